//! How much robots may say: each report that is news is a line of the record and a file.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Reports of one robot at once; a version is three of them at most (armed, trial, and what came of it).
const BURST: f64 = 60.0;
/// One more of a robot in this time.
const PAUSE: Duration = Duration::from_secs(5);
/// Robots whose quota is kept at once.
const QUOTAS_MAX: usize = 1024;

/// What a robot may still say, as of a time.
#[derive(Clone, Copy, Debug)]
struct Left(f64, Instant);

impl Left {
    fn at(self, now: Instant) -> f64 {
        let gained = now.saturating_duration_since(self.1).as_secs_f64() / PAUSE.as_secs_f64();
        (self.0 + gained).min(BURST)
    }
}

/// What each robot may still say.
#[derive(Debug, Default)]
pub struct Quota(BTreeMap<String, Left>);

impl Quota {
    /// Counts a report of `robot`. False: it has said too much for now.
    pub fn take(&mut self, robot: &str, now: Instant) -> bool {
        if self.0.len() >= QUOTAS_MAX && !self.0.contains_key(robot) {
            // Who may say everything again need not be remembered.
            self.0.retain(|_, left| left.at(now) < BURST);
            if self.0.len() >= QUOTAS_MAX {
                return false;
            }
        }
        let full = Left(BURST, now);
        let left = self.0.get(robot).copied().unwrap_or(full).at(now);
        if left < 1.0 {
            return false;
        }
        self.0.insert(robot.to_owned(), Left(left - 1.0, now));
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_that_says_too_much_waits_and_others_do_not() {
        let (mut quota, begun) = (Quota::default(), Instant::now());
        let taken = (0..1000).filter(|_| quota.take("a", begun)).count();
        assert_eq!(taken, 60);
        assert!(quota.take("b", begun));
        let hour = (0..3600).filter(|s| quota.take("a", begun + Duration::from_secs(*s)));
        assert_eq!(hour.count(), 719);
    }

    #[test]
    fn made_up_names_are_bounded() {
        let (mut quota, now) = (Quota::default(), Instant::now());
        let taken = (0..5000).filter(|n| quota.take(&n.to_string(), now)).count();
        assert_eq!((taken, quota.0.len()), (QUOTAS_MAX, QUOTAS_MAX));
        let later = now + PAUSE * 2;
        assert!(quota.take("new", later));
    }
}
