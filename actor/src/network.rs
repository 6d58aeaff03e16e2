//! The network of a policy, computed in vector lanes: for many lanes of observations at a time.

use caudata_lanes::dense::{Activation as InLanes, padded};
use caudata_lanes::perceptron::{Perceptron, Tape, normalise};
use caudata_policy::{Activation, MlpSpec};

/// Normaliser and network of a policy file, and room to run them. Each actor has one and keeps it: a new policy
/// replaces its weights.
///
/// What it computes is what the learner computes with, to the last bit; ONNX Runtime's answers for the same file
/// differ by rounding (`the_network_answers_as_onnx_runtime_does`).
#[derive(Debug)]
pub struct Network {
    mean: Vec<f32>,
    std: Vec<f32>,
    clip: f32,
    act_dim: usize,
    layers: Perceptron,
    seen: Vec<f32>,
    tape: Tape,
}

impl Network {
    /// The network of `spec`, which has been checked.
    #[must_use]
    pub fn new(spec: &MlpSpec) -> Self {
        let mut network = Self {
            mean: Vec::new(),
            std: Vec::new(),
            clip: f32::INFINITY,
            act_dim: 0,
            layers: Perceptron::new(0, InLanes::Elu),
            seen: Vec::new(),
            tape: Tape::default(),
        };
        network.replace(spec);
        network
    }

    /// Takes up another normaliser and other weights.
    pub fn replace(&mut self, spec: &MlpSpec) {
        self.mean.clone_from(&spec.obs_mean);
        self.std.clone_from(&spec.obs_std);
        self.clip = spec.obs_clip.unwrap_or(f32::INFINITY);
        self.act_dim = spec.act_dim();
        let activation = match spec.activation {
            Activation::Elu => InLanes::Elu,
            Activation::Swish => InLanes::Swish,
            Activation::Tanh => InLanes::Tanh,
            Activation::Relu => InLanes::Relu,
        };
        self.layers = Perceptron::new(spec.layers.len(), activation);
        for (dense, layer) in self.layers.layers_mut().iter_mut().zip(&spec.layers) {
            dense.pack(&layer.weight, &layer.bias, false);
        }
    }

    /// Means `[lanes, A]` of raw observations `[lanes, D]`. Arrays of other lengths are a mistake of the caller.
    pub fn run(&mut self, observations: &[f32], lanes: usize, means: &mut [f32]) {
        let width = self.mean.len();
        debug_assert_eq!(observations.len(), lanes * width);
        self.seen.resize(lanes * padded(width), 0.0);
        normalise(
            observations,
            &self.mean,
            &self.std,
            self.clip,
            &mut self.seen,
        );
        let (seen, tape) = (&self.seen, &mut self.tape);
        let rows = self.layers.forward(seen, lanes, tape, &mut |_| ());
        let rows = rows.chunks_exact(padded(self.act_dim).max(1));
        for (mean, row) in means.chunks_exact_mut(self.act_dim.max(1)).zip(rows) {
            mean.copy_from_slice(&row[..self.act_dim]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_model::RobotModel;
    use caudata_policy::{Dense, Inference, PolicyFile, PolicyMetadata, build_onnx};
    use caudata_task::{PolicyContract, TaskConfig};

    fn numbers(count: usize, scale: f32) -> Vec<f32> {
        (0..count)
            .map(|i| scale * (0.37 * i as f32 + 1.0).sin())
            .collect()
    }

    #[test]
    fn the_network_answers_as_onnx_runtime_does() {
        let robot = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../robots/polymander.robot.toml"
        );
        let model = RobotModel::load(robot.as_ref()).unwrap();
        let contract = PolicyContract::new(&model, &TaskConfig::default()).unwrap();
        let sizes = [contract.obs_dim(), 50, 33, contract.act_dim()];
        let mut kept: Option<Network> = None;
        for activation in Activation::ALL {
            let dense = |pair: &[usize]| Dense {
                input: pair[0],
                out: pair[1],
                weight: numbers(pair[0] * pair[1], 0.3),
                bias: numbers(pair[1], 0.1),
            };
            let spec = MlpSpec {
                obs_mean: numbers(sizes[0], 0.5),
                obs_std: numbers(sizes[0], 0.5).iter().map(|x| 1.0 + x).collect(),
                obs_clip: Some(2.0),
                layers: sizes.windows(2).map(dense).collect(),
                activation,
            };
            let metadata = PolicyMetadata {
                contract: contract.clone(),
                version: 1,
                run_id: "test".into(),
                training_commit: String::new(),
                config_hash: String::new(),
                env_steps: 0,
                seed: 0,
                log_std: vec![0.0; contract.act_dim()],
                created_unix_s: None,
                evaluation: None,
            };
            let file = PolicyFile::parse(build_onnx(&spec, &metadata).unwrap().into()).unwrap();
            let lanes = 13;
            let seen = numbers(lanes * sizes[0], 3.0);
            let (mut own, mut runtime) = (
                vec![f32::NAN; lanes * sizes[3]],
                vec![0.0; lanes * sizes[3]],
            );
            // The room of another policy is as good as fresh.
            let network = kept.get_or_insert_with(|| Network::new(file.spec()));
            network.replace(file.spec());
            network.run(&seen, lanes, &mut own);
            Inference::new(&file, 1)
                .unwrap()
                .run(&seen, lanes, &mut runtime)
                .unwrap();
            let off = own.iter().zip(&runtime).map(|(a, b)| (a - b).abs());
            let off = off.fold(0.0, f32::max);
            assert!(off < 2e-5, "{activation:?}: {off}");
        }
    }
}
