//! Assembly of one observation from measured quantities.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::expression::{self, Names, Program, Signal, Source};
use crate::layout::{ObservationLayout, Part, Wanted, check_past};
use crate::{ACTION_HISTORY, COMMAND_DIM, JointTable, PerFoot, PerJoint, TaskError};

/// Table `[task.observation]`: what the policy sees.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObservationConfig {
    /// The terms, in order. Default none, which stands for the standard observation: joint_vel,
    /// joint_pos_offset, gyro, gravity, phase, command, actions, and with `task.observe_medium` medium.
    pub term: Vec<ObservationTerm>,
    /// How many control steps ago earlier observations were that the policy sees behind the present one:
    /// ascending, at most 16, each 1 to 64, such as `[2, 4, 6]`. Default none. Of each it sees the newest of every
    /// term but `phase` and `command`, which follow from the present. Weight, grip and delay show over time only; the
    /// networks grow with what they see. At a start the first observation stands for earlier ones.
    pub past: Vec<u32>,
}

/// Table `[[task.observation.term]]`: one term of an observation of one's own.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObservationTerm {
    /// Name of a built-in term (`caudata task terms` lists them), or any name for one with a `value`.
    pub name: String,
    /// An expression over signals, such as `gyro.x` or `joint_vel * torque`. Default empty: the built-in term
    /// of that name.
    pub value: String,
    /// Control steps that the policy sees of it, newest first, 1 to 16. Default 0: the term's usual number,
    /// which is 3 for `actions` and 1 for all others.
    pub history: u32,
    /// Standard deviation of noise that is added in training, in the term's unit. Default 0; that of
    /// `[task.noise]` is in the readings already.
    pub noise_std: f32,
}

impl ObservationConfig {
    /// Checks what can be checked without a robot.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first term that is wrong.
    pub fn validate(&self) -> Result<(), TaskError> {
        for term in &self.term {
            let wrong = |reason| TaskError::term("task.observation.term", &term.name, reason);
            if !(0.0..=1e3).contains(&term.noise_std) {
                return Err(wrong("has a noise_std that is not 0 to 1000".to_owned()));
            }
            match term.value.is_empty() {
                true if Part::of_name(&term.name).is_none() => {
                    let known = Part::ALL.map(Part::name).join(", ");
                    return Err(wrong(format!("has no value and is none of: {known}")));
                }
                true => {}
                false => {
                    let checked = expression::check(&term.value);
                    checked.map_err(|reason| wrong(format!("= `{}` {reason}", term.value)))?;
                }
            }
        }
        check_past(&self.past)
    }

    /// The layout for a robot with these joints and feet.
    ///
    /// # Errors
    /// [`TaskError::Term`] names the first term that is wrong.
    pub fn layout(
        &self,
        joints: &[String],
        feet: &[String],
        medium: bool,
    ) -> Result<ObservationLayout, TaskError> {
        let wanted = |term| {
            let ObservationTerm { name, value, history, .. }: &ObservationTerm = term;
            Wanted {
                name,
                value: (!value.is_empty()).then_some(value.as_str()),
                history: (*history > 0).then_some(*history),
            }
        };
        let wanted: Vec<Wanted<'_>> = self.term.iter().map(wanted).collect();
        let layout = match wanted.is_empty() {
            true => ObservationLayout::new(joints.len(), feet, medium),
            false => ObservationLayout::of(&wanted, joints, feet)?,
        };
        layout.with_past(&self.past)
    }
}

impl From<&ObservationLayout> for ObservationConfig {
    /// The terms of a layout, without noise.
    fn from(layout: &ObservationLayout) -> Self {
        let term = |wanted: Wanted<'_>| ObservationTerm {
            name: wanted.name.to_owned(),
            value: wanted.value.unwrap_or_default().to_owned(),
            history: wanted.history.unwrap_or_default(),
            noise_std: 0.0,
        };
        Self { term: layout.terms().into_iter().map(term).collect(), past: layout.past().to_vec() }
    }
}

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
    /// Phase of each foot (of the clock without feet), rad, (−π, π].
    pub phase_rad: PerFoot,
    /// Commanded vx, vy (m/s) and yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Past actions, newest first: a(t−1), a(t−2), a(t−3).
    pub previous_actions: &'a [PerJoint; ACTION_HISTORY],
    /// 1 afloat (in water that is too deep for the feet), 0 otherwise; only used where the layout has the
    /// medium bit (0 where it is not given).
    pub medium: Option<f32>,
}

/// A term of a layout, ready to be written.
#[derive(Clone, Debug)]
enum Term {
    Part(Part),
    Own(Program),
}

/// Writes observations of one layout.
#[derive(Clone, Debug)]
pub struct Observer {
    terms: Vec<(Range<usize>, usize, Term)>,
    dim: usize,
    joints: JointTable,
    phases: usize,
    feet: usize,
    stack: Vec<f32>,
}

impl Observer {
    /// For a robot with these joints and feet.
    ///
    /// # Errors
    /// [`TaskError::Term`] where the layout is not one for them.
    pub fn new(
        layout: &ObservationLayout,
        joints: &JointTable,
        names: Names<'_>,
    ) -> Result<Self, TaskError> {
        let mut terms = Vec::new();
        for slice in layout.slices() {
            let wrong = |reason| TaskError::term("task.observation.term", &slice.name, reason);
            let term = match (&slice.value, Part::of_name(&slice.name)) {
                (Some(value), _) => Term::Own(expression::compile(value, names).map_err(wrong)?),
                (None, Some(part)) => Term::Part(part),
                (None, None) => return Err(wrong("is unknown".to_owned())),
            };
            terms.push((slice.start..slice.start + slice.len, slice.width(), term));
        }
        Ok(Self {
            terms,
            dim: layout.present_dim(),
            joints: *joints,
            phases: names.feet.len().max(1),
            feet: names.feet.len(),
            stack: Vec::with_capacity(256),
        })
    }

    /// Refuses an observation with a signal that only the simulation knows.
    ///
    /// # Errors
    /// [`TaskError::Term`] names term and signal.
    pub fn check_sensed(&self, layout: &ObservationLayout) -> Result<(), TaskError> {
        for (slice, (_, _, term)) in layout.slices().iter().zip(&self.terms) {
            if let Term::Own(program) = term
                && let Some(signal) = program.simulated()
            {
                let name = signal.info().name;
                let reason = format!("needs `{name}`, which the robot cannot measure");
                return Err(TaskError::term("observation term", &slice.name, reason));
            }
        }
        Ok(())
    }

    /// Writes the present observation into `out`, which holds the one before it: terms with a history keep it there.
    /// `fresh`: there is none before, the newest values stand for all of the history. `truth` gives what only
    /// the simulation knows.
    ///
    /// # Errors
    /// [`TaskError::Shape`] when a length is wrong; nothing is written then.
    pub fn write(
        &mut self,
        input: &ObservationInput<'_>,
        truth: Option<&dyn Truth>,
        fresh: bool,
        out: &mut [f32],
    ) -> Result<(), TaskError> {
        self.check(input, out)?;
        let source = Observed { input, joints: &self.joints, feet: self.feet, truth };
        for (range, width, term) in &self.terms {
            let out = &mut out[range.clone()];
            if let Term::Part(Part::Actions) = term {
                for (to, action) in out.chunks_exact_mut(*width).zip(input.previous_actions) {
                    to.copy_from_slice(action);
                }
                continue;
            }
            if out.len() > *width {
                out.copy_within(..out.len() - width, *width);
            }
            let (newest, older) = out.split_at_mut(*width);
            match term {
                Term::Part(part) => write_part(*part, input, &self.joints, newest),
                Term::Own(program) => newest.copy_from_slice(program.run(&source, &mut self.stack)),
            }
            if fresh {
                for past in older.chunks_exact_mut(*width) {
                    past.copy_from_slice(newest);
                }
            }
        }
        Ok(())
    }

    fn check(&self, input: &ObservationInput<'_>, out: &[f32]) -> Result<(), TaskError> {
        let joints = self.joints.len();
        for (what, found, expected) in [
            ("observation", out.len(), self.dim),
            ("joint velocities", input.joint_vel_radps.len(), joints),
            ("joint positions", input.joint_pos_rad.len(), joints),
            ("phases", input.phase_rad.len(), self.phases),
            ("past actions", input.previous_actions[0].len(), joints),
        ] {
            if found != expected {
                return Err(TaskError::Shape { what, found, expected });
            }
        }
        Ok(())
    }
}

fn write_part(part: Part, input: &ObservationInput<'_>, joints: &JointTable, out: &mut [f32]) {
    match part {
        Part::JointVel => out.copy_from_slice(input.joint_vel_radps),
        Part::JointPos => {
            let pairs = input.joint_pos_rad.iter().zip(&joints.nominal_rad).enumerate();
            for (offset, (i, (pos, nominal))) in out.iter_mut().zip(pairs) {
                *offset = if joints.rolls(i) { 0.0 } else { pos - nominal };
            }
        }
        Part::Gyro => out.copy_from_slice(&input.gyro_radps),
        Part::Gravity => out.copy_from_slice(&input.gravity),
        Part::Phase => write_phase(&input.phase_rad, out),
        Part::Command => out.copy_from_slice(&input.command),
        // has a history of its own
        Part::Actions => {}
        Part::Medium => out.fill(input.medium.unwrap_or(0.0)),
    }
}

/// cos and sin of each phase. In a trot diagonal feet share a phase, and so its cos and sin.
pub fn write_phase(phase_rad: &[f32], out: &mut [f32]) {
    for (foot, phase) in phase_rad.iter().enumerate() {
        let same = phase_rad[..foot].iter().position(|earlier| earlier == phase);
        let (sin, cos) = match same {
            Some(earlier) => (out[2 * earlier + 1], out[2 * earlier]),
            None => phase.sin_cos(),
        };
        out[2 * foot] = cos;
        out[2 * foot + 1] = sin;
    }
}

/// What only the simulation knows.
pub trait Truth {
    /// The values of a signal that is not sensed.
    fn simulated(&self, signal: Signal) -> &[f32];
}

/// The signals as an observation sees them.
struct Observed<'a> {
    input: &'a ObservationInput<'a>,
    joints: &'a JointTable,
    feet: usize,
    truth: Option<&'a dyn Truth>,
}

impl Source for Observed<'_> {
    fn values(&self, signal: Signal) -> &[f32] {
        let input = self.input;
        match signal {
            Signal::JointVel => input.joint_vel_radps,
            Signal::JointPos => input.joint_pos_rad,
            Signal::Nominal => &self.joints.nominal_rad,
            Signal::Lower => &self.joints.lower_rad,
            Signal::Upper => &self.joints.upper_rad,
            Signal::Gyro => &input.gyro_radps,
            Signal::Gravity => &input.gravity,
            Signal::Phase => &input.phase_rad[..self.feet],
            Signal::Clock => &input.phase_rad[..1],
            Signal::CommandVx => &input.command[..1],
            Signal::CommandVy => &input.command[1..2],
            Signal::CommandYaw => &input.command[2..],
            Signal::Action => &input.previous_actions[0],
            Signal::PreviousAction => &input.previous_actions[1],
            other => match self.truth {
                Some(truth) => truth.simulated(other),
                // refused before ([`Observer::check_sensed`])
                None => nothing(other, self.joints.len(), self.feet),
            },
        }
    }
}

/// As many zeros as a signal has values.
fn nothing(signal: Signal, joints: usize, feet: usize) -> &'static [f32] {
    use crate::expression::Shape;
    const ZEROS: [f32; crate::row::MAX_JOINTS] = [0.0; crate::row::MAX_JOINTS];
    match signal.info().shape {
        Shape::Scalar => &ZEROS[..1],
        Shape::Three => &ZEROS[..3],
        Shape::Joints => &ZEROS[..joints],
        Shape::Feet => &ZEROS[..feet],
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

    fn names() -> (Vec<String>, Vec<String>) {
        let feet = ["FL", "FR", "HL", "HR"].map(str::to_owned);
        ((0..ACT_DIM).map(|i| format!("j{i}")).collect(), feet.to_vec())
    }

    fn joints() -> JointTable {
        JointTable {
            nominal_rad: numbered(1.0),
            lower_rad: numbered(-20.0),
            upper_rad: numbered(20.0),
        }
    }

    #[test]
    fn every_value_lands_where_the_layout_says() {
        let (vel, pos) = (numbered(100.0), numbered(200.0));
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
        let (joint_names, feet) = names();
        for medium in [false, true] {
            let layout = ObservationLayout::new(ACT_DIM, &feet, medium);
            let names = Names { joints: &joint_names, feet: &feet };
            let mut observer = Observer::new(&layout, &joints(), names).unwrap();
            let mut out = vec![f32::NAN; layout.dim()];
            observer.write(&input, None, true, &mut out).unwrap();
            assert!(observer.write(&input, None, true, &mut out[1..]).is_err());
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

    #[test]
    fn a_history_moves_on_and_expressions_see_what_the_sensors_say() {
        let config: ObservationConfig = toml::from_str(
            r#"
            term = [
                { name = "gyro", history = 3 },
                { name = "turn", value = "gyro.z - command_yaw_rate", history = 2 },
                { name = "reach", value = "upper.j1 - joint_pos.j1" },
            ]"#,
        )
        .unwrap();
        config.validate().unwrap();
        let (joint_names, feet) = names();
        let layout = config.layout(&joint_names, &feet, false).unwrap();
        assert_eq!(ObservationConfig::from(&layout), config);
        let names = Names { joints: &joint_names, feet: &feet };
        let mut observer = Observer::new(&layout, &joints(), names).unwrap();
        observer.check_sensed(&layout).unwrap();
        let (vel, pos, actions) = (numbered(0.0), numbered(3.0), [numbered(0.0); 3]);
        let mut out = vec![f32::NAN; layout.dim()];
        let mut write = |turn: f32, fresh| {
            let input = ObservationInput {
                joint_vel_radps: &vel,
                joint_pos_rad: &pos,
                gyro_radps: [0.0, 0.0, turn],
                gravity: [0.0, 0.0, -1.0],
                phase_rad: [0.0; 4].into(),
                command: [0.0, 0.0, 0.5],
                previous_actions: &actions,
                medium: None,
            };
            observer.write(&input, None, fresh, &mut out).unwrap();
            out.clone()
        };
        // 21 − 4 = 17: the upper limit of joint 1 less its position
        let first = [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.5, 17.0];
        assert_eq!(write(1.0, true), first);
        let second = [0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.5, 0.5, 17.0];
        assert_eq!(write(2.0, false), second);
        let third = [0.0, 0.0, 3.0, 0.0, 0.0, 2.0, 0.0, 0.0, 1.0, 2.5, 1.5, 17.0];
        assert_eq!(write(3.0, false), third);
    }

    #[test]
    fn what_the_robot_cannot_measure_is_named() {
        let config = ObservationConfig {
            term: vec![ObservationTerm {
                name: "clearance".into(),
                value: "foot_height".into(),
                ..ObservationTerm::default()
            }],
            ..ObservationConfig::default()
        };
        let (joint_names, feet) = names();
        let layout = config.layout(&joint_names, &feet, false).unwrap();
        let names = Names { joints: &joint_names, feet: &feet };
        let observer = Observer::new(&layout, &joints(), names).unwrap();
        let error = observer.check_sensed(&layout).unwrap_err().to_string();
        assert_eq!(
            error,
            "observation term 'clearance' needs `foot_height`, which the robot cannot measure"
        );
        for bad in ["term = [{ name = \"speed\" }]", "term = [{ name = \"a\", value = \"sped\" }]"]
        {
            let config: ObservationConfig = toml::from_str(bad).unwrap();
            assert!(config.validate().is_err(), "{bad}");
        }
    }
}
