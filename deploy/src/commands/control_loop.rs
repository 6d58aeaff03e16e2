//! `caudata-robot rt`: the control loop. It opens the bus and the IMU, asks for a policy, and drives; it
//! knows no network.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use caudata_dynamixel::SerialPort;
use caudata_hardware::{I2c, JointWiring, Wiring};
use caudata_model::RobotModel;
use caudata_signing::Trust;
use caudata_task::TaskConfig;
use caudata_telemetry::{Metrics, Process};

use crate::boundary::{LOOP_PAGE, LocalLink, RunFolder, Teller, alone};
use crate::bus::{BusError, Health, Robot};
use crate::command_link::random_nonce;
use crate::commands::run::{BusAddress, RunArgs};
use crate::commands::say::{json_line, say_within};
use crate::commands::source::{SourceArgs, load_model};
use crate::control::{ControlLoop, Counts, LegOdometry, READ_DEADLINE, RunPlan};
use crate::courier::{Courier, Loader};
use crate::flight_log::{FlightLog, LogCounts, meta, write_rows};
use crate::gate::HELD_IN_A_ROW_MAX;
use crate::guard::Fault;
use crate::hardware::inspect::{self, Inspection, Mark};
use crate::hardware::{HardwareRobot, open_bus, open_imu, read_wiring};
use crate::metrics::RobotMetrics;
use crate::notify::Notifier;
use crate::pacing::SystemClock;
use crate::runner::PolicyRunner;
use crate::sim_link::SimLink;
use crate::state::PolicyRef;
use crate::store::{PolicyStore, check_trust, check_without_trust};
use crate::summary::{Ended, RunSummary, rounded};
use crate::updates::{Slot, Updates};
use crate::verify::Verified;
use crate::{DeployError, tap};

/// How long the end of a run waits for whoever reads what it prints. Its supervisor would end it after thirty
/// seconds.
const SAY_MAX: Duration = Duration::from_secs(5);

/// Targets may move this many times as fast as the fastest servo turns without load: what a policy of
/// training asks for passes, a jump does not.
const RATE_LIMIT_FACTOR: f64 = 2.0;

/// What every start of the loop needs.
struct Setting<'a> {
    args: &'a RunArgs,
    model: Arc<RobotModel>,
    control_period_s: f64,
    folder: RunFolder,
    process: &'a Process,
}

/// One run.
pub fn run(args: &RunArgs, process: &Process) -> Result<(), DeployError> {
    let commands = args.command_table()?;
    let folder = RunFolder::open(&args.run_folder())?;
    let _alone = alone(&folder.file("rt.lock"))?;
    // And on the state, which another run folder may share: two loops would tell their agents under the same
    // numbers.
    let teller = Teller::open(&args.source.state, &folder)?;
    let setting = Setting {
        args,
        model: load_model(&args.source.robot)?,
        control_period_s: TaskConfig::default().control_period_s,
        folder,
        process,
    };
    let plan = |read_deadline, limits| RunPlan {
        period: Duration::from_secs_f64(setting.control_period_s),
        walk_s: args.seconds,
        commands,
        step_max_rad: step_max_rad(&setting),
        read_deadline,
        limits,
        get_up: Duration::from_secs_f64(args.get_up),
        balances: setting.model.balances(),
        legs: LegOdometry::new(setting.model.clone()),
        swap_wait: (args.swap_wait > 0.0).then(|| Duration::from_secs_f64(args.swap_wait)),
    };
    match &args.bus {
        BusAddress::Sim(address) => {
            let mut robot = SimLink::connect(address, &setting.model, setting.control_period_s)?;
            walk(&setting, &mut robot, plan(READ_DEADLINE, None), teller)
        }
        BusAddress::Wiring(path) => {
            let (wiring, joints) = read_wiring(path, &setting.model, &args.ports)?;
            let mut robot = open_robot(&wiring, joints, &setting.model)?;
            if args.ports.in_step {
                robot = robot.in_step(setting.control_period_s);
            }
            let deadline = Duration::from_millis(wiring.bus.read_deadline_ms);
            let plan = plan(deadline, Some(wiring.limits));
            let result = walk(&setting, &mut robot, plan, teller);
            tracing::info!(counts = ?robot.bus_counts(), "servo bus");
            result
        }
    }
}

/// Servos and IMU, inspected; servos that hold something else are set right.
fn open_robot(
    wiring: &Wiring,
    joints: Vec<JointWiring>,
    model: &RobotModel,
) -> Result<HardwareRobot<SerialPort, Box<dyn I2c + Send>>, DeployError> {
    let mut bus = open_bus(wiring)?;
    let servos = inspect::servos(&mut bus, wiring, &joints, model, true);
    let servos = servos.map_err(BusError::from)?;
    for check in &servos.checks {
        if check.mark == Mark::Fixed {
            tracing::warn!(at = check.at, what = check.what, found = check.found, "set right");
        }
    }
    fit(&servos)?;
    let mut imu = open_imu(wiring)?;
    fit(&inspect::imu(&mut imu))?;
    HardwareRobot::new(bus, imu, wiring, joints)
}

/// Refuses a robot with which something is wrong.
pub(super) fn fit(inspection: &Inspection) -> Result<(), DeployError> {
    let Some(first) = inspection.wrong().next() else { return Ok(()) };
    Err(DeployError::Unfit {
        wrong: inspection.wrong().count(),
        checks: inspection.checks.len(),
        first: format!("{}: {}: {}", first.at, first.what, first.found),
    })
}

/// Asks for a policy and drives: only now, for a robot that is not there says nothing about the policy.
fn walk<R: Robot>(
    setting: &Setting,
    robot: &mut R,
    plan: RunPlan,
    teller: Teller,
) -> Result<(), DeployError> {
    let args = setting.args;
    let registry = Metrics::new();
    let metrics = RobotMetrics::register(&registry);
    let loader = Loader {
        model: setting.model.clone(),
        state: args.source.state.clone(),
        trust: trust_of(&args.source)?.map(Arc::new),
        factory: args.factory.clone(),
        tells_water: robot.in_water().is_some(),
    };
    let link = LocalLink::open(&setting.folder)?;
    let run = random_nonce().map_err(DeployError::system("random bytes"))?;
    let page = args.metrics_addr.map(|_| (registry, setting.folder.file(LOOP_PAGE)));
    let mut courier = Courier::new(setting.folder.clone(), teller, loader, run, page);
    let Some(verified) = courier.first(&setting.process.stop)? else { return Ok(()) };
    let slot = Slot::default();
    let (updates, events) = Updates::new(slot.clone());
    let courier = courier.start(events, slot)?;
    let result = drive(setting, robot, plan, verified, updates, metrics, link);
    if courier.join().is_err() {
        tracing::error!("the courier panicked");
    }
    let over = result?;
    finish(args, over)
}

/// The trust file, where one is given: not one that is older than another that was in force on this robot,
/// and not none where one was. A state that was lost says nothing about that.
fn trust_of(args: &SourceArgs) -> Result<Option<Trust>, DeployError> {
    args.check()?;
    let trust = args.trust.as_deref().map(Trust::read).transpose();
    let trust = trust.map_err(DeployError::Trust)?;
    let state = match PolicyStore::peek(&args.state) {
        Ok(Some(state)) => state,
        Ok(None) | Err(DeployError::StateDamaged { .. }) => return Ok(trust),
        Err(error) => return Err(error),
    };
    match (&args.trust, &trust) {
        (Some(path), Some(trust)) => check_trust(&state, path, trust.version())?,
        _ => check_without_trust(&state, &args.state)?,
    }
    Ok(trust)
}

/// What a run came to.
struct Over {
    summary: RunSummary,
    /// What the hardware stopped it for.
    fault: Option<(Fault, Health)>,
    /// Why its log is not whole.
    log: Option<DeployError>,
}

/// The run itself.
fn drive<R: Robot>(
    setting: &Setting,
    robot: &mut R,
    plan: RunPlan,
    verified: Verified,
    updates: Updates,
    metrics: RobotMetrics,
    link: LocalLink,
) -> Result<Over, DeployError> {
    let args = setting.args;
    let clock = SystemClock::new();
    let runner = PolicyRunner::new(verified, None)?;
    warn_of_untrained(&plan, &runner);
    let mut control = ControlLoop::start(robot, &clock, plan, runner, updates, metrics)?;
    if let (Some(folder), Some(first)) = (&args.log_dir, control.first()) {
        let policy = control.runner().policy();
        let supply_v = first.servos.supply_v;
        let meta = meta(&setting.model, policy, setting.control_period_s, supply_v, &args.terrain);
        let folder = args.of_this_start(folder);
        let log = FlightLog::create(&folder, &setting.model, &meta, &first.truth)?;
        control.log = Some(log);
    }
    // Without commands over the network it only shows that a loop is here.
    let _presence = match args.link_addr {
        Some(_) => {
            control.link = Some(Box::new(link));
            None
        }
        None => Some(link),
    };
    control.notifier = Notifier::from_environment()?;
    // From here on there is torque, which a second signal must not leave on.
    control.insisted = setting.process.insistence.claim();
    if args.tap {
        control.tap = Some(tap::start(&setting.folder)?);
    }
    let result = control.run(&setting.process.stop);
    if let Some(folder) = &args.recorder_dir {
        let calm = matches!(result, Ok(Ended::Time | Ended::Signal | Ended::Interrupted));
        // The run's own error comes first.
        if let Err(error) = record(&args.of_this_start(folder), setting, &control, calm) {
            tracing::error!(%error, "the last moments are lost");
        }
    }
    let policy = control.runner().policy().clone();
    let fault = control.fault();
    let (log, counts) = control.into_parts();
    // The log is closed whatever happened; the run's own error comes first.
    let rows = log.map(FlightLog::finish).transpose();
    let ended = result?;
    // A log that could not be kept does not make the run untrue: it is told after the summary.
    let (rows, log) = match rows {
        Ok(rows) => (rows.unwrap_or_default(), None),
        Err(error) => (LogCounts::default(), Some(error)),
    };
    let summary = summary_of(setting.model.name(), policy, ended, counts, rows);
    Ok(Over { summary, fault, log })
}

fn summary_of(
    robot: &str,
    policy: PolicyRef,
    ended: Ended,
    counts: Counts,
    rows: LogCounts,
) -> RunSummary {
    let commanded = counts.mean_command();
    let by_legs = counts.by_legs();
    let travel = counts.odometer.result();
    RunSummary {
        robot: robot.to_owned(),
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
        saturated_joint_ticks: counts.saturated,
        log_rows: rows.written,
        log_dropped: rows.dropped,
        commanded,
        by_legs,
        achieved: travel.map(|(velocity, _)| velocity),
        distance_m: travel.map(|(_, distance)| distance),
    }
}

/// Writes the last 30 s of a run that ended badly.
fn record<R: Robot>(
    folder: &Path,
    setting: &Setting,
    control: &ControlLoop<'_, R, SystemClock>,
    calm: bool,
) -> Result<(), DeployError> {
    let rows = control.last_moments();
    let Some(last) = rows.iter().last().filter(|_| !calm) else { return Ok(()) };
    let meta = meta(
        &setting.model,
        control.runner().policy(),
        setting.control_period_s,
        last.servos.supply_v,
        &setting.args.terrain,
    );
    let rows = write_rows(folder, &setting.model, &meta, rows.iter())?;
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
fn finish(args: &RunArgs, over: Over) -> Result<(), DeployError> {
    let Over { summary, fault, log } = over;
    let text = if args.json { json_line(&summary)? } else { in_words(&summary, args) };
    if !say_within(text, SAY_MAX) {
        tracing::warn!("nobody reads standard output: the summary is lost");
    }
    let policy = PolicyRef {
        stream: summary.policy_stream,
        version: summary.policy_version,
        sha256: summary.policy_sha256,
        reverts_to: None,
    };
    match summary.ended {
        Ended::BadActions => {
            let in_a_row = HELD_IN_A_ROW_MAX;
            return Err(DeployError::BadActions { policy, in_a_row });
        }
        Ended::Saturated => return Err(DeployError::Saturated { policy }),
        Ended::Interrupted => return Err(DeployError::Interrupted),
        _ => {}
    }
    if let Some((fault, health)) = fault {
        let detail = format!("{health:?}");
        return Err(DeployError::Stopped { fault, detail });
    }
    log.map_or(Ok(()), Err)
}

fn in_words(summary: &RunSummary, args: &RunArgs) -> String {
    let mut lines = vec![format!(
        "{} version {} walked {:.1} s ({:?}): {} ticks, {} skipped, tick p50 {} µs, p99 {} µs",
        summary.policy_stream,
        summary.policy_version,
        summary.walked_s,
        summary.ended,
        summary.ticks,
        summary.overruns,
        summary.tick_p50_us,
        summary.tick_p99_us,
    )];
    if let (Some(achieved), Some(distance)) = (summary.achieved, summary.distance_m) {
        let commanded = summary.commanded;
        lines.push(format!(
            "commanded {:.3} {:.3} m/s {:.3} rad/s, achieved {:.3} {:.3} m/s {:.3} rad/s, {distance:.2} m from the start",
            commanded.vx_mps,
            commanded.vy_mps,
            commanded.yaw_rate_radps,
            achieved.vx_mps,
            achieved.vy_mps,
            achieved.yaw_rate_radps,
        ));
    }
    if let Some(legs) = summary.by_legs {
        lines.push(format!(
            "by its legs {:.3} {:.3} m/s {:.3} rad/s",
            legs.vx_mps, legs.vy_mps, legs.yaw_rate_radps,
        ));
    }
    if let Some(folder) = &args.log_dir {
        lines.push(format!("log: {} ({} rows)", folder.display(), summary.log_rows));
    }
    lines.join("\n")
}

/// Memory of this process that is in use now, bytes; 0 where the system does not tell.
fn resident_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok());
    1024 * kib.unwrap_or(0)
}

fn step_max_rad(setting: &Setting) -> f32 {
    let joints = setting.model.actuated().len();
    let fastest = (0..joints).map(|i| setting.model.servo(i).qd_max_radps).fold(0.0, f64::max);
    (RATE_LIMIT_FACTOR * fastest * setting.control_period_s) as f32
}
