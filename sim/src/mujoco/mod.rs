//! MuJoCo as an engine, in a Python process beside: a third opinion on what the others say.
//!
//! What is MuJoCo's: rigid bodies, contacts, stops, dry friction, damping and springs of joints, all as the
//! robot's files have them. What is ours, the same code that every engine runs: the servo from command to
//! motor torque (once per physics step, applied as a joint torque over it), and water, as forces on links.
//! The robot goes to MuJoCo as an MJCF that is written from the model with the lane's parameters
//! (`mjcf.rs`); `sim/mujoco/engine.py` adds the ground and steps.
//!
//! A lane costs some 0.1 ms per physics step, on one thread. The Python is the one that
//! `CAUDATA_MUJOCO_PYTHON` names; `setup/provision.py --with-mujoco` makes it.
//!
//! Not simulated, and refused: snapshots, shapes that touch each other, slippery patches, gears that give way, friction
//! that is more than Coulomb's and viscous, added mass of water.

mod lane;
mod mjcf;
mod process;
mod robot;
mod shared;

use std::sync::Arc;

use caudata_model::RobotModel;

use crate::engine::{WRENCH, check_new, check_step};
use crate::error::check_lane;
use crate::stop::Stop;
use crate::{Engine, EngineConfig, InitialState, LaneParams, SimError, State, Terrain};
use lane::Lane;
use process::{Process, Request};
use shared::{Shared, cannot};

pub use process::{Python, version};

/// Most lanes one engine takes; one process steps them all.
pub const MAX_MUJOCO_LANES: usize = 4096;

/// The MuJoCo engine.
pub struct MujocoEngine {
    shared: Shared,
    process: Process,
    lanes: Vec<Lane>,
    /// Parameters set since the lane was last built.
    pending: Vec<Option<LaneParams>>,
    state: State,
}

impl MujocoEngine {
    /// Starts the process, each robot at the origin in its nominal pose. One process does not use `_threads`.
    ///
    /// # Errors
    /// When there is no MuJoCo, or it does not simulate this.
    pub fn new(
        model: Arc<RobotModel>,
        lanes: usize,
        config: EngineConfig,
        terrain: Arc<Terrain>,
        _threads: usize,
    ) -> Result<Self, SimError> {
        check_new(&model, &config, lanes, MAX_MUJOCO_LANES)?;
        if config.self_collision {
            return Err(cannot("self_collision"));
        }
        if terrain.has_patches() {
            return Err(cannot("slippery patches of ground"));
        }
        let shared = Shared { stops: Stop::all(&model, &config)?, model, config, terrain };
        let mut engine = Self {
            process: Process::start(&opening(&shared, lanes))?,
            lanes: Vec::with_capacity(lanes),
            pending: vec![None; lanes],
            state: State::of(&shared.model, lanes),
            shared,
        };
        let params = LaneParams::nominal(&engine.shared.model);
        let init = InitialState::nominal(&engine.shared.model);
        for number in 0..lanes {
            let process = &mut engine.process;
            let lane = Lane::new(&engine.shared, process, number, params.clone(), &init)?;
            engine.lanes.push(lane);
            engine.publish(number);
        }
        Ok(engine)
    }

    fn publish(&mut self, lane: usize) {
        self.state.copy_lane(lane, &self.lanes[lane].memory.out);
    }

    /// Builds lanes anew whose parameters have changed.
    fn take_pending(&mut self) -> Result<(), SimError> {
        for number in 0..self.lanes.len() {
            let Some(params) = self.pending[number].take() else { continue };
            let memory = self.lanes[number].memory.clone();
            let process = &mut self.process;
            self.lanes[number] = Lane::from_memory(&self.shared, process, number, params, memory)?;
        }
        Ok(())
    }

    /// One physics step of all lanes.
    fn substep(&mut self, since_s: f64) -> Result<(), SimError> {
        let mut request = Request::new(b'S');
        let moving = self.lanes.iter().map(|lane| u8::from(!lane.stands_still()));
        request.bytes(&moving.collect::<Vec<u8>>());
        for lane in &mut self.lanes {
            lane.load(&self.shared, since_s)?;
            request.numbers(&lane.memory.robot.loads);
        }
        let process = &mut self.process;
        process.ask(&request)?;
        for lane in &mut self.lanes {
            process.read_numbers(&mut lane.memory.robot.answer)?;
            lane.account(&self.shared);
        }
        Ok(())
    }
}

/// What the script is told first.
fn opening(shared: &Shared, lanes: usize) -> Request {
    let mut request = Request::new(b'0');
    request.u32(lanes);
    request.u32(shared.model.feet().len());
    let grid = shared.terrain.grid();
    request.u32(grid.map_or(0, |g| g.points()));
    request.numbers(&[grid.map_or(0.0, |g| g.size_m())]);
    for &height in grid.map_or(&[][..], |g| g.heights_m()) {
        request.numbers(&[f64::from(height)]);
    }
    request
}

impl Engine for MujocoEngine {
    fn terrain(&self) -> &Terrain {
        &self.shared.terrain
    }

    fn lanes(&self) -> usize {
        self.lanes.len()
    }

    fn model(&self) -> &RobotModel {
        &self.shared.model
    }

    fn config(&self) -> &EngineConfig {
        &self.shared.config
    }

    fn params(&self, lane: usize) -> &LaneParams {
        self.pending[lane].as_ref().unwrap_or(&self.lanes[lane].params)
    }

    fn set_params(&mut self, lane: usize, params: &LaneParams) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        params.validate(&self.shared.model, lane)?;
        // MuJoCo's model is made anew with them at the next reset or step, whichever comes first.
        self.pending[lane] = Some(params.clone());
        Ok(())
    }

    fn reset(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        init.validate(&self.shared.model, lane)?;
        let params = self.params(lane).clone();
        let process = &mut self.process;
        self.lanes[lane] = Lane::new(&self.shared, process, lane, params, init)?;
        self.pending[lane] = None;
        self.publish(lane);
        Ok(())
    }

    fn step(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        check_step(self, targets_rad, wrenches)?;
        self.take_pending()?;
        let width = self.shared.model.actuated().len();
        for (i, lane) in self.lanes.iter_mut().enumerate() {
            lane.begin(&targets_rad[i * width..][..width], &wrenches[i * WRENCH..][..WRENCH]);
        }
        for substep in 0..self.shared.config.substeps {
            self.substep(f64::from(substep) * self.shared.config.dt_s)?;
        }
        for lane in 0..self.lanes.len() {
            self.lanes[lane].end(&self.shared)?;
            self.publish(lane);
        }
        Ok(())
    }

    fn state(&self) -> &State {
        &self.state
    }

    /// Refused: going on from positions, velocities and warm start was not bit-exact.
    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        Err(cannot("from a snapshot"))
    }

    fn restore(&mut self, _bytes: &[u8]) -> Result<(), SimError> {
        Err(cannot("from a snapshot"))
    }
}
