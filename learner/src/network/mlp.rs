//! A multilayer perceptron with its backward pass written out.
//!
//! Autograd is not used: with networks of this size its bookkeeping, and above all libtorch's slow `elu`,
//! cost more than the matrix products. Tests compare every gradient with autograd's.

use caudata_config::Activation;
use caudata_telemetry::spans::{Laps, Part};
use tch::{Kind, Tensor};

use super::layout::Layout;

/// Linear layers with a non-linearity between them and none at the end. The tensors are views of a flat
/// vector; cloning the struct does not copy weights.
#[derive(Debug)]
pub struct Mlp {
    layers: Vec<Layer>,
    activation: Activation,
}

#[derive(Debug)]
struct Layer {
    /// `[out, in]`.
    weight: Tensor,
    /// `[out]`.
    bias: Tensor,
}

/// Which parameters of a [`Layout`] an [`Mlp`] consists of: (weight, bias) per layer.
pub type LayerIndices = Vec<(usize, usize)>;

/// Which parameters of a [`Layout`] are whose.
#[derive(Clone, Debug)]
pub struct Indices {
    /// The policy's layers.
    pub policy: LayerIndices,
    /// The value function's layers.
    pub value: LayerIndices,
    /// The policy's spread, before it is bounded.
    pub raw_log_std: usize,
}

/// What the forward pass keeps for the backward pass.
#[derive(Debug)]
pub struct Tape {
    /// Input of each layer, `[M, in]`.
    inputs: Vec<Tensor>,
    /// Output of each hidden layer before the non-linearity, where its derivative needs that (swish only).
    pre: Vec<Tensor>,
}

impl Mlp {
    /// The network whose parameters lie in `flat` at `indices`.
    pub fn over(layout: &Layout, indices: &LayerIndices, flat: &Tensor, act: Activation) -> Self {
        let layer = |&(weight, bias): &(usize, usize)| Layer {
            weight: layout.view(flat, weight),
            bias: layout.view(flat, bias),
        };
        Self { layers: indices.iter().map(layer).collect(), activation: act }
    }

    /// Outputs `[M, out]` of inputs `[M, in]`.
    pub fn forward(&self, x: &Tensor) -> Tensor {
        let (last, hidden) = self.split();
        let mut h = x.shallow_clone();
        for layer in hidden {
            h = activate(self.activation, h.linear(&layer.weight, Some(&layer.bias)));
        }
        h.linear(&last.weight, Some(&last.bias))
    }

    /// Outputs `[M, out]`, and what [`Mlp::backward`] needs.
    pub fn forward_with_tape(&self, x: &Tensor) -> (Tensor, Tape) {
        let (last, hidden) = self.split();
        let mut laps = Laps::new();
        let mut tape = Tape { inputs: vec![x.shallow_clone()], pre: Vec::new() };
        for layer in hidden {
            let z = tape.inputs[tape.inputs.len() - 1].linear(&layer.weight, Some(&layer.bias));
            laps.lap(Part::Products);
            if self.activation == Activation::Swish {
                tape.pre.push(z.shallow_clone());
                tape.inputs.push(z.silu());
            } else {
                tape.inputs.push(activate(self.activation, z));
            }
            laps.lap(Part::ElementWise);
        }
        let input = &tape.inputs[tape.inputs.len() - 1];
        let output = input.linear(&last.weight, Some(&last.bias));
        laps.lap(Part::Products);
        (output, tape)
    }

    /// Writes the gradient of a loss with respect to the parameters into `gradient`, which has the same views
    /// over a vector of its own, given the gradient `[M, out]` with respect to the outputs.
    pub fn backward(&self, tape: &Tape, grad_output: Tensor, gradient: &Mlp) {
        let mut grad = grad_output;
        let mut laps = Laps::new();
        for index in (0..self.layers.len()).rev() {
            let input = &tape.inputs[index];
            let target = &gradient.layers[index];
            let _ = grad.tr().mm_out(&target.weight, input);
            laps.lap(Part::Products);
            let _ = grad.sum_intlist_out(&target.bias, [0].as_slice(), false, Kind::Float);
            laps.lap(Part::ElementWise);
            if index > 0 {
                let upstream = grad.mm(&self.layers[index].weight);
                laps.lap(Part::Products);
                grad = match tape.pre.get(index - 1) {
                    Some(z) => z.silu_backward(&upstream),
                    None => activation_backward(self.activation, upstream, input),
                };
                laps.lap(Part::ElementWise);
            }
        }
    }

    /// Weights `[out, in]` and biases `[out]`, input side first.
    pub fn layers(&self) -> impl Iterator<Item = (&Tensor, &Tensor)> {
        self.layers.iter().map(|layer| (&layer.weight, &layer.bias))
    }

    fn split(&self) -> (&Layer, &[Layer]) {
        // A network has at least its output layer: `NetworkSpec` builds no other.
        let count = self.layers.len();
        (&self.layers[count - 1], &self.layers[..count - 1])
    }
}

/// The non-linearity, in place where that is possible.
fn activate(activation: Activation, mut z: Tensor) -> Tensor {
    match activation {
        // max(z, exp(min(z, 0)) − 1) is ELU with α = 1, since eˣ − 1 ≥ x: three times as fast as `elu`, whose
        // `expm1` buys digits that the next layer does not see.
        Activation::Elu => {
            let negative = z.clamp_max(0.0).exp_().g_sub_scalar_(1.0);
            z.maximum(&negative)
        }
        Activation::Swish => z.silu_(),
        Activation::Tanh => z.tanh_(),
        Activation::Relu => z.relu_(),
    }
}

/// Gradient before the non-linearity, from the one after it and the output `h` of the non-linearity.
fn activation_backward(activation: Activation, grad: Tensor, h: &Tensor) -> Tensor {
    match activation {
        Activation::Elu => Tensor::elu_backward(&grad, 1.0, 1.0, 1.0, true, h),
        Activation::Tanh => Tensor::tanh_backward(&grad, h),
        Activation::Relu => h.threshold_backward(&grad, 0.0),
        // Swish is not a function of its output; its tape keeps the input and the caller uses that.
        Activation::Swish => grad,
    }
}
