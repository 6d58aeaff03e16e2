//! Assembly of one observation from measured quantities.

use crate::layout::{ACTIONS, COMMAND, GRAVITY, GYRO, JOINT_POS, JOINT_VEL, MEDIUM, PHASE};
use crate::{ACT_DIM, ACTION_HISTORY, COMMAND_DIM, FEET, ObservationLayout, TaskError};

/// What goes into an observation: values as the sensors report them.
#[derive(Clone, Copy, Debug)]
pub struct ObservationInput<'a> {
    /// Joint velocities, rad/s, policy order.
    pub joint_vel_radps: &'a [f32; ACT_DIM],
    /// Joint positions, rad, policy order.
    pub joint_pos_rad: &'a [f32; ACT_DIM],
    /// Angular velocity, rad/s, body.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, body (upright: 0, 0, −1).
    pub gravity: [f32; 3],
    /// Phase of each foot, rad, (−π, π].
    pub phase_rad: [f32; FEET],
    /// Commanded vx, vy (m/s) and yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Past actions, newest first: a(t−1), a(t−2), a(t−3).
    pub previous_actions: &'a [[f32; ACT_DIM]; ACTION_HISTORY],
    /// 1 afloat (in water that is too deep for the feet), 0 otherwise; only used where the layout has the medium bit (0 where it is not given).
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
        nominal_rad: &[f32; ACT_DIM],
        out: &mut [f32],
    ) -> Result<(), TaskError> {
        let expected = layout.dim();
        if out.len() != expected {
            return Err(TaskError::Shape {
                what: "observation",
                found: out.len(),
                expected,
            });
        }
        out[JOINT_VEL..JOINT_POS].copy_from_slice(self.joint_vel_radps);
        let offsets = &mut out[JOINT_POS..GYRO];
        for i in 0..ACT_DIM {
            offsets[i] = self.joint_pos_rad[i] - nominal_rad[i];
        }
        out[GYRO..GRAVITY].copy_from_slice(&self.gyro_radps);
        out[GRAVITY..PHASE].copy_from_slice(&self.gravity);
        self.write_phase(&mut out[PHASE..COMMAND]);
        out[COMMAND..ACTIONS].copy_from_slice(&self.command);
        out[ACTIONS..MEDIUM].copy_from_slice(self.previous_actions.as_flattened());
        if let Some(medium) = out.get_mut(MEDIUM) {
            *medium = self.medium.unwrap_or(0.0);
        }
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
    use std::f32::consts::{FRAC_PI_2, PI};

    fn numbered(start: f32) -> [f32; ACT_DIM] {
        std::array::from_fn(|i| start + i as f32)
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
            phase_rad: [0.0, PI, FRAC_PI_2, -FRAC_PI_2],
            command: [0.3, -0.1, 0.2],
            previous_actions: &actions,
            medium: Some(1.0),
        };
        for medium in [false, true] {
            let layout = ObservationLayout::new(medium);
            let mut out = vec![f32::NAN; layout.dim()];
            input.write(&layout, &nominal, &mut out).unwrap();
            assert!(input.write(&layout, &nominal, &mut out[1..]).is_err());
            let part = |name: &str| {
                let s = layout.slice(name).unwrap();
                &out[s.start..s.start + s.len]
            };
            assert_eq!(part("joint_vel"), vel);
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
            assert_eq!(part("actions")[..16], actions[0]);
            assert_eq!(part("actions")[16..32], actions[1]);
            assert_eq!(part("actions")[32..], actions[2]);
            assert_eq!(out.len(), if medium { 98 } else { 97 });
            if medium {
                assert_eq!(out[97], 1.0);
            }
        }
    }
}
