//! The network of a policy: normaliser and multi-layer perceptron, and a plain evaluation of it.

pub use caudata_lanes::dense::Activation;

use crate::PolicyError;

/// Most layers of a policy.
pub const MAX_LAYERS: usize = 16;
/// Widest layer, and longest observation.
pub const MAX_WIDTH: usize = 4096;
/// Smallest standard deviation in a normaliser: below it, noise in a constant observation would
/// swamp everything else. (brax bounds its running statistics by the same figure.)
pub const MIN_OBS_STD: f32 = 1e-6;

/// What the learner hands over: `actions = layers(clip((obs - mean) / std))`, with the activation
/// between layers and none after the last.
#[derive(Debug, Clone, PartialEq)]
pub struct MlpSpec {
    /// `[D]`, subtracted from the observation.
    pub obs_mean: Vec<f32>,
    /// `[D]`, divides the centred observation; at least [`MIN_OBS_STD`].
    pub obs_std: Vec<f32>,
    /// Normalised observations are cut off at plus and minus this, above 0; `None`: not at all.
    pub obs_clip: Option<f32>,
    /// First to last; the first takes D inputs, the last gives the actions.
    pub layers: Vec<Dense>,
    /// Between the layers.
    pub activation: Activation,
}

/// A fully connected layer, `y = W x + b`.
#[derive(Debug, Clone, PartialEq)]
pub struct Dense {
    /// Outputs.
    pub out: usize,
    /// Inputs. (`in` is a keyword.)
    pub input: usize,
    /// `[out, input]`, row-major, as PyTorch and libtorch keep it.
    pub weight: Vec<f32>,
    /// `[out]`.
    pub bias: Vec<f32>,
}

/// The value of the function `of` at `x`.
pub(crate) fn activated(of: Activation, x: f32) -> f32 {
    match of {
        Activation::Elu if x > 0.0 => x,
        Activation::Elu => x.exp_m1(),
        Activation::Swish => x / (1.0 + (-x).exp()),
        Activation::Tanh => x.tanh(),
        Activation::Relu => x.max(0.0),
    }
}

impl MlpSpec {
    /// D, length of the observation.
    pub fn obs_dim(&self) -> usize {
        self.obs_mean.len()
    }

    /// The same network where observations of `obs_dim` values, at least as many as now, have more at their end:
    /// it does not look at these.
    pub fn widened(&self, obs_dim: usize) -> Self {
        let mut spec = self.clone();
        spec.obs_mean.resize(obs_dim, 0.0);
        spec.obs_std.resize(obs_dim, 1.0);
        if let Some(first) = spec.layers.first_mut() {
            let mut weight = vec![0.0; first.out * obs_dim];
            for (to, from) in weight.chunks_mut(obs_dim).zip(first.weight.chunks(first.input)) {
                to[..first.input].copy_from_slice(from);
            }
            (first.weight, first.input) = (weight, obs_dim);
        }
        spec
    }

    /// Number of actions.
    pub fn act_dim(&self) -> usize {
        self.layers.last().map_or(0, |layer| layer.out)
    }

    /// Checks sizes, finiteness and ranges.
    ///
    /// # Errors
    /// The first thing that is not right.
    pub fn check(&self) -> Result<(), PolicyError> {
        if !(1..=MAX_WIDTH).contains(&self.obs_dim()) {
            return Err(PolicyError::Range { field: "obs_mean", problem: "1 to 4096 entries" });
        }
        if !(1..=MAX_LAYERS).contains(&self.layers.len()) {
            return Err(PolicyError::Range { field: "layers", problem: "1 to 16 layers" });
        }
        length("obs_std", self.obs_std.len(), self.obs_dim())?;
        finite("obs_mean", &self.obs_mean)?;
        finite("obs_std", &self.obs_std)?;
        if self.obs_std.iter().any(|&std| std < MIN_OBS_STD) {
            return Err(PolicyError::Range { field: "obs_std", problem: "at least 1e-6" });
        }
        if self.obs_clip.is_some_and(|clip| !(clip > 0.0 && clip.is_finite())) {
            return Err(PolicyError::Range { field: "obs_clip", problem: "above 0 and finite" });
        }
        let mut inputs = self.obs_dim();
        for (index, layer) in self.layers.iter().enumerate() {
            layer.check(index, inputs)?;
            inputs = layer.out;
        }
        Ok(())
    }
}

impl Dense {
    fn check(&self, index: usize, inputs: usize) -> Result<(), PolicyError> {
        length("layer inputs", self.input, inputs)?;
        if !(1..=MAX_WIDTH).contains(&self.out) {
            return Err(PolicyError::Range { field: "layer outputs", problem: "1 to 4096" });
        }
        length("layer weight", self.weight.len(), self.out * self.input)?;
        length("layer bias", self.bias.len(), self.out)?;
        finite(&weight_name(index), &self.weight)?;
        finite(&bias_name(index), &self.bias)
    }
}

/// The network's actions, in plain Rust: the reference for ONNX Runtime's.
///
/// `obs` is `[lanes, D]`, `actions` `[lanes, A]`, both row-major.
///
/// # Errors
/// [`PolicyError::Length`] where a slice does not have that size; what [`MlpSpec::check`] refuses.
pub fn evaluate_mlp(
    spec: &MlpSpec,
    obs: &[f32],
    lanes: usize,
    actions: &mut [f32],
) -> Result<(), PolicyError> {
    spec.check()?;
    let (obs_dim, act_dim) = (spec.obs_dim(), spec.act_dim());
    length("obs", obs.len(), lanes.saturating_mul(obs_dim))?;
    length("actions", actions.len(), lanes.saturating_mul(act_dim))?;
    let (mut x, mut y) = (Vec::new(), Vec::new());
    for (obs, actions) in obs.chunks_exact(obs_dim).zip(actions.chunks_exact_mut(act_dim)) {
        x.clear();
        x.extend((0..obs_dim).map(|i| {
            let normalised = (obs[i] - spec.obs_mean[i]) / spec.obs_std[i];
            spec.obs_clip.map_or(normalised, |clip| normalised.clamp(-clip, clip))
        }));
        for (index, layer) in spec.layers.iter().enumerate() {
            y.clear();
            y.extend(
                layer
                    .weight
                    .chunks_exact(layer.input)
                    .zip(&layer.bias)
                    .map(|(row, bias)| bias + row.iter().zip(&x).map(|(w, x)| w * x).sum::<f32>()),
            );
            if index + 1 < spec.layers.len() {
                y.iter_mut().for_each(|y| *y = activated(spec.activation, *y));
            }
            std::mem::swap(&mut x, &mut y);
        }
        actions.copy_from_slice(&x);
    }
    Ok(())
}

/// Name of a layer's weight in the file.
pub(crate) fn weight_name(index: usize) -> String {
    format!("layers.{index}.weight")
}

/// Name of a layer's bias in the file.
pub(crate) fn bias_name(index: usize) -> String {
    format!("layers.{index}.bias")
}

pub(crate) fn length(what: &'static str, found: usize, expected: usize) -> Result<(), PolicyError> {
    if found == expected {
        return Ok(());
    }
    Err(PolicyError::Length { what, found, expected })
}

pub(crate) fn finite(name: &str, values: &[f32]) -> Result<(), PolicyError> {
    match values.iter().position(|x| !x.is_finite()) {
        None => Ok(()),
        Some(index) => Err(PolicyError::NotFinite { name: name.to_owned(), index }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One observation, two hidden units, one action.
    fn tiny(activation: Activation, obs_clip: Option<f32>) -> MlpSpec {
        MlpSpec {
            obs_mean: vec![1.0],
            obs_std: vec![2.0],
            obs_clip,
            layers: vec![
                Dense { out: 2, input: 1, weight: vec![1.0, -1.0], bias: vec![0.5, 0.0] },
                Dense { out: 1, input: 2, weight: vec![2.0, 3.0], bias: vec![-1.0] },
            ],
            activation,
        }
    }

    fn act(spec: &MlpSpec, obs: f32) -> f32 {
        let mut out = [0.0];
        evaluate_mlp(spec, &[obs], 1, &mut out).unwrap();
        out[0]
    }

    #[test]
    fn forward_pass_by_hand() {
        // obs 5: (5 - 1)/2 = 2; hidden 2.5 and -2.
        // relu: 2·2.5 + 3·0 - 1 = 4.
        assert_eq!(act(&tiny(Activation::Relu, None), 5.0), 4.0);
        // clip 1.5: hidden 2 and -1.5; relu: 2·2 - 1 = 3.
        assert_eq!(act(&tiny(Activation::Relu, Some(1.5)), 5.0), 3.0);
        // elu: e^-2 - 1 = -0.8646647; 5 + 3·(-0.8646647) - 1 = 1.4060059.
        assert!((act(&tiny(Activation::Elu, None), 5.0) - 1.406_005_9).abs() < 1e-6);
        // tanh: 0.9866143 and -0.9640276; 1.9732286 - 2.8920828 - 1 = -1.9188542.
        assert!((act(&tiny(Activation::Tanh, None), 5.0) + 1.918_854_2).abs() < 1e-6);
        // swish: 2.5/(1+e^-2.5) = 2.3103545, -2/(1+e^2) = -0.2384058;
        // 4.6207090 - 0.7152175 - 1 = 2.9054915.
        assert!((act(&tiny(Activation::Swish, None), 5.0) - 2.905_491_5).abs() < 1e-6);
    }

    #[test]
    fn lanes_are_independent_rows() {
        let spec = tiny(Activation::Tanh, None);
        let mut out = [0.0; 3];
        evaluate_mlp(&spec, &[5.0, -1.0, 0.25], 3, &mut out).unwrap();
        assert_eq!(out, [act(&spec, 5.0), act(&spec, -1.0), act(&spec, 0.25)]);
    }

    #[test]
    fn a_network_that_is_not_right_is_refused_by_name() {
        let good = tiny(Activation::Elu, Some(5.0));
        good.check().unwrap();
        let broken = |change: fn(&mut MlpSpec)| {
            let mut spec = good.clone();
            change(&mut spec);
            spec.check().unwrap_err()
        };
        let range = |field| move |e: &PolicyError| matches!(e, PolicyError::Range { field: f, .. } if *f == field);
        assert!(range("obs_std")(&broken(|s| s.obs_std[0] = 0.0)));
        assert!(range("obs_clip")(&broken(|s| s.obs_clip = Some(0.0))));
        assert!(range("layers")(&broken(|s| s.layers.clear())));
        assert!(range("obs_mean")(&broken(|s| s.obs_mean.clear())));
        let nan = broken(|s| s.layers[1].weight[1] = f32::NAN);
        assert_eq!(nan, PolicyError::NotFinite { name: "layers.1.weight".into(), index: 1 });
        let gap = broken(|s| s.layers[1].input = 3);
        assert_eq!(gap, PolicyError::Length { what: "layer inputs", found: 3, expected: 2 });
        let short = broken(|s| s.layers[0].bias.clear());
        assert_eq!(short, PolicyError::Length { what: "layer bias", found: 0, expected: 2 });
    }
}
