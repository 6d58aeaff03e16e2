//! What policies do on a robot, over several trainings: means with intervals, and what one way of training
//! gains over another.

use caudata_evaluation::{Estimate, ScenarioResult};
use serde::Serialize;

/// A figure of a run.
type Of<'a> = &'a dyn Fn(&Run) -> f64;

/// Two-sided 95 % points of Student's distribution for 1, 2, … degrees of freedom; the last one for all more
/// (it is a little too wide for them).
const T_95: [f64; 10] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228];

/// A mean over trainings, and its 95 % interval; null where there is one training only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Interval {
    /// Mean.
    pub mean: f64,
    /// Lower end.
    pub ci_low: Option<f64>,
    /// Upper end.
    pub ci_high: Option<f64>,
}

impl Interval {
    /// Mean of the values and Student's interval, `t·s/√n` with n − 1 degrees of freedom.
    pub fn of(values: &[f64]) -> Self {
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        let Some(freedom) = values.len().checked_sub(1).filter(|f| *f > 0) else {
            return Self { mean, ..Self::default() };
        };
        let squares: f64 = values.iter().map(|x| (x - mean).powi(2)).sum();
        let error = (squares / freedom as f64 / values.len() as f64).sqrt();
        let half = error * T_95[freedom.min(T_95.len()) - 1];
        Self { mean, ci_low: Some(mean - half), ci_high: Some(mean + half) }
    }
}

impl From<Estimate> for Interval {
    fn from(e: Estimate) -> Self {
        Self { mean: e.mean, ci_low: Some(e.ci_low), ci_high: Some(e.ci_high) }
    }
}

/// What one policy did on one robot, over all scenarios of a suite.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Run {
    /// Off the command, root mean square of strides: forward, sideways (m/s), turning (rad/s).
    pub off: [f64; 3],
    /// Mechanical power, W.
    pub power_w: f64,
    /// Share of episodes that ended by falling, mean over scenarios.
    pub fall_share: f64,
    /// Episodes that ended by falling.
    pub falls: usize,
    /// Episodes.
    pub episodes: usize,
}

impl Run {
    /// Errors are added as squares, each scenario counts alike.
    pub fn of(scenarios: &[ScenarioResult]) -> Self {
        let mean = |value: &dyn Fn(&ScenarioResult) -> f64| {
            scenarios.iter().map(value).sum::<f64>() / scenarios.len().max(1) as f64
        };
        Self {
            off: [0, 1, 2].map(|axis| mean(&|s| s.rmse_of_strides[axis].powi(2)).sqrt()),
            power_w: mean(&|s| s.power_w.mean),
            fall_share: mean(&|s| s.fall_share.mean),
            falls: scenarios.iter().flat_map(|s| s.falls.values()).sum(),
            episodes: scenarios.iter().map(|s| s.episodes).sum(),
        }
    }
}

/// The same over trainings that differ in their seed.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Off the commanded velocity forward, root mean square of strides, m/s.
    pub forward_mps: Interval,
    /// Sideways, m/s.
    pub sideways_mps: Interval,
    /// Off the commanded yaw rate, rad/s.
    pub turning_radps: Interval,
    /// Share of episodes that end by falling; Wilson's interval over the episodes of all trainings.
    pub falls: Interval,
    /// Mechanical power, W.
    pub power_w: Interval,
}

impl Figures {
    /// Figures over the runs of several trainings.
    pub fn of(runs: &[Run]) -> Self {
        let falls = runs.iter().map(|r| r.falls).sum();
        let episodes = runs.iter().map(|r| r.episodes).sum();
        Self {
            falls: Estimate::share(falls, episodes).into(),
            ..Self::over(|value| runs.iter().map(value).collect())
        }
    }

    /// What `runs` have less of than `others`, training by training: the same seed stands in the same place.
    pub fn less(runs: &[Run], others: &[Run]) -> Self {
        Self::over(|value| {
            let pairs = runs.iter().zip(others);
            pairs.map(|(r, o)| value(o) - value(r)).collect()
        })
    }

    /// Student's intervals of each figure of a run.
    fn over(values: impl Fn(Of<'_>) -> Vec<f64>) -> Self {
        let interval = |value: Of<'_>| Interval::of(&values(value));
        Self {
            forward_mps: interval(&|r| r.off[0]),
            sideways_mps: interval(&|r| r.off[1]),
            turning_radps: interval(&|r| r.off[2]),
            falls: interval(&|r| r.falls as f64 / r.episodes.max(1) as f64),
            power_w: interval(&|r| r.power_w),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(forward: f64, falls: usize) -> Run {
        Run {
            off: [forward, 0.02, 0.1],
            power_w: 7.0,
            fall_share: falls as f64 / 75.0,
            falls,
            episodes: 75,
        }
    }

    #[test]
    fn intervals_by_hand() {
        // 1, 2, 6: mean 3, s² = 7, standard error √(7/3) = 1.527525, times 4.303
        let i = Interval::of(&[1.0, 2.0, 6.0]);
        assert_eq!(i.mean, 3.0);
        let half = 1.527_525_2 * 4.303;
        assert!((i.ci_high.unwrap() - 3.0 - half).abs() < 1e-6);
        assert!((3.0 - i.ci_low.unwrap() - half).abs() < 1e-6);
        let one = Interval::of(&[5.0]);
        assert_eq!((one.mean, one.ci_low, one.ci_high), (5.0, None, None));
    }

    #[test]
    fn gains_are_taken_training_by_training() {
        // Trainings differ much and the gain does not: 0.01 each time.
        let given = [run(0.03, 5), run(0.08, 1), run(0.05, 0)];
        let better = [run(0.02, 0), run(0.07, 0), run(0.04, 0)];
        let gain = Figures::less(&better, &given);
        assert!((gain.forward_mps.mean - 0.01).abs() < 1e-12);
        assert!(gain.forward_mps.ci_low.unwrap() > 0.0099);
        // (5 + 1 + 0)/75/3
        assert!((gain.falls.mean - 6.0 / 225.0).abs() < 1e-12);
        let all = Figures::of(&given);
        assert!((all.falls.mean - 6.0 / 225.0).abs() < 1e-12);
        // Wilson: no fall in 225 episodes leaves up to z²/(n + z²) = 3.8416/228.8416
        let none = Figures::of(&better).falls.ci_high.unwrap();
        assert!((none - 3.8416 / 228.8416).abs() < 1e-12);
    }

    #[test]
    fn scenarios_are_added_up() {
        let scenario =
            |fall_share: f64, off: f64, falls: &[(&'static str, usize)]| ScenarioResult {
                falls: falls.iter().map(|(why, n)| ((*why).into(), *n)).collect(),
                ..super::super::tests::scenario(fall_share, [off, 0.01, 0.1])
            };
        let got =
            Run::of(&[scenario(0.5, 0.03, &[("tilted", 1), ("low", 1)]), scenario(0.0, 0.04, &[])]);
        assert_eq!((got.falls, got.episodes, got.power_w), (2, 20, 6.5));
        // √((0.0009 + 0.0016)/2) = 0.0353553
        assert!((got.off[0] - 0.035_355_3).abs() < 1e-6 && (got.off[1] - 0.01).abs() < 1e-12);
        assert_eq!(got.fall_share, 0.25);
    }
}
