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
    /// Friction factors of the cells, same layout; empty: 1 everywhere.
    grip: Vec<f32>,
    points: R::Elem,
    /// Largest grid coordinate.
    last: R::Elem,
    per_m: R::Elem,
    half_m: R::Elem,
}

impl<R: Lanes> Ground<R> {
    pub fn new(terrain: &Terrain) -> Self {
        let Some(grid) = terrain.grid() else {
            return Self {
                heights: Vec::new(),
                grip: Vec::new(),
                points: R::elem(0.0),
                last: R::elem(0.0),
                per_m: R::elem(0.0),
                half_m: R::elem(0.0),
            };
        };
        let n = grid.points();
        Self {
            heights: grid.heights_m().to_vec(),
            grip: if terrain.has_patches() { grid.friction().to_vec() } else { Vec::new() },
            points: R::elem(n as f64),
            last: R::elem((n - 1) as f64),
            per_m: R::elem(1.0 / grid.cell_m),
            half_m: R::elem(0.5 * grid.size_m()),
        }
    }

    /// Whether it is the plane z = 0.
    pub fn is_flat(&self) -> bool {
        self.heights.is_empty()
    }

    /// The ground at world `(x, y)`, as [`Terrain::height_m`] and [`Terrain::friction_factor`] have it.
    #[inline(always)]
    pub fn sample(&self, x: R, y: R) -> Sample<R> {
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
        let grip = if self.grip.is_empty() {
            one
        } else {
            R::select(inside, R::gather(&self.grip, corner), one)
        };
        Sample {
            height: R::select(inside, height, R::splat(-APRON_DROP_M)),
            slope_x: R::select(inside, du * k(self.per_m), zero),
            slope_y: R::select(inside, dv * k(self.per_m), zero),
            grip,
        }
    }

    /// Height of a point above the ground's tangent plane below it, that plane's normal, and the friction
    /// factor there.
    #[inline(always)]
    pub fn clearance(&self, x: R, y: R, z: R) -> (R, V3<R>, R) {
        let s = self.sample(x, y);
        let (sx, sy) = (s.slope_x, s.slope_y);
        let inverse = R::one() / sx.mul_add(sx, sy.mul_add(sy, R::one())).sqrt();
        ((z - s.height) * inverse, [-(sx * inverse), -(sy * inverse), inverse], s.grip)
    }
}

/// The ground at a place.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sample<R> {
    /// m
    pub height: R,
    /// ∂z/∂x
    pub slope_x: R,
    /// ∂z/∂y
    pub slope_y: R,
    /// Factor on friction coefficients.
    pub grip: R,
}
