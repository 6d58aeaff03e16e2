//! Left and right exchanged: what a robot that is its own mirror image sees and does on the other side.
//!
//! Reflection in the robot's plane y = 0 maps a vector (x, y, z) to (x, −y, z) and a rotation vector to (−x,
//! y, −z). Each joint has a counterpart: for a joint in the plane itself, for a leg that of the other side.

use caudata_model::{Foot, Kinematics, Pose, RobotModel, pose};

use crate::layout::{ObservationLayout, Part};
use crate::{ACTION_HISTORY, TaskError};

/// How far anchors, axes and nominal angles of counterparts may differ, m, 1 and rad.
const TOLERANCE: f64 = 1e-6;

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
    /// How an observation is mirrored, `[D]`.
    pub observation: SignedPermutation,
    /// How an action is mirrored, `[A]`.
    pub action: SignedPermutation,
}

impl Mirror {
    /// The mirror of a robot in the plane y = 0 of its base, from where its joints are and how they turn.
    /// Masses, limits and gains are taken to be alike on both sides.
    ///
    /// # Errors
    /// [`TaskError::NotSymmetric`] names a joint that has no counterpart, or one with another nominal angle.
    pub fn new(model: &RobotModel, layout: &ObservationLayout) -> Result<Self, TaskError> {
        let zero = vec![0.0; model.joints().len()];
        let at_zero = model.kinematics(&Pose::IDENTITY, &zero);
        // The lengths agree; should they not, nothing finds its counterpart below.
        let at_zero = at_zero.unwrap_or_default();
        let action = joints(model, &at_zero)?;
        let usual = ObservationLayout::new(action.source.len(), &[], true);
        for slice in layout.slices() {
            let known = usual.slice(&slice.name).is_some() && slice.value.is_none();
            if !known || slice.history.is_some() {
                return Err(TaskError::term(
                    "task.observation.term",
                    &slice.name,
                    "has no mirror image that is known; set learner.ppo.mirror = false".to_owned(),
                ));
            }
        }
        let mut observation = SignedPermutation::identity(layout.dim());
        let start = |part| layout.range(part).start;
        observation.place(start(Part::JointVel), &action);
        observation.place(start(Part::JointPos), &action);
        for past in 0..ACTION_HISTORY {
            let from = start(Part::Actions) + past * action.source.len();
            observation.place(from, &action);
        }
        for (part, sign) in [
            (Part::Gyro, [-1.0, 1.0, -1.0]),
            (Part::Gravity, [1.0, -1.0, 1.0]),
            (Part::Command, [1.0, -1.0, -1.0]),
        ] {
            observation.sign[layout.range(part)].copy_from_slice(&sign);
        }
        let phase = start(Part::Phase);
        for (foot, other) in feet(model, &at_zero)?.into_iter().enumerate() {
            for part in 0..2 {
                observation.source[phase + 2 * foot + part] = phase + 2 * other + part;
            }
        }
        Ok(Self {
            observation,
            action,
        })
    }
}

/// The counterpart of each actuated joint, in policy order.
fn joints(model: &RobotModel, at_zero: &Kinematics) -> Result<SignedPermutation, TaskError> {
    let not_symmetric =
        |joint: usize, reason| not_symmetric(model, &model.joints()[joint].name, reason);
    let frames = &at_zero.joints;
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

/// The foot on the other side of each.
fn feet(model: &RobotModel, at_zero: &Kinematics) -> Result<Vec<usize>, TaskError> {
    let centre = |foot: &Foot| {
        let link = at_zero.links.get(foot.link);
        link.map_or([f64::NAN; 3], |link| link.point(foot.centre_m))
    };
    let other = |foot: &Foot| {
        let mirrored = reflect(centre(foot));
        let mut feet = model.feet().iter();
        (feet.position(|other| near(centre(other), mirrored)))
            .ok_or_else(|| not_symmetric(model, &foot.name, "has no counterpart on the other side"))
    };
    model.feet().iter().map(other).collect()
}

fn near(a: [f64; 3], b: [f64; 3]) -> bool {
    pose::norm(pose::sub(a, b)) < TOLERANCE
}

fn not_symmetric(model: &RobotModel, part: &str, reason: &'static str) -> TaskError {
    TaskError::NotSymmetric {
        robot: model.name().to_owned(),
        part: part.to_owned(),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn layout(medium: bool) -> ObservationLayout {
        let feet = ["FL", "FR", "HL", "HR"].map(str::to_owned);
        ObservationLayout::new(16, &feet, medium)
    }

    fn polymander() -> RobotModel {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        RobotModel::load(&file).unwrap()
    }

    #[test]
    fn spine_and_tail_turn_the_other_way_and_legs_change_sides() {
        let mirror = Mirror::new(&polymander(), &layout(true)).unwrap();
        assert_eq!(
            mirror.action.source,
            [0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 8, 9, 14, 15, 12, 13]
        );
        let signs: Vec<f32> = (0..16).map(|i| if i < 8 { -1.0 } else { 1.0 }).collect();
        assert_eq!(mirror.action.sign, signs);
    }

    #[test]
    fn an_observation_by_hand() {
        let mirror = Mirror::new(&polymander(), &layout(true)).unwrap();
        let start = |part| layout(true).range(part).start;
        let (gyro, gravity, phase) = (start(Part::Gyro), start(Part::Gravity), start(Part::Phase));
        let (command, actions) = (start(Part::Command), start(Part::Actions));
        let mut seen = vec![0.0; 98];
        seen[0] = 0.1; // spine_1 turns left
        seen[16 + 9] = 0.2; // FL_knee
        seen[gyro..gyro + 3].copy_from_slice(&[1.0, 2.0, 3.0]);
        seen[gravity..gravity + 3].copy_from_slice(&[0.1, 0.2, -0.9]);
        seen[phase..phase + 8].copy_from_slice(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
        seen[command..command + 3].copy_from_slice(&[0.3, 0.1, 0.5]);
        seen[actions + 32 + 14] = 0.7; // HR_hip, three steps ago
        seen[97] = 1.0;
        let other = mirror.observation.apply(&seen);
        assert_eq!(other[0], -0.1);
        assert_eq!((other[16 + 9], other[16 + 11]), (0.0, 0.2)); // now FR_knee
        assert_eq!(other[gyro..gyro + 3], [-1.0, 2.0, -3.0]);
        assert_eq!(other[gravity..gravity + 3], [0.1, -0.2, -0.9]);
        assert_eq!(
            other[phase..phase + 8],
            [3.0, 4.0, 1.0, 2.0, 7.0, 8.0, 5.0, 6.0]
        );
        assert_eq!(other[command..command + 3], [0.3, -0.1, -0.5]);
        assert_eq!(other[actions + 32 + 12], 0.7); // now HL_hip
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
            let layout = layout(false);
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
