//! The registry of policies: content-addressed store and gRPC service.
//!
//! *Invariant:* a version is whole or absent, and the bytes under a hash never change.

mod access;
mod audit;
mod checks;
mod damage;
mod error;
mod fetches;
mod files;
mod labels;
mod limits;
mod load;
mod metrics;
mod notes;
mod options;
mod page;
mod quota;
mod record;
mod replies;
mod server;
mod service;
mod shared;
mod store;
#[cfg(test)]
mod testing;
mod uploads;
mod watches;

pub use audit::{Deed, Origin};
pub use error::{RecordError, StoreError};
pub use labels::{Change, LABELS_MAX, QUARANTINED_MAX};
pub use metrics::ServerMetrics;
pub use options::{Keepalive, REPLY_IDLE_MAX, ServeOptions};
pub use page::serve_page;
pub use record::{RECORD_FORMAT, Record};
pub use server::{DRAIN_MAX, ServeError, listen, serve_with};
pub use service::{LIST_MAX, RegistryService};
pub use shared::SharedStore;
pub use store::{Published, Store, StoreLimits};
pub use uploads::UPLOAD_IDLE_MAX;
pub use watches::WATCH_PROGRESS;
