//! A second engine, for tests: a kinematic toy whose every number can be worked by hand.
//!
//! Joints go half of the way to their targets per control step (less with a lower Kp). The base keeps its
//! velocity; pushes change it. It rolls with the first spine joint. No contact, no noise.
// Each test program uses its own part of this.
#![allow(dead_code)]

use std::path::Path;
use std::sync::Arc;

use caudata_env::VecEnv;
use caudata_model::RobotModel;
use caudata_sim::{Engine, EngineConfig, InitialState, LaneParams, Rig, SimError, State, Terrain};
use caudata_task::TaskConfig;
use serde::{Deserialize, Serialize};

const ACT_DIM: usize = 16;

/// Roll of the base per rad of the first spine joint.
pub const ROLL_PER_SPINE: f32 = 4.0;
/// Height of the whole body's centre of mass, m.
pub const COM_HEIGHT_M: f32 = 0.12;

pub fn model() -> Arc<RobotModel> {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    Arc::new(RobotModel::load(&robots.join("polymander.robot.toml")).unwrap())
}

/// The default task without anything random but commands and starts.
pub fn calm_task() -> TaskConfig {
    let mut task =
        TaskConfig { episode_steps: 20, stagger_first_episode: false, ..TaskConfig::default() };
    task.randomisation.enabled = false;
    task.push.enabled = false;
    task.noise.enabled = false;
    task
}

pub fn env(task: &TaskConfig, lanes: usize, seed: u64) -> VecEnv {
    let model = model();
    let engine = FakeEngine::new(Arc::clone(&model), lanes);
    VecEnv::new(model, task.clone(), Box::new(engine), seed, 0).unwrap()
}

/// How a lane breaks down at a given control step of its episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Breakdown {
    /// The engine notices: it keeps the last finite state and sets the flag.
    Flagged,
    /// It does not: not-a-number gets into the state.
    Unnoticed,
}

#[derive(Clone)]
pub struct FakeEngine {
    rig: Rig,
    steps: Vec<u32>,
    /// (lane, step of its episode, how); once.
    pub breakdown: Option<(usize, u32, Breakdown)>,
}

#[derive(Serialize, Deserialize)]
struct Saved(State, Vec<LaneParams>, Vec<u32>);

impl FakeEngine {
    pub fn new(model: Arc<RobotModel>, lanes: usize) -> Self {
        let rig = Rig {
            terrain: Arc::new(Terrain::flat()),
            state: State::zeros(lanes, model.joints().len(), ACT_DIM, model.feet().len()),
            params: vec![LaneParams::nominal(&model); lanes],
            config: EngineConfig { dt_s: 0.004, substeps: 5, ..EngineConfig::default() },
            model,
        };
        Self { rig, steps: vec![0; lanes], breakdown: None }
    }

    /// Sets everything that follows from joints, base and heading.
    fn derive(&mut self, lane: usize) {
        let state = &mut self.rig.state;
        let spine = state.joint_pos_rad[lane * state.joints + self.rig.model.actuated()[0]];
        let (sin, cos) = (ROLL_PER_SPINE * spine).sin_cos();
        state.imu_gravity[lane * 3..][..3].copy_from_slice(&[0.0, -sin, -cos]);
        let base: [f32; 3] = state.base_pos_m[lane * 3..][..3].try_into().unwrap();
        let vel: [f32; 3] = state.base_vel_mps[lane * 3..][..3].try_into().unwrap();
        state.com_pos_m[lane * 3..][..3].copy_from_slice(&[base[0], base[1], COM_HEIGHT_M]);
        state.com_vel_mps[lane * 3..][..3].copy_from_slice(&vel);
        for (foot, part) in self.rig.model.feet().iter().enumerate() {
            let at = (lane * 4 + foot) * 3;
            state.foot_pos_m[at..][..3].copy_from_slice(&[
                base[0],
                base[1],
                part.radius_m() as f32,
            ]);
            state.foot_vel_mps[at..][..3].copy_from_slice(&vel);
            state.foot_force_n[at..][..3].copy_from_slice(&[0.0, 0.0, 6.0]);
        }
    }
}

impl Engine for FakeEngine {
    fn rig(&self) -> &Rig {
        &self.rig
    }

    fn rig_mut(&mut self) -> &mut Rig {
        &mut self.rig
    }

    fn take_params(&mut self, _lane: usize) {}

    fn begin(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        let state = &mut self.rig.state;
        let joints = state.joints;
        for (i, &j) in self.rig.model.actuated().iter().enumerate() {
            state.joint_pos_rad[lane * joints + j] = init.joint_pos_rad[i];
            state.joint_vel_radps[lane * joints + j] = init.joint_vel_radps[i];
        }
        let [x, y] = init.base_xy_m;
        state.base_pos_m[lane * 3..][..3].copy_from_slice(&[x, y, 0.1]);
        state.base_vel_mps[lane * 3..][..3].copy_from_slice(&init.base_vel_mps);
        state.heading_rad[lane] = init.base_rpy_rad[2];
        state.mech_power_w[lane * ACT_DIM..][..ACT_DIM].fill(0.0);
        state.diverged[lane] = false;
        self.steps[lane] = 0;
        self.derive(lane);
        Ok(())
    }

    fn advance(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        let dt = self.rig.config.control_period_s() as f32;
        let mass = self.rig.model.total_mass_kg() as f32;
        for lane in 0..self.lanes() {
            self.steps[lane] += 1;
            if self.rig.state.diverged[lane] {
                continue;
            }
            let state = &mut self.rig.state;
            for (i, &j) in self.rig.model.actuated().iter().enumerate() {
                let at = lane * state.joints + j;
                let share = 0.5 * self.rig.params[lane].kp_nm_per_rad[i] / 15.0;
                let change = share * (targets_rad[lane * ACT_DIM + i] - state.joint_pos_rad[at]);
                state.joint_pos_rad[at] += change;
                state.joint_vel_radps[at] = change / dt;
                state.mech_power_w[lane * ACT_DIM + i] = change;
            }
            for axis in 0..2 {
                state.base_vel_mps[lane * 3 + axis] += wrenches[lane * 6 + axis] / mass * dt;
                state.base_pos_m[lane * 3 + axis] += state.base_vel_mps[lane * 3 + axis] * dt;
            }
            self.derive(lane);
            if let Some((broken, step, how)) = self.breakdown
                && (broken, step) == (lane, self.steps[lane])
            {
                match how {
                    Breakdown::Flagged => self.rig.state.diverged[lane] = true,
                    Breakdown::Unnoticed => self.rig.state.com_vel_mps[lane * 3] = f32::NAN,
                }
                self.breakdown = None;
            }
        }
        Ok(())
    }

    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        let saved = Saved(self.rig.state.clone(), self.rig.params.clone(), self.steps.clone());
        Ok(postcard::to_stdvec(&saved).unwrap())
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        let Saved(state, params, steps) = postcard::from_bytes(bytes).map_err(|error| {
            SimError::Snapshot { action: "restored", reason: error.to_string() }
        })?;
        (self.rig.state, self.rig.params, self.steps) = (state, params, steps);
        Ok(())
    }
}

/// Actions that differ per lane, joint and step, small enough to stay upright.
pub fn wiggle(lanes: usize, step: usize) -> Vec<f32> {
    (0..lanes * ACT_DIM).map(|i| 0.3 * ((i * 7 + step * 3) as f32).sin()).collect()
}
