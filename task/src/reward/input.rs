//! What reward terms and conditions look at.

use crate::{COMMAND_DIM, JointTable, PerFoot};

/// What the terms look at: the true state after a control step, without sensor noise.
#[derive(Clone, Copy, Debug)]
pub struct RewardInput<'a> {
    /// The joints' nominal pose and limits.
    pub joints: &'a JointTable,
    /// Length of the control step, s.
    pub dt_s: f32,
    /// Height of the foot reference at the top of the swing, m.
    pub swing_height_m: f32,
    /// Command that held during the step: vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Whether that command is to stand.
    pub standing: bool,
    /// Phase of each foot (of the clock without feet) after the step, rad, (−π, π].
    pub phase_rad: PerFoot,
    /// How far the heading is to the left of the course that the command holds, rad; 0 where it holds none.
    pub off_course_rad: f32,
    /// Velocity of the whole body's centre of mass, m/s, heading frame.
    pub com_vel_mps: [f32; 3],
    /// Height of the whole body's centre of mass above the ground under the feet, m.
    pub com_height_m: f32,
    /// Yaw rate of the whole body's equivalent rotation, rad/s.
    pub yaw_rate_radps: f32,
    /// Angular velocity of the body, rad/s, body frame.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, body frame.
    pub gravity: [f32; 3],
    /// Joint positions, rad.
    pub joint_pos_rad: &'a [f32],
    /// Joint velocities, rad/s.
    pub joint_vel_radps: &'a [f32],
    /// Joint velocities after the step before, rad/s.
    pub previous_joint_vel_radps: &'a [f32],
    /// Motor torques, mean over the step, N·m.
    pub motor_torque_nm: &'a [f32],
    /// Mechanical power of each motor, mean over the step, signed, W.
    pub mech_power_w: &'a [f32],
    /// Height of each foot's lowest point above the ground, m.
    pub foot_height_m: &'a [f32],
    /// Velocity of each foot, m/s, world.
    pub foot_vel_mps: &'a [[f32; 3]],
    /// Contact force on each foot, mean over the step, N, world.
    pub foot_force_n: &'a [[f32; 3]],
    /// Sum of contact forces on everything but the feet, N.
    pub trunk_force_n: f32,
    /// Force that pushes the trunk in this step, N, heading frame.
    pub push_n: [f32; 3],
    /// Friction coefficient of the feet.
    pub friction: f32,
    /// 1 while the whole body's centre of mass is below the water's surface, 0 otherwise.
    pub submerged: f32,
    /// 1 while it is that and the ground is out of reach (`task.afloat_above_m`), 0 otherwise.
    pub afloat: f32,
    /// Which feet can be asked to walk, 1 or 0: all of them on land, and in water those with the ground in
    /// reach.
    pub on_ground: PerFoot,
    /// Which joints move a leg.
    pub in_leg: &'a [bool],
    /// Which joints move the tail.
    pub in_tail: &'a [bool],
    /// Joint positions of the swimming pose, rad.
    pub swimming_rad: &'a [f32],
    /// Position targets of this step before they are cut off at the limits, rad.
    pub target_rad: &'a [f32],
    /// The action of this step, clipped.
    pub action: &'a [f32],
    /// The action of the step before, clipped.
    pub previous_action: &'a [f32],
}
