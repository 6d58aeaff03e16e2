//! Bad networks for tests: a proxy for datagrams with weather in it ([`proxy`]), one for connections that can
//! be cut ([`Wire`]), and hosts that nothing but a proxy joins ([`World`]). No program links this crate.
//!
//! What goes wrong here ends the test: these functions panic.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod datagrams;
mod dice;
mod wire;

pub use datagrams::{Weather, World, proxy};
pub use dice::Dice;
pub use wire::Wire;
