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

use crate::engine::WRENCH;
use crate::stop::Stop;
use crate::{Engine, EngineConfig, InitialState, Rig, SimError, Terrain};
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
    /// Lanes whose parameters have changed since they were built.
    stale: Vec<bool>,
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
        let rig = Rig::new(model, (lanes, MAX_MUJOCO_LANES), config, terrain)?;
        if rig.config.self_collision {
            return Err(cannot("self_collision"));
        }
        if rig.terrain.has_patches() {
            return Err(cannot("slippery patches of ground"));
        }
        let shared = Shared { stops: Stop::all(&rig.model, &rig.config)?, rig };
        let mut engine = Self {
            process: Process::start(&opening(&shared))?,
            lanes: Vec::with_capacity(lanes),
            stale: vec![false; lanes],
            shared,
        };
        let init = InitialState::nominal(engine.model());
        for number in 0..lanes {
            let params = engine.params(number).clone();
            let process = &mut engine.process;
            let lane = Lane::new(&engine.shared, process, number, params, &init)?;
            engine.lanes.push(lane);
            engine.publish(number);
        }
        Ok(engine)
    }

    fn publish(&mut self, lane: usize) {
        self.shared.rig.state.copy_lane(lane, &self.lanes[lane].memory.out);
    }

    /// Builds lanes anew whose parameters have changed.
    fn take_stale(&mut self) -> Result<(), SimError> {
        for number in 0..self.lanes.len() {
            if std::mem::take(&mut self.stale[number]) {
                let (params, memory) =
                    (self.params(number).clone(), self.lanes[number].memory.clone());
                let (shared, process) = (&self.shared, &mut self.process);
                self.lanes[number] = Lane::from_memory(shared, process, number, params, memory)?;
            }
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
fn opening(shared: &Shared) -> Request {
    let mut request = Request::new(b'0');
    request.u32(shared.rig.params.len());
    request.u32(shared.rig.model.feet().len());
    let grid = shared.rig.terrain.grid();
    request.u32(grid.map_or(0, |g| g.points()));
    request.numbers(&[grid.map_or(0.0, |g| g.size_m())]);
    for &height in grid.map_or(&[][..], |g| g.heights_m()) {
        request.numbers(&[f64::from(height)]);
    }
    request
}

impl Engine for MujocoEngine {
    fn rig(&self) -> &Rig {
        &self.shared.rig
    }

    fn rig_mut(&mut self) -> &mut Rig {
        &mut self.shared.rig
    }

    /// MuJoCo's model is made anew with them at the next reset or step, whichever comes first.
    fn take_params(&mut self, lane: usize) {
        self.stale[lane] = true;
    }

    fn begin(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        let params = self.params(lane).clone();
        let process = &mut self.process;
        self.lanes[lane] = Lane::new(&self.shared, process, lane, params, init)?;
        self.stale[lane] = false;
        self.publish(lane);
        Ok(())
    }

    fn advance(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        self.take_stale()?;
        let width = self.model().actuated().len();
        for (i, lane) in self.lanes.iter_mut().enumerate() {
            lane.begin(&targets_rad[i * width..][..width], &wrenches[i * WRENCH..][..WRENCH]);
        }
        for substep in 0..self.shared.rig.config.substeps {
            self.substep(f64::from(substep) * self.shared.rig.config.dt_s)?;
        }
        for lane in 0..self.lanes.len() {
            self.lanes[lane].end(&self.shared)?;
            self.publish(lane);
        }
        Ok(())
    }

    /// Refused: going on from positions, velocities and warm start was not bit-exact.
    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        Err(cannot("from a snapshot"))
    }

    fn restore(&mut self, _bytes: &[u8]) -> Result<(), SimError> {
        Err(cannot("from a snapshot"))
    }
}
