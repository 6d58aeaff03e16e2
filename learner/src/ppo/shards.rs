//! The shards of an update: worked on by the threads of this process, and added in their order.
//!
//! A batch is cut into shards by a rule that knows nothing of threads, and so *the bits of an update on the
//! CPU do not depend on the number of threads.*

use caudata_config::AdvantageScale;
use tch::{Device, Kind, Tensor};

use super::loss::{LossSettings, Outputs, Samples, loss_and_gradient, sums};
use super::pool::{Pool, SHARD_ROWS, Worker, rows, shards};
use crate::LearnerError;
use crate::network::ActorCritic;

/// Keeps a division by a spread finite.
const SPREAD_MIN: f64 = 1e-8;

/// One of the two networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Head {
    /// Means of the actions, `[·, A]`.
    Policy,
    /// Values, `[·, 1]`.
    Value,
}

/// Columns of the samples behind actions and means.
#[derive(Clone, Copy, Debug)]
#[repr(usize)]
pub enum Column {
    /// log π_prox(a).
    ProxLogProb = 0,
    /// A.
    Advantage = 1,
    /// Value target.
    Target = 2,
    /// w.
    Weight = 3,
}

/// How many [`Column`]s there are.
pub const SAMPLE_COLUMNS: usize = 4;

/// What the epochs of an update draw from, or one pass over it in the order of that pass.
#[derive(Debug)]
pub struct Draws {
    /// Normalised, `[B, D]`.
    pub observations: Tensor,
    /// Actions, means of π_prox, and the columns of [`Column`]: `[B, 2A + 4]`, as many rows as observations.
    pub samples: Tensor,
    /// Logarithm of the standard deviation of π_prox, `[A]`.
    pub prox_log_std: Tensor,
}

impl Draws {
    /// The rows of `order`, one after the other.
    pub fn shuffled(&self, order: &[i64]) -> Self {
        let index = Tensor::from_slice(order).to_device(self.samples.device());
        Self {
            observations: self.observations.index_select(0, &index),
            samples: self.samples.index_select(0, &index),
            prox_log_std: self.prox_log_std.shallow_clone(),
        }
    }
}

/// One minibatch of a shuffled pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Minibatch {
    /// First row and number of rows.
    pub part: (usize, usize),
    /// Weights and ranges of the loss.
    pub loss: LossSettings,
    /// Whether advantages are scaled over the minibatch, or over the batch.
    pub scale: AdvantageScale,
}

/// What the shards of a minibatch give together.
#[derive(Debug, Default)]
pub struct Total {
    /// In the order of [`sums`].
    pub sums: [f64; sums::COUNT],
    /// Gradient of the loss of the whole minibatch, `[P]`; nothing before the first shard.
    pub gradient: Option<Tensor>,
}

impl Total {
    /// Adds shards, in their order.
    ///
    /// # Errors
    /// When the device does not hand the sums over.
    fn add(&mut self, shards: Vec<(Tensor, Tensor)>) -> Result<(), LearnerError> {
        for (shard_sums, gradient) in shards {
            self.sums
                .iter_mut()
                .zip(host(&shard_sums)?)
                .for_each(|(sum, s)| *sum += f64::from(s));
            self.gradient = Some(match self.gradient.take() {
                Some(mut total) => total.g_add_(&gradient),
                None => gradient,
            });
        }
        Ok(())
    }
}

/// The threads that work on the shards of one network. Its parameters are the owner's: they change between
/// two calls, never during one.
#[derive(Debug)]
pub struct Shards {
    net: ActorCritic,
    pool: Pool,
}

impl Shards {
    /// `threads` threads on the CPU, one where the network lies on another device: a GPU works on whole
    /// minibatches, and a second thread could only queue behind the first.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        let on_cpu = net.device() == Device::Cpu;
        Ok(Self {
            pool: Pool::new(net, if on_cpu { threads } else { 1 })?,
            net: net.share(),
        })
    }

    /// What a network says of these observations, `[rows, ·]`.
    ///
    /// # Errors
    /// When a thread has died.
    pub fn forward(&mut self, head: Head, observations: &Tensor) -> Result<Tensor, LearnerError> {
        let parts = self.cut(observations.size()[0] as usize);
        let inputs = parts.iter().map(|&part| rows(observations, part)).collect();
        let outputs = match head {
            Head::Policy => self.pool.map(inputs, mean_of),
            Head::Value => self.pool.map(inputs, value_of),
        };
        Ok(Tensor::cat(&outputs?, 0))
    }

    /// Sums and gradient of a minibatch of `pass`.
    ///
    /// # Errors
    /// When a thread has died.
    pub fn gradient(&mut self, pass: &Draws, minibatch: &Minibatch) -> Result<Total, LearnerError> {
        let samples = rows(&pass.samples, minibatch.part);
        let observations = rows(&pass.observations, minibatch.part);
        if minibatch.scale == AdvantageScale::Minibatch {
            scale_advantages(&samples, self.net.spec().act_dim);
        }
        let parts = self.cut(minibatch.part.1);
        let jobs = parts.iter().map(|&part| GradientJob {
            observations: rows(&observations, part),
            samples: rows(&samples, part),
            prox_log_std: pass.prox_log_std.shallow_clone(),
            minibatch_rows: minibatch.part.1,
            settings: minibatch.loss,
        });
        let mut total = Total::default();
        total.add(self.pool.map(jobs.collect(), shard_gradient)?)?;
        Ok(total)
    }

    fn cut(&self, rows: usize) -> Vec<(usize, usize)> {
        match self.net.device() {
            Device::Cpu => shards(rows, SHARD_ROWS),
            _ => vec![(0, rows)],
        }
    }
}

struct GradientJob {
    observations: Tensor,
    /// As [`Draws::samples`].
    samples: Tensor,
    prox_log_std: Tensor,
    minibatch_rows: usize,
    settings: LossSettings,
}

fn value_of(worker: &mut Worker, observations: Tensor) -> Tensor {
    worker.net.value().forward(&observations)
}

fn mean_of(worker: &mut Worker, observations: Tensor) -> Tensor {
    worker.net.policy().forward(&observations)
}

/// Forward and backward of one shard; answers the sums of the loss and the gradient `[P]`.
fn shard_gradient(worker: &mut Worker, job: GradientJob) -> (Tensor, Tensor) {
    let (net, gradient) = worker.next_gradient();
    let actions = net.spec().act_dim as i64;
    let column = |c: Column| job.samples.narrow(1, 2 * actions + c as i64, 1);
    let samples = Samples {
        actions: job.samples.narrow(1, 0, actions),
        prox_means: job.samples.narrow(1, actions, actions),
        prox_log_probs: column(Column::ProxLogProb),
        advantages: column(Column::Advantage),
        targets: column(Column::Target),
        weights: column(Column::Weight),
    };
    let (means, policy_tape) = net.policy().forward_with_tape(&job.observations);
    let (values, value_tape) = net.value().forward_with_tape(&job.observations);
    let outputs = Outputs { means, values };
    let (sums, output_gradient) = loss_and_gradient(
        &job.settings,
        job.minibatch_rows,
        &outputs,
        &net.log_std(),
        &job.prox_log_std,
        &samples,
    );
    net.policy()
        .backward(&policy_tape, output_gradient.means, gradient.policy());
    net.value()
        .backward(&value_tape, output_gradient.values, gradient.value());
    net.log_std_backward(&output_gradient.log_std, gradient);
    (sums, gradient.flat().shallow_clone())
}

/// Advantages to mean 0 and deviation 1, in place: `samples` `[M, 2A + 4]` are the minibatch's own copy.
fn scale_advantages(samples: &Tensor, act_dim: usize) {
    let column = 2 * act_dim + Column::Advantage as usize;
    let mut advantages = samples.narrow(1, column as i64, 1);
    let mean = advantages.mean(Kind::Float);
    let std = advantages.std(false).g_add_scalar_(SPREAD_MIN);
    let _ = advantages.g_sub_(&mean).g_div_(&std);
}

/// All numbers of a tensor, on the host.
///
/// # Errors
/// When the device does not hand them over.
pub fn host(t: &Tensor) -> Result<Vec<f32>, LearnerError> {
    Ok(Vec::try_from(
        &t.to_device(Device::Cpu).contiguous().view([-1]),
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advantages_of_a_minibatch_are_shifted_and_scaled() {
        const ACT: usize = 2;
        let samples = Tensor::zeros(
            [3, 2 * ACT as i64 + SAMPLE_COLUMNS as i64],
            (Kind::Float, Device::Cpu),
        );
        let advantages = samples.narrow(1, 2 * ACT as i64 + 1, 1);
        advantages
            .shallow_clone()
            .copy_(&Tensor::from_slice(&[1.0_f32, 2.0, 6.0]).view([3, 1]));
        scale_advantages(&samples, ACT);
        // Mean 3, variance (4 + 1 + 9)/3.
        let expected = [-2.0, -1.0, 3.0].map(|x| x / (14.0_f64 / 3.0).sqrt());
        for (i, expected) in expected.iter().enumerate() {
            assert!((advantages.double_value(&[i as i64, 0]) - expected).abs() < 1e-6);
        }
    }

    #[test]
    fn shards_are_added_in_their_order() {
        // In single precision (1e8 + 1) − 1e8 = 0, and (1e8 − 1e8) + 1 = 1.
        let shard = |g: f32| (Tensor::from_slice(&[g; 4]), Tensor::from_slice(&[g]));
        let sum_of = |gradients: [f32; 3]| {
            let mut total = Total::default();
            total.add(gradients.map(shard).into()).unwrap();
            (total.gradient.unwrap().double_value(&[0]), total.sums[0])
        };
        // The sums of the loss are double.
        assert_eq!(sum_of([1e8, 1.0, -1e8]), (0.0, 1.0));
        assert_eq!(sum_of([1e8, -1e8, 1.0]), (1.0, 1.0));
    }
}
