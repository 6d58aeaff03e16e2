//! The robot on the page: one lane of the engine under a policy.

use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::Config;
use caudata_env::{StartShift, VecEnv};
use caudata_evaluation::report::{GroundScene, RobotScene, motion_row, pose_row};
use caudata_evaluation::{
    EvaluationError, Frame, RobotPose, Scenario, Settings, Start, conditions,
};
use caudata_model::RobotModel;
use caudata_policy::{Inference, PolicyFile};
use caudata_sim::{Terrain, TerrainConfig, TerrainKind};
use caudata_task::push::PushConfig;
use serde::Serialize;

use crate::order::Order;

/// Key of its random streams: no actor of a training run and no block of an evaluation has it.
const LIVE_KEY: u64 = u64::MAX / 2;
/// Seed of the ground, and of the sensors' noise.
const SEED: u64 = 1;
/// Length of an episode, s: nobody shall be put back at the start in the middle of something.
const EPISODE_S: f64 = 86_400.0;
/// How long a push lasts, s.
const PUSH_S: f64 = 0.2;

/// One robot, its ground, and what it is told.
pub struct Stage {
    config: Config,
    model: Arc<RobotModel>,
    env: VecEnv,
    inference: Option<Inference>,
    actions: Vec<f32>,
    strengths: Vec<f32>,
    velocity: [f32; 3],
    terrain: TerrainConfig,
}

/// What does not change.
#[derive(Debug, Serialize)]
struct Robot {
    robot: RobotScene,
    name: String,
    mass_kg: f64,
    joint_names: Vec<String>,
    foot_names: Vec<String>,
    terrains: Vec<&'static str>,
    /// Least and greatest vx, vy (m/s), yaw rate (rad/s) of the task.
    ranges: [[f32; 2]; 3],
}

/// The ground; the robot is at its start.
#[derive(Debug, Serialize)]
struct Ground {
    kind: &'static str,
    period_s: f64,
    ground: GroundScene,
}

/// What it is told at present.
#[derive(Debug, Serialize)]
struct Told<'a> {
    velocity: [f32; 3],
    strengths: &'a [f32],
}

impl Stage {
    /// The robot of `config` under `policy`, at rest on the ground of `config`; without a policy it holds its
    /// nominal pose.
    ///
    /// # Errors
    /// When the policy does not fit the robot, or the simulation cannot be built.
    pub fn new(
        config: &Config,
        model: &Arc<RobotModel>,
        policy: Option<&PolicyFile>,
    ) -> Result<Self, EvaluationError> {
        let terrain = config.terrain.clone();
        let env = environment(config, model, &terrain)?;
        let joints = env.act_dim();
        let mut stage = Self {
            config: config.clone(),
            model: Arc::clone(model),
            env,
            inference: None,
            actions: vec![0.0; joints],
            strengths: vec![1.0; joints],
            velocity: [0.0; 3],
            terrain,
        };
        if let Some(policy) = policy {
            stage.follow(policy)?;
        }
        Ok(stage)
    }

    /// Goes on under another policy.
    ///
    /// # Errors
    /// When it does not fit the robot, or cannot be run.
    pub fn follow(&mut self, policy: &PolicyFile) -> Result<(), EvaluationError> {
        policy.check_runs_on(self.env.contract()).map_err(EvaluationError::Refused)?;
        let inference = Inference::new(policy, 1).map_err(EvaluationError::Inference)?;
        self.inference = Some(inference);
        Ok(())
    }

    /// Time of one step, s.
    pub fn period_s(&self) -> f64 {
        self.config.task.control_period_s
    }

    /// One control step. `Some`: the robot fell, for this reason, and has started again.
    ///
    /// # Errors
    /// When the policy or the engine fails.
    pub fn step(&mut self) -> Result<Option<&'static str>, EvaluationError> {
        if let Some(inference) = &mut self.inference {
            inference
                .run(self.env.observations(), 1, &mut self.actions)
                .map_err(EvaluationError::Inference)?;
        }
        let output = self.env.step(&self.actions)?;
        let ended = output.episodes.first();
        Ok(ended.map(|episode| episode.reason.map_or("time", |reason| reason.name())))
    }

    /// Where every part of the robot is.
    pub fn pose(&self) -> RobotPose {
        RobotPose::read(&self.env, 0)
    }

    /// What it does.
    pub fn frame(&self) -> Frame {
        Frame::read(&self.env, 0)
    }

    /// Pose, then motion, as the replay of an evaluation has them ([`pose_row`], [`motion_row`]).
    pub(crate) fn row(&self) -> Vec<f32> {
        let mut row = pose_row(&self.pose());
        row.extend(motion_row(&self.frame()));
        row
    }

    /// Does what it is told; true: the robot stands at a start, perhaps on another ground.
    ///
    /// # Errors
    /// When the engine refuses, or the ground cannot be made.
    pub fn obey(&mut self, order: &Order) -> Result<bool, EvaluationError> {
        match *order {
            Order::Drive { velocity } => {
                let ranges = self.ranges();
                self.velocity =
                    std::array::from_fn(|i| velocity[i].clamp(ranges[i][0], ranges[i][1]));
                self.env.set_command(0, self.velocity);
            }
            Order::Push { velocity_mps } => {
                let newtons = (self.model.total_mass_kg() / PUSH_S) as f32;
                self.env.push(0, velocity_mps.map(|v| v * newtons), PUSH_S);
            }
            Order::Terrain { kind } => {
                self.terrain.kind = kind;
                self.restart()?;
                return Ok(true);
            }
            Order::Joint { index, strength } => {
                if let Some(joint) = self.strengths.get_mut(index) {
                    *joint = strength;
                }
                self.env.set_joint_strengths(&self.strengths)?;
            }
            Order::Restart => {
                self.restart()?;
                return Ok(true);
            }
        }
        Ok(false)
    }

    fn restart(&mut self) -> Result<(), EvaluationError> {
        self.env = environment(&self.config, &self.model, &self.terrain)?;
        self.env.set_joint_strengths(&self.strengths)?;
        self.actions.fill(0.0);
        self.env.set_command(0, self.velocity);
        Ok(())
    }

    /// Ranges of the command; each holds 0.
    fn ranges(&self) -> [[f32; 2]; 3] {
        let command = &self.config.task.command;
        [command.vx_mps, command.vy_mps, command.yaw_rate_radps]
            .map(|[least, most]| [least.min(0.0), most.max(0.0)])
    }

    /// Puts it at another place and heading, at rest.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn place(&mut self, start: StartShift) -> Result<(), EvaluationError> {
        self.env.shift_starts(start)?;
        Ok(())
    }

    /// What a client must know first.
    pub(crate) fn robot(&self) -> impl Serialize + use<> {
        let owned = |names: Vec<&str>| names.into_iter().map(str::to_owned).collect();
        let (kinds, swims) = (TerrainKind::ALL.into_iter(), self.model.water().is_some());
        Robot {
            robot: RobotScene::of(&self.model),
            name: self.model.name().to_owned(),
            mass_kg: self.model.total_mass_kg(),
            joint_names: owned(self.model.actuated_names()),
            foot_names: self.model.feet().iter().map(|f| f.name.clone()).collect(),
            terrains: kinds
                .filter(|kind| *kind != TerrainKind::Map && (swims || !kind.is_wet()))
                .map(TerrainKind::name)
                .collect(),
            ranges: self.ranges(),
        }
    }

    /// The ground that it stands on.
    pub(crate) fn ground(&self) -> impl Serialize + use<> {
        Ground {
            kind: self.terrain.kind.name(),
            period_s: self.period_s(),
            ground: GroundScene::around(self.env.engine().terrain(), &[]),
        }
    }

    /// What it is told at present.
    pub(crate) fn told(&self) -> impl Serialize + '_ {
        Told { velocity: self.velocity, strengths: &self.strengths }
    }
}

/// One lane under the conditions of an evaluation: the robot as its file says, nothing that befalls it.
fn environment(
    config: &Config,
    model: &Arc<RobotModel>,
    terrain: &TerrainConfig,
) -> Result<VecEnv, EvaluationError> {
    let scenario = Scenario {
        terrain: terrain.clone(),
        start: Start { yaw_range_rad: Some(0.0), ..Start::default() },
        ..Scenario::walk("live", [0.0; 3])
    };
    let settings = Settings { episode_s: EPISODE_S, seed: SEED, ..Settings::default() };
    let ground =
        Terrain::generate(terrain, SEED).map_err(|error| EvaluationError::Env(error.into()))?;
    let mut config = conditions(config, &scenario, &settings, ground.water_level_m);
    config.actors.lanes = 1;
    config.actors.threads = 1;
    config.task.push = PushConfig { enabled: false, ..PushConfig::default() };
    let mut env = build_env(&config, Arc::clone(model), LIVE_KEY)?;
    env.hold_commands(&[[0.0; 3]])?;
    Ok(env)
}
