//! NEON, which every aarch64 processor has.
#![allow(unsafe_code, unused_unsafe)] // which intrinsics are unsafe to call is another matter for each instruction set

use std::arch::aarch64::*;

use super::table::vector;
use super::{Kernel, Lanes, gather_one_by_one};
use crate::real::{Mask, Real};

vector! {
    /// 4 × f32, NEON.
    F32x4(float32x4_t; 4);
    /// 4 truth values, all bits of a lane set or none.
    Mask4(uint32x4_t);
    binary vaddq_f32 vsubq_f32 vmulq_f32 vdivq_f32 vminnmq_f32 vmaxnmq_f32;
    memory vdupq_n_f32 vld1q_f32 vst1q_f32 vsqrtq_f32;
    neg(a) vnegq_f32(a);
    abs(a) vabsq_f32(a);
    floor(a) vrndmq_f32(a);
    mul_add(a, b, c) vfmaq_f32(c, a, b);
    times_power_of_two(p, n) {
        let power = vaddq_s32(vcvtq_s32_f32(n), vdupq_n_s32(127));
        vmulq_f32(p, vreinterpretq_f32_s32(vshlq_n_s32::<23>(power)))
    };
    lt(a, b) vcltq_f32(a, b);
    le(a, b) vcleq_f32(a, b);
    select(mask, yes, no) vbslq_f32(mask, yes, no);
    and(a, b) vandq_u32(a, b);
    or(a, b) vorrq_u32(a, b);
    not(a) vmvnq_u32(a);
    // one bit per lane: the lanes' own bits added up
    bits(a) vaddvq_u32(vandq_u32(a, vld1q_u32([1_u32, 2, 4, 8].as_ptr())));
    gather(table, index) gather_one_by_one(table, index);
}
