//! The registry of policies: content-addressed store and gRPC service.
//!
//! *Invariant:* a version is whole or absent, and the bytes under a hash never change.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod access;
mod audit;
mod error;
mod labels;
mod limits;
mod metrics;
mod notes;
mod page;
mod record;
mod replies;
mod server;
mod service;
mod steps;
mod store;
#[cfg(test)]
mod testing;

pub use access::tls_config;
pub use audit::{Deed, Origin};
pub use error::StoreError;
pub use labels::Change;
pub use limits::{CONNECTIONS_MAX, ConnectionLimits, PEER_CONNECTIONS_MAX};
pub use metrics::ServerMetrics;
pub use page::serve_page;
pub use record::{RECORD_FORMAT, Record, RecordError};
pub use server::{
    DRAIN_MAX, Keepalive, ServeError, ServeOptions, listen, serve, serve_tls, serve_with,
};
pub use service::{
    LIST_MAX, REPLY_IDLE_MAX, RegistryService, SharedStore, UPLOAD_IDLE_MAX, WATCH_PROGRESS,
};
pub use store::{LABELS_MAX, Published, Store, StoreLimits, hex};
