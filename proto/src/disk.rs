//! How messages look in files: states as words.

use serde::{Deserialize, Deserializer, Serializer};

use crate::registry::RobotState;

/// For serde: the state of a report as its word.
pub(crate) mod state_word {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(state: &i32, to: S) -> Result<S::Ok, S::Error> {
        match RobotState::of_number(*state) {
            Some(state) => to.serialize_str(state.name()),
            None => Err(serde::ser::Error::custom("not a state of a report")),
        }
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<i32, D::Error> {
        let word = String::deserialize(from)?;
        match RobotState::of_name(&word) {
            Some(state) => Ok(state.number()),
            None => Err(serde::de::Error::custom(format!("`{word}` is not a state of a report"))),
        }
    }
}
