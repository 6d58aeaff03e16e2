//! Where each quantity lies in the observation: the one definition, written into every policy file.

use caudata_declare::named;
use serde::{Deserialize, Serialize};

use std::ops::Range;

use crate::expression::{self, Names, Unit};
use crate::{ACTION_HISTORY, COMMAND_DIM, TaskError};

/// Most control steps that a term may hold.
pub const HISTORY_MAX: u32 = 16;
/// Most earlier observations that a policy sees.
const PAST_MAX: usize = 16;
/// Most control steps that it looks back.
const AGE_MAX: u32 = 64;

named! {
    /// The observation terms that are functions here; any other is an expression.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Part {
        /// Joint velocities.
        JointVel = "joint_vel",
        /// Joint position offsets.
        JointPos = "joint_pos_offset",
        /// Angular velocity.
        Gyro = "gyro",
        /// Gravity direction.
        Gravity = "gravity",
        /// Phase: cos, sin of the first foot, then of the next; of the clock for a robot without feet.
        Phase = "phase",
        /// Command.
        Command = "command",
        /// Past actions, newest first.
        Actions = "actions",
        /// Medium bit.
        Medium = "medium",
    }
}

impl Part {
    /// Unit of its values.
    pub fn unit(self) -> &'static str {
        match self {
            Self::JointVel | Self::Gyro => "rad/s",
            Self::JointPos => "rad",
            Self::Command => "m/s m/s rad/s",
            Self::Gravity | Self::Phase | Self::Actions | Self::Medium => "1",
        }
    }

    /// Frame or order of its values, for feet with these names.
    pub fn frame(self, feet: &[String]) -> String {
        match (self, feet) {
            (Self::JointVel, _) => "policy order".to_owned(),
            (Self::JointPos, _) => "policy order, minus nominal".to_owned(),
            (Self::Gyro, _) => "body".to_owned(),
            (Self::Gravity, _) => "body, unit vector, upright is 0 0 -1".to_owned(),
            (Self::Phase, []) => "cos sin of the clock".to_owned(),
            (Self::Phase, feet) => format!("cos sin of {}", feet.join(", ")),
            (Self::Command, _) => "heading: vx, vy, yaw rate".to_owned(),
            (Self::Actions, _) => "policy order, newest first".to_owned(),
            (Self::Medium, _) => "0 on land, 1 in water".to_owned(),
        }
    }

    fn len(self, joints: usize, feet: usize) -> usize {
        match self {
            Self::JointVel | Self::JointPos | Self::Actions => joints,
            Self::Gyro | Self::Gravity => 3,
            Self::Phase => 2 * feet.max(1),
            Self::Command => COMMAND_DIM,
            Self::Medium => 1,
        }
    }
}

/// One named part of the observation.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slice {
    /// Name of the quantity.
    pub name: String,
    /// First index.
    pub start: usize,
    /// Number of values.
    pub len: usize,
    /// SI unit; `1` for pure numbers.
    pub unit: String,
    /// Frame, or order of the values.
    pub frame: String,
    /// The expression that gives the values; none for a term that is a function ([`Part`]).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<String>,
    /// Control steps that it holds, newest first, where that is not the term's usual number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub history: Option<u32>,
}

impl Slice {
    /// How many control steps it holds.
    pub fn steps(&self) -> usize {
        let usual = match self.name == Part::Actions.name() && self.value.is_none() {
            true => ACTION_HISTORY,
            false => 1,
        };
        self.history.map_or(usual, |steps| steps as usize)
    }

    /// Values of one control step.
    pub fn width(&self) -> usize {
        self.len / self.steps().max(1)
    }
}

/// A term that an observation is to have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted<'a> {
    /// Its name.
    pub name: &'a str,
    /// An expression; `None`: the [`Part`] of that name.
    pub value: Option<&'a str>,
    /// Control steps, where not the usual number.
    pub history: Option<u32>,
}

/// The observation's slices, in order and without gaps, and behind them those of earlier control steps.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationLayout {
    slices: Vec<Slice>,
    /// How many control steps ago each earlier observation was, ascending.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    past: Vec<u32>,
}

impl ObservationLayout {
    /// The standard layout for a robot with that many actuated joints and these feet; with the medium bit of
    /// amphibious tasks where `medium` asks for it.
    pub fn new(joints: usize, feet: &[String], medium: bool) -> Self {
        let parts = Part::ALL.into_iter().filter(|&part| medium || part != Part::Medium);
        let mut layout = Self::default();
        for part in parts {
            layout.push_part(part, None, joints, feet);
        }
        layout
    }

    /// The layout with these terms in this order.
    ///
    /// # Errors
    /// [`TaskError::Term`] for a term that is unknown, or whose expression or history is wrong.
    pub fn of(terms: &[Wanted<'_>], joints: &[String], feet: &[String]) -> Result<Self, TaskError> {
        let mut layout = Self::default();
        for term in terms {
            let wrong =
                |reason: String| TaskError::term("task.observation.term", term.name, reason);
            if layout.slice(term.name).is_some() {
                return Err(wrong("is there twice".to_owned()));
            }
            if term.history.is_some_and(|steps| !(1..=HISTORY_MAX).contains(&steps)) {
                return Err(wrong(format!("has a history that is not 1 to {HISTORY_MAX}")));
            }
            match (Part::of_name(term.name), term.value) {
                (Some(Part::Actions), None)
                    if term.history.is_some_and(|steps| steps as usize > ACTION_HISTORY) =>
                {
                    return Err(wrong(format!("keeps at most {ACTION_HISTORY} steps")));
                }
                (Some(part), None) => layout.push_part(part, term.history, joints.len(), feet),
                (_, Some(value)) => layout.push_value(term, value, joints, feet).map_err(wrong)?,
                (None, None) => {
                    let known = Part::ALL.map(Part::name).join(", ");
                    return Err(wrong(format!("has no value and is none of: {known}")));
                }
            }
        }
        match layout.present_dim() {
            0 => Err(TaskError::term("task.observation", "term", "gives no value".to_owned())),
            _ => Ok(layout),
        }
    }

    fn push_part(&mut self, part: Part, history: Option<u32>, joints: usize, feet: &[String]) {
        let mut slice = Slice {
            name: part.name().to_owned(),
            start: self.present_dim(),
            len: 0,
            unit: part.unit().to_owned(),
            frame: part.frame(feet),
            value: None,
            history,
        };
        slice.len = slice.steps() * part.len(joints, feet.len());
        self.slices.push(slice);
    }

    fn push_value(
        &mut self,
        term: &Wanted<'_>,
        value: &str,
        joints: &[String],
        feet: &[String],
    ) -> Result<(), String> {
        let word = |c: char| c.is_ascii_alphanumeric() || c == '_';
        if term.name.is_empty() || term.name.len() > 40 || !term.name.chars().all(word) {
            return Err("has a name that is not 1 to 40 letters, digits and _".to_owned());
        }
        let program = expression::compile(value, Names { joints, feet })?;
        self.slices.push(Slice {
            name: term.name.to_owned(),
            start: self.present_dim(),
            len: program.len() * term.history.unwrap_or(1) as usize,
            unit: program.unit().unwrap_or(Unit::ONE).to_string(),
            frame: program.shape().name().to_owned(),
            value: Some(value.to_owned()),
            history: term.history,
        });
        Ok(())
    }

    /// The same with observations of so many control steps ago behind it (see [`Self::recalled`]).
    ///
    /// # Errors
    /// [`TaskError::Term`] where these are not ascending, too many or too long ago.
    pub fn with_past(self, past: &[u32]) -> Result<Self, TaskError> {
        check_past(past)?;
        Ok(Self { past: past.to_vec(), ..self })
    }

    /// How many control steps ago each earlier observation was, ascending.
    pub fn past(&self) -> &[u32] {
        &self.past
    }

    /// What an observation has of an earlier one: the newest of each term, without clock and command, of which the
    /// present ones tell.
    pub fn recalled(&self) -> impl Iterator<Item = Range<usize>> {
        let repeats = [Part::Phase, Part::Command].map(Part::name);
        let kept = move |s: &&Slice| s.value.is_some() || !repeats.contains(&s.name.as_str());
        self.slices.iter().filter(kept).map(|s| s.start..s.start + s.width())
    }

    /// Whether observations of `other` are the first values of those of this layout.
    pub fn begins_with(&self, other: &Self) -> bool {
        let alike = self.slices.len() == other.slices.len();
        self.slices.starts_with(&other.slices)
            && (other.past.is_empty() || alike && self.past.starts_with(&other.past))
    }

    /// The terms that it is made of.
    pub fn terms(&self) -> Vec<Wanted<'_>> {
        let term = |slice| {
            let Slice { name, value, history, .. }: &Slice = slice;
            Wanted { name, value: value.as_deref(), history: *history }
        };
        self.slices.iter().map(term).collect()
    }

    /// Where a part lies; empty for one that the layout lacks.
    pub fn range(&self, part: Part) -> Range<usize> {
        let named = |s: &&Slice| s.value.is_none() && s.name == part.name();
        let slice = self.slices.iter().find(named);
        slice.map_or(0..0, |s| s.start..s.start.saturating_add(s.len))
    }

    /// The slices, in order.
    pub fn slices(&self) -> &[Slice] {
        &self.slices
    }

    /// The slice called `name`.
    pub fn slice(&self, name: &str) -> Option<&Slice> {
        self.slices.iter().find(|s| s.name == name)
    }

    /// Number of values in an observation, what it has of earlier ones included.
    pub fn dim(&self) -> usize {
        let recalled: usize = self.recalled().map(|range| range.len()).sum();
        self.present_dim() + self.past.len() * recalled
    }

    /// Number of values that are of the present.
    pub fn present_dim(&self) -> usize {
        self.slices.iter().map(|s| s.len).sum()
    }
}

/// Refuses ages that are not ascending, too many or too long ago: they bound a robot's memory.
pub(crate) fn check_past(ages: &[u32]) -> Result<(), TaskError> {
    let ascending = ages.windows(2).all(|pair| pair[0] < pair[1]);
    let within = ages.iter().all(|age| (1..=AGE_MAX).contains(age));
    if ascending && within && ages.len() <= PAST_MAX {
        return Ok(());
    }
    let reason = format!("must be at most {PAST_MAX} ascending numbers of 1 to {AGE_MAX}");
    Err(TaskError::term("task.observation", "past", reason))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn layout(medium: bool) -> ObservationLayout {
        let feet = ["FL", "FR", "HL", "HR"].map(str::to_owned);
        ObservationLayout::new(16, &feet, medium)
    }

    #[test]
    fn land_layout_is_the_documented_order_without_gaps() {
        // 16 + 16 + 3 + 3 + 8 + 3 + 48 = 97
        let layout = layout(false);
        let found: Vec<_> =
            layout.slices().iter().map(|s| (s.name.as_str(), s.start, s.len)).collect();
        assert_eq!(
            found,
            [
                ("joint_vel", 0, 16),
                ("joint_pos_offset", 16, 16),
                ("gyro", 32, 3),
                ("gravity", 35, 3),
                ("phase", 38, 8),
                ("command", 46, 3),
                ("actions", 49, 48),
            ]
        );
        assert_eq!(layout.dim(), 97);
        assert!(layout.range(Part::Medium).is_empty());
    }

    #[test]
    fn amphibious_layout_appends_the_medium_bit() {
        let layout = layout(true);
        assert_eq!(layout.dim(), 98);
        let medium = layout.slice("medium").unwrap();
        assert_eq!((medium.start, medium.len), (97, 1));
        assert_eq!(layout.range(Part::Medium), 97..98);
        assert!(layout.slice("lin_vel").is_none());
    }

    #[test]
    fn sizes_are_the_robots() {
        // a biped of 14 servos: 14 + 14 + 3 + 3 + 4 + 3 + 42 = 83
        let feet = ["L", "R"].map(str::to_owned);
        let biped = ObservationLayout::new(14, &feet, false);
        assert_eq!(biped.dim(), 83);
        assert_eq!(biped.range(Part::Actions), 41..83);
        // a snake of 12 has no feet, and the clock in their place
        let snake = ObservationLayout::new(12, &[], false);
        assert_eq!(snake.dim(), 71);
        assert_eq!(snake.slice("phase").unwrap().frame, "cos sin of the clock");
    }

    fn wanted<'a>(name: &'a str, value: Option<&'a str>, history: Option<u32>) -> Wanted<'a> {
        Wanted { name, value, history }
    }

    #[test]
    fn terms_and_layouts_say_the_same() {
        let joints = ["hip", "knee"].map(str::to_owned);
        let feet = ["L", "R"].map(str::to_owned);
        let standard = ObservationLayout::new(2, &feet, true);
        let again = ObservationLayout::of(&standard.terms(), &joints, &feet).unwrap();
        assert_eq!(again, standard);
        let own = [
            wanted("gyro", None, Some(3)),
            wanted("lean", Some("gravity.x + 0.1 * gyro.y / joint_vel.hip"), None),
            wanted("effort", Some("torque"), Some(2)),
            wanted("actions", None, Some(1)),
        ];
        let layout = ObservationLayout::of(&own, &joints, &feet).unwrap();
        let found: Vec<_> = layout.slices().iter().map(|s| (s.start, s.len)).collect();
        assert_eq!(found, [(0, 9), (9, 1), (10, 4), (14, 2)]);
        assert_eq!(layout.slice("effort").unwrap().unit, "N·m");
        assert_eq!(layout.terms(), own);
        let json = serde_json::to_string(&layout).unwrap();
        assert_eq!(serde_json::from_str::<ObservationLayout>(&json).unwrap(), layout);
        // a standard layout is written as it always was
        assert!(!serde_json::to_string(&standard).unwrap().contains("history"));
    }

    #[test]
    fn wrong_terms_are_named() {
        let joints = ["hip"].map(str::to_owned);
        for (term, reason) in [
            (wanted("speed", None, None), "none of: joint_vel"),
            (wanted("gyro", None, Some(17)), "not 1 to 16"),
            (wanted("actions", None, Some(4)), "at most 3"),
            (wanted("a", Some("torque.knee"), None), "has: hip"),
            (wanted("a b", Some("height"), None), "letters"),
        ] {
            let error = ObservationLayout::of(&[term], &joints, &[]).unwrap_err().to_string();
            assert!(error.contains(reason), "{error}");
        }
        let twice = [wanted("gyro", None, None), wanted("gyro", None, None)];
        assert!(ObservationLayout::of(&twice, &joints, &[]).is_err());
        assert!(ObservationLayout::of(&[], &joints, &[]).is_err());
    }
}
