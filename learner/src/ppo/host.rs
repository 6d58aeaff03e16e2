//! The networks in vector lanes on the CPU: a batch cut into shards, which the threads of this process work on.
//!
//! A batch is cut by a rule that knows nothing of threads, and gradients are added in the order of the shards: *the
//! bits of an update do not depend on the number of threads.* Nor on the lanes, of those that have fused
//! multiply-add.

use std::sync::Arc;

use caudata_lanes::perceptron::{Inputs, Perceptron, Tape, Work, normalise};
use caudata_task::mirror::SignedPermutation;
use caudata_telemetry::spans::{Laps, Part};

use super::loss::Loss;
use super::minibatch::{Before, Minibatch, Samples, Step, Total, sums};
use super::networks::Networks;
use super::pool::{Pool, SHARD_ROWS, shards};
use crate::LearnerError;
use crate::adam::Adam;
use crate::batch::Batch;
use crate::network::{ActorCritic, Place};
use crate::normaliser::Scaling;

/// Observations that are normalised and evaluated in one piece before an update.
const BLOCK_ROWS: usize = 256;

/// The networks, a batch that is being learnt from, and the threads.
#[derive(Debug)]
pub struct Host {
    nets: Arc<Nets>,
    /// `[P]`.
    parameters: Vec<f32>,
    /// That of the last minibatch, `[P]`.
    gradient: Vec<f32>,
    adam: Adam,
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
    /// How the mirror exchanges actions.
    actions: SignedPermutation,
}

/// A batch with its normalised observations, folded, in blocks of [`BLOCK_ROWS`] rows.
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
        let spec = net.spec();
        let activation = spec.activation;
        let actions = spec.mirror.as_ref().map(|mirror| mirror.action.clone());
        let [policy, value] = spec.folds();
        Ok(Self {
            nets: Arc::new(Nets {
                policy: Perceptron::new(policy, activation),
                value: Perceptron::new(value, activation),
                place,
                actions: actions.unwrap_or_else(|| SignedPermutation::identity(spec.act_dim)),
            }),
            parameters: Vec::new(),
            gradient: Vec::new(),
            adam: Adam::new(net.layout().len()),
            pool: Pool::new(threads)?,
            seen: Arc::default(),
            spare: Vec::new(),
        })
    }

    /// The networks are those of the parameters from here on.
    fn pack(&mut self) {
        let nets = Arc::make_mut(&mut self.nets);
        let place = Arc::clone(&nets.place);
        for (net, layers) in [(&mut nets.policy, &place.policy), (&mut nets.value, &place.value)] {
            for (at, layer) in layers.iter().enumerate() {
                net.pack(
                    at,
                    &self.parameters[layer.weight..][..layer.inputs * layer.outputs],
                    &self.parameters[layer.bias..][..layer.outputs],
                    true,
                );
            }
        }
    }
}

impl Networks for Host {
    fn take_up(&mut self, parameters: &[f32], adam: &Adam) {
        self.parameters = parameters.to_vec();
        self.adam = adam.clone();
        self.pack();
    }

    fn begin(
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
        self.seen = Arc::new(Seen { batch: Arc::clone(batch), blocks });
        Ok(before)
    }

    fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError> {
        let parts = shards(minibatch.part.1, SHARD_ROWS);
        let place = &self.nets.place;
        let raw = &self.parameters[place.raw_log_std..][..place.act_dim];
        let (log_std, slope) = place.log_std_and_slope(raw);
        let log_std: [Arc<[f32]>; 2] = [log_std.into(), slope.into()];
        let jobs = parts.into_iter().map(|part| GradientJob {
            nets: Arc::clone(&self.nets),
            seen: Arc::clone(&self.seen),
            samples: Arc::clone(samples),
            minibatch: minibatch.clone(),
            log_std: log_std.clone(),
            part,
            gradient: self.spare.pop().unwrap_or_default(),
        });
        let jobs = jobs.collect();
        let done = self.pool.map(jobs, shard_gradient)?;
        let mut laps = Laps::new();
        let mut done = done.into_iter();
        let (mut totals, mut folded) = (done.next())
            .unwrap_or_else(|| ([0.0; sums::COUNT], vec![0.0; self.nets.gradient_len()]));
        for (sums, gradient) in done {
            totals.iter_mut().zip(sums).for_each(|(total, sum)| *total += sum);
            folded.iter_mut().zip(&gradient).for_each(|(total, g)| *total += g);
            self.spare.push(gradient);
        }
        self.gradient = self.nets.unfolded(&folded);
        self.spare.push(folded);
        if minibatch.value_only {
            self.gradient[..self.nets.place.policy_len].fill(0.0);
        }
        let norm = norm(&self.gradient);
        laps.lap(Part::Optimiser);
        Ok(Total { sums: totals, norm })
    }

    fn step(&mut self, step: &Step) {
        self.adam.step(&mut self.parameters, (&self.gradient, step.scale), &step.rates);
        self.pack();
    }

    #[cfg(test)]
    fn last_gradient(&self) -> Result<Vec<f32>, LearnerError> {
        Ok(self.gradient.clone())
    }

    fn state(&self) -> Result<(Vec<f32>, Adam), LearnerError> {
        Ok((self.parameters.clone(), self.adam.clone()))
    }
}

impl Nets {
    /// Length of a shard's gradient: the policy's, the value function's, that of the log-std.
    fn gradient_len(&self) -> usize {
        self.policy.gradient_len() + self.value.gradient_len() + self.actions.len()
    }

    /// The gradient of all parameters, `[P]`, from that of the folded networks. What the mirror ties gets the mean
    /// of its gradients.
    fn unfolded(&self, folded: &[f32]) -> Vec<f32> {
        let mut gradient = vec![0.0; self.place.len];
        let (policy, rest) = folded.split_at(self.policy.gradient_len());
        let (value, log_std) = rest.split_at(self.value.gradient_len());
        for (net, folded, layers) in
            [(&self.policy, policy, &self.place.policy), (&self.value, value, &self.place.value)]
        {
            for (at, layer) in layers.iter().enumerate() {
                // A layer's biases lie behind its weights.
                let (before, bias) = gradient.split_at_mut(layer.bias);
                let weight = &mut before[layer.weight..][..layer.inputs * layer.outputs];
                net.unfold_gradient(at, folded, weight, &mut bias[..layer.outputs]);
            }
        }
        let raw = &mut gradient[self.place.raw_log_std..];
        for (i, (raw, &other)) in raw.iter_mut().zip(&self.actions.source).enumerate() {
            *raw = 0.5 * (log_std[i] + log_std[other]);
        }
        gradient
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
    let (policy, value) = (&job.nets.policy, &job.nets.value);
    let side = value.input();
    let mut seen = vec![0.0; rows * side.width()];
    let scaling = &job.scaling;
    let how = (&scaling.mean[..], &scaling.std[..], scaling.clip);
    normalise(raw, how, side, &mut seen);
    let inputs = |rows| Inputs { rows, values: &seen, side };
    let idle = &mut |_| ();
    let values = value.forward(inputs(rows), &mut room.value, idle);
    let values = values.iter().step_by(value.output().width());
    let values = values.copied().collect();
    let acted = batch.rows.saturating_sub(first).min(rows);
    let means = match job.means {
        false => Vec::new(),
        true => {
            let (side, width) = (policy.output(), batch.act_dim);
            let folded = policy.forward(inputs(acted), &mut room.policy, idle);
            let mut means = vec![0.0; acted * width];
            let rows = means.chunks_exact_mut(width);
            for (means, folded) in rows.zip(folded.chunks_exact(side.width())) {
                side.unfold(folded, means);
            }
            means
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
    /// The log-std now, and its slope with respect to its parameters, `[A]`.
    log_std: [Arc<[f32]>; 2],
    /// First of the minibatch's samples, and how many.
    part: (usize, usize),
    /// Memory for the gradient.
    gradient: Vec<f32>,
}

/// Forward and backward of one shard: sums of the loss, and the gradient of the folded networks.
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
    let order = &job.minibatch.samples()[first..first + rows];
    let side = nets.value.input();
    let width = side.width();
    let x = &mut room.observations;
    x.clear();
    for &sample in order {
        let (block, row) = (sample as usize / BLOCK_ROWS, sample as usize % BLOCK_ROWS);
        x.extend_from_slice(&job.seen.blocks[block][row * width..][..width]);
    }
    done(Work::ElementWise);
    let inputs = Inputs { rows, values: x, side };
    nets.policy.forward(inputs, &mut room.policy, &mut done);
    let values = nets.value.forward(inputs, &mut room.value, &mut done);
    let wide = nets.value.output().width();
    let mut values: Vec<f32> = values.iter().step_by(wide).copied().collect();

    let [log_std, slope] = &job.log_std;
    let mut loss = Loss::new(&job.minibatch, log_std, &job.samples);
    let side = nets.policy.output();
    room.policy.fill_gradients(side, |at, mean, gradient| {
        let sample = order[at] as usize;
        let action = &batch.actions[sample * batch.act_dim..][..batch.act_dim];
        // From here on the gradient with respect to the value.
        values[at] = loss.add(sample, action, mean, values[at], gradient);
    });
    let side = nets.value.output();
    room.value.fill_gradients(side, |at, _, gradient| gradient[0] = values[at]);
    done(Work::ElementWise);

    let mut gradient = job.gradient;
    gradient.resize(nets.gradient_len(), 0.0);
    let (policy, rest) = gradient.split_at_mut(nets.policy.gradient_len());
    let (value, raw) = rest.split_at_mut(nets.value.gradient_len());
    nets.policy.backward(inputs, &mut room.policy, policy, &mut done);
    nets.value.backward(inputs, &mut room.value, value, &mut done);
    let log_std = loss.log_std_gradient(rows);
    let slopes = log_std.iter().zip(&**slope);
    for (raw, (gradient, slope)) in raw.iter_mut().zip(slopes) {
        *raw = gradient * slope;
    }
    done(Work::ElementWise);
    (loss.sums(), gradient)
}

/// Euclidean norm, in f64; sums side by side, since one after the other would wait for each addition.
fn norm(values: &[f32]) -> f64 {
    let mut sums = [0.0_f64; 8];
    for part in values.chunks(sums.len()) {
        for (sum, value) in sums.iter_mut().zip(part) {
            *sum += f64::from(*value).powi(2);
        }
    }
    sums.iter().sum::<f64>().sqrt()
}
