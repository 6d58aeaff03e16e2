//! Typed client of the policy server: publish, list, fetch with resume, watch.
//!
//! Every answer is checked (`caudata-proto`) before a caller sees it, and held against its question; every call has a
//! deadline, and a fetch that is cut goes on where it stopped. The bytes that [`RegistryClient::fetch`] returns hash to
//! what was asked for.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod client;
mod error;
mod fetch;
mod manifest;
mod watch;

pub use client::RegistryClient;
pub use error::ClientError;
pub use fetch::{Patience, jittered};
pub use manifest::manifest_of;
pub use watch::Watch;

use std::time::Duration;

/// Time to reach the server.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for one call that is not a stream.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(30);
/// Longest silence within a fetch.
pub const FETCH_IDLE_MAX: Duration = Duration::from_secs(15);
/// How often a cut fetch is taken up again.
pub const FETCH_RETRIES: u32 = 5;
/// First pause before a retry; doubles each time.
pub const RETRY_PAUSE: Duration = Duration::from_millis(200);
/// Longest pause before a retry.
pub const RETRY_PAUSE_MAX: Duration = Duration::from_secs(5);
/// Least bytes per second of a fetch, over [`RATE_WINDOW`]: a server that drips holds nobody for ever.
pub const RATE_MIN: u64 = 4 << 10;
/// Over how long the rate is judged.
pub const RATE_WINDOW: Duration = Duration::from_secs(30);
/// Longest time for one file, whatever the rate.
pub const FETCH_MAX: Duration = Duration::from_secs(600);
/// A watch that is silent for this long is dead: the server sends progress every 10 s.
pub const WATCH_IDLE_MAX: Duration = Duration::from_secs(35);
