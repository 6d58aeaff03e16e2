//! The Rapier engine: one world per lane, the robot as a reduced-coordinates multibody.
//!
//! What of Rapier is used, and what is not (0.36.1, checked by tests):
//! - Armature, joint damping and joint springs of its multibodies are implicit and exact for a pendulum; they
//!   carry rotor inertia, passive springs, end stops and sticking friction. Its own limits, motors and
//!   dry-friction rows are not used: each costs a solve with the mass matrix per step.
//! - The servo's torque is a torque pair on the two bodies of its hinge, constant over a physics step
//!   (explicit). Rotor inertia keeps this stable: with 15 N·m/rad and 0.0022 kg·m², ω·dt is 0.33 at 4 ms, the
//!   limit being 2.
//! - Contacts are Rapier's own (Coulomb friction per point, warm started), between robot and ground, and with
//!   [`EngineConfig::self_collision`] between legs and trunk with their real shapes; but what surely slides
//!   on the ground has its friction from [`friction`].
//! - Continuous collision detection, sleeping, contact recycling and clustering are off.
//!
//! Cost and accuracy, measured before friction of what slides was taken from Rapier (an open-loop trot on
//! flat ground, one thread of a 2.7 GHz Xeon; travel and power over 10 s). MuJoCo 3 on the same MJCF and
//! servo goes 2.14 m with 6.90 W at 0.5 ms:
//!
//! | step, iterations | physics steps/s | times real time | travel, m | power, W |
//! |---|---|---|---|---|
//! | 10 ms, 1 | 8,000 | 80 | 1.95 | 7.04 |
//! | 5 ms, 1 | 8,000 | 40 | 2.04 | 6.68 |
//! | 4 ms, 1 | 8,000 | 32 | 2.09 | 6.64 |
//! | 4 ms, 2 | 4,400 | 18 | 2.13 | 6.70 |
//! | 4 ms, 4 | 2,300 | 9 | 2.17 | 6.71 |
//! | 2 ms, 1 | 8,200 | 16 | 2.15 | 6.59 |
//! | 0.5 ms, 1 | 8,300 | 4 | 2.15 | 6.67 |
//!
//! On rugged ground it makes 7,200. So time is better spent on smaller steps than on iterations. Two thirds
//! of it is the dense mass matrix; without the four play hinges ([`EngineConfig::lock_backlash`]) a step
//! costs two thirds. At 10 ms, feet driven hard into rough ground go through it.
//!
//! Same bits for any number of threads; across processors they may differ, as linear algebra kernels are
//! chosen at run time.

mod contacts;
mod convert;
mod friction;
mod lane;
mod robot;
mod shared;
mod snapshot;
mod tags;
mod water;
mod world;

use std::sync::Arc;

use caudata_model::RobotModel;

use crate::engine::{WRENCH, check_new, check_step};
use crate::error::check_lane;
use crate::mobility::Mobility;
use crate::stop::Stop;
use crate::{Engine, EngineConfig, InitialState, LaneParams, SimError, State, Terrain};
use lane::Lane;
use shared::Shared;

/// Most lanes one engine takes; each needs about 0.25 MB of memory.
pub const MAX_RAPIER_LANES: usize = 65_536;

/// The Rapier engine.
pub struct RapierEngine {
    shared: Shared,
    lanes: Vec<Lane>,
    /// Parameters set since the lane was last built.
    pending: Vec<Option<LaneParams>>,
    state: State,
    threads: usize,
}

impl RapierEngine {
    /// Builds `lanes` worlds, each robot at the origin in its nominal pose.
    ///
    /// # Errors
    /// When the configuration or the model cannot be simulated.
    pub fn new(
        model: Arc<RobotModel>,
        lanes: usize,
        config: EngineConfig,
        terrain: Arc<Terrain>,
        threads: usize,
    ) -> Result<Self, SimError> {
        check_new(&model, &config, lanes, MAX_RAPIER_LANES)?;
        let params = LaneParams::nominal(&model);
        let init = InitialState::nominal(&model);
        let state = State::of(&model, lanes);
        let shared = Shared {
            stops: Stop::all(&model, &config)?,
            ground: world::height_field(&terrain),
            mobility_per_kg: Mobility::of(&model, &config)?.links,
            grip: friction::Grip::new(Arc::clone(&terrain)),
            model,
            config,
            terrain,
        };
        let built = (0..lanes)
            .map(|_| Lane::new(&shared, params.clone(), &init))
            .collect::<Result<Vec<_>, _>>()?;
        let mut engine = Self {
            shared,
            lanes: built,
            pending: vec![None; lanes],
            state,
            threads: threads.clamp(1, lanes),
        };
        for lane in 0..lanes {
            engine.publish(lane);
        }
        Ok(engine)
    }

    fn publish(&mut self, lane: usize) {
        self.state.copy_lane(lane, &self.lanes[lane].memory.out);
    }
}

impl Engine for RapierEngine {
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
        // The world is rebuilt with them at the next reset or step, whichever comes first.
        self.pending[lane] = Some(params.clone());
        Ok(())
    }

    fn reset(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        init.validate(&self.shared.model, lane)?;
        let params = self.params(lane).clone();
        self.lanes[lane] = Lane::new(&self.shared, params, init)?;
        self.pending[lane] = None;
        self.publish(lane);
        Ok(())
    }

    fn step(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        let width = self.shared.model.actuated().len();
        check_step(self, targets_rad, wrenches)?;
        for (lane, pending) in self.lanes.iter_mut().zip(&mut self.pending) {
            if let Some(params) = pending.take() {
                lane.rebuild(&self.shared, params)?;
            }
        }
        let shared = &self.shared;
        // A joint-less robot has empty rows, which cannot be cut by width.
        let row = |i: usize| {
            (&targets_rad[i * width..(i + 1) * width], &wrenches[i * WRENCH..(i + 1) * WRENCH])
        };
        let share = self.lanes.len().div_ceil(self.threads);
        let run = |first: usize, part: &mut [Lane]| {
            for (i, lane) in part.iter_mut().enumerate() {
                let (targets, wrench) = row(first + i);
                lane.step(shared, targets, wrench);
            }
        };
        let (own, others) = self.lanes.split_at_mut(share);
        std::thread::scope(|scope| {
            for (k, part) in others.chunks_mut(share).enumerate() {
                let run = &run;
                scope.spawn(move || run((k + 1) * share, part));
            }
            run(0, own);
        });
        for lane in 0..self.lanes.len() {
            self.publish(lane);
        }
        Ok(())
    }

    fn state(&self) -> &State {
        &self.state
    }

    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        snapshot::save(&self.shared, &self.lanes, &self.pending)
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        (self.lanes, self.pending) = snapshot::load(&self.shared, bytes, self.lanes.len())?;
        for lane in 0..self.lanes.len() {
            self.publish(lane);
        }
        Ok(())
    }
}
