//! The page of an evaluation, policies whose verdict is known, and another engine.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used)]

mod by_hand;
mod engines;
mod page;
mod policies;
