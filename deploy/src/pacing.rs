//! When the next control tick is due: an absolute grid of times, so that delays never add up and missed ticks
//! are never replayed.

use std::time::{Duration, Instant};

/// Where the loop gets time from; tests use one of their own.
pub trait Clock {
    /// Time since some fixed moment.
    fn now(&self) -> Duration;
    /// Returns at `time` or later; at once where that has passed.
    fn sleep_until(&self, time: Duration);
}

/// The machine's monotonic clock.
#[derive(Clone, Copy, Debug)]
pub struct SystemClock {
    zero: Instant,
}

impl SystemClock {
    /// A clock that shows 0 now.
    pub fn new() -> Self {
        Self { zero: Instant::now() }
    }
}

impl Default for SystemClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for SystemClock {
    fn now(&self) -> Duration {
        self.zero.elapsed()
    }

    fn sleep_until(&self, time: Duration) {
        if let Some(left) = time.checked_sub(self.now()) {
            std::thread::sleep(left);
        }
    }
}

/// One due tick.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Due {
    /// Its place on the grid.
    pub at: Duration,
    /// Periods that were left out since the tick before, because that one took too long.
    pub skipped: u64,
}

/// The grid `start + k·period`.
///
/// A tick that is late by less than half a period still runs in its slot; a later one is skipped and the loop
/// waits for the next slot. So two ticks are never closer than half a period, however long the loop was held
/// up.
#[derive(Clone, Copy, Debug)]
pub struct Pacer {
    period: Duration,
    next: Duration,
    /// Periods skipped so far.
    pub overruns: u64,
}

impl Pacer {
    /// A grid whose first tick is due at `start`. `period` must not be zero.
    pub fn new(start: Duration, period: Duration) -> Self {
        Self { period, next: start, overruns: 0 }
    }

    /// The next tick, seen from `now`.
    pub fn next(&mut self, now: Duration) -> Due {
        let late = now.saturating_sub(self.next);
        let skipped = (late + self.period / 2).as_nanos() / self.period.as_nanos().max(1);
        let skipped = u64::try_from(skipped).unwrap_or(u64::MAX);
        let slots = u32::try_from(skipped).unwrap_or(u32::MAX);
        let at = self.next + self.period * slots;
        self.overruns += skipped;
        self.next = at + self.period;
        Due { at, skipped }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    fn due(pacer: &mut Pacer, now_ms: u32) -> (u32, u64) {
        let due = pacer.next(MS * now_ms);
        (due.at.as_millis() as u32, due.skipped)
    }

    #[test]
    fn a_loop_in_time_stays_on_the_grid() {
        let mut pacer = Pacer::new(MS * 100, MS * 20);
        // The work takes 3 ms, 19 ms, 1 ms: the grid does not move.
        assert_eq!(due(&mut pacer, 90), (100, 0));
        assert_eq!(due(&mut pacer, 103), (120, 0));
        assert_eq!(due(&mut pacer, 139), (140, 0));
        assert_eq!(due(&mut pacer, 141), (160, 0));
        assert_eq!(pacer.overruns, 0);
    }

    #[test]
    fn a_little_late_runs_in_its_slot_and_the_grid_stays() {
        let mut pacer = Pacer::new(Duration::ZERO, MS * 20);
        assert_eq!(due(&mut pacer, 0), (0, 0));
        // 9 ms after slot 20: runs at once (its time has passed), the next one is at 40 again.
        assert_eq!(due(&mut pacer, 29), (20, 0));
        assert_eq!(due(&mut pacer, 30), (40, 0));
    }

    #[test]
    fn missed_ticks_are_skipped_and_counted_never_replayed() {
        let mut pacer = Pacer::new(Duration::ZERO, MS * 20);
        assert_eq!(due(&mut pacer, 0), (0, 0));
        // 10 ms after slot 20 is half a period: wait for 40 instead.
        assert_eq!(due(&mut pacer, 30), (40, 1));
        // Held up until 205: slots 60 to 180 are gone (7 of them), 200 is 5 ms late and runs.
        assert_eq!(due(&mut pacer, 205), (200, 7));
        assert_eq!(due(&mut pacer, 206), (220, 0));
        assert_eq!(pacer.overruns, 8);
    }

    #[test]
    fn two_ticks_are_never_closer_than_half_a_period() {
        // Whatever the work takes (a fixed, irregular sequence of durations, ms).
        let mut pacer = Pacer::new(Duration::ZERO, MS * 20);
        let mut now = Duration::ZERO;
        let mut last: Option<Duration> = None;
        for k in 0..1000_u32 {
            let due = pacer.next(now);
            let ran = now.max(due.at);
            if let Some(last) = last {
                assert!(ran - last >= MS * 10, "tick {k}: {:?}", ran - last);
            }
            last = Some(ran);
            now = ran + MS * ((k * k * 7 + k) % 67);
        }
        assert!(pacer.overruns > 100);
    }
}
