//! The page of an evaluation, and the shipped policies.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod by_hand;
mod page;
mod policies;
