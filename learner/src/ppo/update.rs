//! One update: values and log-probabilities of the batch, advantages, then epochs of minibatches.

use caudata_config::{Config, Correction, PpoConfig, StalenessConfig};
use caudata_random::Stream;
use caudata_telemetry::Pulse;
use tch::Tensor;

use super::loss::{LossSettings, entropy, log_prob, sums};
use super::pool::rows;
use super::shards::{Draws, Head, Minibatch, SAMPLE_COLUMNS, Shards, host};
use super::targets::{Targets, effective_share, explained_variance};
use crate::LearnerError;
use crate::adam::Adam;
use crate::batch::Batch;
use crate::network::ActorCritic;
use crate::normaliser::Scaling;

/// Factor of rsl_rl's rule for the learning rate.
const RATE_FACTOR: f64 = 1.5;

/// The hyper-parameters of an update.
#[derive(Clone, Debug, PartialEq)]
pub struct PpoSettings {
    /// `[learner.ppo]`.
    pub ppo: PpoConfig,
    /// `[learner.staleness]`.
    pub staleness: StalenessConfig,
}

impl PpoSettings {
    /// What `config` asks for.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        Self {
            ppo: config.learner.ppo.clone(),
            staleness: config.learner.staleness.clone(),
        }
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
    shards: Shards,
    settings: PpoSettings,
    learning_rate: f64,
    /// Environment steps of the whole run so far.
    env_steps: u64,
    pulse: Pulse,
}

/// What is known of the batch before the epochs.
struct Prepared {
    draws: Draws,
    effective_share: f64,
    explained_variance: f64,
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
        Ok(Self {
            adam: Adam::new(net.layout().len(), net.device()),
            shards: Shards::new(&net, threads)?,
            learning_rate: settings.ppo.learning_rate,
            env_steps: 0,
            pulse: Pulse::new(),
            net,
            settings,
        })
    }

    /// From now on `pulse` beats with each minibatch.
    pub fn beat(&mut self, pulse: Pulse) {
        self.pulse = pulse;
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

    /// Environment steps of the whole run before the next update, on which the target of the KL divergence
    /// depends.
    pub fn set_progress(&mut self, env_steps: u64) {
        self.env_steps = env_steps;
    }

    /// After iterations with `value_only`: the optimiser forgets them. The policy had no gradient in them,
    /// and the second moments' correction for the first steps would be long gone: its first real steps would
    /// be three times as long as they should.
    pub fn begin_policy(&mut self) {
        self.adam.reset();
    }

    /// Sets the learning rate, for restoring it.
    pub fn set_learning_rate(&mut self, rate: f64) {
        self.learning_rate = rate;
    }

    /// Learns from `batch`, whose observations the current policy (version `policy_version`) sees through
    /// `scaling`. `order` decides which samples meet in a minibatch. With `value_only` the policy stays as it
    /// is.
    ///
    /// A minibatch whose loss or gradient is not finite changes nothing and is counted. An update that fails
    /// changes nothing at all.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] for a batch of other dimensions, an error of libtorch, or that a thread has
    /// died.
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
        for _ in 0..self.settings.ppo.epochs {
            order.shuffle(&mut indices);
            let pass = prepared.draws.shuffled(&indices);
            for part in self.minibatches(batch.rows) {
                let step = Step {
                    rate_guard: guard,
                    value_only,
                };
                self.minibatch(&pass, part, step, &mut tally)?;
            }
        }
        Ok(self.stats(&tally, &prepared))
    }

    fn check(&self, batch: &Batch) -> Result<(), LearnerError> {
        let spec = self.net.spec();
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
        let observations = rows(&all, (0, batch.rows));
        let actions = Tensor::from_slice(&batch.actions)
            .view([batch.rows as i64, batch.act_dim as i64])
            .to_device(device);

        let values = host(&self.shards.forward(Head::Value, &all)?)?;
        let prox_means = self.shards.forward(Head::Policy, &observations)?;
        let prox_log_std = self.net.log_std();
        // Plain PPO clips against the policy that acted, whatever its age: then every ratio below is 1.
        let prox_log_probs: Vec<f32> = match self.settings.staleness.correction {
            Correction::Decoupled => host(&log_prob(&actions, &prox_means, &prox_log_std))?,
            Correction::None => batch.behaviour_log_probs.clone(),
        };

        let (ppo, staleness) = (&self.settings.ppo, &self.settings.staleness);
        let targets = Targets::new(
            ppo,
            staleness,
            batch,
            &values,
            &prox_log_probs,
            policy_version,
        );
        let effective_share = effective_share(&targets.weights);
        let explained_variance = explained_variance(&values[..batch.rows], &targets.targets);
        let samples = self.samples(&actions, &prox_means, &prox_log_probs, &targets);
        Ok(Prepared {
            draws: Draws {
                observations,
                samples,
                prox_log_std,
            },
            effective_share,
            explained_variance,
        })
    }

    /// As [`Draws::samples`].
    fn samples(
        &self,
        actions: &Tensor,
        prox_means: &Tensor,
        prox_log_probs: &[f32],
        targets: &Targets,
    ) -> Tensor {
        let columns = Tensor::from_slice(&targets.columns(prox_log_probs))
            .view([-1, SAMPLE_COLUMNS as i64])
            .to_device(self.net.device());
        Tensor::cat(&[actions, prox_means, &columns], 1)
    }

    /// Gradient of one minibatch, and the step that it gives.
    fn minibatch(
        &mut self,
        pass: &Draws,
        part: (usize, usize),
        step: Step,
        tally: &mut Tally,
    ) -> Result<(), LearnerError> {
        self.pulse.beat();
        let minibatch_rows = part.1;
        let ppo = &self.settings.ppo;
        let minibatch = Minibatch {
            part,
            loss: LossSettings {
                clip: ppo.clip,
                value_weight: ppo.value_loss_weight,
                entropy_weight: ppo.entropy_weight,
            },
            scale: ppo.advantage_scale,
        };
        let total = self.shards.gradient(pass, &minibatch)?;
        let sums = total.sums;
        let Some(gradient) = total.gradient else {
            return Ok(());
        };
        let gradient = self.net.symmetric_gradient(gradient);
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

#[cfg(test)]
mod tests;
