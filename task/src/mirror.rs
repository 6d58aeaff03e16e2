//! Left and right exchanged: what a robot that is its own mirror image sees and does on the other side.
//!
//! Reflection in the robot's plane y = 0 maps a vector (x, y, z) to (x, −y, z) and a rotation vector to (−x, y, −z). Each joint has a
//! counterpart: for a joint in the plane itself, for a leg that of the other side.

use caudata_model::{Pose, RobotModel, pose};

use crate::layout::{
    ACTIONS, COMMAND, GRAVITY, GYRO, JOINT_POS, JOINT_VEL, ObservationLayout, PHASE,
};
use crate::{ACT_DIM, ACTION_HISTORY, FEET, TaskError};

/// How far anchors, axes and nominal angles of counterparts may differ, m, 1 and rad.
const TOLERANCE: f64 = 1e-6;
/// The foot on the other side, in the order FL, FR, HL, HR.
const OTHER_FOOT: [usize; FEET] = [1, 0, 3, 2];

/// `mirrored[i] = sign[i]·original[source[i]]`.
#[derive(Clone, Debug, PartialEq)]
pub struct SignedPermutation {
    /// Where each value comes from.
    pub source: Vec<usize>,
    /// 1 or −1 for each.
    pub sign: Vec<f32>,
}

impl SignedPermutation {
    fn identity(len: usize) -> Self {
        Self {
            source: (0..len).collect(),
            sign: vec![1.0; len],
        }
    }

    /// Puts `part` at `start`.
    fn place(&mut self, start: usize, part: &Self) {
        for (i, (source, sign)) in part.source.iter().zip(&part.sign).enumerate() {
            self.source[start + i] = start + source;
            self.sign[start + i] = *sign;
        }
    }

    /// The mirror image of `values`, which must have the permutation's length.
    pub fn apply(&self, values: &[f32]) -> Vec<f32> {
        let pairs = self.source.iter().zip(&self.sign);
        pairs.map(|(&from, sign)| sign * values[from]).collect()
    }
}

/// The mirror images of observations and actions.
#[derive(Clone, Debug, PartialEq)]
pub struct Mirror {
    /// Of an observation, `[D]`.
    pub observation: SignedPermutation,
    /// Of an action, `[A]`.
    pub action: SignedPermutation,
}

impl Mirror {
    /// The mirror of a robot in the plane y = 0 of its base, from where its joints are and how they turn. Masses, limits and gains are taken to be
    /// alike on both sides.
    ///
    /// # Errors
    /// [`TaskError::NotSymmetric`] names a joint that has no counterpart, or one with another nominal angle.
    pub fn new(model: &RobotModel, layout: &ObservationLayout) -> Result<Self, TaskError> {
        let action = joints(model)?;
        let mut observation = SignedPermutation::identity(layout.dim());
        for start in [JOINT_VEL, JOINT_POS] {
            observation.place(start, &action);
        }
        for past in 0..ACTION_HISTORY {
            observation.place(ACTIONS + past * ACT_DIM, &action);
        }
        observation.sign[GYRO..GYRO + 3].copy_from_slice(&[-1.0, 1.0, -1.0]);
        observation.sign[GRAVITY..GRAVITY + 3].copy_from_slice(&[1.0, -1.0, 1.0]);
        observation.sign[COMMAND..COMMAND + 3].copy_from_slice(&[1.0, -1.0, -1.0]);
        for (foot, other) in OTHER_FOOT.into_iter().enumerate() {
            for part in 0..2 {
                observation.source[PHASE + 2 * foot + part] = PHASE + 2 * other + part;
            }
        }
        Ok(Self {
            observation,
            action,
        })
    }
}

/// The counterpart of each actuated joint, in policy order.
fn joints(model: &RobotModel) -> Result<SignedPermutation, TaskError> {
    let not_symmetric = |joint: usize, reason: &'static str| TaskError::NotSymmetric {
        robot: model.name().to_owned(),
        joint: model.joints()[joint].name.clone(),
        reason,
    };
    let zero = vec![0.0; model.joints().len()];
    let place = Pose::from_pos([0.0; 3]);
    let frames = model.kinematics(&place, &zero).map(|k| k.joints);
    // The lengths agree; should they not, no joint finds its counterpart below.
    let frames = frames.unwrap_or_default();
    let near = |a: [f64; 3], b: [f64; 3]| pose::norm(pose::sub(a, b)) < TOLERANCE;
    let actuated = model.actuated();
    let mut out = SignedPermutation::identity(actuated.len());
    for (i, &joint) in actuated.iter().enumerate() {
        let counterpart = frames.get(joint).and_then(|frame| {
            let anchor = reflect(frame.anchor_m);
            // an axis is a rotation vector
            let axis = reflect(frame.axis).map(|a| -a);
            let sign = |other: [f64; 3]| {
                let opposite = near(other, axis.map(|a| -a)).then_some(-1.0);
                near(other, axis).then_some(1.0).or(opposite)
            };
            actuated.iter().enumerate().find_map(|(j, &other)| {
                let other = frames.get(other).filter(|o| near(o.anchor_m, anchor))?;
                sign(other.axis).map(|sign| (j, sign))
            })
        });
        let (source, sign) = counterpart
            .ok_or_else(|| not_symmetric(joint, "has no counterpart on the other side"))?;
        let nominal = model.nominal_pos_rad();
        if (nominal[i] - f64::from(sign) * nominal[source]).abs() > TOLERANCE {
            return Err(not_symmetric(
                joint,
                "has a counterpart with another nominal angle",
            ));
        }
        out.source[i] = source;
        out.sign[i] = sign;
    }
    Ok(out)
}

fn reflect([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -y, z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn polymander() -> RobotModel {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        RobotModel::load(&file).unwrap()
    }

    #[test]
    fn spine_and_tail_turn_the_other_way_and_legs_change_sides() {
        let mirror = Mirror::new(&polymander(), &ObservationLayout::new(true)).unwrap();
        assert_eq!(
            mirror.action.source,
            [0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 8, 9, 14, 15, 12, 13]
        );
        let signs: Vec<f32> = (0..16).map(|i| if i < 8 { -1.0 } else { 1.0 }).collect();
        assert_eq!(mirror.action.sign, signs);
    }

    #[test]
    fn an_observation_by_hand() {
        let mirror = Mirror::new(&polymander(), &ObservationLayout::new(true)).unwrap();
        let mut seen = vec![0.0; 98];
        seen[0] = 0.1; // spine_1 turns left
        seen[16 + 9] = 0.2; // FL_knee
        seen[GYRO..GYRO + 3].copy_from_slice(&[1.0, 2.0, 3.0]);
        seen[GRAVITY..GRAVITY + 3].copy_from_slice(&[0.1, 0.2, -0.9]);
        seen[PHASE..PHASE + 8].copy_from_slice(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
        seen[COMMAND..COMMAND + 3].copy_from_slice(&[0.3, 0.1, 0.5]);
        seen[ACTIONS + 32 + 14] = 0.7; // HR_hip, three steps ago
        seen[97] = 1.0;
        let other = mirror.observation.apply(&seen);
        assert_eq!(other[0], -0.1);
        assert_eq!((other[16 + 9], other[16 + 11]), (0.0, 0.2)); // now FR_knee
        assert_eq!(other[GYRO..GYRO + 3], [-1.0, 2.0, -3.0]);
        assert_eq!(other[GRAVITY..GRAVITY + 3], [0.1, -0.2, -0.9]);
        assert_eq!(
            other[PHASE..PHASE + 8],
            [3.0, 4.0, 1.0, 2.0, 7.0, 8.0, 5.0, 6.0]
        );
        assert_eq!(other[COMMAND..COMMAND + 3], [0.3, -0.1, -0.5]);
        assert_eq!(other[ACTIONS + 32 + 12], 0.7); // now HL_hip
        assert_eq!(other[97], 1.0);
        assert_eq!(mirror.observation.apply(&other), seen);
    }

    #[test]
    fn a_lopsided_robot_is_refused() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
        let (robot, mjcf) = (read("polymander.robot.toml"), read("polymander.xml"));
        let refusal = |robot: &str, mjcf: &str| {
            let model = RobotModel::from_bytes("test", robot.as_bytes(), mjcf.as_bytes()).unwrap();
            let layout = ObservationLayout::new(false);
            Mirror::new(&model, &layout).unwrap_err().to_string()
        };
        let knee = "FL_knee = 0.6283185307179586";
        assert!(robot.contains(knee));
        let found = refusal(&robot.replacen(knee, "FL_knee = 0.5", 1), &mjcf);
        assert!(
            found.contains("FL_knee") && found.contains("nominal"),
            "{found}"
        );
        let hip = r#"<body name="HR_upper" pos="-0.06505 -0.038 0">"#;
        assert!(mjcf.contains(hip));
        let wide = r#"<body name="HR_upper" pos="-0.06505 -0.048 0">"#;
        let found = refusal(&robot, &mjcf.replacen(hip, wide, 1));
        assert!(
            found.contains("HL_hip") && found.contains("counterpart"),
            "{found}"
        );
    }
}
