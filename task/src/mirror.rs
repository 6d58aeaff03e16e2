//! Left and right exchanged: what a robot that is its own mirror image sees and does on the other side.
//!
//! Reflection in the robot's plane y = 0 maps a vector (x, y, z) to (x, −y, z) and a rotation vector to (−x,
//! y, −z). Each joint has a counterpart, found from where its axis and what it moves are in the nominal pose: for
//! a joint in the plane itself, for a leg that of the other side. Names do not matter, nor where on its axis
//! the model puts a joint.

use caudata_model::{Foot, Joint, JointMotion, Kinematics, Pose, RobotModel, pose};

use crate::layout::{ObservationLayout, Part};
use crate::{ACTION_HISTORY, TaskError};

/// How far the places of counterparts may differ, m: models drawn by hand or by CAD are exact to about that.
const PLACE_M: f64 = 2e-3;
/// How far their axes may differ, rad.
const AXIS_RAD: f64 = 0.02;
/// How far the centres of mass of the links that they move may differ, m, where their places on the axis do: CAD
/// puts motors and cables on one side. Farther apart, it is an arm on one side only, whose axis is its own mirror image.
const MOVED_M: f64 = 0.02;

/// `mirrored[i] = sign[i]·original[source[i]]`.
#[derive(Clone, Debug, PartialEq)]
pub struct SignedPermutation {
    /// Where each value comes from.
    pub source: Vec<usize>,
    /// 1 or −1 for each.
    pub sign: Vec<f32>,
}

impl SignedPermutation {
    /// Leaves everything as it is.
    pub fn identity(len: usize) -> Self {
        Self { source: (0..len).collect(), sign: vec![1.0; len] }
    }

    /// Exchanges the first with the last, the second with the last but one, and so on.
    pub fn reversal(len: usize) -> Self {
        Self { source: (0..len).rev().collect(), ..Self::identity(len) }
    }

    /// How many values there are.
    pub fn len(&self) -> usize {
        self.source.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.source.is_empty()
    }

    /// Whether the mirror image of the mirror image is the original.
    fn is_its_own_inverse(&self) -> bool {
        let back = |(i, &j): (usize, &usize)| {
            self.source.get(j) == Some(&i) && self.sign.get(i) == self.sign.get(j)
        };
        self.source.iter().enumerate().all(back)
    }

    /// Puts `part` at `start`.
    fn place(&mut self, start: usize, part: &Self) {
        for (i, (source, sign)) in part.source.iter().zip(&part.sign).enumerate() {
            self.source[start + i] = start + source;
            self.sign[start + i] = *sign;
        }
    }

    /// These values, and those of `other` behind them.
    pub fn followed_by(&self, other: &Self) -> Self {
        let mut all = Self::identity(self.len() + other.len());
        all.place(0, self);
        all.place(self.len(), other);
        all
    }

    /// What it does to the values `kept` of a row, ascending, which it exchanges among themselves.
    fn of_part(&self, kept: &[usize]) -> Self {
        Self {
            source: kept.iter().map(|&i| kept.partition_point(|&k| k < self.source[i])).collect(),
            sign: kept.iter().map(|&i| self.sign[i]).collect(),
        }
    }

    /// The mirror image of `values`, which must have the permutation's length.
    pub fn apply(&self, values: &[f32]) -> Vec<f32> {
        let pairs = self.source.iter().zip(&self.sign);
        pairs.map(|(&from, sign)| sign * values[from]).collect()
    }
}

/// How a mirror changes the values between the layers of a network that commutes with it, input and output
/// included: in a hidden layer of n units, unit i changes places with unit n − 1 − i.
pub fn sides(
    input: &SignedPermutation,
    hidden: &[usize],
    output: &SignedPermutation,
) -> Vec<SignedPermutation> {
    let hidden = hidden.iter().map(|&n| SignedPermutation::reversal(n));
    let first = std::iter::once(input.clone());
    first.chain(hidden).chain([output.clone()]).collect()
}

/// The mirror images of observations and actions.
#[derive(Clone, Debug, PartialEq)]
pub struct Mirror {
    /// How an observation is mirrored, `[D]`.
    pub observation: SignedPermutation,
    /// How an action is mirrored, `[A]`.
    pub action: SignedPermutation,
    /// The foot on the other side of each, in the order of the robot file.
    pub feet: Vec<usize>,
}

impl Mirror {
    /// The mirror of a robot in the plane y = 0 of its base, from where its joints are and how they turn in
    /// the nominal pose. Masses, limits and gains are taken to be alike on both sides.
    ///
    /// The gait clock of a robot without feet is half a cycle on in its mirror image: what bends to the left
    /// now bends to the right then.
    ///
    /// # Errors
    /// [`TaskError::NotSymmetric`] names a joint or foot that has no counterpart in the nominal pose.
    pub fn new(model: &RobotModel, layout: &ObservationLayout) -> Result<Self, TaskError> {
        let nominal = model.full_pos_rad(model.nominal_pos_rad());
        let at_nominal = nominal.and_then(|q| model.kinematics(&Pose::IDENTITY, &q));
        // The lengths agree; should they not, nothing finds its counterpart below.
        let at_nominal = at_nominal.unwrap_or_default();
        let action = joints(model, &at_nominal)?;
        let feet_names: Vec<String> = model.feet().iter().map(|f| f.name.clone()).collect();
        let usual = |medium| ObservationLayout::new(action.source.len(), &feet_names, medium);
        if [false, true].iter().all(|&medium| layout.slices() != usual(medium).slices()) {
            return Err(TaskError::term(
                "task.observation",
                "term",
                "makes an observation whose mirror image is not known; set learner.network.symmetric = false"
                    .to_owned(),
            ));
        }
        let mut observation = SignedPermutation::identity(layout.present_dim());
        let start = |part| layout.range(part).start;
        observation.place(start(Part::JointVel), &action);
        observation.place(start(Part::JointPos), &action);
        for past in 0..ACTION_HISTORY {
            let from = start(Part::Actions) + past * action.len();
            observation.place(from, &action);
        }
        for (part, sign) in [
            (Part::Gyro, [-1.0, 1.0, -1.0]),
            (Part::Gravity, [1.0, -1.0, 1.0]),
            (Part::Command, [1.0, -1.0, -1.0]),
        ] {
            observation.sign[layout.range(part)].copy_from_slice(&sign);
        }
        if model.feet().is_empty() {
            observation.sign[layout.range(Part::Phase)].fill(-1.0);
        }
        let phase = start(Part::Phase);
        let feet = feet(model, &at_nominal)?;
        for (foot, other) in feet.iter().enumerate() {
            for part in 0..2 {
                observation.source[phase + 2 * foot + part] = phase + 2 * other + part;
            }
        }
        let recalled: Vec<usize> = layout.recalled().flatten().collect();
        let earlier = observation.of_part(&recalled);
        let observation =
            layout.past().iter().fold(observation, |all, _| all.followed_by(&earlier));
        Ok(Self { observation, action, feet })
    }
}

/// The counterpart of each actuated joint, in policy order: of those about the mirrored axis the one whose link
/// is nearest to the mirror image of its own.
fn joints(model: &RobotModel, at_nominal: &Kinematics) -> Result<SignedPermutation, TaskError> {
    let actuated = model.actuated();
    let mut out = SignedPermutation::identity(actuated.len());
    for (i, &joint) in actuated.iter().enumerate() {
        let others = actuated.iter().enumerate();
        let found = others.filter_map(|(j, &other)| {
            let (off_m, sign) = mirrored(model, at_nominal, [joint, other])?;
            Some((off_m, j, sign))
        });
        let Some((_, source, sign)) = found.min_by(|a, b| a.0.total_cmp(&b.0)) else {
            return Err(no_counterpart(model, &model.joints()[joint].name));
        };
        (out.source[i], out.sign[i]) = (source, sign);
    }
    if out.is_its_own_inverse() { Ok(out) } else { Err(no_counterpart(model, "a joint")) }
}

/// How far the link of the second of two joints is from the mirror image of the first one's, m, and 1 where it
/// moves as that does, −1 where it moves the other way; `None` where it is not its counterpart.
fn mirrored(model: &RobotModel, at_nominal: &Kinematics, pair: [usize; 2]) -> Option<(f64, f32)> {
    let joint = pair.map(|i| &model.joints()[i]);
    let (frame, other) = (at_nominal.joints.get(pair[0])?, at_nominal.joints.get(pair[1])?);
    // the axis of a hinge is a rotation vector, that of a slide a direction
    let along = reflect(frame.axis);
    let axis = if joint[0].motion == JointMotion::Hinge { along.map(|a| -a) } else { along };
    let is_axis = |axis| pose::norm(pose::sub(axis, other.axis)) < AXIS_RAD;
    let opposite = is_axis(axis.map(|a| -a)).then_some(-1.0);
    let sign = is_axis(axis).then_some(1.0).or(opposite)?;
    // a slide moves alike wherever its axis is
    let apart = pose::sub(reflect(frame.anchor_m), other.anchor_m);
    let across_m = pose::norm(pose::cross(apart, other.axis));
    let on_axis = joint[0].motion == JointMotion::Slide || across_m < PLACE_M;
    let moved = |joint: &Joint| {
        let link = &model.links()[joint.child_link];
        at_nominal.links[joint.child_link].point(link.com_m)
    };
    let off_m = pose::norm(pose::sub(reflect(moved(joint[0])), moved(joint[1])));
    let in_place = pose::norm(apart) < PLACE_M || off_m < MOVED_M;
    let counterpart = joint[0].motion == joint[1].motion && on_axis && in_place;
    counterpart.then_some((off_m, sign))
}

fn reflect([x, y, z]: [f64; 3]) -> [f64; 3] {
    [x, -y, z]
}

/// The foot on the other side of each.
fn feet(model: &RobotModel, at_nominal: &Kinematics) -> Result<Vec<usize>, TaskError> {
    let centre = |foot: &Foot| {
        let link = at_nominal.links.get(foot.link);
        link.map_or([f64::NAN; 3], |link| link.point(foot.centre_m))
    };
    let other = |foot: &Foot| {
        let mirrored = reflect(centre(foot));
        let off_m = |other: &Foot| pose::norm(pose::sub(centre(other), mirrored));
        let near = model.feet().iter().map(off_m).enumerate();
        let near = near.filter(|(_, off_m)| *off_m < PLACE_M);
        let nearest = near.min_by(|a, b| a.1.total_cmp(&b.1));
        nearest.map_or_else(|| Err(no_counterpart(model, &foot.name)), |(other, _)| Ok(other))
    };
    model.feet().iter().map(other).collect()
}

fn no_counterpart(model: &RobotModel, part: &str) -> TaskError {
    TaskError::NotSymmetric { robot: model.name().to_owned(), part: part.to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::past::Recall;
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
        assert_eq!(mirror.action.source, [0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 8, 9, 14, 15, 12, 13]);
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
        assert_eq!(other[phase..phase + 8], [3.0, 4.0, 1.0, 2.0, 7.0, 8.0, 5.0, 6.0]);
        assert_eq!(other[command..command + 3], [0.3, -0.1, -0.5]);
        assert_eq!(other[actions + 32 + 12], 0.7); // now HL_hip
        assert_eq!(other[97], 1.0);
        assert_eq!(mirror.observation.apply(&other), seen);
    }

    /// Robots of other builds: pairs are found by place, whatever their names, and mirroring twice changes
    /// nothing.
    #[test]
    fn every_shipped_robot_has_its_mirror_image() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        for (name, feet) in [
            ("quadruped", vec![1, 0, 3, 2]),
            ("biped", vec![1, 0]),
            ("hexapod", vec![1, 0, 3, 2, 5, 4]),
            ("snake", vec![]),
        ] {
            let file = folder.join(format!("{name}.robot.toml"));
            let model = RobotModel::load(&file).unwrap();
            let names: Vec<String> = model.feet().iter().map(|f| f.name.clone()).collect();
            let layout = ObservationLayout::new(model.actuated().len(), &names, false);
            let layout = layout.with_past(&[1, 3]).unwrap();
            let mirror = Mirror::new(&model, &layout).unwrap();
            assert_eq!(mirror.feet, feet, "{name}");
            let seen: Vec<f32> = (0..layout.dim()).map(|i| i as f32 + 1.0).collect();
            let image = mirror.observation.apply(&seen);
            assert_ne!(image, seen, "{name}");
            assert_eq!(mirror.observation.apply(&image), seen, "{name}");
            // what was seen earlier is mirrored as what is seen now
            let recall = Recall::new(&layout);
            let mut memory = vec![0.0; recall.memory_len()];
            let [seen, image] = [seen, image].map(|mut row| {
                recall.write(true, &mut row, &mut memory).unwrap();
                row
            });
            assert_eq!(mirror.observation.apply(&seen), image, "{name}");
        }
    }

    /// A knee of one side 3 cm farther along its axis turns the leg as before; a tail that slides up and down
    /// does so in the mirror too, and one that slides to the left goes to the right.
    #[test]
    fn a_joint_may_lie_anywhere_on_its_axis_and_a_slide_has_a_direction() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        let read = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
        let (robot, mjcf) = (read("polymander.robot.toml"), read("polymander.xml"));
        let changed = |from: &str, to: &str| {
            assert!(mjcf.contains(from));
            let mjcf = mjcf.replacen(from, to, 1);
            let model = RobotModel::from_bytes("test", robot.as_bytes(), mjcf.as_bytes()).unwrap();
            Mirror::new(&model, &layout(false)).unwrap().action
        };
        let usual = Mirror::new(&polymander(), &layout(false)).unwrap().action;
        let knee = r#"name="FL_knee" axis="-1 0 0""#;
        assert_eq!(changed(knee, &format!(r#"{knee} pos="0.03 0 0""#)), usual);
        for (axis, sign) in [("0 0 1", 1.0), ("1 0 0", 1.0), ("0 1 0", -1.0)] {
            let slide = format!(r#"name="tail_3" type="slide" axis="{axis}""#);
            let found = changed(r#"name="tail_3" axis="0 0 1""#, &slide);
            assert_eq!((found.source, found.sign[7]), (usual.source.clone(), sign), "{axis}");
        }
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
        // another nominal angle: the foot is elsewhere
        let found = refusal(&robot.replacen(knee, "FL_knee = 0.5", 1), &mjcf);
        assert!(found.contains("'FL'") && found.contains("nominal pose"), "{found}");
        let hip = r#"<body name="HR_upper" pos="-0.06505 -0.038 0">"#;
        assert!(mjcf.contains(hip));
        let wide = r#"<body name="HR_upper" pos="-0.06505 -0.048 0">"#;
        let found = refusal(&robot, &mjcf.replacen(hip, wide, 1));
        assert!(found.contains("HL_hip") && found.contains("counterpart"), "{found}");
    }
}
