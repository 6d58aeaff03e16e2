//! Computations that do not care how wide the lanes are, on the widest that there are.

use std::marker::PhantomData;

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
use super::F32x4;
#[cfg(target_arch = "x86_64")]
use super::{F32x8, F32x16};
use super::{Kernel, Lanes, Width};

/// A computation over lanes of any width.
pub trait AnyWidth {
    /// What it gives.
    type Output;
    /// Does it. Implementations are `#[inline(always)]`.
    fn run<R: Lanes<Elem = f32>>(self) -> Self::Output;
}

/// A computation at the width of `R`.
struct At<R, K>(K, PhantomData<R>);

impl<R: Lanes<Elem = f32>, K: AnyWidth> Kernel for At<R, K> {
    type Output = K::Output;
    #[inline(always)]
    fn run(self) -> K::Output {
        self.0.run::<R>()
    }
}

/// Runs `kernel` on the widest lanes of this processor.
pub fn widest<K: AnyWidth>(kernel: K) -> K::Output {
    match Width::best() {
        #[cfg(target_arch = "x86_64")]
        Width::Sixteen => F32x16::run(At(kernel, PhantomData::<F32x16>)),
        #[cfg(target_arch = "x86_64")]
        Width::Eight => F32x8::run(At(kernel, PhantomData::<F32x8>)),
        #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
        Width::Four => F32x4::run(At(kernel, PhantomData::<F32x4>)),
        #[allow(unreachable_patterns)]
        _ => <f32 as Lanes>::run(At(kernel, PhantomData::<f32>)),
    }
}
