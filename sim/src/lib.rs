//! Physics: engines behind one batch-first trait, servo, terrain, sensors.
//!
//! [`Engine`] steps `N` independent lanes, each one robot in its own world, by one control period at a time.
//! [`build`] is the one factory. Around it, formulas over [`real::Real`]: [`drive`] (from command to joint
//! torque), [`water`] (a link in water); and pure functions: [`terrain`] (ground height), [`sensors`] (what
//! encoders, IMU and current sensing make of a state).
//!
//! Invariant: nothing here knows a network, a clock or a file being watched; the same seed, lane
//! parameters and commands give the same bits for any number of threads.

pub mod batch;
pub mod config;
pub mod drive;
pub mod effects;
pub mod engine;
pub mod error;
pub mod extension;
mod mobility;
pub mod momenta;
pub mod mujoco;
mod observe;
pub mod params;
pub mod per_lane;
pub mod rapier;
pub use caudata_lanes::real;
mod self_contact;
pub mod sensors;
pub(crate) use caudata_lanes::simd;
mod snapshot;
pub mod state;
pub mod stop;
pub mod terrain;
pub mod water;

use std::sync::Arc;

use caudata_model::RobotModel;

pub use config::{EngineConfig, EngineKind, Precision};
pub use engine::{Engine, Rig};
pub use error::SimError;
pub use extension::check_extension;
pub use momenta::Momenta;
pub use params::{
    CommandLoss, HingeEffects, InitialState, JointEffects, LaneParams, LinkWater,
    MAX_COMMAND_DELAY_S, MAX_LOOP_DELAY_S,
};
pub use state::State;
pub use terrain::{HeightGrid, Terrain, TerrainConfig, TerrainKind};

/// Builds the engine that `config.kind` names, `lanes` robots on one terrain.
///
/// `seed` draws the terrain (nothing else here is random); `threads` splits the lanes over that many
/// threads (at least one, at most one per lane) and never changes a result. Every lane starts with
/// [`LaneParams::nominal`] in its nominal pose at the origin.
///
/// # Errors
/// [`SimError`] when a configuration value is out of range, the model cannot be built, or there is water and
/// the robot file does not say how it acts.
pub fn build(
    model: Arc<RobotModel>,
    lanes: usize,
    config: &EngineConfig,
    terrain: &TerrainConfig,
    seed: u64,
    threads: usize,
) -> Result<Box<dyn Engine>, SimError> {
    let terrain = Arc::new(Terrain::generate(terrain, seed)?);
    terrain.check_robot(&model)?;
    macro_rules! engine {
        ($engine:ty) => {
            Ok(Box::new(<$engine>::new(model, lanes, config.clone(), terrain, threads)?))
        };
    }
    match config.kind {
        EngineKind::Batch => engine!(batch::BatchEngine),
        EngineKind::Rapier => engine!(rapier::RapierEngine),
        EngineKind::Mujoco => engine!(mujoco::MujocoEngine),
    }
}
