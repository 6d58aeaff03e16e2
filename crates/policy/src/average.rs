//! The mean of several versions of one policy.

use std::sync::Arc;

use crate::mlp::{Dense, MlpSpec};
use crate::onnx::build::build_onnx;
use crate::{PolicyError, PolicyFile};

/// A policy whose every number (weights, normaliser, exploration) is the mean of those of `versions`, and
/// that says of itself what the last of them says.
///
/// Late in a training with policy gradients weights wander about a good place; their mean is nearer to it
/// than most of them (B. T. Polyak, A. B. Juditsky, "Acceleration of stochastic approximation by averaging",
/// SIAM J. Control Optim. 30, 1992). A mean of symmetric policies is symmetric.
///
/// # Errors
/// [`PolicyError::NotOneTraining`] for none, and for versions of different runs or with another contract,
/// other layers or another activation than the last one's; else as [`build_onnx`].
pub fn average(versions: &[PolicyFile]) -> Result<PolicyFile, PolicyError> {
    let last = versions.last().ok_or(PolicyError::NotOneTraining)?;
    if !versions.iter().all(|v| fits(v, last)) {
        return Err(PolicyError::NotOneTraining);
    }
    let specs = || versions.iter().map(PolicyFile::spec);
    let layer = |i: usize| {
        let of = |part: fn(&Dense) -> &Vec<f32>| mean(specs().map(|s| &part(&s.layers[i])[..]));
        Dense { weight: of(|l| &l.weight), bias: of(|l| &l.bias), ..last.spec().layers[i] }
    };
    let spec = MlpSpec {
        obs_mean: mean(specs().map(|s| &s.obs_mean[..])),
        obs_std: mean(specs().map(|s| &s.obs_std[..])),
        layers: (0..last.spec().layers.len()).map(layer).collect(),
        ..last.spec().clone()
    };
    let mut metadata = last.metadata().clone();
    metadata.log_std = mean(versions.iter().map(|v| &v.metadata().log_std[..]));
    // of the last version, not of the mean
    metadata.evaluation = None;
    PolicyFile::parse(Arc::from(build_onnx(&spec, &metadata)?))
}

/// Whether the numbers of two files mean the same and can be added.
fn fits(a: &PolicyFile, b: &PolicyFile) -> bool {
    let shape = |s: &MlpSpec| {
        let sizes: Vec<_> = s.layers.iter().map(|l| (l.out, l.input)).collect();
        (sizes, s.activation, s.obs_clip)
    };
    let run = |f: &PolicyFile| (f.metadata().run_id.clone(), f.metadata().contract.clone());
    shape(a.spec()) == shape(b.spec()) && run(a) == run(b)
}

/// The mean of equally long lists, summed in f64.
fn mean<'a>(lists: impl Iterator<Item = &'a [f32]>) -> Vec<f32> {
    let mut n = 0.0;
    let mut sums: Vec<f64> = Vec::new();
    for list in lists {
        sums.resize(list.len(), 0.0);
        sums.iter_mut().zip(list).for_each(|(sum, &x)| *sum += f64::from(x));
        n += 1.0;
    }
    sums.iter().map(|sum| (sum / n) as f32).collect()
}
