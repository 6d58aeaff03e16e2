//! Products against the plain sums, gradients against differences.

use super::*;
use crate::simd::Kernel;

/// Numbers without a pattern, within ±1.
fn numbers(count: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        f64::from(state) / f64::from(u32::MAX)
    };
    (0..count).map(|_| (2.0 * next() - 1.0) as f32).collect()
}

/// `[rows, width]` with rows padded.
fn rows_of(values: &[f32], width: usize) -> Vec<f32> {
    let pad = vec![0.0; padded(width) - width];
    values.chunks_exact(width).flat_map(|row| [row, &pad].concat()).collect()
}

fn layer(inputs: usize, outputs: usize) -> (Dense, Vec<f32>, Vec<f32>) {
    let (weight, bias) = (numbers(inputs * outputs, 1), numbers(outputs, 2));
    let mut dense = Dense::default();
    dense.pack(inputs, &weight, &bias, true);
    (dense, weight, bias)
}

fn near(found: f32, expected: f64, what: &str) {
    let off = (f64::from(found) - expected).abs();
    assert!(off <= 1e-5 * expected.abs().max(1.0), "{what}: {found} instead of {expected}");
}

#[test]
fn layers_and_their_gradients_are_the_plain_sums() {
    for (inputs, outputs, rows) in [(97, 128, 13), (128, 16, 7), (33, 1, 6), (1, 1, 1), (16, 50, 2)]
    {
        let (dense, weight, bias) = layer(inputs, outputs);
        let (x, dy) = (numbers(rows * inputs, 3), numbers(rows * outputs, 4));
        let (wide_x, wide_dy) = (rows_of(&x, inputs), rows_of(&dy, outputs));
        let mut y = vec![f32::NAN; rows * padded(outputs)];
        let lie = Rows { count: rows, input: padded(inputs), output: padded(outputs) };
        dense.forward(lie, &wide_x, &mut y);
        let mut dx = vec![f32::NAN; rows * padded(inputs)];
        dense.input_gradient(lie, &wide_dy, &mut dx);
        let mut dw = vec![f32::NAN; outputs * padded(inputs)];
        let mut db = vec![f32::NAN; outputs];
        dense.weight_gradient(lie, &wide_dy, &wide_x, &mut dw);
        dense.bias_gradient(lie, &wide_dy, &mut db);

        let at = |values: &[f32], i: usize| f64::from(values[i]);
        for r in 0..rows {
            for o in 0..padded(outputs) {
                let sum = |o| {
                    (0..inputs)
                        .map(|i| at(&weight, o * inputs + i) * at(&x, r * inputs + i))
                        .sum::<f64>()
                };
                let expected = if o < outputs { at(&bias, o) + sum(o) } else { 0.0 };
                near(y[r * padded(outputs) + o], expected, "output");
            }
            for i in 0..inputs {
                let sum: f64 = (0..outputs)
                    .map(|o| at(&dy, r * outputs + o) * at(&weight, o * inputs + i))
                    .sum();
                near(dx[r * padded(inputs) + i], sum, "gradient of an input");
            }
        }
        for o in 0..outputs {
            for i in 0..inputs {
                let sum: f64 =
                    (0..rows).map(|r| at(&dy, r * outputs + o) * at(&x, r * inputs + i)).sum();
                near(dw[o * padded(inputs) + i], sum, "gradient of a weight");
            }
            near(db[o], (0..rows).map(|r| at(&dy, r * outputs + o)).sum(), "gradient of a bias");
        }
    }
}

#[test]
fn a_row_gets_alone_what_it_gets_in_a_batch() {
    let (dense, _, _) = layer(97, 128);
    let x = rows_of(&numbers(13 * 97, 5), 97);
    let (mut together, mut alone) = (vec![0.0; 13 * 128], vec![0.0; 128]);
    let lie = |count| Rows { count, input: padded(97), output: 128 };
    dense.forward(lie(13), &x, &mut together);
    for (row, expected) in x.chunks_exact(padded(97)).zip(together.chunks_exact(128)) {
        dense.forward(lie(1), row, &mut alone);
        assert_eq!(alone, expected);
    }
}

#[test]
fn non_linearities_are_their_formulas_and_gradients_their_slopes() {
    let z: Vec<f32> = (0..64).map(|i| 0.17 * (i as f32 - 31.5)).collect();
    let formula = |activation, x: f64| match activation {
        Activation::Elu => {
            if x > 0.0 {
                x
            } else {
                x.exp_m1()
            }
        }
        Activation::Swish => x / (1.0 + (-x).exp()),
        Activation::Tanh => x.tanh(),
        Activation::Relu => x.max(0.0),
    };
    for activation in [Activation::Elu, Activation::Swish, Activation::Tanh, Activation::Relu] {
        let mut h = z.clone();
        activate(activation, &mut h);
        let mut slope = vec![1.0; z.len()];
        let kept = if activation == Activation::Swish { &z } else { &h };
        activation_gradient(activation, kept, &mut slope);
        for i in 0..z.len() {
            let x = f64::from(z[i]);
            near(h[i], formula(activation, x), "value");
            let difference = formula(activation, x + 1e-6) - formula(activation, x - 1e-6);
            assert!(
                (f64::from(slope[i]) - difference / 2e-6).abs() < 1e-4,
                "{activation:?} at {x}: {}",
                slope[i]
            );
        }
        let mut nan = [f32::NAN; 16];
        activate(activation, &mut nan);
        assert!(nan.iter().all(|x| x.is_nan()), "{activation:?} hides what is not a number");
    }
}

/// A product at the width of `R`.
struct At<R>(std::marker::PhantomData<R>);

impl<R: Lanes<Elem = f32>> Kernel for At<R> {
    type Output = Vec<f32>;
    #[inline(always)]
    fn run(self) -> Vec<f32> {
        let (dense, _, _) = layer(40, 48);
        let x = rows_of(&numbers(9 * 40, 6), 40);
        let mut y = vec![0.0; 9 * 48];
        Product {
            left: Left::Rows { values: &x, stride: 48 },
            right: &dense.by_output,
            right_stride: BLOCK,
            block_stride: 40 * BLOCK,
            inner: 40,
            start: &dense.bias,
            rows: 9,
            columns: 48,
            out: &mut y,
            out_stride: 48,
        }
        .run::<R>();
        y
    }
}

#[cfg(target_arch = "x86_64")]
#[test]
fn sixteen_and_eight_lanes_give_the_same_bits() {
    use crate::simd::{F32x8, F32x16, Width};
    if Width::Sixteen.is_available() {
        let (wide, narrow) = (
            F32x16::run(At::<F32x16>(Default::default())),
            F32x8::run(At::<F32x8>(Default::default())),
        );
        assert_eq!(wide, narrow);
    }
}
