//! Where each quantity lies in the observation: the one definition, written into every policy file.

use serde::{Deserialize, Serialize};

use std::ops::Range;

use crate::{ACTION_HISTORY, COMMAND_DIM};

/// The parts of every observation, in order; the medium bit only where a layout has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Joint velocities.
    JointVel,
    /// Joint position offsets.
    JointPos,
    /// Angular velocity.
    Gyro,
    /// Gravity direction.
    Gravity,
    /// Phase: cos, sin of the first foot, then of the next; of the clock for a robot without feet.
    Phase,
    /// Command.
    Command,
    /// Past actions, newest first.
    Actions,
    /// Medium bit.
    Medium,
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
}

/// The observation's slices, in order and without gaps.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObservationLayout {
    slices: Vec<Slice>,
}

impl ObservationLayout {
    /// The layout for a robot with that many actuated joints and these feet; with the medium bit of
    /// amphibious tasks where `medium` asks for it.
    pub fn new(joints: usize, feet: &[String], medium: bool) -> Self {
        let phases = match feet {
            [] => "cos sin of the clock".to_owned(),
            names => format!("cos sin of {}", names.join(", ")),
        };
        let command = "heading: vx, vy, yaw rate";
        #[rustfmt::skip]
        let table = [
            ("joint_vel", joints, "rad/s", "policy order"),
            ("joint_pos_offset", joints, "rad", "policy order, minus nominal"),
            ("gyro", 3, "rad/s", "body"),
            ("gravity", 3, "1", "body, unit vector, upright is 0 0 -1"),
            ("phase", 2 * feet.len().max(1), "1", phases.as_str()),
            ("command", COMMAND_DIM, "m/s m/s rad/s", command),
            ("actions", ACTION_HISTORY * joints, "1", "policy order, newest first"),
            ("medium", 1, "1", "0 on land, 1 in water"),
        ];
        let parts = if medium { table.len() } else { table.len() - 1 };
        let mut start = 0;
        let mut slice = |&(name, len, unit, frame): &(&str, usize, &str, &str)| {
            start += len;
            Slice {
                name: name.to_owned(),
                start: start - len,
                len,
                unit: unit.to_owned(),
                frame: frame.to_owned(),
            }
        };
        Self {
            slices: table[..parts].iter().map(&mut slice).collect(),
        }
    }

    /// Where a part lies; empty for one that the layout lacks.
    #[inline]
    pub fn range(&self, part: Part) -> Range<usize> {
        self.slices
            .get(part as usize)
            .map_or(0..0, |s| s.start..s.start.saturating_add(s.len))
    }

    /// Number of phases: one per foot, one of the clock for a robot without feet.
    pub fn phases(&self) -> usize {
        self.range(Part::Phase).len() / 2
    }

    /// The slices, in order.
    pub fn slices(&self) -> &[Slice] {
        &self.slices
    }

    /// The slice called `name`.
    pub fn slice(&self, name: &str) -> Option<&Slice> {
        self.slices.iter().find(|s| s.name == name)
    }

    /// Number of values in an observation.
    pub fn dim(&self) -> usize {
        self.slices.iter().map(|s| s.len).sum()
    }
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
        let found: Vec<_> = layout
            .slices()
            .iter()
            .map(|s| (s.name.as_str(), s.start, s.len))
            .collect();
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
        assert_eq!((biped.dim(), biped.phases()), (83, 2));
        assert_eq!(biped.range(Part::Actions), 41..83);
        // a snake of 12 has no feet, and the clock in their place
        let snake = ObservationLayout::new(12, &[], false);
        assert_eq!((snake.dim(), snake.phases()), (71, 1));
        assert_eq!(snake.slice("phase").unwrap().frame, "cos sin of the clock");
    }
}
