//! The trait every engine implements, and the per-lane inputs it takes.

use caudata_model::RobotModel;
use serde::{Deserialize, Serialize};

use crate::{EngineConfig, SimError, State};

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
    /// A lane whose targets or state turn non-finite is marked in [`State::diverged`] and stands still until reset.
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

/// One lane's physical parameters. Start from [`LaneParams::nominal`] and change what should differ.
///
/// `L` links, `A` actuated joints (policy order), `B` backlash hinges (in model order).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaneParams {
    /// Gravity, world, m/s². Nominal (0, 0, −9.81).
    pub gravity_mps2: [f32; 3],
    /// Coulomb friction coefficient between foot balls and the ground, 0..=4.
    pub foot_friction: f32,
    /// Coulomb friction coefficient between everything else and the ground, 0..=4.
    pub body_friction: f32,
    /// Factor on each link's mass and inertia, > 0. `[L]`
    pub link_mass_scale: Vec<f32>,
    /// Shift of each link's centre of mass in its own frame, m. `[L]`
    pub com_offset_m: Vec<[f32; 3]>,
    /// Coulomb friction of each actuated joint, N·m, >= 0. `[A]`
    pub joint_friction_nm: Vec<f32>,
    /// Reflected rotor inertia of each actuated joint, kg·m², >= 0. `[A]`
    pub joint_armature_kgm2: Vec<f32>,
    /// Viscous damping of each actuated joint, N·m·s/rad, >= 0 (not the servo's Kd). `[A]`
    pub joint_damping_nms_per_rad: Vec<f32>,
    /// Servo proportional gain at the joint, N·m/rad, >= 0. `[A]`
    pub kp_nm_per_rad: Vec<f32>,
    /// Servo derivative gain at the joint, N·m·s/rad, >= 0. `[A]`
    pub kd_nms_per_rad: Vec<f32>,
    /// Factor on every torque limit of the servo envelope, >= 0. `[A]`
    pub torque_scale: Vec<f32>,
    /// Supply voltage, V, > 0. The speeds of the servo envelope scale with it.
    pub supply_v: f32,
    /// Delay from [`Engine::step`]'s targets to the servo, s, 0..=[`MAX_COMMAND_DELAY_S`]. Fractions of a physics step
    /// are interpolated.
    pub command_delay_s: f32,
    /// Half of the free play of each backlash hinge, rad, >= 0. `[B]`
    pub backlash_half_width_rad: Vec<f32>,
}

/// Longest command delay an engine keeps history for, s.
pub const MAX_COMMAND_DELAY_S: f32 = 0.1;

/// Where a lane starts. Build with [`InitialState::nominal`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InitialState {
    /// Base position on the ground plane, world, m.
    pub base_xy_m: [f32; 2],
    /// Height of the base link's origin, m, world. `None`: as low as possible with every geom at or above the terrain
    /// (the lowest foot touches).
    pub base_z_m: Option<f32>,
    /// Roll, pitch, yaw of the base (applied yaw first, about body axes), rad.
    pub base_rpy_rad: [f32; 3],
    /// Velocity of the base link's origin, world, m/s.
    pub base_vel_mps: [f32; 3],
    /// Angular velocity of the base link, body frame, rad/s.
    pub base_angvel_radps: [f32; 3],
    /// Actuated joint positions, policy order, rad. `[A]` (passive and backlash hinges start at 0)
    pub joint_pos_rad: Vec<f32>,
    /// Actuated joint velocities, policy order, rad/s. `[A]`
    pub joint_vel_radps: Vec<f32>,
}
