//! Numbers that tell links and learner processes apart.

use std::hash::{BuildHasher, RandomState};
use std::time::SystemTime;

/// A number that no other link or learner process has, on this host or another. Identity only: never part of
/// any result.
pub(crate) fn fresh() -> u64 {
    // RandomState has a key from the system's random source; time and process make a repeat harmless to
    // expect.
    RandomState::new().hash_one((std::process::id(), SystemTime::now()))
}
