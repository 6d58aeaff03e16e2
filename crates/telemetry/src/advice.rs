//! More actors, fewer, or as it is: advice out of where the learner's time goes and how old its data is.

/// Weight of the newest iteration in the running means: about the last twenty count.
const NEWEST: f64 = 0.05;
/// Waiting for more than this share of the time: the learner starves.
const STARVES_ABOVE: f64 = 0.5;
/// Waiting for less than this share: actors are not what holds it up.
const SATED_BELOW: f64 = 0.05;
/// More than this share of chunks too old to use: actors collect what is thrown away.
const WASTE_ABOVE: f64 = 0.02;

/// What to do about the number of actors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Advice {
    /// The learner waits for rollouts most of the time.
    More,
    /// As it is, or more would help and the lag forbids it.
    Keep,
    /// The learner never waits, and what actors collect comes too late.
    Fewer,
}

impl Advice {
    /// As a metric: 1, 0, −1.
    pub fn as_metric(self) -> f64 {
        match self {
            Self::More => 1.0,
            Self::Keep => 0.0,
            Self::Fewer => -1.0,
        }
    }
}

/// One iteration of a learner.
#[derive(Clone, Copy, Debug)]
pub struct IterationLoad {
    /// Waiting for the batch, s.
    pub waiting_s: f64,
    /// The update, s.
    pub learning_s: f64,
    /// Age of the oldest data in the batch, policy versions.
    pub lag_max: u64,
    /// Age at which data is dropped.
    pub lag_allowed: u64,
    /// Chunks that came since the iteration before.
    pub received: u64,
    /// Those among them that were too old or too many.
    pub dropped: u64,
}

/// Running means over iterations.
#[derive(Clone, Debug, Default)]
pub struct Advisor {
    waiting: Option<f64>,
    dropped: f64,
}

impl Advisor {
    /// The advice after one more iteration.
    ///
    /// More actors make data older, because a batch is full of others' chunks before a slow actor's comes. So
    /// they are not advised while data is as old as is allowed, or is dropped for its age.
    pub fn after(&mut self, load: &IterationLoad) -> Advice {
        let total_s = load.waiting_s + load.learning_s;
        let waiting = if total_s > 0.0 { load.waiting_s / total_s } else { 0.0 };
        let dropped =
            if load.received > 0 { load.dropped as f64 / load.received as f64 } else { 0.0 };
        let mean = self.waiting.get_or_insert(waiting);
        *mean += NEWEST * (waiting - *mean);
        self.dropped += NEWEST * (dropped - self.dropped);
        let wasteful = self.dropped > WASTE_ABOVE;
        let at_bound = load.lag_allowed > 0 && load.lag_max >= load.lag_allowed;
        if *mean > STARVES_ABOVE && !wasteful && !at_bound {
            Advice::More
        } else if *mean < SATED_BELOW && (wasteful || at_bound) {
            Advice::Fewer
        } else {
            Advice::Keep
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Advice after a hundred iterations like this.
    fn settled(waiting_s: f64, lag_max: u64, dropped: u64) -> Advice {
        let load = IterationLoad {
            waiting_s,
            learning_s: 1.0,
            lag_max,
            lag_allowed: 4,
            received: 100,
            dropped,
        };
        let mut advisor = Advisor::default();
        let all = (0..100).map(|_| advisor.after(&load));
        all.last().unwrap()
    }

    #[test]
    fn a_starving_learner_wants_more_unless_data_is_too_old_already() {
        assert_eq!(settled(3.0, 1, 0), Advice::More);
        assert_eq!(settled(3.0, 4, 0), Advice::Keep, "at the bound of the lag");
        assert_eq!(settled(3.0, 1, 10), Advice::Keep, "a tenth is dropped");
    }

    #[test]
    fn a_learner_that_never_waits_wants_fewer_only_when_work_is_wasted() {
        assert_eq!(settled(0.01, 1, 0), Advice::Keep, "balanced");
        assert_eq!(settled(0.01, 1, 10), Advice::Fewer);
        assert_eq!(settled(0.01, 4, 0), Advice::Fewer);
        assert_eq!(settled(0.3, 4, 10), Advice::Keep);
    }

    #[test]
    fn one_odd_iteration_changes_nothing() {
        let mut advisor = Advisor::default();
        let mut load = IterationLoad {
            waiting_s: 0.1,
            learning_s: 1.0,
            lag_max: 1,
            lag_allowed: 4,
            received: 10,
            dropped: 0,
        };
        advisor.after(&load);
        load.waiting_s = 30.0;
        // 0.1 / 1.1 = 0.09, moved by a twentieth towards 30 / 31 = 0.97: 0.13.
        assert_eq!(advisor.after(&load), Advice::Keep);
    }
}
