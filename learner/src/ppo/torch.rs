//! The networks on a device of libtorch, a minibatch at a time: a GPU works on it whole.

use std::sync::Arc;

use caudata_telemetry::spans::{Laps, Part};
use tch::Tensor;

use super::loss::{Outputs, Samples as OnDevice, loss_and_gradient, sums};
use super::minibatch::{Before, Minibatch, Samples, Total};
use crate::LearnerError;
use crate::batch::Batch;
use crate::network::ActorCritic;
use crate::normaliser::Scaling;

/// The networks, room for their gradient, and the batch that is being learnt from.
#[derive(Debug)]
pub struct Torch {
    net: ActorCritic,
    gradient: ActorCritic,
    batch: Option<OnTheDevice>,
}

#[derive(Debug)]
struct OnTheDevice {
    /// Normalised, `[B, D]`.
    observations: Tensor,
    /// `[B, A]`.
    actions: Tensor,
    /// What the whole batch is learnt with, and its source.
    samples: Option<(Arc<Samples>, OnDevice)>,
}

impl Torch {
    /// Networks of the shape of `net`, on its device.
    pub fn new(net: &ActorCritic) -> Self {
        Self { net: net.zeros_like(), gradient: net.zeros_like(), batch: None }
    }

    /// As [`super::gradient::Networks::set`].
    pub fn set(&mut self, parameters: &[f32]) {
        let mut flat = self.net.flat().shallow_clone();
        flat.copy_(&Tensor::from_slice(parameters));
    }

    /// As [`super::gradient::Networks::begin`].
    pub fn begin(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        means: bool,
    ) -> Result<Before, LearnerError> {
        let (device, wide) = (self.net.device(), batch.obs_dim as i64);
        let raw = Tensor::from_slice(&batch.observations).view([-1, wide]);
        let all = scaling.apply(&raw.to_device(device));
        let observations = all.narrow(0, 0, batch.rows as i64);
        let before = Before {
            values: host(&self.net.value().forward(&all))?,
            means: match means {
                true => host(&self.net.policy().forward(&policy_sees(&self.net, &observations)))?,
                false => Vec::new(),
            },
        };
        let actions = Tensor::from_slice(&batch.actions).view([-1, batch.act_dim as i64]);
        self.batch =
            Some(OnTheDevice { observations, actions: actions.to_device(device), samples: None });
        Ok(before)
    }

    /// As [`super::gradient::Networks::gradient`].
    pub fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError> {
        let Some(batch) = &mut self.batch else {
            return Err(LearnerError::setting("no batch has been taken up"));
        };
        let mut laps = Laps::new();
        let device = self.net.device();
        if batch.samples.as_ref().is_none_or(|(from, ..)| !Arc::ptr_eq(from, samples)) {
            let put = |values: &[f32], width: i64| {
                Tensor::from_slice(values).view([-1, width]).to_device(device)
            };
            let wide = samples.prox_log_std.len() as i64;
            let all = OnDevice {
                actions: batch.actions.shallow_clone(),
                prox_means: put(&samples.prox_means, wide),
                prox_log_probs: put(&samples.prox_log_probs, 1),
                advantages: put(&samples.advantages, 1),
                targets: put(&samples.targets, 1),
                weights: put(&samples.weights, 1),
                teacher: (samples.teacher.as_ref())
                    .map(|(actions, weight)| (put(actions, wide), f64::from(*weight))),
            };
            batch.samples = Some((Arc::clone(samples), all));
        }
        let Some((_, all)) = &batch.samples else {
            return Err(LearnerError::setting("no samples have been taken up"));
        };
        let order: Vec<i64> = minibatch.samples.iter().map(|&i| i64::from(i)).collect();
        let order = Tensor::from_slice(&order).to_device(device);
        let pick = |t: &Tensor| t.index_select(0, &order);
        let (shift, scale) = minibatch.advantage_scale;
        let picked = OnDevice {
            actions: pick(&all.actions),
            prox_means: pick(&all.prox_means),
            prox_log_probs: pick(&all.prox_log_probs),
            advantages: (pick(&all.advantages) - f64::from(shift)) / f64::from(scale),
            targets: pick(&all.targets),
            weights: pick(&all.weights),
            teacher: all.teacher.as_ref().map(|(actions, weight)| (pick(actions), *weight)),
        };
        let observations = pick(&batch.observations);
        laps.lap(Part::ElementWise);
        let seen = policy_sees(&self.net, &observations);
        let (net, gradient) = (&self.net, &self.gradient);
        let (means, policy_tape) = net.policy().forward_with_tape(&seen);
        let (values, value_tape) = net.value().forward_with_tape(&observations);
        laps.lap(Part::Products);
        let (sums, output_gradient) = loss_and_gradient(
            &minibatch.loss,
            minibatch.samples.len(),
            &Outputs { means, values },
            &Tensor::from_slice(&minibatch.log_std).to_device(device),
            &Tensor::from_slice(&samples.prox_log_std).to_device(device),
            &picked,
        );
        laps.lap(Part::ElementWise);
        net.policy().backward(&policy_tape, output_gradient.means, gradient.policy());
        net.value().backward(&value_tape, output_gradient.values, gradient.value());
        net.log_std_backward(&output_gradient.log_std, gradient);
        let mut total = [0.0; sums::COUNT];
        for (total, sum) in total.iter_mut().zip(host(&sums)?) {
            *total = f64::from(sum);
        }
        let gradient = self.net.symmetric_gradient(gradient.to_vec()?);
        laps.lap(Part::Products);
        Ok(Total { sums: total, gradient })
    }
}

/// The columns that the policy sees of what the value function sees.
fn policy_sees(net: &ActorCritic, all: &Tensor) -> Tensor {
    all.narrow(1, 0, net.spec().obs_dim as i64)
}

/// All numbers of a tensor, on the host.
fn host(t: &Tensor) -> Result<Vec<f32>, LearnerError> {
    let flat = t.to_device(tch::Device::Cpu).contiguous().view([-1]);
    Ok(Vec::try_from(&flat)?)
}
