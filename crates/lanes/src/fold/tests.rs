//! Folded networks against what the plain formulas give.

use super::*;
use crate::dense::Activation;
use crate::perceptron::{Inputs, Perceptron, Tape, normalise};

/// Exchanges the first two, negates the third, leaves the fourth.
fn hand() -> Side {
    Side::new(&[1, 0, 2, 3], &[1.0, 1.0, -1.0, 1.0])
}

#[test]
fn a_layer_by_hand() {
    // The mirror of (a, b, c, d) is (b, a, −c, d), that of the outputs (y, z) is (−z, −y). A layer that commutes
    // has rows (p, q, r, s) and (−q, −p, r, −s).
    let (input, output) = (hand(), Side::new(&[1, 0], &[-1.0, -1.0]));
    let weight = [1.0, 2.0, 3.0, 4.0, -2.0, -1.0, 3.0, -4.0];
    // Even inputs: pair, fourth; odd inputs: pair, third. p + q = 3, s = 4; p − q = −1, r = 3.
    let [even, odd] = fold_weights(&weight, &output, &input);
    assert_eq!((even, odd), (vec![3.0, 4.0], vec![-1.0, 3.0]));
    let mut net = Perceptron::new(vec![input.clone(), output.clone()], Activation::Elu);
    net.pack(0, &weight, &[0.5, -0.5], true);
    let mut seen = vec![0.0; input.width()];
    let raw = [1.0, 5.0, 7.0, 2.0];
    normalise(&raw, (&[0.0; 4], &[1.0; 4], 9.0), &input, &mut seen);
    // ½(1 + 5), 2; ½(1 − 5), 7
    assert_eq!((&seen[..2], &seen[16..18]), (&[3.0, 2.0][..], &[-2.0, 7.0][..]));
    let x = Inputs { rows: 1, values: &seen, side: &input };
    let mut tape = Tape::default();
    let folded = net.forward(x, &mut tape, &mut |_| ());
    let mut row = [f32::NAN; 2];
    output.unfold(folded, &mut row);
    // 1 + 10 + 21 + 8 + ½; −2 − 5 + 21 − 8 − ½
    assert_eq!(row, [40.5, 5.5]);
    // Of a loss with slopes (2, 1): of the weights (2, 10, 14, 4) and (1, 5, 7, 2), of the biases (2, 1). The mean
    // of tied ones: ½(2 − 5), ½(10 − 1), ½(14 + 7), ½(4 − 2); ½(2 − 1).
    tape.fill_gradients(&output, |_, _, gradient| gradient.copy_from_slice(&[2.0, 1.0]));
    let mut gradient = vec![f32::NAN; net.gradient_len()];
    net.backward(x, &mut tape, &mut gradient, &mut |_| ());
    let (mut weight, mut bias) = ([f32::NAN; 8], [f32::NAN; 2]);
    net.unfold_gradient(0, &gradient, &mut weight, &mut bias);
    assert_eq!(weight, [-1.5, 4.5, 10.5, 1.0, -4.5, 1.5, 10.5, -1.0]);
    assert_eq!(bias, [0.5, -0.5]);
}

/// Numbers without a pattern, within ±1.
fn numbers(count: usize, seed: f32) -> Vec<f32> {
    (0..count).map(|i| (37.7 * (i as f32 + seed)).sin()).collect()
}

/// The mean of `weight` `[out, in]` and its image.
fn commuting(weight: &[f32], output: (&[usize], &[f32]), input: (&[usize], &[f32])) -> Vec<f32> {
    let width = input.0.len();
    let each = (0..weight.len()).map(|at| {
        let (o, i) = (at / width, at % width);
        let sign = output.1[o] * input.1[i];
        0.5 * (weight[at] + sign * weight[output.0[o] * width + input.0[i]])
    });
    each.collect()
}

/// Every shape of side: pairs with units of their own, an odd number of hidden units, nothing even, nothing odd.
#[test]
fn a_folded_network_is_the_plain_one() {
    let hidden: Vec<usize> = (0..33).rev().collect();
    for (source, sign) in [
        (vec![0, 1], vec![-1.0, -1.0]),
        (vec![1, 0], vec![1.0, 1.0]),
        (vec![0], vec![1.0]),
        (vec![2, 1, 0], vec![-1.0, 1.0, -1.0]),
    ] {
        for activation in [Activation::Elu, Activation::Swish, Activation::Tanh, Activation::Relu] {
            let input = (&[1, 0, 2, 3][..], &[1.0, 1.0, -1.0, 1.0][..]);
            let middle = (&hidden[..], &[1.0; 33][..]);
            let output = (&source[..], &sign[..]);
            let sides = [input, middle, middle, output];
            let folded = sides.map(|(source, sign)| Side::new(source, sign)).to_vec();
            let plain = folded.iter().map(|side| Side::plain(side.len())).collect();
            let mut nets = [folded, plain].map(|sides| Perceptron::new(sides, activation));
            for (at, pair) in sides.windows(2).enumerate() {
                let (input, output) = (pair[0], pair[1]);
                let count = output.0.len();
                let weight = numbers(count * input.0.len(), at as f32);
                let weight = commuting(&weight, output, input);
                let bias = commuting(&numbers(count, 5.0), output, (&[0], &[1.0]));
                nets.iter_mut().for_each(|net| net.pack(at, &weight, &bias, true));
            }
            let rows = 7;
            let raw = numbers(rows * 4, 9.0);
            let found = nets.each_ref().map(|net| outputs_and_gradients(net, &raw, rows));
            let near = |a: &[f32], b: &[f32]| {
                let off = a.iter().zip(b).map(|(a, b)| (a - b).abs());
                let off = off.fold(0.0, f32::max);
                assert!(a.len() == b.len() && off < 1e-4, "{activation:?} {sign:?}: {off}");
            };
            near(&found[0].0, &found[1].0);
            for (at, pair) in sides.windows(2).enumerate() {
                let (weight, bias) = &found[1].1[at];
                let (input, output) = (pair[0], pair[1]);
                near(&found[0].1[at].0, &commuting(weight, output, input));
                near(&found[0].1[at].1, &commuting(bias, output, (&[0], &[1.0])));
                // tied to the bit
                let own = &found[0].1[at].0;
                assert_eq!(*own, commuting(own, output, input));
            }
        }
    }
}

/// Outputs, and gradients of each layer for slopes that are no mirror images of each other.
#[expect(clippy::type_complexity, reason = "two lists")]
fn outputs_and_gradients(
    net: &Perceptron,
    raw: &[f32],
    rows: usize,
) -> (Vec<f32>, Vec<(Vec<f32>, Vec<f32>)>) {
    let side = net.input();
    let mut values = vec![0.0; rows * side.width()];
    normalise(raw, (&[0.1; 4], &[0.5; 4], 3.0), side, &mut values);
    let x = Inputs { rows, values: &values, side };
    let (mut tape, mut outputs, mut layers) = (Tape::default(), Vec::new(), Vec::new());
    // twice: what is left of the first pass must not show
    for _ in 0..2 {
        net.forward(x, &mut tape, &mut |_| ());
        outputs.clear();
        tape.fill_gradients(net.output(), |at, row, gradient| {
            outputs.extend_from_slice(row);
            gradient.copy_from_slice(&numbers(row.len(), at as f32 + 0.3));
        });
        let mut gradient = vec![f32::NAN; net.gradient_len()];
        net.backward(x, &mut tape, &mut gradient, &mut |_| ());
        let sizes = [4, 33, 33, net.output().len()];
        layers.clear();
        layers.extend(sizes.windows(2).enumerate().map(|(at, pair)| {
            let mut weight = vec![f32::NAN; pair[0] * pair[1]];
            let mut bias = vec![f32::NAN; pair[1]];
            net.unfold_gradient(at, &gradient, &mut weight, &mut bias);
            (weight, bias)
        }));
    }
    (outputs, layers)
}
