//! Assembly of one observation from measured quantities.

use crate::layout::Part;
use crate::{ACTION_HISTORY, COMMAND_DIM, ObservationLayout, PerFoot, PerJoint, TaskError};

/// What goes into an observation: values as the sensors report them.
#[derive(Clone, Copy, Debug)]
pub struct ObservationInput<'a> {
    /// Joint velocities, rad/s, policy order.
    pub joint_vel_radps: &'a [f32],
    /// Joint positions, rad, policy order.
    pub joint_pos_rad: &'a [f32],
    /// Angular velocity, rad/s, body.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, body (upright: 0, 0, −1).
    pub gravity: [f32; 3],
    /// Phase of each foot (of the clock without feet), rad, (−π, π]: [`ObservationLayout::phases`] of them.
    pub phase_rad: PerFoot,
    /// Commanded vx, vy (m/s) and yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Past actions, newest first: a(t−1), a(t−2), a(t−3).
    pub previous_actions: &'a [PerJoint; ACTION_HISTORY],
    /// 1 afloat (in water that is too deep for the feet), 0 otherwise; only used where the layout has the
    /// medium bit (0 where it is not given).
    pub medium: Option<f32>,
}

impl ObservationInput<'_> {
    /// Writes the observation into `out`, of length `layout.dim()`.
    ///
    /// # Errors
    /// [`TaskError::Shape`] when `out` has another length; nothing is written then.
    pub fn write(
        &self,
        layout: &ObservationLayout,
        nominal_rad: &[f32],
        out: &mut [f32],
    ) -> Result<(), TaskError> {
        let joints = layout.range(Part::JointVel).len();
        for (what, found, expected) in [
            ("observation", out.len(), layout.dim()),
            ("joint velocities", self.joint_vel_radps.len(), joints),
            ("joint positions", self.joint_pos_rad.len(), joints),
            ("nominal pose", nominal_rad.len(), joints),
            ("phases", self.phase_rad.len(), layout.phases()),
            ("past actions", self.previous_actions[0].len(), joints),
        ] {
            if found != expected {
                return Err(TaskError::Shape {
                    what,
                    found,
                    expected,
                });
            }
        }
        out[layout.range(Part::JointVel)].copy_from_slice(self.joint_vel_radps);
        let offsets = &mut out[layout.range(Part::JointPos)];
        for i in 0..joints {
            offsets[i] = self.joint_pos_rad[i] - nominal_rad[i];
        }
        out[layout.range(Part::Gyro)].copy_from_slice(&self.gyro_radps);
        out[layout.range(Part::Gravity)].copy_from_slice(&self.gravity);
        self.write_phase(&mut out[layout.range(Part::Phase)]);
        out[layout.range(Part::Command)].copy_from_slice(&self.command);
        let actions = &mut out[layout.range(Part::Actions)];
        for (to, action) in actions.chunks_exact_mut(joints).zip(self.previous_actions) {
            to.copy_from_slice(action);
        }
        out[layout.range(Part::Medium)].fill(self.medium.unwrap_or(0.0));
        Ok(())
    }

    /// cos and sin of each phase. In a trot diagonal feet share a phase, and so its cos and sin.
    fn write_phase(&self, out: &mut [f32]) {
        for (foot, phase) in self.phase_rad.iter().enumerate() {
            let same = self.phase_rad[..foot]
                .iter()
                .position(|earlier| earlier == phase);
            let (sin, cos) = match same {
                Some(earlier) => (out[2 * earlier + 1], out[2 * earlier]),
                None => phase.sin_cos(),
            };
            out[2 * foot] = cos;
            out[2 * foot + 1] = sin;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACT_DIM: usize = 16;
    use std::f32::consts::{FRAC_PI_2, PI};

    fn numbered(start: f32) -> PerJoint {
        PerJoint::from_fn(ACT_DIM, |i| start + i as f32)
    }

    #[test]
    fn every_value_lands_where_the_layout_says() {
        let (vel, pos, nominal) = (numbered(100.0), numbered(200.0), numbered(1.0));
        let actions = [numbered(300.0), numbered(400.0), numbered(500.0)];
        let input = ObservationInput {
            joint_vel_radps: &vel,
            joint_pos_rad: &pos,
            gyro_radps: [1.0, 2.0, 3.0],
            gravity: [0.0, 0.1, -0.9],
            phase_rad: [0.0, PI, FRAC_PI_2, -FRAC_PI_2].into(),
            command: [0.3, -0.1, 0.2],
            previous_actions: &actions,
            medium: Some(1.0),
        };
        for medium in [false, true] {
            let feet = ["FL", "FR", "HL", "HR"].map(str::to_owned);
            let layout = ObservationLayout::new(ACT_DIM, &feet, medium);
            let mut out = vec![f32::NAN; layout.dim()];
            input.write(&layout, &nominal, &mut out).unwrap();
            assert!(input.write(&layout, &nominal, &mut out[1..]).is_err());
            let part = |name: &str| {
                let s = layout.slice(name).unwrap();
                &out[s.start..s.start + s.len]
            };
            assert_eq!(part("joint_vel"), &vel[..]);
            // (200 + i) − (1 + i) = 199
            assert_eq!(part("joint_pos_offset"), [199.0; ACT_DIM]);
            assert_eq!(part("gyro"), [1.0, 2.0, 3.0]);
            assert_eq!(part("gravity"), [0.0, 0.1, -0.9]);
            // (cos, sin) of 0, π, π/2, −π/2.
            let expected = [1.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, -1.0];
            for (found, expected) in part("phase").iter().zip(expected) {
                assert!((found - expected).abs() < 1e-6);
            }
            assert_eq!(part("command"), [0.3, -0.1, 0.2]);
            assert_eq!(part("actions")[..16], actions[0][..]);
            assert_eq!(part("actions")[16..32], actions[1][..]);
            assert_eq!(part("actions")[32..], actions[2][..]);
            assert_eq!(out.len(), if medium { 98 } else { 97 });
            if medium {
                assert_eq!(out[97], 1.0);
            }
        }
    }
}
