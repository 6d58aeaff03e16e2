//! Bad networks for tests: a proxy for datagrams with weather in it ([`proxy`]), one for connections that can
//! be cut ([`Wire`]), and hosts that nothing but a proxy joins ([`World`]). No program links this crate.
//!
//! What goes wrong here ends the test: these functions panic.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod datagrams;
mod dice;
mod wire;

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicU16, Ordering};

pub use datagrams::{Weather, World, proxy};
pub use dice::Dice;
pub use wire::Wire;

/// An address of this machine that nobody else takes: a process has a host of its own in 127.0.0.0/8, and
/// each call another port of it. A port that was free a moment ago is no such address: where the test that
/// found it closed it, it may still be open in the child of another test that is just being started.
#[must_use]
pub fn own_address() -> SocketAddr {
    static NEXT: AtomicU16 = AtomicU16::new(20_000);
    let [_, a, b, c] = std::process::id().to_be_bytes();
    let host = Ipv4Addr::new(127, 64 | a, b, c);
    (host, NEXT.fetch_add(1, Ordering::Relaxed)).into()
}
