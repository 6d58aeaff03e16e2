//! NEON, which every aarch64 processor has.
#![allow(unsafe_code)]

use std::arch::aarch64::*;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub, SubAssign};

use super::{Kernel, Lanes};
use crate::real::{Mask, Real};

/// 4 × f32, NEON.
#[derive(Clone, Copy, Debug)]
#[repr(transparent)]
pub struct F32x4(float32x4_t);

/// 4 truth values, all bits of a lane set or none.
#[derive(Clone, Copy, Debug)]
pub struct Mask4(uint32x4_t);

macro_rules! operator {
    ($trait:ident, $method:ident, $intrinsic:ident, $on:ident) => {
        impl $trait for $on {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                // SAFETY: NEON is part of aarch64.
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        }
    };
}

operator!(Add, add, vaddq_f32, F32x4);
operator!(Sub, sub, vsubq_f32, F32x4);
operator!(Mul, mul, vmulq_f32, F32x4);
operator!(Div, div, vdivq_f32, F32x4);
operator!(BitAnd, bitand, vandq_u32, Mask4);
operator!(BitOr, bitor, vorrq_u32, Mask4);

impl Default for F32x4 {
    fn default() -> Self {
        Self::zero()
    }
}
impl PartialEq for F32x4 {
    fn eq(&self, other: &Self) -> bool {
        (0..Self::LANES).all(|i| self.lane(i) == other.lane(i))
    }
}
impl AddAssign for F32x4 {
    #[inline(always)]
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}
impl SubAssign for F32x4 {
    #[inline(always)]
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}
impl Neg for F32x4 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(unsafe { vnegq_f32(self.0) })
    }
}
impl Not for Mask4 {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(unsafe { vmvnq_u32(self.0) })
    }
}
impl Mask for Mask4 {
    #[inline(always)]
    fn any(self) -> bool {
        unsafe { vmaxvq_u32(self.0) != 0 }
    }
    #[inline(always)]
    fn lane(self, lane: usize) -> bool {
        // SAFETY: same size, every bit pattern is valid.
        let all: [u32; 4] = unsafe { std::mem::transmute(self.0) };
        all[lane] != 0
    }
}

impl Real for F32x4 {
    type Mask = Mask4;
    const LANES: usize = 4;

    #[inline(always)]
    fn splat(value: f64) -> Self {
        Self(unsafe { vdupq_n_f32(value as f32) })
    }
    #[inline(always)]
    fn lane(self, lane: usize) -> f64 {
        // SAFETY: same size, every bit pattern is valid.
        let all: [f32; 4] = unsafe { std::mem::transmute(self.0) };
        f64::from(all[lane])
    }
    #[inline(always)]
    fn with_lane(self, lane: usize, value: f64) -> Self {
        // SAFETY: as in `lane`.
        let mut all: [f32; 4] = unsafe { std::mem::transmute(self.0) };
        all[lane] = value as f32;
        Self(unsafe { std::mem::transmute::<[f32; 4], float32x4_t>(all) })
    }
    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self(unsafe { vfmaq_f32(b.0, self.0, a.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { vsqrtq_f32(self.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { vabsq_f32(self.0) })
    }
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self(unsafe { vminnmq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self(unsafe { vmaxnmq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(unsafe { vrndmq_f32(self.0) })
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        super::sin_cos(self)
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let (n, p) = super::exp_parts(self);
        unsafe {
            let power = vaddq_s32(vcvtq_s32_f32(n.0), vdupq_n_s32(127));
            Self(vmulq_f32(
                p.0,
                vreinterpretq_f32_s32(vshlq_n_s32::<23>(power)),
            ))
        }
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(unsafe { vcltq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask4 {
        Mask4(unsafe { vcleq_f32(self.0, other.0) })
    }
    #[inline(always)]
    fn is_finite(self) -> Mask4 {
        self.abs().le(Self::splat(f64::from(f32::MAX)))
    }
    #[inline(always)]
    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        Self(unsafe { vbslq_f32(mask.0, yes.0, no.0) })
    }
}

impl Lanes for F32x4 {
    type Elem = f32;

    #[inline(always)]
    fn elem(value: f64) -> f32 {
        value as f32
    }
    #[inline(always)]
    fn uniform(value: f32) -> Self {
        Self(unsafe { vdupq_n_f32(value) })
    }
    #[inline(always)]
    fn read(from: &[f32]) -> Self {
        let from = &from[..4];
        // SAFETY: the slice has exactly as many values as are read.
        Self(unsafe { vld1q_f32(from.as_ptr()) })
    }
    #[inline(always)]
    fn write(self, to: &mut [f32]) {
        let to = &mut to[..4];
        // SAFETY: the slice has exactly as many values as are written.
        unsafe { vst1q_f32(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn gather(table: &[f32], index: Self) -> Self {
        let mut at = [0.0; 4];
        index.write(&mut at);
        let last = table.len().saturating_sub(1);
        for slot in &mut at {
            *slot = table
                .get((*slot as usize).min(last))
                .copied()
                .unwrap_or(0.0);
        }
        Self::read(&at)
    }
    fn run<K: Kernel>(kernel: K) -> K::Output {
        kernel.run()
    }
}
