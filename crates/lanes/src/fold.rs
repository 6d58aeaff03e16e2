//! The values between two layers, folded along a mirror: what both sides have in common, and what they differ in.
//!
//! A mirror exchanges values and negates some: x'ₖ = s·xₗ, x'ₗ = s·xₖ. The even part of such a pair is ½(xₖ +
//! s·xₗ), the odd part ½(xₖ − s·xₗ). A layer that commutes with the mirror takes even parts to even parts and odd
//! parts to odd parts: two products of half the size each way, half the multiplications of one. Without a mirror
//! every value is an even part by itself, and nothing is odd.

use crate::dense::padded;

/// A value and its counterpart in the mirror.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Unit {
    index: usize,
    /// Its counterpart; itself where the mirror leaves it in its place.
    other: usize,
    /// The counterpart's sign; 0 for a value that is its own counterpart.
    sign: f32,
    /// ½ for a pair, 1 for a value that is its own counterpart.
    share: f32,
}

/// How the mirror changes the values on one side of a layer, and how a row of them is folded: the even parts,
/// padded to [`Side::part`], and behind them the odd parts, if there are any, padded to the same.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Side {
    len: usize,
    even: Vec<Unit>,
    odd: Vec<Unit>,
}

impl Side {
    /// `len` values that no mirror changes.
    pub fn plain(len: usize) -> Self {
        Self::new(&Vec::from_iter(0..len), &vec![1.0; len])
    }

    /// The mirror image of value i is `sign[i]` times value `source[i]`; twice mirrored is as it was. A first
    /// part of the values that is mirrored in itself is folded into the first parts of both halves.
    pub fn new(source: &[usize], sign: &[f32]) -> Self {
        let mut side = Self { len: source.len(), ..Self::default() };
        for (index, (&other, &sign)) in source.iter().zip(sign).enumerate() {
            let alone = Unit { index, other, sign: 0.0, share: 1.0 };
            match (index == other, sign > 0.0) {
                (true, true) => side.even.push(alone),
                (true, false) => side.odd.push(alone),
                (false, _) if index < other => {
                    let pair = Unit { sign, share: 0.5, ..alone };
                    side.even.push(pair);
                    side.odd.push(pair);
                }
                (false, _) => {}
            }
        }
        side
    }

    /// Values of a row that is not folded.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Even and odd parts.
    pub fn counts(&self) -> [usize; 2] {
        [self.even.len(), self.odd.len()]
    }

    /// Where the odd parts begin in a folded row.
    pub fn part(&self) -> usize {
        padded(self.even.len().max(self.odd.len()))
    }

    /// Values in a folded row.
    pub fn width(&self) -> usize {
        if self.odd.is_empty() { self.part() } else { 2 * self.part() }
    }

    /// Folds `row` `[len]` into `out` `[width]`, whose padding is left as it is.
    pub fn fold(&self, row: &[f32], out: &mut [f32]) {
        let (even, odd) = out.split_at_mut(self.part());
        for (out, unit) in even.iter_mut().zip(&self.even) {
            *out = unit.share * (row[unit.index] + unit.sign * row[unit.other]);
        }
        for (out, unit) in odd.iter_mut().zip(&self.odd) {
            *out = unit.share * (row[unit.index] - unit.sign * row[unit.other]);
        }
    }

    /// The row `[len]` that was folded into `folded` `[width]`.
    pub fn unfold(&self, folded: &[f32], row: &mut [f32]) {
        let (even, odd) = folded.split_at(self.part());
        row.fill(0.0);
        for (value, unit) in even.iter().zip(&self.even) {
            row[unit.index] += value;
            row[unit.other] += unit.sign * value;
        }
        for (value, unit) in odd.iter().zip(&self.odd) {
            row[unit.index] += value;
            row[unit.other] -= unit.sign * value;
        }
    }

    /// Gradient with respect to a folded row `[width]` from that with respect to the row `[len]`.
    pub fn fold_gradient(&self, row: &[f32], out: &mut [f32]) {
        let (even, odd) = out.split_at_mut(self.part());
        for (out, unit) in even.iter_mut().zip(&self.even) {
            *out = row[unit.index] + unit.sign * row[unit.other];
        }
        for (out, unit) in odd.iter_mut().zip(&self.odd) {
            *out = row[unit.index] - unit.sign * row[unit.other];
        }
    }
}

/// The two matrices, even and odd, row-major, that a layer with `weight` `[out, in]` is between folded rows.
pub fn fold_weights(weight: &[f32], output: &Side, input: &Side) -> [Vec<f32>; 2] {
    let halves = [(&output.even, &input.even, 1.0), (&output.odd, &input.odd, -1.0)];
    halves.map(|(output, inputs, parity)| {
        let mut half = Vec::with_capacity(output.len() * inputs.len());
        for to in output {
            let row = &weight[to.index * input.len..][..input.len];
            half.extend(
                inputs.iter().map(|from| row[from.index] + parity * from.sign * row[from.other]),
            );
        }
        half
    })
}

/// Adds up the gradient with respect to a layer's `weight` `[out, in]` from those with respect to its two
/// matrices, `[even, odd]`, whose rows are padded. Weights that the mirror ties get the mean of their gradients.
pub fn unfold_weights(halves: [&[f32]; 2], output: &Side, input: &Side, weight: &mut [f32]) {
    weight.fill(0.0);
    let halves =
        [(halves[0], &output.even, &input.even, 1.0), (halves[1], &output.odd, &input.odd, -1.0)];
    for (half, outputs, inputs, parity) in halves {
        let rows = half.chunks_exact(padded(inputs.len()).max(1));
        for (to, row) in outputs.iter().zip(rows) {
            let mut add = |at: usize, scale: f32| {
                let all = &mut weight[at * input.len..][..input.len];
                for (from, gradient) in inputs.iter().zip(row) {
                    let gradient = scale * gradient;
                    all[from.index] += gradient;
                    all[from.other] += parity * from.sign * gradient;
                }
            };
            add(to.index, to.share);
            if to.other != to.index {
                add(to.other, parity * to.sign * to.share);
            }
        }
    }
}

/// The biases between folded rows: those of the even parts. A layer that commutes with its mirror has none of
/// odd parts.
pub fn fold_bias(bias: &[f32], output: &Side) -> Vec<f32> {
    output.even.iter().map(|unit| bias[unit.index]).collect()
}

/// Gradient with respect to the biases `[out]`, tied ones with the mean of theirs, from that with respect to
/// the even parts'.
pub fn unfold_bias(gradient: &[f32], output: &Side, bias: &mut [f32]) {
    bias.fill(0.0);
    for (gradient, unit) in gradient.iter().zip(&output.even) {
        let gradient = unit.share * gradient;
        bias[unit.index] += gradient;
        bias[unit.other] += unit.sign * gradient;
    }
}

#[cfg(test)]
mod tests;
