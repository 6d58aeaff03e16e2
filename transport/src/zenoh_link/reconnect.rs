//! When an actor that hears nothing tries another connection. Pure: the caller has the clock.

use std::time::{Duration, Instant};

use crate::Limits;

/// Pauses between attempts grow to so many times the first one.
const PAUSE_GROWS: u32 = 16;

/// Whether nothing has been heard for so long that another connection is worth a try: half the peer time-out,
/// so that a learner that is killed and back is found not long after its absence counts as one.
pub(super) fn is_silent(limits: &Limits, heard: Option<Instant>) -> bool {
    heard.is_none_or(|heard| heard.elapsed() >= patience(limits))
}

fn patience(limits: &Limits) -> Duration {
    limits.peer_timeout() / 2
}

/// Says when the next attempt is due.
pub(super) struct Reconnect {
    first_pause: Duration,
    pause: Duration,
    /// The last sign of life.
    heard: Option<Instant>,
    due: Instant,
}

impl Reconnect {
    /// For link number `link`, connected at `now`. Links wait for different times, up to a half longer, so
    /// that the actors of a learner do not all come back in one moment.
    pub fn new(limits: &Limits, link: u64, now: Instant) -> Self {
        let patience = patience(limits);
        let spread = patience.mul_f64((link % 1024) as f64 / 2048.0);
        Self {
            first_pause: patience + spread,
            pause: patience + spread,
            heard: None,
            due: now + patience + spread,
        }
    }

    /// The last time that anything was heard.
    pub fn heard(&mut self, heard: Option<Instant>) {
        let Some(at) = heard.filter(|_| heard > self.heard) else { return };
        self.heard = heard;
        self.pause = self.first_pause;
        self.due = at + self.pause;
    }

    pub fn is_due(&self, now: Instant) -> bool {
        now >= self.due
    }

    /// An attempt has ended, well or not.
    pub fn tried(&mut self, now: Instant) {
        self.due = now + self.pause;
        self.pause = (2 * self.pause).min(PAUSE_GROWS * self.first_pause);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn reconnect(link: u64, now: Instant) -> Reconnect {
        let limits = Limits { peer_timeout_ms: 2_000, ..Limits::default() };
        Reconnect::new(&limits, link, now)
    }

    /// Half of 2 s of silence, then after 1, 2, 4, 8, 16 and 16 s; a sign of life sets it back.
    #[test]
    fn attempts_come_after_silence_and_then_more_rarely() {
        let start = Instant::now();
        let mut reconnect = reconnect(0, start);
        let at = |ms: u32| start + ms * MS;
        assert!(!reconnect.is_due(at(999)) && reconnect.is_due(at(1_000)));
        let mut tried = 1_000;
        for pause in [1_000, 2_000, 4_000, 8_000, 16_000, 16_000] {
            reconnect.tried(at(tried));
            tried += pause;
            assert!(!reconnect.is_due(at(tried - 1)) && reconnect.is_due(at(tried)));
        }
        reconnect.heard(Some(at(70_000)));
        assert!(!reconnect.is_due(at(70_999)) && reconnect.is_due(at(71_000)));
        // The same sign of life again is none.
        reconnect.tried(at(71_000));
        reconnect.heard(Some(at(70_000)));
        assert!(!reconnect.is_due(at(71_999)) && reconnect.is_due(at(72_000)));
    }

    #[test]
    fn links_do_not_all_come_at_once() {
        let start = Instant::now();
        // 512 of 1024: a quarter later than the first.
        let late = reconnect(512, start);
        assert!(!late.is_due(start + 1_249 * MS) && late.is_due(start + 1_250 * MS));
    }
}
