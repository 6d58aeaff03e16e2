//! `caudata sim show`: a picture or a short animation of a model, a scene or a log.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_env::StartShift;
use caudata_model::{Pose, RobotModel};
use caudata_render::{Image, Moment, Quality, View, encode, portrait};
use caudata_runlog::{Axis, QuatPart, RunLog, Setting, Signal, Table, meta_file, rows_file};
use caudata_sim::{InitialState, Terrain, TerrainConfig, TerrainKind};
use caudata_studies::failures::stopped;
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::{Args, ValueEnum};
use serde_json::json;

use crate::commands::ground::{degrees, pair, terrain_parser, triple};
use crate::commands::sim_walk::Walk;
use crate::commands::{eval, robot};
use crate::say;

/// Pictures of one turn around a model or scene.
const TURN_FRAMES: u32 = 48;
/// Most pictures of an animation.
const FRAMES_MAX: usize = 1500;

/// Where a robot stands half in the water of the default shore, m.
const WATERLINE_M: [f32; 2] = [1.6, 0.0];

#[derive(Debug, Args)]
pub struct ShowArgs {
    /// Where the picture goes: `.png`, or `.gif` for an animation (of a log: all of it; of a policy: its walk;
    /// otherwise one turn around)
    #[arg(long, value_name = "FRAME.png|CLIP.gif")]
    out: PathBuf,
    /// Joint angles of a model or scene
    #[arg(long, value_enum, default_value_t = PoseName::Nominal)]
    pose: PoseName,
    /// Shape of the ground; default: the log's, or `[terrain]`
    #[arg(long, value_parser = terrain_parser())]
    terrain: Option<TerrainKind>,
    /// Seed of the ground; default: the log's, or 1
    #[arg(long)]
    seed: Option<u64>,
    /// Where a scene's robot starts, m; default: the origin, on a shore the waterline (1.6, 0)
    #[arg(long, value_name = "X,Y", value_parser = pair, allow_hyphen_values = true)]
    place: Option<[f32; 2]>,
    /// Which way a policy's robot faces at first, degrees from the x axis to the left
    #[arg(long, value_name = "DEG", value_parser = degrees, default_value = "0", allow_negative_numbers = true, requires = "policy")]
    heading_deg: f32,
    /// How long a scene's robot settles before the picture, s
    #[arg(long, default_value_t = 1.0)]
    settle_s: f64,
    /// A log to show: a folder with its log.csv and log.toml, or NAME.csv with NAME.toml beside it
    #[arg(long, value_name = "LOG")]
    log: Option<PathBuf>,
    /// A policy whose walk is drawn
    #[arg(long, value_name = "P.onnx", conflicts_with = "log")]
    policy: Option<PathBuf>,
    /// What the policy is told: vx, vy (m/s), yaw rate (rad/s)
    #[arg(long, value_name = "X,Y,YAW", value_parser = triple, default_value = "0.3,0,0", allow_hyphen_values = true, requires = "policy")]
    command: [f32; 3],
    /// How long its walk is drawn after it has settled, s
    #[arg(long, default_value_t = 4.0, requires = "policy")]
    seconds: f64,
    /// Moment of the log that a `.png` shows, s; default: its middle
    #[arg(long, value_name = "T", requires = "log")]
    at: Option<f64>,
    /// From where
    #[arg(long, value_enum, default_value_t = View::Iso)]
    view: View,
    /// Distance of the camera, m; default: so that the whole robot is in the picture
    #[arg(long)]
    distance: Option<f64>,
    /// Width, pixels; default 1280, 480 for an animation
    #[arg(long)]
    width: Option<u32>,
    /// Height, pixels; default 9/16 of the width
    #[arg(long)]
    height: Option<u32>,
    /// Pictures per second of an animation, 1 to 50
    #[arg(long, default_value_t = 20.0)]
    fps: f64,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// Robot, engine and ground
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum PoseName {
    /// Standing
    Nominal,
    /// Legs folded back
    Swimming,
}

pub fn run(args: &ShowArgs, stop: &StopFlag) -> Result<(), Failure> {
    let animated = match args.out.extension().and_then(|e| e.to_str()) {
        Some("png") => false,
        Some("gif") => true,
        _ => {
            let name = args.out.display();
            let message = format!("--out {name} must end with .png or .gif");
            return Err(Failure::message(ExitCode::BadConfig, message));
        }
    };
    if !(1.0..=50.0).contains(&args.fps) {
        return Err(Failure::message(ExitCode::BadConfig, "--fps must be 1 to 50"));
    }
    let policy = args.policy.as_deref().map(files::policy).transpose()?;
    let log = args.log.as_deref().map(read_log).transpose()?;
    let (mut config, model) = match (&args.policy, &policy, &log) {
        (Some(path), Some(policy), _) => eval::task_of(path, policy, &args.config)?,
        (_, _, Some(log)) => robot::configured(&of_log(args, log)?)?,
        _ => robot::configured(&args.config)?,
    };
    let seed = choose_terrain(args, log.as_ref(), &mut config)?;
    let terrain = Arc::new(Terrain::generate(&config.terrain, seed).or_exit(ExitCode::BadConfig)?);
    let moments = match (&log, &policy) {
        (Some(log), _) => moments_of_log(args, log, &model, &terrain, animated)?,
        (None, Some(policy)) => {
            let walk = Walk {
                start: StartShift {
                    xy_m: args.place.unwrap_or_default(),
                    yaw_rad: args.heading_deg.to_radians(),
                },
                command: args.command,
                settle_s: args.settle_s.clamp(0.0, 60.0),
                pictures: if animated { frame_count(args.seconds, args.fps)? } else { 1 },
                fps: args.fps,
            };
            walk.moments(&config, &model, policy)?
        }
        (None, None) => vec![settled(args, &config, &model, seed)?],
    };
    let frames = draw(args, &config, &model, &terrain, &moments, animated, stop)?;
    let bytes = if animated {
        encode::gif(&frames, 1.0 / args.fps).or_exit(ExitCode::Internal)?
    } else {
        encode::png(&frames[0]).or_exit(ExitCode::Internal)?
    };
    files::write(&args.out, &bytes)?;
    let (width, height, count) = (frames[0].width(), frames[0].height(), frames.len());
    let made = json!({
        "out": args.out, "frames": count, "width": width, "height": height, "bytes": bytes.len(),
    });
    say::either(args.json, &made, |_| {
        let out = args.out.display();
        let frames = match count {
            1 => String::new(),
            _ => format!(", {count} frames"),
        };
        say::line(format!("{out} ({width} × {height}{frames})"));
    })
}

fn read_log(log: &Path) -> Result<RunLog, Failure> {
    let code = match rows_file(log).exists() && meta_file(log).exists() {
        true => ExitCode::BadInput,
        false => ExitCode::NoInput,
    };
    RunLog::read(log).or_exit_with(code, || format!("log {}", log.display()))
}

/// The flags, with the robot of the log where they have none.
fn of_log(args: &ShowArgs, log: &RunLog) -> Result<ConfigArgs, Failure> {
    let (flags, named) = (&args.config, log.meta.robot.as_str());
    let found = files::robot_of_log(args.log.as_deref().unwrap_or(Path::new("")), named);
    if flags.robot.is_some() || named.is_empty() || found.is_none() && flags.config.is_some() {
        return Ok(flags.clone());
    }
    let robot = found.ok_or_else(|| {
        let message = format!("the log is of robot `{named}`, whose file is not found");
        Failure::message(ExitCode::NoInput, message).hint("give it with --robot")
    })?;
    Ok(ConfigArgs { robot: Some(robot), ..flags.clone() })
}

/// Puts the flags' or the log's terrain into `config`; returns the seed.
fn choose_terrain(
    args: &ShowArgs,
    log: Option<&RunLog>,
    config: &mut Config,
) -> Result<u64, Failure> {
    let mut seed = 1;
    if let Some(log) = log {
        if let Some(kind) = TerrainKind::of_name(&log.meta.terrain) {
            config.terrain = logged_terrain(log, kind)?;
        }
        match log.meta.settings.get("seed") {
            Some(Setting::Text(logged)) => seed = logged.parse().unwrap_or(seed),
            Some(Setting::Number(logged)) => seed = *logged as u64,
            _ => {}
        }
    }
    if let Some(kind) = args.terrain {
        config.terrain.kind = kind;
    }
    Ok(args.seed.unwrap_or(seed))
}

/// The terrain that `caudata sim rollout` or `caudata eval` wrote into a log: its kind, and each key that is not the default as
/// `terrain_<key>`.
fn logged_terrain(log: &RunLog, kind: TerrainKind) -> Result<TerrainConfig, Failure> {
    let mut table = serde_json::Map::new();
    table.insert("kind".into(), kind.name().into());
    for (key, value) in &log.meta.settings {
        if let (Some(key), Setting::Number(value)) = (key.strip_prefix("terrain_"), value) {
            table.insert(key.to_owned(), json!(value));
        }
    }
    serde_json::from_value(table.into())
        .or_exit_with(ExitCode::BadInput, || format!("the terrain settings of {}", log.meta_name))
}

/// The robot after it has settled in the scene.
fn settled(
    args: &ShowArgs,
    config: &Config,
    model: &Arc<RobotModel>,
    seed: u64,
) -> Result<Moment, Failure> {
    let pose = match args.pose {
        PoseName::Nominal => Some(model.nominal_pos_rad()),
        PoseName::Swimming => model.swimming_pos_rad(),
    };
    let pose = pose.ok_or_else(|| {
        Failure::message(ExitCode::BadInput, "the robot file has no swimming pose")
    })?;
    let targets: Vec<f32> = pose.iter().map(|&q| q as f32).collect();
    let mut engine =
        caudata_sim::build(Arc::clone(model), 1, &config.engine, &config.terrain, seed, 1)
            .or_exit(ExitCode::BadConfig)?;
    let start = InitialState {
        base_xy_m: args.place.unwrap_or(match config.terrain.kind {
            TerrainKind::Shore => WATERLINE_M,
            _ => [0.0; 2],
        }),
        joint_pos_rad: targets.clone(),
        ..InitialState::nominal(model)
    };
    engine.reset(0, &start).or_exit(ExitCode::BadConfig)?;
    if !(0.0..=60.0).contains(&args.settle_s) {
        let message = "--settle-s must be 0 to 60";
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    let periods = (args.settle_s / engine.config().control_period_s()).round() as u64;
    for _ in 0..periods {
        engine.step(&targets, &[0.0; 6]).or_exit(ExitCode::Internal)?;
    }
    let state = engine.state();
    let wide = |v: &[f32]| v.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>();
    Ok(Moment {
        time_s: args.settle_s,
        base: Pose {
            pos_m: std::array::from_fn(|i| f64::from(state.base_pos_m[i])),
            quat_wxyz: std::array::from_fn(|i| f64::from(state.base_quat_wxyz[i])),
        },
        joint_pos_rad: wide(&state.joint_pos_rad),
        contacts: Vec::new(),
    })
}

/// Pictures of an animation.
fn frame_count(seconds: f64, fps: f64) -> Result<usize, Failure> {
    let count = (seconds * fps).floor() as usize + 1;
    if count > FRAMES_MAX {
        let message = format!("{count} frames are more than {FRAMES_MAX}; lower --fps");
        return Err(Failure::message(ExitCode::BadConfig, message));
    }
    Ok(count)
}

/// The moments of a log that are to be shown.
fn moments_of_log(
    args: &ShowArgs,
    log: &RunLog,
    model: &RobotModel,
    terrain: &Terrain,
    animated: bool,
) -> Result<Vec<Moment>, Failure> {
    let times = log.table.time_s();
    let (Some(&first), Some(&last)) = (times.first(), times.last()) else {
        return Err(Failure::message(ExitCode::BadInput, "the log has no rows"));
    };
    let reader = LogReader::new(&log.table, model, terrain);
    if animated && args.at.is_some() {
        return Err(Failure::message(
            ExitCode::BadConfig,
            "--at is one moment of the log, and a .gif shows all of it: give --out a .png",
        ));
    }
    if !animated {
        let at = args.at.unwrap_or(0.5 * (first + last));
        if !(first..=last).contains(&at) {
            let message =
                format!("--at {at} is outside the log, which runs from {first:.2} to {last:.2} s");
            return Err(Failure::message(ExitCode::BadConfig, message));
        }
        return Ok(vec![reader.moment(at)]);
    }
    let count = frame_count(last - first, args.fps)?;
    Ok((0..count).map(|k| reader.moment(first + k as f64 / args.fps)).collect())
}

/// Reads moments out of a log: each signal's last value until then.
struct LogReader<'a> {
    table: &'a Table,
    base: Option<[&'a [Option<f64>]; 7]>,
    /// One per joint, model order.
    joints: Vec<Option<&'a [Option<f64>]>>,
    feet: Vec<Option<&'a [Option<f64>]>>,
    /// Where a log without the base's place has it.
    fallback: Pose,
}

impl<'a> LogReader<'a> {
    fn new(table: &'a Table, model: &RobotModel, terrain: &Terrain) -> Self {
        let base = Axis::ALL
            .map(Signal::BasePosition)
            .into_iter()
            .chain(QuatPart::ALL.map(Signal::BaseQuaternion))
            .map(|s| table.column(&s))
            .collect::<Option<Vec<_>>>();
        let height = f64::from(terrain.height_m(0.0, 0.0)) + 0.2;
        Self {
            table,
            base: base.and_then(|columns| columns.try_into().ok()),
            joints: model
                .joints()
                .iter()
                .map(|j| table.column(&Signal::Position(j.name.clone())))
                .collect(),
            feet: model
                .feet()
                .iter()
                .map(|f| table.column(&Signal::Contact(f.name.clone())))
                .collect(),
            fallback: Pose::from_pos([0.0, 0.0, height]),
        }
    }

    fn moment(&self, at_s: f64) -> Moment {
        const ROUNDING_S: f64 = 1e-9;
        let reached = self.table.time_s().partition_point(|&t| t <= at_s + ROUNDING_S);
        let last = |column: &[Option<f64>]| column[..reached].iter().rev().find_map(|v| *v);
        let base = self.base.and_then(|columns| {
            let v: Vec<f64> = columns.into_iter().map(last).collect::<Option<_>>()?;
            Some(Pose {
                pos_m: [v[0], v[1], v[2]],
                quat_wxyz: caudata_model::pose::quat_normalised([v[3], v[4], v[5], v[6]])?,
            })
        });
        let value = |column: &Option<&[Option<f64>]>| column.and_then(last).unwrap_or(0.0);
        Moment {
            time_s: at_s,
            base: base.unwrap_or(self.fallback),
            joint_pos_rad: self.joints.iter().map(value).collect(),
            contacts: self.feet.iter().map(|c| value(c) > 0.5).collect(),
        }
    }
}

/// Makes the pictures: of every moment, or one turn around the only one.
fn draw(
    args: &ShowArgs,
    config: &Config,
    model: &RobotModel,
    terrain: &Arc<Terrain>,
    moments: &[Moment],
    animated: bool,
    stop: &StopFlag,
) -> Result<Vec<Image>, Failure> {
    let width = args.width.unwrap_or(if animated { 480 } else { 1280 });
    let quality = Quality {
        width,
        height: args.height.unwrap_or(width * 9 / 16),
        rays: if animated { 2 } else { 3 },
        threads: flags::cores(),
    };
    let turn = animated && moments.len() == 1;
    let count = if turn { TURN_FRAMES as usize } else { moments.len() };
    let mut frames = Vec::with_capacity(count);
    let mut heading = Smooth::default();
    let mut distance_m = args.distance;
    let mut share = say::Share::new("pictures", count);
    for k in 0..count {
        if stop.is_set() {
            return Err(stopped(stop));
        }
        let moment = &moments[if turn { 0 } else { k }];
        let forward = moment.base.rotate([1.0, 0.0, 0.0]);
        let extra = if turn { TAU * k as f64 / count as f64 } else { 0.0 };
        let yaw = match args.view {
            // From above it is to be seen where the robot faces: the picture does not turn with it.
            View::Top => 0.0,
            _ => heading.follow(forward[1].atan2(forward[0])),
        };
        let from = (args.view, yaw + extra);
        let mut image = portrait(model, moment, terrain, from, &mut distance_m, &quality)
            .or_exit(ExitCode::BadConfig)?;
        image.caption(&format!(
            "t = {:.2} s   {}   grid 0.1 m, bold 1 m",
            moment.time_s,
            config.terrain.kind.name()
        ));
        frames.push(image);
        share.one_more();
    }
    Ok(frames)
}

/// A heading that the camera follows slowly, so that a swinging head does not swing the picture.
#[derive(Default)]
struct Smooth {
    yaw_rad: Option<f64>,
}

impl Smooth {
    fn follow(&mut self, yaw_rad: f64) -> f64 {
        let Some(old) = self.yaw_rad else {
            self.yaw_rad = Some(yaw_rad);
            return yaw_rad;
        };
        let step = (yaw_rad - old + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
        let new = old + 0.03 * step;
        self.yaw_rad = Some(new);
        new
    }
}
