//! What an engine reports after a control period: structure of arrays, row-major `[N, k]`, f32, SI.

use caudata_model::RobotModel;
use serde::{Deserialize, Serialize};

/// Declares [`State`]: its numeric fields, and how many numbers of each a lane has.
macro_rules! state {
    (
        ($joints:ident, $actuated:ident, $feet:ident)
        $(#[$about:meta])* pub struct State { $($(#[$field_about:meta])* $field:ident: $width:expr,)+ }
    ) => {
        $(#[$about])*
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
            $($(#[$field_about])* pub $field: Vec<f32>,)+
            /// Whether the lane's simulation broke down; sticky until the lane's next reset. `[N]`
            pub diverged: Vec<bool>,
        }

        /// Number of numeric fields of [`State`].
        pub(crate) const FIELDS: usize = [$(stringify!($field)),+].len();

        /// Numbers per lane of each field of [`State`], in its order.
        pub(crate) fn widths($joints: usize, $actuated: usize, $feet: usize) -> [usize; FIELDS] {
            [$($width),+]
        }

        impl State {
            /// All zeros in the given shape.
            pub fn zeros(lanes: usize, $joints: usize, $actuated: usize, $feet: usize) -> Self {
                Self {
                    lanes,
                    joints: $joints,
                    actuated: $actuated,
                    feet: $feet,
                    $($field: vec![0.0; lanes * $width],)+
                    diverged: vec![false; lanes],
                }
            }

            /// Every numeric field, in the order of declaration.
            pub fn fields(&self) -> [&[f32]; FIELDS] {
                [$(&self.$field),+]
            }

            /// Every numeric field, in the order of declaration, and the marks of lanes that diverged.
            pub(crate) fn parts_mut(&mut self) -> ([&mut [f32]; FIELDS], &mut [bool]) {
                ([$(&mut self.$field),+], &mut self.diverged)
            }
        }
    };
}

state! {
    (joints, actuated, feet)
    /// State of all lanes after the last [`step`](crate::Engine::step) or [`reset`](crate::Engine::reset).
    ///
    /// `N` lanes, `J` joints in model order (every hinge), `A` actuated joints in policy order, `F` feet
    /// (FL, FR, HL, HR). Quaternions are w, x, y, z and turn body vectors into world vectors. World: z up.
    /// The base is the root link. Means are over the last control period; right after a reset they are 0.
    /// Every value is finite: a lane that diverged keeps its last finite values and has `diverged` set.
    pub struct State {
        /// Origin of the base link, world, m. `[N, 3]`
        base_pos_m: 3,
        /// Orientation of the base link, world_from_body. `[N, 4]`
        base_quat_wxyz: 4,
        /// Velocity of the base link's origin, world, m/s. `[N, 3]`
        base_vel_mps: 3,
        /// Angular velocity of the base link, body frame, rad/s. `[N, 3]`
        base_angvel_radps: 3,
        /// Hinge positions, model order, rad. `[N, J]`
        joint_pos_rad: joints,
        /// Hinge velocities, model order, rad/s. `[N, J]`
        joint_vel_radps: joints,
        /// Motor torque after the servo envelope, mean over the period, policy order, N·m. `[N, A]`
        motor_torque_nm: actuated,
        /// Mechanical power q̇·τ of each motor, mean over the period (signed), W. `[N, A]`
        mech_power_w: actuated,
        /// How far each joint's encoder is ahead of it, policy order, rad: something where it is on the motor,
        /// behind play or a spring. `[N, A]`
        encoder_ahead_rad: actuated,
        /// How much faster it is, rad/s. `[N, A]`
        encoder_ahead_radps: actuated,
        /// Centre of mass of the whole robot, world, m. `[N, 3]`
        com_pos_m: 3,
        /// Velocity of that centre of mass, world, m/s. `[N, 3]`
        com_vel_mps: 3,
        /// Equivalent angular velocity I⁻¹L of the whole robot about its centre of mass, world, rad/s.
        /// `[N, 3]`
        com_angvel_radps: 3,
        /// Yaw of the horizontal line from the hind girdle to the front girdle, rad, (−π, π]. `[N, 1]`
        heading_rad: 1,
        /// Centres of the foot balls, world, m. `[N, F, 3]`
        foot_pos_m: 3 * feet,
        /// Velocities of those centres, world, m/s. `[N, F, 3]`
        foot_vel_mps: 3 * feet,
        /// Height of the foot ball's lowest point above the terrain below its centre, m. `[N, F]`
        foot_height_m: feet,
        /// Contact force on each foot from everything it touches, mean over the period, world, N. `[N, F, 3]`
        foot_force_n: 3 * feet,
        /// Sum of normal contact forces on links that carry feet, the feet themselves left out
        /// ([`RobotModel::carries_feet`](caudata_model::RobotModel::carries_feet)), mean over the period, N.
        /// `[N, 1]`
        trunk_force_n: 1,
        /// Sum of normal contact forces on links that carry no feet (the tail), mean over the period, N.
        /// `[N, 1]`
        tail_force_n: 1,
        /// Angular velocity in the IMU frame, rad/s. `[N, 3]`
        imu_gyro_radps: 3,
        /// Specific force in the IMU frame (at rest: +g along up), m/s². Mean over the period: the change of
        /// the IMU point's velocity divided by the period, minus gravity, turned by the final orientation.
        /// `[N, 3]`
        imu_acc_mps2: 3,
        /// Unit vector of gravity in the IMU frame (level: 0, 0, −1). `[N, 3]`
        imu_gravity: 3,
    }
}

impl State {
    /// All zeros, for `lanes` robots of `model`.
    pub(crate) fn of(model: &RobotModel, lanes: usize) -> Self {
        let (joints, actuated) = (model.joints().len(), model.actuated().len());
        Self::zeros(lanes, joints, actuated, model.feet().len())
    }

    /// Copies the only lane of `from` over lane `lane` of `self`; both have the same shape otherwise.
    pub(crate) fn copy_lane(&mut self, lane: usize, from: &Self) {
        self.diverged[lane] = from.diverged[0];
        for (to, from) in self.fields_mut().into_iter().zip(from.fields()) {
            let k = from.len();
            to[lane * k..(lane + 1) * k].copy_from_slice(from);
        }
    }

    /// What the encoder of lane `lane`'s hinge `joint` (model order), moved by servo `servo` (policy order),
    /// has, rad.
    pub fn encoder_pos_rad(&self, lane: usize, joint: usize, servo: usize) -> f32 {
        self.joint_pos_rad[lane * self.joints + joint]
            + self.encoder_ahead_rad[lane * self.actuated + servo]
    }

    /// Its speed, rad/s.
    pub fn encoder_vel_radps(&self, lane: usize, joint: usize, servo: usize) -> f32 {
        self.joint_vel_radps[lane * self.joints + joint]
            + self.encoder_ahead_radps[lane * self.actuated + servo]
    }

    /// Whether every number is finite.
    pub(crate) fn is_finite(&self) -> bool {
        self.fields().iter().all(|f| f.iter().all(|v| v.is_finite()))
    }

    pub(crate) fn fields_mut(&mut self) -> [&mut [f32]; FIELDS] {
        self.parts_mut().0
    }
}
