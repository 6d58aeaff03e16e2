//! What figures need to know of a robot's build: which parts mirror each other, what is trunk and what is
//! tail. All of it comes from the robot's files.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_task::{BodyPlan, Mirror, ObservationLayout, PerFoot, PerJoint};

use crate::overlap::Shapes;

/// The build of a robot. Joints in policy order.
#[derive(Clone, Debug)]
pub struct Anatomy {
    /// Nominal pose, rad.
    pub nominal_rad: PerJoint<f64>,
    /// End stops, rad.
    pub range_rad: PerJoint<[f64; 2]>,
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
    /// Shapes that must not meet.
    pub shapes: Shapes,
}

impl Anatomy {
    /// The build of `model`.
    #[must_use]
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
        Self {
            nominal_rad: PerJoint::of(nominal),
            range_rad: PerJoint::from_fn(joints, range),
            counterpart: PerJoint::from_fn(joints, counterpart),
            other_foot: PerFoot::from_fn(feet.len(), |f| mirror.as_ref().map_or(f, |m| m.feet[f])),
            in_leg: plan.in_leg,
            in_trunk: plan.in_trunk,
            in_tail: plan.in_tail,
            shapes: Shapes::of(model),
        }
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
    }
}
