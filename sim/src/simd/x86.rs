//! SSE 4.1, AVX2 with FMA, AVX-512.
//!
//! Safety of every `unsafe` here rests on one rule: a value of these types is only ever made while its instructions exist. The batch
//! engine makes them only after [`super::Width::is_available`] said so; the constructors are not reachable from outside this crate's
//! engine otherwise. Pointers are only formed from slices whose length is checked in the line before.
#![allow(unsafe_code)]

use std::arch::x86_64::*;
use std::ops::{Add, AddAssign, BitAnd, BitOr, Div, Mul, Neg, Not, Sub, SubAssign};

use super::{Kernel, Lanes};
use crate::real::{Mask, Real};

macro_rules! operators {
    ($name:ident, $add:ident, $sub:ident, $mul:ident, $div:ident) => {
        impl std::fmt::Debug for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.debug_list()
                    .entries((0..Self::LANES).map(|i| self.lane(i)))
                    .finish()
            }
        }
        impl Default for $name {
            fn default() -> Self {
                Self::zero()
            }
        }
        impl PartialEq for $name {
            fn eq(&self, other: &Self) -> bool {
                (0..Self::LANES).all(|i| self.lane(i) == other.lane(i))
            }
        }
        impl Add for $name {
            type Output = Self;
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                Self(unsafe { $add(self.0, other.0) })
            }
        }
        impl Sub for $name {
            type Output = Self;
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                Self(unsafe { $sub(self.0, other.0) })
            }
        }
        impl Mul for $name {
            type Output = Self;
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                Self(unsafe { $mul(self.0, other.0) })
            }
        }
        impl Div for $name {
            type Output = Self;
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                Self(unsafe { $div(self.0, other.0) })
            }
        }
        impl AddAssign for $name {
            #[inline(always)]
            fn add_assign(&mut self, other: Self) {
                *self = *self + other;
            }
        }
        impl SubAssign for $name {
            #[inline(always)]
            fn sub_assign(&mut self, other: Self) {
                *self = *self - other;
            }
        }
    };
}

/// What of [`Real`] and [`Lanes`] is written alike for all widths.
macro_rules! common_real {
    ($register:ty, $lanes:literal, $set1:ident, $sqrt:ident, $min:ident, $max:ident) => {
        const LANES: usize = $lanes;

        #[inline(always)]
        fn splat(value: f64) -> Self {
            Self(unsafe { $set1(value as f32) })
        }
        #[inline(always)]
        fn lane(self, lane: usize) -> f64 {
            // SAFETY: a vector register and an array of as many f32 have the same size and every bit pattern is valid.
            let all: [f32; $lanes] = unsafe { std::mem::transmute(self.0) };
            f64::from(all[lane])
        }
        #[inline(always)]
        fn with_lane(self, lane: usize, value: f64) -> Self {
            // SAFETY: as in `lane`.
            let mut all: [f32; $lanes] = unsafe { std::mem::transmute(self.0) };
            all[lane] = value as f32;
            Self(unsafe { std::mem::transmute::<[f32; $lanes], $register>(all) })
        }
        #[inline(always)]
        fn sqrt(self) -> Self {
            Self(unsafe { $sqrt(self.0) })
        }
        // The instruction gives its second operand where either is NaN.
        #[inline(always)]
        fn min(self, other: Self) -> Self {
            Self(unsafe { $min(self.0, other.0) })
        }
        #[inline(always)]
        fn max(self, other: Self) -> Self {
            Self(unsafe { $max(self.0, other.0) })
        }
        #[inline(always)]
        fn sin_cos(self) -> (Self, Self) {
            super::sin_cos(self)
        }
        #[inline(always)]
        fn is_finite(self) -> Self::Mask {
            self.abs().le(Self::splat(f64::from(f32::MAX)))
        }
    };
}

macro_rules! common_lanes {
    ($lanes:literal, $set1:ident, $loadu:ident, $storeu:ident, $features:literal) => {
        type Elem = f32;

        #[inline(always)]
        fn elem(value: f64) -> f32 {
            value as f32
        }
        #[inline(always)]
        fn uniform(value: f32) -> Self {
            Self(unsafe { $set1(value) })
        }
        #[inline(always)]
        fn read(from: &[f32]) -> Self {
            let from = &from[..$lanes];
            // SAFETY: the slice has exactly as many values as are read.
            Self(unsafe { $loadu(from.as_ptr()) })
        }
        #[inline(always)]
        fn write(self, to: &mut [f32]) {
            let to = &mut to[..$lanes];
            // SAFETY: the slice has exactly as many values as are written.
            unsafe { $storeu(to.as_mut_ptr(), self.0) }
        }
        #[inline(always)]
        fn run<K: Kernel>(kernel: K) -> K::Output {
            #[target_feature(enable = $features)]
            unsafe fn inner<K: Kernel>(kernel: K) -> K::Output {
                kernel.run()
            }
            // SAFETY: see the top of this file.
            unsafe { inner(kernel) }
        }
    };
}

// ---------------------------------------------------------------------------------------------------------------- 16 lanes

/// 16 × f32, AVX-512.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct F32x16(__m512);

/// 16 truth values.
#[derive(Clone, Copy, Debug)]
pub struct Mask16(__mmask16);

impl BitAnd for Mask16 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }
}
impl BitOr for Mask16 {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}
impl Not for Mask16 {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(!self.0)
    }
}
impl Mask for Mask16 {
    #[inline(always)]
    fn any(self) -> bool {
        self.0 != 0
    }
    #[inline(always)]
    fn lane(self, lane: usize) -> bool {
        self.0 >> lane & 1 == 1
    }
}

operators!(
    F32x16,
    _mm512_add_ps,
    _mm512_sub_ps,
    _mm512_mul_ps,
    _mm512_div_ps
);

impl Neg for F32x16 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(unsafe { _mm512_xor_ps(self.0, _mm512_set1_ps(-0.0)) })
    }
}

impl Real for F32x16 {
    type Mask = Mask16;
    common_real!(
        __m512,
        16,
        _mm512_set1_ps,
        _mm512_sqrt_ps,
        _mm512_min_ps,
        _mm512_max_ps
    );

    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self(unsafe { _mm512_fmadd_ps(self.0, a.0, b.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm512_abs_ps(self.0) })
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(unsafe { _mm512_roundscale_ps::<0x09>(self.0) })
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let (n, p) = super::exp_parts(self);
        Self(unsafe { _mm512_scalef_ps(p.0, n.0) })
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Mask16 {
        Mask16(unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask16 {
        Mask16(unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn select(mask: Mask16, yes: Self, no: Self) -> Self {
        Self(unsafe { _mm512_mask_blend_ps(mask.0, no.0, yes.0) })
    }
}

impl Lanes for F32x16 {
    common_lanes!(
        16,
        _mm512_set1_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        "avx512f,avx512dq,avx512vl,avx512bw,avx2,fma"
    );

    #[inline(always)]
    fn gather(table: &[f32], index: Self) -> Self {
        let Ok(length) = i32::try_from(table.len()) else {
            return Self::zero();
        };
        if length == 0 {
            return Self::zero();
        }
        // SAFETY: every index is clamped into the table (NaN converts to the lowest integer, which the clamp takes to 0).
        unsafe {
            let i = _mm512_cvttps_epi32(index.0);
            let i = _mm512_min_epi32(i, _mm512_set1_epi32(length - 1));
            let i = _mm512_max_epi32(i, _mm512_setzero_si512());
            Self(_mm512_i32gather_ps::<4>(i, table.as_ptr()))
        }
    }
}

// ----------------------------------------------------------------------------------------------------------------- 8 lanes

/// 8 × f32, AVX2 with FMA.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct F32x8(__m256);

/// 8 truth values, all bits of a lane set or none.
#[derive(Clone, Copy, Debug)]
pub struct Mask8(__m256);

impl BitAnd for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(unsafe { _mm256_and_ps(self.0, other.0) })
    }
}
impl BitOr for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(unsafe { _mm256_or_ps(self.0, other.0) })
    }
}
impl Not for Mask8 {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(unsafe { _mm256_xor_ps(self.0, _mm256_castsi256_ps(_mm256_set1_epi32(-1))) })
    }
}
impl Mask for Mask8 {
    #[inline(always)]
    fn any(self) -> bool {
        unsafe { _mm256_movemask_ps(self.0) != 0 }
    }
    #[inline(always)]
    fn lane(self, lane: usize) -> bool {
        unsafe { _mm256_movemask_ps(self.0) >> lane & 1 == 1 }
    }
}

operators!(
    F32x8,
    _mm256_add_ps,
    _mm256_sub_ps,
    _mm256_mul_ps,
    _mm256_div_ps
);

impl Neg for F32x8 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(unsafe { _mm256_xor_ps(self.0, _mm256_set1_ps(-0.0)) })
    }
}

impl Real for F32x8 {
    type Mask = Mask8;
    common_real!(
        __m256,
        8,
        _mm256_set1_ps,
        _mm256_sqrt_ps,
        _mm256_min_ps,
        _mm256_max_ps
    );

    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        Self(unsafe { _mm256_fmadd_ps(self.0, a.0, b.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(unsafe { _mm256_floor_ps(self.0) })
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let (n, p) = super::exp_parts(self);
        unsafe {
            let power = _mm256_add_epi32(_mm256_cvttps_epi32(n.0), _mm256_set1_epi32(127));
            Self(_mm256_mul_ps(
                p.0,
                _mm256_castsi256_ps(_mm256_slli_epi32::<23>(power)),
            ))
        }
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Mask8 {
        Mask8(unsafe { _mm256_cmp_ps::<_CMP_LT_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask8 {
        Mask8(unsafe { _mm256_cmp_ps::<_CMP_LE_OQ>(self.0, other.0) })
    }
    #[inline(always)]
    fn select(mask: Mask8, yes: Self, no: Self) -> Self {
        Self(unsafe { _mm256_blendv_ps(no.0, yes.0, mask.0) })
    }
}

impl Lanes for F32x8 {
    common_lanes!(
        8,
        _mm256_set1_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        "avx2,fma"
    );

    #[inline(always)]
    fn gather(table: &[f32], index: Self) -> Self {
        let Ok(length) = i32::try_from(table.len()) else {
            return Self::zero();
        };
        if length == 0 {
            return Self::zero();
        }
        // SAFETY: every index is clamped into the table.
        unsafe {
            let i = _mm256_cvttps_epi32(index.0);
            let i = _mm256_min_epi32(i, _mm256_set1_epi32(length - 1));
            let i = _mm256_max_epi32(i, _mm256_setzero_si256());
            Self(_mm256_i32gather_ps::<4>(table.as_ptr(), i))
        }
    }
}

// ----------------------------------------------------------------------------------------------------------------- 4 lanes

/// 4 × f32, SSE 4.1. Without fused multiply-add.
#[derive(Clone, Copy)]
#[repr(transparent)]
pub struct F32x4(__m128);

/// 4 truth values, all bits of a lane set or none.
#[derive(Clone, Copy, Debug)]
pub struct Mask4(__m128);

impl BitAnd for Mask4 {
    type Output = Self;
    #[inline(always)]
    fn bitand(self, other: Self) -> Self {
        Self(unsafe { _mm_and_ps(self.0, other.0) })
    }
}
impl BitOr for Mask4 {
    type Output = Self;
    #[inline(always)]
    fn bitor(self, other: Self) -> Self {
        Self(unsafe { _mm_or_ps(self.0, other.0) })
    }
}
impl Not for Mask4 {
    type Output = Self;
    #[inline(always)]
    fn not(self) -> Self {
        Self(unsafe { _mm_xor_ps(self.0, _mm_castsi128_ps(_mm_set1_epi32(-1))) })
    }
}
impl Mask for Mask4 {
    #[inline(always)]
    fn any(self) -> bool {
        unsafe { _mm_movemask_ps(self.0) != 0 }
    }
    #[inline(always)]
    fn lane(self, lane: usize) -> bool {
        unsafe { _mm_movemask_ps(self.0) >> lane & 1 == 1 }
    }
}

operators!(F32x4, _mm_add_ps, _mm_sub_ps, _mm_mul_ps, _mm_div_ps);

impl Neg for F32x4 {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(unsafe { _mm_xor_ps(self.0, _mm_set1_ps(-0.0)) })
    }
}

impl Real for F32x4 {
    type Mask = Mask4;
    common_real!(__m128, 4, _mm_set1_ps, _mm_sqrt_ps, _mm_min_ps, _mm_max_ps);

    #[inline(always)]
    fn mul_add(self, a: Self, b: Self) -> Self {
        self * a + b
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm_andnot_ps(_mm_set1_ps(-0.0), self.0) })
    }
    #[inline(always)]
    fn floor(self) -> Self {
        Self(unsafe { _mm_floor_ps(self.0) })
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let (n, p) = super::exp_parts(self);
        unsafe {
            let power = _mm_add_epi32(_mm_cvttps_epi32(n.0), _mm_set1_epi32(127));
            Self(_mm_mul_ps(
                p.0,
                _mm_castsi128_ps(_mm_slli_epi32::<23>(power)),
            ))
        }
    }
    #[inline(always)]
    fn lt(self, other: Self) -> Mask4 {
        Mask4(unsafe { _mm_cmplt_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn le(self, other: Self) -> Mask4 {
        Mask4(unsafe { _mm_cmple_ps(self.0, other.0) })
    }
    #[inline(always)]
    fn select(mask: Mask4, yes: Self, no: Self) -> Self {
        Self(unsafe { _mm_blendv_ps(no.0, yes.0, mask.0) })
    }
}

impl Lanes for F32x4 {
    common_lanes!(4, _mm_set1_ps, _mm_loadu_ps, _mm_storeu_ps, "sse4.1");

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
}
