//! What is shared out by host.

use std::net::IpAddr;
use std::sync::{Arc, Weak};

use caudata_telemetry::ConnectionLimits;
use parking_lot::Mutex;

/// Fetches at once, altogether and from one other host: each holds a few pieces of a file, and all hold one
/// file together.
pub const FETCHES_MAX: ConnectionLimits = ConnectionLimits { total: 256, per_peer: 64 };

/// Counts what is shared out by host, such as fetches.
#[derive(Debug)]
pub struct Shares {
    limits: ConnectionLimits,
    taken: Mutex<Vec<(IpAddr, Weak<()>)>>,
}

/// See [`Shares::take`].
pub type Share = Arc<()>;

impl Shares {
    pub fn new(limits: ConnectionLimits) -> Self {
        Self { limits, taken: Mutex::default() }
    }

    /// A share of `peer`, given back when dropped; `None`: there is none left.
    pub fn take(&self, peer: IpAddr) -> Option<Share> {
        let mut taken = self.taken.lock();
        taken.retain(|(_, share)| share.strong_count() > 0);
        let of_peer = taken.iter().filter(|(host, _)| *host == peer).count();
        if taken.len() >= self.limits.total || self.limits.is_full(peer, of_peer) {
            return None;
        }
        let share = Share::default();
        taken.push((peer, Arc::downgrade(&share)));
        Some(share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_counted_and_given_back() {
        let host = |last: u8| IpAddr::from([10, 0, 0, last]);
        let shares = Shares::new(ConnectionLimits { total: 3, per_peer: 2 });
        let (a, _b) = (shares.take(host(1)).unwrap(), shares.take(host(1)).unwrap());
        assert!(shares.take(host(1)).is_none());
        drop(a);
        let _c = shares.take(host(1)).unwrap();
        let _d = shares.take(host(2)).unwrap();
        assert!(shares.take(host(3)).is_none());
    }
}
