//! What figures need to know of a robot's build: which parts mirror each other, what is trunk and what is
//! tail. All of it comes from the robot's files.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use caudata_model::{Foot, Kinematics, Pose, RobotModel, Site};
use caudata_task::{BodyPlan, Mirror, ObservationLayout, PerFoot, PerJoint};

use crate::overlap::Shapes;

/// The build of a robot. Joints in policy order.
#[derive(Clone, Debug)]
pub struct Anatomy {
    /// Nominal pose, rad.
    pub nominal_rad: PerJoint<f64>,
    /// End stops, rad.
    pub range_rad: PerJoint<[f64; 2]>,
    /// What counts as a radian: of a slide m.
    pub per_radian: PerJoint<f64>,
    /// The counterpart of each joint on the other side, and 1 or −1 as it turns alike or the other way;
    /// itself and 1 where the robot is not its own mirror image.
    pub counterpart: PerJoint<(usize, f64)>,
    /// The foot on the other side of each; itself where there is none.
    pub other_foot: PerFoot<usize>,
    /// Which joints move a leg.
    pub in_leg: PerJoint<bool>,
    /// Which joints bend the body between its feet.
    pub in_trunk: PerJoint<bool>,
    /// Which joints move a part that carries no foot and lies behind all feet.
    pub in_tail: PerJoint<bool>,
    /// The hind and the fore foot of either side, for a robot with two girdles and two feet at each.
    pub sides: Vec<[usize; 2]>,
    /// Snout (the foremost point of its shapes) to vent (the hind girdle) in the nominal pose, along the
    /// heading, m; 0 for a robot whose file names no girdles.
    pub snout_vent_m: f64,
    /// The hind girdle; `None` for a robot whose file names none.
    pub pelvis: Option<Pelvis>,
    /// Shapes that must not meet.
    pub shapes: Shapes,
}

impl Anatomy {
    /// The build of `model`.
    pub fn of(model: &Arc<RobotModel>) -> Self {
        let plan = BodyPlan::from_model(model);
        let nominal = model.nominal_pos_rad();
        let joints = nominal.len();
        let feet: Vec<String> = model.feet().iter().map(|f| f.name.clone()).collect();
        let layout = ObservationLayout::new(joints, &feet, false);
        let mirror = Mirror::new(model, &layout).ok();
        let counterpart = |i: usize| match &mirror {
            Some(m) => (m.action.source[i], f64::from(m.action.sign[i])),
            None => (i, 1.0),
        };
        let unlimited = (f64::NEG_INFINITY, f64::INFINITY);
        let range = |i: usize| {
            let joint = &model.joints()[model.actuated()[i]];
            let (low, high) = joint.range_rad.unwrap_or(unlimited);
            [low, high]
        };
        let shapes = Shapes::of(model);
        let pos = model.full_pos_rad(nominal);
        let places = pos.and_then(|q| model.kinematics(&Pose::IDENTITY, &q));
        let places = places.unwrap_or_default();
        let girdles = Girdles::of(model, &places);
        Self {
            pelvis: girdles
                .as_ref()
                .map(|g| Pelvis { model: Arc::clone(model), nominal_rad: g.pelvis_off_rad }),
            sides: girdles.as_ref().map_or_else(Vec::new, |g| g.sides(model)),
            snout_vent_m: girdles
                .map_or(0.0, |g| shapes.foremost_m(&places, g.ahead) - g.along(g.hind_m)),
            nominal_rad: PerJoint::of(nominal),
            range_rad: PerJoint::from_fn(joints, range),
            per_radian: PerJoint::from_fn(joints, |j| model.per_radian(j)),
            counterpart: PerJoint::from_fn(joints, counterpart),
            other_foot: PerFoot::from_fn(feet.len(), |f| mirror.as_ref().map_or(f, |m| m.feet[f])),
            in_leg: plan.in_leg,
            in_trunk: plan.in_trunk,
            in_tail: plan.in_tail,
            shapes,
        }
    }
}

/// The hind girdle of a robot.
#[derive(Clone, Debug)]
pub struct Pelvis {
    model: Arc<RobotModel>,
    /// Its yaw off the heading in the nominal pose, rad.
    nominal_rad: f64,
}

impl Pelvis {
    /// How far it is turned to the left of the line between the girdles at these positions of the actuated
    /// joints (rad), and off how it is in the nominal pose, rad. `at` is room to work in.
    pub(crate) fn yaw_off_heading_rad(&self, joint_pos_rad: &[f64], at: &mut Kinematics) -> f64 {
        let full = self.model.full_pos_rad(joint_pos_rad);
        let placed = full.and_then(|q| self.model.kinematics_into(&Pose::IDENTITY, &q, at));
        let girdles = placed.ok().and_then(|()| Girdles::of(&self.model, at));
        let off = girdles.map_or(0.0, |g| g.pelvis_off_rad) - self.nominal_rad;
        (off + PI).rem_euclid(TAU) - PI
    }
}

/// Where the girdles of a robot are whose links are placed.
struct Girdles<'a> {
    places: &'a Kinematics,
    hind_m: [f64; 3],
    front_m: [f64; 3],
    /// Unit vector from the hind to the front girdle, seen from above.
    ahead: [f64; 2],
    /// Yaw of the hind girdle's link off that line, rad.
    pelvis_off_rad: f64,
}

impl<'a> Girdles<'a> {
    /// `None` for a robot whose file names none, or both in one place.
    fn of(model: &RobotModel, places: &'a Kinematics) -> Option<Self> {
        let (hind, front) = model.heading_sites()?;
        let at = |site: &Site| places.links[site.link].point(site.link_from_site.pos_m);
        let (hind_m, front_m) = (at(hind), at(front));
        let way = [front_m[0] - hind_m[0], front_m[1] - hind_m[1]];
        let length = way[0].hypot(way[1]);
        let link = &places.links[hind.link];
        let (here, there) = (link.point([0.0; 3]), link.point([1.0, 0.0, 0.0]));
        let yaw_rad = (there[1] - here[1]).atan2(there[0] - here[0]);
        (length > 1e-6).then(|| Self {
            places,
            hind_m,
            front_m,
            ahead: way.map(|w| w / length),
            pelvis_off_rad: yaw_rad - way[1].atan2(way[0]),
        })
    }

    fn along(&self, at_m: [f64; 3]) -> f64 {
        at_m[0] * self.ahead[0] + at_m[1] * self.ahead[1]
    }

    /// See [`Anatomy::sides`]. A foot belongs to the girdle that it is nearer to along the heading.
    fn sides(&self, model: &RobotModel) -> Vec<[usize; 2]> {
        let middle = 0.5 * (self.along(self.hind_m) + self.along(self.front_m));
        let place = |foot: &Foot| self.places.links[foot.link].point(foot.centre_m);
        let left = |at: [f64; 3]| {
            let [x, y] = [0, 1].map(|i| at[i] - self.hind_m[i]);
            self.ahead[0] * y - self.ahead[1] * x > 0.0
        };
        let feet: Vec<[f64; 3]> = model.feet().iter().map(place).collect();
        let find = |is_left: bool, is_fore: bool| -> Vec<usize> {
            let fits =
                |&f: &usize| left(feet[f]) == is_left && (self.along(feet[f]) > middle) == is_fore;
            (0..feet.len()).filter(fits).collect()
        };
        let side = |is_left| match (&find(is_left, false)[..], &find(is_left, true)[..]) {
            (&[hind], &[fore]) => Some([hind, fore]),
            _ => None,
        };
        let sides = [true, false].map(side);
        sides.into_iter().collect::<Option<Vec<_>>>().unwrap_or_default()
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::path::Path;

    pub(crate) fn polymander() -> Arc<RobotModel> {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.robot.toml");
        Arc::new(RobotModel::load(&file).unwrap())
    }

    #[test]
    fn the_salamander_has_a_head_a_trunk_of_four_joints_and_a_tail_of_three() {
        let anatomy = Anatomy::of(&polymander());
        let which = |of: &PerJoint<bool>| (0..16).filter(|&i| of[i]).collect::<Vec<_>>();
        assert_eq!(which(&anatomy.in_trunk), [1, 2, 3, 4]);
        assert_eq!(which(&anatomy.in_tail), [5, 6, 7]);
        assert_eq!(anatomy.counterpart[0], (0, -1.0));
        assert_eq!(anatomy.counterpart[8], (10, 1.0));
        assert_eq!(anatomy.other_foot, [1, 0, 3, 2]);
        assert_eq!(anatomy.nominal_rad[9], 36.0_f64.to_radians());
        assert_eq!(anatomy.sides, [[2, 0], [3, 1]]);
        assert!((0.4..0.7).contains(&anatomy.snout_vent_m), "{}", anatomy.snout_vent_m);
    }
}
