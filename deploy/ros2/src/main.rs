//! `caudata-ros2`: joint states, frames, odometry, IMU, battery and diagnostics of a robot for ROS 2, and velocity commands from it.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode as OsExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_deploy::boundary::RunFolder;
use caudata_deploy::command_link::LinkKey;
use caudata_deploy::failure;
use caudata_deploy::tap::Tap;
use caudata_model::{ModelError, RobotModel};
use caudata_ros2::door::{Appearance, Commands, Door, settings};
use caudata_telemetry::{ExitCode, Failure, FailureExt, LogArgs, Process, parse_args};
use clap::Parser;

/// How long a tick is waited for before commands are looked at again.
const TICK_MAX: Duration = Duration::from_millis(25);
/// After this time without one that is said, once for every silence.
const SILENCE: Duration = Duration::from_secs(5);

/// Shows a robot that runs with `caudata-robot run --tap` to ROS 2 nodes on rmw_zenoh_cpp, and passes their
/// velocities on to it.
///
/// Topics: /joint_states, /imu/data, /odom (by the legs), /tf, /battery_state, /robot_description, /diagnostics out; /cmd_vel
/// (geometry_msgs/Twist) in, with --link-addr only.
#[derive(Debug, Parser)]
#[command(name = "caudata-ros2", version, max_term_width = 100, after_help = EXIT_CODES)]
struct Args {
    /// Robot file, for the names of the joints, its description and its frames
    #[arg(
        long,
        value_name = "FILE.robot.toml",
        default_value = "robots/polymander.robot.toml",
        value_parser = caudata_durable::shipped_flag
    )]
    robot: PathBuf,
    /// The robot's --run-dir; without one, `run` in its state folder
    #[arg(long, value_name = "DIR")]
    run_dir: PathBuf,
    /// zenoh endpoint of the ROS router (`ros2 run rmw_zenoh_cpp rmw_zenohd`) or of another peer; may be
    /// given more than once
    #[arg(long, value_name = "ENDPOINT", default_value = "tcp/localhost:7447")]
    connect: Vec<String>,
    /// ROS domain; other domains see nothing of this robot
    #[arg(long, value_name = "N", env = "ROS_DOMAIN_ID", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=232))]
    domain: u32,
    /// Name of the node
    #[arg(long, value_name = "NAME", default_value = "salamander", value_parser = name)]
    node: String,
    /// In front of the topics (but /diagnostics): empty, or a name such as `robot1`
    #[arg(long, value_name = "NAME", default_value = "", value_parser = name_or_nothing)]
    namespace: String,
    /// Frame of the IMU
    #[arg(long, value_name = "NAME", default_value = "imu")]
    imu_frame: String,
    /// The robot's --link-addr: velocities of ROS go there. Without it none are taken
    #[arg(long, value_name = "HOST:PORT", requires = "link_key")]
    link_addr: Option<SocketAddr>,
    /// File with the key of that link
    #[arg(long, value_name = "FILE")]
    link_key: Option<PathBuf>,
    /// Logging.
    #[command(flatten)]
    log: LogArgs,
}

const EXIT_CODES: &str = "\
Exit codes: 0 done · 64 flag · 65 bad input file · 66 input missing · 69 zenoh endpoint gone · 71 system resource
  73 the tap cannot be opened · 130 interrupted twice";

/// A name as ROS allows it: letters, digits, `_`, no digit in front.
fn name(text: &str) -> Result<String, String> {
    let fits = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let starts = text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_');
    match starts && text.chars().all(fits) && text.len() <= 64 {
        true => Ok(text.to_owned()),
        false => {
            Err("must be letters, digits and _, at most 64, without a digit in front".to_owned())
        }
    }
}

fn name_or_nothing(text: &str) -> Result<String, String> {
    if text.is_empty() { Ok(String::new()) } else { name(text) }
}

fn main() -> OsExitCode {
    let args: Args = parse_args();
    Process::run("caudata-ros2", &args.log, |process| run(&args, process))
}

fn run(args: &Args, process: &Process) -> Result<(), Failure> {
    let model = RobotModel::load(&args.robot).map_err(|error| {
        let code = match &error {
            ModelError::Read { .. } => ExitCode::NoInput,
            _ => ExitCode::BadInput,
        };
        Failure::new(code, error).context("robot file")
    })?;
    let joints = model.actuated_names();
    let torque = (0..joints.len()).map(|i| model.servo(i).torque_per_current_nm_per_a);
    let prefix = match args.namespace.is_empty() {
        true => String::new(),
        false => format!("/{}", args.namespace),
    };
    let appearance = Appearance {
        domain: args.domain,
        node: args.node.clone(),
        prefix,
        imu_frame: args.imu_frame.clone(),
        torque_nm_per_a: torque.collect(),
        joints: joints.iter().map(|name| (*name).to_owned()).collect(),
        robot: Arc::new(model.clone()),
    };
    let mut commands = match (args.link_addr, &args.link_key) {
        (Some(address), Some(key)) => {
            let key = LinkKey::read(key).map_err(failure)?;
            Some(Commands::to(address, key).or_exit(ExitCode::OsResource)?)
        }
        _ => None,
    };
    let folder = RunFolder::open(&args.run_dir).map_err(failure)?;
    let tap = Tap::open(&folder).map_err(failure)?;
    let config = settings(&args.connect, &[]).or_exit(ExitCode::BadConfig)?;
    let mut door = Door::open(config, appearance).or_exit(ExitCode::Unavailable)?;
    tracing::info!(node = args.node, session = door.session_id(), "the door to ROS is open");
    let (mut heard, mut said) = (Instant::now(), false);
    while !process.stop.is_set() {
        if let Some(tick) = tap.next(TICK_MAX).or_exit(ExitCode::OsResource)? {
            door.publish(&tick).or_exit(ExitCode::Unavailable)?;
            (heard, said) = (Instant::now(), false);
        } else if !said && heard.elapsed() > SILENCE {
            said = true;
            tracing::warn!(
                run_dir = %args.run_dir.display(),
                "nothing is heard of a robot: does `caudata-robot run --tap` run with this --run-dir?"
            );
        }
        if let Some(commands) = &mut commands {
            commands.pass_on(door.velocity());
        }
    }
    Ok(())
}
