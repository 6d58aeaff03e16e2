//! Returns that can be compared from the first iteration on.
//!
//! Environments start at different ages, so the first episodes to end are cut short by their time limit, and
//! the plain mean of their returns says nothing about the robot. Here such an episode counts as the share of
//! a whole one that it lasted; one that ended by failure is whole, since nothing would have followed. The
//! mean return is the sum of returns over the sum of shares, which is the plain mean as soon as no episode is
//! cut short any more.

use caudata_proto::EpisodeSummary;
use caudata_telemetry::progress::MeanSe;

/// How much of a whole episode, of `episode_steps` steps, `episode` is: 0 to 1.
pub fn share_of_whole(episode: &EpisodeSummary, episode_steps: u32) -> f64 {
    match episode.terminated {
        true => 1.0,
        false => (f64::from(episode.steps) / f64::from(episode_steps.max(1))).min(1.0),
    }
}

/// Sums over episodes, from which mean and standard error follow for any stretch of iterations.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ReturnSums {
    n: f64,
    shares: f64,
    returns: f64,
    shares_squared: f64,
    products: f64,
    returns_squared: f64,
}

/// Numbers in a row of the saved table.
const COLUMNS: usize = 6;

impl ReturnSums {
    /// Adds an episode that counts as `share` of a whole one.
    pub fn add(&mut self, return_sum: f64, share: f64) {
        self.n += 1.0;
        self.shares += share;
        self.returns += return_sum;
        self.shares_squared += share * share;
        self.products += return_sum * share;
        self.returns_squared += return_sum * return_sum;
    }

    /// The sums over all of `parts`.
    pub fn total(parts: &[Self]) -> Self {
        let mut total = [0.0; COLUMNS];
        for part in parts {
            total.iter_mut().zip(part.row()).for_each(|(t, x)| *t += x);
        }
        Self::of_row(&total)
    }

    /// Mean return R = Σr/Σs of a whole episode, and its standard error √(n/(n−1)·Σ(r − R·s)²)/Σs (Cochran,
    /// "Sampling Techniques", section 6.4: the ratio estimator). `None` with fewer than two episodes.
    pub fn mean(&self) -> Option<MeanSe> {
        if self.n < 2.0 || self.shares <= 0.0 {
            return None;
        }
        let mean = self.returns / self.shares;
        let squares =
            self.returns_squared - 2.0 * mean * self.products + mean * mean * self.shares_squared;
        Some(MeanSe {
            mean,
            standard_error: (squares.max(0.0) * self.n / (self.n - 1.0)).sqrt() / self.shares,
            n: self.n as u64,
        })
    }

    /// As one table, row by row.
    pub fn to_rows(all: &[Self]) -> Vec<f64> {
        all.iter().flat_map(Self::row).collect()
    }

    /// The opposite of [`ReturnSums::to_rows`].
    pub fn from_rows(rows: &[f64]) -> Vec<Self> {
        rows.as_chunks().0.iter().map(Self::of_row).collect()
    }

    fn row(&self) -> [f64; COLUMNS] {
        [
            self.n,
            self.shares,
            self.returns,
            self.shares_squared,
            self.products,
            self.returns_squared,
        ]
    }

    fn of_row(row: &[f64; COLUMNS]) -> Self {
        let [n, shares, returns, shares_squared, products, returns_squared] = *row;
        Self { n, shares, returns, shares_squared, products, returns_squared }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn episode(steps: u32, terminated: bool) -> EpisodeSummary {
        EpisodeSummary {
            lane: 0,
            steps,
            return_sum: 0.0,
            terms: Vec::new(),
            terminated,
            reason: 0,
            mean_speed_mps: 0.0,
        }
    }

    #[test]
    fn an_episode_cut_short_is_a_part_and_a_failure_is_whole() {
        assert_eq!(share_of_whole(&episode(250, false), 1000), 0.25);
        assert_eq!(share_of_whole(&episode(1000, false), 1000), 1.0);
        assert_eq!(share_of_whole(&episode(250, true), 1000), 1.0);
    }

    #[test]
    fn a_robot_that_does_not_change_has_the_same_return_from_the_start() {
        // A reward of 0.5 per step: staggered first episodes of 10 to 100 steps, then whole ones of 100.
        let mut early = ReturnSums::default();
        (1..=10).for_each(|i| early.add(5.0 * f64::from(i), 0.1 * f64::from(i)));
        let mut late = ReturnSums::default();
        (0..10).for_each(|_| late.add(50.0, 1.0));
        for mean in [early.mean().unwrap(), late.mean().unwrap()] {
            assert!((mean.mean - 50.0).abs() < 1e-9, "{mean:?}");
            assert!(mean.standard_error < 1e-6);
        }
    }

    #[test]
    fn mean_and_standard_error_by_hand() {
        // Whole episodes 1, 2, 6: mean 3, variance 7, standard error sqrt(7/3), as for any plain mean.
        let mut whole = ReturnSums::default();
        [1.0, 2.0, 6.0].iter().for_each(|&r| whole.add(r, 1.0));
        let found = whole.mean().unwrap();
        assert_eq!((found.mean, found.n), (3.0, 3));
        assert!((found.standard_error - (7.0_f64 / 3.0).sqrt()).abs() < 1e-12);
        // Shares 1 and 1/2, returns 4 and 5: R = 9/1.5 = 6, residuals -2 and 2, error sqrt(2·8)/1.5 = 8/3.
        let mut parts = [ReturnSums::default(); 2];
        parts[0].add(4.0, 1.0);
        parts[1].add(5.0, 0.5);
        let found = ReturnSums::total(&parts).mean().unwrap();
        assert!(
            (found.mean - 6.0).abs() < 1e-12 && (found.standard_error - 8.0 / 3.0).abs() < 1e-12
        );
        assert_eq!(parts[0].mean(), None);
        let rows = ReturnSums::to_rows(&parts);
        assert_eq!((rows.len(), ReturnSums::from_rows(&rows)), (12, parts.to_vec()));
    }
}
