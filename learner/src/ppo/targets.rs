//! What the samples of a batch are learnt with: advantages, value targets and importance weights, on the
//! host.

use caudata_config::{AdvantageScale, PpoConfig, Returns, StalenessConfig};

use crate::batch::{Batch, Segment};
use crate::returns::{Trajectories, VtraceSettings, mean_and_std, vtrace, weighted_mean_and_std};

/// Keeps a division by a spread finite.
const SPREAD_MIN: f64 = 1e-8;

/// One of each per sample.
pub(super) struct Targets {
    pub advantages: Vec<f32>,
    pub targets: Vec<f32>,
    pub weights: Vec<f32>,
}

impl Targets {
    /// Advantages (scaled over the batch if so configured), value targets and importance weights under the
    /// policy before the update, which is version `policy_version`.
    pub fn new(
        ppo: &PpoConfig,
        staleness: &StalenessConfig,
        batch: &Batch,
        values: &[f32],
        prox_log_probs: &[f32],
        policy_version: u64,
    ) -> Self {
        let mut out = Self {
            advantages: vec![0.0; batch.rows],
            targets: vec![0.0; batch.rows],
            weights: vec![1.0; batch.rows],
        };
        for segment in &batch.segments {
            // The same policy computed on another processor may differ in the last bits; that is no
            // staleness.
            let stale = segment.policy_version != policy_version;
            let prox = stale.then_some(prox_log_probs);
            out.add_segment(ppo, staleness, batch, segment, values, prox);
        }
        if ppo.advantage_scale == AdvantageScale::Batch {
            // By the weights that samples have in the loss, which are 1 where they are the policy's own.
            let (mean, std) = weighted_mean_and_std(&out.advantages, &out.weights);
            let scaled = |a: f32| ((f64::from(a) - mean) / (std + SPREAD_MIN)) as f32;
            out.advantages.iter_mut().for_each(|a| *a = scaled(*a));
        }
        out
    }

    /// One chunk; `prox_log_probs` where it is of an older policy.
    fn add_segment(
        &mut self,
        ppo: &PpoConfig,
        staleness: &StalenessConfig,
        batch: &Batch,
        segment: &Segment,
        values: &[f32],
        prox_log_probs: Option<&[f32]>,
    ) {
        let cells = segment.first_row..segment.first_row + segment.steps * segment.lanes;
        let finals_row = segment.bootstrap_row + segment.lanes;
        let ratios: Option<Vec<f32>> = prox_log_probs.map(|prox| {
            let ratio = |i: usize| (prox[i] - batch.behaviour_log_probs[i]).exp();
            cells.clone().map(ratio).collect()
        });
        if let Some(ratios) = &ratios {
            let cap = staleness.weight_max as f32;
            let weights = &mut self.weights[cells.clone()];
            weights.iter_mut().zip(ratios).for_each(|(w, r)| *w = r.min(cap));
        }
        let chunk = Trajectories {
            lanes: segment.lanes,
            rewards: &batch.rewards[cells.clone()],
            terminated: &batch.terminated[cells.clone()],
            truncated: &batch.truncated[cells.clone()],
            values: &values[cells.clone()],
            bootstrap_values: &values[segment.bootstrap_row..finals_row],
            final_values: &values[finals_row..finals_row + segment.finals],
            ratios: match staleness.returns {
                Returns::Gae => None,
                Returns::Vtrace => ratios.as_deref(),
            },
        };
        let settings = VtraceSettings {
            gamma: ppo.gamma as f32,
            lambda: ppo.lambda as f32,
            rho_max: staleness.rho_max as f32,
            c_max: staleness.c_max as f32,
        };
        vtrace(&settings, &chunk, &mut self.advantages[cells.clone()], &mut self.targets[cells]);
    }
}

/// (Σw)²/(N·Σw²): 1 when all weights are equal.
pub(super) fn effective_share(weights: &[f32]) -> f64 {
    let (mut sum, mut squares) = (0.0, 0.0);
    for &w in weights {
        sum += f64::from(w);
        squares += f64::from(w).powi(2);
    }
    if squares > 0.0 { sum * sum / (weights.len() as f64 * squares) } else { 0.0 }
}

/// 1 − Var(target − V)/Var(target); 0 where the targets do not vary.
pub(super) fn explained_variance(values: &[f32], targets: &[f32]) -> f64 {
    let errors: Vec<f32> = targets.iter().zip(values).map(|(t, v)| t - v).collect();
    let (spread, left) = (mean_and_std(targets).1, mean_and_std(&errors).1);
    if spread > 0.0 { 1.0 - (left / spread).powi(2) } else { 0.0 }
}
