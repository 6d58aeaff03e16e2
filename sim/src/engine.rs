//! The trait every engine implements.

use caudata_model::RobotModel;

use crate::error::check_len;
use crate::{EngineConfig, InitialState, LaneParams, SimError, State, Terrain};

/// A batch of independent robots ("lanes"), stepped together by control periods.
///
/// Lanes never influence each other. Results do not depend on the number of threads.
pub trait Engine: Send {
    /// Number of lanes `N`.
    fn lanes(&self) -> usize;

    /// The robot that every lane holds.
    fn model(&self) -> &RobotModel;

    /// Step sizes and solver settings.
    fn config(&self) -> &EngineConfig;

    /// The ground and water of all lanes.
    fn terrain(&self) -> &Terrain;

    /// The physical parameters lane `lane` runs with.
    ///
    /// # Panics
    /// When `lane >= self.lanes()`, like a slice.
    fn params(&self, lane: usize) -> &LaneParams;

    /// Changes one lane's physical parameters, at once. Positions and velocities stay.
    ///
    /// # Errors
    /// When the lane does not exist, an array has the wrong length or a value is not physical.
    fn set_params(&mut self, lane: usize, params: &LaneParams) -> Result<(), SimError>;

    /// Puts one lane into `init`, at rest inside (no contact memory, no delayed commands, not diverged).
    /// The same parameters and `init` always give the same bits, whatever the lane did before.
    ///
    /// # Errors
    /// When the lane does not exist or `init` does not fit the model.
    fn reset(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError>;

    /// One control period (`config().substeps` physics steps of `config().dt_s`) for all lanes.
    ///
    /// `targets_rad` `[N, A]`: position command of each actuated joint, held over the period (and delayed by
    /// the lane's `command_delay_s`). `wrenches` `[N, 6]`: force (N) and torque (N·m), both world frame,
    /// on the torso link at its centre of mass, held over the period.
    ///
    /// A lane whose targets or state turn non-finite is marked in [`State::diverged`] and stands still until
    /// reset.
    ///
    /// # Errors
    /// When an array has the wrong length.
    fn step(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError>;

    /// State after the last step or reset.
    fn state(&self) -> &State;

    /// Everything, including contact warm start and delayed commands: continuing from it is bit-exact
    /// in an engine built with the same model, lanes, configuration and terrain.
    ///
    /// # Errors
    /// When the state cannot be encoded.
    fn snapshot(&self) -> Result<Vec<u8>, SimError>;

    /// Takes over a [`snapshot`](Self::snapshot). On an error the engine is unchanged.
    ///
    /// # Errors
    /// When the bytes are damaged or belong to another model, lane count, configuration or terrain.
    fn restore(&mut self, bytes: &[u8]) -> Result<(), SimError>;
}

/// Values per lane of a wrench: force, torque.
pub(crate) const WRENCH: usize = 6;

/// What every engine checks before it is built.
pub(crate) fn check_new(
    model: &RobotModel,
    config: &EngineConfig,
    lanes: usize,
    most_lanes: usize,
) -> Result<(), SimError> {
    config.validate()?;
    crate::check_extension(model)?;
    let expected = lanes.clamp(1, most_lanes);
    check_len("lanes", lanes, expected)
}

/// What every engine checks of a step's arrays.
pub(crate) fn check_step(
    engine: &dyn Engine,
    targets_rad: &[f32],
    wrenches: &[f32],
) -> Result<(), SimError> {
    let (lanes, width) = (engine.lanes(), engine.model().actuated().len());
    check_len("targets_rad", targets_rad.len(), lanes * width)?;
    check_len("wrenches", wrenches.len(), lanes * WRENCH)
}
