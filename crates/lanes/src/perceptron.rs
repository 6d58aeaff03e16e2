//! Layers with a non-linearity between them, forward and backward, in room that is reused from batch to batch.

use crate::dense::{Activation, Dense, activate, activation_gradient, padded, weight_gradient};

/// What a thread has just done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    /// A product of matrices.
    Product,
    /// Something value by value.
    ElementWise,
}

/// What hears of the gradients of a layer: its number, weights, biases.
pub type Take<'a> = dyn FnMut(usize, &[f32], &[f32]) + 'a;

/// Layers with a non-linearity between them and none at the end.
#[derive(Clone, Debug)]
pub struct Perceptron {
    layers: Vec<Dense>,
    activation: Activation,
}

/// What a pass forward keeps for the pass backward, and room for both; reused from batch to batch.
#[derive(Clone, Debug, Default)]
pub struct Tape {
    /// Output of each layer after the non-linearity, `[rows, padded(out)]`.
    outputs: Vec<Vec<f32>>,
    /// Before it, where its slope needs that (swish only).
    before: Vec<Vec<f32>>,
    gradient: Vec<f32>,
    upstream: Vec<f32>,
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Tape {
    /// The outputs of the last layer, row by row of `width` values, padding included, each with room for the
    /// gradient with respect to it, zeros.
    pub fn outputs_and_gradients(
        &mut self,
        width: usize,
    ) -> impl Iterator<Item = (&[f32], &mut [f32])> {
        let outputs = self.outputs.last().map_or(&[][..], Vec::as_slice);
        self.gradient.clear();
        self.gradient.resize(outputs.len(), 0.0);
        let gradients = self.gradient.chunks_exact_mut(width);
        outputs.chunks_exact(width).zip(gradients)
    }
}

impl Perceptron {
    /// `count` layers without weights yet.
    #[must_use]
    pub fn new(count: usize, activation: Activation) -> Self {
        Self {
            layers: vec![Dense::default(); count],
            activation,
        }
    }

    /// The layers, input side first.
    pub fn layers_mut(&mut self) -> &mut [Dense] {
        &mut self.layers
    }

    /// Outputs `[rows, padded(out)]` of `x` `[rows, padded(in)]`. `done` hears of each piece of work.
    pub fn forward<'a>(
        &self,
        x: &[f32],
        rows: usize,
        tape: &'a mut Tape,
        done: &mut dyn FnMut(Work),
    ) -> &'a [f32] {
        tape.outputs.resize(self.layers.len(), Vec::new());
        tape.before.resize(self.layers.len(), Vec::new());
        for (at, layer) in self.layers.iter().enumerate() {
            let (below, above) = tape.outputs.split_at_mut(at);
            let (input, output) = (below.last().map_or(x, Vec::as_slice), &mut above[0]);
            output.resize(rows * padded(layer.outputs()), 0.0);
            layer.forward(input, rows, output);
            done(Work::Product);
            if at + 1 < self.layers.len() {
                if self.activation == Activation::Swish {
                    tape.before[at].clone_from(output);
                }
                activate(self.activation, output);
                done(Work::ElementWise);
            }
        }
        tape.outputs.last().map_or(&[], Vec::as_slice)
    }

    /// After [`Perceptron::forward`] of the same `x`, and with the gradients of
    /// [`Tape::outputs_and_gradients`] filled in: `take` is given those of each layer, the last one first: its
    /// number, `weight` `[out, padded(in)]`, `bias` `[out]`.
    pub fn backward(
        &self,
        x: &[f32],
        rows: usize,
        tape: &mut Tape,
        take: &mut Take<'_>,
        done: &mut dyn FnMut(Work),
    ) {
        for (at, layer) in self.layers.iter().enumerate().rev() {
            let input = match at {
                0 => x,
                _ => &tape.outputs[at - 1],
            };
            let (weight, bias) = (&mut tape.weight, &mut tape.bias);
            weight.resize(layer.outputs() * padded(layer.inputs()), 0.0);
            bias.resize(layer.outputs(), 0.0);
            let shape = (rows, layer.inputs());
            weight_gradient(&tape.gradient, input, shape, weight, bias);
            done(Work::Product);
            take(at, weight, bias);
            if at > 0 {
                tape.upstream.resize(rows * padded(layer.inputs()), 0.0);
                layer.input_gradient(&tape.gradient, rows, &mut tape.upstream);
                done(Work::Product);
                let kept = match self.activation {
                    Activation::Swish => &tape.before[at - 1],
                    _ => &tape.outputs[at - 1],
                };
                activation_gradient(self.activation, kept, &mut tape.upstream);
                std::mem::swap(&mut tape.gradient, &mut tape.upstream);
                done(Work::ElementWise);
            }
        }
    }
}

/// Shifts, scales and clips `raw` `[rows, width]` into `out` `[rows, padded(width)]`:
/// `clip((x − mean)/std, ±limit)`.
pub fn normalise(raw: &[f32], mean: &[f32], std: &[f32], limit: f32, out: &mut [f32]) {
    let width = mean.len();
    let rows = raw.chunks_exact(width.max(1));
    for (row, out) in rows.zip(out.chunks_exact_mut(padded(width).max(1))) {
        let values = row.iter().zip(mean.iter().zip(std)).zip(out);
        for ((x, (mean, std)), out) in values {
            *out = ((x - mean) / std).clamp(-limit, limit);
        }
    }
}
