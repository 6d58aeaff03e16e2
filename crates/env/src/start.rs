//! Where an episode starts: the draw, shifted for evaluation.

use caudata_task::reset::ResetDraw;

/// A place and a heading that are added to every drawn start.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StartShift {
    /// World x and y, m.
    pub xy_m: [f32; 2],
    /// About the vertical, rad.
    pub yaw_rad: f32,
}

impl StartShift {
    /// The drawn start, shifted. Its velocity turns with the heading.
    pub(crate) fn apply(&self, mut start: ResetDraw) -> ResetDraw {
        let (sin, cos) = self.yaw_rad.sin_cos();
        let [vx, vy] = start.base_vel_mps;
        start.base_vel_mps = [cos * vx - sin * vy, sin * vx + cos * vy];
        start.yaw_rad += self.yaw_rad;
        for (at, by) in start.base_xy_m.iter_mut().zip(self.xy_m) {
            *at += by;
        }
        start
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::FRAC_PI_2;

    #[test]
    fn a_shift_moves_and_turns_a_start() {
        // a quarter turn takes a velocity of (0.1, 0) to (0, 0.1)
        let start = ResetDraw {
            base_xy_m: [0.5, -0.5],
            roll_pitch_rad: [0.0; 2],
            yaw_rad: 0.25,
            base_vel_mps: [0.1, 0.0],
            joint_pos_rad: [0.0; 16].into(),
            joint_vel_radps: [0.0; 16].into(),
        };
        let shift = StartShift { xy_m: [3.0, 1.0], yaw_rad: FRAC_PI_2 };
        let moved = shift.apply(start);
        assert_eq!(moved.base_xy_m, [3.5, 0.5]);
        assert_eq!(moved.yaw_rad, 0.25 + FRAC_PI_2);
        assert!(moved.base_vel_mps[0].abs() < 1e-7);
        assert!((moved.base_vel_mps[1] - 0.1).abs() < 1e-7);
        assert_eq!(StartShift::default().apply(start), start);
    }
}
