//! Where each quantity lies in the observation: the one definition, written into every policy file.

use serde::{Deserialize, Serialize};

use crate::{ACT_DIM, ACTION_HISTORY, COMMAND_DIM, FEET};

/// First index of the joint velocities.
pub const JOINT_VEL: usize = 0;
/// First index of the joint position offsets.
pub const JOINT_POS: usize = JOINT_VEL + ACT_DIM;
/// First index of the angular velocity.
pub const GYRO: usize = JOINT_POS + ACT_DIM;
/// First index of the gravity direction.
pub const GRAVITY: usize = GYRO + 3;
/// First index of the phase: cos, sin of FL, then of FR, HL, HR.
pub const PHASE: usize = GRAVITY + 3;
/// First index of the command.
pub const COMMAND: usize = PHASE + 2 * FEET;
/// First index of the past actions, newest first.
pub const ACTIONS: usize = COMMAND + COMMAND_DIM;
/// Index of the medium bit, where there is one.
pub const MEDIUM: usize = ACTIONS + ACTION_HISTORY * ACT_DIM;
/// Length of the observation on land (97).
pub const OBS_DIM: usize = MEDIUM;

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
    /// The layout on land (97 values), or with the medium bit of amphibious tasks (98).
    pub fn new(medium: bool) -> Self {
        let table = [
            ("joint_vel", JOINT_VEL, ACT_DIM, "rad/s", "policy order"),
            (
                "joint_pos_offset",
                JOINT_POS,
                ACT_DIM,
                "rad",
                "policy order, minus nominal",
            ),
            ("gyro", GYRO, 3, "rad/s", "body"),
            (
                "gravity",
                GRAVITY,
                3,
                "1",
                "body, unit vector, upright is 0 0 -1",
            ),
            ("phase", PHASE, 2 * FEET, "1", "cos sin of FL, FR, HL, HR"),
            (
                "command",
                COMMAND,
                COMMAND_DIM,
                "m/s m/s rad/s",
                "heading: vx, vy, yaw rate",
            ),
            (
                "actions",
                ACTIONS,
                ACTION_HISTORY * ACT_DIM,
                "1",
                "policy order, newest first",
            ),
            ("medium", MEDIUM, 1, "1", "0 on land, 1 in water"),
        ];
        let parts = if medium { table.len() } else { table.len() - 1 };
        let slices = table[..parts]
            .iter()
            .map(|&(name, start, len, unit, frame)| Slice {
                name: name.to_owned(),
                start,
                len,
                unit: unit.to_owned(),
                frame: frame.to_owned(),
            })
            .collect();
        Self { slices }
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

    /// Whether the medium bit is part of it.
    pub fn has_medium(&self) -> bool {
        self.slice("medium").is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn land_layout_is_the_documented_order_without_gaps() {
        // 16 + 16 + 3 + 3 + 8 + 3 + 48 = 97
        let layout = ObservationLayout::new(false);
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
        assert_eq!(layout.dim(), OBS_DIM);
        assert!(!layout.has_medium());
    }

    #[test]
    fn amphibious_layout_appends_the_medium_bit() {
        let layout = ObservationLayout::new(true);
        assert_eq!(layout.dim(), 98);
        let medium = layout.slice("medium").unwrap();
        assert_eq!((medium.start, medium.len), (97, 1));
        assert!(layout.has_medium());
        assert!(layout.slice("lin_vel").is_none());
    }
}
