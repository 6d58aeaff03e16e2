//! `caudata sim rollout`: open loop. Joint commands in, simulated signals out, both in the log format.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_model::{BaseKind, RobotModel};
use caudata_runlog::{Axis, BaseHold, LogMeta, QuatPart, Setting, Signal, Table, TableWriter};
use caudata_sim::{Engine, EngineKind, InitialState, LaneParams, State, TerrainKind};
use caudata_studies::failures::stopped;
use caudata_studies::files;
use caudata_studies::flags::EngineName;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::{Args, ValueEnum};
use serde_json::json;

use crate::commands::ground::{self, pair, terrain_parser};
use crate::commands::lane_params;
use crate::commands::robot;
use crate::say;

/// A foot counts as on the ground above this much force, N.
const CONTACT_FORCE_N: f32 = 0.1;

/// Largest command that is taken for one, rad: ten turns. More is another unit, or nonsense.
const LARGEST_RAD: f64 = 62.8;

/// Periods and times that differ by this share are the same.
const ROUNDING: f64 = 1e-6;

/// What is simulated stands beside logs of robots, in which no step is to be seen.
const CENTRED: &str = "engine.centred=true";

/// Share of the commands of a log that may be lost to the next one in the same control period.
const LOST: f64 = 0.01;
/// How much longer than a control period the intervals of a log are on average, at most: it misses rows.
const MISSED: f64 = 0.25;

#[derive(Debug, Args)]
pub struct RolloutArgs {
    /// Columns `t` (s), `cmd.<joint>` (rad), `on.<joint>` (0: lets go); a joint without a column holds its nominal
    /// position
    #[arg(long, value_name = "C.csv")]
    commands: PathBuf,
    /// Where the signals go; the circumstances of the run go beside it, as T.toml
    #[arg(long, value_name = "T.csv")]
    out: PathBuf,
    /// On which engine; default: the configuration's
    #[arg(long, value_enum)]
    engine: Option<EngineName>,
    /// Whether the base is held in the air
    #[arg(long, value_enum, default_value_t = Base::Free)]
    base: Base,
    /// Shape of the ground; default: `terrain.kind` of the configuration
    #[arg(long, value_parser = terrain_parser())]
    terrain: Option<TerrainKind>,
    /// Seed of the ground
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Where on the ground the robot starts, m
    #[arg(long, value_name = "X,Y", value_parser = pair, default_value = "0,0", allow_hyphen_values = true)]
    place: [f32; 2],
    /// How long to simulate, s; default: until the last command, which holds if this is longer
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration_s: Option<f64>,
    /// Rows, and control periods, per second; default: `engine.substeps` and `engine.dt_s` decide (50), or, where
    /// these are not set, commands that come faster
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    rate_hz: Option<f64>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// Step sizes and solver come from `[engine]`, `centred` is true unless it is set; `--set lane.KEY=VALUE`
    /// changes the robot's physical parameters, for instance lane.foot_friction=0.5, lane.kp_nm_per_rad=12,
    /// lane.kp_nm_per_rad.FL_hip=9
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Base {
    /// On the ground
    Free,
    /// On a stand
    Fixed,
}

pub fn run(args: &RolloutArgs, stop: &StopFlag) -> Result<(), Failure> {
    let (mut flags, changes) = lane_params::split(&args.config);
    if !flags.sets("engine", "centred").or_exit(ExitCode::BadConfig)? {
        flags.overrides.push(CENTRED.to_owned());
    }
    let mut config = flags.load().or_exit(ExitCode::BadConfig)?;
    if let Some(engine) = args.engine {
        config.engine.kind = engine.into();
    }
    config.engine.fixed_base = args.base == Base::Fixed;
    if let Some(kind) = args.terrain {
        config.terrain.kind = kind;
    }
    config.run.seed = args.seed;
    let model = Arc::new(robot::load(&config.robot_path())?);
    let params = lane_params::changed(&model, &changes)?;
    let code = match args.commands.try_exists() {
        Ok(true) => ExitCode::BadInput,
        _ => ExitCode::NoInput,
    };
    let table = Table::read(&args.commands)
        .or_exit_with(code, || format!("commands {}", args.commands.display()))?;
    check_out(&args.out, &args.commands)?;
    let mut commands = Commands::new(&table, &model)?;
    let set = |key| flags.sets("engine", key).or_exit(ExitCode::BadConfig);
    let own_rate = || commands.rate_hz(config.engine.control_period_s(), config.engine.dt_s);
    let rate_hz = match args.rate_hz {
        None if !set("substeps")? && !set("dt_s")? => own_rate(),
        given => given,
    };
    if let Some(rate_hz) = rate_hz {
        (config.engine.substeps, config.engine.dt_s) = steps(config.engine.dt_s, rate_hz)?;
    }
    let row_s = config.engine.control_period_s();
    commands.early_s = commands.fit(row_s)?;
    let rows = periods(args, &commands, row_s)?;
    // What is told is of an instant, as a servo reads its current, and not the mean over a row. Frames are lost by
    // control period.
    let steps = match params.command_loss.share > 0.0 {
        true => 1,
        false => std::mem::replace(&mut config.engine.substeps, 1),
    };
    let (seed, robot) = (config.run.seed, Arc::clone(&model));
    let mut engine = caudata_sim::build(robot, 1, &config.engine, &config.terrain, seed, 1)
        .or_exit(ExitCode::BadConfig)?;
    engine.set_params(0, &params).or_exit(ExitCode::BadConfig)?;
    let start = InitialState { base_xy_m: args.place, ..InitialState::nominal(&model) };
    engine.reset(0, &start).or_exit(ExitCode::BadConfig)?;
    let rows = simulate(engine.as_mut(), &commands, (rows, steps), &args.out, stop)?;
    let meta_path = args.out.with_extension("toml");
    let meta = circumstances(args, &config, &params, engine.as_ref(), row_s)
        .to_toml()
        .or_exit(ExitCode::Internal)?;
    files::write(&meta_path, meta)?;
    let diverged = engine.state().diverged[0];
    let made = json!({ "rows": rows, "out": args.out, "meta": meta_path, "diverged": diverged });
    say::either(args.json, &made, |_| {
        say::line(format!("{rows} rows are in {}", args.out.display()));
    })?;
    if diverged {
        let message = "the simulation broke down; the last rows stand still";
        return Err(Failure::message(ExitCode::Internal, message));
    }
    Ok(())
}

/// Neither the commands nor the circumstances, which are written beside it, may be what `--out` overwrites.
fn check_out(out: &Path, commands: &Path) -> Result<(), Failure> {
    let beside = out.with_extension("toml");
    let same = |a: &Path, b: &Path| match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        _ => a == b,
    };
    let why = if out == beside {
        "is where the circumstances of the run go; give a .csv"
    } else if out.extension().is_none_or(|x| x != "csv") {
        "does not end with .csv; `caudata log convert` makes other forms of it"
    } else if same(out, commands) || same(&beside, commands) {
        "would overwrite the commands; give another name"
    } else {
        return Ok(());
    };
    Err(Failure::message(ExitCode::BadConfig, format!("--out {} {why}", out.display())))
}

/// Physics steps per row, and their length, s: the longest that is no longer than `dt_s` and divides a row.
fn steps(dt_s: f64, rate_hz: f64) -> Result<(u32, f64), Failure> {
    let exact = 1.0 / (rate_hz * dt_s);
    if !(1.0 - ROUNDING..=f64::from(u32::MAX)).contains(&exact) {
        let message = format!(
            "--rate-hz {rate_hz} is not within 0 and a row per step of engine.dt_s = {dt_s} s"
        );
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    let whole = exact.round();
    if (exact - whole).abs() < ROUNDING * whole {
        return Ok((whole as u32, dt_s));
    }
    let steps = exact.ceil();
    Ok((steps as u32, 1.0 / (rate_hz * steps)))
}

/// Control periods to simulate.
fn periods(args: &RolloutArgs, commands: &Commands, period_s: f64) -> Result<u64, Failure> {
    const LONGEST_S: f64 = 24.0 * 3600.0;
    let times = &commands.time_s;
    let duration_s = args.duration_s.unwrap_or(times[times.len() - 1] - times[0]);
    if !(0.0..=LONGEST_S).contains(&duration_s) {
        let message = format!("a duration of {duration_s} s is not within 0 s to a day");
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    Ok((duration_s / period_s).round() as u64)
}

/// What `log.toml` says about the run.
fn circumstances(
    args: &RolloutArgs,
    config: &Config,
    params: &LaneParams,
    engine: &dyn Engine,
    row_s: f64,
) -> LogMeta {
    let ground = caudata_sim::Terrain::generate(&config.terrain, args.seed);
    let wet = ground.is_ok_and(|t| t.water_level_m.is_some());
    let base = match args.base {
        Base::Fixed => BaseHold::Fixed,
        Base::Free if engine.model().base() == BaseKind::Fixed => BaseHold::Fixed,
        Base::Free if wet => BaseHold::Water,
        Base::Free => BaseHold::Free,
    };
    let rate_hz = 1.0 / row_s;
    let mut meta = LogMeta::new(config.robot_path().display().to_string(), base, rate_hz);
    ground::note(&mut meta, &config.terrain, args.seed);
    meta.notes = "caudata sim rollout".to_owned();
    let path = |path: &Path| Setting::Text(path.display().to_string());
    let same = |values: &[f32]| {
        let first = *values.first()?;
        values.iter().all(|v| *v == first).then(|| f64::from(first))
    };
    meta.kp = same(&params.kp_nm_per_rad);
    meta.kd = same(&params.kd_nms_per_rad);
    meta.supply_v = Some(f64::from(params.supply_v));
    let mut put = |key: &str, value| meta.settings.insert(key.to_owned(), value);
    put("commands", path(&args.commands));
    put("place_x_m", Setting::Number(f64::from(args.place[0])));
    put("place_y_m", Setting::Number(f64::from(args.place[1])));
    put("dt_s", Setting::Number(config.engine.dt_s));
    if config.engine.kind == EngineKind::Batch {
        put("centred", Setting::Switch(config.engine.centred));
    }
    put("engine", Setting::Text(config.engine.kind.name().to_owned()));
    if let Some(preset) = &args.config.preset {
        put("preset", Setting::Text(preset.clone()));
    }
    if let Some(file) = &args.config.config {
        put("config", path(file));
    }
    if !args.config.overrides.is_empty() {
        put("set", Setting::Text(args.config.overrides.join(" ")));
    }
    meta
}

/// Joint commands over time; each holds until the next row.
#[derive(Debug)]
struct Commands {
    time_s: Vec<f64>,
    /// One row of all actuated joints per time.
    rows: Vec<Vec<f32>>,
    /// Likewise whether each has torque; empty where nothing says so.
    on: Vec<Vec<bool>>,
    /// A command counts as reached this long before its time, s. Grid times are sums of periods, so never 0.
    early_s: f64,
}

impl Commands {
    /// Empty cells keep the command before; joints without a column stay where they are nominally.
    fn new(table: &Table, model: &RobotModel) -> Result<Self, Failure> {
        let joints = model.actuated_names();
        let bad = |message: String| Err(Failure::message(ExitCode::BadInput, message));
        for signal in table.signals() {
            if let Signal::Command(joint) | Signal::Enabled(joint) = signal
                && !joints.contains(&joint.as_str())
            {
                return bad(format!("the robot has no actuated joint `{joint}`"));
            }
        }
        if table.is_empty() {
            return bad("the command file has no rows".into());
        }
        if let Some(note) = table.notes().first() {
            return bad(format!("{note}; end the file with a line break"));
        }
        let commanded = |signal: &Signal| matches!(signal, Signal::Command(_));
        if !table.signals().iter().any(commanded) {
            return bad("the command file has no column cmd.<joint>".into());
        }
        let mut row: Vec<f32> = model.nominal_pos_rad().iter().map(|&q| q as f32).collect();
        let columns: Vec<_> = joints
            .iter()
            .map(|joint| table.column(&Signal::Command((*joint).to_owned())))
            .collect();
        let mut rows = Vec::with_capacity(table.len());
        for at in 0..table.len() {
            for (value, column) in row.iter_mut().zip(&columns) {
                if let Some(command) = column.and_then(|column| column[at]) {
                    if command.abs() > LARGEST_RAD {
                        let t_s = table.time_s()[at];
                        return bad(format!(
                            "a command of {command} rad at t = {t_s} s: no joint turns by more than {LARGEST_RAD} rad"
                        ));
                    }
                    *value = command as f32;
                }
            }
            rows.push(row.clone());
        }
        Ok(Self { time_s: table.time_s().to_vec(), rows, on: on(table, &joints), early_s: 1e-9 })
    }

    /// Refuses commands that come faster than the engine takes them: all but the last of a control period would
    /// be lost. Those of a log, which come once in a period and jitter, go to the period that is nearest. Answers
    /// with [`Self::early_s`].
    fn fit(&self, period_s: f64) -> Result<f64, Failure> {
        let close = |pair: &[f64]| pair[1] - pair[0] < period_s * (1.0 - ROUNDING);
        if !self.time_s.windows(2).any(close) {
            return Ok(self.early_s);
        }
        let first = self.time_s[0];
        let nearest: Vec<f64> =
            (self.time_s.iter()).map(|t| ((t - first) / period_s).round()).collect();
        let lost = nearest.windows(2).filter(|pair| pair[0] == pair[1]).count();
        let intervals = nearest.len() as f64 - 1.0;
        let [mean_s, least_s] = self.intervals_s();
        let is_log = (1.0 - LOST..1.0 + MISSED).contains(&(mean_s / period_s));
        if !is_log || lost as f64 > LOST * intervals {
            let message = format!(
                "{lost} command(s) share a control period of {period_s} s with the next; give --rate-hz {:.0} or more",
                1.0 / if is_log { mean_s } else { least_s }
            );
            return Err(Failure::message(ExitCode::BadInput, message));
        }
        Ok(period_s / 2.0)
    }

    /// The rate that they come at, Hz, where that is faster than every `period_s`, and no faster than every
    /// `dt_s`.
    fn rate_hz(&self, period_s: f64, dt_s: f64) -> Option<f64> {
        if self.fit(period_s).is_ok() {
            return None;
        }
        let fits = |s: &f64| *s > dt_s * (1.0 - ROUNDING) && self.fit(*s).is_ok();
        let exact = 1.0 / self.intervals_s().into_iter().find(fits)?;
        let whole = exact.round();
        Some(if (exact - whole).abs() < ROUNDING * whole { whole } else { exact })
    }

    /// Mean and least time from one to the next, s.
    fn intervals_s(&self) -> [f64; 2] {
        let times = &self.time_s;
        let count = times.len().saturating_sub(1).max(1) as f64;
        let steps = times.windows(2).map(|pair| pair[1] - pair[0]);
        let mean_s = (times[times.len() - 1] - times[0]) / count;
        [mean_s, steps.fold(f64::INFINITY, f64::min)]
    }

    /// The row in force from `t_s` on.
    fn row(&self, t_s: f64) -> usize {
        let reached = self.time_s.partition_point(|&t| t <= t_s + self.early_s);
        reached.saturating_sub(1)
    }

    /// What is commanded from `t_s` on.
    fn at(&self, t_s: f64) -> &[f32] {
        &self.rows[self.row(t_s)]
    }

    /// Which joints have torque from `t_s` on.
    fn on_at(&self, t_s: f64) -> &[bool] {
        self.on.get(self.row(t_s)).map_or(&[], Vec::as_slice)
    }
}

/// Which of `joints` have torque, by `on.<joint>`; an empty cell holds. Empty where there is no such column.
fn on(table: &Table, joints: &[&str]) -> Vec<Vec<bool>> {
    let column = |joint: &&str| table.column(&Signal::Enabled((*joint).to_owned()));
    let columns: Vec<_> = joints.iter().map(column).collect();
    if columns.iter().all(Option::is_none) {
        return Vec::new();
    }
    let mut row = vec![true; joints.len()];
    let rows = (0..table.len()).map(|at| {
        for (on, column) in row.iter_mut().zip(&columns) {
            *on = column.and_then(|c| c[at]).map_or(*on, |said| said != 0.0);
        }
        row.clone()
    });
    rows.collect()
}

/// `nominal` without what drives the joints that are not `on`: they turn freely.
fn with_torque(nominal: &LaneParams, on: &[bool]) -> LaneParams {
    let mut params = nominal.clone();
    for (joint, _) in on.iter().enumerate().filter(|(_, on)| !**on) {
        params.torque_scale[joint] = 0.0;
        params.kp_nm_per_rad[joint] = 0.0;
        params.kd_nms_per_rad[joint] = 0.0;
    }
    params
}

/// Steps through the commands and writes one row per control period: the command from that time on, and the
/// state at that time.
fn simulate(
    engine: &mut dyn Engine,
    commands: &Commands,
    (periods, steps): (u64, u32),
    out: &Path,
    stop: &StopFlag,
) -> Result<u64, Failure> {
    let cannot_write = || format!("cannot write {}", out.display());
    if let Some(folder) = out.parent() {
        files::make_folder(folder)?;
    }
    let file = File::create(out).or_exit_with(ExitCode::CannotCreate, cannot_write)?;
    let lets_go = !commands.on.is_empty();
    let signals = signals(engine.model(), lets_go);
    let mut table = TableWriter::new(BufWriter::new(file), &signals, 0.5)
        .or_exit_with(ExitCode::IoError, cannot_write)?;
    let period_s = engine.config().control_period_s() * f64::from(steps);
    let first = commands.time_s[0];
    let mut values = Vec::with_capacity(signals.len());
    let nominal = engine.params(0).clone();
    let mut on: &[bool] = &[];
    for period in 0..=periods {
        if stop.is_set() {
            return Err(stopped(stop));
        }
        let t_s = first + period as f64 * period_s;
        let command = commands.at(t_s);
        values.clear();
        values.extend(command.iter().map(|&x| Some(f64::from(x))));
        push_state(&mut values, engine.model(), engine.state());
        if commands.on_at(t_s) != on {
            on = commands.on_at(t_s);
            engine.set_params(0, &with_torque(&nominal, on)).or_exit(ExitCode::Internal)?;
        }
        values.extend(on.iter().map(|&on| Some(f64::from(u8::from(on)))));
        table.row(t_s, &values).or_exit_with(ExitCode::IoError, cannot_write)?;
        if period == periods {
            break;
        }
        for _ in 0..steps {
            engine.step(command, &[0.0; 6]).or_exit(ExitCode::Internal)?;
        }
    }
    let rows = table.rows();
    table.finish().or_exit_with(ExitCode::IoError, cannot_write)?;
    Ok(rows)
}

/// The columns, in the order of [`push_state`], and whether each joint has torque where one of them `lets_go`.
fn signals(model: &RobotModel, lets_go: bool) -> Vec<Signal> {
    let joints = model.actuated_names();
    let feet = || model.feet().iter().map(|foot| foot.name.clone());
    let of_joints: [fn(String) -> Signal; 4] =
        [Signal::Command, Signal::Position, Signal::Velocity, Signal::Torque];
    let mut signals = Signal::each(&of_joints, &joints);
    let of_axes: [fn(Axis) -> Signal; 4] =
        [Signal::Gyro, Signal::Acceleration, Signal::Gravity, Signal::BasePosition];
    signals.extend(Signal::axes(&of_axes));
    signals.extend(QuatPart::ALL.map(Signal::BaseQuaternion));
    signals.extend(Axis::ALL.map(Signal::BaseVelocity));
    signals.extend(feet().flat_map(|leg| Axis::ALL.map(|axis| Signal::Foot(leg.clone(), axis))));
    signals.extend(feet().map(Signal::Contact));
    if lets_go {
        signals.extend(joints.iter().map(|joint| Signal::Enabled((*joint).to_owned())));
    }
    signals
}

/// The state of the only lane, without the commands that stand before it.
fn push_state(values: &mut Vec<Option<f64>>, model: &RobotModel, state: &State) {
    let mut push = |slice: &[f32]| values.extend(slice.iter().map(|&x| Some(f64::from(x))));
    let servos = || model.actuated().iter().enumerate();
    let pos_rad: Vec<f32> = servos().map(|(a, &j)| state.encoder_pos_rad(0, j, a)).collect();
    let vel_radps: Vec<f32> = servos().map(|(a, &j)| state.encoder_vel_radps(0, j, a)).collect();
    push(&pos_rad);
    push(&vel_radps);
    push(&state.motor_torque_nm);
    push(&state.imu_gyro_radps);
    push(&state.imu_acc_mps2);
    push(&state.imu_gravity);
    push(&state.base_pos_m);
    push(&state.base_quat_wxyz);
    push(&state.base_vel_mps);
    push(&state.foot_pos_m);
    let forces = state.foot_force_n.chunks_exact(3);
    let contact: Vec<f32> = forces
        .map(|f| {
            let force_n = f.iter().map(|x| x * x).sum::<f32>().sqrt();
            f32::from(u8::from(force_n > CONTACT_FORCE_N))
        })
        .collect();
    push(&contact);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> RobotModel {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/polymander.robot.toml");
        RobotModel::load(&path).unwrap()
    }

    fn commands(csv: &str) -> Result<Commands, Failure> {
        Commands::new(&Table::parse("c.csv", csv.as_bytes()).unwrap(), &model())
    }

    #[test]
    fn commands_hold_and_missing_joints_are_nominal() {
        let commands = commands("t,cmd.FL_hip\n0.0,0.1\n0.1,\n0.2,0.3\n").unwrap();
        // Policy order: 8 spine and tail joints, then FL_hip (8), FL_knee (9, nominally 36°).
        let hip = |t| commands.at(t)[8];
        assert_eq!((hip(0.0), hip(0.15), hip(0.2), hip(9.0)), (0.1, 0.1, 0.3, 0.3));
        assert!((commands.at(0.0)[9] - 36f32.to_radians()).abs() < 1e-6);
    }

    #[test]
    fn a_joint_that_is_off_has_no_torque_until_it_is_on() {
        let commands =
            commands("t,cmd.FL_hip,on.FL_hip\n0,0,\n0.1,0,0\n0.2,0,\n0.3,0,1\n").unwrap();
        let on = |t_s: f64| commands.on_at(t_s)[8];
        assert_eq!([0.0, 0.1, 0.25, 0.3].map(on), [true, false, false, true]);
        assert!(commands.on_at(0.1)[9]);
        let nominal = LaneParams::nominal(&model());
        let off = with_torque(&nominal, commands.on_at(0.1));
        assert_eq!((off.torque_scale[8], off.kp_nm_per_rad[8]), (0.0, 0.0));
        assert_eq!(off.kp_nm_per_rad[9], nominal.kp_nm_per_rad[9]);
        assert_eq!(with_torque(&nominal, commands.on_at(0.3)), nominal);
    }

    #[test]
    fn commands_faster_than_the_control_period_are_refused() {
        let rows = |csv: &str| commands(&format!("t,cmd.FL_hip\n{csv}")).unwrap();
        let commands = rows("0,0\n0.01,0.5\n0.02,0\n");
        commands.fit(0.01).unwrap();
        let failure = commands.fit(0.02).unwrap_err();
        assert!(failure.to_string().contains("--rate-hz 100"), "{failure}");
        // their own rate is the default, if the engine can
        assert_eq!(commands.rate_hz(0.02, 0.002), Some(100.0));
        assert_eq!(commands.rate_hz(0.01, 0.002), None);
        assert_eq!(commands.rate_hz(0.02, 0.012), None);
        let once_in_a_while = rows("0,0\n0.01,0.5\n0.02,0\n1,0.5\n");
        assert_eq!(once_in_a_while.rate_hz(0.02, 0.002), Some(100.0));
    }

    #[test]
    fn stamps_that_jitter_go_to_the_nearest_period() {
        let csv = "t,cmd.FL_hip\n5.000,0.0\n5.012,0.1\n5.019,0.2\n5.033,0.3\n5.040,0.4\n";
        let mut commands = commands(csv).unwrap();
        commands.early_s = commands.fit(0.01).unwrap();
        let hip: Vec<f32> = (0..5).map(|k| commands.at(5.0 + 0.01 * f64::from(k))[8]).collect();
        assert_eq!(hip, [0.0, 0.1, 0.2, 0.3, 0.4]);
    }

    #[derive(clap::Parser)]
    struct Command {
        #[command(flatten)]
        rollout: RolloutArgs,
    }

    /// Columns `pos`, `vel` and `tau` of the weight that one servo swings, after commands in a file.
    fn swung(csv: &str, flags: &str) -> [Vec<f64>; 3] {
        let dir = tempfile::tempdir().unwrap();
        let path = |name: &str| dir.path().join(name).display().to_string();
        std::fs::write(path("c.csv"), csv).unwrap();
        let robot = concat!(env!("CARGO_MANIFEST_DIR"), "/robots/xl330_pendulum.robot.toml");
        let (commands, out) = (path("c.csv"), path("t.csv"));
        let paths = ["rollout", "--robot", robot, "--commands", &commands, "--out", &out];
        let line = paths.into_iter().chain(flags.split_whitespace());
        let args = <Command as clap::Parser>::parse_from(line).rollout;
        run(&args, &StopFlag::default()).unwrap();
        let table = Table::read(Path::new(&out)).unwrap();
        [Signal::Position, Signal::Velocity, Signal::Torque].map(|signal| {
            let column = table.column(&signal("swing".to_owned())).unwrap();
            column.iter().map(|x| x.unwrap()).collect()
        })
    }

    /// Hangs still, is sent to `rad` from `jump_s` on, and is looked at until 1 s.
    fn jump(jump_s: f64, rad: f64, flags: &str) -> [Vec<f64>; 3] {
        swung(&format!("t,cmd.swing\n0,0\n{jump_s:.2},{rad}\n1,{rad}\n"), flags)
    }

    /// The duty of a position loop is a spring (0.886 N·m/rad) behind the back-EMF (0.0482 N·m·s/rad), as the robot's
    /// file says. A row tells where the weight is and what pulls at it at that instant, so that both go together; the
    /// mean of the ten steps of a row is of 10 ms before.
    #[test]
    fn a_torque_is_of_the_instant_of_its_row() {
        let [pos, vel, tau] = jump(0.1, 0.5, "");
        let [_, _, each_step] = jump(0.1, 0.5, "--rate-hz 500");
        let (mut law, mut mean): (f64, f64) = (0.0, 0.0);
        for row in 6..=50 {
            assert_eq!(tau[row], each_step[10 * row], "row {row}");
            let told = 0.886 * (0.5 - pos[row]) - 0.0482 * vel[row];
            law = law.max((told - tau[row]).abs());
            let steps = &each_step[10 * row - 9..=10 * row];
            mean = mean.max((steps.iter().sum::<f64>() / 10.0 - told).abs());
        }
        assert!(law < 0.01 && mean > 0.03, "{law} and {mean} N·m off");
    }

    #[test]
    fn steps_are_of_the_second_order_unless_a_file_or_a_flag_says_otherwise() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("e.toml");
        std::fs::write(&file, "[engine]\ncentred = false\n").unwrap();
        let swing = |flags: &str| jump(0.1, 0.5, flags);
        let as_trained = swing(&format!("--config {}", file.display()));
        assert_eq!(as_trained, swing("--set engine.centred=false"));
        assert_ne!(as_trained, swing(""));
        assert_eq!(swing(""), swing("--set engine.centred=true"));
    }

    /// A frame that is lost is lost for its control period: what is asked for later comes whole periods late.
    #[test]
    fn frames_are_lost_by_control_period() {
        let lossy = "--set lane.command_loss.share=0.6 --set lane.command_loss.burst=2";
        let late: Vec<usize> = (5..15)
            .map(|row| {
                let [pos, ..] = jump(0.02 * f64::from(row), 0.5, lossy);
                let as_if = |late: u32| jump(0.02 * f64::from(row + late), 0.5, "")[0].clone();
                let found = (0..10).position(|late| as_if(late) == pos);
                found.unwrap_or_else(|| panic!("row {row}: {pos:?}"))
            })
            .collect();
        assert!(late.contains(&0) && late.iter().any(|&rows| rows > 1), "{late:?}");
    }

    #[test]
    fn any_rate_divides_into_steps_that_are_no_longer() {
        assert_eq!(steps(0.002, 50.0).unwrap(), (10, 0.002));
        let (count, dt_s) = steps(0.002, 200.0).unwrap();
        assert_eq!(count, 3);
        assert!((dt_s - 0.005 / 3.0).abs() < 1e-12);
        for rate_hz in [0.0, -50.0, 501.0, f64::NAN, f64::INFINITY] {
            assert!(steps(0.002, rate_hz).is_err(), "{rate_hz}");
        }
    }

    #[test]
    fn nothing_that_is_read_is_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        let commands = dir.path().join("c.csv");
        std::fs::write(&commands, "t\n").unwrap();
        assert!(check_out(&commands, &commands).is_err());
        assert!(check_out(&dir.path().join("log.toml"), &commands).is_err());
        check_out(&dir.path().join("log.csv"), &commands).unwrap();
    }

    #[test]
    fn an_unknown_joint_and_an_empty_file_are_refused() {
        let failure = commands("t,cmd.wing\n0.0,0.1\n").unwrap_err();
        assert!(failure.to_string().contains("wing"), "{failure}");
        for (csv, why) in [
            ("t,pos.FL_hip\n0.0,0.1\n", "no column cmd"),
            ("t,cmd.FL_hip\n0.0,0.1\n1.0,0.5", "line break"),
            ("t,cmd.FL_hip\n0.0,1e39\n", "1000000000000000000000000000000000000000 rad"),
            ("t,cmd.FL_hip\n0.0,500\n", "500 rad at t = 0 s"),
        ] {
            let failure = commands(csv).unwrap_err();
            assert!(failure.to_string().contains(why), "{failure}");
            assert_eq!(failure.code(), ExitCode::BadInput);
        }
        assert_eq!(commands("t,cmd.FL_hip\n").unwrap_err().code(), ExitCode::BadInput);
    }
}
