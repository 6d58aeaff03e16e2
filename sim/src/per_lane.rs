//! Structs of per-lane numbers: written and read one lane at a time, computed with all lanes at once.

use crate::real::Real;

/// Something that holds one `One` per lane.
pub trait PerLane<One> {
    /// The same in every lane.
    fn splat(one: &One) -> Self;
    /// Replaces lane `lane`.
    fn set_lane(&mut self, lane: usize, one: &One);
    /// What lane `lane` holds.
    fn lane(&self, lane: usize) -> One;
}

impl<R: Real> PerLane<f64> for R {
    #[inline(always)]
    fn splat(one: &f64) -> Self {
        <R as Real>::splat(*one)
    }
    #[inline(always)]
    fn set_lane(&mut self, lane: usize, one: &f64) {
        *self = self.with_lane(lane, *one);
    }
    #[inline(always)]
    fn lane(&self, lane: usize) -> f64 {
        Real::lane(*self, lane)
    }
}

impl<R: Real> PerLane<[f64; 3]> for [R; 3] {
    #[inline(always)]
    fn splat(one: &[f64; 3]) -> Self {
        one.map(<R as Real>::splat)
    }
    #[inline(always)]
    fn set_lane(&mut self, lane: usize, one: &[f64; 3]) {
        for (all, one) in self.iter_mut().zip(one) {
            *all = all.with_lane(lane, *one);
        }
    }
    #[inline(always)]
    fn lane(&self, lane: usize) -> [f64; 3] {
        [0, 1, 2].map(|i| Real::lane(self[i], lane))
    }
}

/// Declares a struct generic over [`Real`], each field `R` or `[R; 3]`, with [`PerLane`] between it and its
/// one-lane `f64` form.
macro_rules! per_lane {
    ($(#[$meta:meta])* pub struct $name:ident<R> { $($(#[$field_meta:meta])* pub $field:ident: $kind:ty,)+ }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
        pub struct $name<R> {
            $($(#[$field_meta])* pub $field: $kind,)+
        }

        impl<R: $crate::real::Real> $crate::per_lane::PerLane<$name<f64>> for $name<R> {
            fn splat(one: &$name<f64>) -> Self {
                Self { $($field: $crate::per_lane::PerLane::splat(&one.$field),)+ }
            }
            fn set_lane(&mut self, lane: usize, one: &$name<f64>) {
                $($crate::per_lane::PerLane::set_lane(&mut self.$field, lane, &one.$field);)+
            }
            fn lane(&self, lane: usize) -> $name<f64> {
                $name { $($field: $crate::per_lane::PerLane::lane(&self.$field, lane),)+ }
            }
        }
    };
}
pub(crate) use per_lane;

#[cfg(test)]
mod tests {
    use super::*;

    per_lane! {
        /// A pair.
        pub struct Pair<R> {
            /// One number.
            pub one: R,
            /// Three numbers.
            pub three: [R; 3],
        }
    }

    #[test]
    fn goes_in_and_comes_out() {
        let mut wide: Pair<f32> = PerLane::splat(&Pair { one: 1.5, three: [1.0, 2.0, 3.0] });
        assert_eq!(wide.three, [1.0_f32, 2.0, 3.0]);
        let other = Pair { one: -2.0, three: [0.5, 0.25, 0.125] };
        wide.set_lane(0, &other);
        assert_eq!(wide.lane(0), other);
    }
}
