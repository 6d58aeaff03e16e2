//! How long what may take, and how much.

use std::time::Duration;

use caudata_declare::settings;

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

settings! {
    /// How long a fetch bears with a server, and how fast that one must be.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct Patience {
        /// See [`FETCH_IDLE_MAX`].
        pub idle_max: Duration = FETCH_IDLE_MAX,
        /// See [`FETCH_MAX`].
        pub whole_max: Duration = FETCH_MAX,
        /// See [`RATE_WINDOW`].
        pub rate_window: Duration = RATE_WINDOW,
        /// See [`RETRY_PAUSE`].
        pub retry_pause: Duration = RETRY_PAUSE,
    }
}
