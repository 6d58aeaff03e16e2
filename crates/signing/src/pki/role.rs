//! What a process is, and so what it may ask of others.

use std::fmt;
use std::str::FromStr;

use super::error::PkiError;

/// What a process is. The word is the common name of its certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Role {
    /// Receives rollouts, publishes policies.
    Learner,
    /// Sends rollouts, receives policies of its learner.
    Actor,
    /// The policy server.
    Server,
    /// A zenoh router between learner and actors.
    Router,
    /// A person: lists and pulls policies, moves labels.
    Operator,
    /// A robot: pulls policies and reports how they did.
    Robot,
}

impl Role {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::Learner,
        Self::Actor,
        Self::Server,
        Self::Router,
        Self::Operator,
        Self::Robot,
    ];

    /// The common name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Learner => "learner",
            Self::Actor => "actor",
            Self::Server => "server",
            Self::Router => "router",
            Self::Operator => "operator",
            Self::Robot => "robot",
        }
    }

    /// Whether others connect to it, so that its certificate must name its hosts.
    #[must_use]
    pub fn listens(self) -> bool {
        matches!(self, Self::Learner | Self::Server | Self::Router)
    }

    /// Whether it connects to others.
    #[must_use]
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
        let found = Self::ALL.into_iter().find(|role| role.name() == word);
        found.ok_or_else(|| PkiError::Role(word.to_owned()))
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
