//! The number type that physics is written over, so that one source serves one robot or sixteen side by side.
//!
//! [`Real`] is one value per lane: `f64` (the reference) and `f32` are one lane, the batch engine adds
//! vectors of 4, 8 and 16. Code over it has no branch that depends on a value: both sides are computed and
//! [`Real::select`] takes one.

use std::fmt::Debug;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub, SubAssign};

/// A truth value per lane.
pub trait Mask:
    Copy + Debug + BitAnd<Output = Self> + BitOr<Output = Self> + Not<Output = Self>
{
    /// Whether any lane is true.
    fn any(self) -> bool;
    /// Whether lane `lane` is true.
    fn lane(self, lane: usize) -> bool;
}

/// A number per lane.
pub trait Real:
    Copy
    + Debug
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// What comparisons give.
    type Mask: Mask;
    /// Number of lanes.
    const LANES: usize;

    /// The same value in every lane.
    fn splat(value: f64) -> Self;
    /// Value of lane `lane`.
    fn lane(self, lane: usize) -> f64;
    /// With lane `lane` replaced.
    fn with_lane(self, lane: usize, value: f64) -> Self;
    /// `self · a + b`, rounded once or twice, whichever is faster here.
    fn mul_add(self, a: Self, b: Self) -> Self;
    /// Square root.
    fn sqrt(self) -> Self;
    /// Absolute value.
    fn abs(self) -> Self;
    /// The smaller one; the other where one is NaN.
    fn min(self, other: Self) -> Self;
    /// The larger one; the other where one is NaN.
    fn max(self, other: Self) -> Self;
    /// The largest whole number not above.
    fn floor(self) -> Self;
    /// Sine and cosine of an angle in rad.
    fn sin_cos(self) -> (Self, Self);
    /// e to the power of `self`.
    fn exp(self) -> Self;
    /// `self < other`.
    fn lt(self, other: Self) -> Self::Mask;
    /// `self <= other`.
    fn le(self, other: Self) -> Self::Mask;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> Self::Mask;
    /// `yes` where `mask` is true, `no` elsewhere.
    fn select(mask: Self::Mask, yes: Self, no: Self) -> Self;

    /// 0.
    #[inline(always)]
    fn zero() -> Self {
        Self::splat(0.0)
    }

    /// 1.
    #[inline(always)]
    fn one() -> Self {
        Self::splat(1.0)
    }

    /// The nearest value within `low..=high`.
    #[inline(always)]
    fn clamp(self, low: Self, high: Self) -> Self {
        self.max(low).min(high)
    }

    /// −1, 0 or 1.
    #[inline(always)]
    fn signum0(self) -> Self {
        let positive = Self::select(Self::zero().lt(self), Self::one(), Self::zero());
        Self::select(self.lt(Self::zero()), -Self::one(), positive)
    }
}

impl Mask for bool {
    #[inline(always)]
    fn any(self) -> bool {
        self
    }
    #[inline(always)]
    fn lane(self, _lane: usize) -> bool {
        self
    }
}

macro_rules! one_lane {
    (@own $float:ty; $($method:ident($($other:ident)?) -> $out:ty;)+) => {
        $(#[inline(always)]
        fn $method(self $(, $other: Self)?) -> $out {
            <$float>::$method(self $(, $other)?)
        })+
    };
    ($float:ty) => {
        impl Real for $float {
            type Mask = bool;
            const LANES: usize = 1;

            one_lane!(@own $float;
                sqrt() -> Self;
                abs() -> Self;
                min(other) -> Self;
                max(other) -> Self;
                floor() -> Self;
                sin_cos() -> (Self, Self);
                exp() -> Self;
                is_finite() -> bool;
            );
            #[inline(always)]
            fn splat(value: f64) -> Self {
                value as $float
            }
            #[inline(always)]
            fn lane(self, _lane: usize) -> f64 {
                f64::from(self)
            }
            #[inline(always)]
            fn with_lane(self, _lane: usize, value: f64) -> Self {
                value as $float
            }
            #[inline(always)]
            fn mul_add(self, a: Self, b: Self) -> Self {
                // Two roundings: a fused one is a call into the C library where the target has no such
                // instruction.
                self * a + b
            }
            #[inline(always)]
            fn lt(self, other: Self) -> bool {
                self < other
            }
            #[inline(always)]
            fn le(self, other: Self) -> bool {
                self <= other
            }
            #[inline(always)]
            fn select(mask: bool, yes: Self, no: Self) -> Self {
                if mask { yes } else { no }
            }
        }
    };
}

one_lane!(f32);
one_lane!(f64);

#[cfg(test)]
mod tests {
    use super::*;

    fn formula<R: Real>(x: R) -> R {
        // |x| − 2 held within 0..=1, times the sign of x
        (x.abs() - R::splat(2.0)).clamp(R::zero(), R::one()) * x.signum0()
    }

    #[test]
    fn one_source_for_both_precisions() {
        for (x, want) in [(0.0, 0.0), (1.5, 0.0), (-2.25, -0.25), (7.0, 1.0)] {
            assert_eq!(formula::<f64>(x), want);
            assert_eq!(formula::<f32>(x as f32), want as f32);
        }
    }
}
