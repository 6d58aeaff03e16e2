//! What one lane is given: physical parameters and a state to start from.

use caudata_model::{Joint, JointKind, RobotModel};
use serde::{Deserialize, Serialize};

use crate::SimError;
pub use crate::drive::command::MAX_COMMAND_DELAY_S;
pub use crate::drive::loop_delay::MAX_LOOP_DELAY_S;
pub use crate::drive::loss::CommandLoss;
pub use crate::effects::{EffectField, HingeEffects, JointEffects, LinkWater};
use crate::error::check_len;

/// Largest absolute position, velocity or angle an initial state may hold (m, m/s, rad, rad/s).
const MAX_INITIAL: f32 = 1000.0;

/// Smallest rotor inertia of a gear with play, kg·m²: a twentieth of a small servo's.
const MIN_ROTOR_KGM2: f32 = 1e-4;

/// One lane's physical parameters. Start from [`LaneParams::nominal`] and change what should differ.
///
/// `L` links, `A` actuated joints (policy order), `B` backlash hinges, `H` hinges without a servo (both model
/// order), `F` feet.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaneParams {
    /// Gravity, world, m/s². Nominal: the model's.
    pub gravity_mps2: [f32; 3],
    /// Coulomb friction coefficient between foot balls and the ground, 0..=10.
    pub foot_friction: f32,
    /// Factor on `foot_friction` of each foot, 0..=100. Nominal 1. `[F]`
    pub foot_friction_scale: Vec<f32>,
    /// Coulomb friction coefficient between everything else (belly, tail) and the ground, 0..=10.
    pub body_friction: f32,
    /// Factor on each link's mass and inertia, 0.01..=100. `[L]`
    pub link_mass_scale: Vec<f32>,
    /// Factor on each link's inertia about its centre of mass, on top of `link_mass_scale`, 0.01..=100.
    /// Nominal 1. `[L]`
    pub link_inertia_scale: Vec<f32>,
    /// Shift of each link's centre of mass in its own frame, m, each within ±1. `[L]`
    pub com_offset_m: Vec<[f32; 3]>,
    /// Mass of a payload on the torso link, kg, 0..=1000. It displaces no water. Nominal 0.
    pub payload_kg: f32,
    /// Where it is in the torso link's frame, m, each within ±10. Nominal 0.
    pub payload_m: [f32; 3],
    /// Coulomb friction of each actuated joint, N·m, 0..=100. `[A]`
    pub joint_friction_nm: Vec<f32>,
    /// Reflected rotor inertia of each actuated joint, kg·m², 0..=10. `[A]`
    pub joint_armature_kgm2: Vec<f32>,
    /// Viscous damping of each actuated joint, N·m·s/rad, 0..=100 (not the servo's Kd). `[A]`
    pub joint_damping_nms_per_rad: Vec<f32>,
    /// Servo proportional gain at the joint, N·m/rad, 0..=10000. `[A]`
    pub kp_nm_per_rad: Vec<f32>,
    /// Servo derivative gain at the joint, N·m·s/rad, 0..=100. `[A]`
    pub kd_nms_per_rad: Vec<f32>,
    /// Factor on every torque limit of the servo envelope, 0..=100. `[A]`
    pub torque_scale: Vec<f32>,
    /// Supply voltage, V, 0.1..=1000. The sloping part of the servo envelope moves with it.
    pub supply_v: f32,
    /// Resistance of battery and wiring, Ω, 0..=100: what all motors together take lowers the voltage of all.
    /// Nominal: the model's.
    pub supply_resistance_ohm: f32,
    /// Time constant with which the voltage follows, s, 0..=10. Nominal: the model's.
    pub supply_lag_s: f32,
    /// Delay from [`Engine::step`](crate::Engine::step)'s targets to the servo, s,
    /// 0..=[`MAX_COMMAND_DELAY_S`]; fractions of a physics step count.
    pub command_delay_s: f32,
    /// Command frames that never arrive. Nominal: none.
    pub command_loss: CommandLoss,
    /// Drive-line of each actuated joint. `[A]`
    pub joints: Vec<JointEffects>,
    /// Hinges without a servo. `[H]`
    pub hinges: Vec<HingeEffects>,
    /// Half of the free play of each backlash hinge, rad, 0..=1. `[B]`
    pub backlash_half_width_rad: Vec<f32>,
    /// Each link in water. `[L]`
    pub water: Vec<LinkWater>,
    /// How much higher the water's surface is than the terrain says, m, within ±100. Nominal 0.
    pub water_level_offset_m: f32,
    /// Velocity of the water, world, m/s, each within ±100. Nominal 0.
    pub water_current_mps: [f32; 3],
}

impl LaneParams {
    /// The robot file's values: no scaling, no offset, no delay, default supply; with what its `[extension]`
    /// has, where it has one.
    pub fn nominal(model: &RobotModel) -> Self {
        let mut params = Self::bare(model);
        params.extend(model);
        params
    }

    /// As [`LaneParams::nominal`] without the robot file's `[extension]`.
    pub fn bare(model: &RobotModel) -> Self {
        let per_servo = |f: &dyn Fn(usize) -> f64| -> Vec<f32> {
            (0..model.actuated().len()).map(|a| f(a) as f32).collect()
        };
        let actuated_joint = |a: usize| &model.joints()[model.actuated()[a]];
        Self {
            gravity_mps2: model.gravity_mps2().map(|g| g as f32),
            foot_friction: model.contact().foot_friction as f32,
            foot_friction_scale: vec![1.0; model.feet().len()],
            body_friction: model.contact().body_friction as f32,
            link_mass_scale: vec![1.0; model.links().len()],
            link_inertia_scale: vec![1.0; model.links().len()],
            com_offset_m: vec![[0.0; 3]; model.links().len()],
            payload_kg: 0.0,
            payload_m: [0.0; 3],
            joint_friction_nm: per_servo(&|a| actuated_joint(a).friction_loss_nm),
            joint_armature_kgm2: per_servo(&|a| actuated_joint(a).armature_kgm2),
            joint_damping_nms_per_rad: per_servo(&|a| actuated_joint(a).damping_nm_s_per_rad),
            kp_nm_per_rad: per_servo(&|a| model.kp_nm_per_rad(a)),
            kd_nms_per_rad: per_servo(&|a| model.kd_nm_s_per_rad(a)),
            torque_scale: per_servo(&|_| 1.0),
            supply_v: model.supply_v() as f32,
            supply_resistance_ohm: model.supply().resistance_ohm as f32,
            supply_lag_s: model.supply().lag_s as f32,
            command_delay_s: 0.0,
            command_loss: CommandLoss::default(),
            joints: (0..model.actuated().len())
                .map(|a| JointEffects::nominal(model.servo(a), actuated_joint(a)))
                .collect(),
            hinges: unactuated(model).map(HingeEffects::nominal).collect(),
            backlash_half_width_rad: backlash_joints(model)
                .map(|j| model.joints()[j].range_rad.map_or(0.0, |(_, high)| high) as f32)
                .collect(),
            water: (0..model.links().len())
                .map(|link| LinkWater::nominal(model.water(), link))
                .collect(),
            water_level_offset_m: 0.0,
            water_current_mps: [0.0; 3],
        }
    }

    /// Tilts the floor by turning gravity instead: a floor that rises by `pitch_rad` towards +x and by
    /// `roll_rad` towards +y.
    pub fn tilt_floor(&mut self, roll_rad: f32, pitch_rad: f32) {
        let g = self.gravity_mps2.iter().map(|g| g * g).sum::<f32>().sqrt();
        let (x, y) = (pitch_rad.tan(), roll_rad.tan());
        let down = g / (1.0 + x * x + y * y).sqrt();
        self.gravity_mps2 = [-down * x, -down * y, -down];
    }

    /// Checks lengths and ranges against `model`; `lane` goes into the error.
    ///
    /// # Errors
    /// [`SimError::Shape`] or [`SimError::Value`] naming the field.
    pub fn validate(&self, model: &RobotModel, lane: usize) -> Result<(), SimError> {
        let (a, l) = (model.actuated().len(), model.links().len());
        let offsets: Vec<f32> = self.com_offset_m.iter().flatten().copied().collect();
        let loss = &self.command_loss;
        let (feet, play) = (model.feet().len(), backlash_joints(model).count());
        // joints may slide: an axis on a ball screw has far more of all of it than a hinge
        #[rustfmt::skip]
        let checks: &[(&'static str, &[f32], usize, f32, f32)] = &[
            ("gravity_mps2", &self.gravity_mps2, 3, -1000.0, 1000.0),
            ("foot_friction", &[self.foot_friction], 1, 0.0, 10.0),
            ("foot_friction_scale", &self.foot_friction_scale, feet, 0.0, 100.0),
            ("body_friction", &[self.body_friction], 1, 0.0, 10.0),
            ("link_mass_scale", &self.link_mass_scale, l, 0.01, 100.0),
            ("link_inertia_scale", &self.link_inertia_scale, l, 0.01, 100.0),
            ("com_offset_m", &offsets, 3 * l, -1.0, 1.0),
            ("payload_kg", &[self.payload_kg], 1, 0.0, 1000.0),
            ("payload_m", &self.payload_m, 3, -10.0, 10.0),
            ("joint_friction_nm", &self.joint_friction_nm, a, 0.0, 1e4),
            ("joint_armature_kgm2", &self.joint_armature_kgm2, a, 0.0, 1e4),
            ("joint_damping_nms_per_rad", &self.joint_damping_nms_per_rad, a, 0.0, 1e5),
            ("kp_nm_per_rad", &self.kp_nm_per_rad, a, 0.0, 1e6),
            ("kd_nms_per_rad", &self.kd_nms_per_rad, a, 0.0, 1e5),
            ("torque_scale", &self.torque_scale, a, 0.0, 100.0),
            ("supply_v", &[self.supply_v], 1, 0.1, 1000.0),
            ("supply_resistance_ohm", &[self.supply_resistance_ohm], 1, 0.0, 100.0),
            ("supply_lag_s", &[self.supply_lag_s], 1, 0.0, 10.0),
            ("command_delay_s", &[self.command_delay_s], 1, 0.0, MAX_COMMAND_DELAY_S),
            ("command_loss.share", &[loss.share], 1, 0.0, 0.9),
            ("command_loss.burst", &[loss.burst], 1, 1.0, 100.0),
            ("water_level_offset_m", &[self.water_level_offset_m], 1, -100.0, 100.0),
            ("water_current_mps", &self.water_current_mps, 3, -100.0, 100.0),
            ("backlash_half_width_rad", &self.backlash_half_width_rad, play, 0.0, 1.0),
        ];
        for &(what, values, expected, low, high) in checks {
            check_values(what, values, expected, low, high, lane)?;
        }
        check_effects("joints", &self.joints, a, JointEffects::wrong, lane)?;
        let hinges = unactuated(model).count();
        check_effects("hinges", &self.hinges, hinges, HingeEffects::wrong, lane)?;
        check_effects("water", &self.water, l, LinkWater::wrong, lane)?;
        let stops = (self.joints.iter().map(|j| (j.low_rad, j.high_rad)))
            .chain(self.hinges.iter().map(|h| (h.low_rad, h.high_rad)));
        for (low, high) in stops {
            check_values("high_rad", &[high], 1, low, f32::INFINITY, lane)?;
        }
        // A rotor that is a body of its own needs inertia: its speed is divided by it.
        for (joint, armature) in self.joints.iter().zip(&self.joint_armature_kgm2) {
            if joint.gear_half_gap_rad > 0.0 || joint.gear_stiffness_nm_per_rad > 0.0 {
                let what = "joint_armature_kgm2 (of a joint with play or compliance in its gear)";
                check_values(what, &[*armature], 1, MIN_ROTOR_KGM2, 1e4, lane)?;
            }
        }
        Ok(())
    }
}

/// Where a lane starts. Start from [`InitialState::nominal`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InitialState {
    /// Position of the base link's origin on the ground plane, world, m.
    pub base_xy_m: [f32; 2],
    /// Height of the base link's origin, world, m. `None`: found so that the lowest geom just touches the
    /// terrain; in deeper water, the surface.
    pub base_z_m: Option<f32>,
    /// Roll, pitch, yaw of the base (R = Rz(yaw)·Ry(pitch)·Rx(roll)), rad.
    pub base_rpy_rad: [f32; 3],
    /// Velocity of the base link's origin, world, m/s.
    pub base_vel_mps: [f32; 3],
    /// Angular velocity of the base link, body frame, rad/s.
    pub base_angvel_radps: [f32; 3],
    /// Actuated joint positions, policy order, rad; also what the servos hold until a delayed command
    /// arrives. `[A]` (Passive and backlash hinges start at 0.)
    pub joint_pos_rad: Vec<f32>,
    /// Actuated joint velocities, policy order, rad/s. `[A]`
    pub joint_vel_radps: Vec<f32>,
}

impl InitialState {
    /// At rest in the nominal pose above the origin, facing +x.
    pub fn nominal(model: &RobotModel) -> Self {
        Self {
            base_xy_m: [0.0; 2],
            base_z_m: None,
            base_rpy_rad: [0.0; 3],
            base_vel_mps: [0.0; 3],
            base_angvel_radps: [0.0; 3],
            joint_pos_rad: model.nominal_pos_rad().iter().map(|&q| q as f32).collect(),
            joint_vel_radps: vec![0.0; model.actuated().len()],
        }
    }

    /// Checks lengths and ranges against `model`; `lane` goes into the error.
    ///
    /// # Errors
    /// [`SimError::Shape`] or [`SimError::Value`] naming the field.
    pub fn validate(&self, model: &RobotModel, lane: usize) -> Result<(), SimError> {
        let actuated = model.actuated().len();
        let checks: [(&'static str, &[f32], usize); 7] = [
            ("base_xy_m", &self.base_xy_m, 2),
            ("base_z_m", &[self.base_z_m.unwrap_or(0.0)], 1),
            ("base_rpy_rad", &self.base_rpy_rad, 3),
            ("base_vel_mps", &self.base_vel_mps, 3),
            ("base_angvel_radps", &self.base_angvel_radps, 3),
            ("joint_pos_rad", &self.joint_pos_rad, actuated),
            ("joint_vel_radps", &self.joint_vel_radps, actuated),
        ];
        for (what, values, expected) in checks {
            check_values(what, values, expected, -MAX_INITIAL, MAX_INITIAL, lane)?;
        }
        Ok(())
    }
}

/// Model indices of the backlash hinges, model order.
pub(crate) fn backlash_joints(model: &RobotModel) -> impl Iterator<Item = usize> + '_ {
    model.joints().iter().enumerate().filter(|(_, j)| j.kind == JointKind::Backlash).map(|(i, _)| i)
}

/// Hinges without a servo, model order.
pub(crate) fn unactuated(model: &RobotModel) -> impl Iterator<Item = &Joint> {
    model.joints().iter().filter(|j| !matches!(j.kind, JointKind::Actuated { .. }))
}

fn check_effects<T>(
    what: &'static str,
    all: &[T],
    expected: usize,
    wrong: impl Fn(&T) -> Option<(EffectField, f32)>,
    lane: usize,
) -> Result<(), SimError> {
    check_len(what, all.len(), expected)?;
    match all.iter().find_map(wrong) {
        Some((field, value)) => check_values(field.name, &[value], 1, field.low, field.high, lane),
        None => Ok(()),
    }
}

pub(crate) fn check_values(
    what: &'static str,
    values: &[f32],
    expected: usize,
    low: f32,
    high: f32,
    lane: usize,
) -> Result<(), SimError> {
    check_len(what, values.len(), expected)?;
    match values.iter().find(|v| !(low..=high).contains(*v)) {
        Some(&value) => Err(SimError::Value { what, value, lane, low, high }),
        None => Ok(()),
    }
}
