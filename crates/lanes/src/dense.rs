//! Dense layers in vector lanes: what small networks spend their time on, forward and backward.
//!
//! Matrices are row-major, and every row is padded with zeros to a multiple of [`BLOCK`] values
//! ([`padded`]). Each output is one chain of multiply-adds in the order of the inputs, whatever the width of the
//! lanes and the number of rows: 16 and 8 lanes give the same bits, and a batch gives each row what it gets
//! alone.

use serde::{Deserialize, Serialize};

use crate::real::Real;
use crate::simd::{AnyWidth, Lanes, widest};

/// Columns of a block. Rows are padded to a multiple of it.
pub const BLOCK: usize = 16;
/// Rows of a tile of results that is kept in registers.
const ROWS: usize = 6;

/// Values in a padded row of `width`.
pub fn padded(width: usize) -> usize {
    width.next_multiple_of(BLOCK)
}

/// Non-linearity between layers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// x where positive, else eˣ − 1 (rsl_rl's default).
    #[default]
    Elu,
    /// x times the logistic function of x; also called SiLU (brax's default).
    Swish,
    /// Hyperbolic tangent.
    Tanh,
    /// x where positive, else 0.
    Relu,
}

impl Activation {
    /// Every activation.
    pub const ALL: [Self; 4] = [Self::Elu, Self::Swish, Self::Tanh, Self::Relu];
}

/// A layer `y = W·x + b`, packed for the products.
#[derive(Clone, Debug, Default)]
pub struct Dense {
    /// Inputs.
    pub inputs: usize,
    /// Outputs.
    pub outputs: usize,
    /// Wᵀ in blocks of outputs, `[⌈out/16⌉, in, 16]`.
    by_output: Vec<f32>,
    /// W in blocks of inputs, `[⌈in/16⌉, out, 16]`.
    by_input: Vec<f32>,
    /// `[padded(out)]`.
    bias: Vec<f32>,
}

impl Dense {
    /// Replaces the layer by one of `inputs` inputs with `weight` `[out, in]` and `bias` `[out]`. `both_ways`:
    /// also for [`Dense::input_gradient`].
    pub fn pack(&mut self, inputs: usize, weight: &[f32], bias: &[f32], both_ways: bool) {
        let outputs = bias.len();
        (self.inputs, self.outputs) = (inputs, outputs);
        self.bias.clear();
        self.bias.extend_from_slice(bias);
        self.bias.resize(padded(outputs), 0.0);
        self.by_output.resize(padded(outputs) * inputs, 0.0);
        for (o, row) in weight.chunks_exact(inputs.max(1)).enumerate() {
            let block = &mut self.by_output[(o / BLOCK) * inputs * BLOCK..];
            for (i, &w) in row.iter().enumerate() {
                block[i * BLOCK + o % BLOCK] = w;
            }
        }
        if !both_ways {
            return;
        }
        self.by_input.resize(padded(inputs) * outputs, 0.0);
        for (o, row) in weight.chunks_exact(inputs.max(1)).enumerate() {
            for (block, part) in row.chunks(BLOCK).enumerate() {
                let at = (block * outputs + o) * BLOCK;
                self.by_input[at..at + part.len()].copy_from_slice(part);
            }
        }
    }

    /// `y = W·x + b`: rows of `x` have at least the inputs, rows of `y` room for `padded(out)` values.
    pub fn forward(&self, rows: Rows, x: &[f32], y: &mut [f32]) {
        widest(Product {
            left: Left::Rows { values: x, stride: rows.input },
            right: &self.by_output,
            right_stride: BLOCK,
            block_stride: self.inputs * BLOCK,
            inner: self.inputs,
            start: &self.bias,
            rows: rows.count,
            columns: padded(self.outputs),
            out: y,
            out_stride: rows.output,
        });
    }

    /// Gradient `dx` with respect to the inputs, rows with room for `padded(in)` values, from `dy`.
    pub fn input_gradient(&self, rows: Rows, dy: &[f32], dx: &mut [f32]) {
        widest(Product {
            left: Left::Rows { values: dy, stride: rows.output },
            right: &self.by_input,
            right_stride: BLOCK,
            block_stride: self.outputs * BLOCK,
            inner: self.outputs,
            start: &[],
            rows: rows.count,
            columns: padded(self.inputs),
            out: dx,
            out_stride: rows.input,
        });
    }

    /// Gradient of the weights `[out, padded(in)]` from `x`, whose rows have `padded(in)` values or more, and
    /// `dy`. What its padding gets has no meaning.
    pub fn weight_gradient(&self, rows: Rows, dy: &[f32], x: &[f32], weight: &mut [f32]) {
        widest(Product {
            left: Left::Columns { values: dy, stride: rows.output },
            right: x,
            right_stride: rows.input,
            block_stride: BLOCK,
            inner: rows.count,
            start: &[],
            rows: self.outputs,
            columns: padded(self.inputs),
            out: weight,
            out_stride: padded(self.inputs),
        });
    }

    /// Gradient of the biases `[out]` from `dy`.
    pub fn bias_gradient(&self, rows: Rows, dy: &[f32], bias: &mut [f32]) {
        bias.fill(0.0);
        for row in dy.chunks(rows.output.max(1)).take(rows.count) {
            for (sum, d) in bias.iter_mut().zip(row) {
                *sum += d;
            }
        }
    }
}

/// How the rows of a batch lie, on either side of a layer.
#[derive(Clone, Copy, Debug)]
pub struct Rows {
    /// How many.
    pub count: usize,
    /// From one row of inputs to the next.
    pub input: usize,
    /// From one row of outputs to the next.
    pub output: usize,
}

/// Puts the non-linearity's values in place of `z`.
pub fn activate(activation: Activation, z: &mut [f32]) {
    widest(Activate { activation, z });
}

/// Turns the gradient after the non-linearity into the one before it, in place. `h`: the values after it, or with
/// [`Activation::Swish`] those before it.
pub fn activation_gradient(activation: Activation, h: &[f32], gradient: &mut [f32]) {
    widest(ActivationGradient { activation, h, gradient });
}

/// [`activate`] of folded rows: `part` even parts e, then as many odd parts o, of pairs e + o and e − o.
pub fn activate_folded(activation: Activation, part: usize, z: &mut [f32]) {
    widest(ActivateFolded { activation, part, z });
}

/// [`activation_gradient`] of folded rows.
pub fn folded_activation_gradient(
    activation: Activation,
    part: usize,
    h: &[f32],
    gradient: &mut [f32],
) {
    widest(FoldedActivationGradient { activation, part, h, gradient });
}

/// The left matrix of a product, of which single values are read.
#[derive(Clone, Copy)]
enum Left<'a> {
    /// Value (r, k) lies at `r·stride + k`.
    Rows { values: &'a [f32], stride: usize },
    /// Value (r, k) lies at `k·stride + r`.
    Columns { values: &'a [f32], stride: usize },
}

/// `out[r, c] = start[c] + Σ_k left(r, k)·right(k, c)`, columns in blocks of 16.
struct Product<'a> {
    left: Left<'a>,
    /// Value (k, c) lies at `(c / 16)·block_stride + k·right_stride + c % 16`.
    right: &'a [f32],
    right_stride: usize,
    block_stride: usize,
    /// Length of the sums.
    inner: usize,
    /// `[columns]`, or empty for zeros.
    start: &'a [f32],
    rows: usize,
    /// A multiple of 16.
    columns: usize,
    out: &'a mut [f32],
    out_stride: usize,
}

impl AnyWidth for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(mut self) {
        if self.inner == 0 {
            return self.start_alone();
        }
        // As many registers as sums in flight need: 24 of 32 with 16 and with 4 lanes, 12 of 16 with 8.
        match R::LANES {
            16 => self.strips::<R, 4>(),
            4 => self.strips::<R, 4>(),
            8 => self.strips::<R, 2>(),
            _ => self.strips::<R, 1>(),
        }
    }
}

impl Product<'_> {
    /// Sums of nothing.
    fn start_alone(&mut self) {
        for row in self.out.chunks_mut(self.out_stride.max(1)).take(self.rows) {
            match self.start {
                [] => row[..self.columns].fill(0.0),
                start => row[..self.columns].copy_from_slice(start),
            }
        }
    }

    /// Strips of up to `WIDE` registers of columns, one after the other: the right matrix's part stays in the
    /// nearest cache while all rows go by.
    #[inline(always)]
    fn strips<R: Lanes<Elem = f32>, const WIDE: usize>(&mut self) {
        let mut column = 0;
        while column + WIDE * R::LANES <= self.columns {
            self.strip::<R, WIDE>(column);
            column += WIDE * R::LANES;
        }
        while WIDE > 2 && column + 2 * R::LANES <= self.columns {
            self.strip::<R, 2>(column);
            column += 2 * R::LANES;
        }
        while column < self.columns {
            self.strip::<R, 1>(column);
            column += R::LANES;
        }
    }

    #[inline(always)]
    fn strip<R: Lanes<Elem = f32>, const N: usize>(&mut self, column: usize) {
        let mut row = 0;
        while row + ROWS <= self.rows {
            self.tile::<R, N, ROWS>(row, column);
            row += ROWS;
        }
        while row + 2 <= self.rows {
            self.tile::<R, N, 2>(row, column);
            row += 2;
        }
        if row < self.rows {
            self.tile::<R, N, 1>(row, column);
        }
    }

    #[inline(always)]
    fn tile<R: Lanes<Elem = f32>, const N: usize, const M: usize>(
        &mut self,
        row: usize,
        column: usize,
    ) {
        let mut sums = [[R::zero(); N]; M];
        if !self.start.is_empty() {
            for j in 0..N {
                let start = R::read(&self.start[column + j * R::LANES..]);
                for i in 0..M {
                    sums[i][j] = start;
                }
            }
        }
        let mut right = [&self.right[..0]; N];
        for j in 0..N {
            let at = column + j * R::LANES;
            right[j] = &self.right[at / BLOCK * self.block_stride + at % BLOCK..];
        }
        match self.left {
            Left::Rows { values, stride } => {
                let mut left = [&values[..0]; M];
                for i in 0..M {
                    left[i] = &values[(row + i) * stride..][..self.inner];
                }
                for k in 0..self.inner {
                    let mut b = [R::zero(); N];
                    for j in 0..N {
                        b[j] = R::read(&right[j][k * self.right_stride..]);
                    }
                    for i in 0..M {
                        let a = R::uniform(left[i][k]);
                        for j in 0..N {
                            sums[i][j] = a.mul_add(b[j], sums[i][j]);
                        }
                    }
                }
            }
            Left::Columns { values, stride } => {
                for k in 0..self.inner {
                    let left = &values[k * stride + row..][..M];
                    let mut b = [R::zero(); N];
                    for j in 0..N {
                        b[j] = R::read(&right[j][k * self.right_stride..]);
                    }
                    for i in 0..M {
                        let a = R::uniform(left[i]);
                        for j in 0..N {
                            sums[i][j] = a.mul_add(b[j], sums[i][j]);
                        }
                    }
                }
            }
        }
        for i in 0..M {
            let out = &mut self.out[(row + i) * self.out_stride + column..];
            for j in 0..N {
                sums[i][j].write(&mut out[j * R::LANES..]);
            }
        }
    }
}

struct Activate<'a> {
    activation: Activation,
    z: &'a mut [f32],
}

impl AnyWidth for Activate<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(self) {
        for part in self.z.chunks_exact_mut(R::LANES) {
            let z = R::read(part);
            value(self.activation, z).write(part);
        }
    }
}

#[inline(always)]
fn value<R: Real>(activation: Activation, z: R) -> R {
    match activation {
        // eˣ − 1 ≥ x, so the larger one is ELU. `max` gives its second operand where either is NaN.
        Activation::Elu => (z.min(R::zero()).exp() - R::one()).max(z),
        Activation::Swish => z * logistic(z),
        // 2σ(2z) − 1; the last term is 0, and NaN where z is.
        Activation::Tanh => logistic(z + z).mul_add(R::splat(2.0), -R::one()) + z * R::zero(),
        Activation::Relu => R::zero().max(z),
    }
}

#[inline(always)]
fn logistic<R: Real>(z: R) -> R {
    R::one() / (R::one() + (-z).exp())
}

struct ActivateFolded<'a> {
    activation: Activation,
    part: usize,
    z: &'a mut [f32],
}

impl AnyWidth for ActivateFolded<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(self) {
        let half = R::splat(0.5);
        for row in self.z.chunks_exact_mut(2 * self.part) {
            let (even, odd) = row.split_at_mut(self.part);
            let pairs = even.chunks_exact_mut(R::LANES);
            for (even, odd) in pairs.zip(odd.chunks_exact_mut(R::LANES)) {
                let (e, o) = (R::read(even), R::read(odd));
                let (one, other) = (value(self.activation, e + o), value(self.activation, e - o));
                (half * (one + other)).write(even);
                (half * (one - other)).write(odd);
            }
        }
    }
}

struct ActivationGradient<'a> {
    activation: Activation,
    h: &'a [f32],
    gradient: &'a mut [f32],
}

impl AnyWidth for ActivationGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(self) {
        let parts = self.gradient.chunks_exact_mut(R::LANES);
        for (part, h) in parts.zip(self.h.chunks_exact(R::LANES)) {
            let (g, h) = (R::read(part), R::read(h));
            (g * slope(self.activation, h)).write(part);
        }
    }
}

struct FoldedActivationGradient<'a> {
    activation: Activation,
    part: usize,
    h: &'a [f32],
    gradient: &'a mut [f32],
}

impl AnyWidth for FoldedActivationGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn run<R: Lanes<Elem = f32>>(self) {
        let half = R::splat(0.5);
        let rows = self.gradient.chunks_exact_mut(2 * self.part);
        for (row, h) in rows.zip(self.h.chunks_exact(2 * self.part)) {
            let (even, odd) = row.split_at_mut(self.part);
            let (h_even, h_odd) = h.split_at(self.part);
            let parts = even.chunks_exact_mut(R::LANES);
            let parts = parts.zip(odd.chunks_exact_mut(R::LANES));
            let seen = h_even.chunks_exact(R::LANES);
            let seen = seen.zip(h_odd.chunks_exact(R::LANES));
            for ((even, odd), (h_even, h_odd)) in parts.zip(seen) {
                let (e, o) = (R::read(even), R::read(odd));
                let (h_even, h_odd) = (R::read(h_even), R::read(h_odd));
                // Each of a pair has half of what both parts have after it, and gives all to both before it.
                let one = half * (e + o) * slope(self.activation, h_even + h_odd);
                let other = half * (e - o) * slope(self.activation, h_even - h_odd);
                (one + other).write(even);
                (one - other).write(odd);
            }
        }
    }
}

/// Slope of the non-linearity, from its value, or with [`Activation::Swish`] from where it is taken.
#[inline(always)]
fn slope<R: Real>(activation: Activation, h: R) -> R {
    match activation {
        Activation::Elu => h.min(R::zero()) + R::one(),
        Activation::Swish => {
            let s = logistic(h);
            s * (h * (R::one() - s) + R::one())
        }
        Activation::Tanh => R::one() - h * h,
        Activation::Relu => R::select(R::zero().lt(h), R::one(), R::zero()),
    }
}

#[cfg(test)]
mod tests;
