//! What an engine reports after a control period: structure of arrays, row-major `[N, k]`, f32, SI.

use serde::{Deserialize, Serialize};

/// State of all lanes after the last [`step`](crate::Engine::step) or [`reset`](crate::Engine::reset).
///
/// `N` lanes, `J` joints in model order (every hinge), `A` actuated joints in policy order, `F` feet
/// (FL, FR, HL, HR). Quaternions are w, x, y, z and turn body vectors into world vectors. World: z up.
/// The base is the root link. Means are over the last control period; right after a reset they are 0.
/// Every value is finite: a lane that diverged keeps its last finite values and has `diverged` set.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct State {
    /// Number of lanes `N`.
    pub lanes: usize,
    /// Number of hinges `J`.
    pub joints: usize,
    /// Number of actuated joints `A`.
    pub actuated: usize,
    /// Number of feet `F`.
    pub feet: usize,
    /// Origin of the base link, world, m. `[N, 3]`
    pub base_pos_m: Vec<f32>,
    /// Orientation of the base link, world_from_body. `[N, 4]`
    pub base_quat_wxyz: Vec<f32>,
    /// Velocity of the base link's origin, world, m/s. `[N, 3]`
    pub base_vel_mps: Vec<f32>,
    /// Angular velocity of the base link, body frame, rad/s. `[N, 3]`
    pub base_angvel_radps: Vec<f32>,
    /// Hinge positions, model order, rad. `[N, J]`
    pub joint_pos_rad: Vec<f32>,
    /// Hinge velocities, model order, rad/s. `[N, J]`
    pub joint_vel_radps: Vec<f32>,
    /// Motor torque after the servo envelope, mean over the period, policy order, N·m. `[N, A]`
    pub motor_torque_nm: Vec<f32>,
    /// Mechanical power q̇·τ of each motor, mean over the period (signed), W. `[N, A]`
    pub mech_power_w: Vec<f32>,
    /// Centre of mass of the whole robot, world, m. `[N, 3]`
    pub com_pos_m: Vec<f32>,
    /// Velocity of that centre of mass, world, m/s. `[N, 3]`
    pub com_vel_mps: Vec<f32>,
    /// Equivalent angular velocity I⁻¹L of the whole robot about its centre of mass, world, rad/s. `[N, 3]`
    pub com_angvel_radps: Vec<f32>,
    /// Yaw of the horizontal line from the hind girdle to the front girdle, rad, (−π, π]. `[N, 1]`
    pub heading_rad: Vec<f32>,
    /// Centres of the foot balls, world, m. `[N, F, 3]`
    pub foot_pos_m: Vec<f32>,
    /// Velocities of those centres, world, m/s. `[N, F, 3]`
    pub foot_vel_mps: Vec<f32>,
    /// Height of the foot ball's lowest point above the terrain below its centre, m. `[N, F]`
    pub foot_height_m: Vec<f32>,
    /// Contact force on each foot from everything it touches, mean over the period, world, N. `[N, F, 3]`
    pub foot_force_n: Vec<f32>,
    /// Sum of normal contact forces on links that carry feet, the feet themselves left out
    /// ([`RobotModel::carries_feet`](caudata_model::RobotModel::carries_feet)), mean over the period, N. `[N, 1]`
    pub trunk_force_n: Vec<f32>,
    /// Sum of normal contact forces on links that carry no feet (the tail), mean over the period, N. `[N, 1]`
    pub tail_force_n: Vec<f32>,
    /// Angular velocity in the IMU frame, rad/s. `[N, 3]`
    pub imu_gyro_radps: Vec<f32>,
    /// Specific force in the IMU frame (at rest: +g along up), m/s². Mean over the period: the change of
    /// the IMU point's velocity divided by the period, minus gravity, turned by the final orientation. `[N, 3]`
    pub imu_acc_mps2: Vec<f32>,
    /// Unit vector of gravity in the IMU frame (level: 0, 0, −1). `[N, 3]`
    pub imu_gravity: Vec<f32>,
    /// Whether the lane's simulation broke down; sticky until the lane's next reset. `[N]`
    pub diverged: Vec<bool>,
}

impl State {
    /// All zeros in the given shape.
    #[must_use]
    pub fn zeros(lanes: usize, joints: usize, actuated: usize, feet: usize) -> Self {
        let z = |k: usize| vec![0.0_f32; lanes * k];
        Self {
            lanes,
            joints,
            actuated,
            feet,
            base_pos_m: z(3),
            base_quat_wxyz: z(4),
            base_vel_mps: z(3),
            base_angvel_radps: z(3),
            joint_pos_rad: z(joints),
            joint_vel_radps: z(joints),
            motor_torque_nm: z(actuated),
            mech_power_w: z(actuated),
            com_pos_m: z(3),
            com_vel_mps: z(3),
            com_angvel_radps: z(3),
            heading_rad: z(1),
            foot_pos_m: z(feet * 3),
            foot_vel_mps: z(feet * 3),
            foot_height_m: z(feet),
            foot_force_n: z(feet * 3),
            trunk_force_n: z(1),
            tail_force_n: z(1),
            imu_gyro_radps: z(3),
            imu_acc_mps2: z(3),
            imu_gravity: z(3),
            diverged: vec![false; lanes],
        }
    }

    /// Copies the only lane of `from` over lane `lane` of `self`; both have the same shape otherwise.
    pub(crate) fn copy_lane(&mut self, lane: usize, from: &Self) {
        self.diverged[lane] = from.diverged[0];
        for (to, from) in self.fields_mut().into_iter().zip(from.fields()) {
            let k = from.len();
            to[lane * k..(lane + 1) * k].copy_from_slice(from);
        }
    }

    /// Whether every number is finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.fields()
            .iter()
            .all(|f| f.iter().all(|v| v.is_finite()))
    }

    /// Every numeric field, in the order of declaration.
    #[must_use]
    pub fn fields(&self) -> [&[f32]; FIELDS] {
        [
            &self.base_pos_m,
            &self.base_quat_wxyz,
            &self.base_vel_mps,
            &self.base_angvel_radps,
            &self.joint_pos_rad,
            &self.joint_vel_radps,
            &self.motor_torque_nm,
            &self.mech_power_w,
            &self.com_pos_m,
            &self.com_vel_mps,
            &self.com_angvel_radps,
            &self.heading_rad,
            &self.foot_pos_m,
            &self.foot_vel_mps,
            &self.foot_height_m,
            &self.foot_force_n,
            &self.trunk_force_n,
            &self.tail_force_n,
            &self.imu_gyro_radps,
            &self.imu_acc_mps2,
            &self.imu_gravity,
        ]
    }

    pub(crate) fn fields_mut(&mut self) -> [&mut [f32]; FIELDS] {
        self.parts_mut().0
    }

    /// Every numeric field, in the order of declaration, and the marks of lanes that diverged.
    pub(crate) fn parts_mut(&mut self) -> ([&mut [f32]; FIELDS], &mut [bool]) {
        let fields: [&mut [f32]; FIELDS] = [
            &mut self.base_pos_m,
            &mut self.base_quat_wxyz,
            &mut self.base_vel_mps,
            &mut self.base_angvel_radps,
            &mut self.joint_pos_rad,
            &mut self.joint_vel_radps,
            &mut self.motor_torque_nm,
            &mut self.mech_power_w,
            &mut self.com_pos_m,
            &mut self.com_vel_mps,
            &mut self.com_angvel_radps,
            &mut self.heading_rad,
            &mut self.foot_pos_m,
            &mut self.foot_vel_mps,
            &mut self.foot_height_m,
            &mut self.foot_force_n,
            &mut self.trunk_force_n,
            &mut self.tail_force_n,
            &mut self.imu_gyro_radps,
            &mut self.imu_acc_mps2,
            &mut self.imu_gravity,
        ];
        (fields, &mut self.diverged)
    }
}

/// Number of numeric fields of [`State`].
pub(crate) const FIELDS: usize = 21;
