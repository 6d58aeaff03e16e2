//! A joint that turns the other way round than its counterpart, or stands elsewhere: found from the geometry of
//! the two sides, whatever the joints are called.
//!
//! A joint's axis says which way is positive; its nominal position and its limits say which way was meant. Where
//! these agree with the counterpart's only if one axis is turned round, one of the two is reversed; which, the
//! other legs on its side say.

use caudata_model::{Kinematics, Pose, RobotModel};

use crate::suspect::{Edit, Suspect};

/// How far a joint may be from the mirror image of its counterpart, m.
const PLACE_M: f64 = 5e-3;
/// How far positions and limits may differ, rad.
const APART_RAD: f64 = 0.05;

fn close(a: [f64; 3], b: [f64; 3], within: f64) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < within)
}

/// What the two sides of a robot say of it: actuated joints by policy order.
struct Sides<'a> {
    model: &'a RobotModel,
    at_zero: Kinematics,
}

impl Sides<'_> {
    fn anchor(&self, joint: usize) -> [f64; 3] {
        self.at_zero.joints[self.model.actuated()[joint]].anchor_m
    }

    fn axis(&self, joint: usize) -> [f64; 3] {
        self.at_zero.joints[self.model.actuated()[joint]].axis
    }

    /// Joints between this one and the trunk, so that legs can be compared.
    fn depth(&self, joint: usize) -> usize {
        let link = self.model.joints()[self.model.actuated()[joint]].child_link;
        std::iter::successors(Some(link), |&link| self.model.links()[link].parent).count()
    }

    /// The joint on the other side, and 1 where a positive turn is the mirror image of one there, −1 where it is
    /// that of a negative one.
    fn counterpart(&self, joint: usize) -> Option<(usize, f64)> {
        let [x, y, z] = self.anchor(joint);
        let [a, b, c] = self.axis(joint);
        (0..self.model.actuated().len()).find_map(|other| {
            if other == joint || !close(self.anchor(other), [x, -y, z], PLACE_M) {
                return None;
            }
            // an axis is a rotation vector
            let same = close(self.axis(other), [-a, b, -c], 0.02);
            let opposite = close(self.axis(other), [a, -b, c], 0.02);
            (same || opposite).then_some((other, if same { 1.0 } else { -1.0 }))
        })
    }

    /// Whether nominal positions and limits of two joints are each other's mirror image if turns are by `sign`.
    fn agree(&self, [a, b]: [usize; 2], sign: f64) -> bool {
        let near = |x: f64, y: f64| (x - y).abs() < APART_RAD;
        let (nominal, limits) = (self.model.nominal_pos_rad(), self.model.joint_limits_rad());
        let (low, high) = limits[b];
        let (low, high) = if sign < 0.0 { (-high, -low) } else { (low, high) };
        near(nominal[a], sign * nominal[b]) && near(limits[a].0, low) && near(limits[a].1, high)
    }

    /// Whether the joint is of the one leg whose foot is not level with the others in the nominal pose.
    fn of_odd_leg(&self, joint: usize) -> bool {
        let model = self.model;
        let pos = model.full_pos_rad(model.nominal_pos_rad());
        let places = pos.and_then(|q| model.kinematics(&Pose::IDENTITY, &q));
        let places = places.unwrap_or_default();
        let height = |f: &caudata_model::Foot| {
            let link = places.links.get(f.link);
            link.map_or(0.0, |link| link.point(f.centre_m)[2])
        };
        let heights: Vec<f64> = model.feet().iter().map(height).collect();
        let mut sorted = heights.clone();
        sorted.sort_by(f64::total_cmp);
        let middle = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
        let link = model.joints()[model.actuated()[joint]].child_link;
        let off = |leg: usize| (heights[leg] - middle).abs();
        let mine = model.leg_of(link);
        mine.is_some_and(|leg| off(leg) > PLACE_M && (0..heights.len()).all(|k| off(k) <= off(leg)))
    }

    /// Legs on this joint's side whose joint at that depth turns the other way, less those that turn alike.
    fn against(&self, joint: usize, but: usize) -> i32 {
        let axis = self.axis(joint);
        let alike = |&k: &usize| {
            let same_side = self.anchor(k)[1] * self.anchor(joint)[1] > 0.0;
            k != joint && k != but && same_side && self.depth(k) == self.depth(joint)
        };
        let vote = |k: usize| match self.axis(k) {
            other if close(other, axis.map(|a| -a), 0.02) => 1,
            other if close(other, axis, 0.02) => -1,
            _ => 0,
        };
        (0..self.model.actuated().len()).filter(alike).map(vote).sum()
    }
}

/// The suspects in a robot file; none for a robot without two sides.
pub fn suspects(model: &RobotModel) -> Vec<Suspect> {
    let zeros = vec![0.0; model.actuated().len()];
    let at_zero = model.full_pos_rad(&zeros).and_then(|q| model.kinematics(&Pose::IDENTITY, &q));
    let Ok(at_zero) = at_zero else { return Vec::new() };
    let sides = Sides { model, at_zero };
    let names = model.actuated_names();
    let mut all = Vec::new();
    for joint in 0..names.len() {
        let Some((other, sign)) = sides.counterpart(joint) else { continue };
        if sides.agree([joint, other], sign) {
            continue;
        }
        let (name, there) = (names[joint].to_owned(), names[other]);
        let keys = vec![format!("robot.{name}")];
        let nominal = model.nominal_pos_rad();
        all.push(match sides.agree([joint, other], -sign) {
            true => Suspect {
                id: "joint_reversed",
                keys,
                says: format!("joint {name} turns the other way round than {there}, its pose and limits do not"),
                edit: Edit::Axis {
                    axis: model.joints()[model.actuated()[joint]].axis.map(|a| -a),
                    joint: name,
                },
                suspicion: 3.0
                    + f64::from(sides.against(joint, other)).clamp(-1.0, 1.0)
                    + if sides.of_odd_leg(joint) { 0.5 } else { 0.0 },
            },
            false if (nominal[joint] - sign * nominal[other]).abs() > APART_RAD => Suspect {
                id: "pose_lopsided",
                keys,
                says: format!(
                    "joint {name} stands at {:.2} rad where {there} on the other side stands at {:.2}",
                    nominal[joint], nominal[other]
                ),
                edit: Edit::Nominal {
                    rad: sign * nominal[other],
                    joint: name,
                },
                suspicion: 1.5,
            },
            false => continue,
        });
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn read(name: &str) -> String {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
        std::fs::read_to_string(folder.join(name)).unwrap()
    }

    #[test]
    fn the_reversed_joint_is_named_and_no_shipped_robot_is_suspect() {
        for name in ["polymander", "quadruped", "biped", "hexapod", "snake"] {
            let [robot, mjcf] = ["robot.toml", "xml"].map(|end| read(&format!("{name}.{end}")));
            let model = RobotModel::from_bytes(name, robot.as_bytes(), mjcf.as_bytes()).unwrap();
            assert_eq!(suspects(&model), [], "{name}");
        }
        let right = r#"<joint class="fore_thigh" name="FR_thigh"/>"#;
        let mjcf = read("quadruped.xml");
        assert!(mjcf.contains(right));
        let wrong = right.replace("/>", r#" axis="0 -1 0"/>"#);
        let mjcf = mjcf.replace(right, &wrong);
        let robot = read("quadruped.robot.toml");
        let model = RobotModel::from_bytes("q", robot.as_bytes(), mjcf.as_bytes()).unwrap();
        let found = suspects(&model);
        let worst = found.iter().max_by(|a, b| a.suspicion.total_cmp(&b.suspicion)).unwrap();
        assert_eq!((worst.id, worst.keys[0].as_str()), ("joint_reversed", "robot.FR_thigh"));
        let axis = [0.0, 1.0, 0.0];
        assert!(matches!(&worst.edit, Edit::Axis { axis: to, .. } if close(*to, axis, 1e-9)));
    }
}
