//! A vector of f32 and its truth values, declared as a table of the operations that differ from one
//! instruction set to another.

/// `$kernel` is how a kernel is entered; every operation is an expression over registers, named on its left.
macro_rules! vector {
    (
        $(#[$about:meta])* $name:ident($register:ty; $lanes:literal);
        $(#[$mask_about:meta])* $mask:ident($truth:ty);
        $(features $features:literal;)?
        binary $add:ident $sub:ident $mul:ident $div:ident $min:ident $max:ident;
        memory $set1:ident $load:ident $store:ident $sqrt:ident;
        neg($neg:ident) $neg_as:expr;
        abs($abs:ident) $abs_as:expr;
        floor($floor:ident) $floor_as:expr;
        mul_add($fa:ident, $fb:ident, $fc:ident) $fused_as:expr;
        times_power_of_two($p:ident, $n:ident) $power_as:expr;
        lt($lta:ident, $ltb:ident) $lt_as:expr;
        le($lea:ident, $leb:ident) $le_as:expr;
        select($select:ident, $yes:ident, $no:ident) $select_as:expr;
        and($anda:ident, $andb:ident) $and_as:expr;
        or($ora:ident, $orb:ident) $or_as:expr;
        not($not:ident) $not_as:expr;
        bits($bits:ident) $bits_as:expr;
        gather($table:ident, $index:ident) $gather_as:expr;
    ) => {
        $(#[$about])*
        #[derive(Clone, Copy)]
        #[repr(transparent)]
        pub struct $name($register);

        $(#[$mask_about])*
        #[derive(Clone, Copy, Debug)]
        pub struct $mask($truth);

        vector!(@binary $name Add add $add, Sub sub $sub, Mul mul $mul, Div div $div);

        impl std::ops::Neg for $name {
            type Output = Self;
            #[inline(always)]
            fn neg(self) -> Self {
                let $neg = self.0;
                Self(unsafe { $neg_as })
            }
        }
        impl std::ops::AddAssign for $name {
            #[inline(always)]
            fn add_assign(&mut self, other: Self) {
                *self = *self + other;
            }
        }
        impl std::ops::SubAssign for $name {
            #[inline(always)]
            fn sub_assign(&mut self, other: Self) {
                *self = *self - other;
            }
        }
        impl std::fmt::Debug for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                let lanes = (0..Self::LANES).map(|i| self.lane(i));
                f.debug_list().entries(lanes).finish()
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

        impl std::ops::BitAnd for $mask {
            type Output = Self;
            #[inline(always)]
            fn bitand(self, other: Self) -> Self {
                let ($anda, $andb) = (self.0, other.0);
                Self(unsafe { $and_as })
            }
        }
        impl std::ops::BitOr for $mask {
            type Output = Self;
            #[inline(always)]
            fn bitor(self, other: Self) -> Self {
                let ($ora, $orb) = (self.0, other.0);
                Self(unsafe { $or_as })
            }
        }
        impl std::ops::Not for $mask {
            type Output = Self;
            #[inline(always)]
            fn not(self) -> Self {
                let $not = self.0;
                Self(unsafe { $not_as })
            }
        }
        impl Mask for $mask {
            #[inline(always)]
            fn any(self) -> bool {
                let $bits = self.0;
                (unsafe { $bits_as }) != 0
            }
            #[inline(always)]
            fn lane(self, lane: usize) -> bool {
                let $bits = self.0;
                (unsafe { $bits_as }) >> lane & 1 == 1
            }
        }

        impl Real for $name {
            type Mask = $mask;
            const LANES: usize = $lanes;

            #[inline(always)]
            fn splat(value: f64) -> Self {
                Self(unsafe { $set1(value as f32) })
            }
            #[inline(always)]
            fn lane(self, lane: usize) -> f64 {
                // SAFETY: a vector register and an array of as many f32 have the same size and every bit
                // pattern is valid.
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
            fn mul_add(self, a: Self, b: Self) -> Self {
                let ($fa, $fb, $fc) = (self.0, a.0, b.0);
                Self(unsafe { $fused_as })
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                Self(unsafe { $sqrt(self.0) })
            }
            #[inline(always)]
            fn abs(self) -> Self {
                let $abs = self.0;
                Self(unsafe { $abs_as })
            }
            #[inline(always)]
            fn min(self, other: Self) -> Self {
                Self(unsafe { $min(self.0, other.0) })
            }
            #[inline(always)]
            fn max(self, other: Self) -> Self {
                Self(unsafe { $max(self.0, other.0) })
            }
            #[inline(always)]
            fn floor(self) -> Self {
                let $floor = self.0;
                Self(unsafe { $floor_as })
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                super::sin_cos(self)
            }
            #[inline(always)]
            fn exp(self) -> Self {
                let (Self($n), Self($p)) = super::exp_parts(self);
                Self(unsafe { $power_as })
            }
            #[inline(always)]
            fn lt(self, other: Self) -> $mask {
                let ($lta, $ltb) = (self.0, other.0);
                $mask(unsafe { $lt_as })
            }
            #[inline(always)]
            fn le(self, other: Self) -> $mask {
                let ($lea, $leb) = (self.0, other.0);
                $mask(unsafe { $le_as })
            }
            #[inline(always)]
            fn is_finite(self) -> $mask {
                self.abs().le(Self::splat(f64::from(f32::MAX)))
            }
            #[inline(always)]
            fn select(mask: $mask, yes: Self, no: Self) -> Self {
                let ($select, $yes, $no) = (mask.0, yes.0, no.0);
                Self(unsafe { $select_as })
            }
        }

        impl Lanes for $name {
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
                Self(unsafe { $load(from.as_ptr()) })
            }
            #[inline(always)]
            fn write(self, to: &mut [f32]) {
                let to = &mut to[..$lanes];
                // SAFETY: the slice has exactly as many values as are written.
                unsafe { $store(to.as_mut_ptr(), self.0) }
            }
            #[inline(always)]
            fn gather($table: &[f32], $index: Self) -> Self {
                $gather_as
            }
            #[inline(always)]
            fn run<K: Kernel>(kernel: K) -> K::Output {
                $(#[target_feature(enable = $features)])?
                unsafe fn inner<K: Kernel>(kernel: K) -> K::Output {
                    kernel.run()
                }
                // SAFETY: a value of this type is only ever made where its instructions exist, see [`super`].
                unsafe { inner(kernel) }
            }
        }
    };
    (@binary $name:ident $($trait:ident $method:ident $intrinsic:ident),+) => {
        $(impl std::ops::$trait for $name {
            type Output = Self;
            #[inline(always)]
            fn $method(self, other: Self) -> Self {
                Self(unsafe { $intrinsic(self.0, other.0) })
            }
        })+
    };
}
pub(super) use vector;
