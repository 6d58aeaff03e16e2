//! `caudata bench sim`: physics steps per second by engine, scene and lane width, MuJoCo beside it in the
//! same run; and environment steps.
//!
//! Rounds of an engine and of MuJoCo alternate, so that both see the same machine. Nothing is pinned here:
//! started under `taskset -c N`, the program and its MuJoCo share that core.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use caudata_config::ConfigArgs;
use caudata_declare::named;
use caudata_model::RobotModel;
use caudata_sim::batch::{BatchEngine, Phase};
use caudata_sim::{
    Engine, EngineConfig, EngineKind, InitialState, LaneParams, SimError, Terrain, TerrainConfig,
    TerrainKind, build,
};
use caudata_studies::files;
use caudata_studies::flags::{self, EngineName};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, ValueEnum};
use serde::Serialize;
use serde_json::{Value, json};

use crate::measure::{Rate, until};
use crate::parts::{self, Time};
use crate::verify::{Gait, Mujoco, Presence, RobotRequest, VerifyError};

/// Physics step, s.
pub const DT_S: f64 = 0.002;
/// Steps per control period.
const SUBSTEPS: u32 = 10;
/// Control periods of the targets that repeat: 10 s, in which the trot's 1.3 Hz closes.
const PERIODS: usize = 500;
/// How often ours and MuJoCo's rounds alternate; the best of each counts.
const ROUNDS: u32 = 5;

named! {
    /// Where the robot is.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
    #[serde(rename_all = "lowercase")]
    pub enum SceneName {
        /// A trot on level ground
        Flat = "flat",
        /// A trot on hills with 4 cm of random height
        Rough = "rough",
        /// The trot's motions in deep water, all drag on
        Water = "water",
    }
}

impl SceneName {
    fn terrain(self) -> TerrainConfig {
        TerrainConfig::of(match self {
            Self::Flat => TerrainKind::Flat,
            Self::Rough => TerrainKind::RoughMedium,
            Self::Water => TerrainKind::DeepWater,
        })
    }
}

/// What to measure.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    #[command(flatten)]
    time: Time,
    /// Environments
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=65_536))]
    lanes: u32,
    /// Threads of the environment steps; physics is measured on one and on all
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    threads: u32,
    /// Engines whose physics is measured; default: all. May be given several times
    #[arg(long, value_enum)]
    engine: Vec<EngineName>,
    /// Scenes; default: all. May be given several times
    #[arg(long, value_enum)]
    scene: Vec<SceneName>,
    /// Lanes per vector register; default 0, the engine's choice. May be given several times
    #[arg(long, value_name = "LANE_WIDTH", default_values_t = [0], hide_default_value = true)]
    lane_width: Vec<u32>,
    /// Environment steps only
    #[arg(long)]
    no_physics: bool,
    /// No MuJoCo beside
    #[arg(long)]
    no_mujoco: bool,
    /// The robot file's drive-line as it is, without delay, low-pass, Stribeck and load-dependent friction,
    /// gear play and sag of the supply
    #[arg(long)]
    bare: bool,
    /// Robot, engine, terrain and task; the preset `quick` without these flags
    #[command(flatten)]
    config: ConfigArgs,
}

/// Physics and environment steps.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// Environment steps.
    #[serde(flatten)]
    pub environment: Rate,
    /// By engine, scene and lane width.
    pub physics: Vec<Speed>,
    /// Which MuJoCo, or why none.
    pub mujoco: String,
}

/// Measures everything in the plan.
///
/// # Errors
/// Where a robot cannot be read, or an engine or MuJoCo cannot run.
pub fn run(plan: &Plan) -> Result<Finding, Failure> {
    let mut config = parts::config(&plan.config)?;
    let (physics, mujoco) = match plan.no_physics {
        true => (Vec::new(), "skipped: --no-physics".to_owned()),
        false => physics(plan, &config.robot_path(), &config.engine)?,
    };
    (config.actors.lanes, config.actors.threads) = (plan.lanes, plan.threads);
    Ok(Finding {
        environment: parts::environment_steps(plan.time.seconds, &config)?,
        physics,
        mujoco,
    })
}

/// One line of the table.
#[derive(Clone, Debug, Serialize)]
pub struct Speed {
    /// The engine.
    pub engine: &'static str,
    /// The scene.
    pub scene: SceneName,
    /// Lanes per vector register asked for; 0: the engine's choice.
    pub lane_width: u32,
    /// Robots side by side.
    pub lanes: usize,
    /// Physics steps per second, all lanes together, on one thread.
    pub steps_per_s: f64,
    /// The same on all threads.
    pub all_threads_steps_per_s: f64,
    /// All threads.
    pub threads: usize,
    /// `all_threads_steps_per_s` over `steps_per_s`.
    pub scaling: f64,
    /// MuJoCo's rate in the alternating rounds; null without MuJoCo.
    pub mujoco_steps_per_s: Option<f64>,
    /// One thread of ours over one of MuJoCo's.
    pub ratio: Option<f64>,
    /// Lanes that diverged while it was measured.
    pub diverged: usize,
    /// Share of one thread's time by phase of the step, `[0, 1]`; empty for an engine that cannot tell.
    pub phases: Vec<PhaseShare>,
}

/// One phase of a step.
#[derive(Clone, Debug, Serialize)]
pub struct PhaseShare {
    /// Its name.
    pub phase: &'static str,
    /// Its share of the time, `[0, 1]`.
    pub share: f64,
}

/// Measures physics; also says which MuJoCo, or why none.
fn physics(
    plan: &Plan,
    robot: &Path,
    engine: &EngineConfig,
) -> Result<(Vec<Speed>, String), Failure> {
    let model = Arc::new(files::robot(robot)?);
    let robot = RobotRequest::read(robot).or_exit(ExitCode::NoInput)?;
    let mut mujoco = match plan.no_mujoco {
        true => Presence::Absent("not asked for".to_owned()),
        false => Mujoco::start(),
    };
    let about = match &mujoco {
        Presence::Here(m) => format!("MuJoCo {}", m.version),
        Presence::Absent(why) => format!("skipped: {why}"),
    };
    let scenes = match plan.scene.as_slice() {
        [] => SceneName::value_variants(),
        some => some,
    };
    let mut found = Vec::new();
    for &scene in scenes {
        if plan.scene.is_empty() && scene == SceneName::Water && model.water().is_none() {
            tracing::warn!("the scene water is left out: the robot file has no [water]");
            continue;
        }
        let mut theirs = match mujoco.get() {
            Ok(mujoco) => {
                let mut there = Theirs { mujoco, scene };
                there.start(&robot, &model).or_exit(ExitCode::Unavailable)?;
                Some(there)
            }
            Err(_) => None,
        };
        for name in EngineName::or_all(&plan.engine) {
            for &lane_width in &plan.lane_width {
                let config = EngineConfig {
                    kind: name.into(),
                    dt_s: DT_S,
                    substeps: SUBSTEPS,
                    lane_width,
                    ..engine.clone()
                };
                found.extend(one(plan, &model, scene, &config, theirs.as_mut())?);
            }
        }
    }
    Ok((found, about))
}

/// MuJoCo in one scene.
struct Theirs<'a> {
    mujoco: &'a mut Mujoco,
    scene: SceneName,
}

impl Theirs<'_> {
    fn start(&mut self, robot: &RobotRequest, model: &RobotModel) -> Result<(), VerifyError> {
        let mut options =
            json!({ "dt_s": DT_S, "cone": "pyramidal", "iterations": 4, "ls_iterations": 8 });
        let terrain = self.scene.terrain();
        let ground = Terrain::generate(&terrain, 1)?;
        let start = InitialState::nominal(model);
        let mut height = 0.12 + f64::from(ground.height_m(0.0, 0.0));
        if let Some(level) = ground.water_level_m {
            // its fluid fills all space and lifts nothing: weightless in water
            options["density"] = json!(1000.0);
            options["viscosity"] = json!(0.001);
            options["gravity_mps2"] = json!([0.0, 0.0, 0.0]);
            height = f64::from(level);
        }
        let targets = Gait::TROT.rows(model, PERIODS);
        let angles: Vec<f64> = start.joint_pos_rad.iter().map(|&q| f64::from(q)).collect();
        let full = model.full_pos_rad(&angles)?;
        let grid = ground.grid().map(
            |g| json!({ "points": g.points(), "size_m": g.size_m(), "heights_m": g.heights_m() }),
        );
        let more = json!({
            "name": self.scene.name(), "joint_pos": full, "base": [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0],
            "targets": targets, "substeps": SUBSTEPS, "terrain": grid,
        });
        self.mujoco.ask(&robot.task("speed", model, options, more)).map(|_| ())
    }

    /// Steps and seconds of one round.
    fn round(&mut self, seconds: f64) -> Result<(f64, f64), VerifyError> {
        let ask = json!({ "task": "speed", "name": self.scene.name(), "seconds": seconds });
        let answer: Value = self.mujoco.ask(&ask)?;
        let number = |key: &str| answer[key].as_f64().unwrap_or(f64::NAN);
        Ok((number("steps"), number("seconds")))
    }
}

/// One engine, scene and lane width; `None` where the engine does not have that width.
fn one(
    plan: &Plan,
    model: &Arc<RobotModel>,
    scene: SceneName,
    config: &EngineConfig,
    mut theirs: Option<&mut Theirs<'_>>,
) -> Result<Option<Speed>, Failure> {
    let width = config.lane_width;
    if width != 0 && config.kind != EngineKind::Batch {
        return Ok(None); // only that engine has lanes in registers
    }
    if ![0, 1, 4, 8, 16].contains(&width) {
        return Err(Failure::message(
            ExitCode::BadConfig,
            format!("--lane-width {width} is not 0 (the widest), 1, 4, 8 or 16"),
        ));
    }
    let threads = flags::cores();
    let lanes = plan.lanes as usize;
    let make = |threads: usize| -> Result<Ours<dyn Engine>, SimError> {
        let model = Arc::clone(model);
        let engine = build(model, lanes, config, &scene.terrain(), 1, threads)?;
        Ours::new(engine, plan.bare)
    };
    let (mut single, mut all) = match (make(1), make(threads)) {
        (Ok(single), Ok(all)) => (single, all),
        // a width that this processor lacks
        (Err(SimError::Config { field: "lane_width", .. }), _) => {
            tracing::warn!(
                lanes = width,
                "skipped: this processor has no registers of so many lanes"
            );
            return Ok(None);
        }
        (Err(error), _) | (_, Err(error)) => return Err(Failure::new(ExitCode::BadConfig, error)),
    };
    let seconds = plan.time.seconds / f64::from(ROUNDS);
    single.round(0.2 * seconds)?; // caches and clocks warm up
    all.round(0.2 * seconds)?;
    // the best round counts: whatever else the machine does only ever takes away
    let mut best = [0.0_f64; 3];
    for _ in 0..ROUNDS {
        let mut rounds = [single.round(seconds)?, (0.0, 1.0), all.round(seconds)?];
        if let Some(theirs) = theirs.as_deref_mut() {
            rounds[1] = theirs.round(seconds).or_exit(ExitCode::Unavailable)?;
        }
        for (best, (steps, seconds)) in best.iter_mut().zip(rounds) {
            *best = best.max(steps / seconds);
        }
    }
    let [steps_per_s, mujoco, all_threads_steps_per_s] = best;
    let mujoco_steps_per_s = theirs.is_some().then_some(mujoco);
    let broken = single.engine.state().diverged.iter().filter(|d| **d);
    let diverged = single.diverged + broken.count();
    Ok(Some(Speed {
        engine: config.kind.name(),
        scene,
        lane_width: width,
        lanes,
        steps_per_s,
        all_threads_steps_per_s,
        threads,
        scaling: all_threads_steps_per_s / steps_per_s,
        mujoco_steps_per_s,
        ratio: mujoco_steps_per_s.map(|theirs| steps_per_s / theirs),
        diverged,
        phases: phases(plan, model, scene, config)?,
    }))
}

/// Where one thread's time goes, in a run of its own: looking at the clock costs some per cent.
fn phases(
    plan: &Plan,
    model: &Arc<RobotModel>,
    scene: SceneName,
    config: &EngineConfig,
) -> Result<Vec<PhaseShare>, Failure> {
    if config.kind != EngineKind::Batch {
        return Ok(Vec::new());
    }
    let make = || -> Result<Ours<BatchEngine>, SimError> {
        let terrain = Arc::new(Terrain::generate(&scene.terrain(), 1)?);
        let model = Arc::clone(model);
        let engine = BatchEngine::new(model, plan.lanes as usize, config.clone(), terrain, 1)?;
        Ours::new(Box::new(engine), plan.bare)
    };
    let mut ours = make().or_exit(ExitCode::BadConfig)?;
    let seconds = plan.time.seconds / f64::from(ROUNDS);
    ours.round(0.2 * seconds)?;
    ours.engine.time_phases();
    ours.round(seconds)?;
    let spent = ours.engine.phase_seconds();
    let total: f64 = spent.iter().sum();
    Ok(Phase::ALL
        .into_iter()
        .zip(spent)
        .map(|(phase, seconds)| PhaseShare { phase: phase.name(), share: seconds / total })
        .collect())
}

/// One of our engines, walking.
struct Ours<E: Engine + ?Sized> {
    engine: Box<E>,
    /// Each control period's targets for all lanes.
    targets: Vec<Vec<f32>>,
    wrenches: Vec<f32>,
    period: usize,
    /// Lanes that broke down before a restart.
    diverged: usize,
}

/// The robot with every effect of its drive-line and supply switched on, of the size that the catalogue
/// expects in such servos: the time of a step with all of them is what counts. (MuJoCo has none of them.)
fn walking(model: &RobotModel) -> LaneParams {
    let mut params = LaneParams::nominal(model);
    params.command_delay_s = 0.007;
    params.supply_resistance_ohm = 0.1;
    params.supply_lag_s = 0.005;
    for joint in &mut params.joints {
        joint.command_skew_s = 0.001;
        joint.command_low_pass_s = 0.005;
        joint.stribeck_nm = 0.02;
        joint.load_friction_driving = 0.1;
        joint.load_friction_driven = 0.05;
        joint.gear_half_gap_rad = 0.002;
    }
    params
}

impl<E: Engine + ?Sized> Ours<E> {
    fn new(mut engine: Box<E>, bare: bool) -> Result<Self, SimError> {
        let lanes = engine.lanes();
        if !bare {
            let params = walking(engine.model());
            for lane in 0..lanes {
                engine.set_params(lane, &params)?;
            }
        }
        let width = engine.model().actuated().len();
        let targets = (0..PERIODS)
            .map(|k| {
                let mut all = vec![0.0; lanes * width];
                for (lane, row) in all.chunks_exact_mut(width).enumerate() {
                    // each lane a little later, so that not all feet touch at once
                    let t_s = (k as f64 + lane as f64 * 0.37) * 0.02;
                    Gait::TROT.targets(engine.model(), t_s, row);
                }
                all
            })
            .collect();
        Ok(Self { wrenches: vec![0.0; lanes * 6], engine, targets, period: 0, diverged: 0 })
    }

    /// Everybody back to the start, as MuJoCo's rollout begins anew: a robot that walked into a hole would
    /// measure lying still.
    fn restart(&mut self) -> Result<(), SimError> {
        let broken = &self.engine.state().diverged;
        self.diverged += broken.iter().filter(|d| **d).count();
        let start = InitialState::nominal(self.engine.model());
        for lane in 0..self.engine.lanes() {
            self.engine.reset(lane, &start)?;
        }
        Ok(())
    }

    /// Physics steps and seconds of one round.
    fn round(&mut self, seconds: f64) -> Result<(f64, f64), Failure> {
        let began = Instant::now();
        let mut steps = 0.0;
        until(seconds, || {
            if self.period.is_multiple_of(PERIODS) {
                self.restart().or_exit(ExitCode::Internal)?;
            }
            let targets = &self.targets[self.period % PERIODS];
            self.period += 1;
            self.engine.step(targets, &self.wrenches).or_exit(ExitCode::Internal)?;
            steps += (self.engine.lanes() * SUBSTEPS as usize) as f64;
            Ok(())
        })?;
        Ok((steps, began.elapsed().as_secs_f64()))
    }
}
