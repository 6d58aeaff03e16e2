//! Vectors of numbers, one robot per lane: [`Real`] over the processor's vector registers.
//!
//! Which width a processor offers is found at run time ([`Width::best`]); nothing needs `-C target-cpu`. Code
//! over [`Lanes`] is `#[inline(always)]` from top to bottom and entered through [`Lanes::run`], which is
//! compiled with the instructions that the width needs; everything inside is then inlined into it and becomes
//! vector code. A function that is not inlined would still be correct but slow, so kernels use no closures
//! and no iterator adapters.
//!
//! Rounding: 16 and 8 lanes have fused multiply-add and give the same bits as each other. 4 lanes on x86-64
//! and one lane round twice.

#[cfg(target_arch = "aarch64")]
mod neon;
mod scalar;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod table;
mod widest;
#[cfg(target_arch = "x86_64")]
mod x86;

use crate::real::Real;

#[cfg(target_arch = "aarch64")]
pub use neon::F32x4;
pub use widest::{AnyWidth, widest};
#[cfg(target_arch = "x86_64")]
pub use x86::{F32x4, F32x8, F32x16};

/// A computation over lanes that is to be compiled for the width's instructions.
pub trait Kernel {
    /// What it gives.
    type Output;
    /// Does it. Implementations are `#[inline(always)]`.
    fn run(self) -> Self::Output;
}

/// A [`Real`] whose lanes can be read, written and looked up in tables.
pub trait Lanes: Real + Default + PartialEq {
    /// One lane.
    type Elem: Copy + Send + Sync + std::fmt::Debug + 'static;

    /// The nearest value of one lane.
    fn elem(value: f64) -> Self::Elem;
    /// The same value in every lane.
    fn uniform(value: Self::Elem) -> Self;
    /// Reads [`Real::LANES`] values.
    fn read(from: &[f32]) -> Self;
    /// Writes [`Real::LANES`] values, rounded to f32.
    fn write(self, to: &mut [f32]);
    /// `table[index]` per lane; `index` holds whole numbers, what is beyond an end takes the entry there (0
    /// from an empty table).
    fn gather(table: &[f32], index: Self) -> Self;
    /// Runs `kernel` compiled for this width's instructions.
    fn run<K: Kernel>(kernel: K) -> K::Output;
}

/// Lanes per vector register.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Width {
    /// Plain code.
    One,
    /// SSE 4.1 or NEON.
    Four,
    /// AVX2 with FMA.
    Eight,
    /// AVX-512 (F, DQ, VL, BW).
    Sixteen,
}

impl Width {
    /// Every width, narrowest first.
    pub const ALL: [Self; 4] = [Self::One, Self::Four, Self::Eight, Self::Sixteen];

    /// Number of lanes.
    pub fn lanes(self) -> usize {
        match self {
            Self::One => 1,
            Self::Four => 4,
            Self::Eight => 8,
            Self::Sixteen => 16,
        }
    }

    /// The width with that many lanes.
    pub fn of(lanes: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|w| w.lanes() == lanes as usize)
    }

    /// Whether this processor has the instructions.
    pub fn is_available(self) -> bool {
        match self {
            Self::One => true,
            #[cfg(target_arch = "x86_64")]
            Self::Four => std::arch::is_x86_feature_detected!("sse4.1"),
            #[cfg(target_arch = "x86_64")]
            Self::Eight => {
                std::arch::is_x86_feature_detected!("avx2")
                    && std::arch::is_x86_feature_detected!("fma")
            }
            #[cfg(target_arch = "x86_64")]
            Self::Sixteen => {
                Self::Eight.is_available()
                    && std::arch::is_x86_feature_detected!("avx512f")
                    && std::arch::is_x86_feature_detected!("avx512dq")
                    && std::arch::is_x86_feature_detected!("avx512vl")
                    && std::arch::is_x86_feature_detected!("avx512bw")
            }
            #[cfg(target_arch = "aarch64")]
            Self::Four => true,
            #[allow(unreachable_patterns)]
            _ => false,
        }
    }

    /// The widest one this processor has.
    pub fn best() -> Self {
        Self::ALL.into_iter().rev().find(|w| w.is_available()).unwrap_or(Self::One)
    }
}

/// [`Lanes::gather`] without an instruction for it.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
#[inline(always)]
fn gather_one_by_one<R: Lanes>(table: &[f32], index: R) -> R {
    let mut at = [0.0_f32; 16];
    index.write(&mut at);
    let last = table.len().saturating_sub(1);
    for slot in &mut at[..R::LANES] {
        *slot = table.get((*slot as usize).min(last)).copied().unwrap_or(0.0);
    }
    R::read(&at)
}

/// Sine and cosine by range reduction to ±π/4 and minimax polynomials (Cephes' coefficients, S. Moshier),
/// absolute error below 1.5e-7 up to 1000 rad and growing as 1e-10 per rad beyond.
#[inline(always)]
fn sin_cos<R: Real>(x: R) -> (R, R) {
    let turns = (x * R::splat(std::f64::consts::FRAC_2_PI) + R::splat(0.5)).floor();
    // π/2 in three parts, the first two short enough that their products with `turns` are exact up to some
    // thousand turns
    let r = turns.mul_add(R::splat(-1.570_312_5), x);
    let r = turns.mul_add(R::splat(-4.837_512_969_970_703e-4), r);
    let r = turns.mul_add(R::splat(-7.549_789_954_891_89e-8), r);
    let z = r * r;
    let s = z
        .mul_add(R::splat(-1.951_529_589_1e-4), R::splat(8.332_160_873_6e-3))
        .mul_add(z, R::splat(-1.666_665_461_1e-1));
    let s = (s * z).mul_add(r, r);
    let c = z
        .mul_add(R::splat(2.443_315_711_809_948e-5), R::splat(-1.388_731_625_493_765e-3))
        .mul_add(z, R::splat(4.166_664_568_298_827e-2));
    let c = (c * z).mul_add(z, z.mul_add(R::splat(-0.5), R::one()));
    // quadrant 0..=3
    let quadrant = (turns * R::splat(0.25)).floor().mul_add(R::splat(-4.0), turns);
    let half = R::splat(0.5);
    let odd_low = half.lt(quadrant) & quadrant.lt(R::splat(1.5));
    let odd_high = R::splat(2.5).lt(quadrant);
    let odd = odd_low | odd_high;
    let (sin, cos) = (R::select(odd, c, s), R::select(odd, s, c));
    let sin_negative = R::splat(1.5).lt(quadrant);
    let cos_negative = half.lt(quadrant) & quadrant.lt(R::splat(2.5));
    (R::select(sin_negative, -sin, sin), R::select(cos_negative, -cos, cos))
}

/// What is left of e^x after taking out 2^n: (n, polynomial), with `x` held within ±87. Relative error below
/// 2e-7 (Cephes' coefficients).
#[inline(always)]
fn exp_parts<R: Real>(x: R) -> (R, R) {
    let x = x.clamp(R::splat(-87.0), R::splat(88.0));
    let n = (x * R::splat(std::f64::consts::LOG2_E) + R::splat(0.5)).floor();
    let r = n.mul_add(R::splat(-0.693_359_375), x);
    let r = n.mul_add(R::splat(2.121_944_4e-4), r);
    let p = r
        .mul_add(R::splat(1.987_569_15e-4), R::splat(1.398_199_95e-3))
        .mul_add(r, R::splat(8.333_451_9e-3))
        .mul_add(r, R::splat(4.166_579_6e-2))
        .mul_add(r, R::splat(1.666_666_55e-1))
        .mul_add(r, R::splat(0.5));
    (n, (p * (r * r)) + (r + R::one()))
}

#[cfg(test)]
mod tests;
