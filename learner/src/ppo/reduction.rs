//! Where the shards of an update are worked on, and how what they give becomes one: the seam between the mathematics of an update and the
//! threads, or processes, that do it.
//!
//! A batch is cut into shards by a rule that knows nothing of threads or processes, and what shards give is added in their order. Whoever
//! implements [`Reduction`] keeps to that, and so *the bits of an update on the CPU depend neither on the number of threads nor on the number of ranks.*

use std::fmt::Debug;
use std::ops::Range;

use caudata_config::AdvantageScale;
use tch::{Device, Kind, Tensor};

use super::loss::{LossSettings, Outputs, Samples, loss_and_gradient, sums};
use super::pool::{Pool, SHARD_ROWS, Worker, rows, shards};
use crate::LearnerError;
use crate::network::ActorCritic;

/// Keeps a division by a spread finite.
const TINY: f64 = 1e-8;

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
pub const COLUMNS: usize = 4;

/// What the epochs of an update draw from besides the observations.
#[derive(Debug)]
pub struct Drawn {
    /// Actions, means of π_prox, and the columns of [`Column`], table after table: `[R, 2A + 4]`.
    pub samples: Tensor,
    /// Logarithm of the standard deviation of π_prox, `[A]`.
    pub prox_log_std: Tensor,
    /// First rows of each table that belong to it, B.
    pub rows: usize,
}

impl Drawn {
    /// Columns of the samples for `act_dim` actions, 2A + 4.
    pub fn width(act_dim: usize) -> usize {
        2 * act_dim + COLUMNS
    }
}

/// One minibatch of a shuffled pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Minibatch {
    /// First row and number of rows.
    pub part: (usize, usize),
    /// The loss's settings.
    pub loss: LossSettings,
    /// Advantages are shifted and scaled over the minibatch.
    pub scale_advantages: bool,
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
    pub fn add(&mut self, shards: Vec<(Tensor, Tensor)>) -> Result<(), LearnerError> {
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

/// Works on the shards of an update and makes one of what they give. The network's parameters are its owner's: they change between two calls of
/// [`gradient`](Self::gradient), never during one.
pub trait Reduction: Debug {
    /// A new update begins, with these tables of normalised observations, `[·, D]` each.
    ///
    /// # Errors
    /// When a rank is lost.
    fn begin(&mut self, tables: Vec<Tensor>) -> Result<(), LearnerError>;

    /// What a network says of the first `rows` rows of a table: `[rows, ·]`.
    ///
    /// # Errors
    /// When a thread or a rank is lost.
    fn forward(&mut self, head: Head, table: usize, rows: usize) -> Result<Tensor, LearnerError>;

    /// What the epochs draw from: the first rows of all tables, one after the other, and these samples of them.
    ///
    /// # Errors
    /// When a rank is lost.
    fn load(&mut self, drawn: Drawn) -> Result<(), LearnerError>;

    /// A new pass, in this order.
    ///
    /// # Errors
    /// When a rank is lost.
    fn shuffle(&mut self, order: &[i64]) -> Result<(), LearnerError>;

    /// Sums and gradient of a minibatch of the pass.
    ///
    /// # Errors
    /// When a thread or a rank is lost.
    fn gradient(&mut self, minibatch: &Minibatch) -> Result<Total, LearnerError>;

    /// The run ends in good order.
    fn finish(&mut self) {}

    /// A rank that was asked to stop, if there is one.
    fn leaving(&self) -> Option<u32> {
        None
    }
}

/// The threads of this process, and the data of an update on their device.
#[derive(Debug)]
pub struct Local {
    net: ActorCritic,
    pool: Pool,
    /// Ranks that share the work; 1 where this process is alone.
    ranks: usize,
    tables: Vec<Tensor>,
    drawn: Option<(Tensor, Drawn)>,
    /// Observations and samples in the order of the pass.
    pass: Option<(Tensor, Tensor)>,
}

impl Local {
    /// `threads` threads on the CPU, one where the network lies on another device; the work is shared by `ranks` processes like this.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize, ranks: usize) -> Result<Self, LearnerError> {
        let on_cpu = net.device() == Device::Cpu;
        Ok(Self {
            // One GPU works on whole minibatches; a second thread could only queue behind the first.
            pool: Pool::new(net, if on_cpu { threads } else { 1 })?,
            net: net.share(),
            ranks: ranks.max(1),
            tables: Vec::new(),
            drawn: None,
            pass: None,
        })
    }

    /// The network that it works on.
    pub fn net(&self) -> &ActorCritic {
        &self.net
    }

    /// How `rows` rows are cut. On a GPU there is one piece per rank, and the bits depend on their number.
    pub fn cut(&self, rows: usize) -> Vec<(usize, usize)> {
        if self.net.device() == Device::Cpu {
            return shards(rows, SHARD_ROWS);
        }
        let count = self.ranks.min(rows.max(1));
        let at = |part: usize| part * rows / count;
        (0..count)
            .map(|part| (at(part), at(part + 1) - at(part)))
            .collect()
    }

    /// As [`Reduction::begin`].
    pub fn begin(&mut self, tables: Vec<Tensor>) {
        (self.drawn, self.pass) = (None, None);
        self.tables = tables;
    }

    /// One more table.
    pub fn push_table(&mut self, table: Tensor) {
        self.tables.push(table);
    }

    /// As [`Reduction::forward`], for some of the shards: their outputs in order.
    ///
    /// # Errors
    /// [`LearnerError::Worker`] when a thread has died, [`LearnerError::Setting`] when there is no such table.
    pub fn forward(
        &mut self,
        head: Head,
        table: usize,
        count: usize,
        which: Range<usize>,
    ) -> Result<Vec<Tensor>, LearnerError> {
        let table = self.tables.get(table).ok_or_else(out_of_order)?;
        let parts = self.cut(count);
        let parts = parts.get(which).ok_or_else(out_of_order)?;
        let inputs = parts.iter().map(|&part| rows(table, part)).collect();
        match head {
            Head::Policy => self.pool.map(inputs, mean_of),
            Head::Value => self.pool.map(inputs, value_of),
        }
    }

    /// As [`Reduction::load`].
    pub fn load(&mut self, drawn: Drawn) {
        let firsts: Vec<Tensor> = self
            .tables
            .iter()
            .map(|table| rows(table, (0, drawn.rows)))
            .collect();
        let observations = match firsts.as_slice() {
            [only] => only.shallow_clone(),
            several => Tensor::cat(several, 0),
        };
        self.drawn = Some((observations, drawn));
    }

    /// As [`Reduction::shuffle`].
    ///
    /// # Errors
    /// [`LearnerError::Setting`] before [`Local::load`].
    pub fn shuffle(&mut self, order: &[i64]) -> Result<(), LearnerError> {
        let (observations, drawn) = self.drawn.as_ref().ok_or_else(out_of_order)?;
        let index = Tensor::from_slice(order).to_device(self.net.device());
        let observations = observations.index_select(0, &index);
        self.pass = Some((observations, drawn.samples.index_select(0, &index)));
        Ok(())
    }

    /// As [`Reduction::gradient`], for some of the shards: sums and gradient of each, in order. The gradients are good until the next call.
    ///
    /// # Errors
    /// [`LearnerError::Worker`] when a thread has died, [`LearnerError::Setting`] before [`Local::shuffle`].
    pub fn gradient(
        &mut self,
        minibatch: &Minibatch,
        which: Range<usize>,
    ) -> Result<Vec<(Tensor, Tensor)>, LearnerError> {
        let (observations, samples) = self.pass.as_ref().ok_or_else(out_of_order)?;
        let (_, drawn) = self.drawn.as_ref().ok_or_else(out_of_order)?;
        let samples = rows(samples, minibatch.part);
        let observations = rows(observations, minibatch.part);
        if minibatch.scale_advantages {
            scale_advantages(&samples, self.net.spec().act_dim);
        }
        let parts = self.cut(minibatch.part.1);
        let parts = parts.get(which).ok_or_else(out_of_order)?;
        let jobs = parts.iter().map(|&part| GradientJob {
            observations: rows(&observations, part),
            samples: rows(&samples, part),
            prox_log_std: drawn.prox_log_std.shallow_clone(),
            minibatch_rows: minibatch.part.1,
            settings: minibatch.loss,
        });
        self.pool.map(jobs.collect(), shard_gradient)
    }
}

fn out_of_order() -> LearnerError {
    LearnerError::setting("a step of an update came before the one that it builds on")
}

/// One process alone.
#[derive(Debug)]
pub struct InProcess(Local);

impl InProcess {
    /// `threads` threads on the CPU.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        Ok(Self(Local::new(net, threads, 1)?))
    }
}

impl Reduction for InProcess {
    fn begin(&mut self, tables: Vec<Tensor>) -> Result<(), LearnerError> {
        self.0.begin(tables);
        Ok(())
    }

    fn forward(&mut self, head: Head, table: usize, rows: usize) -> Result<Tensor, LearnerError> {
        let all = 0..self.0.cut(rows).len();
        Ok(Tensor::cat(&self.0.forward(head, table, rows, all)?, 0))
    }

    fn load(&mut self, drawn: Drawn) -> Result<(), LearnerError> {
        self.0.load(drawn);
        Ok(())
    }

    fn shuffle(&mut self, order: &[i64]) -> Result<(), LearnerError> {
        self.0.shuffle(order)
    }

    fn gradient(&mut self, minibatch: &Minibatch) -> Result<Total, LearnerError> {
        let all = 0..self.0.cut(minibatch.part.1).len();
        let mut total = Total::default();
        total.add(self.0.gradient(minibatch, all)?)?;
        Ok(total)
    }
}

struct GradientJob {
    observations: Tensor,
    /// As [`Drawn::samples`].
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
    let std = advantages.std(false).g_add_scalar_(TINY);
    let _ = advantages.g_sub_(&mean).g_div_(&std);
}

/// Whether a minibatch's advantages are scaled by themselves.
pub fn scales_minibatch(scale: AdvantageScale) -> bool {
    scale == AdvantageScale::Minibatch
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
            [3, 2 * ACT as i64 + COLUMNS as i64],
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
