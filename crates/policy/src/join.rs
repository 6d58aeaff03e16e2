//! Two policies in one network, of which one observed value chooses.

use std::sync::Arc;

use caudata_task::PolicyContract;

use crate::mlp::{Activation, Dense, MlpSpec, activated};
use crate::onnx::build::build_onnx;
use crate::{PolicyError, PolicyFile};

/// Slope of the gates, per standard deviation of the observed value: they are open or shut from a fifth of one
/// on.
const SLOPE: f64 = 100.0;
/// How far a shut gate pushes the units behind it down: far beyond what they sum up to.
const SHUT: f64 = 40.0;

/// Fewest layers: one for the gates, one that they act on, and the actions.
const LAYERS_LEAST: usize = 3;

/// One plain perceptron that acts as `low` where entry `index` of the observation is below `at`, and as `high`
/// above. It says of itself what `low` says, but for two things: it observes what the one that observes more
/// does (the other does not look at what it has not), and is for the commands that both are for.
///
/// Both networks lie side by side. Of two more units in the first layer one is −1 below and large above, the
/// other the reverse: the ends of ELU. In the second layer they push every unit of the network that is not to
/// act down to ELU's −1, so that what it gives is a constant; one unit more takes that constant off. The
/// result is exact but for rounding, except within a fifth of a standard deviation of `at` and where a
/// normaliser cuts observations off.
///
/// # Errors
/// [`PolicyError::NotJoinable`] where the contracts differ, the layers cannot be laid side by side, `index` is
/// beyond the observation, or `at` is where a normaliser cuts off; else as [`build_onnx`].
pub fn join(
    low: &PolicyFile,
    high: &PolicyFile,
    index: usize,
    at: f32,
) -> Result<PolicyFile, PolicyError> {
    let contract = contract(low, high);
    let obs_dim = contract.obs_dim();
    if let Some(problem) = obstacle(low, high, index) {
        return Err(PolicyError::NotJoinable { problem });
    }
    let (a, b) = (&low.spec().widened(obs_dim), &high.spec().widened(obs_dim));
    // of each entry the wider normaliser, so that neither network meets a cut that it was not trained with
    let (obs_mean, obs_std): (Vec<f32>, Vec<f32>) = (0..a.obs_dim())
        .map(|i| match a.obs_std[i] > b.obs_std[i] {
            true => (a.obs_mean[i], a.obs_std[i]),
            false => (b.obs_mean[i], b.obs_std[i]),
        })
        .unzip();
    let threshold = f64::from((at - obs_mean[index]) / obs_std[index]);
    let cut = a.obs_clip.map_or(f64::INFINITY, f64::from);
    if threshold.is_nan() || threshold.abs() >= cut {
        let problem = "no observation gets past the threshold: the normalisers cut it off before";
        return Err(PolicyError::NotJoinable { problem });
    }
    let first = [a, b].map(|spec| renormalised(spec, &obs_mean, &obs_std));

    let last = a.layers.len() - 1;
    let mut layers = vec![gates(&first, index, threshold), gated(&a.layers[1], &b.layers[1])];
    layers.extend((2..last).map(|i| carried(&a.layers[i], &b.layers[i])));
    layers.push(summed(a, b));
    let spec = MlpSpec { obs_mean, obs_std, layers, ..a.clone() };
    let mut metadata = low.metadata().clone();
    metadata.contract = contract;
    metadata.env_steps = metadata.env_steps.saturating_add(high.metadata().env_steps);
    // of the one, not of both
    metadata.evaluation = None;
    PolicyFile::parse(Arc::from(build_onnx(&spec, &metadata)?))
}

/// The contract of `of`, with what may differ as it is of both: the IMU of `other` where this one is older than
/// the files that name theirs, the longer observation where it begins with the other, the narrower commands.
fn contract(of: &PolicyFile, other: &PolicyFile) -> PolicyContract {
    let (mut contract, other) = (of.metadata().contract.clone(), &other.metadata().contract);
    contract.imu = contract.imu.take().or_else(|| other.imu.clone());
    if other.observation.begins_with(&contract.observation) {
        contract.observation = other.observation.clone();
    }
    contract.afloat_above_m = contract.afloat_above_m.or(other.afloat_above_m);
    let (own, theirs) = (&mut contract.command, &other.command);
    for (own, theirs) in [
        (&mut own.vx_mps, theirs.vx_mps),
        (&mut own.vy_mps, theirs.vy_mps),
        (&mut own.yaw_rate_radps, theirs.yaw_rate_radps),
    ] {
        *own = [own[0].max(theirs[0]), own[1].min(theirs[1])];
    }
    contract
}

fn obstacle(low: &PolicyFile, high: &PolicyFile, index: usize) -> Option<&'static str> {
    let (a, b) = (low.spec(), high.spec());
    let both = contract(low, high);
    if both != contract(high, low) {
        return Some(
            "their contracts differ: robot, joints, action and clock must agree, and one observation begin with the other",
        );
    }
    let command = &both.command;
    if [command.vx_mps, command.vy_mps, command.yaw_rate_radps].iter().any(|r| r[0] > r[1]) {
        return Some("there is no command that both are for");
    }
    if a.activation != Activation::Elu || b.activation != Activation::Elu {
        return Some("both must have ELU between their layers");
    }
    if a.layers.len() != b.layers.len() || a.layers.len() < LAYERS_LEAST {
        return Some("both must have as many layers, three at least");
    }
    if a.obs_clip != b.obs_clip {
        return Some("their normalisers cut observations off at different heights");
    }
    (index >= both.obs_dim()).then_some("the value that is to choose is beyond the observation")
}

/// The first layer of `spec` for observations that another normaliser has treated.
fn renormalised(spec: &MlpSpec, mean: &[f32], std: &[f32]) -> Dense {
    let mut layer = spec.layers[0].clone();
    for (row, bias) in layer.weight.chunks_mut(layer.input).zip(&mut layer.bias) {
        let mut shift = f64::from(*bias);
        for (i, w) in row.iter_mut().enumerate() {
            let per_unit = f64::from(*w) / f64::from(spec.obs_std[i]);
            shift += per_unit * f64::from(mean[i] - spec.obs_mean[i]);
            *w = (per_unit * f64::from(std[i])) as f32;
        }
        *bias = shift as f32;
    }
    layer
}

/// Rows of a layer under way.
struct Rows {
    layer: Dense,
}

impl Rows {
    fn of(input: usize) -> Self {
        let (weight, bias) = (Vec::new(), Vec::new());
        Self { layer: Dense { out: 0, input, weight, bias } }
    }

    /// A row with these (input, weight) and zeros elsewhere.
    fn push(&mut self, weights: impl IntoIterator<Item = (usize, f64)>, bias: f64) {
        let start = self.layer.weight.len();
        self.layer.weight.resize(start + self.layer.input, 0.0);
        for (i, w) in weights {
            self.layer.weight[start + i] = w as f32;
        }
        self.layer.bias.push(bias as f32);
        self.layer.out += 1;
    }

    /// The rows of `dense`, whose inputs begin at `from`, each with one more (input, weight) and bias.
    fn push_all(&mut self, dense: &Dense, from: usize, more: Option<(usize, f64)>, bias: f64) {
        for (row, b) in dense.weight.chunks(dense.input).zip(&dense.bias) {
            let own = row.iter().enumerate().map(|(i, &w)| (from + i, f64::from(w)));
            self.push(own.chain(more), f64::from(*b) + bias);
        }
    }
}

/// First layer: both networks' own, then the gates that shut the low one (above) and the high one (below).
fn gates(first: &[Dense; 2], index: usize, threshold: f64) -> Dense {
    let mut rows = Rows::of(first[0].input);
    first.iter().for_each(|dense| rows.push_all(dense, 0, None, 0.0));
    rows.push([(index, SLOPE)], -SLOPE * threshold);
    rows.push([(index, -SLOPE)], SLOPE * threshold);
    rows.layer
}

/// Second layer: units whose gate is at −1 are as they were; the others are pushed down. The last unit is 0
/// where the low network acts and −1 where it does not.
fn gated(a: &Dense, b: &Dense) -> Dense {
    let (low_gate, high_gate) = (a.input + b.input, a.input + b.input + 1);
    let mut rows = Rows::of(high_gate + 1);
    rows.push_all(a, 0, Some((low_gate, -SHUT)), -SHUT);
    rows.push_all(b, a.input, Some((high_gate, -SHUT)), -SHUT);
    rows.push([(low_gate, -SHUT)], -SHUT);
    rows.layer
}

/// A layer between: both networks' own, and the last unit handed on.
fn carried(a: &Dense, b: &Dense) -> Dense {
    let which = a.input + b.input;
    let mut rows = Rows::of(which + 1);
    rows.push_all(a, 0, None, 0.0);
    rows.push_all(b, a.input, None, 0.0);
    rows.push([(which, SHUT)], 0.0);
    rows.layer
}

/// The actions: the sum of both, less what the one that does not act gives all the time.
fn summed(a: &MlpSpec, b: &MlpSpec) -> Dense {
    let (idle_a, idle_b) = (when_shut(a), when_shut(b));
    let (Some(a), Some(b)) = (a.layers.last(), b.layers.last()) else { return Rows::of(0).layer };
    let which = a.input + b.input;
    let mut rows = Rows::of(which + 1);
    for action in 0..a.out {
        let row = |dense: &Dense, from: usize| -> Vec<(usize, f64)> {
            let own = &dense.weight[action * dense.input..][..dense.input];
            own.iter().enumerate().map(|(i, &w)| (from + i, f64::from(w))).collect()
        };
        let weights = [row(a, 0), row(b, a.input), vec![(which, idle_a[action] - idle_b[action])]];
        let bias = f64::from(a.bias[action]) + f64::from(b.bias[action]);
        rows.push(weights.concat(), bias - idle_b[action]);
    }
    rows.layer
}

/// What a network gives when every unit of its second layer is −1.
fn when_shut(spec: &MlpSpec) -> Vec<f64> {
    let mut values = vec![-1.0; spec.layers[1].out];
    for (i, layer) in spec.layers.iter().enumerate().skip(2) {
        let rows = layer.weight.chunks(layer.input).zip(&layer.bias);
        let sums = rows.map(|(row, &bias)| {
            let sum: f64 = row.iter().zip(&values).map(|(&w, x)| f64::from(w) * x).sum();
            sum + f64::from(bias)
        });
        values = match i + 1 == spec.layers.len() {
            true => sums.collect(),
            false => sums.map(|x| f64::from(activated(spec.activation, x as f32))).collect(),
        };
    }
    values
}
