//! One update: values and log-probabilities of the batch, advantages, then epochs of minibatches.

use std::sync::Arc;

use caudata_config::{Config, Correction, PpoConfig, StalenessConfig, TeacherConfig};
use caudata_random::Stream;
use caudata_telemetry::Pulse;
use caudata_telemetry::spans::{Laps, Part};

use super::gradient::on_its_device;
use super::loss::{entropy, log_probs};
use super::minibatch::{LossSettings, Minibatch, Samples, Step, Total, advantage_scale, sums};
use super::networks::Networks;
use super::targets::{Targets, effective_share, explained_variance};
use crate::LearnerError;
use crate::adam::Adam;
use crate::batch::Batch;
use crate::network::ActorCritic;
use crate::normaliser::Scaling;
use crate::teacher::Teacher;

/// Factor of rsl_rl's rule for the learning rate.
const RATE_FACTOR: f64 = 1.5;

/// The hyper-parameters of an update.
#[derive(Clone, Debug, PartialEq)]
pub struct PpoSettings {
    /// `[learner.ppo]`.
    pub ppo: PpoConfig,
    /// `[learner.staleness]`.
    pub staleness: StalenessConfig,
    /// `[learner.teacher]`.
    pub teacher: TeacherConfig,
}

impl PpoSettings {
    /// What `config` asks for.
    pub fn new(config: &Config) -> Self {
        let learner = &config.learner;
        Self {
            ppo: learner.ppo.clone(),
            staleness: learner.staleness.clone(),
            teacher: learner.teacher.clone(),
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
    /// Mean of half the squared distance from a teacher's actions.
    pub teacher_loss: f64,
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
    networks: Box<dyn Networks>,
    teacher: Option<Teacher>,
    settings: PpoSettings,
    /// Learning rate of the next update.
    pub learning_rate: f64,
    /// Environment steps of the whole run so far.
    env_steps: u64,
    pulse: Pulse,
}

/// What is known of the batch before the epochs.
struct Prepared {
    samples: Arc<Samples>,
    effective_share: f64,
    explained_variance: f64,
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
            adam: Adam::new(net.layout().len()),
            networks: on_its_device(&net, threads)?,
            teacher: None,
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

    /// From now on it learns from `teacher` as well.
    pub fn learn_from(&mut self, teacher: Teacher) {
        self.teacher = Some(teacher);
    }

    /// Other hyper-parameters, from the next update on.
    pub fn set_settings(&mut self, settings: PpoSettings) {
        self.settings = settings;
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
        batch: &Arc<Batch>,
        scaling: &Scaling,
        policy_version: u64,
        order: &mut Stream,
        value_only: bool,
    ) -> Result<UpdateStats, LearnerError> {
        let _no_grad = tch::no_grad_guard();
        self.check(batch)?;
        let (rate, shuffles) = (self.learning_rate, order.clone());
        let result = self.try_update(batch, scaling, policy_version, order, value_only);
        if result.is_err() {
            // What is saved after a failure must be what an update ended with, not half of the next one.
            (self.learning_rate, *order) = (rate, shuffles);
        }
        result
    }

    fn try_update(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        policy_version: u64,
        order: &mut Stream,
        value_only: bool,
    ) -> Result<UpdateStats, LearnerError> {
        let parameters = self.net.to_vec()?;
        self.networks.take_up(&parameters, &self.adam);
        let prepared = self.prepare(&parameters, batch, scaling, policy_version)?;
        let mut tally = Tally::default();
        let guard = if prepared.effective_share < self.settings.staleness.min_effective_share {
            0.5
        } else {
            1.0
        };
        let mut indices: Vec<u32> = (0..batch.rows as u32).collect();
        for _ in 0..self.settings.ppo.epochs {
            order.shuffle(&mut indices);
            let order: Arc<[u32]> = Arc::from(&indices[..]);
            for part in self.minibatches(batch.rows) {
                let minibatch = self.minibatch(&prepared.samples, &order, part, value_only);
                self.learn(&mut tally, &prepared.samples, &minibatch, guard)?;
            }
        }
        let (parameters, adam) = self.networks.state()?;
        self.net.set(&parameters);
        self.adam = adam;
        Ok(self.stats(&tally, &parameters, &prepared))
    }

    fn check(&self, batch: &Batch) -> Result<(), LearnerError> {
        let spec = self.net.spec();
        if batch.rows == 0 || batch.obs_dim != spec.seen_dim() || batch.act_dim != spec.act_dim {
            return Err(LearnerError::setting(format!(
                "batch of {} samples with {} observations and {} actions for a network with {} and {}",
                batch.rows,
                batch.obs_dim,
                batch.act_dim,
                spec.seen_dim(),
                spec.act_dim
            )));
        }
        Ok(())
    }

    /// Parts of as equal size as possible: (first row, rows).
    fn minibatches(&self, rows: usize) -> Vec<(usize, usize)> {
        let count = (self.settings.ppo.minibatches as usize).clamp(1, rows);
        let cut = |part: usize| part * rows / count;
        (0..count).map(|part| (cut(part), cut(part + 1) - cut(part))).collect()
    }

    fn prepare(
        &mut self,
        parameters: &[f32],
        batch: &Arc<Batch>,
        scaling: &Scaling,
        policy_version: u64,
    ) -> Result<Prepared, LearnerError> {
        // Actors compute what the learner would: the same weights in the same lanes.
        let known = batch.means_of(policy_version);
        let before = self.networks.begin(batch, scaling, known.is_none())?;
        let prox_means = known.map_or(before.means, <[f32]>::to_vec);
        let mut laps = Laps::new();
        let prox_log_std = self.net.place().log_std_of(parameters);
        // Plain PPO clips against the policy that acted, whatever its age: then every ratio below is 1.
        let prox_log_probs = match self.settings.staleness.correction {
            Correction::Decoupled => log_probs(&batch.actions, &prox_means, &prox_log_std),
            Correction::None => batch.behaviour_log_probs.clone(),
        };
        let (ppo, staleness) = (&self.settings.ppo, &self.settings.staleness);
        let targets =
            Targets::new(ppo, staleness, batch, &before.values, &prox_log_probs, policy_version);
        let weight = self.settings.teacher.weight_after(self.env_steps);
        let teacher = self.teacher.as_mut().filter(|_| weight > 0.0);
        let prepared = Prepared {
            effective_share: effective_share(&targets.weights),
            explained_variance: explained_variance(&before.values[..batch.rows], &targets.targets),
            samples: Arc::new(Samples {
                prox_means,
                prox_log_std,
                prox_log_probs,
                advantages: targets.advantages,
                targets: targets.targets,
                weights: targets.weights,
                teacher: teacher.map(|teacher| (teacher.actions(batch), weight as f32)),
            }),
        };
        laps.lap(Part::Returns);
        Ok(prepared)
    }

    fn minibatch(
        &self,
        samples: &Samples,
        order: &Arc<[u32]>,
        part: (usize, usize),
        value_only: bool,
    ) -> Minibatch {
        let ppo = &self.settings.ppo;
        let own = &order[part.0..][..part.1];
        Minibatch {
            advantage_scale: advantage_scale(ppo.advantage_scale, &samples.advantages, own),
            order: Arc::clone(order),
            part,
            loss: LossSettings {
                clip: ppo.clip,
                value_weight: ppo.value_loss_weight,
                entropy_weight: ppo.entropy_weight,
            },
            value_only,
        }
    }

    /// Gradient of one minibatch, and the step that it gives.
    fn learn(
        &mut self,
        tally: &mut Tally,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
        rate_guard: f64,
    ) -> Result<(), LearnerError> {
        self.pulse.beat();
        let rows = minibatch.part.1;
        let Total { sums, norm } = self.networks.gradient(samples, minibatch)?;
        let mut laps = Laps::new();
        if !norm.is_finite() || sums.iter().any(|sum| !sum.is_finite()) {
            tally.skipped += 1;
            return Ok(());
        }
        if !minibatch.value_only {
            let ppo = &self.settings.ppo;
            let (target_kl, kl) =
                (ppo.target_kl_after(self.env_steps), sums[sums::KL] / rows as f64);
            self.learning_rate = adapted_rate(ppo, target_kl, self.learning_rate, kl);
        }
        let step = self.step(norm, rate_guard);
        self.networks.step(&step);
        tally.add(&sums, rows, norm);
        laps.lap(Part::Optimiser);
        Ok(())
    }

    fn step(&self, norm: f64, rate_guard: f64) -> Step {
        let rate = self.learning_rate * rate_guard;
        let largest = self.settings.ppo.max_grad_norm;
        let policy = self.net.policy_len();
        let value = self.net.layout().len() - policy;
        let value_rate = match self.settings.ppo.value_learning_rate {
            0.0 => rate,
            own => own * rate_guard,
        };
        Step {
            scale: if norm > largest { largest / norm } else { 1.0 },
            rates: [(policy, rate), (value, value_rate)],
        }
    }

    fn stats(&self, tally: &Tally, parameters: &[f32], prepared: &Prepared) -> UpdateStats {
        let log_std = self.net.place().log_std_of(parameters);
        let std = log_std.iter().map(|&x| f64::from(x).exp());
        let mean = |index: usize| tally.sums[index] / tally.rows.max(1.0);
        UpdateStats {
            surrogate: mean(sums::SURROGATE),
            value_loss: mean(sums::VALUE),
            teacher_loss: mean(sums::TEACHER),
            entropy: entropy(&log_std),
            kl: mean(sums::KL),
            clip_fraction: mean(sums::CLIPPED),
            gradient_norm: tally.gradient_norm / tally.updates.max(1) as f64,
            effective_share: prepared.effective_share,
            explained_variance: prepared.explained_variance,
            learning_rate: self.learning_rate,
            mean_std: std.sum::<f64>() / log_std.len() as f64,
            updates: tally.updates,
            skipped: tally.skipped,
        }
    }
}

impl Tally {
    fn add(&mut self, sums: &[f64], rows: usize, norm: f64) {
        self.sums.iter_mut().zip(sums).for_each(|(total, sum)| *total += sum);
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
