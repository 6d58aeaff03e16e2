//! One lane: `f32` and `f64`.

use super::{Kernel, Lanes};
use crate::real::Real;

macro_rules! one_lane {
    ($float:ty) => {
        impl Lanes for $float {
            type Elem = $float;

            #[inline(always)]
            fn elem(value: f64) -> $float {
                value as $float
            }
            #[inline(always)]
            fn uniform(value: $float) -> $float {
                value
            }
            #[inline(always)]
            fn read(from: &[f32]) -> $float {
                <$float>::from(from[0])
            }
            #[inline(always)]
            fn write(self, to: &mut [f32]) {
                to[0] = self as f32;
            }
            #[inline(always)]
            fn gather(table: &[f32], index: $float) -> $float {
                let last = table.len().saturating_sub(1);
                table
                    .get((index as usize).min(last))
                    .map_or(<$float>::zero(), |&v| <$float>::from(v))
            }
            fn run<K: Kernel>(kernel: K) -> K::Output {
                kernel.run()
            }
        }
    };
}

one_lane!(f32);
one_lane!(f64);
