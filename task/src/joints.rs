//! The actuated joints as the task sees them: nominal pose, limits, which of them are legs.

use caudata_model::{Pose, ROLLS_FROM_RAD, RobotModel};

use crate::row::{MAX_FEET, MAX_JOINTS};
use crate::{PerJoint, TaskError};

/// Nominal position and limits of the actuated joints, rad, policy order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointTable {
    /// Nominal (standing) pose: actions are offsets from it.
    pub nominal_rad: PerJoint,
    /// Lower position limits.
    pub lower_rad: PerJoint,
    /// Upper position limits.
    pub upper_rad: PerJoint,
}

impl JointTable {
    /// Reads the table out of a robot model.
    ///
    /// # Errors
    /// [`TaskError::Robot`] for a robot without actuated joints, or with more joints or feet than the task
    /// takes.
    pub fn from_model(model: &RobotModel) -> Result<Self, TaskError> {
        let count = |what, found, least, most| {
            if (least..=most).contains(&found) {
                return Ok(());
            }
            Err(TaskError::Robot { robot: model.name().to_owned(), what, found, least, most })
        };
        let joints = model.actuated().len();
        count("actuated joints", joints, 1, MAX_JOINTS)?;
        count("feet", model.feet().len(), 0, MAX_FEET)?;
        let limits = model.joint_limits_rad();
        Ok(Self {
            nominal_rad: narrow(model.nominal_pos_rad()),
            lower_rad: PerJoint::from_fn(joints, |i| limits[i].0 as f32),
            upper_rad: PerJoint::from_fn(joints, |i| limits[i].1 as f32),
        })
    }

    /// Number of actuated joints, and of actions.
    pub fn len(&self) -> usize {
        self.nominal_rad.len()
    }

    /// Whether a joint turns without end: a wheel.
    pub fn rolls(&self, joint: usize) -> bool {
        self.upper_rad[joint] - self.lower_rad[joint] > ROLLS_FROM_RAD as f32
    }

    /// Whether there is none (no robot that the task drives).
    pub fn is_empty(&self) -> bool {
        self.nominal_rad.is_empty()
    }
}

/// What rewards and starts need to know of a body besides its limits. Policy order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyPlan {
    /// Swimming pose, rad; the nominal one where the robot has none.
    pub swimming_rad: PerJoint,
    /// Which joints move a leg (see [`RobotModel::leg_of`]); the others are the body's, from head to tail.
    pub in_leg: PerJoint<bool>,
    /// Which joints bend the body between its feet.
    pub in_trunk: PerJoint<bool>,
    /// Which joints move a part that carries no foot and lies behind all feet.
    pub in_tail: PerJoint<bool>,
}

/// Where a joint of the body lies.
#[derive(Clone, Copy, PartialEq)]
enum Place {
    Trunk,
    Tail,
    Elsewhere,
}

impl BodyPlan {
    /// Reads the plan out of a robot model.
    pub fn from_model(model: &RobotModel) -> Self {
        let swimming = model.swimming_pos_rad().unwrap_or(model.nominal_pos_rad());
        let in_leg = |i: usize| {
            let joint = &model.joints()[model.actuated()[i]];
            model.leg_of(joint.child_link).is_some()
        };
        let joints = swimming.len();
        let places: Vec<Place> = (0..joints).map(|i| place(model, i)).collect();
        let at = |place: Place| PerJoint::from_fn(joints, |i| !in_leg(i) && places[i] == place);
        Self {
            swimming_rad: narrow(swimming),
            in_leg: PerJoint::from_fn(joints, in_leg),
            in_trunk: at(Place::Trunk),
            in_tail: at(Place::Tail),
        }
    }
}

/// A joint cuts the robot in two. With feet on both sides it bends the trunk; a side without feet is a tail
/// where it lies behind every foot in the nominal pose, else a head or an arm.
fn place(model: &RobotModel, joint: usize) -> Place {
    let child = model.joints()[model.actuated()[joint]].child_link;
    let up = |l: usize| model.links()[l].parent;
    let beyond = |link: usize| std::iter::successors(Some(link), |&l| up(l)).any(|l| l == child);
    let on = |side: bool| model.feet().iter().filter(move |f| beyond(f.link) == side);
    let footless = match (on(true).count(), on(false).count()) {
        (0, 0) => return Place::Elsewhere,
        (0, _) => true,
        (_, 0) => false,
        _ => return Place::Trunk,
    };
    let nominal = model.full_pos_rad(model.nominal_pos_rad());
    let Ok(at) = nominal.and_then(|q| model.kinematics(&Pose::IDENTITY, &q)) else {
        return Place::Elsewhere;
    };
    let feet = model.feet().iter().map(|f| at.links[f.link].point(f.centre_m)[0]);
    let hindmost = feet.fold(f64::INFINITY, f64::min);
    let side = (0..model.links().len()).filter(|&l| beyond(l) == footless);
    let xs: Vec<f64> = side.map(|l| at.links[l].point(model.links()[l].com_m)[0]).collect();
    match xs.iter().sum::<f64>() / (xs.len() as f64) < hindmost {
        true => Place::Tail,
        false => Place::Elsewhere,
    }
}

fn narrow(values: &[f64]) -> PerJoint {
    PerJoint::from_fn(values.len(), |i| values[i] as f32)
}
