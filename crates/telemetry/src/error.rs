//! Why a process cannot serve over HTTP what it measures, or a page.

use std::io;
use std::net::SocketAddr;

/// Why the endpoint could not be opened.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ServeError {
    /// Another process listens there.
    #[error(
        "{0} is in use by another process; give another address, or port 0 for any that is free"
    )]
    InUse(SocketAddr),
    /// The system refuses the address or the thread.
    #[error("cannot listen on {addr}: {source}")]
    Io { addr: SocketAddr, source: io::Error },
}

impl ServeError {
    /// What the system says about `addr`.
    pub fn of(addr: SocketAddr, source: io::Error) -> Self {
        match source.kind() {
            io::ErrorKind::AddrInUse => Self::InUse(addr),
            _ => Self::Io { addr, source },
        }
    }
}
