//! Reward terms and conditions that a task file brings along, and the signals that they see.

use serde::{Deserialize, Serialize};

use super::input::RewardInput;
use crate::expression::{self, Names, Program, Shape, Signal, Source};
use crate::observation::Truth;
use crate::{PerFoot, PerJoint, TaskError};

/// Most terms, and most conditions, that a task file may bring along.
pub const OWN_MAX: usize = 32;

/// Table `[[task.reward.term]]`: a reward term of one's own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OwnTerm {
    /// Name in logs and curves.
    pub name: String,
    /// An expression that gives one number, such as `exp(-(height - 0.2)^2 / 0.001)`.
    pub value: String,
    /// What its value is multiplied by. A negative weight makes it a cost, which grows as `costs_at_start`
    /// says.
    pub weight: f32,
}

/// Table `[[task.termination.when]]`: a state that ends an episode by failing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OwnCondition {
    /// Name, for error messages.
    pub name: String,
    /// An expression that gives one number, such as `height < 0.1`; anything but 0 ends the episode.
    pub value: String,
}

/// Checks expressions without a robot: names that are distinct and not among `taken`, one number each.
pub(crate) fn check<'a>(
    table: &'static str,
    taken: impl Iterator<Item = &'a str>,
    terms: impl Iterator<Item = (&'a str, &'a str)>,
) -> Result<(), TaskError> {
    let mut seen: Vec<&str> = taken.collect();
    let most = seen.len() + OWN_MAX;
    for (name, value) in terms {
        let wrong = |reason: String| Err(TaskError::term(table, name, reason));
        let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
        if name.is_empty() || name.len() > 40 || !name.chars().all(word) {
            return wrong("has a name that is not 1 to 40 letters, digits and _".to_owned());
        }
        if seen.contains(&name) {
            return wrong("has the name of another term".to_owned());
        }
        seen.push(name);
        if seen.len() > most {
            return wrong(format!("is one too many; at most {OWN_MAX}"));
        }
        match expression::check(value) {
            Err(reason) => return wrong(format!("= `{value}` {reason}")),
            Ok((Shape::Scalar, _)) => {}
            Ok((shape, _)) => {
                let shape = shape.name();
                return wrong(format!(
                    "= `{value}` gives {shape}, not one number; use sum, mean, least or most"
                ));
            }
        }
    }
    Ok(())
}

/// Compiled expressions, and the stack that they are worked out on.
#[derive(Clone, Debug, Default)]
pub struct Programs {
    programs: Vec<Program>,
    stack: Vec<f32>,
}

impl Programs {
    /// Compiles expressions for a robot.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first that is wrong.
    pub fn new<'a>(
        table: &'static str,
        terms: impl Iterator<Item = (&'a str, &'a str)>,
        names: Names<'_>,
    ) -> Result<Self, TaskError> {
        let compile = |(name, value): (&str, &str)| {
            expression::compile(value, names)
                .map_err(|reason| TaskError::term(table, name, format!("= `{value}` {reason}")))
        };
        Ok(Self {
            programs: terms.map(compile).collect::<Result<_, _>>()?,
            stack: Vec::with_capacity(256),
        })
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.programs.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.programs.is_empty()
    }

    /// The value of number `which`; 0 where it is not finite.
    pub fn value(&mut self, which: usize, source: &impl Source) -> f32 {
        let value = self.programs[which].scalar(source, &mut self.stack);
        if value.is_finite() { value } else { 0.0 }
    }

    /// The first whose value is not 0.
    pub fn first(&mut self, source: &impl Source) -> Option<usize> {
        (0..self.len()).find(|&which| self.value(which, source) != 0.0)
    }
}

/// The true state after a control step, as signals.
#[derive(Clone, Copy, Debug)]
pub struct StateSignals<'a> {
    input: &'a RewardInput<'a>,
    foot_speed_mps: PerFoot,
    foot_force_n: PerFoot,
    contact: PerFoot,
    in_tail: PerJoint,
    standing: f32,
}

impl<'a> StateSignals<'a> {
    /// The signals of what reward terms look at; feet with more than `contact_force_n` on them count as in
    /// contact.
    pub fn new(input: &'a RewardInput<'a>, contact_force_n: f32) -> Self {
        let feet = input.foot_height_m.len();
        let foot_force_n = PerFoot::from_fn(feet, |foot| input.foot_force_n[foot][2]);
        Self {
            input,
            foot_speed_mps: PerFoot::from_fn(feet, |foot| {
                let [x, y, _] = input.foot_vel_mps[foot];
                x.hypot(y)
            }),
            contact: foot_force_n.map(|force| f32::from(force > contact_force_n)),
            foot_force_n,
            in_tail: PerJoint::from_fn(input.in_tail.len(), |joint| {
                f32::from(u8::from(input.in_tail[joint]))
            }),
            standing: f32::from(u8::from(input.standing)),
        }
    }
}

impl Source for StateSignals<'_> {
    fn values(&self, signal: Signal) -> &[f32] {
        use std::slice::from_ref;
        let input = self.input;
        match signal {
            Signal::JointVel => input.joint_vel_radps,
            Signal::JointPos => input.joint_pos_rad,
            Signal::Nominal => &input.joints.nominal_rad,
            Signal::Lower => &input.joints.lower_rad,
            Signal::Upper => &input.joints.upper_rad,
            Signal::InTail => &self.in_tail,
            Signal::Gyro => &input.gyro_radps,
            Signal::Gravity => &input.gravity,
            Signal::Phase => &input.phase_rad[..input.foot_height_m.len()],
            Signal::Clock => &input.phase_rad[..1],
            Signal::CommandVx => &input.command[..1],
            Signal::CommandVy => &input.command[1..2],
            Signal::CommandYaw => &input.command[2..],
            Signal::Action => input.action,
            Signal::PreviousAction => input.previous_action,
            Signal::Target => input.target_rad,
            Signal::PreviousJointVel => input.previous_joint_vel_radps,
            Signal::Torque => input.motor_torque_nm,
            Signal::Power => input.mech_power_w,
            Signal::Velocity => &input.com_vel_mps,
            Signal::YawRate => from_ref(&input.yaw_rate_radps),
            Signal::Height => from_ref(&input.com_height_m),
            Signal::FootHeight => input.foot_height_m,
            Signal::FootSpeed => &self.foot_speed_mps,
            Signal::FootForce => &self.foot_force_n,
            Signal::Contact => &self.contact,
            Signal::TrunkForce => from_ref(&input.trunk_force_n),
            Signal::OffCourse => from_ref(&input.off_course_rad),
            Signal::Standing => from_ref(&self.standing),
            Signal::Submerged => from_ref(&input.submerged),
            Signal::Afloat => from_ref(&input.afloat),
            Signal::Push => &input.push_n,
            Signal::Friction => from_ref(&input.friction),
            Signal::Step => from_ref(&input.dt_s),
        }
    }
}

impl Truth for StateSignals<'_> {
    fn simulated(&self, signal: Signal) -> &[f32] {
        self.values(signal)
    }
}
