//! The batch engine: many robots in the lanes of vector registers.
//!
//! Lanes are stepped together in groups of 16 (AVX-512), 8 (AVX2), 4 (SSE 4.1, NEON) or 1, whichever the
//! processor has ([`EngineConfig::lane_width`] chooses another). The robot is compiled once ([`program`]); a
//! control period of a group is one call ([`period`]): kinematics outwards ([`kinematics`]) with ground
//! contact ([`contact`]), joint loads ([`crate::drive`]), the articulated-body algorithm inwards and outwards
//! ([`aba`]), semi-implicit Euler; at its end the report ([`report`]). Nothing branches on a lane's values
//! except to skip work that would add nothing to any lane, so a lane's result depends neither on its place
//! nor on its neighbours.
//!
//! Limits: hinges and slides, [`program::MAX_JOINTS`] of them; contact of balls, capsules, boxes and
//! cylinders with the ground as [`program`] describes, and of balls with balls of the robot itself
//! ([`pairs`]); drive-lines as in [`crate::drive`], water as in [`crate::water`].
//!
//! Cost: `caudata bench sim`, with the time split by phase; accuracy: `caudata sim verify`.
//! docs/reference/simulation.md has the figures.

mod aba;
mod clock;
mod contact;
mod contact_law;
mod convex;
mod core;
mod cores;
mod frame;
mod ground;
mod group;
mod integrate;
mod kinematics;
mod pairs;
mod period;
mod place;
mod pool;
pub mod program;
mod readout;
mod report;
mod rounded;
mod shared;
pub mod smooth;
pub(crate) mod vec3;
mod wet;

use std::sync::Arc;

use caudata_model::RobotModel;

pub use self::clock::{Phase, PhaseSeconds};
use self::core::{Core, CoreOf, LaneState, Start};
pub use self::readout::Readout;
use crate::config::Precision;
use crate::drive::loop_memory_steps;
use crate::error::{check_lane, check_len};
use crate::observe::Coordinates;
use crate::params::check_values;
use crate::simd::Width;
use crate::snapshot::{Owner, refused};
use crate::{Engine, EngineConfig, InitialState, LaneParams, Rig, SimError, State, Terrain};

/// Most lanes one engine takes; each needs about 20 kB of memory.
pub const MAX_LANES: usize = 1 << 20;

/// Largest torque that is fed to a joint, N·m.
const MOST_NM: f32 = 1e6;

/// Changes whenever what a snapshot holds does.
const BATCH_FORMAT: &str = "caudata-batch-7";

/// The batch engine.
pub struct BatchEngine {
    rig: Rig,
    terrain_mark: u64,
    core: Box<dyn Core>,
    pool: pool::Pool,
}

impl BatchEngine {
    /// Builds `lanes` robots, each at the origin in its nominal pose.
    ///
    /// # Errors
    /// When the configuration or the model cannot be simulated, or the processor lacks the lane width asked
    /// for.
    pub fn new(
        model: Arc<RobotModel>,
        lanes: usize,
        config: EngineConfig,
        terrain: Arc<Terrain>,
        threads: usize,
    ) -> Result<Self, SimError> {
        let rig = Rig::new(model, (lanes, MAX_LANES), config, terrain)?;
        let width = width(&rig.config)?;
        let threads = threads.clamp(1, lanes.div_ceil(width.lanes()));
        let mut engine = Self {
            terrain_mark: rig.terrain.fingerprint(),
            core: build_core(&rig, threads, width)?,
            pool: pool::Pool::new(threads),
            rig,
        };
        for lane in 0..lanes {
            engine.take_params(lane);
        }
        let init = InitialState::nominal(engine.model());
        for lane in 0..lanes {
            engine.reset(lane, &init)?;
        }
        Ok(engine)
    }

    /// Starts to time the phases of the steps that follow, from zero.
    pub fn time_phases(&mut self) {
        self.core.time_phases();
    }

    /// Seconds that the steps since [`time_phases`](Self::time_phases) spent in each phase, over all threads;
    /// zeros without it.
    pub fn phase_seconds(&self) -> PhaseSeconds {
        self.core.phase_seconds()
    }

    /// From the next step on, works out and reports only what is in `readout`. A new engine reports
    /// everything.
    pub fn report_only(&mut self, readout: Readout) {
        self.core.report_only(readout);
    }

    /// Puts a lane's base and actuated joints where `init` says, in the middle of its motion. What nobody can
    /// measure stays as it is: hinges without a servo, what friction, loops, filters and contacts remember.
    ///
    /// # Errors
    /// As [`Engine::reset`].
    pub fn correct(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        init.validate(self.model(), lane)?;
        let at = Coordinates::start(&self.rig, init)?;
        let rig = &mut self.rig;
        let start = start_of(&rig.params[lane], init, &at);
        self.core.correct(lane, &start, rig.model.actuated(), &mut rig.state);
        Ok(())
    }

    /// Until the lane's parameters are next set: torques that are commanded beside the positions (policy order, N·m),
    /// which the servos' loops add to their own, and torques from outside on joints (model order, N·m; of a slide, N).
    ///
    /// # Errors
    /// [`SimError`] where the lane, a length or a number is wrong.
    pub fn feed(
        &mut self,
        lane: usize,
        commanded_nm: &[f32],
        outer_nm: &[f32],
    ) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        check_len("commanded_nm", commanded_nm.len(), self.model().actuated().len())?;
        check_len("outer_nm", outer_nm.len(), self.model().joints().len())?;
        for (what, values) in [("commanded_nm", commanded_nm), ("outer_nm", outer_nm)] {
            check_values(what, values, values.len(), -MOST_NM, MOST_NM, lane)?;
        }
        self.core.feed(lane, commanded_nm, outer_nm);
        Ok(())
    }

    /// How far each servo's rotor is ahead of its joint behind play or a spring in a lane, policy order, rad. `[A]`
    pub fn rotor_leads_rad(&self, lane: usize) -> Vec<f32> {
        self.core.rotor_leads_rad(lane)
    }

    fn owner(&self) -> Owner<'_> {
        Owner {
            format: BATCH_FORMAT,
            model_hash: self.model().hash(),
            config: self.config(),
            terrain: self.terrain_mark,
            lanes: self.lanes(),
        }
    }
}

/// The width asked for, or the widest that the processor has.
fn width(config: &EngineConfig) -> Result<Width, SimError> {
    let refused = |reason| SimError::Config {
        table: "engine",
        field: "lane_width",
        value: config.lane_width.to_string(),
        reason,
    };
    if config.precision == Precision::Double {
        return match config.lane_width {
            0 | 1 => Ok(Width::One),
            _ => Err(refused("must be 0 or 1 with engine.precision = \"double\"")),
        };
    }
    if config.lane_width == 0 {
        return Ok(Width::best());
    }
    let width = Width::of(config.lane_width).ok_or_else(|| refused("must be 0, 1, 4, 8 or 16"))?;
    if !width.is_available() {
        return Err(refused("this processor lacks the instructions for it; 0 chooses"));
    }
    Ok(width)
}

fn start_of<'a>(params: &LaneParams, init: &'a InitialState, at: &'a Coordinates) -> Start<'a> {
    let ([x, y, z], [w, i, j, k]) = (at.world_from_base.pos_m, at.world_from_base.quat_wxyz);
    let ([vx, vy, vz], [wx, wy, wz]) = (at.base_vel_mps, at.base_angvel_radps);
    Start {
        pose: [x, y, z, w, i, j, k],
        motion: [vx, vy, vz, wx, wy, wz],
        joint_pos: &at.joint_pos_rad,
        bus_v: f64::from(params.supply_v),
        servo_vel: &init.joint_vel_radps,
        joint_vel: &at.joint_vel_radps,
        rest: &init.joint_pos_rad,
    }
}

fn build_core(rig: &Rig, threads: usize, width: Width) -> Result<Box<dyn Core>, SimError> {
    let (model, config, lanes) = (&*rig.model, &rig.config, rig.params.len());
    macro_rules! of {
        ($number:ty) => {
            Ok(Box::new(CoreOf::<$number>::new(model, lanes, config, &rig.terrain, threads)?))
        };
    }
    if config.precision == Precision::Double {
        return of!(f64);
    }
    match width {
        #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
        Width::Four => of!(crate::simd::F32x4),
        #[cfg(target_arch = "x86_64")]
        Width::Eight => of!(crate::simd::F32x8),
        #[cfg(target_arch = "x86_64")]
        Width::Sixteen => of!(crate::simd::F32x16),
        _ => of!(f32),
    }
}

impl Engine for BatchEngine {
    fn rig(&self) -> &Rig {
        &self.rig
    }

    fn rig_mut(&mut self) -> &mut Rig {
        &mut self.rig
    }

    fn take_params(&mut self, lane: usize) {
        let rig = &self.rig;
        self.core.set_params(lane, &rig.model, &rig.config, &rig.params[lane]);
    }

    fn begin(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        let at = Coordinates::start(&self.rig, init)?;
        let start = start_of(&self.rig.params[lane], init, &at);
        self.core.reset(lane, &start, &mut self.rig.state);
        Ok(())
    }

    fn advance(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        self.core.step(&self.pool, targets_rad, wrenches, &mut self.rig.state);
        Ok(())
    }

    fn snapshot(&self) -> Result<Vec<u8>, SimError> {
        let lanes: Vec<_> = (0..self.lanes()).map(|l| self.core.get(l)).collect();
        self.owner().save(&(&self.rig.params, lanes, &self.rig.state))
    }

    fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError> {
        let (params, lanes, state): (Vec<LaneParams>, Vec<LaneState>, State) =
            self.owner().load(bytes)?;
        let count = self.lanes();
        if [params.len(), lanes.len(), state.lanes] != [count; 3] {
            return Err(refused("it has another number of lanes"));
        }
        for (lane, p) in params.iter().enumerate() {
            p.validate(self.model(), lane)?;
        }
        let fits = |(lane, p)| {
            let steps = loop_memory_steps(p, self.config().dt_s);
            self.core.fits(lane, steps)
        };
        if !lanes.iter().zip(&params).all(fits) {
            return Err(refused("its lanes have another layout"));
        }
        for (lane, (p, from)) in params.iter().zip(&lanes).enumerate() {
            self.core.set_params(lane, &self.rig.model, &self.rig.config, p);
            if !self.core.put(lane, from) {
                return Err(refused("its lanes have another layout"));
            }
        }
        (self.rig.params, self.rig.state) = (params, state);
        Ok(())
    }
}
