//! Vectors, matrices and spatial inertias of lanes. All `#[inline(always)]`, without closures (see
//! [`crate::simd`]).

use crate::real::Real;
use crate::simd::Lanes;

/// Three numbers per lane.
pub(crate) type V3<R> = [R; 3];

#[inline(always)]
pub(super) fn zero3<R: Real>() -> V3<R> {
    [R::zero(); 3]
}

/// The same vector in every lane.
#[inline(always)]
pub(super) fn uniform3<R: Lanes>(v: [R::Elem; 3]) -> V3<R> {
    [R::uniform(v[0]), R::uniform(v[1]), R::uniform(v[2])]
}

#[inline(always)]
pub(crate) fn add<R: Real>(a: V3<R>, b: V3<R>) -> V3<R> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

#[inline(always)]
pub(crate) fn sub<R: Real>(a: V3<R>, b: V3<R>) -> V3<R> {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

#[inline(always)]
pub(crate) fn scale<R: Real>(a: V3<R>, s: R) -> V3<R> {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// `a + b·s`
#[inline(always)]
pub(super) fn add_scaled<R: Real>(a: V3<R>, b: V3<R>, s: R) -> V3<R> {
    [b[0].mul_add(s, a[0]), b[1].mul_add(s, a[1]), b[2].mul_add(s, a[2])]
}

#[inline(always)]
pub(super) fn dot<R: Real>(a: V3<R>, b: V3<R>) -> R {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

/// `a × b`
#[inline(always)]
pub(super) fn cross<R: Real>(a: V3<R>, b: V3<R>) -> V3<R> {
    [
        a[1].mul_add(b[2], -(a[2] * b[1])),
        a[2].mul_add(b[0], -(a[0] * b[2])),
        a[0].mul_add(b[1], -(a[1] * b[0])),
    ]
}

/// `c + a × b`
#[inline(always)]
pub(super) fn add_cross<R: Real>(c: V3<R>, a: V3<R>, b: V3<R>) -> V3<R> {
    [
        a[1].mul_add(b[2], (-a[2]).mul_add(b[1], c[0])),
        a[2].mul_add(b[0], (-a[0]).mul_add(b[2], c[1])),
        a[0].mul_add(b[1], (-a[1]).mul_add(b[0], c[2])),
    ]
}

/// Columns `m` times `v`.
#[inline(always)]
pub(super) fn turn<R: Real>(m: &[V3<R>; 3], v: V3<R>) -> V3<R> {
    add_scaled(add_scaled(scale(m[0], v[0]), m[1], v[1]), m[2], v[2])
}

/// Transposed columns `m` times `v`.
#[inline(always)]
pub(super) fn turn_back<R: Real>(m: &[V3<R>; 3], v: V3<R>) -> V3<R> {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

#[inline(always)]
pub(super) fn select3<R: Real>(mask: R::Mask, yes: V3<R>, no: V3<R>) -> V3<R> {
    [R::select(mask, yes[0], no[0]), R::select(mask, yes[1], no[1]), R::select(mask, yes[2], no[2])]
}

/// Symmetric 3 × 3: xx, xy, xz, yy, yz, zz.
pub(super) type Sym<R> = [R; 6];

#[inline(always)]
pub(super) fn sym_times<R: Real>(m: &Sym<R>, v: V3<R>) -> V3<R> {
    [
        m[2].mul_add(v[2], m[1].mul_add(v[1], m[0] * v[0])),
        m[4].mul_add(v[2], m[3].mul_add(v[1], m[1] * v[0])),
        m[5].mul_add(v[2], m[4].mul_add(v[1], m[2] * v[0])),
    ]
}

/// `r · m · rᵀ`, `r` as columns.
#[inline(always)]
pub(super) fn turn_sym<R: Real>(r: &[V3<R>; 3], m: &Sym<R>) -> Sym<R> {
    // columns of r·m
    let t0 = add_scaled(add_scaled(scale(r[0], m[0]), r[1], m[1]), r[2], m[2]);
    let t1 = add_scaled(add_scaled(scale(r[0], m[1]), r[1], m[3]), r[2], m[4]);
    let t2 = add_scaled(add_scaled(scale(r[0], m[2]), r[1], m[4]), r[2], m[5]);
    [
        entry(t0, t1, t2, r, 0, 0),
        entry(t0, t1, t2, r, 0, 1),
        entry(t0, t1, t2, r, 0, 2),
        entry(t0, t1, t2, r, 1, 1),
        entry(t0, t1, t2, r, 1, 2),
        entry(t0, t1, t2, r, 2, 2),
    ]
}

#[inline(always)]
fn entry<R: Real>(t0: V3<R>, t1: V3<R>, t2: V3<R>, r: &[V3<R>; 3], i: usize, j: usize) -> R {
    t2[i].mul_add(r[2][j], t1[i].mul_add(r[1][j], t0[i] * r[0][j]))
}

/// Rotation matrix, as columns, of a unit quaternion w, x, y, z.
#[inline(always)]
pub(super) fn columns<R: Real>(q: [R; 4]) -> [V3<R>; 3] {
    let [w, x, y, z] = q;
    let two = R::splat(2.0);
    let (x2, y2, z2) = (x * two, y * two, z * two);
    let (xx, yy, zz) = (x * x2, y * y2, z * z2);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    let (wx, wy, wz) = (w * x2, w * y2, w * z2);
    let one = R::one();
    [
        [one - (yy + zz), xy + wz, xz - wy],
        [xy - wz, one - (xx + zz), yz + wx],
        [xz + wy, yz - wx, one - (xx + yy)],
    ]
}

/// Articulated inertia and bias force of a body about the base's origin, world axes: what takes spatial
/// acceleration to force, `moment = a·α + b·acc + n`, `force = bᵀ·α + c·acc + f`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inertia<R> {
    /// Symmetric, kg·m².
    pub a: Sym<R>,
    /// Rows, kg·m.
    pub b: [R; 9],
    /// Symmetric, kg.
    pub c: Sym<R>,
    /// Moment, N·m.
    pub n: V3<R>,
    /// Force, N.
    pub f: V3<R>,
}

impl<R: Real> Inertia<R> {
    #[inline(always)]
    pub fn zero() -> Self {
        let o = R::zero();
        Self { a: [o; 6], b: [o; 9], c: [o; 6], n: [o; 3], f: [o; 3] }
    }

    #[inline(always)]
    pub fn add(&mut self, other: &Self) {
        for i in 0..6 {
            self.a[i] += other.a[i];
            self.c[i] += other.c[i];
        }
        for i in 0..9 {
            self.b[i] += other.b[i];
        }
        for i in 0..3 {
            self.n[i] += other.n[i];
            self.f[i] += other.f[i];
        }
    }

    /// `a·α + b·acc` and `bᵀ·α + c·acc`.
    #[inline(always)]
    pub fn times(&self, ang: V3<R>, lin: V3<R>) -> (V3<R>, V3<R>) {
        let b = &self.b;
        let top = sym_times(&self.a, ang);
        let low = sym_times(&self.c, lin);
        (
            [
                b[2].mul_add(lin[2], b[1].mul_add(lin[1], b[0].mul_add(lin[0], top[0]))),
                b[5].mul_add(lin[2], b[4].mul_add(lin[1], b[3].mul_add(lin[0], top[1]))),
                b[8].mul_add(lin[2], b[7].mul_add(lin[1], b[6].mul_add(lin[0], top[2]))),
            ],
            [
                b[6].mul_add(ang[2], b[3].mul_add(ang[1], b[0].mul_add(ang[0], low[0]))),
                b[7].mul_add(ang[2], b[4].mul_add(ang[1], b[1].mul_add(ang[0], low[1]))),
                b[8].mul_add(ang[2], b[5].mul_add(ang[1], b[2].mul_add(ang[0], low[2]))),
            ],
        )
    }

    /// `bᵀ·0 + ...` for a pure linear direction: `b·lin`, `c·lin`.
    #[inline(always)]
    pub fn times_linear(&self, lin: V3<R>) -> (V3<R>, V3<R>) {
        let b = &self.b;
        (
            [
                b[2].mul_add(lin[2], b[1].mul_add(lin[1], b[0] * lin[0])),
                b[5].mul_add(lin[2], b[4].mul_add(lin[1], b[3] * lin[0])),
                b[8].mul_add(lin[2], b[7].mul_add(lin[1], b[6] * lin[0])),
            ],
            sym_times(&self.c, lin),
        )
    }

    /// Adds `self` less what a joint with `u = (ang, lin)` and `1/d = inverse` lets go:
    /// `self − u·uᵀ·inverse`, bias force `+ u·gain`.
    #[inline(always)]
    pub fn reduced(&self, ang: V3<R>, lin: V3<R>, inverse: R, gain: R) -> Self {
        let (wa, wl) = (scale(ang, -inverse), scale(lin, -inverse));
        let (a, b, c) = (&self.a, &self.b, &self.c);
        Self {
            a: [
                wa[0].mul_add(ang[0], a[0]),
                wa[0].mul_add(ang[1], a[1]),
                wa[0].mul_add(ang[2], a[2]),
                wa[1].mul_add(ang[1], a[3]),
                wa[1].mul_add(ang[2], a[4]),
                wa[2].mul_add(ang[2], a[5]),
            ],
            b: [
                wa[0].mul_add(lin[0], b[0]),
                wa[0].mul_add(lin[1], b[1]),
                wa[0].mul_add(lin[2], b[2]),
                wa[1].mul_add(lin[0], b[3]),
                wa[1].mul_add(lin[1], b[4]),
                wa[1].mul_add(lin[2], b[5]),
                wa[2].mul_add(lin[0], b[6]),
                wa[2].mul_add(lin[1], b[7]),
                wa[2].mul_add(lin[2], b[8]),
            ],
            c: [
                wl[0].mul_add(lin[0], c[0]),
                wl[0].mul_add(lin[1], c[1]),
                wl[0].mul_add(lin[2], c[2]),
                wl[1].mul_add(lin[1], c[3]),
                wl[1].mul_add(lin[2], c[4]),
                wl[2].mul_add(lin[2], c[5]),
            ],
            n: add_scaled(self.n, ang, gain),
            f: add_scaled(self.f, lin, gain),
        }
    }
}
