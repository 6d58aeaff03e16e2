//! The ground as lanes look it up.

use super::vec3::V3;
use crate::Terrain;
use crate::simd::Lanes;
use crate::terrain::APRON_DROP_M;

/// A terrain's heights in one table.
#[derive(Debug, Clone)]
pub(super) struct Ground<R: Lanes> {
    /// `[points (y), points (x)]`, m; empty: the plane z = 0.
    heights: Vec<f32>,
    points: R::Elem,
    /// Largest grid coordinate.
    last: R::Elem,
    per_m: R::Elem,
    half_m: R::Elem,
}

impl<R: Lanes> Ground<R> {
    pub fn new(terrain: &Terrain) -> Self {
        match terrain {
            Terrain::Flat => Self {
                heights: Vec::new(),
                points: R::elem(0.0),
                last: R::elem(0.0),
                per_m: R::elem(0.0),
                half_m: R::elem(0.0),
            },
            Terrain::HeightField(grid) => {
                let n = grid.points();
                let size = grid.size_m();
                Self {
                    heights: (0..n * n).map(|i| grid.at(i % n, i / n)).collect(),
                    points: R::elem(n as f64),
                    last: R::elem((n - 1) as f64),
                    per_m: R::elem((n - 1) as f64 / size),
                    half_m: R::elem(0.5 * size),
                }
            }
        }
    }

    /// Whether it is the plane z = 0.
    pub fn is_flat(&self) -> bool {
        self.heights.is_empty()
    }

    /// Height and slope (∂z/∂x, ∂z/∂y) at world `(x, y)`, as [`Terrain::height_m`] has them.
    #[inline(always)]
    pub fn sample(&self, x: R, y: R) -> (R, R, R) {
        let k = R::uniform;
        let (zero, one) = (R::zero(), R::one());
        let (last, points) = (k(self.last), k(self.points));
        let gx = (x + k(self.half_m)) * k(self.per_m);
        let gy = (y + k(self.half_m)) * k(self.per_m);
        let inside = zero.le(gx) & gx.le(last) & zero.le(gy) & gy.le(last);
        let ix = gx.max(zero).min(last - one).floor();
        let iy = gy.max(zero).min(last - one).floor();
        let (u, v) = (gx - ix, gy - iy);
        let corner = iy.mul_add(points, ix);
        let h00 = R::gather(&self.heights, corner);
        let h11 = R::gather(&self.heights, corner + points + one);
        let right = v.le(u);
        let h = R::gather(&self.heights, corner + R::select(right, one, points));
        let du = R::select(right, h - h00, h11 - h);
        let dv = R::select(right, h11 - h, h - h00);
        let height = v.mul_add(dv, u.mul_add(du, h00));
        (
            R::select(inside, height, R::splat(-APRON_DROP_M)),
            R::select(inside, du * k(self.per_m), zero),
            R::select(inside, dv * k(self.per_m), zero),
        )
    }

    /// Height of a point above the ground's tangent plane below it, and that plane's normal.
    #[inline(always)]
    pub fn clearance(&self, x: R, y: R, z: R) -> (R, V3<R>) {
        let (height, sx, sy) = self.sample(x, y);
        let inverse = R::one() / sx.mul_add(sx, sy.mul_add(sy, R::one())).sqrt();
        (
            (z - height) * inverse,
            [-(sx * inverse), -(sy * inverse), inverse],
        )
    }
}
