//! Typed client of the policy server: publish, list, fetch with resume, watch.
//!
//! Every answer is checked (`caudata-proto`) before a caller sees it, and held against its question; every
//! call has a deadline, and a fetch that is cut goes on where it stopped. The bytes that
//! [`RegistryClient::fetch`] returns hash to what was asked for.

mod call;
mod client;
mod error;
mod fetch;
mod limits;
mod manifest;
mod watch;

pub use client::{RegistryClient, is_loopback};
pub use error::ClientError;
pub use fetch::jittered;
pub use limits::{
    CALL_TIMEOUT, CONNECT_TIMEOUT, FETCH_IDLE_MAX, FETCH_MAX, FETCH_RETRIES, Patience, RATE_MIN,
    RATE_WINDOW, RETRY_PAUSE, RETRY_PAUSE_MAX, WATCH_IDLE_MAX,
};
pub use manifest::manifest_of;
pub use watch::Watch;
