//! Networks that treat left and right alike by construction.
//!
//! A mirror exchanges and negates observations and actions ([`Mirror`]); in a hidden layer of n units, unit i
//! changes places with unit n − 1 − i. Where every layer W commutes with that (M_out·W = W·M_in, M_out·b =
//! b), so does the network: policy(mirror(o)) = mirror(policy(o)), value(mirror(o)) = value(o). With two
//! halves of hidden units that is a network of half the width and its mirror image, folded into one
//! (Abdolhosseini et al. 2019, "On learning symmetric locomotion", call it a symmetric network); its shape is
//! that of any other, in files too.
//!
//! Parameters are kept in full. Those that must be alike, up to a sign, begin alike and have the mean of
//! their gradients, with which Adam moves them alike. It costs one pass per minibatch; a gradient that is
//! averaged so is that of the minibatch and of its mirror image together.

use caudata_task::Mirror;
use caudata_task::mirror::SignedPermutation;

use super::layout::Layout;
use super::mlp::{Indices, LayerIndices};

/// How far parameters that ought to be alike may be apart, as a share of their size (or of 1): rounding of a
/// long training.
const ALIKE: f32 = 1e-3;

/// Which parameters of a flat vector mirror each other: where the counterpart of each lies, and 1 or −1.
#[derive(Clone, Debug)]
pub(super) struct Symmetry(pub(super) SignedPermutation);

impl Symmetry {
    /// `policy` and `value` are the mirror at the sides of their layers ([`caudata_task::mirror::sides`]).
    pub fn new(
        mirror: &Mirror,
        [policy, value]: [&[SignedPermutation]; 2],
        layout: &Layout,
        indices: &Indices,
    ) -> Self {
        let mut all = SignedPermutation::identity(layout.len());
        let offset = |index: usize| layout.parameters()[index].offset;
        let mut place = |layers: &LayerIndices, sides: &[SignedPermutation]| {
            for (&(weight, bias), pair) in layers.iter().zip(sides.windows(2)) {
                let (input, output) = (&pair[0], &pair[1]);
                for (o, (&from, sign)) in output.source.iter().zip(&output.sign).enumerate() {
                    let row = offset(weight) + o * input.len();
                    let from_row = offset(weight) + from * input.len();
                    for i in 0..input.len() {
                        all.source[row + i] = from_row + input.source[i];
                        all.sign[row + i] = sign * input.sign[i];
                    }
                    all.source[offset(bias) + o] = offset(bias) + from;
                    all.sign[offset(bias) + o] = *sign;
                }
            }
        };
        place(&indices.policy, policy);
        place(&indices.value, value);
        let raw = offset(indices.raw_log_std);
        for (i, from) in mirror.action.source.iter().enumerate() {
            all.source[raw + i] = raw + from;
        }
        Self(all)
    }

    /// The symmetric part of `values` `[P]`: the mean of each and its counterpart. Exactly symmetric, to the
    /// bit.
    pub fn part_of(&self, values: &[f32]) -> Vec<f32> {
        let counterparts = self.0.source.iter().zip(&self.0.sign);
        let mean =
            |(value, (&from, sign)): (&f32, (&usize, &f32))| 0.5 * (value + sign * values[from]);
        values.iter().zip(counterparts).map(mean).collect()
    }

    /// Whether `values` `[P]` are those of a symmetric network; what is not finite is somebody else's business.
    pub fn holds_for(&self, values: &[f32]) -> bool {
        let part = self.part_of(values);
        let apart =
            |(part, value): (&f32, &f32)| (part - value).abs() > ALIKE * value.abs().max(1.0);
        !part.iter().zip(values).any(apart)
    }
}
