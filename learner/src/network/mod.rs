//! The actor-critic: a policy network for the mean of the actions, a value network, and a standard deviation
//! per action that does not depend on the state.
//!
//! N observations of size D go in, normalised; the value function may see E values more. A is the number of
//! actions.

mod init;
mod layout;
mod mlp;
mod symmetry;

pub use init::{equivariant, orthogonal};
pub use layout::{LayerPlace, Layout, Parameter, Place};
pub use mlp::{Mlp, Tape};

use caudata_config::{Activation, NetworkConfig};
use caudata_lanes::fold::Side;
use caudata_policy::MlpSpec;
use caudata_random::{Key, Purpose, Stream};
use caudata_task::Mirror;
use caudata_task::mirror::{SignedPermutation, sides};
use tch::{Device, Tensor};

use crate::LearnerError;
use mlp::{Indices, LayerIndices};
use symmetry::Symmetry;

/// Gain of the policy's last layer: actions near zero at first, so that the noise explores around the nominal
/// pose (Andrychowicz et al. 2021, "What matters in on-policy reinforcement learning", section 3.2).
const POLICY_OUTPUT_GAIN: f64 = 0.01;
/// How far inside its bounds the initial std must lie, as a share of their distance on the log scale; at a
/// bound itself the map below would be flat and the parameter stuck.
const STD_MARGIN: f64 = 0.01;

/// Sizes, non-linearity and bounds of an [`ActorCritic`].
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkSpec {
    /// D, what the policy sees.
    pub obs_dim: usize,
    /// How the mirror changes what only the value function sees, behind those: E values.
    pub critic: SignedPermutation,
    /// A.
    pub act_dim: usize,
    /// Hidden layers of the policy.
    pub policy_hidden: Vec<usize>,
    /// Hidden layers of the value function.
    pub value_hidden: Vec<usize>,
    /// Between the layers.
    pub activation: Activation,
    /// Standard deviation of the action noise at the start.
    pub init_std: f64,
    /// Its lower bound.
    pub std_min: f64,
    /// Its upper bound.
    pub std_max: f64,
    /// The mirror that the networks commute with, if any: left and right are then treated alike.
    pub mirror: Option<Mirror>,
}

impl NetworkSpec {
    /// The networks of a configuration for a task with `obs_dim` observations and `act_dim` actions.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] when a size is zero or the bounds of the std do not enclose its start.
    pub fn new(
        config: &NetworkConfig,
        obs_dim: usize,
        act_dim: usize,
    ) -> Result<Self, LearnerError> {
        let spec = Self {
            obs_dim,
            critic: SignedPermutation::identity(0),
            act_dim,
            policy_hidden: config.policy_hidden.iter().map(|&n| n as usize).collect(),
            value_hidden: config.value_hidden.iter().map(|&n| n as usize).collect(),
            activation: config.activation,
            init_std: config.init_std,
            std_min: config.std_min,
            std_max: config.std_max,
            mirror: None,
        };
        let mut sizes = spec.policy_hidden.iter().chain(&spec.value_hidden);
        if obs_dim == 0 || act_dim == 0 || sizes.any(|&n| n == 0) {
            return Err(LearnerError::setting("a layer of the networks has no units"));
        }
        let ordered = 0.0 < spec.std_min && spec.std_min < spec.std_max;
        if !ordered || spec.init_std < spec.std_min || spec.init_std > spec.std_max {
            return Err(LearnerError::setting(
                "learner.network: 0 < std_min <= init_std <= std_max does not hold",
            ));
        }
        Ok(spec)
    }

    /// The same networks, but the value function sees more, which the mirror changes so.
    pub fn with_critic(self, critic: SignedPermutation) -> Self {
        Self { critic, ..self }
    }

    /// D + E, what the value function sees.
    pub fn seen_dim(&self) -> usize {
        self.obs_dim + self.critic.len()
    }

    /// How the mirror changes what the value function sees, if there is one.
    pub fn seen_mirror(&self) -> Option<SignedPermutation> {
        let mirror = self.mirror.as_ref()?;
        Some(mirror.observation.followed_by(&self.critic))
    }

    /// The same networks, but such that they commute with `mirror`.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] when it is for other observations or actions.
    pub fn symmetric(self, mirror: Mirror) -> Result<Self, LearnerError> {
        let found = (mirror.observation.len(), mirror.action.len());
        if found != (self.obs_dim, self.act_dim) {
            return Err(LearnerError::setting(format!(
                "mirror of {} observations and {} actions for a network with {} and {}",
                found.0, found.1, self.obs_dim, self.act_dim
            )));
        }
        Ok(Self { mirror: Some(mirror), ..self })
    }

    fn policy_sides(&self, mirror: &Mirror) -> Vec<SignedPermutation> {
        sides(&mirror.observation, &self.policy_hidden, &mirror.action)
    }

    fn value_sides(&self, mirror: &Mirror) -> Vec<SignedPermutation> {
        let value = SignedPermutation::identity(1);
        let seen = mirror.observation.followed_by(&self.critic);
        sides(&seen, &self.value_hidden, &value)
    }

    /// How rows between the layers of policy and value function are folded.
    pub(crate) fn folds(&self) -> [Vec<Side>; 2] {
        let mirrored = |m: &SignedPermutation| Side::new(&m.source, &m.sign);
        match &self.mirror {
            Some(mirror) => [self.policy_sides(mirror), self.value_sides(mirror)]
                .map(|sides| sides.iter().map(mirrored).collect()),
            None => [self.policy_sizes(), self.value_sizes()]
                .map(|sizes| sizes.into_iter().map(Side::plain).collect()),
        }
    }

    /// Layer sizes of the policy, input and output included.
    pub(crate) fn policy_sizes(&self) -> Vec<usize> {
        sizes(self.obs_dim, &self.policy_hidden, self.act_dim)
    }

    pub(crate) fn value_sizes(&self) -> Vec<usize> {
        sizes(self.seen_dim(), &self.value_hidden, 1)
    }
}

fn sizes(input: usize, hidden: &[usize], output: usize) -> Vec<usize> {
    [&[input], hidden, &[output]].concat()
}

/// Policy and value networks over one flat vector of parameters.
///
/// The log-std is `lo + (hi − lo)·σ(raw)` with the bounds' logarithms `lo`, `hi` and the learnt parameter
/// `raw`: it cannot leave its bounds, and unlike a hard clamp it always has a gradient that leads back.
#[derive(Debug)]
pub struct ActorCritic {
    spec: NetworkSpec,
    layout: Layout,
    indices: Indices,
    flat: Tensor,
    policy: Mlp,
    value: Mlp,
    /// `[A]`.
    raw_log_std: Tensor,
    symmetry: Option<Symmetry>,
}

impl ActorCritic {
    /// A network with fresh weights: orthogonal, gain √2 in hidden layers, 1 at the value, 0.01 at the
    /// actions; biases zero. The same seed gives the same weights, on every device and machine.
    pub fn new(spec: NetworkSpec, seed: u64, device: Device) -> Self {
        let (layout, indices) = lay_out(&spec);
        let values = initial_values(&spec, &layout, &indices, seed);
        let flat = Tensor::from_slice(&values).to_device(device);
        let mirror = spec.mirror.as_ref();
        let symmetry = mirror.map(|m| {
            let sides = [&spec.policy_sides(m)[..], &spec.value_sides(m)[..]];
            Symmetry::new(m, sides, &layout, &indices)
        });
        Self::over(spec, layout, indices, flat, symmetry)
    }

    /// Same shapes over zeros of its own.
    pub fn zeros_like(&self) -> Self {
        Self::over(
            self.spec.clone(),
            self.layout.clone(),
            self.indices.clone(),
            self.flat.zeros_like(),
            self.symmetry.clone(),
        )
    }

    fn over(
        spec: NetworkSpec,
        layout: Layout,
        indices: Indices,
        flat: Tensor,
        symmetry: Option<Symmetry>,
    ) -> Self {
        Self {
            policy: Mlp::over(&layout, &indices.policy, &flat, spec.activation),
            value: Mlp::over(&layout, &indices.value, &flat, spec.activation),
            raw_log_std: layout.view(&flat, indices.raw_log_std),
            spec,
            layout,
            indices,
            flat,
            symmetry,
        }
    }

    /// Where the parameters of each layer lie.
    pub fn place(&self) -> Place {
        let layers = |indices: &LayerIndices| {
            let layer = |&(weight, bias): &(usize, usize)| {
                let (weight, bias) =
                    (&self.layout.parameters()[weight], &self.layout.parameters()[bias]);
                LayerPlace {
                    weight: weight.offset,
                    bias: bias.offset,
                    inputs: weight.numel() / bias.numel().max(1),
                    outputs: bias.numel(),
                }
            };
            indices.iter().map(layer).collect()
        };
        Place {
            policy: layers(&self.indices.policy),
            value: layers(&self.indices.value),
            raw_log_std: self.layout.parameters()[self.indices.raw_log_std].offset,
            act_dim: self.spec.act_dim,
            log_std_bounds: self.log_std_bounds(),
            policy_len: self.policy_len(),
            len: self.layout.len(),
        }
    }

    /// Where the counterpart of each parameter lies and its sign, if the network is symmetric.
    pub fn counterparts(&self) -> Option<&SignedPermutation> {
        self.symmetry.as_ref().map(|symmetry| &symmetry.0)
    }

    /// Sizes and bounds.
    pub fn spec(&self) -> &NetworkSpec {
        &self.spec
    }

    /// Where each parameter lies in [`ActorCritic::flat`].
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// All parameters, `[P]`. Changing it in place changes the network.
    pub fn flat(&self) -> &Tensor {
        &self.flat
    }

    /// Where the parameters live.
    pub fn device(&self) -> Device {
        self.flat.device()
    }

    /// Length of the part of [`ActorCritic::flat`] that the policy has, its log-std included; the value
    /// function's comes behind it.
    pub fn policy_len(&self) -> usize {
        let first = self.indices.value.first().map(|&(weight, _)| weight);
        first.map_or(self.layout.len(), |index| self.layout.parameters()[index].offset)
    }

    /// Writes the policy of `spec` and its log-std `[A]` into `values`, laid out as [`ActorCritic::flat`].
    ///
    /// # Errors
    /// One line when a size is not that of this network.
    pub fn set_policy(
        &self,
        values: &mut [f32],
        spec: &MlpSpec,
        log_std: &[f32],
    ) -> Result<(), String> {
        let mut put = |index: usize, from: &[f32]| {
            let parameter = &self.layout.parameters()[index];
            match values.get_mut(parameter.offset..parameter.offset + from.len()) {
                Some(to) if from.len() == parameter.numel() => {
                    to.copy_from_slice(from);
                    Ok(())
                }
                _ => Err(format!(
                    "{} has {} values, not {}",
                    parameter.name,
                    parameter.numel(),
                    from.len()
                )),
            }
        };
        for (&(weight, bias), layer) in self.indices.policy.iter().zip(&spec.layers) {
            put(weight, &layer.weight)?;
            put(bias, &layer.bias)?;
        }
        let (lo, hi) = self.log_std_bounds();
        // The inverse of `log_std`, kept off the ends of the sigmoid, where there is no gradient.
        let raw = |&x: &f32| {
            let share = ((f64::from(x) - lo) / (hi - lo)).clamp(0.01, 0.99);
            (share / (1.0 - share)).ln() as f32
        };
        let raw: Vec<f32> = log_std.iter().map(raw).collect();
        put(self.indices.raw_log_std, &raw)
    }

    /// The network whose output is the mean of the actions.
    pub fn policy(&self) -> &Mlp {
        &self.policy
    }

    /// The network whose output, `[N, 1]`, is the value.
    pub fn value(&self) -> &Mlp {
        &self.value
    }

    /// Natural logarithm of the standard deviation of each action, `[A]`.
    pub fn log_std(&self) -> Tensor {
        let (lo, hi) = self.log_std_bounds();
        self.raw_log_std.sigmoid() * (hi - lo) + lo
    }

    fn log_std_bounds(&self) -> (f64, f64) {
        (self.spec.std_min.ln(), self.spec.std_max.ln())
    }

    /// All parameters on the host, in the order of the flat vector.
    ///
    /// # Errors
    /// When the device does not hand them over.
    pub fn to_vec(&self) -> Result<Vec<f32>, LearnerError> {
        Ok(Vec::try_from(&self.flat.to_device(Device::Cpu))?)
    }

    /// Replaces all parameters by ones that come from this network.
    pub(crate) fn set(&self, values: &[f32]) {
        let values = Tensor::from_slice(values).to_device(self.device());
        self.flat.shallow_clone().copy_(&values);
    }

    /// Replaces all parameters.
    ///
    /// # Errors
    /// [`LearnerError::Setting`] when the number of values is not that of this network, or when this network is
    /// symmetric and they are not.
    pub fn copy_from_slice(&self, values: &[f32]) -> Result<(), LearnerError> {
        if values.len() != self.layout.len() {
            return Err(LearnerError::setting(format!(
                "{} parameters given to a network with {}",
                values.len(),
                self.layout.len()
            )));
        }
        if self.symmetry.as_ref().is_some_and(|s| !s.holds_for(values)) {
            return Err(LearnerError::setting(
                "it does not treat left and right alike: it was trained with learner.network.symmetric = false",
            ));
        }
        match &self.symmetry {
            // Exactly: the lanes look at one of each pair that the mirror ties.
            Some(symmetry) => self.set(&symmetry.part_of(values)),
            None => self.set(values),
        }
        Ok(())
    }
}

fn lay_out(spec: &NetworkSpec) -> (Layout, Indices) {
    let mut layout = Layout::default();
    let policy = push_layers(&mut layout, "policy", &spec.policy_sizes());
    let raw_log_std = layout.push("raw_log_std".into(), &[spec.act_dim as i64]);
    let value = push_layers(&mut layout, "value", &spec.value_sizes());
    let indices = Indices { policy, value, raw_log_std };
    (layout, indices)
}

fn push_layers(layout: &mut Layout, name: &str, sizes: &[usize]) -> LayerIndices {
    let mut indices = LayerIndices::new();
    for (number, pair) in sizes.windows(2).enumerate() {
        let (input, output) = (pair[0] as i64, pair[1] as i64);
        let weight = layout.push(format!("{name}.{number}.weight"), &[output, input]);
        let bias = layout.push(format!("{name}.{number}.bias"), &[output]);
        indices.push((weight, bias));
    }
    indices
}

fn initial_values(spec: &NetworkSpec, layout: &Layout, indices: &Indices, seed: u64) -> Vec<f32> {
    let key = Key { seed, actor: 0, env: 0, episode: 0 };
    let mut stream = Stream::new(key, Purpose::Init);
    let mut values = vec![0.0_f32; layout.len()];
    let mirror = spec.mirror.as_ref();
    let (policy, value) =
        (mirror.map(|m| spec.policy_sides(m)), mirror.map(|m| spec.value_sides(m)));
    for (layers, sides, output_gain) in
        [(&indices.policy, policy, POLICY_OUTPUT_GAIN), (&indices.value, value, 1.0)]
    {
        for (number, &(weight, _)) in layers.iter().enumerate() {
            let last = number + 1 == layers.len();
            let gain = if last { output_gain } else { std::f64::consts::SQRT_2 };
            let parameter = &layout.parameters()[weight];
            let (rows, columns) = (parameter.shape[0] as usize, parameter.shape[1] as usize);
            let matrix = match &sides {
                Some(sides) => equivariant(&mut stream, &sides[number + 1], &sides[number], gain),
                None => orthogonal(&mut stream, rows, columns, gain),
            };
            values[parameter.offset..][..matrix.len()].copy_from_slice(&matrix);
        }
    }
    let parameter = &layout.parameters()[indices.raw_log_std];
    values[parameter.offset..][..spec.act_dim].fill(raw_of_std(spec) as f32);
    values
}

/// The parameter that gives the initial std: the inverse of the map of [`ActorCritic`].
fn raw_of_std(spec: &NetworkSpec) -> f64 {
    let (lo, hi) = (spec.std_min.ln(), spec.std_max.ln());
    let share = (spec.init_std.ln() - lo) / (hi - lo);
    let share = share.clamp(STD_MARGIN, 1.0 - STD_MARGIN);
    (share / (1.0 - share)).ln()
}

#[cfg(test)]
mod tests;
