//! Why a process cannot serve its metrics.

use std::io;
use std::net::SocketAddr;

/// Why the endpoint could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Another process listens there.
    #[error("metrics address {0} is in use")]
    InUse(SocketAddr),
    /// The system refuses the address or the thread.
    #[error("cannot serve metrics on {addr}: {source}")]
    Io {
        /// The address asked for.
        addr: SocketAddr,
        /// What the system said.
        source: io::Error,
    },
}
