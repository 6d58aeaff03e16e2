//! `caudata-robot run`: both halves under a supervisor; and the flags of all three.

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Duration;

use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};

use crate::boundary::{RunFolder, Staged, alone};
use crate::command_link::LinkKey;
use crate::commands::source::SourceArgs;
use crate::control::FALLEN_FOR;
use crate::hardware::PortOverrides;
use crate::supervisor::{Plan, supervise};
use crate::walk_command::{CommandTable, WalkCommand};
use crate::{DeployError, failure};

/// How long a loop may be silent, where the flag does not say.
const HANG_WIRED: Duration = Duration::from_millis(300);
const HANG_SIMULATED: Duration = Duration::from_secs(10);

/// Flags of `caudata-robot run`.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub(super) source: SourceArgs,
    /// Policy that came with the program, an ONNX file: runs where nothing else may, a lost state included.
    /// It needs no signature
    #[arg(long, value_name = "FILE.onnx", value_parser = caudata_durable::shipped_flag)]
    pub(super) factory: Option<PathBuf>,
    /// Folder for what `agent` and `rt` tell each other, this user's alone; `run` in the state folder when
    /// absent
    #[arg(long, value_name = "DIR")]
    run_dir: Option<PathBuf>,
    /// A loop without a sign of life for this long is ended and the torque switched off, ms. When absent 300
    /// with a wiring file (lower: a busy computer is taken for a hang; higher: a hang lasts longer) and 10000
    /// with a simulated robot
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(60..=600_000))]
    hang_ms: Option<u64>,
    /// Show every tick to other programs of this user on this computer (`caudata-ros2`)
    #[arg(long)]
    pub(super) tap: bool,
    /// Which start of the loop this is.
    #[arg(long, hide = true, default_value_t = 1)]
    start: u32,
    /// The robot: `sim:HOST:PORT` is a simulated one (`caudata sim robot`), `wiring:FILE.toml` real servos,
    /// or emulated ones
    #[arg(long, value_name = "BUS")]
    pub(super) bus: BusAddress,
    #[command(flatten)]
    pub(super) ports: PortOverrides,
    /// Folder for the log of this run; none when absent
    #[arg(long, value_name = "DIR")]
    pub(super) log_dir: Option<PathBuf>,
    /// Folder for the last 30 s before a run ended badly (fall, fault, kill); none when absent
    #[arg(long, value_name = "DIR")]
    pub(super) recorder_dir: Option<PathBuf>,
    /// Take velocity commands from `caudata-robot drive` at this UDP address
    #[arg(long, value_name = "ADDR", requires = "link_key", conflicts_with_all = ["command", "commands"])]
    pub(super) link_addr: Option<SocketAddr>,
    /// File with the key that both ends of the command link share
    #[arg(long, value_name = "FILE")]
    pub(super) link_key: Option<PathBuf>,
    /// Only velocities whose sender says that a dead-man's button is held move the robot (`drive --hold`,
    /// `drive --gamepad`); it stands when the button is let go of. Without it a sender that has no such
    /// button moves it too
    #[arg(long, requires = "link_addr")]
    pub(super) dead_man: bool,
    /// What the robot stands on, for the log
    #[arg(long, value_name = "TEXT", default_value = "")]
    pub(super) terrain: String,
    /// Velocity forward and to the left (m/s) and yaw rate (rad/s)
    #[arg(
        long,
        value_name = "VX,VY,YAW",
        default_value = "0,0,0",
        allow_hyphen_values = true,
        conflicts_with = "commands"
    )]
    pub(super) command: WalkCommand,
    /// CSV file of commands over time: t,vx,vy,yaw_rate
    #[arg(long, value_name = "FILE.csv")]
    pub(super) commands: Option<PathBuf>,
    /// How long the policy is in charge, s; until stopped when absent. While a robot stands because nobody drives it
    /// (`--link-addr`), none of it passes
    #[arg(long, value_name = "N", value_parser = positive)]
    pub(super) seconds: Option<f64>,
    /// Swap in what the label comes to lead to, at safe moments: standing, or before walking
    #[arg(long)]
    pub(super) follow: bool,
    /// How long a newer policy waits for such a moment, s, before the robot is made to stand for it; 0: for
    /// ever
    #[arg(long, value_name = "N", default_value_t = 30.0, value_parser = seconds(0.0, 1e6))]
    pub(super) swap_wait: f64,
    /// How long a robot that lies may take to get up, s, before its servos are let go. For policies that can
    /// get up; under any other it thrashes on its back for as long
    #[arg(long, value_name = "N", default_value_t = FALLEN_FOR.as_secs_f64(), value_parser = seconds(FALLEN_FOR.as_secs_f64(), 60.0))]
    pub(super) get_up: f64,
    /// Address of /metrics and /healthz; none when absent
    #[arg(long, value_name = "ADDR")]
    pub(super) metrics_addr: Option<SocketAddr>,
    /// One JSON object as the last line of standard output
    #[arg(long)]
    pub(super) json: bool,
}

/// Where the robot is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BusAddress {
    /// A simulated robot at `host:port`.
    Sim(String),
    /// The servos and the IMU of a wiring file.
    Wiring(PathBuf),
}

impl FromStr for BusAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once(':') {
            Some(("sim", address)) if address.contains(':') => Ok(Self::Sim(address.to_owned())),
            Some(("wiring", path)) if !path.is_empty() => {
                Ok(Self::Wiring(caudata_durable::shipped(path.as_ref())))
            }
            _ => Err("must be sim:HOST:PORT or wiring:FILE.toml".to_owned()),
        }
    }
}

/// A parser of seconds between two bounds.
fn seconds(least: f64, most: f64) -> impl Fn(&str) -> Result<f64, String> + Clone + Send + Sync {
    move |text| match text.parse::<f64>() {
        Ok(value) if (least..=most).contains(&value) => Ok(value),
        _ => Err(format!("must be {least} to {most}")),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        _ => Err("must be above 0 and at most 1000000".to_owned()),
    }
}

impl RunArgs {
    /// Where `agent` and `rt` meet.
    pub(super) fn run_folder(&self) -> PathBuf {
        let inside = || self.source.state.join("run");
        self.run_dir.clone().unwrap_or_else(inside)
    }

    /// `folder` for this start of the loop: a log is never overwritten.
    pub(super) fn of_this_start(&self, folder: &Path) -> PathBuf {
        match self.start {
            0 | 1 => folder.to_owned(),
            start => PathBuf::from(format!("{}-{start}", folder.display())),
        }
    }

    /// Where the robot goes.
    pub(super) fn command_table(&self) -> Result<CommandTable, DeployError> {
        match &self.commands {
            Some(path) => CommandTable::read(path),
            None => Ok(CommandTable::constant(self.command)),
        }
    }
}

/// Supervises until the run is over.
pub fn run(args: &RunArgs, process: &Process) -> Result<(), Failure> {
    // What would end a child at once ends this one before anything is fetched.
    args.command_table().map_err(failure)?;
    args.source.check().map_err(failure)?;
    if let Some(key) = &args.link_key {
        LinkKey::read(key).map_err(failure)?;
    }
    let folder = RunFolder::open(&args.run_folder()).map_err(failure)?;
    // Before anything in the folder is touched: a second supervisor would take the first one's sockets away.
    let _alone = alone(&folder.file("run.lock")).map_err(failure)?;
    let hang = match &args.bus {
        BusAddress::Sim(_) => HANG_SIMULATED,
        BusAddress::Wiring(_) => HANG_WIRED,
    };
    let plan = Plan {
        program: std::env::current_exe().or_exit(ExitCode::Internal)?,
        arguments: around_the_command(std::env::args_os().skip(1), "run"),
        limp: limp_arguments(args),
        hang_after: args.hang_ms.map_or(hang, Duration::from_millis),
        folder: folder.clone(),
    };
    // A second signal must not leave torque on: it is dealt with there.
    let insisted = process.insistence.claim();
    let result = supervise(&plan, &process.stop, &insisted);
    Staged::clear(&folder);
    result
}

/// Arguments before and after the first `command`.
fn around_the_command(
    mut arguments: impl Iterator<Item = OsString>,
    command: &str,
) -> [Vec<OsString>; 2] {
    let before = arguments.by_ref().take_while(|word| word != command).collect();
    [before, arguments.collect()]
}

/// A simulated robot needs nobody to let it go: without a client its time stands still.
fn limp_arguments(args: &RunArgs) -> Option<Vec<OsString>> {
    let BusAddress::Wiring(wiring) = &args.bus else { return None };
    let mut arguments = vec!["--wiring".into(), wiring.into()];
    if let Some(port) = &args.ports.servo_port {
        arguments.extend(["--servo-port".into(), port.into()]);
    }
    Some(arguments)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn children_get_the_arguments_of_the_command_that_they_replace() {
        let words = ["--log-format", "json", "run", "--state", "run"].map(OsString::from);
        let [before, after] = around_the_command(words.into_iter(), "run");
        assert_eq!(before, ["--log-format", "json"]);
        assert_eq!(after, ["--state", "run"]);
    }
}
