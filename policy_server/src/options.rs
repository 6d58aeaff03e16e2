//! How to serve.

use std::sync::Arc;
use std::time::Duration;

use caudata_declare::settings;
use caudata_signing::ReleaseKey;
use caudata_telemetry::ConnectionLimits;
use tokio_rustls::TlsAcceptor;

use crate::uploads::UPLOAD_IDLE_MAX;

/// A client must take a piece of an answer that waits for it (a watch, a fetch) within this time.
pub const REPLY_IDLE_MAX: Duration = Duration::from_secs(60);
/// How often a store that cannot write looks whether it can again.
const PROBE_PAUSE: Duration = Duration::from_secs(5);

settings! {
    /// When a silent connection is given up.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Keepalive {
        /// A connection that is silent for this long is asked for a sign of life.
        pub interval: Duration = Duration::from_secs(30),
        /// Without one for this long it is closed.
        pub timeout: Duration = Duration::from_secs(20),
    }
}

settings! {
    /// How to serve.
    #[derive(Clone)]
    pub struct ServeOptions {
        /// When a silent connection is given up.
        pub keepalive: Keepalive,
        /// Clients show a certificate, and its role decides what they may do; `None`: plain, for this host
        /// only.
        pub tls: Option<TlsAcceptor>,
        /// Signs where labels lead; `None`: the server cannot say so.
        pub fresh_key: Option<Arc<ReleaseKey>>,
        /// How many connections.
        pub connections: ConnectionLimits,
        /// A publisher must send its next piece within this time, [`UPLOAD_IDLE_MAX`] unless told otherwise.
        /// Too short: publishers behind a poor network are cut off; too long: one that died holds its place
        /// and the bytes that came.
        pub upload_idle: Duration = UPLOAD_IDLE_MAX,
        /// A client must take a piece of an answer that waits for it (a watch, a fetch) within this time,
        /// [`REPLY_IDLE_MAX`] unless told otherwise. Too short: robots behind a poor network are cut off and
        /// have to ask again; too long: one that hangs holds its place and what waits for it.
        pub reply_idle: Duration = REPLY_IDLE_MAX,
        /// How often a store that cannot write looks whether it can again.
        pub probe_pause: Duration = PROBE_PAUSE,
    }
}
