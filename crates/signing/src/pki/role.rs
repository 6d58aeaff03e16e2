//! What a process is, and so what it may ask of others.

use std::fmt;
use std::str::FromStr;

use caudata_declare::named;

use super::error::PkiError;

named! {
    /// What a process is. The word is the common name of its certificate.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
    pub enum Role {
        /// Receives rollouts, publishes policies.
        Learner = "learner",
        /// Sends rollouts, receives policies of its learner.
        Actor = "actor",
        /// The policy server.
        Server = "server",
        /// A zenoh router between learner and actors.
        Router = "router",
        /// A person: lists and pulls policies, moves labels.
        Operator = "operator",
        /// A robot: pulls policies and reports how they did.
        Robot = "robot",
    }
}

impl Role {
    /// Whether others connect to it, so that its certificate must name its hosts.
    pub fn listens(self) -> bool {
        matches!(self, Self::Learner | Self::Server | Self::Router)
    }

    /// Whether it connects to others.
    pub fn connects(self) -> bool {
        !matches!(self, Self::Server)
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Role {
    type Err = PkiError;

    fn from_str(word: &str) -> Result<Self, PkiError> {
        Self::of_name(word).ok_or_else(|| PkiError::Role(word.to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_role_is_its_word_and_other_words_are_none() {
        for role in Role::ALL {
            assert_eq!(role.name().parse::<Role>().unwrap(), role);
        }
        for word in ["Actor", "actors", "", "root"] {
            assert!(word.parse::<Role>().is_err(), "{word}");
        }
    }
}
