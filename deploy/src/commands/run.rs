//! `caudata-robot run`.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::thread::JoinHandle;
use std::time::Duration;

use caudata_dynamixel::{BusFault, SerialPort};
use caudata_hardware::wiring::Limits;
use caudata_hardware::{I2c, JointWiring, Wiring};
use caudata_model::RobotModel;
use caudata_telemetry::{Metrics, MetricsServer, Process};
use crossbeam_channel::Receiver;

use crate::DeployError;
use crate::bus::{BusError, Health, Robot};
use crate::command_link::{LinkKey, UdpLink};
use crate::commands::{PortArgs, Source, SourceArgs, say, say_json};
use crate::control::{ControlLoop, READ_DEADLINE, RunPlan};
use crate::flight_log::{FlightLog, LogCounts, meta, write_rows};
use crate::follower::Follower;
use crate::gate::HELD_IN_A_ROW_MAX;
use crate::guard::Fault;
use crate::hardware::inspect::{self, Inspection, Mark};
use crate::hardware::{HardwareRobot, open_bus, open_imu, read_wiring};
use crate::keeper::Keeper;
use crate::metrics::RobotMetrics;
use crate::pacing::SystemClock;
use crate::report::{Ended, RunSummary, rounded};
use crate::runner::PolicyRunner;
use crate::sim_link::SimLink;
use crate::updates::{PolicyEvent, Slot, Updates};
use crate::verify::Verified;
use crate::walk_command::{CommandTable, WalkCommand};

/// Targets may move this many times as fast as the fastest servo turns without load: what a policy of training asks for
/// passes, a jump does not.
const RATE_LIMIT_FACTOR: f64 = 2.0;

/// Flags of `caudata-robot run`.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    #[command(flatten)]
    source: SourceArgs,
    /// The robot: `sim:HOST:PORT` is a simulated one (`caudata sim robot`), `wiring:FILE.toml` real servos, or emulated ones
    #[arg(long, value_name = "BUS")]
    bus: BusAddress,
    #[command(flatten)]
    ports: PortArgs,
    /// Folder for the log of this run; none when absent
    #[arg(long, value_name = "DIR")]
    log_dir: Option<PathBuf>,
    /// Folder for the last 30 s before a run ended badly (fall, fault, kill); none when absent
    #[arg(long, value_name = "DIR")]
    recorder_dir: Option<PathBuf>,
    /// Take velocity commands from `caudata-robot drive` at this UDP address
    #[arg(long, value_name = "ADDR", requires = "link_key", conflicts_with_all = ["command", "commands"])]
    link_addr: Option<SocketAddr>,
    /// File with the key that both ends of the command link share
    #[arg(long, value_name = "FILE")]
    link_key: Option<PathBuf>,
    /// What the robot stands on, for the log
    #[arg(long, value_name = "TEXT", default_value = "")]
    terrain: String,
    /// Velocity forward and to the left (m/s) and yaw rate (rad/s)
    #[arg(
        long,
        value_name = "VX,VY,YAW",
        default_value = "0,0,0",
        allow_hyphen_values = true,
        conflicts_with = "commands"
    )]
    command: WalkCommand,
    /// CSV file of commands over time: t,vx,vy,yaw_rate
    #[arg(long, value_name = "FILE.csv")]
    commands: Option<PathBuf>,
    /// How long the policy is in charge, s; until stopped when absent
    #[arg(long, value_name = "N", value_parser = positive)]
    seconds: Option<f64>,
    /// Swap in what the label comes to lead to, at safe moments: standing, or before walking
    #[arg(long)]
    follow: bool,
    /// How long a newer policy waits for such a moment, s, before the robot is made to stand for it; 0: for ever
    #[arg(long, value_name = "N", default_value_t = 30.0, value_parser = not_negative)]
    swap_wait: f64,
    /// Address of /metrics and /healthz; none when absent
    #[arg(long, value_name = "ADDR")]
    metrics_addr: Option<SocketAddr>,
    /// One JSON object as the last line of standard output
    #[arg(long)]
    json: bool,
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
            Some(("wiring", path)) if !path.is_empty() => Ok(Self::Wiring(path.into())),
            _ => Err("must be sim:HOST:PORT or wiring:FILE.toml".to_owned()),
        }
    }
}

fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (0.0..=1e6).contains(&value) => Ok(value),
        _ => Err("must be 0 to 1000000".to_owned()),
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value > 0.0 && value <= 1e6 => Ok(value),
        _ => Err("must be above 0 and at most 1000000".to_owned()),
    }
}

pub fn run(args: &RunArgs, process: &Process) -> Result<(), DeployError> {
    let commands = match &args.commands {
        Some(path) => CommandTable::read(path)?,
        None => CommandTable::constant(args.command),
    };
    let registry = Metrics::new();
    let (source, metrics) = Source::open(&args.source, &registry)?;
    let _endpoint = match args.metrics_addr {
        Some(addr) => Some(metrics_endpoint(addr, registry, process)?),
        None => None,
    };
    let verified = choose(&source)?;
    match &args.bus {
        BusAddress::Sim(address) => {
            let mut robot = SimLink::connect(address, &source.model, source.control_period_s)?;
            let plan = plan(args, &source, commands, READ_DEADLINE, None);
            walk(args, &source, &mut robot, plan, verified, metrics, process)
        }
        BusAddress::Wiring(path) => {
            let overrides = args.ports.overrides();
            let (wiring, joints) = read_wiring(path, &source.model, &overrides)?;
            let mut robot = open_robot(&wiring, joints, &source.model)?;
            let deadline = Duration::from_millis(wiring.bus.read_deadline_ms);
            let plan = plan(args, &source, commands, deadline, Some(wiring.limits));
            let result = walk(args, &source, &mut robot, plan, verified, metrics, process);
            tracing::info!(counts = ?robot.bus_counts(), "servo bus");
            result
        }
    }
}

fn plan(
    args: &RunArgs,
    source: &Source,
    commands: CommandTable,
    read_deadline: Duration,
    limits: Option<Limits>,
) -> RunPlan {
    RunPlan {
        period: Duration::from_secs_f64(source.control_period_s),
        walk_s: args.seconds,
        commands,
        step_max_rad: step_max_rad(source),
        read_deadline,
        limits,
        swap_wait: (args.swap_wait > 0.0).then(|| Duration::from_secs_f64(args.swap_wait)),
    }
}

/// Servos and IMU, inspected; servos that hold something else are set right.
fn open_robot(
    wiring: &Wiring,
    joints: Vec<JointWiring>,
    model: &RobotModel,
) -> Result<HardwareRobot<SerialPort, Box<dyn I2c + Send>>, DeployError> {
    let mut bus = open_bus(wiring)?;
    let lost = |fault: BusFault| BusError::Lost {
        reason: fault.to_string(),
    };
    let servos = inspect::servos(&mut bus, wiring, &joints, model, true).map_err(lost)?;
    for check in &servos.checks {
        if check.mark == Mark::Fixed {
            tracing::warn!(
                at = check.at,
                what = check.what,
                found = check.found,
                "set right"
            );
        }
    }
    fit(&servos)?;
    let mut imu = open_imu(wiring)?;
    fit(&inspect::imu(&mut imu))?;
    HardwareRobot::new(bus, imu, wiring, joints)
}

/// Refuses a robot with which something is wrong.
pub(super) fn fit(inspection: &Inspection) -> Result<(), DeployError> {
    let Some(first) = inspection.wrong().next() else {
        return Ok(());
    };
    Err(DeployError::Unfit {
        wrong: inspection.wrong().count(),
        checks: inspection.checks.len(),
        first: format!("{}: {}: {}", first.at, first.what, first.found),
    })
}

/// Follows, keeps house and drives.
fn walk<R: Robot>(
    args: &RunArgs,
    source: &Source,
    robot: &mut R,
    plan: RunPlan,
    mut verified: Verified,
    metrics: RobotMetrics,
    process: &Process,
) -> Result<(), DeployError> {
    // Here, and not before: a robot that is not there says nothing about the policy.
    source.keeper.begin(&mut verified)?;
    let slot = Slot::default();
    let (updates, events) = Updates::new(slot.clone());
    let follower = match args.follow {
        true => Some(Follower::start(
            source.keeper.clone(),
            source.follow.clone(),
            verified.policy.clone(),
            slot,
            metrics.clone(),
        )?),
        false => None,
    };
    let housekeeper = keep_house(source.keeper.clone(), events)?;
    let result = drive(
        args, source, robot, plan, verified, updates, metrics, process,
    );
    drop(follower);
    if housekeeper.join().is_err() {
        tracing::error!("the housekeeping thread panicked");
    }
    let (summary, fault) = result?;
    finish(args, summary, fault)
}

/// The server's newest policy, or else the best on the disk.
fn choose(source: &Source) -> Result<Verified, DeployError> {
    let error = match source.pull() {
        Ok(verified) => return Ok(verified),
        Err(
            error @ (DeployError::Server(_)
            | DeployError::NoPolicy { .. }
            | DeployError::Stale { .. }
            | DeployError::Refused { .. }),
        ) => error,
        Err(error) => return Err(error),
    };
    if source.keeper.is_torn() {
        tracing::error!(%error, "no proof");
        return Err(DeployError::StateLost);
    }
    match source.keeper.from_disk()? {
        Some(verified) => {
            tracing::warn!(%error, running = %verified.policy, "running what is on disk");
            Ok(verified)
        }
        None => Err(error),
    }
}

/// The run itself.
fn drive<R: Robot>(
    args: &RunArgs,
    source: &Source,
    robot: &mut R,
    plan: RunPlan,
    verified: Verified,
    updates: Updates,
    metrics: RobotMetrics,
    process: &Process,
) -> Result<(RunSummary, Option<(Fault, Health)>), DeployError> {
    let clock = SystemClock::new();
    let runner = PolicyRunner::new(verified, None)?;
    warn_of_untrained(&plan, &runner);
    let mut control = ControlLoop::start(robot, &clock, plan, runner, updates, metrics)?;
    if let (Some(folder), Some(first)) = (&args.log_dir, control.first()) {
        let policy = control.runner().policy();
        let supply_v = first.servos.supply_v;
        let meta = meta(
            &source.model,
            policy,
            source.control_period_s,
            supply_v,
            &args.terrain,
        );
        let log = FlightLog::create(folder, &source.model, &meta, &first.truth)?;
        control.set_log(log);
    }
    if let (Some(addr), Some(key)) = (args.link_addr, &args.link_key) {
        control.set_link(Box::new(UdpLink::listen(addr, LinkKey::read(key)?)?));
    }
    let result = control.run(&process.stop);
    if let Some(folder) = &args.recorder_dir {
        let calm = matches!(result, Ok(Ended::Time | Ended::Signal));
        // The run's own error comes first.
        if let Err(error) = record(folder, source, args, &control, calm) {
            tracing::error!(%error, "the last moments are lost");
        }
    }
    let policy = control.runner().policy().clone();
    let fault = control.fault();
    let (log, counts) = control.into_parts();
    // The log is closed whatever happened; the run's own error comes first.
    let rows = log.map(FlightLog::finish).transpose();
    let ended = result?;
    let rows: LogCounts = rows?.unwrap_or_default();
    let commanded = counts.mean_command();
    let travel = counts.odometer.result();
    let summary = RunSummary {
        robot: source.model.name().to_owned(),
        policy_stream: policy.stream,
        policy_version: policy.version,
        policy_sha256: policy.sha256,
        policy_swaps: counts.swaps,
        stands_for_swap: counts.stands_for_swap,
        swap_speed_radps: rounded(f64::from(counts.swap_speed_radps)),
        ended,
        walked_s: rounded(counts.walked_s),
        ticks: counts.ticks,
        overruns: counts.overruns,
        late_readings: counts.late_readings,
        tick_p50_us: counts.tick_latency.quantile_us(0.5),
        tick_p99_us: counts.tick_latency.quantile_us(0.99),
        tick_p999_us: counts.tick_latency.quantile_us(0.999),
        inference_p99_us: counts.inference_latency.quantile_us(0.99),
        resident_bytes: resident_bytes(),
        wake_late_p99_us: counts.wake_latency.quantile_us(0.99),
        held_actions: counts.held,
        rate_limited_ticks: counts.rate_limited,
        log_rows: rows.written,
        log_dropped: rows.dropped,
        commanded,
        achieved: travel.map(|(velocity, _)| velocity),
        distance_m: travel.map(|(_, distance)| distance),
    };
    Ok((summary, fault))
}

/// Writes the last 30 s of a run that ended badly.
fn record<R: Robot>(
    folder: &Path,
    source: &Source,
    args: &RunArgs,
    control: &ControlLoop<'_, R, SystemClock>,
    calm: bool,
) -> Result<(), DeployError> {
    let rows = control.recorder();
    let Some(last) = rows.iter().last().filter(|_| !calm) else {
        return Ok(());
    };
    let meta = meta(
        &source.model,
        control.runner().policy(),
        source.control_period_s,
        last.servos.supply_v,
        &args.terrain,
    );
    let rows = write_rows(folder, &source.model, &meta, rows.iter())?;
    tracing::error!(folder = %folder.display(), rows, "the last moments are written");
    Ok(())
}

fn warn_of_untrained(plan: &RunPlan, runner: &PolicyRunner) {
    let wanted = plan.commands.at(0.0);
    let given = runner.trained_command(wanted);
    if wanted != given {
        tracing::warn!(
            ?wanted,
            ?given,
            "the policy was not trained for this command; it gets the nearest it knows"
        );
    }
}

/// Prints the summary; a policy that had to be stopped is a failure.
fn finish(
    args: &RunArgs,
    summary: RunSummary,
    fault: Option<(Fault, Health)>,
) -> Result<(), DeployError> {
    if args.json {
        say_json(&summary)?;
    } else {
        print(&summary, args);
    }
    if summary.ended == Ended::BadActions {
        return Err(DeployError::BadActions {
            policy: crate::state::PolicyRef {
                stream: summary.policy_stream,
                version: summary.policy_version,
                sha256: summary.policy_sha256,
                reverts_to: None,
            },
            in_a_row: HELD_IN_A_ROW_MAX,
        });
    }
    if let Some((fault, health)) = fault {
        let detail = format!("{health:?}");
        return Err(DeployError::Stopped { fault, detail });
    }
    Ok(())
}

fn print(summary: &RunSummary, args: &RunArgs) {
    say(&format!(
        "{} version {} walked {:.1} s ({:?}): {} ticks, {} skipped, tick p50 {} µs, p99 {} µs",
        summary.policy_stream,
        summary.policy_version,
        summary.walked_s,
        summary.ended,
        summary.ticks,
        summary.overruns,
        summary.tick_p50_us,
        summary.tick_p99_us,
    ));
    if let (Some(achieved), Some(distance)) = (summary.achieved, summary.distance_m) {
        let commanded = summary.commanded;
        say(&format!(
            "commanded {:.3} {:.3} m/s {:.3} rad/s, achieved {:.3} {:.3} m/s {:.3} rad/s, {distance:.2} m from the start",
            commanded.vx_mps,
            commanded.vy_mps,
            commanded.yaw_rate_radps,
            achieved.vx_mps,
            achieved.vy_mps,
            achieved.yaw_rate_radps,
        ));
    }
    if let Some(folder) = &args.log_dir {
        say(&format!(
            "log: {} ({} rows)",
            folder.display(),
            summary.log_rows
        ));
    }
}

/// Memory of this process that is in use now, bytes; 0 where the system does not tell.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok());
    1024 * kib.unwrap_or(0)
}

fn step_max_rad(source: &Source) -> f32 {
    let joints = source.model.actuated().len();
    let fastest = (0..joints)
        .map(|i| source.model.servo(i).qd_max_radps)
        .fold(0.0, f64::max);
    (RATE_LIMIT_FACTOR * fastest * source.control_period_s) as f32
}

fn metrics_endpoint(
    addr: SocketAddr,
    registry: Metrics,
    process: &Process,
) -> Result<MetricsServer, DeployError> {
    MetricsServer::start(addr, registry, process.stop.clone()).map_err(|error| {
        DeployError::System {
            what: "the metrics address",
            source: std::io::Error::other(error.to_string()),
        }
    })
}

/// Writes what the loop learns to the disk, and takes replaced policies apart; ends when the loop is gone.
fn keep_house(
    keeper: Keeper,
    events: Receiver<PolicyEvent>,
) -> Result<JoinHandle<()>, DeployError> {
    let work = move || {
        for event in events {
            if let Err(error) = keeper.note(event) {
                tracing::error!(%error, "cannot write down what was learnt about a policy");
            }
        }
    };
    std::thread::Builder::new()
        .name("housekeeping".into())
        .spawn(work)
        .map_err(|source| DeployError::System {
            what: "a thread",
            source,
        })
}
