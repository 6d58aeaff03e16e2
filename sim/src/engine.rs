//! The trait every engine implements.

use std::sync::Arc;

use caudata_model::RobotModel;

use crate::error::{check_lane, check_len};
use crate::{EngineConfig, InitialState, LaneParams, SimError, State, Terrain};

/// What every engine holds of its lanes.
#[derive(Clone)]
pub struct Rig {
    /// The robot that every lane holds.
    pub model: Arc<RobotModel>,
    /// Step sizes and solver settings.
    pub config: EngineConfig,
    /// The ground and water of all lanes.
    pub terrain: Arc<Terrain>,
    /// What each lane runs with from its next step on.
    pub params: Vec<LaneParams>,
    /// After the last step or reset.
    pub state: State,
}

impl Rig {
    /// Lanes with the robot file's parameters.
    ///
    /// # Errors
    /// When there are none or more than `most_lanes`, or the configuration or the model cannot be simulated.
    pub(crate) fn new(
        model: Arc<RobotModel>,
        (lanes, most_lanes): (usize, usize),
        config: EngineConfig,
        terrain: Arc<Terrain>,
    ) -> Result<Self, SimError> {
        config.validate()?;
        crate::check_extension(&model)?;
        check_len("lanes", lanes, lanes.clamp(1, most_lanes))?;
        let params = vec![LaneParams::nominal(&model); lanes];
        Ok(Self { state: State::of(&model, lanes), model, config, terrain, params })
    }
}

/// A batch of independent robots ("lanes"), stepped together by control periods.
///
/// Lanes never influence each other. Results do not depend on the number of threads.
pub trait Engine: Send {
    /// What it holds of its lanes.
    fn rig(&self) -> &Rig;

    /// The same, to be changed by the provided methods alone.
    fn rig_mut(&mut self) -> &mut Rig;

    /// Number of lanes `N`.
    fn lanes(&self) -> usize {
        self.rig().params.len()
    }

    /// The robot that every lane holds.
    fn model(&self) -> &RobotModel {
        &self.rig().model
    }

    /// Step sizes and solver settings.
    fn config(&self) -> &EngineConfig {
        &self.rig().config
    }

    /// The ground and water of all lanes.
    fn terrain(&self) -> &Terrain {
        &self.rig().terrain
    }

    /// The physical parameters lane `lane` runs with.
    ///
    /// # Panics
    /// When `lane >= self.lanes()`, like a slice.
    fn params(&self, lane: usize) -> &LaneParams {
        &self.rig().params[lane]
    }

    /// Changes one lane's physical parameters, at once. Positions and velocities stay.
    ///
    /// # Errors
    /// When the lane does not exist, an array has the wrong length or a value is not physical.
    fn set_params(&mut self, lane: usize, params: &LaneParams) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        params.validate(self.model(), lane)?;
        self.rig_mut().params[lane].clone_from(params);
        self.take_params(lane);
        Ok(())
    }

    /// Lane `lane` of the rig has other parameters.
    fn take_params(&mut self, lane: usize);

    /// Puts one lane into `init`, at rest inside (no contact memory, no delayed commands, not diverged).
    /// The same parameters and `init` always give the same bits, whatever the lane did before.
    ///
    /// # Errors
    /// When the lane does not exist or `init` does not fit the model.
    fn reset(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError> {
        check_lane(lane, self.lanes())?;
        init.validate(self.model(), lane)?;
        self.begin(lane, init)
    }

    /// [`reset`](Self::reset) of a lane that there is, into a state that fits.
    ///
    /// # Errors
    /// As [`reset`](Self::reset).
    fn begin(&mut self, lane: usize, init: &InitialState) -> Result<(), SimError>;

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
    fn step(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError> {
        let (lanes, width) = (self.lanes(), self.model().actuated().len());
        check_len("targets_rad", targets_rad.len(), lanes * width)?;
        check_len("wrenches", wrenches.len(), lanes * WRENCH)?;
        self.advance(targets_rad, wrenches)
    }

    /// [`step`](Self::step) with arrays that fit.
    ///
    /// # Errors
    /// As [`step`](Self::step).
    fn advance(&mut self, targets_rad: &[f32], wrenches: &[f32]) -> Result<(), SimError>;

    /// State after the last step or reset.
    fn state(&self) -> &State {
        &self.rig().state
    }

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
