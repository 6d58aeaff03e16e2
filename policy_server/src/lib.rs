//! The registry of policies: content-addressed store and gRPC service.
//!
//! *Invariant:* a version is whole or absent, and the bytes under a hash never change.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod access;
mod error;
mod metrics;
mod record;
mod server;
mod service;
mod store;
#[cfg(test)]
mod testing;

pub use access::tls_config;
pub use error::StoreError;
pub use metrics::ServerMetrics;
pub use record::{RECORD_FORMAT, Record, RecordError};
pub use server::{DRAIN_MAX, Keepalive, ServeError, listen, serve, serve_tls, serve_with};
pub use service::{LIST_MAX, RegistryService, UPLOAD_IDLE_MAX, WATCH_PROGRESS};
pub use store::{Published, Store, StoreLimits, hex};
