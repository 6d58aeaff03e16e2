//! Draws height fields.

use std::f64::consts::TAU;

use caudata_random::{Key, Purpose, Stream};

use super::config::{TerrainConfig, TerrainKind};
use super::grid::HeightGrid;
use super::map::HeightMap;
use crate::SimError;

/// Width of the ramp down to 0 at the edge of a height field, m.
const MARGIN_M: f64 = 1.0;

/// How many sine waves make a hilly landscape.
const HILL_WAVES: usize = 12;

/// Height of a shore's land above the water, m: enough for the nominal pose to stand dry.
pub(super) const FREEBOARD_M: f64 = 0.1;

/// Where a shore's beach begins, m: ahead of a robot that starts at the origin (its nose is there).
pub(super) const BEACH_X_M: f64 = 0.5;

/// Half the width of a valley's floor, m.
const VALLEY_FLOOR_HALF_WIDTH_M: f64 = 0.5;

/// The height field of a valid `config`; `None` for kinds without one. Refuses a map that cannot be read.
pub(super) fn grid(config: &TerrainConfig, seed: u64) -> Result<Option<HeightGrid>, SimError> {
    if matches!(config.kind, TerrainKind::Flat | TerrainKind::DeepWater) {
        return Ok(None);
    }
    let mut stream = Stream::new(Key::for_run(seed), Purpose::Terrain);
    let cell_m = config.grid_cell_m();
    let plan = Plan {
        points: (config.size_m / cell_m).round() as usize + 1,
        cell_m,
        easiest_share: match config.kind {
            TerrainKind::Mixed => 1.0,
            _ => config.easiest_share,
        },
    };
    let (roughness_m, slope_deg) = config.grade();
    let slope = slope_deg.to_radians().tan();
    let mut friction = vec![1.0_f32; plan.points * plan.points];
    let mut heights = match config.kind {
        TerrainKind::Hills
        | TerrainKind::Rough
        | TerrainKind::RoughEasy
        | TerrainKind::RoughMedium
        | TerrainKind::RoughHard => plan.hills(config.wavelength_m, slope, &mut stream),
        TerrainKind::Valley => plan.valley(slope),
        TerrainKind::Slope => {
            let half = plan.half_m();
            plan.each(|x, y| (x + half) * slope * plan.hardness(y))
        }
        TerrainKind::Steps => plan.steps(config.step_length_m, config.height_m),
        TerrainKind::Shore => plan.shore(config.surface_m().unwrap_or(0.0), slope),
        TerrainKind::Slippery => {
            friction = plan.patches(config, &mut stream);
            plan.each(|_, _| 0.0)
        }
        TerrainKind::Mixed => plan.mixed(config, slope, &mut stream),
        TerrainKind::Map => {
            let map = HeightMap::read(&config.map, config.height_m)?;
            let half = plan.half_m();
            let share = |at: f64| (at + half) / (2.0 * half);
            plan.each(|x, y| map.at(share(x), share(y)))
        }
        TerrainKind::Flat | TerrainKind::Rugged | TerrainKind::DeepWater => plan.each(|_, _| 0.0),
    };
    let rugged = matches!(
        config.kind,
        TerrainKind::Rugged
            | TerrainKind::Rough
            | TerrainKind::RoughEasy
            | TerrainKind::RoughMedium
            | TerrainKind::RoughHard
    );
    if rugged {
        let hardness = plan.each(|_, y| plan.hardness(y));
        for (h, hardness) in heights.iter_mut().zip(hardness) {
            *h += hardness * stream.uniform_f64(0.0, roughness_m);
        }
    }
    // A slope, steps and a map go from edge to edge; everything else ends at 0.
    if !matches!(config.kind, TerrainKind::Slope | TerrainKind::Steps | TerrainKind::Map) {
        plan.lower_margin(&mut heights);
    }
    let heights_m = heights.iter().map(|&h| h as f32).collect();
    let grid = HeightGrid::new(plan.points, cell_m, heights_m, friction);
    Ok(Some(grid))
}

/// Size of the grid to be drawn.
struct Plan {
    points: usize,
    cell_m: f64,
    easiest_share: f64,
}

impl Plan {
    /// Factor on slopes and heights at y: from `easiest_share` at the right edge evenly to 1 at the left one.
    fn hardness(&self, y: f64) -> f64 {
        let share = (y + self.half_m()) / (2.0 * self.half_m());
        self.easiest_share + (1.0 - self.easiest_share) * share
    }

    fn half_m(&self) -> f64 {
        self.cell_m * (self.points - 1) as f64 / 2.0
    }

    /// `[points (y), points (x)]` of a function of world x and y.
    fn each<T>(&self, mut of: impl FnMut(f64, f64) -> T) -> Vec<T> {
        let half = self.half_m();
        let at = |i: usize| i as f64 * self.cell_m - half;
        let n = self.points;
        (0..n * n).map(|i| of(at(i % n), at(i / n))).collect()
    }

    /// Sum of sine waves of random direction and phase, scaled so that no facet is steeper than `slope`,
    /// lowest point 0.
    fn hills(&self, wavelength_m: f64, slope: f64, stream: &mut Stream) -> Vec<f64> {
        let waves: Vec<[f64; 4]> = (0..HILL_WAVES)
            .map(|_| {
                let wavelength = wavelength_m * stream.uniform_f64(1.0, 3.0);
                let (sin, cos) = stream.uniform_f64(0.0, TAU).sin_cos();
                let phase = stream.uniform_f64(0.0, TAU);
                // amplitude proportional to the wavelength: every wave is equally steep
                [cos * TAU / wavelength, sin * TAU / wavelength, phase, wavelength]
            })
            .collect();
        let half = self.half_m();
        let mut heights = self.each(|x, y| {
            let (x, y) = (x + half, y + half);
            let wave = |[kx, ky, phase, a]: &[f64; 4]| a * (kx * x + ky * y + phase).sin();
            waves.iter().map(wave).sum::<f64>()
        });
        let steepest = self.steepest_facet(&heights).max(1e-12);
        let lowest = heights.iter().copied().fold(f64::INFINITY, f64::min);
        let hardness = self.each(|_, y| self.hardness(y));
        for (h, hardness) in heights.iter_mut().zip(hardness) {
            *h = (*h - lowest) * hardness * slope / steepest;
        }
        heights
    }

    /// Floor 1 m wide along x, walls of constant slope.
    fn valley(&self, slope: f64) -> Vec<f64> {
        self.each(|_, y| (y.abs() - VALLEY_FLOOR_HALF_WIDTH_M).max(0.0) * slope * self.hardness(y))
    }

    /// Terraces, lowest at 0 at the edge of largest x.
    fn steps(&self, length_m: f64, drop_m: f64) -> Vec<f64> {
        // Number of the terrace at x, the origin in the middle of number 0. A quarter of a cell: rounding
        // must not move a riser.
        let number = |x: f64| ((x + self.cell_m / 4.0) / length_m + 0.5).floor();
        let lowest = number(self.half_m());
        self.each(|x, y| (lowest - number(x)) * drop_m * self.hardness(y))
    }

    /// Land, beach and the pool's floor at 0.
    fn shore(&self, surface_m: f64, slope: f64) -> Vec<f64> {
        let land = surface_m + FREEBOARD_M;
        self.each(|x, y| (land - (x - BEACH_X_M).max(0.0) * slope * self.hardness(y)).max(0.0))
    }

    /// Flat (−x −y), hills (+x −y), rugged (−x +y) and valley (+x +y), each ramped down to 0 at its border.
    fn mixed(&self, config: &TerrainConfig, slope: f64, stream: &mut Stream) -> Vec<f64> {
        let half = self.half_m();
        let hills = self.hills(config.wavelength_m, slope, stream);
        let rugged: Vec<f64> = (0..self.points * self.points)
            .map(|_| stream.uniform_f64(0.0, config.height_m))
            .collect();
        let square = |x: f64, y: f64| (x.abs().min(y.abs()) / MARGIN_M).min(1.0);
        let share = self.each(square);
        let place = self.each(|x, y| (x, y));
        let valley = |y: f64| ((y - half / 2.0).abs() - VALLEY_FLOOR_HALF_WIDTH_M).max(0.0) * slope;
        let height = |i: usize| match place[i] {
            (x, y) if x < 0.0 && y < 0.0 => 0.0,
            (x, _) if x < 0.0 => rugged[i],
            (_, y) if y < 0.0 => hills[i],
            (_, y) => valley(y),
        };
        (0..place.len()).map(|i| share[i] * height(i)).collect()
    }

    /// Friction factors: square patches, drawn one by one.
    fn patches(&self, config: &TerrainConfig, stream: &mut Stream) -> Vec<f32> {
        let across = (config.size_m / config.patch_m).ceil() as usize + 2;
        let share = config.patch_share as f32;
        let slippery: Vec<bool> = (0..across * across).map(|_| stream.chance(share)).collect();
        let half = self.half_m();
        self.each(|x, y| {
            // the middle of the cell decides
            let (x, y) = (x + self.cell_m / 2.0, y + self.cell_m / 2.0);
            let patch =
                |at: f64| (((at + half) / config.patch_m).max(0.0) as usize).min(across - 1);
            if slippery[patch(y) * across + patch(x)] { config.patch_friction as f32 } else { 1.0 }
        })
    }

    /// Largest |∇z| over all facets.
    fn steepest_facet(&self, heights: &[f64]) -> f64 {
        let mut steepest = 0.0_f64;
        for iy in 0..self.points - 1 {
            for ix in 0..self.points - 1 {
                let h = |dx: usize, dy: usize| heights[(iy + dy) * self.points + ix + dx];
                let right = (h(1, 0) - h(0, 0)).hypot(h(1, 1) - h(1, 0));
                let left = (h(1, 1) - h(0, 1)).hypot(h(0, 1) - h(0, 0));
                steepest = steepest.max(right).max(left);
            }
        }
        steepest / self.cell_m
    }

    /// Ramps the outermost [`MARGIN_M`] down to 0.
    fn lower_margin(&self, heights: &mut [f64]) {
        let last = self.points - 1;
        for iy in 0..self.points {
            for ix in 0..self.points {
                let steps = ix.min(iy).min(last - ix).min(last - iy);
                heights[iy * self.points + ix] *= (steps as f64 * self.cell_m / MARGIN_M).min(1.0);
            }
        }
    }
}
