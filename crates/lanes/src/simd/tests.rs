//! Every width computes what one lane computes.
#![allow(clippy::print_stdout)]

use super::*;
use crate::real::Mask;
use std::io::Write as _;

/// Values and the operation to apply, so that it runs compiled for the width.
struct Probe<R>(std::marker::PhantomData<R>, f64, f64);

/// Sine, cosine, exponential, square root, quotient, floor, fused product, smaller, larger, chosen.
impl<R: Lanes> Kernel for Probe<R> {
    type Output = [f64; 10];
    #[inline(always)]
    fn run(self) -> [f64; 10] {
        let last = R::LANES - 1;
        let x = R::zero().with_lane(last, self.1);
        let y = R::splat(self.2);
        let (s, c) = x.sin_cos();
        let all = [
            s,
            c,
            x.clamp(R::splat(-80.0), R::splat(80.0)).exp(),
            x.abs().sqrt(),
            x / y,
            x.floor(),
            x.mul_add(y, y),
            x.min(y),
            x.max(y),
            R::select(x.lt(y), x, -y),
        ];
        let mut out = [0.0; 10];
        for i in 0..10 {
            out[i] = all[i].lane(last);
        }
        out
    }
}

fn agrees<R: Lanes>(width: Width) {
    if !width.is_available() {
        let _ = writeln!(std::io::stderr(), "skipped: this processor has no {width:?}");
        return;
    }
    for (x, y) in [
        (0.0, 1.0),
        (0.7, -0.3),
        (-2.5, 0.01),
        (3.0, 3.5),
        (100.0, 7.0),
        (-999.0, 12.0),
        (42.42, -42.0),
    ] {
        let x = f64::from(x as f32);
        let got = R::run(Probe::<R>(std::marker::PhantomData, x, y));
        let y = f64::from(y as f32);
        let want = [
            x.sin(),
            x.cos(),
            x.clamp(-80.0, 80.0).exp(),
            x.abs().sqrt(),
            x / y,
            x.floor(),
            x * y + y,
            x.min(y),
            x.max(y),
            if x < y { x } else { -y },
        ];
        for (i, (got, want)) in got.iter().zip(want).enumerate() {
            let tolerance = if i < 2 { 3e-7 } else { 4e-7 * want.abs() + 1e-37 };
            assert!(
                (got - want).abs() <= tolerance,
                "{width:?}, operation {i} of {x}, {y}: {got}, want {want}"
            );
        }
    }
}

#[test]
fn every_width_agrees_with_plain_arithmetic() {
    agrees::<f64>(Width::One);
    agrees::<f32>(Width::One);
    #[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
    agrees::<F32x4>(Width::Four);
    #[cfg(target_arch = "x86_64")]
    {
        agrees::<F32x8>(Width::Eight);
        agrees::<F32x16>(Width::Sixteen);
    }
}

/// Reads, writes, looks up and compares: `[last entry, first, entry 2, any, none]`.
struct Tables<R>(std::marker::PhantomData<R>);

impl<R: Lanes> Kernel for Tables<R> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let table = [10.0_f32, 11.0, 12.0, 13.0];
        let mut numbers = [0.0_f32; 16];
        for i in 0..16 {
            numbers[i] = i as f32 - 1.0;
        }
        let found = R::gather(&table, R::read(&numbers));
        let mut out = [0.0_f32; 16];
        found.write(&mut out);
        for lane in 0..R::LANES {
            assert_eq!(out[lane], 10.0 + (lane as f32 - 1.0).clamp(0.0, 3.0));
        }
        assert_eq!(R::gather(&[], found).lane(0), 0.0);
        assert_eq!(R::gather(&table, R::splat(f64::NAN)).lane(0), 10.0);
        let first = R::read(&numbers).lt(R::zero());
        assert!(first.any() && first.lane(0));
        assert!(!(first & !first).any());
        assert!((first | !first).lane(R::LANES - 1));
        let odd = R::splat(f64::NAN).is_finite() | R::splat(f64::INFINITY).is_finite();
        assert!(!odd.any() && R::one().is_finite().any());
    }
}

#[test]
fn tables_are_read_within_their_ends() {
    Tables::<f64>(std::marker::PhantomData).run();
    f32::run(Tables::<f32>(std::marker::PhantomData));
    #[cfg(target_arch = "x86_64")]
    {
        if Width::Four.is_available() {
            F32x4::run(Tables::<F32x4>(std::marker::PhantomData));
        }
        if Width::Eight.is_available() {
            F32x8::run(Tables::<F32x8>(std::marker::PhantomData));
        }
        if Width::Sixteen.is_available() {
            F32x16::run(Tables::<F32x16>(std::marker::PhantomData));
        }
    }
}
