//! A square grid of heights and friction factors, and how it is interpolated.

/// A square grid centred on the origin.
///
/// Grid point `(ix, iy)` lies at `x = ix·cell − size/2`, `y = iy·cell − size/2`; its height is
/// `heights_m()[iy·points + ix]`. The cell with that point at its smallest x and y is cell `(ix, iy)`;
/// `friction()` has the same index (its last row and column are not used), so one index gathers both. With
/// `u, v` in 0..=1 across the cell along x and y, and h00, h10, h01, h11 the corners (first digit x), each
/// cell is two triangles along the diagonal h00–h11:
/// - u ≥ v: `z = h00 + u·(h10 − h00) + v·(h11 − h10)`,
/// - u < v: `z = h00 + u·(h11 − h01) + v·(h01 − h00)`;
///
/// the brackets, divided by the cell's size, are the facet's slopes ∂z/∂x and ∂z/∂y, and its normal is
/// (−∂z/∂x, −∂z/∂y, 1), normalised.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightGrid {
    points: usize,
    /// Distance of grid points, m.
    pub cell_m: f64,
    /// `[points (y), points (x)]`, from the smallest x and y, m.
    heights_m: Vec<f32>,
    /// Same layout, per cell.
    friction: Vec<f32>,
}

impl HeightGrid {
    /// `heights_m` and `friction` as `[points (y), points (x)]`.
    pub(super) fn new(points: usize, cell_m: f64, heights_m: Vec<f32>, friction: Vec<f32>) -> Self {
        debug_assert_eq!(heights_m.len(), points * points);
        debug_assert_eq!(friction.len(), points * points);
        Self { points, cell_m, heights_m, friction }
    }

    /// Grid points along one edge.
    pub fn points(&self) -> usize {
        self.points
    }

    /// Edge length, m.
    pub fn size_m(&self) -> f64 {
        self.cell_m * (self.points - 1) as f64
    }

    /// All heights, `[points (y), points (x)]`, m.
    pub fn heights_m(&self) -> &[f32] {
        &self.heights_m
    }

    /// Friction factor of each cell, by its corner with the smallest x and y, `[points (y), points (x)]`.
    pub fn friction(&self) -> &[f32] {
        &self.friction
    }

    /// Height at grid point `(ix, iy)`, m.
    pub fn at(&self, ix: usize, iy: usize) -> f32 {
        self.heights_m[iy * self.points + ix]
    }

    /// Cell and place in it (0..=1) of `(x, y)`; `None` beyond the edge, and where x or y is not a number.
    fn cell(&self, x_m: f64, y_m: f64) -> Option<([usize; 2], [f64; 2])> {
        let half = self.size_m() / 2.0;
        let (gx, gy) = ((x_m + half) / self.cell_m, (y_m + half) / self.cell_m);
        let last = (self.points - 1) as f64;
        if !((0.0..=last).contains(&gx) && (0.0..=last).contains(&gy)) {
            return None;
        }
        let (ix, iy) = ((gx as usize).min(self.points - 2), (gy as usize).min(self.points - 2));
        Some(([ix, iy], [gx - ix as f64, gy - iy as f64]))
    }

    /// Height and slope (∂z/∂x, ∂z/∂y) at `(x, y)`; `None` beyond the edge.
    pub(super) fn sample(&self, x_m: f64, y_m: f64) -> Option<(f64, [f64; 2])> {
        let ([ix, iy], [u, v]) = self.cell(x_m, y_m)?;
        let h = |dx: usize, dy: usize| f64::from(self.at(ix + dx, iy + dy));
        let (du, dv) = if u >= v {
            (h(1, 0) - h(0, 0), h(1, 1) - h(1, 0))
        } else {
            (h(1, 1) - h(0, 1), h(0, 1) - h(0, 0))
        };
        Some((h(0, 0) + u * du + v * dv, [du / self.cell_m, dv / self.cell_m]))
    }

    /// Friction factor of the cell at `(x, y)`; 1 beyond the edge.
    pub(super) fn friction_factor(&self, x_m: f64, y_m: f64) -> f32 {
        self.cell(x_m, y_m).map_or(1.0, |([ix, iy], _)| self.friction[iy * self.points + ix])
    }
}
