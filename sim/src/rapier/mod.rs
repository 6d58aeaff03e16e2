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

use crate::engine::WRENCH;
use crate::mobility::Mobility;
use crate::stop::Stop;
use crate::{Engine, EngineConfig, InitialState, Rig, SimError, Terrain};
use lane::Lane;
use shared::Shared;

/// Most lanes one engine takes; each needs about 0.25 MB of memory.
pub const MAX_RAPIER_LANES: usize = 65_536;

/// The Rapier engine.
pub struct RapierEngine {
    shared: Shared,
    lanes: Vec<Lane>,
    /// Lanes whose parameters have changed since they were built.
    stale: Vec<bool>,
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
        let rig = Rig::new(model, (lanes, MAX_RAPIER_LANES), config, terrain)?;
        let shared = Shared {
            stops: Stop::all(&rig.model, &rig.config)?,
            ground: world::height_field(&rig.terrain),
            mobility_per_kg: Mobility::of(&rig.model, &rig.config)?.links,
            grip: friction::Grip::new(Arc::clone(&rig.terrain)),
            rig,
        };
        let init = InitialState::nominal(&shared.rig.model);
        let built = shared.rig.params.iter().map(|p| Lane::new(&shared, p.clone(), &init));
        let mut engine = Self {
            lanes: built.collect::<Result<_, _>>()?,
            shared,
            stale: vec![false; lanes],
            threads: threads.clamp(1, lanes),
        };
        engine.publish_all();
        Ok(engine)
    }

    fn publish(&mut self, lane: usize) {
        self.shared.rig.state.copy_lane(lane, &self.lanes[lane].memory.out);
    }

    fn publish_all(&mut self) {
        (0..self.lanes.len()).for_each(|lane| self.publish(lane));
    }
}

impl Engine for RapierEngine {
    fn rig(&self) -> &Rig {
        &self.shared.rig
    }

    fn rig_mut(&mut self) -> &mut Rig {
        &mut self.shared.rig
    }

    /// The world is rebuilt with them at the next reset or step, whichever comes first.
    fn take_params(&mut self, lane: usize) {
        self.stale[lane] = true;
    }

    fn begin(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        self.lanes[lane] = Lane::new(&self.shared, self.params(lane).clone(), init)?;
        self.stale[lane] = false;
        self.publish(lane);
        Ok(())
    }

    fn advance(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        let width = self.model().actuated().len();
        for (number, lane) in self.lanes.iter_mut().enumerate() {
            if std::mem::take(&mut self.stale[number]) {
                lane.rebuild(&self.shared, self.shared.rig.params[number].clone())?;
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
        self.publish_all();
        Ok(())
    }

    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        snapshot::save(&self.shared, &self.lanes, &self.stale)
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        (self.lanes, self.shared.rig.params, self.stale) = snapshot::load(&self.shared, bytes)?;
        self.publish_all();
        Ok(())
    }
}
