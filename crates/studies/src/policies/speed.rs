//! Forward velocities that change: what a policy is asked for, what it did, and its velocity over time.

use caudata_evaluation::{Leg, Order, Outcome, Scenario, ScenarioResult};
use caudata_policy::PolicyFile;
use serde::{Deserialize, Serialize};

/// Forward velocities that are asked for in turn, m/s, each for [`LEG_S`]: what the picture of velocity
/// tracking shows.
const FORWARD_MPS: [f32; 5] = [0.1, 0.2, 0.3, 0.4, 0.2];
/// s.
const LEG_S: f64 = 4.0;
/// How long all of them take, s.
pub const EPISODE_S: f64 = LEG_S * FORWARD_MPS.len() as f64;

/// The scenario.
pub fn scenario() -> Scenario {
    let leg = |(i, vx): (usize, &f32)| Leg {
        from_s: LEG_S * i as f64,
        order: Order::Command([*vx, 0.0, 0.0]),
    };
    Scenario {
        course: FORWARD_MPS.iter().enumerate().map(leg).collect(),
        judged: false,
        film: None,
        ..Scenario::walk("forward velocities that change", [FORWARD_MPS[0], 0.0, 0.0])
    }
}

/// `NAME_in_rapier.json`: a policy with forward velocities that change.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Walks {
    /// SHA-256 of the policy's file.
    pub policy_sha256: String,
    /// A scenario of `caudata eval --json`.
    pub result: ScenarioResult,
    /// Time between two values, s.
    pub period_s: f64,
    /// Commanded and achieved forward velocity of each episode, m/s.
    pub episodes: Vec<Vec<[f32; 2]>>,
}

impl Walks {
    /// What an evaluation that kept velocities says of a policy.
    pub fn of(policy: &PolicyFile, outcome: Outcome) -> Self {
        let forward = |row: &[f32; 6]| [row[0], row[3]];
        let tracks = outcome.tracks.iter();
        Self {
            policy_sha256: policy.sha256_hex(),
            period_s: outcome.period_s,
            episodes: tracks.map(|track| track.rows.iter().map(forward).collect()).collect(),
            result: outcome.result,
        }
    }
}

/// Forward velocity over time, over the episodes of all trainings of a way; each is averaged over a stride of
/// 0.7 s, since a trunk that bends sways.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Speed {
    /// s.
    pub time_s: Vec<f64>,
    /// What was asked for, m/s.
    pub command_mps: Vec<f64>,
    /// Mean, m/s.
    pub mean_mps: Vec<f64>,
    /// Standard deviation, m/s.
    pub sd_mps: Vec<f64>,
}

impl Speed {
    /// The mean over the episodes of all of them; where some have ended, over those that go on.
    pub fn of<'a>(all: impl Iterator<Item = &'a Walks>) -> Self {
        const STRIDE_S: f64 = 0.7;
        let mut speed = Self::default();
        let mut tracks: Vec<Vec<f64>> = Vec::new();
        let mut period_s = 0.0;
        for walks in all {
            period_s = walks.period_s;
            let half = (0.5 * STRIDE_S / period_s) as usize;
            for rows in &walks.episodes {
                if rows.len() > speed.command_mps.len() {
                    speed.command_mps = rows.iter().map(|row| f64::from(row[0])).collect();
                }
                let forward: Vec<f64> = rows.iter().map(|row| f64::from(row[1])).collect();
                tracks.push(smooth(&forward, half));
            }
        }
        for k in 0..speed.command_mps.len() {
            let there: Vec<f64> = tracks.iter().filter_map(|t| t.get(k).copied()).collect();
            let n = there.len().max(1) as f64;
            let mean = there.iter().sum::<f64>() / n;
            let square = there.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
            speed.time_s.push(k as f64 * period_s);
            speed.mean_mps.push(mean);
            speed.sd_mps.push(square.sqrt());
        }
        speed
    }

    /// Commanded velocities, each once, and what was achieved in the second half of their time, m/s.
    pub fn held(&self) -> (Vec<f64>, Vec<f64>) {
        let mut wanted: Vec<f64> = self.command_mps.clone();
        wanted.sort_unstable_by(f64::total_cmp);
        wanted.dedup();
        let mut held = Vec::new();
        wanted.retain(|command| {
            let late = |k: &usize| {
                self.command_mps[*k] == *command && self.time_s[*k] % LEG_S >= 0.5 * LEG_S
            };
            let there: Vec<usize> = (0..self.command_mps.len()).filter(late).collect();
            let sum: f64 = there.iter().map(|&k| self.mean_mps[k]).sum();
            if !there.is_empty() {
                held.push(sum / there.len() as f64);
            }
            !there.is_empty()
        });
        (wanted, held)
    }
}

/// Means over `half` values on each side, fewer at the ends.
fn smooth(values: &[f64], half: usize) -> Vec<f64> {
    let mean = |k: usize| {
        let near = &values[k.saturating_sub(half)..(k + half + 1).min(values.len())];
        near.iter().sum::<f64>() / near.len() as f64
    };
    (0..values.len()).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_by_hand() {
        assert_eq!(smooth(&[0.0, 3.0, 6.0, 0.0], 1), [1.5, 3.0, 3.0, 3.0]);
        assert_eq!(smooth(&[], 3), [0.0; 0]);
    }

    #[test]
    fn what_is_achieved_is_read_late() {
        let speed = Speed {
            time_s: vec![0.0, 2.5, 4.5, 7.0, 8.5],
            command_mps: vec![0.2, 0.2, 0.1, 0.1, 0.3],
            mean_mps: vec![0.0, 0.18, 0.15, 0.11, 0.2],
            sd_mps: vec![0.0; 5],
        };
        // 0.3 m/s: only its beginning is there
        assert_eq!(speed.held(), (vec![0.1, 0.2], vec![0.11, 0.18]));
    }
}
