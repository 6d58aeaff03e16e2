//! Layers with a non-linearity between them, forward and backward, in room that is reused from batch to batch.

use crate::dense::{
    Activation, Dense, Rows, activate, activate_folded, activation_gradient,
    folded_activation_gradient, padded,
};
use crate::fold::{Side, fold_bias, fold_weights, unfold_bias, unfold_weights};

/// What a thread has just done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Work {
    /// A product of matrices.
    Product,
    /// Something value by value.
    ElementWise,
}

/// Layers with a non-linearity between them and none at the end, which commute with a mirror: it works on folded
/// rows ([`Side`]).
#[derive(Clone, Debug)]
pub struct Perceptron {
    /// Even and odd.
    layers: Vec<[Dense; 2]>,
    /// Input and output of each layer, one more than layers.
    sides: Vec<Side>,
    activation: Activation,
}

/// Folded inputs of a batch.
#[derive(Clone, Copy, Debug)]
pub struct Inputs<'a> {
    /// How many rows there are.
    pub rows: usize,
    /// The rows, folded along `side`.
    pub values: &'a [f32],
    /// The network's inputs, or more values of which they are the first.
    pub side: &'a Side,
}

/// What a pass forward keeps for the pass backward, and room for both; reused from batch to batch.
#[derive(Clone, Debug, Default)]
pub struct Tape {
    /// Output of each layer after the non-linearity, folded.
    outputs: Vec<Vec<f32>>,
    /// Before it, where its slope needs that (swish only).
    before: Vec<Vec<f32>>,
    gradient: Vec<f32>,
    upstream: Vec<f32>,
}

impl Tape {
    /// Calls `of` with each row of the last layer's outputs, unfolded along `side`, and with zeros for the
    /// gradient with respect to them.
    pub fn fill_gradients(&mut self, side: &Side, mut of: impl FnMut(usize, &[f32], &mut [f32])) {
        let outputs = self.outputs.last().map_or(&[][..], Vec::as_slice);
        self.gradient.clear();
        self.gradient.resize(outputs.len(), 0.0);
        let (mut row, mut gradient) = (vec![0.0; side.len()], vec![0.0; side.len()]);
        let folded = outputs.chunks_exact(side.width());
        let gradients = self.gradient.chunks_exact_mut(side.width());
        for (at, (folded, folded_gradient)) in folded.zip(gradients).enumerate() {
            side.unfold(folded, &mut row);
            gradient.fill(0.0);
            of(at, &row, &mut gradient);
            side.fold_gradient(&gradient, folded_gradient);
        }
    }
}

impl Perceptron {
    /// A network without weights yet, with a layer between each of `sides` and the next.
    pub fn new(sides: Vec<Side>, activation: Activation) -> Self {
        Self {
            layers: vec![<[Dense; 2]>::default(); sides.len().saturating_sub(1)],
            sides,
            activation,
        }
    }

    /// Its inputs.
    pub fn input(&self) -> &Side {
        &self.sides[0]
    }

    /// Its outputs.
    pub fn output(&self) -> &Side {
        &self.sides[self.layers.len()]
    }

    /// Replaces layer `at` by `weight` `[out, in]` and `bias` `[out]`, which commute with the mirror. `both_ways`:
    /// also for [`Perceptron::backward`].
    pub fn pack(&mut self, at: usize, weight: &[f32], bias: &[f32], both_ways: bool) {
        let (input, output) = (&self.sides[at], &self.sides[at + 1]);
        let [even, odd] = fold_weights(weight, output, input);
        let inputs = input.counts();
        let no_bias = vec![0.0; output.counts()[1]];
        self.layers[at][0].pack(inputs[0], &even, &fold_bias(bias, output), both_ways);
        self.layers[at][1].pack(inputs[1], &odd, &no_bias, both_ways);
    }

    /// Folded outputs of `x`. `done` hears of each piece of work.
    pub fn forward<'a>(
        &self,
        x: Inputs<'_>,
        tape: &'a mut Tape,
        done: &mut dyn FnMut(Work),
    ) -> &'a [f32] {
        tape.outputs.resize(self.layers.len(), Vec::new());
        tape.before.resize(self.layers.len(), Vec::new());
        for (at, layer) in self.layers.iter().enumerate() {
            let (below, above) = tape.outputs.split_at_mut(at);
            let input = self.input_of(at, x, below);
            let (output, side) = (&mut above[0], &self.sides[at + 1]);
            make_room(output, x.rows, side);
            for (half, (from, to, rows)) in layer.iter().zip(halves(input, side)) {
                half.forward(rows, from, output.get_mut(to..).unwrap_or_default());
            }
            done(Work::Product);
            if at + 1 < self.layers.len() {
                if self.activation == Activation::Swish {
                    tape.before[at].clone_from(output);
                }
                match side.width() == side.part() {
                    true => activate(self.activation, output),
                    false => activate_folded(self.activation, side.part(), output),
                }
                done(Work::ElementWise);
            }
        }
        tape.outputs.last().map_or(&[], Vec::as_slice)
    }

    fn input_of<'a>(&'a self, at: usize, x: Inputs<'a>, below: &'a [Vec<f32>]) -> Inputs<'a> {
        match at {
            0 => x,
            _ => Inputs { rows: x.rows, values: &below[at - 1], side: &self.sides[at] },
        }
    }

    /// Length of the gradient of [`Perceptron::backward`].
    pub fn gradient_len(&self) -> usize {
        let sizes = (0..self.layers.len()).map(|at| self.gradient_sizes(at));
        sizes.flatten().sum()
    }

    /// Lengths of the gradients of layer `at`: of its even weights, its odd weights, its biases.
    fn gradient_sizes(&self, at: usize) -> [usize; 3] {
        let (input, output) = (self.sides[at].counts(), self.sides[at + 1].counts());
        let weights = |half: usize| output[half] * padded(input[half]);
        [weights(0), weights(1), output[0]]
    }

    /// After [`Perceptron::forward`] of the same `x`, and with the gradients of [`Tape::fill_gradients`]: those of
    /// the parameters, folded, which [`Perceptron::unfold_gradient`] reads.
    pub fn backward(
        &self,
        x: Inputs<'_>,
        tape: &mut Tape,
        gradient: &mut [f32],
        done: &mut dyn FnMut(Work),
    ) {
        let mut rest = gradient;
        for (at, layer) in self.layers.iter().enumerate().rev() {
            let side = &self.sides[at + 1];
            let input = self.input_of(at, x, &tape.outputs);
            for (half, (from, to, rows)) in layer.iter().zip(halves(input, side)) {
                let len = half.outputs * padded(half.inputs);
                let (weight, after) = rest.split_at_mut(len);
                let dy = tape.gradient.get(to..).unwrap_or_default();
                half.weight_gradient(rows, dy, from, weight);
                rest = after;
            }
            let (bias, after) = rest.split_at_mut(layer[0].outputs);
            let rows = halves(input, side).map(|(.., rows)| rows);
            layer[0].bias_gradient(rows[0], &tape.gradient, bias);
            rest = after;
            done(Work::Product);
            if at > 0 {
                self.upstream(at, x.rows, tape, done);
            }
        }
    }

    /// Takes the gradient from the outputs of layer `at` to those of the layer before it.
    fn upstream(&self, at: usize, rows: usize, tape: &mut Tape, done: &mut dyn FnMut(Work)) {
        let (side, output) = (&self.sides[at], &self.sides[at + 1]);
        make_room(&mut tape.upstream, rows, side);
        let below = Inputs { rows, values: &tape.outputs[at - 1], side };
        let offsets = [0, side.part()];
        let pieces = halves(below, output).into_iter().zip(offsets);
        for (half, ((_, from, rows), to)) in self.layers[at].iter().zip(pieces) {
            let dy = tape.gradient.get(from..).unwrap_or_default();
            let dx = tape.upstream.get_mut(to..).unwrap_or_default();
            half.input_gradient(rows, dy, dx);
        }
        done(Work::Product);
        let kept = match self.activation {
            Activation::Swish => &tape.before[at - 1],
            _ => &tape.outputs[at - 1],
        };
        let (activation, part) = (self.activation, side.part());
        match side.width() == part {
            true => activation_gradient(activation, kept, &mut tape.upstream),
            false => folded_activation_gradient(activation, part, kept, &mut tape.upstream),
        }
        std::mem::swap(&mut tape.gradient, &mut tape.upstream);
        done(Work::ElementWise);
    }

    /// Gradient of the plain layer `at`, `weight` `[out, in]` and `bias` `[out]`, from the folded gradient of all
    /// layers. Parameters that the mirror ties get the mean of their gradients.
    pub fn unfold_gradient(
        &self,
        at: usize,
        gradient: &[f32],
        weight: &mut [f32],
        bias: &mut [f32],
    ) {
        let behind = (at + 1..self.layers.len()).map(|later| self.gradient_sizes(later));
        let from = behind.flatten().sum();
        let [even, odd, _] = self.gradient_sizes(at);
        let (even, rest) = gradient[from..].split_at(even);
        let (odd, rest) = rest.split_at(odd);
        let (input, output) = (&self.sides[at], &self.sides[at + 1]);
        unfold_weights([even, odd], output, input, weight);
        unfold_bias(rest, output, bias);
    }
}

/// Inputs, place of the outputs in a row, and how rows lie, of the even and of the odd half of a layer.
fn halves<'a>(input: Inputs<'a>, output: &Side) -> [(&'a [f32], usize, Rows); 2] {
    let rows = Rows { count: input.rows, input: input.side.width(), output: output.width() };
    let odd = match input.side.width() == input.side.part() {
        true => &[],
        // no rows, no odd parts
        false => input.values.get(input.side.part()..).unwrap_or_default(),
    };
    let odd_out = output.width() - output.part();
    [(input.values, 0, rows), (odd, odd_out, rows)]
}

/// `rows` folded rows, whose padding is zeros.
fn make_room(values: &mut Vec<f32>, rows: usize, side: &Side) {
    // What the products write includes the padding, but for that of the shorter of two halves.
    let [even, odd] = side.counts();
    if odd > 0 && padded(even) != padded(odd) {
        values.clear();
    }
    values.resize(rows * side.width(), 0.0);
}

/// Shifts, scales and clips `raw` `[rows, len]` into `out`, folded along `side`: `clip((x − mean)/std, ±limit)`.
pub fn normalise(
    raw: &[f32],
    (mean, std, limit): (&[f32], &[f32], f32),
    side: &Side,
    out: &mut [f32],
) {
    let mut seen = vec![0.0; side.len()];
    let rows = raw.chunks_exact(side.len().max(1));
    for (row, out) in rows.zip(out.chunks_exact_mut(side.width().max(1))) {
        let values = row.iter().zip(mean.iter().zip(std)).zip(&mut seen);
        for ((x, (mean, std)), seen) in values {
            *seen = ((x - mean) / std).clamp(-limit, limit);
        }
        side.fold(&seen, out);
    }
}
