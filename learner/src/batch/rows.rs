//! The samples of one update, laid out for the networks: chunks one after the other.

use caudata_proto::RolloutChunk;

use crate::normaliser::Moments;

/// What one update learns from. B = acted-on observations of all chunks together; behind them in
/// `observations` come the rows whose value alone is wanted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// What the value function sees, of which the policy sees the first values: D here.
    pub obs_dim: usize,
    /// A.
    pub act_dim: usize,
    /// B.
    pub rows: usize,
    /// Raw, row-major `[B + extra, D]`: per chunk `[T, N]` first, then per chunk the N observations after the
    /// last step and the final observations of truncated steps.
    pub observations: Vec<f32>,
    /// `[B, A]`.
    pub actions: Vec<f32>,
    /// Means of the policies that acted, `[B, A]`; empty where nobody says.
    pub action_means: Vec<f32>,
    /// Log-probability of each action under the policy that took it, `[B]`.
    pub behaviour_log_probs: Vec<f32>,
    /// `[B]`.
    pub rewards: Vec<f32>,
    /// `[B]`.
    pub terminated: Vec<bool>,
    /// `[B]`.
    pub truncated: Vec<bool>,
    /// One per chunk, in order.
    pub segments: Vec<Segment>,
    /// Statistics of the acted-on observations of each chunk, in order.
    pub moments: Vec<Moments>,
}

/// Where one chunk lies in a [`Batch`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Segment {
    /// First of its T·N rows.
    pub first_row: usize,
    /// T.
    pub steps: usize,
    /// N.
    pub lanes: usize,
    /// First of the N rows of observations after its last step.
    pub bootstrap_row: usize,
    /// Its final observations, which follow those.
    pub finals: usize,
    /// Version of the policy that acted.
    pub policy_version: u64,
}

impl Batch {
    /// The chunks, in the order given.
    pub fn new(chunks: Vec<RolloutChunk>) -> Self {
        let mut batch = Self::default();
        let values = |of: fn(&RolloutChunk) -> usize| chunks.iter().map(of).sum::<usize>();
        let finals = values(|chunk| chunk.final_observations.len() * chunk.obs_dim);
        batch.observations.reserve(values(|chunk| chunk.observations.len()) + finals);
        batch.actions.reserve(values(|chunk| chunk.actions.len()));
        batch.action_means.reserve(values(|chunk| chunk.action_means.len()));
        for chunk in &chunks {
            batch.push_samples(chunk);
        }
        for (index, chunk) in chunks.into_iter().enumerate() {
            batch.push_extra_rows(index, &chunk);
            batch.moments.push(chunk.moments.into());
        }
        batch
    }

    fn push_samples(&mut self, chunk: &RolloutChunk) {
        let samples = chunk.steps * chunk.lanes;
        self.obs_dim = chunk.obs_dim;
        self.act_dim = chunk.act_dim;
        self.segments.push(Segment {
            first_row: self.rows,
            steps: chunk.steps,
            lanes: chunk.lanes,
            bootstrap_row: 0,
            finals: 0,
            policy_version: chunk.policy_version,
        });
        self.rows += samples;
        let acted_on = &chunk.observations[..samples * chunk.obs_dim];
        self.observations.extend_from_slice(acted_on);
        self.actions.extend_from_slice(&chunk.actions);
        self.action_means.extend_from_slice(&chunk.action_means);
        self.behaviour_log_probs.extend_from_slice(&chunk.log_probs);
        self.rewards.extend_from_slice(&chunk.rewards);
        self.terminated.extend_from_slice(&chunk.terminated);
        self.truncated.extend_from_slice(&chunk.truncated);
    }

    fn push_extra_rows(&mut self, index: usize, chunk: &RolloutChunk) {
        let segment = &mut self.segments[index];
        segment.bootstrap_row = self.observations.len() / self.obs_dim;
        segment.finals = chunk.final_observations.len();
        let after_last = &chunk.observations[chunk.steps * chunk.lanes * chunk.obs_dim..];
        self.observations.extend_from_slice(after_last);
        for last in &chunk.final_observations {
            self.observations.extend_from_slice(&last.observation);
        }
    }

    /// The means of π_prox, where actors have said them: those of policy version `version`, if it took every
    /// action.
    pub fn means_of(&self, version: u64) -> Option<&[f32]> {
        let fresh = self.segments.iter().all(|s| s.policy_version == version);
        (fresh && self.action_means.len() == self.actions.len()).then_some(&self.action_means)
    }

    /// Mean reward of a step.
    pub fn mean_reward(&self) -> f64 {
        self.rewards.iter().map(|&r| f64::from(r)).sum::<f64>() / self.rows.max(1) as f64
    }
}
