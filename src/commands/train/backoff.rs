//! When a dead child is started again, and when not. Pure: time comes in as an argument.

use std::collections::VecDeque;
use std::time::Duration;

/// The window in which restarts are counted.
const WINDOW: Duration = Duration::from_secs(60);
/// Pause before the first restart in a window; doubles with each further one.
const FIRST_PAUSE: Duration = Duration::from_millis(250);
/// The longest pause.
const LONGEST_PAUSE: Duration = Duration::from_secs(8);

/// The restarts of one child.
#[derive(Clone, Debug)]
pub struct Backoff {
    per_minute: usize,
    /// When it died, since the supervisor began; not older than [`WINDOW`].
    deaths: VecDeque<Duration>,
}

impl Backoff {
    /// At most `per_minute` restarts in any 60 s.
    pub fn new(per_minute: u32) -> Self {
        Self { per_minute: per_minute as usize, deaths: VecDeque::new() }
    }

    /// The child died at `now` (since the supervisor began): the pause after which to start it again; `None`:
    /// it died too often.
    pub fn died(&mut self, now: Duration) -> Option<Duration> {
        while self.deaths.front().is_some_and(|&death| now.saturating_sub(death) > WINDOW) {
            self.deaths.pop_front();
        }
        if self.deaths.len() >= self.per_minute {
            return None;
        }
        let doublings = u32::try_from(self.deaths.len()).unwrap_or(u32::MAX).min(16);
        self.deaths.push_back(now);
        Some((FIRST_PAUSE * 2u32.pow(doublings)).min(LONGEST_PAUSE))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    #[test]
    fn pauses_double_and_the_third_death_in_a_minute_is_the_last() {
        let mut backoff = Backoff::new(2);
        assert_eq!(backoff.died(at(0.0)), Some(at(0.25)));
        assert_eq!(backoff.died(at(1.0)), Some(at(0.5)));
        assert_eq!(backoff.died(at(2.0)), None);
    }

    #[test]
    fn a_quiet_minute_forgives() {
        let mut backoff = Backoff::new(2);
        backoff.died(at(0.0));
        backoff.died(at(30.0));
        // The death at 0 s is older than 60 s, the one at 30 s is not.
        assert_eq!(backoff.died(at(61.0)), Some(at(0.5)));
        assert_eq!(backoff.died(at(200.0)), Some(at(0.25)));
    }

    #[test]
    fn pauses_are_bounded_and_zero_restarts_means_none() {
        let mut backoff = Backoff::new(60);
        let last = (0..20).map(|_| backoff.died(at(1.0))).last();
        assert_eq!(last, Some(Some(LONGEST_PAUSE)));
        assert_eq!(Backoff::new(0).died(at(0.0)), None);
    }
}
