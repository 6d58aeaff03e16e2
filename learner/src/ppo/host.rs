//! The networks in vector lanes on the CPU: a batch cut into shards, which the threads of this process work on.
//!
//! A batch is cut by a rule that knows nothing of threads, and gradients are added in the order of the shards: *the
//! bits of an update do not depend on the number of threads.* Nor on the lanes, of those that have fused
//! multiply-add.

use std::sync::Arc;

use caudata_lanes::dense::padded;
use caudata_lanes::perceptron::{Perceptron, Tape, Work, normalise};
use caudata_telemetry::spans::{Laps, Part};

use super::loss::sums;
use super::minibatch::{Before, Minibatch, Samples, Total};
use super::pool::{Pool, SHARD_ROWS, shards};
use super::row_loss::Loss;
use crate::LearnerError;
use crate::batch::Batch;
use crate::network::{ActorCritic, Place};
use crate::normaliser::Scaling;

/// Observations that are normalised and evaluated in one piece before an update.
const BLOCK_ROWS: usize = 256;

/// The networks, a batch that is being learnt from, and the threads.
#[derive(Debug)]
pub struct Host {
    nets: Arc<Nets>,
    pool: Pool<Room>,
    seen: Arc<Seen>,
    /// Gradients of shards, for the next minibatch.
    spare: Vec<Vec<f32>>,
}

/// Both networks, and where their parameters lie.
#[derive(Clone, Debug)]
struct Nets {
    policy: Perceptron,
    value: Perceptron,
    place: Arc<Place>,
}

/// A batch with its normalised observations, in blocks of [`BLOCK_ROWS`] rows.
#[derive(Debug, Default)]
struct Seen {
    batch: Arc<Batch>,
    blocks: Vec<Vec<f32>>,
}

/// What a thread works with.
#[derive(Debug, Default)]
struct Room {
    observations: Vec<f32>,
    policy: Tape,
    value: Tape,
}

impl Host {
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        let place = Arc::new(net.place());
        let activation = crate::export::in_lanes(net.spec().activation);
        Ok(Self {
            nets: Arc::new(Nets {
                policy: Perceptron::new(place.policy.len(), activation),
                value: Perceptron::new(place.value.len(), activation),
                place,
            }),
            pool: Pool::new(threads)?,
            seen: Arc::default(),
            spare: Vec::new(),
        })
    }

    /// As [`super::gradient::Networks::set`].
    pub fn set(&mut self, parameters: &[f32]) {
        let nets = Arc::make_mut(&mut self.nets);
        let place = Arc::clone(&nets.place);
        for (net, layers) in [
            (&mut nets.policy, &place.policy),
            (&mut nets.value, &place.value),
        ] {
            for (dense, layer) in net.layers_mut().iter_mut().zip(layers) {
                dense.pack(
                    &parameters[layer.weight..][..layer.inputs * layer.outputs],
                    &parameters[layer.bias..][..layer.outputs],
                    true,
                );
            }
        }
    }

    /// As [`super::gradient::Networks::begin`].
    pub fn begin(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        means: bool,
    ) -> Result<Before, LearnerError> {
        let rows = batch.observations.len() / batch.obs_dim;
        let scaling = Arc::new(scaling.clone());
        let jobs = (0..rows).step_by(BLOCK_ROWS).map(|first| BlockJob {
            nets: Arc::clone(&self.nets),
            batch: Arc::clone(batch),
            scaling: Arc::clone(&scaling),
            rows: (first, BLOCK_ROWS.min(rows - first)),
            means,
        });
        let done = self.pool.map(jobs.collect(), look_at_block)?;
        let mut before = Before {
            values: Vec::with_capacity(rows),
            means: Vec::with_capacity(batch.actions.len()),
        };
        let mut blocks = Vec::with_capacity(done.len());
        for (block, values, means) in done {
            blocks.push(block);
            before.values.extend(values);
            before.means.extend(means);
        }
        self.seen = Arc::new(Seen {
            batch: Arc::clone(batch),
            blocks,
        });
        Ok(before)
    }

    /// As [`super::gradient::Networks::gradient`].
    pub fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError> {
        let parts = shards(minibatch.samples.len(), SHARD_ROWS);
        let jobs = parts.into_iter().map(|part| GradientJob {
            nets: Arc::clone(&self.nets),
            seen: Arc::clone(&self.seen),
            samples: Arc::clone(samples),
            minibatch: minibatch.clone(),
            part,
            gradient: self.spare.pop().unwrap_or_default(),
        });
        let jobs = jobs.collect();
        let done = self.pool.map(jobs, shard_gradient)?;
        let mut laps = Laps::new();
        let mut done = done.into_iter();
        let mut total = match done.next() {
            Some((sums, gradient)) => Total { sums, gradient },
            None => Total {
                sums: [0.0; sums::COUNT],
                gradient: vec![0.0; self.nets.place.len],
            },
        };
        for (sums, gradient) in done {
            for (total, sum) in total.sums.iter_mut().zip(sums) {
                *total += sum;
            }
            for (total, g) in total.gradient.iter_mut().zip(&gradient) {
                *total += g;
            }
            self.spare.push(gradient);
        }
        laps.lap(Part::Optimiser);
        Ok(total)
    }
}

struct BlockJob {
    nets: Arc<Nets>,
    batch: Arc<Batch>,
    scaling: Arc<Scaling>,
    /// First row and number of rows.
    rows: (usize, usize),
    /// Whether the means are wanted.
    means: bool,
}

/// Normalised observations of a block, their values, and the means of those that were acted on.
fn look_at_block(room: &mut Room, job: BlockJob) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let mut laps = Laps::new();
    let (batch, (first, rows)) = (&job.batch, job.rows);
    let raw = &batch.observations[first * batch.obs_dim..][..rows * batch.obs_dim];
    let mut seen = vec![0.0; rows * padded(batch.obs_dim)];
    let scaling = &job.scaling;
    normalise(raw, &scaling.mean, &scaling.std, scaling.clip, &mut seen);
    let idle = &mut |_| ();
    let values = job.nets.value.forward(&seen, rows, &mut room.value, idle);
    let values = values.iter().step_by(padded(1)).copied().collect();
    let acted = batch.rows.saturating_sub(first).min(rows);
    let means = match job.means {
        false => Vec::new(),
        true => {
            let means = job
                .nets
                .policy
                .forward(&seen, acted, &mut room.policy, idle);
            let rows = means.chunks_exact(padded(batch.act_dim));
            rows.flat_map(|row| &row[..batch.act_dim])
                .copied()
                .collect()
        }
    };
    laps.lap(Part::Returns);
    (seen, values, means)
}

struct GradientJob {
    nets: Arc<Nets>,
    seen: Arc<Seen>,
    samples: Arc<Samples>,
    minibatch: Minibatch,
    /// First of the minibatch's samples, and how many.
    part: (usize, usize),
    /// Memory for the gradient.
    gradient: Vec<f32>,
}

/// Forward and backward of one shard: sums of the loss and gradient `[P]`.
fn shard_gradient(room: &mut Room, job: GradientJob) -> ([f64; sums::COUNT], Vec<f32>) {
    let mut laps = Laps::new();
    let mut done = |work| {
        laps.lap(match work {
            Work::Product => Part::Products,
            Work::ElementWise => Part::ElementWise,
        });
    };
    let (nets, batch) = (&*job.nets, &*job.seen.batch);
    let (first, rows) = job.part;
    let order = &job.minibatch.samples[first..first + rows];
    let width = padded(batch.obs_dim);
    let x = &mut room.observations;
    x.clear();
    for &sample in order {
        let (block, row) = (sample as usize / BLOCK_ROWS, sample as usize % BLOCK_ROWS);
        x.extend_from_slice(&job.seen.blocks[block][row * width..][..width]);
    }
    done(Work::ElementWise);
    nets.policy.forward(x, rows, &mut room.policy, &mut done);
    nets.value.forward(x, rows, &mut room.value, &mut done);

    let mut loss = Loss::new(&job.minibatch, &job.samples);
    let means = room.policy.outputs_and_gradients(padded(batch.act_dim));
    let values = room.value.outputs_and_gradients(padded(1));
    let outputs = means.zip(values);
    for (&sample, ((mean, mean_gradient), (value, value_gradient))) in order.iter().zip(outputs) {
        let action = &batch.actions[sample as usize * batch.act_dim..][..batch.act_dim];
        value_gradient[0] = loss.add(sample as usize, action, mean, value[0], mean_gradient);
    }
    done(Work::ElementWise);

    let mut gradient = job.gradient;
    gradient.resize(nets.place.len, 0.0);
    for (net, layers, tape) in [
        (&nets.policy, &nets.place.policy, &mut room.policy),
        (&nets.value, &nets.place.value, &mut room.value),
    ] {
        let mut take = |at: usize, weight: &[f32], bias: &[f32]| {
            let layer = &layers[at];
            let rows = weight.chunks_exact(padded(layer.inputs));
            let to = &mut gradient[layer.weight..][..layer.inputs * layer.outputs];
            for (to, row) in to.chunks_exact_mut(layer.inputs).zip(rows) {
                to.copy_from_slice(&row[..layer.inputs]);
            }
            gradient[layer.bias..][..layer.outputs].copy_from_slice(bias);
        };
        net.backward(x, rows, tape, &mut take, &mut done);
    }
    let log_std = loss.log_std_gradient(rows);
    let raw = &mut gradient[nets.place.raw_log_std..][..log_std.len()];
    for (raw, (gradient, slope)) in raw
        .iter_mut()
        .zip(log_std.iter().zip(&*job.minibatch.log_std_slope))
    {
        *raw = gradient * slope;
    }
    done(Work::ElementWise);
    (loss.sums(), gradient)
}
