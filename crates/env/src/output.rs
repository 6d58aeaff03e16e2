//! What a step gives.

use caudata_task::termination::TerminationReason;

/// Result of one control step of all lanes. `N` lanes, `D` observation values.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepOutput {
    /// Reward of the step. `[N]`
    pub rewards: Vec<f32>,
    /// Whether the episode ended by failing in this step. `[N]`
    pub terminated: Vec<bool>,
    /// Whether the episode ended by its time limit in this step; never together with `terminated`. `[N]`
    pub truncated: Vec<bool>,
    /// For each lane whose episode ended, in lane order: the last observation of the episode that ended
    /// `[D]`. (`VecEnv::observations` has the first of the next one.) A lane that diverged has the
    /// observation before the step, the last one that can be trusted.
    pub final_observations: Vec<(usize, Vec<f32>)>,
    /// What only the value function sees of those last observations, one after the other. `[ends, E]`
    pub final_privileged: Vec<f32>,
    /// The episodes that ended, in lane order.
    pub episodes: Vec<EpisodeStats>,
}

/// Bookkeeping of an episode that ended. Means are over its control steps, from the true state; steps in
/// which the simulation diverged count as zero.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EpisodeStats {
    /// Lane.
    pub lane: u32,
    /// Number of the episode in its lane, from 0.
    pub episode: u64,
    /// Length, control steps.
    pub steps: u32,
    /// Sum of rewards.
    pub return_sum: f32,
    /// Sum of each reward term, weighted, in the order of
    /// [`caudata_task::reward::RewardConfig::term_names`].
    pub terms: Vec<f32>,
    /// Whether it ended by failing rather than by its time limit.
    pub terminated: bool,
    /// Why it failed; `None` where the time limit ended it.
    pub reason: Option<TerminationReason>,
    /// Mean horizontal speed of the whole body, m/s.
    pub mean_speed_mps: f32,
    /// Mean distance between commanded and actual horizontal velocity, m/s.
    pub mean_velocity_error_mps: f32,
    /// Mean of Σ|q̇τ|, W.
    pub mean_power_w: f32,
    /// Share of steps in which the contact force on anything but the feet was above `contact_force_n`.
    pub trunk_contact_share: f32,
    /// Share of foot-steps with the foot in contact, that is with more than `contact_force_n` on it (mean
    /// duty factor of the four feet).
    pub duty_factor: f32,
    /// Mean horizontal speed of feet in contact, m/s.
    pub mean_slip_mps: f32,
}

/// The output, with the buffers of earlier steps kept for reuse.
#[derive(Debug)]
pub(crate) struct OutputBuffers {
    pub output: StepOutput,
    observation_pool: Vec<Vec<f32>>,
    terms_pool: Vec<Vec<f32>>,
}

impl OutputBuffers {
    pub fn new(lanes: usize) -> Self {
        Self {
            output: StepOutput {
                rewards: vec![0.0; lanes],
                terminated: vec![false; lanes],
                truncated: vec![false; lanes],
                ..StepOutput::default()
            },
            observation_pool: Vec::new(),
            terms_pool: Vec::new(),
        }
    }

    /// Empties the output for the next step; at most one buffer per lane is ever kept.
    pub fn clear(&mut self) {
        self.output.rewards.fill(0.0);
        self.output.terminated.fill(false);
        self.output.truncated.fill(false);
        let observations = self.output.final_observations.drain(..);
        self.observation_pool.extend(observations.map(|(_, buffer)| buffer));
        self.output.final_privileged.clear();
        let episodes = self.output.episodes.drain(..);
        self.terms_pool.extend(episodes.map(|episode| episode.terms));
    }

    /// Notes that a lane's episode ended, with its last observation and what the value function saw besides.
    pub fn finish(
        &mut self,
        mut stats: EpisodeStats,
        terms: &[f64],
        (last_observation, privileged): (&[f32], &[f32]),
    ) {
        let mut observation = self.observation_pool.pop().unwrap_or_default();
        observation.clear();
        observation.extend_from_slice(last_observation);
        let mut term_sums = self.terms_pool.pop().unwrap_or_default();
        term_sums.clear();
        term_sums.extend(terms.iter().map(|&sum| sum as f32));
        stats.terms = term_sums;
        let lane = stats.lane as usize;
        self.output.terminated[lane] = stats.terminated;
        self.output.truncated[lane] = !stats.terminated;
        self.output.final_observations.push((lane, observation));
        self.output.final_privileged.extend_from_slice(privileged);
        self.output.episodes.push(stats);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_of_ended_episodes_are_used_again() {
        let mut buffers = OutputBuffers::new(3);
        let mut seen = Vec::new();
        for round in 0..5 {
            buffers.clear();
            let stats =
                EpisodeStats { lane: 2, terminated: round % 2 == 0, ..EpisodeStats::default() };
            buffers.finish(stats, &[0.5; 18], (&[round as f32; 97], &[-1.0]));
            let output = &buffers.output;
            assert_eq!(output.terminated, [false, false, round % 2 == 0]);
            assert_eq!(output.truncated, [false, false, round % 2 == 1]);
            assert_eq!(output.final_observations, [(2, vec![round as f32; 97])]);
            assert_eq!(output.final_privileged, [-1.0]);
            assert_eq!(output.episodes[0].terms, [0.5; 18]);
            seen.push((output.final_observations[0].1.as_ptr(), output.episodes[0].terms.as_ptr()));
        }
        assert!(seen.iter().all(|pointers| *pointers == seen[0]));
    }
}
