//! Which parts of its report a batch engine works out.

use crate::state::FIELDS;

/// What of [`State`](crate::State) is worked out after each control period beside joints and motor torques,
/// which always are. With short periods the report costs as much as the physics, and who reads only joints
/// need not pay for the whole robot's centre of mass.
///
/// What is not read out stays as the lane's last reset or correction reported it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Readout {
    /// Pose, velocity and angular velocity of the base link.
    pub base: bool,
    /// Angular velocity, specific force and direction of gravity of the IMU. A lane's first specific force
    /// after this is switched on (and after restoring a snapshot that was taken without it) is wrong unless
    /// the lane is reset or corrected first: it is a change of velocity.
    pub imu: bool,
    /// Positions of the feet.
    pub feet: bool,
    /// Everything else: power, centre of mass, heading, velocities and heights of the feet, contact forces.
    pub rest: bool,
}

impl Readout {
    /// All of it.
    pub const ALL: Self = Self { base: true, imu: true, feet: true, rest: true };
    /// Joints and motor torques alone.
    pub const JOINTS: Self = Self { base: false, imu: false, feet: false, rest: false };

    /// Whether each field of [`State`](crate::State) is read out, in its order; `ahead`: whether an encoder may
    /// be ahead of its joint.
    #[inline(always)]
    pub(super) fn fields(self, ahead: bool) -> [bool; FIELDS] {
        let Self { base, imu, feet, rest } = self;
        [
            base, base, base, base, true, true, true, rest, ahead, ahead, rest, rest, rest, rest,
            feet, rest, rest, rest, rest, rest, imu, imu, imu,
        ]
    }
}

impl Default for Readout {
    fn default() -> Self {
        Self::ALL
    }
}
