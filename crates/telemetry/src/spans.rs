//! Where the time of a training goes: seconds per part of the work, over all threads of this process. What is
//! left of the cores' time was waited, for each other or because other programs ran.
//!
//! A lap costs one look at the clock (some 30 ns) and one addition, a few hundred times per iteration: it is
//! always on.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use caudata_declare::named;

named! {
    /// A part of the work of a training.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    #[repr(usize)]
    pub enum Part {
        /// Actors: steps of the physics.
        Physics = "physics",
        /// Actors: rewards, ends of episodes, sensors, observations, resets.
        Task = "task",
        /// Actors: means of the actions.
        Inference = "inference",
        /// Actors: exploration noise, log-probabilities, copies into the chunk, statistics of observations.
        Recording = "recording",
        /// Actors: new policies, checked and made ready.
        Loading = "loading",
        /// Actors: chunks turned into what the link takes, and handed over. Learner: the way back, and
        /// checks.
        Encoding = "encoding",
        /// Learner: chunks laid out as a batch, normalised, values before the update, returns, targets.
        Returns = "returns",
        /// Learner: matrix products, forward and backward.
        Products = "products",
        /// Learner: non-linearities, loss, shuffling.
        ElementWise = "element_wise",
        /// Learner: gradients added, clipped, and Adam.
        Optimiser = "optimiser",
        /// Learner: the policy file.
        Export = "export",
        /// Learner: policies handed out and published, reports, checkpoints.
        Publishing = "publishing",
    }
}

static NANOSECONDS: [AtomicU64; Part::ALL.len()] = [const { AtomicU64::new(0) }; Part::ALL.len()];

/// Counts `time` to `part`.
pub fn add(part: Part, time: Duration) {
    let nanoseconds = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    NANOSECONDS[part as usize].fetch_add(nanoseconds, Ordering::Relaxed);
}

/// Seconds of this process by part since it began, as [`Part::ALL`] has them.
pub fn totals() -> [f64; Part::ALL.len()] {
    std::array::from_fn(|i| NANOSECONDS[i].load(Ordering::Relaxed) as f64 * 1e-9)
}

/// Seconds by name from `before` to `after`.
pub fn between(before: &[f64], after: &[f64]) -> BTreeMap<String, f64> {
    let parts = Part::ALL.iter().zip(before.iter().zip(after));
    parts.map(|(part, (before, after))| (part.name().to_owned(), after - before)).collect()
}

/// Parts of one thread's work, one after the other.
#[derive(Debug)]
pub struct Laps(Instant);

impl Laps {
    /// From now on.
    #[allow(clippy::new_without_default)] // a clock begins when it is told to
    pub fn new() -> Self {
        Self(Instant::now())
    }

    /// What has passed since the last lap was nobody's: the thread has waited.
    pub fn waited(&mut self) {
        self.0 = Instant::now();
    }

    /// What has passed since the last lap was `part`'s.
    pub fn lap(&mut self, part: Part) -> Duration {
        let now = Instant::now();
        let took = now - std::mem::replace(&mut self.0, now);
        add(part, took);
        took
    }

    /// The same, but `other` of it was another part's.
    pub fn lap_with(&mut self, part: Part, (other, took): (Part, Duration)) -> Duration {
        let now = Instant::now();
        let all = now - std::mem::replace(&mut self.0, now);
        add(other, took);
        add(part, all.saturating_sub(took));
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn laps_add_up_and_are_told_apart() {
        let before = totals();
        let mut laps = Laps::new();
        std::thread::sleep(Duration::from_millis(3));
        let first = laps.lap(Part::Export);
        let second = laps.lap_with(Part::Task, (Part::Physics, Duration::ZERO));
        let found = between(&before, &totals());
        assert!(first >= Duration::from_millis(3) && second < first);
        assert!((found["export"] - first.as_secs_f64()).abs() < 1e-6);
        assert!((found["task"] - second.as_secs_f64()).abs() < 1e-6);
        assert_eq!((found["physics"], found.len()), (0.0, Part::ALL.len()));
    }

    #[test]
    fn parts_are_in_their_order_and_named_apart() {
        let mut names: Vec<_> = Part::ALL.iter().map(|part| part.name()).collect();
        assert!(Part::ALL.iter().enumerate().all(|(i, part)| *part as usize == i));
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), Part::ALL.len());
    }
}
