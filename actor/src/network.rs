//! The network of a policy, computed in vector lanes: for many lanes of observations at a time.

use caudata_lanes::fold::Side;
use caudata_lanes::perceptron::{Inputs, Perceptron, Tape, normalise};
use caudata_policy::{Activation, Dense, MlpSpec};
use caudata_task::Mirror;
use caudata_task::mirror::{SignedPermutation, sides};

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
    layers: Perceptron,
    seen: Vec<f32>,
    tape: Tape,
}

impl Network {
    /// The network of `spec`, which has been checked. Where it commutes with `mirror`, that saves half of the
    /// multiplications.
    pub fn new(spec: &MlpSpec, mirror: Option<&Mirror>) -> Self {
        let mut network = Self {
            mean: Vec::new(),
            std: Vec::new(),
            clip: f32::INFINITY,
            layers: Perceptron::new(vec![Side::default()], Activation::Elu),
            seen: Vec::new(),
            tape: Tape::default(),
        };
        network.replace(spec, mirror);
        network
    }

    /// Takes up another normaliser and other weights.
    pub fn replace(&mut self, spec: &MlpSpec, mirror: Option<&Mirror>) {
        self.mean.clone_from(&spec.obs_mean);
        self.std.clone_from(&spec.obs_std);
        self.clip = spec.obs_clip.unwrap_or(f32::INFINITY);
        self.layers = Perceptron::new(folds(spec, mirror), spec.activation);
        for (at, layer) in spec.layers.iter().enumerate() {
            self.layers.pack(at, &layer.weight, &layer.bias, false);
        }
        self.seen.clear();
    }

    /// Means `[lanes, A]` of raw observations `[lanes, D]`. Arrays of other lengths are a mistake of the caller.
    pub fn run(&mut self, observations: &[f32], lanes: usize, means: &mut [f32]) {
        debug_assert_eq!(observations.len(), lanes * self.mean.len());
        let (side, output) = (self.layers.input(), self.layers.output());
        self.seen.resize(lanes * side.width(), 0.0);
        let how = (&self.mean[..], &self.std[..], self.clip);
        normalise(observations, how, side, &mut self.seen);
        let inputs = Inputs { rows: lanes, values: &self.seen, side };
        let rows = self.layers.forward(inputs, &mut self.tape, &mut |_| ());
        let rows = rows.chunks_exact(output.width().max(1));
        for (mean, row) in means.chunks_exact_mut(output.len().max(1)).zip(rows) {
            output.unfold(row, mean);
        }
    }
}

/// How rows between the layers are folded: along `mirror`, if all layers commute with it to the last bit.
fn folds(spec: &MlpSpec, mirror: Option<&Mirror>) -> Vec<Side> {
    let outputs: Vec<usize> = spec.layers.iter().map(|layer| layer.out).collect();
    let (last, hidden) = outputs.split_last().unwrap_or((&0, &[]));
    let fits = |mirror: &&Mirror| {
        (mirror.observation.len(), mirror.action.len()) == (spec.obs_mean.len(), *last)
    };
    let sides = mirror
        .filter(fits)
        .map(|mirror| sides(&mirror.observation, hidden, &mirror.action))
        .filter(|sides| {
            let mut layers = spec.layers.iter().zip(sides.windows(2));
            layers.all(|(layer, pair)| commutes(layer, &pair[0], &pair[1]))
        });
    match sides {
        Some(sides) => sides.iter().map(|side| Side::new(&side.source, &side.sign)).collect(),
        None => [spec.obs_mean.len()]
            .into_iter()
            .chain(outputs.iter().copied())
            .map(Side::plain)
            .collect(),
    }
}

/// Whether mirroring the layer's inputs mirrors its outputs.
fn commutes(layer: &Dense, input: &SignedPermutation, output: &SignedPermutation) -> bool {
    let row = |o: usize| &layer.weight[o * layer.input..][..layer.input];
    output.source.iter().zip(&output.sign).enumerate().all(|(o, (&from, sign))| {
        let image = row(from);
        let mut pairs = row(o).iter().zip(input.source.iter().zip(&input.sign));
        layer.bias[o] == sign * layer.bias[from]
            && pairs.all(|(w, (&i, input_sign))| *w == sign * input_sign * image[i])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_model::RobotModel;
    use caudata_policy::{Inference, PolicyFile, PolicyMetadata, build_onnx};
    use caudata_task::{PolicyContract, TaskConfig};

    fn numbers(count: usize, scale: f32) -> Vec<f32> {
        (0..count).map(|i| scale * (0.37 * i as f32 + 1.0).sin()).collect()
    }

    /// The mean of a layer and its mirror image.
    fn commuting(layer: &Dense, input: &SignedPermutation, output: &SignedPermutation) -> Dense {
        let mut mean = layer.clone();
        for (o, (&from, sign)) in output.source.iter().zip(&output.sign).enumerate() {
            mean.bias[o] = 0.5 * (layer.bias[o] + sign * layer.bias[from]);
            for (i, (&at, own)) in input.source.iter().zip(&input.sign).enumerate() {
                let image = sign * own * layer.weight[from * layer.input + at];
                let weight = &mut mean.weight[o * layer.input + i];
                *weight = 0.5 * (*weight + image);
            }
        }
        mean
    }

    #[test]
    fn the_network_answers_as_onnx_runtime_does() {
        let robot = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
        let model = RobotModel::load(robot.as_ref()).unwrap();
        let contract = PolicyContract::new(&model, &TaskConfig::default()).unwrap();
        let sizes = [contract.obs_dim(), 50, 33, contract.act_dim()];
        let mirror = Mirror::new(&model, &contract.observation).unwrap();
        let mirrored = sides(&mirror.observation, &sizes[1..3], &mirror.action);
        let mut kept: Option<Network> = None;
        let both = Activation::ALL.into_iter().flat_map(|a| [(a, false), (a, true)]);
        for (activation, symmetric) in both {
            let dense = |pair: &[usize]| Dense {
                input: pair[0],
                out: pair[1],
                weight: numbers(pair[0] * pair[1], 0.3),
                bias: numbers(pair[1], 0.1),
            };
            let mut layers: Vec<Dense> = sizes.windows(2).map(dense).collect();
            if symmetric {
                let layers = layers.iter_mut().zip(mirrored.windows(2));
                layers.for_each(|(layer, pair)| *layer = commuting(layer, &pair[0], &pair[1]));
            }
            let spec = MlpSpec {
                obs_mean: numbers(sizes[0], 0.5),
                obs_std: numbers(sizes[0], 0.5).iter().map(|x| 1.0 + x).collect(),
                obs_clip: Some(2.0),
                layers,
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
            let (mut own, mut runtime) =
                (vec![f32::NAN; lanes * sizes[3]], vec![0.0; lanes * sizes[3]]);
            // The room of another policy is as good as fresh.
            let network = kept.get_or_insert_with(|| Network::new(file.spec(), None));
            network.replace(file.spec(), Some(&mirror));
            // Folded where it commutes with the mirror, and only there.
            assert_eq!(network.layers.output().counts()[1] > 0, symmetric);
            network.run(&seen, lanes, &mut own);
            Inference::new(&file, 1).unwrap().run(&seen, lanes, &mut runtime).unwrap();
            let off = own.iter().zip(&runtime).map(|(a, b)| (a - b).abs());
            let off = off.fold(0.0, f32::max);
            assert!(off < 2e-5, "{activation:?}, symmetric {symmetric}: {off}");
        }
    }
}
