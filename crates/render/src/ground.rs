//! Where rays meet the ground, and what colour it has there.

use std::sync::Arc;

use caudata_sim::terrain::APRON_DROP_M;
use caudata_sim::{HeightGrid, Terrain};

use crate::solid::{Hit, Ray};
use crate::vector::{Vec3, mix, unit};

/// Distances of the thin and the strong grid lines, m, their widths, and how far they darken.
const LINES: [(f64, f64, f64); 2] = [(0.1, 0.003, 0.22), (1.0, 0.010, 0.55)];

/// A terrain with what every ray asks of it.
#[derive(Clone, Debug)]
pub(crate) struct Ground {
    pub terrain: Arc<Terrain>,
    /// Lowest and highest point of the height field, m.
    span_m: (f64, f64),
    has_patches: bool,
}

impl Ground {
    pub fn new(terrain: Arc<Terrain>) -> Self {
        let heights = terrain.grid().map_or(&[][..], HeightGrid::heights_m);
        let span = heights.iter().fold((f32::MAX, f32::MIN), |(a, b), &h| (a.min(h), b.max(h)));
        Self {
            span_m: (f64::from(span.0), f64::from(span.1)),
            has_patches: terrain.has_patches(),
            terrain,
        }
    }
}

/// Where a ray first meets the ground before `far`.
pub(crate) fn meet(ground: &Ground, ray: &Ray, far: f64) -> Option<Hit> {
    let Some(grid) = ground.terrain.grid() else { return plane(ray, 0.0, far) };
    let field = meet_field(grid, ground.span_m, ray, far);
    let apron = plane(ray, -APRON_DROP_M, far).filter(|hit| {
        let half = grid.size_m() / 2.0;
        let at = ray.at(hit.t);
        at[0].abs() > half || at[1].abs() > half
    });
    match (field, apron) {
        (Some(a), Some(b)) => Some(if a.t < b.t { a } else { b }),
        (a, b) => a.or(b),
    }
}

/// A level plane, from above or below.
pub(crate) fn plane(ray: &Ray, z: f64, far: f64) -> Option<Hit> {
    let t = (z - ray.from[2]) / ray.along[2];
    (t > 1e-6 && t < far).then_some(Hit { t, normal: [0.0, 0.0, -ray.along[2].signum()] })
}

/// Walks through the cells under a ray, within the height field's box.
fn meet_field(grid: &HeightGrid, span_m: (f64, f64), ray: &Ray, far: f64) -> Option<Hit> {
    let half = grid.size_m() / 2.0;
    let (mut enter, mut leave) = (0.0_f64, far);
    let bounds = [(-half, half), (-half, half), (span_m.0 - 1e-6, span_m.1 + 1e-6)];
    for (i, (lo, hi)) in bounds.into_iter().enumerate() {
        let (a, b) = ((lo - ray.from[i]) / ray.along[i], (hi - ray.from[i]) / ray.along[i]);
        if a.is_nan() || b.is_nan() {
            return None;
        }
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    if enter >= leave {
        return None;
    }
    let cell = grid.cell_m;
    let last = grid.points() - 2;
    let index = |x: f64| (((x + half) / cell).max(0.0) as usize).min(last);
    let start = ray.at(enter + 1e-9);
    let (mut ix, mut iy) = (index(start[0]), index(start[1]));
    let mut t = enter;
    // Each step leaves one cell; a ray crosses at most twice the edge's number of cells.
    for _ in 0..2 * grid.points() + 2 {
        if let Some(hit) = meet_cell(grid, ray, [ix, iy], far)
            && hit.t >= t - 1e-9
        {
            return Some(hit);
        }
        let border = |i: usize, along: f64| (i + usize::from(along > 0.0)) as f64 * cell - half;
        let until = |axis: usize, i: usize| match ray.along[axis] {
            0.0 => f64::INFINITY,
            d => (border(i, d) - ray.from[axis]) / d,
        };
        let (tx, ty) = (until(0, ix), until(1, iy));
        t = tx.min(ty);
        if t >= leave {
            return None;
        }
        let (i, axis) = if tx <= ty { (&mut ix, 0) } else { (&mut iy, 1) };
        if ray.along[axis] > 0.0 {
            if *i == last {
                return None;
            }
            *i += 1;
        } else {
            *i = i.checked_sub(1)?;
        }
    }
    None
}

/// The two triangles of a cell.
fn meet_cell(grid: &HeightGrid, ray: &Ray, [ix, iy]: [usize; 2], far: f64) -> Option<Hit> {
    let h = |dx: usize, dy: usize| f64::from(grid.at(ix + dx, iy + dy));
    let cell = grid.cell_m;
    let half = grid.size_m() / 2.0;
    let corner = [ix as f64 * cell - half, iy as f64 * cell - half];
    let slopes = [[h(1, 0) - h(0, 0), h(1, 1) - h(1, 0)], [h(1, 1) - h(0, 1), h(0, 1) - h(0, 0)]];
    let mut found: Option<Hit> = None;
    for (lower_right, [du, dv]) in [true, false].into_iter().zip(slopes) {
        let (sx, sy) = (du / cell, dv / cell);
        // z − h00 − sx·(x − x0) − sy·(y − y0) along the ray
        let above =
            ray.from[2] - h(0, 0) - sx * (ray.from[0] - corner[0]) - sy * (ray.from[1] - corner[1]);
        let rate = ray.along[2] - sx * ray.along[0] - sy * ray.along[1];
        let t = -above / rate;
        if !(t > 1e-6 && t < far) || found.is_some_and(|f| f.t <= t) {
            continue;
        }
        let at = ray.at(t);
        let (u, v) = ((at[0] - corner[0]) / cell, (at[1] - corner[1]) / cell);
        const EDGE: f64 = 1e-7;
        let inside = u > -EDGE && v > -EDGE && u < 1.0 + EDGE && v < 1.0 + EDGE;
        if inside && (if lower_right { u >= v - EDGE } else { v >= u - EDGE }) {
            let normal = unit([-sx, -sy, 1.0]);
            found = Some(Hit { t, normal });
        }
    }
    found
}

/// Linear RGB of the ground at `at`; `footprint_m`: how much of it one pixel covers.
pub(crate) fn colour(ground: &Ground, at: Vec3, footprint_m: f64) -> Vec3 {
    const LOW: Vec3 = [0.24, 0.27, 0.25];
    const HIGH: Vec3 = [0.40, 0.36, 0.28];
    const ICE: Vec3 = [0.42, 0.62, 0.78];
    let terrain = &ground.terrain;
    let mut colour = LOW;
    if terrain.grid().is_some() {
        // 0.3 m of height turn green-grey into sand; higher ground repeats it softly
        let share = 0.5 - 0.5 * (std::f64::consts::PI * at[2] / 0.3).cos();
        colour = mix(LOW, HIGH, share);
        if ground.has_patches {
            let factor = f64::from(terrain.friction_factor(at[0] as f32, at[1] as f32));
            colour = mix(ICE, colour, factor);
        }
    }
    let water = terrain.water_level_m.map_or(f64::NEG_INFINITY, f64::from);
    if at[2] < water {
        colour = mix(colour, [0.42, 0.38, 0.28], 0.6); // sand under water
    }
    for (spacing, width, strength) in LINES {
        let dark =
            (0..2).map(|i| line_share(at[i], spacing, width, footprint_m)).fold(0.0, f64::max);
        colour = colour.map(|c| c * (1.0 - strength * dark));
    }
    colour
}

/// How much of a pixel around `x` lies on a line.
fn line_share(x: f64, spacing: f64, width: f64, footprint: f64) -> f64 {
    let distance = (x - (x / spacing).round() * spacing).abs();
    let covered = (width / 2.0 + footprint / 2.0 - distance) / footprint.max(1e-9);
    // far away the lines are finer than pixels and fade
    let fade = (1.5 - footprint / (0.2 * spacing)).clamp(0.0, 1.0);
    covered.clamp(0.0, 1.0) * (width / footprint.max(width)).sqrt() * fade
}
