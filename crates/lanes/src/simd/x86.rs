//! SSE 4.1, AVX2 with FMA, AVX-512.
//!
//! Safety of every `unsafe` here rests on one rule: a value of these types is only ever made while its
//! instructions exist. [`super::widest`] and the batch engine make them only after
//! [`super::Width::is_available`] said so, and nothing else may. Pointers are only formed from slices whose length
//! is checked in the line before.
//!
//! `min` and `max` give their second operand where either is NaN.
#![allow(unsafe_code, unused_unsafe)] // which intrinsics are unsafe to call is another matter for each instruction set

use std::arch::x86_64::*;

use super::table::vector;
use super::{Kernel, Lanes, gather_one_by_one};
use crate::real::{Mask, Real};

vector! {
    /// 16 × f32, AVX-512.
    F32x16(__m512; 16);
    /// 16 truth values.
    Mask16(__mmask16);
    features "avx512f,avx512dq,avx512vl,avx512bw,avx2,fma";
    binary _mm512_add_ps _mm512_sub_ps _mm512_mul_ps _mm512_div_ps _mm512_min_ps _mm512_max_ps;
    memory _mm512_set1_ps _mm512_loadu_ps _mm512_storeu_ps _mm512_sqrt_ps;
    neg(a) _mm512_xor_ps(a, _mm512_set1_ps(-0.0));
    abs(a) _mm512_abs_ps(a);
    floor(a) _mm512_roundscale_ps::<0x09>(a);
    mul_add(a, b, c) _mm512_fmadd_ps(a, b, c);
    times_power_of_two(p, n) _mm512_scalef_ps(p, n);
    lt(a, b) _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b);
    le(a, b) _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b);
    select(mask, yes, no) _mm512_mask_blend_ps(mask, no, yes);
    and(a, b) a & b;
    or(a, b) a | b;
    not(a) !a;
    bits(a) a;
    gather(table, index) match last_index(table) {
        // SAFETY: every index is clamped into the table (NaN converts to the lowest integer, which the clamp
        // takes to 0).
        Some(last) => unsafe {
            let i = _mm512_cvttps_epi32(index.0);
            let i = _mm512_min_epi32(i, _mm512_set1_epi32(last));
            let i = _mm512_max_epi32(i, _mm512_setzero_si512());
            Self(_mm512_i32gather_ps::<4>(i, table.as_ptr()))
        },
        None => Self::zero(),
    };
}

vector! {
    /// 8 × f32, AVX2 with FMA.
    F32x8(__m256; 8);
    /// 8 truth values, all bits of a lane set or none.
    Mask8(__m256);
    features "avx2,fma";
    binary _mm256_add_ps _mm256_sub_ps _mm256_mul_ps _mm256_div_ps _mm256_min_ps _mm256_max_ps;
    memory _mm256_set1_ps _mm256_loadu_ps _mm256_storeu_ps _mm256_sqrt_ps;
    neg(a) _mm256_xor_ps(a, _mm256_set1_ps(-0.0));
    abs(a) _mm256_andnot_ps(_mm256_set1_ps(-0.0), a);
    floor(a) _mm256_floor_ps(a);
    mul_add(a, b, c) _mm256_fmadd_ps(a, b, c);
    times_power_of_two(p, n) {
        let power = _mm256_add_epi32(_mm256_cvttps_epi32(n), _mm256_set1_epi32(127));
        _mm256_mul_ps(p, _mm256_castsi256_ps(_mm256_slli_epi32::<23>(power)))
    };
    lt(a, b) _mm256_cmp_ps::<_CMP_LT_OQ>(a, b);
    le(a, b) _mm256_cmp_ps::<_CMP_LE_OQ>(a, b);
    select(mask, yes, no) _mm256_blendv_ps(no, yes, mask);
    and(a, b) _mm256_and_ps(a, b);
    or(a, b) _mm256_or_ps(a, b);
    not(a) _mm256_xor_ps(a, _mm256_castsi256_ps(_mm256_set1_epi32(-1)));
    bits(a) _mm256_movemask_ps(a);
    gather(table, index) match last_index(table) {
        // SAFETY: every index is clamped into the table.
        Some(last) => unsafe {
            let i = _mm256_cvttps_epi32(index.0);
            let i = _mm256_min_epi32(i, _mm256_set1_epi32(last));
            let i = _mm256_max_epi32(i, _mm256_setzero_si256());
            Self(_mm256_i32gather_ps::<4>(table.as_ptr(), i))
        },
        None => Self::zero(),
    };
}

vector! {
    /// 4 × f32, SSE 4.1. Without fused multiply-add.
    F32x4(__m128; 4);
    /// 4 truth values, all bits of a lane set or none.
    Mask4(__m128);
    features "sse4.1";
    binary _mm_add_ps _mm_sub_ps _mm_mul_ps _mm_div_ps _mm_min_ps _mm_max_ps;
    memory _mm_set1_ps _mm_loadu_ps _mm_storeu_ps _mm_sqrt_ps;
    neg(a) _mm_xor_ps(a, _mm_set1_ps(-0.0));
    abs(a) _mm_andnot_ps(_mm_set1_ps(-0.0), a);
    floor(a) _mm_floor_ps(a);
    mul_add(a, b, c) _mm_add_ps(_mm_mul_ps(a, b), c);
    times_power_of_two(p, n) {
        let power = _mm_add_epi32(_mm_cvttps_epi32(n), _mm_set1_epi32(127));
        _mm_mul_ps(p, _mm_castsi128_ps(_mm_slli_epi32::<23>(power)))
    };
    lt(a, b) _mm_cmplt_ps(a, b);
    le(a, b) _mm_cmple_ps(a, b);
    select(mask, yes, no) _mm_blendv_ps(no, yes, mask);
    and(a, b) _mm_and_ps(a, b);
    or(a, b) _mm_or_ps(a, b);
    not(a) _mm_xor_ps(a, _mm_castsi128_ps(_mm_set1_epi32(-1)));
    bits(a) _mm_movemask_ps(a);
    gather(table, index) gather_one_by_one(table, index);
}

/// The last index of a table, as the instructions count; `None` where it has none, or more than they can
/// count.
#[inline(always)]
fn last_index(table: &[f32]) -> Option<i32> {
    i32::try_from(table.len()).ok()?.checked_sub(1).filter(|&last| last >= 0)
}
