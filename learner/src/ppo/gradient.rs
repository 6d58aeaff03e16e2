//! Where the networks of an update are computed: in this project's vector lanes on the
//! CPU's cores ([`super::host`]), or by libtorch on another device ([`super::torch`]).

use super::host::Host;
use super::networks::Networks;
use super::torch::Torch;
use crate::LearnerError;
use crate::network::ActorCritic;

/// Networks of the shape of `net`, on its device, with `threads` threads for what is done on the host.
///
/// # Errors
/// When the operating system refuses a thread.
pub fn on_its_device(net: &ActorCritic, threads: usize) -> Result<Box<dyn Networks>, LearnerError> {
    Ok(match net.device() {
        tch::Device::Cpu => Box::new(Host::new(net, threads)?),
        _ => Box::new(Torch::new(net, threads)?),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::adam::Adam;
    use crate::batch::Batch;
    use crate::network::NetworkSpec;
    use crate::normaliser::Scaling;
    use crate::ppo::loss::log_probs;
    use crate::ppo::minibatch::{LossSettings, Minibatch, Samples, Step};
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

    /// Those that libtorch has here.
    fn devices() -> Vec<Device> {
        let cuda = Device::cuda_if_available();
        if !cuda.is_cuda() {
            eprintln!("skipped on a GPU: libtorch finds no CUDA here");
            return vec![Device::Cpu];
        }
        vec![Device::Cpu, cuda]
    }

    /// libtorch's operations, whose gradients are compared with autograd elsewhere, against the lanes.
    #[test]
    fn lanes_and_libtorch_agree() {
        let devices = devices();
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
            let mut all: Vec<Box<dyn Networks>> = vec![Box::new(Host::new(&net, 2).unwrap())];
            for &device in &devices {
                let net = ActorCritic::new(net.spec().clone(), 1, device);
                all.push(Box::new(Torch::new(&net, 2).unwrap()));
            }
            let log_std = net.place().log_std_of(&parameters);
            let minibatch = |first, value_only| Minibatch {
                order: (0..rows).map(|i| (i * 9 % rows) as u32).collect(),
                part: (first, 600),
                loss: LossSettings { clip: 0.2, value_weight: 2.0, entropy_weight: 0.01 },
                advantage_scale: (0.1, 1.3),
                value_only,
            };
            let prox_log_std: Vec<f32> = log_std.iter().map(|x| x + 0.05).collect();
            let (shifts, advantages, targets) = (draw(rows * act_dim), draw(rows), draw(rows));
            let lessons = draw(rows * act_dim);
            let mut found = all.iter_mut().map(|networks| {
                networks.take_up(&parameters, &Adam::new(parameters.len()));
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
                let samples = Arc::new(samples);
                let total = networks.gradient(&samples, &minibatch(50, false)).unwrap();
                let gradient = networks.last_gradient().unwrap();
                let policy = net.policy_len();
                let step =
                    Step { scale: 0.5, rates: [(policy, 1e-3), (gradient.len() - policy, 2e-3)] };
                networks.step(&step);
                networks.gradient(&samples, &minibatch(0, true)).unwrap();
                networks.step(&step);
                (before, total, gradient, networks.state().unwrap())
            });
            let (host, of_host, gradient, (moved, adam)) = found.next().unwrap();
            for ((torch, of_torch, its_gradient, its_state), device) in found.zip(&devices) {
                let folded = net.spec().mirror.is_some();
                let of =
                    |what: &str| format!("{device:?}, {activation:?}, folded {folded}: {what}");
                near(&host.values, &torch.values, 1e-5, &of("values"));
                near(&host.means, &torch.means, 1e-5, &of("means"));
                near(&gradient, &its_gradient, 2e-5, &of("gradient"));
                near(&[of_host.norm as f32], &[of_torch.norm as f32], 1e-5, &of("norm"));
                near(&moved, &its_state.0, 1e-4, &of("parameters after two steps"));
                let (own, its) = (adam.state(), its_state.1.state());
                near(&own.0, &its.0, 2e-5, &of("first moment"));
                near(&own.1, &its.1, 2e-5, &of("second moment"));
                assert_eq!(own.2, its.2);
                for (found, expected) in of_host.sums.iter().zip(of_torch.sums) {
                    let off = (found - expected).abs();
                    assert!(off < 1e-4 * expected.abs().max(1.0), "{}", of("sums"));
                }
            }
        }
    }
}
