//! One update: values and log-probabilities of the batch, advantages, then epochs of minibatches.

use caudata_config::{AdvantageScale, Config, Correction, PpoConfig, Returns, StalenessConfig};
use caudata_model::RobotModel;
use caudata_random::Stream;
use caudata_task::mirror::SignedPermutation;
use caudata_task::{Mirror, PolicyContract};
use tch::Tensor;

use super::loss::{LossSettings, entropy, log_prob, sums};
use super::pool::rows;
use super::reduction::{
    COLUMNS, Column, Drawn, Head, InProcess, Minibatch, Reduction, host, scales_minibatch,
};
use crate::LearnerError;
use crate::adam::Adam;
use crate::batch::{Batch, Segment};
use crate::network::ActorCritic;
use crate::normaliser::Scaling;
use crate::returns::{Trajectories, VtraceSettings, mean_and_std, vtrace, weighted_mean_and_std};

/// Factor of rsl_rl's rule for the learning rate.
const RATE_FACTOR: f64 = 1.5;
/// Keeps divisions by a spread or a norm finite.
const TINY: f64 = 1e-8;

/// The hyper-parameters of an update.
#[derive(Clone, Debug, PartialEq)]
pub struct PpoSettings {
    /// `[learner.ppo]`.
    pub ppo: PpoConfig,
    /// `[learner.staleness]`.
    pub staleness: StalenessConfig,
    /// Left and right exchanged, where `learner.ppo.mirror` asks for it.
    pub mirror: Option<Mirror>,
}

impl PpoSettings {
    /// What `config` asks for on this robot.
    ///
    /// # Errors
    /// When it asks for mirror images and the robot is not its own.
    pub fn new(
        config: &Config,
        model: &RobotModel,
        contract: &PolicyContract,
    ) -> Result<Self, LearnerError> {
        let ppo = config.learner.ppo.clone();
        let mirror = ppo
            .mirror
            .then(|| Mirror::new(model, &contract.observation))
            .transpose()?;
        Ok(Self {
            ppo,
            staleness: config.learner.staleness.clone(),
            mirror,
        })
    }
}

/// What an update did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// Mean clipped surrogate loss.
    pub surrogate: f64,
    /// Mean value loss, ¼·MSE.
    pub value_loss: f64,
    /// Entropy of the policy afterwards, nats.
    pub entropy: f64,
    /// Mean KL divergence from the policy before the update to the one at each minibatch, nats.
    pub kl: f64,
    /// Share of samples whose ratio was outside 1 ± ε.
    pub clip_fraction: f64,
    /// Mean norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// Effective sample size of the importance weights, as a share of the batch: 1 when nothing is stale.
    pub effective_share: f64,
    /// Share of the variance of the value targets that the critic explained before the update.
    pub explained_variance: f64,
    /// Learning rate after the update.
    pub learning_rate: f64,
    /// Mean standard deviation of the action noise afterwards.
    pub mean_std: f64,
    /// Minibatches that changed the weights.
    pub updates: u64,
    /// Minibatches left out because the loss or its gradient was not finite.
    pub skipped: u64,
}

/// Network, optimiser and learning rate, and what works on them.
#[derive(Debug)]
pub struct Ppo {
    net: ActorCritic,
    adam: Adam,
    reduction: Box<dyn Reduction>,
    settings: PpoSettings,
    learning_rate: f64,
    /// Environment steps of the whole run so far.
    env_steps: u64,
}

/// What is known of the batch before the epochs.
struct Prepared {
    effective_share: f64,
    explained_variance: f64,
}

/// Host-side results of the pass before the update.
struct Targets {
    advantages: Vec<f32>,
    targets: Vec<f32>,
    weights: Vec<f32>,
}

/// How a minibatch's gradient is used.
#[derive(Clone, Copy)]
struct Step {
    /// Factor on the learning rate.
    rate_guard: f64,
    /// Whether the policy stays as it is.
    value_only: bool,
}

/// Sums over the minibatches of an update, in the order of [`sums`].
#[derive(Default)]
struct Tally {
    sums: [f64; sums::COUNT],
    rows: f64,
    gradient_norm: f64,
    updates: u64,
    skipped: u64,
}

impl Ppo {
    /// The start: fresh optimiser, the learning rate of the configuration, `threads` threads on the CPU.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(
        net: ActorCritic,
        settings: PpoSettings,
        threads: usize,
    ) -> Result<Self, LearnerError> {
        let reduction = Box::new(InProcess::new(&net, threads)?);
        Ok(Self::with_reduction(net, settings, reduction))
    }

    /// The start, with somebody else to work on the shards of `net`.
    pub fn with_reduction(
        net: ActorCritic,
        settings: PpoSettings,
        reduction: Box<dyn Reduction>,
    ) -> Self {
        Self {
            adam: Adam::new(net.layout().len(), net.device()),
            reduction,
            learning_rate: settings.ppo.learning_rate,
            env_steps: 0,
            net,
            settings,
        }
    }

    /// The run ends in good order: other ranks may go.
    pub fn finish(&mut self) {
        self.reduction.finish();
    }

    /// A rank of this learner that was asked to stop, if there is one.
    pub fn leaving_rank(&self) -> Option<u32> {
        self.reduction.leaving()
    }

    /// The hyper-parameters.
    pub fn settings(&self) -> &PpoSettings {
        &self.settings
    }

    /// The network.
    pub fn net(&self) -> &ActorCritic {
        &self.net
    }

    /// The optimiser.
    pub fn adam(&self) -> &Adam {
        &self.adam
    }

    /// The optimiser, for restoring its state.
    pub fn adam_mut(&mut self) -> &mut Adam {
        &mut self.adam
    }

    /// Learning rate of the next update.
    pub fn learning_rate(&self) -> f64 {
        self.learning_rate
    }

    /// Environment steps of the whole run before the next update, on which the target of the KL divergence depends.
    pub fn set_progress(&mut self, env_steps: u64) {
        self.env_steps = env_steps;
    }

    /// After iterations with `value_only`: the optimiser forgets them. The policy had no gradient in them, and the second moments' correction for
    /// the first steps would be long gone: its first real steps would be three times as long as they should.
    pub fn begin_policy(&mut self) {
        self.adam.reset();
    }

    /// Sets the learning rate, for restoring it.
    pub fn set_learning_rate(&mut self, rate: f64) {
        self.learning_rate = rate;
    }

    /// Learns from `batch`, whose observations the current policy (version `policy_version`) sees through `scaling`.
    /// `order` decides which samples meet in a minibatch. With `value_only` the policy stays as it is.
    ///
    /// A minibatch whose loss or gradient is not finite changes nothing and is counted. An update that fails changes nothing at all.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] for a batch of other dimensions, an error of libtorch, or that a thread or a rank is lost.
    pub fn update(
        &mut self,
        batch: &Batch,
        scaling: &Scaling,
        policy_version: u64,
        order: &mut Stream,
        value_only: bool,
    ) -> Result<UpdateStats, LearnerError> {
        let _no_grad = tch::no_grad_guard();
        self.check(batch)?;
        // What is saved after a failure must be what an update ended with, not half of the next one.
        let parameters = self.net.flat().copy();
        let (adam, rate, shuffles) = (self.adam.copy(), self.learning_rate, order.clone());
        let updated = self.try_update(batch, scaling, policy_version, order, value_only);
        if updated.is_err() {
            self.net.flat().shallow_clone().copy_(&parameters);
            (self.adam, self.learning_rate, *order) = (adam, rate, shuffles);
        }
        updated
    }

    fn try_update(
        &mut self,
        batch: &Batch,
        scaling: &Scaling,
        policy_version: u64,
        order: &mut Stream,
        value_only: bool,
    ) -> Result<UpdateStats, LearnerError> {
        let prepared = self.prepare(batch, scaling, policy_version)?;
        let guard = if prepared.effective_share < self.settings.staleness.min_effective_share {
            0.5
        } else {
            1.0
        };
        let mut tally = Tally::default();
        let mut indices: Vec<i64> = (0..batch.rows as i64).collect();
        for epoch in 0..self.settings.ppo.epochs {
            order.shuffle(&mut indices);
            match self.settings.mirror {
                None => self.reduction.shuffle(&indices)?,
                Some(_) => self.reduction.shuffle(&half_mirrored(&indices, epoch))?,
            }
            for part in self.minibatches(batch.rows) {
                let step = Step {
                    rate_guard: guard,
                    value_only,
                };
                self.minibatch(part, step, &mut tally)?;
            }
        }
        Ok(self.stats(&tally, &prepared))
    }

    fn check(&self, batch: &Batch) -> Result<(), LearnerError> {
        let spec = self.net.spec();
        if let Some(mirror) = &self.settings.mirror {
            let found = (mirror.observation.source.len(), mirror.action.source.len());
            if found != (spec.obs_dim, spec.act_dim) {
                return Err(LearnerError::setting(format!(
                    "mirror of {} observations and {} actions for a network with {} and {}",
                    found.0, found.1, spec.obs_dim, spec.act_dim
                )));
            }
        }
        if batch.rows == 0 || batch.obs_dim != spec.obs_dim || batch.act_dim != spec.act_dim {
            return Err(LearnerError::setting(format!(
                "batch of {} samples with {} observations and {} actions for a network with {} and {}",
                batch.rows, batch.obs_dim, batch.act_dim, spec.obs_dim, spec.act_dim
            )));
        }
        Ok(())
    }

    /// Parts of as equal size as possible: (first row, rows).
    fn minibatches(&self, rows: usize) -> Vec<(usize, usize)> {
        let count = (self.settings.ppo.minibatches as usize).clamp(1, rows);
        let cut = |part: usize| part * rows / count;
        (0..count)
            .map(|part| (cut(part), cut(part + 1) - cut(part)))
            .collect()
    }

    fn prepare(
        &mut self,
        batch: &Batch,
        scaling: &Scaling,
        policy_version: u64,
    ) -> Result<Prepared, LearnerError> {
        let device = self.net.device();
        let (rows_all, obs_dim) = (
            batch.observations.len() / batch.obs_dim,
            batch.obs_dim as i64,
        );
        let raw = Tensor::from_slice(&batch.observations).view([rows_all as i64, obs_dim]);
        let all = scaling.apply(&raw.to_device(device));
        let mut tables = vec![all];
        let mirror = self.settings.mirror.clone();
        if let Some(mirror) = &mirror {
            let images = exchange(&rows(&raw, (0, batch.rows)), &mirror.observation);
            tables.push(scaling.apply(&images.to_device(device)));
        }
        self.reduction.begin(tables)?;
        let actions = Tensor::from_slice(&batch.actions)
            .view([batch.rows as i64, batch.act_dim as i64])
            .to_device(device);

        let values = host(&self.reduction.forward(Head::Value, 0, rows_all)?)?;
        let prox_means = self.reduction.forward(Head::Policy, 0, batch.rows)?;
        let prox_log_std = self.net.log_std();
        // Plain PPO clips against the policy that acted, whatever its age: then every ratio below is 1.
        let prox_log_probs: Vec<f32> = match self.settings.staleness.correction {
            Correction::Decoupled => host(&log_prob(&actions, &prox_means, &prox_log_std))?,
            Correction::None => batch.behaviour_log_probs.clone(),
        };

        let mut targets = self.targets(batch, &values, &prox_log_probs, policy_version);
        let effective_share = effective_share(&targets.weights);
        let explained_variance = explained_variance(&values[..batch.rows], &targets.targets);
        let mut samples = self.samples(&actions, &prox_means, &prox_log_probs, &targets);
        if let Some(mirror) = mirror {
            // Values and advantages of a mirror image are the sample's own. Its weight is how likely the policy is to act so: without it an action that
            // a lopsided policy would not take pushes the mean about, and the robot ends up standing.
            let actions = exchange(&actions, &mirror.action);
            let means = self.reduction.forward(Head::Policy, 1, batch.rows)?;
            let log_probs: Vec<f32> = host(&log_prob(&actions, &means, &prox_log_std))?;
            let cap = self.settings.staleness.weight_max as f32;
            targets.weights = image_weights(&log_probs, &batch.behaviour_log_probs, cap);
            let image_samples = self.samples(&actions, &means, &log_probs, &targets);
            samples = Tensor::cat(&[samples, image_samples], 0);
        }
        self.reduction.load(Drawn {
            samples,
            prox_log_std,
            rows: batch.rows,
        })?;
        Ok(Prepared {
            effective_share,
            explained_variance,
        })
    }

    /// The columns of [`Drawn::samples`].
    fn samples(
        &self,
        actions: &Tensor,
        prox_means: &Tensor,
        prox_log_probs: &[f32],
        targets: &Targets,
    ) -> Tensor {
        let columns = Tensor::from_slice(&interleave(prox_log_probs, targets))
            .view([-1, COLUMNS as i64])
            .to_device(self.net.device());
        Tensor::cat(&[actions, prox_means, &columns], 1)
    }

    /// Advantages (scaled over the batch if so configured), value targets and importance weights.
    fn targets(
        &self,
        batch: &Batch,
        values: &[f32],
        prox_log_probs: &[f32],
        policy_version: u64,
    ) -> Targets {
        let mut out = Targets {
            advantages: vec![0.0; batch.rows],
            targets: vec![0.0; batch.rows],
            weights: vec![1.0; batch.rows],
        };
        for segment in &batch.segments {
            self.segment_targets(
                batch,
                segment,
                values,
                prox_log_probs,
                policy_version,
                &mut out,
            );
        }
        if self.settings.ppo.advantage_scale == AdvantageScale::Batch {
            // Of the policy before the update: by the weights that samples have in the loss, which are 1 where they are its own.
            let (mean, std) = weighted_mean_and_std(&out.advantages, &out.weights);
            let scaled = |a: f32| ((f64::from(a) - mean) / (std + TINY)) as f32;
            out.advantages.iter_mut().for_each(|a| *a = scaled(*a));
        }
        out
    }

    fn segment_targets(
        &self,
        batch: &Batch,
        segment: &Segment,
        values: &[f32],
        prox_log_probs: &[f32],
        policy_version: u64,
        out: &mut Targets,
    ) {
        let cells = segment.first_row..segment.first_row + segment.steps * segment.lanes;
        let finals_row = segment.bootstrap_row + segment.lanes;
        // The same policy computed by ONNX Runtime and by libtorch differs in the last bits; that is no staleness.
        let ratios: Option<Vec<f32>> = (segment.policy_version != policy_version).then(|| {
            let ratio = |i: usize| (prox_log_probs[i] - batch.behaviour_log_probs[i]).exp();
            cells.clone().map(ratio).collect()
        });
        if let Some(ratios) = &ratios {
            let cap = self.settings.staleness.weight_max as f32;
            let weights = &mut out.weights[cells.clone()];
            weights
                .iter_mut()
                .zip(ratios)
                .for_each(|(w, r)| *w = r.min(cap));
        }
        let chunk = Trajectories {
            lanes: segment.lanes,
            rewards: &batch.rewards[cells.clone()],
            terminated: &batch.terminated[cells.clone()],
            truncated: &batch.truncated[cells.clone()],
            values: &values[cells.clone()],
            bootstrap_values: &values[segment.bootstrap_row..finals_row],
            final_values: &values[finals_row..finals_row + segment.finals],
            ratios: match self.settings.staleness.returns {
                Returns::Gae => None,
                Returns::Vtrace => ratios.as_deref(),
            },
        };
        let settings = VtraceSettings {
            gamma: self.settings.ppo.gamma as f32,
            lambda: self.settings.ppo.lambda as f32,
            rho_max: self.settings.staleness.rho_max as f32,
            c_max: self.settings.staleness.c_max as f32,
        };
        vtrace(
            &settings,
            &chunk,
            &mut out.advantages[cells.clone()],
            &mut out.targets[cells],
        );
    }

    /// Gradient of one minibatch, and the step that it gives.
    fn minibatch(
        &mut self,
        part: (usize, usize),
        step: Step,
        tally: &mut Tally,
    ) -> Result<(), LearnerError> {
        let minibatch_rows = part.1;
        let ppo = &self.settings.ppo;
        let total = self.reduction.gradient(&Minibatch {
            part,
            loss: LossSettings {
                clip: ppo.clip,
                value_weight: ppo.value_loss_weight,
                entropy_weight: ppo.entropy_weight,
            },
            scale_advantages: scales_minibatch(ppo.advantage_scale),
        })?;
        let sums = total.sums;
        let Some(gradient) = total.gradient else {
            return Ok(());
        };
        if step.value_only {
            let policy = self.net.policy_len() as i64;
            let _ = gradient.narrow(0, 0, policy).zero_();
        }
        let norm = gradient.norm().double_value(&[]);
        if !norm.is_finite() || sums.iter().any(|sum| !sum.is_finite()) {
            tally.skipped += 1;
            return Ok(());
        }
        let kl = sums[sums::KL] / minibatch_rows as f64;
        if !step.value_only {
            let target_kl = self.settings.ppo.target_kl_after(self.env_steps);
            self.learning_rate =
                adapted_rate(&self.settings.ppo, target_kl, self.learning_rate, kl);
        }
        self.step(gradient, norm, step.rate_guard);
        tally.add(&sums, minibatch_rows, norm);
        Ok(())
    }

    fn step(&mut self, mut gradient: Tensor, norm: f64, rate_guard: f64) {
        let rate = self.learning_rate * rate_guard;
        let largest = self.settings.ppo.max_grad_norm;
        if norm > largest {
            gradient = gradient.g_mul_scalar_(largest / norm);
        }
        let policy = self.net.policy_len();
        let value = self.net.layout().len() - policy;
        let value_rate = match self.settings.ppo.value_learning_rate {
            0.0 => rate,
            own => own * rate_guard,
        };
        let rates = [(policy, rate), (value, value_rate)];
        self.adam.step(self.net.flat(), &gradient, &rates);
    }

    fn stats(&self, tally: &Tally, prepared: &Prepared) -> UpdateStats {
        let log_std = self.net.log_std();
        let mean = |index: usize| tally.sums[index] / tally.rows.max(1.0);
        UpdateStats {
            surrogate: mean(sums::SURROGATE),
            value_loss: mean(sums::VALUE),
            entropy: entropy(&log_std),
            kl: mean(sums::KL),
            clip_fraction: mean(sums::CLIPPED),
            gradient_norm: tally.gradient_norm / tally.updates.max(1) as f64,
            effective_share: prepared.effective_share,
            explained_variance: prepared.explained_variance,
            learning_rate: self.learning_rate,
            mean_std: log_std.exp().mean(tch::Kind::Double).double_value(&[]),
            updates: tally.updates,
            skipped: tally.skipped,
        }
    }
}

impl Tally {
    fn add(&mut self, sums: &[f64], rows: usize, norm: f64) {
        self.sums
            .iter_mut()
            .zip(sums)
            .for_each(|(total, sum)| *total += sum);
        self.rows += rows as f64;
        self.gradient_norm += norm;
        self.updates += 1;
    }
}

/// rsl_rl's rule; the rate stays when no target is set.
fn adapted_rate(ppo: &PpoConfig, target_kl: f64, rate: f64, kl: f64) -> f64 {
    if target_kl <= 0.0 {
        return rate;
    }
    if kl > 2.0 * target_kl {
        (rate / RATE_FACTOR).max(ppo.learning_rate_min)
    } else if kl > 0.0 && kl < 0.5 * target_kl {
        (rate * RATE_FACTOR).min(ppo.learning_rate_max)
    } else {
        rate
    }
}

/// In each pass every other sample as it is and the others as their mirror images, which follow B rows later; the other way round in the next pass.
fn half_mirrored(indices: &[i64], epoch: u32) -> Vec<i64> {
    let rows = indices.len() as i64;
    let image = |&i: &i64| i + rows * ((i + i64::from(epoch)) & 1);
    indices.iter().map(image).collect()
}

/// min(π_prox(image)/μ, `cap`) for each sample.
fn image_weights(images: &[f32], acted: &[f32], cap: f32) -> Vec<f32> {
    let pairs = images.iter().zip(acted);
    pairs
        .map(|(image, acted)| (image - acted).exp().min(cap))
        .collect()
}

/// The mirror image of each row.
fn exchange(values: &Tensor, by: &SignedPermutation) -> Tensor {
    let source: Vec<i64> = by.source.iter().map(|&i| i as i64).collect();
    let device = values.device();
    let sign = Tensor::from_slice(&by.sign).to_device(device);
    values.index_select(1, &Tensor::from_slice(&source).to_device(device)) * sign
}

/// (Σw)²/(N·Σw²): 1 when all weights are equal.
fn effective_share(weights: &[f32]) -> f64 {
    let (mut sum, mut squares) = (0.0, 0.0);
    for &w in weights {
        sum += f64::from(w);
        squares += f64::from(w).powi(2);
    }
    if squares > 0.0 {
        sum * sum / (weights.len() as f64 * squares)
    } else {
        0.0
    }
}

/// 1 − Var(target − V)/Var(target); 0 where the targets do not vary.
fn explained_variance(values: &[f32], targets: &[f32]) -> f64 {
    let errors: Vec<f32> = targets.iter().zip(values).map(|(t, v)| t - v).collect();
    let (spread, left) = (mean_and_std(targets).1, mean_and_std(&errors).1);
    if spread > 0.0 {
        1.0 - (left / spread).powi(2)
    } else {
        0.0
    }
}

fn interleave(prox_log_probs: &[f32], targets: &Targets) -> Vec<f32> {
    let mut columns = vec![0.0; prox_log_probs.len() * COLUMNS];
    for (i, row) in columns.chunks_exact_mut(COLUMNS).enumerate() {
        row[Column::ProxLogProb as usize] = prox_log_probs[i];
        row[Column::Advantage as usize] = targets.advantages[i];
        row[Column::Target as usize] = targets.targets[i];
        row[Column::Weight as usize] = targets.weights[i];
    }
    columns
}

#[cfg(test)]
mod tests;
