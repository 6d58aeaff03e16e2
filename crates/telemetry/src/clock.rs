//! The time of day, as what is written down has it.

use std::time::SystemTime;

/// Time since 1970, ns; 0 before, which is a wrong clock.
pub fn now_ns() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |since| u64::try_from(since.as_nanos()).unwrap_or(u64::MAX))
}

/// The same, ms.
pub fn unix_ms() -> u64 {
    now_ns() / 1_000_000
}
