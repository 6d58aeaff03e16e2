//! The networks on a device of libtorch, a minibatch at a time: a GPU works on it whole. Parameters, gradient and
//! the optimiser's moments stay there during an update. The loss lies between forward and backward, on the host,
//! the same as for [`super::host`].

use std::sync::Arc;

use caudata_telemetry::spans::{Laps, Part};
use tch::{Device, Kind, Tensor};

use super::loss::Loss;
use super::minibatch::{Before, Minibatch, Samples, Step, Total, sums};
use super::networks::Networks;
use super::pool::{Pool, SHARD_ROWS, shards};
use crate::LearnerError;
use crate::adam::{Adam, BETA1, BETA2, EPSILON};
use crate::batch::Batch;
use crate::network::{ActorCritic, Place};
use crate::normaliser::Scaling;

/// The networks, their gradient, the optimiser, and the batch that is being learnt from.
#[derive(Debug)]
pub struct Torch {
    net: ActorCritic,
    gradient: ActorCritic,
    place: Place,
    /// Where the counterpart of each parameter lies and its sign, `[P]`, if the network is symmetric.
    counterparts: Option<(Tensor, Tensor)>,
    /// First and second moment, `[P]`.
    moments: (Tensor, Tensor),
    /// Counts the steps; its moments are those before the update.
    adam: Adam,
    batch: Arc<Batch>,
    /// Normalised, `[B, D]`.
    observations: Tensor,
    /// An order of the samples, and the observations in that order.
    epoch: (Arc<[u32]>, Tensor),
    pool: Pool<()>,
}

impl Torch {
    /// Networks of the shape of `net`, on its device.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        let device = net.device();
        let counterparts = net.counterparts().map(|mirror| {
            let source: Vec<i64> = mirror.source.iter().map(|&from| from as i64).collect();
            let on = |tensor: Tensor| tensor.to_device(device);
            (on(Tensor::from_slice(&source)), on(Tensor::from_slice(&mirror.sign)))
        });
        let nothing = || Tensor::zeros([0, 0], (Kind::Float, device));
        Ok(Self {
            net: net.zeros_like(),
            gradient: net.zeros_like(),
            place: net.place(),
            counterparts,
            moments: (net.flat().zeros_like(), net.flat().zeros_like()),
            adam: Adam::new(net.layout().len()),
            batch: Arc::default(),
            observations: nothing(),
            epoch: (Arc::default(), nothing()),
            pool: Pool::new(threads)?,
        })
    }

    /// Observations of a minibatch, `[M, D]`.
    fn seen(&mut self, minibatch: &Minibatch) -> Tensor {
        if !Arc::ptr_eq(&self.epoch.0, &minibatch.order) {
            let order: Vec<i64> = minibatch.order.iter().map(|&i| i64::from(i)).collect();
            let order = Tensor::from_slice(&order).to_device(self.net.device());
            let shuffled = self.observations.index_select(0, &order);
            self.epoch = (Arc::clone(&minibatch.order), shuffled);
        }
        let (first, rows) = minibatch.part;
        self.epoch.1.narrow(0, first as i64, rows as i64)
    }

    /// Sums of the loss, and its gradient. `outputs` are means and value of each sample, `[M, A + 1]`, and behind them
    /// the parameters of the log-std, `[A]`; the gradient with respect to them lies likewise.
    fn loss(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
        outputs: Vec<f32>,
    ) -> Result<([f64; sums::COUNT], Vec<f32>), LearnerError> {
        let rows = minibatch.part.1;
        let raw = &outputs[outputs.len() - self.place.act_dim..];
        let (log_std, slope) = self.place.log_std_and_slope(raw);
        let (outputs, log_std): (Arc<[f32]>, Arc<[f32]>) = (outputs.into(), log_std.into());
        let jobs = shards(rows, SHARD_ROWS).into_iter().map(|part| LossJob {
            batch: Arc::clone(&self.batch),
            samples: Arc::clone(samples),
            minibatch: minibatch.clone(),
            outputs: Arc::clone(&outputs),
            log_std: Arc::clone(&log_std),
            part,
        });
        let (mut total, mut of_log_std) = ([0.0; sums::COUNT], vec![0.0; slope.len()]);
        let mut gradient = Vec::with_capacity(outputs.len());
        for (sums, outputs, log_std) in self.pool.map(jobs.collect(), shard_loss)? {
            total.iter_mut().zip(sums).for_each(|(total, sum)| *total += sum);
            of_log_std.iter_mut().zip(log_std).for_each(|(total, g)| *total += g);
            gradient.extend(outputs);
        }
        gradient.extend(of_log_std.iter().zip(&slope).map(|(g, slope)| g * slope));
        Ok((total, gradient))
    }

    /// The gradient becomes what it is to be: that of the mirror image as well, or of the value function alone.
    fn settle_gradient(&self, value_only: bool) {
        let mut gradient = self.gradient.flat().shallow_clone();
        if let Some((source, sign)) = &self.counterparts {
            gradient += gradient.index_select(0, source) * sign;
            gradient *= 0.5;
        }
        if value_only {
            let _ = gradient.narrow(0, 0, self.place.policy_len as i64).zero_();
        }
    }
}

impl Networks for Torch {
    fn take_up(&mut self, parameters: &[f32], adam: &Adam) {
        self.net.set(parameters);
        let (m, v, _) = adam.state();
        self.moments.0.copy_(&Tensor::from_slice(&m));
        self.moments.1.copy_(&Tensor::from_slice(&v));
        self.adam = adam.clone();
    }

    fn begin(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        means: bool,
    ) -> Result<Before, LearnerError> {
        let raw = Tensor::from_slice(&batch.observations).view([-1, batch.obs_dim as i64]);
        let all = scaling.apply(&raw.to_device(self.net.device()));
        self.observations = all.narrow(0, 0, batch.rows as i64);
        self.epoch.0 = Arc::default();
        self.batch = Arc::clone(batch);
        let seen = policy_sees(&self.net, &self.observations);
        Ok(Before {
            values: host(&self.net.value().forward(&all))?,
            means: if means { host(&self.net.policy().forward(&seen))? } else { Vec::new() },
        })
    }

    fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError> {
        let mut laps = Laps::new();
        let observations = self.seen(minibatch);
        let seen = policy_sees(&self.net, &observations);
        let (means, policy_tape) = self.net.policy().forward_with_tape(&seen);
        let (values, value_tape) = self.net.value().forward_with_tape(&observations);
        let raw = self.place.raw_log_std as i64;
        let (actions, wide) = (self.place.act_dim as i64, self.place.act_dim as i64 + 1);
        let raw_log_std = |net: &ActorCritic| net.flat().narrow(0, raw, actions);
        let outputs = Tensor::cat(&[means, values], 1).view([-1]);
        let outputs = host(&Tensor::cat(&[outputs, raw_log_std(&self.net)], 0))?;
        laps.lap(Part::Products);
        let (sums, back) = self.loss(samples, minibatch, outputs)?;
        laps.lap(Part::ElementWise);
        let back = Tensor::from_slice(&back).to_device(self.net.device());
        let of_outputs = back.narrow(0, 0, back.numel() as i64 - actions).view([-1, wide]);
        let (net, gradient) = (&self.net, &self.gradient);
        net.policy().backward(&policy_tape, of_outputs.narrow(1, 0, actions), gradient.policy());
        net.value().backward(&value_tape, of_outputs.narrow(1, actions, 1), gradient.value());
        raw_log_std(gradient).copy_(&back.narrow(0, back.numel() as i64 - actions, actions));
        self.settle_gradient(minibatch.value_only);
        let norm = gradient.flat().norm().double_value(&[]);
        laps.lap(Part::Products);
        Ok(Total { sums, norm })
    }

    fn step(&mut self, step: &Step) {
        let (bias1, bias2_root) = self.adam.count();
        let gradient = self.gradient.flat() * step.scale;
        let (m, v) = &mut self.moments;
        let _ = m.lerp_(&gradient, 1.0 - BETA1);
        *v *= BETA2;
        *v += gradient.square() * (1.0 - BETA2);
        let change = &*m / (v.sqrt() / bias2_root + EPSILON);
        let mut first = 0;
        for (len, rate) in step.rates {
            let part = |all: &Tensor| all.narrow(0, first, len as i64);
            let mut parameters = part(self.net.flat());
            parameters -= part(&change) * (rate / bias1);
            first += len as i64;
        }
    }

    #[cfg(test)]
    fn last_gradient(&self) -> Result<Vec<f32>, LearnerError> {
        self.gradient.to_vec()
    }

    fn state(&self) -> Result<(Vec<f32>, Adam), LearnerError> {
        let mut adam = self.adam.clone();
        let (_, _, steps) = adam.state();
        adam.restore(&host(&self.moments.0)?, &host(&self.moments.1)?, steps)?;
        Ok((self.net.to_vec()?, adam))
    }
}

struct LossJob {
    batch: Arc<Batch>,
    samples: Arc<Samples>,
    minibatch: Minibatch,
    /// `[M, A + 1]`, means and values.
    outputs: Arc<[f32]>,
    /// `[A]`.
    log_std: Arc<[f32]>,
    /// First of the minibatch's samples, and how many.
    part: (usize, usize),
}

/// Sums of the loss of one shard, its gradient with respect to outputs `[m, A + 1]` and to the log-std `[A]`.
fn shard_loss(_: &mut (), job: LossJob) -> ([f64; sums::COUNT], Vec<f32>, Vec<f32>) {
    let ((first, rows), actions) = (job.part, job.log_std.len());
    let wide = actions + 1;
    let mut loss = Loss::new(&job.minibatch, &job.log_std, &job.samples);
    let mut gradient = vec![0.0; rows * wide];
    let outputs = job.outputs[first * wide..].chunks_exact(wide);
    let order = &job.minibatch.samples()[first..first + rows];
    for ((gradient, output), &sample) in gradient.chunks_exact_mut(wide).zip(outputs).zip(order) {
        let sample = sample as usize;
        let action = &job.batch.actions[sample * actions..][..actions];
        let (of_means, of_value) = gradient.split_at_mut(actions);
        of_value[0] = loss.add(sample, action, &output[..actions], output[actions], of_means);
    }
    let log_std = loss.log_std_gradient(rows);
    (loss.sums(), gradient, log_std)
}

/// The columns that the policy sees of what the value function sees.
fn policy_sees(net: &ActorCritic, all: &Tensor) -> Tensor {
    all.narrow(1, 0, net.spec().obs_dim as i64)
}

/// All numbers of a tensor, on the host.
fn host(t: &Tensor) -> Result<Vec<f32>, LearnerError> {
    let flat = t.to_device(Device::Cpu).contiguous().view([-1]);
    Ok(Vec::try_from(&flat)?)
}
