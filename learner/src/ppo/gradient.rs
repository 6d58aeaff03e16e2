//! Where the networks of an update are computed: in this project's vector lanes on the
//! CPU's cores ([`super::host`]), or by libtorch on another device ([`super::torch`]).

use std::sync::Arc;

use super::host::Host;
use super::minibatch::{Before, Minibatch, Samples, Total};
use super::torch::Torch;
use crate::LearnerError;
use crate::batch::Batch;
use crate::network::ActorCritic;
use crate::normaliser::Scaling;

/// Where the networks are computed.
#[derive(Debug)]
pub enum Networks {
    /// In vector lanes, on threads of this process.
    Host(Box<Host>),
    /// By libtorch, a minibatch at a time.
    Torch(Box<Torch>),
}

impl Networks {
    /// Networks of the shape of `net`, on its device.
    ///
    /// # Errors
    /// When the operating system refuses a thread.
    pub fn new(net: &ActorCritic, threads: usize) -> Result<Self, LearnerError> {
        Ok(match net.device() {
            tch::Device::Cpu => Self::Host(Box::new(Host::new(net, threads)?)),
            _ => Self::Torch(Box::new(Torch::new(net))),
        })
    }

    /// Takes up `parameters` `[P]`.
    pub fn set(&mut self, parameters: &[f32]) {
        match self {
            Self::Host(host) => host.set(parameters),
            Self::Torch(torch) => torch.set(parameters),
        }
    }

    /// Takes up a batch, seen through `scaling`, and says what the networks make of it: `means` of the actions
    /// only if asked for.
    ///
    /// # Errors
    /// When a thread has died, or the device does not answer.
    pub fn begin(
        &mut self,
        batch: &Arc<Batch>,
        scaling: &Scaling,
        means: bool,
    ) -> Result<Before, LearnerError> {
        match self {
            Self::Host(host) => host.begin(batch, scaling, means),
            Self::Torch(torch) => torch.begin(batch, scaling, means),
        }
    }

    /// Sums and gradient of a minibatch of the batch.
    ///
    /// # Errors
    /// As [`Networks::begin`].
    pub fn gradient(
        &mut self,
        samples: &Arc<Samples>,
        minibatch: &Minibatch,
    ) -> Result<Total, LearnerError> {
        match self {
            Self::Host(host) => host.gradient(samples, minibatch),
            Self::Torch(torch) => torch.gradient(samples, minibatch),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::NetworkSpec;
    use crate::ppo::loss::LossSettings;
    use crate::ppo::row_loss::log_probs;
    use caudata_config::{Activation, NetworkConfig};
    use caudata_random::{Key, Purpose, Stream};
    use caudata_task::Mirror;
    use caudata_task::mirror::SignedPermutation;
    use tch::Device;

    fn near(found: &[f32], expected: &[f32], tolerance: f32, what: &str) {
        assert_eq!(found.len(), expected.len(), "{what}");
        let size = expected.iter().fold(0.0_f32, |a, x| a.max(x.abs()));
        let off = found.iter().zip(expected).map(|(f, e)| (f - e).abs());
        let off = off.fold(0.0, f32::max);
        assert!(size > 0.0 && off <= tolerance * size, "{what}: {off} of {size}");
    }

    /// With the sign of every fourth from `first` on, and of its counterpart, turned round.
    fn signed(source: Vec<usize>, first: usize) -> SignedPermutation {
        let mut mirror = SignedPermutation::identity(source.len());
        for i in (first..source.len()).step_by(4) {
            (mirror.sign[i], mirror.sign[source[i]]) = (-1.0, -1.0);
        }
        SignedPermutation { source, ..mirror }
    }

    /// libtorch's operations, whose gradients are compared with autograd elsewhere, against the lanes.
    #[test]
    fn lanes_and_libtorch_agree() {
        let (obs_dim, act_dim, rows) = (21, 5, 700);
        let mut noise = Stream::new(Key::for_run(3), Purpose::Sensor);
        let mut draw = |n: usize| (0..n).map(|_| noise.normal()).collect::<Vec<f32>>();
        let batch = Arc::new(Batch {
            obs_dim,
            act_dim,
            rows,
            observations: draw((rows + 9) * obs_dim),
            actions: draw(rows * act_dim),
            ..Batch::default()
        });
        let scaling = Scaling { mean: draw(obs_dim), std: vec![0.7; obs_dim], clip: 2.0 };
        let mirror = Mirror {
            observation: signed((0..obs_dim - 3).rev().collect(), 0),
            action: signed(vec![1, 0, 2, 3, 4], 2),
            feet: Vec::new(),
        };
        let activations = [Activation::Elu, Activation::Swish, Activation::Tanh, Activation::Relu];
        let each = activations.map(|a| [(a, None), (a, Some(mirror.clone()))]);
        for (activation, mirror) in each.into_iter().flatten() {
            let config = NetworkConfig {
                policy_hidden: vec![40, 24],
                value_hidden: vec![33],
                activation,
                ..NetworkConfig::default()
            };
            // Three of the values only the value function sees.
            let spec = NetworkSpec::new(&config, obs_dim - 3, act_dim).unwrap();
            let spec = spec.with_critic(signed(vec![1, 0, 2], 2));
            let spec = match mirror {
                Some(mirror) => spec.symmetric(mirror).unwrap(),
                None => spec,
            };
            let net = ActorCritic::new(spec, 1, Device::Cpu);
            let parameters: Vec<f32> = net.to_vec().unwrap().iter().map(|w| 1.5 * w).collect();
            let mut both = [
                Networks::Host(Box::new(Host::new(&net, 2).unwrap())),
                Networks::Torch(Box::new(Torch::new(&net))),
            ];
            let (log_std, slope) = net.log_std_of(&parameters);
            let minibatch = Minibatch {
                samples: (0..600).map(|i| (i * 7 % rows) as u32).collect(),
                loss: LossSettings { clip: 0.2, value_weight: 2.0, entropy_weight: 0.01 },
                log_std: log_std.clone().into(),
                log_std_slope: slope.into(),
                advantage_scale: (0.1, 1.3),
            };
            let prox_log_std: Vec<f32> = log_std.iter().map(|x| x + 0.05).collect();
            let (shifts, advantages, targets) = (draw(rows * act_dim), draw(rows), draw(rows));
            let lessons = draw(rows * act_dim);
            let [(host, of_host), (torch, of_torch)] = both.each_mut().map(|networks| {
                networks.set(&parameters);
                let before = networks.begin(&batch, &scaling, true).unwrap();
                let moved = before.means.iter().zip(&shifts);
                let prox_means: Vec<f32> = moved.map(|(mean, x)| mean + 0.1 * x).collect();
                let samples = Samples {
                    prox_log_probs: log_probs(&batch.actions, &prox_means, &prox_log_std),
                    prox_means,
                    prox_log_std: prox_log_std.clone(),
                    advantages: advantages.clone(),
                    targets: targets.clone(),
                    weights: vec![0.8; rows],
                    teacher: Some((lessons.clone(), 0.3)),
                };
                (before, networks.gradient(&Arc::new(samples), &minibatch).unwrap())
            });
            let folded = net.spec().mirror.is_some();
            let of = |what: &str| format!("{activation:?}, folded {folded}: {what}");
            near(&host.values, &torch.values, 1e-5, &of("values"));
            near(&host.means, &torch.means, 1e-5, &of("means"));
            near(&of_host.gradient, &of_torch.gradient, 2e-5, &of("gradient"));
            for (found, expected) in of_host.sums.iter().zip(of_torch.sums) {
                let off = (found - expected).abs();
                assert!(off < 1e-4 * expected.abs().max(1.0), "{}", of("sums"));
            }
        }
    }
}
