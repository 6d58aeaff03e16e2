//! The ground: flat, or a height field drawn from a seed.
//!
//! A height field is a square grid of heights ≥ 0 around the origin, each cell split into two triangles along its
//! diagonal from the corner with the smallest x and y to the one with the largest. Its outermost [`MARGIN_M`] ramps down to 0; beyond it
//! lies an endless plane [`APRON_DROP_M`] lower.

use std::f64::consts::TAU;

use caudata_random::{Key, Purpose, Stream};
use serde::{Deserialize, Serialize};

use crate::SimError;

/// Width of the ramp down to 0 at the edge of a height field, m.
pub const MARGIN_M: f64 = 1.0;

/// How far the plane around (and under) a height field lies below 0, m: deep enough that a foot on the field never touches both.
pub const APRON_DROP_M: f64 = 0.002;

/// Largest number of grid points along one edge: 16 MiB of heights.
const MAX_POINTS: f64 = 2048.0;

/// How many sine waves make a hilly landscape.
const HILL_WAVES: usize = 12;

/// Shape of the ground.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TerrainKind {
    /// The plane z = 0, without end.
    Flat,
    /// Smooth hills; steepest slope `slope_deg`.
    Hills,
    /// Independent random heights from 0 to `height_m` at the grid points.
    Rugged,
    /// `hills` with `rugged` on top.
    Rough,
    /// A valley along x: a floor 1 m wide, then walls rising with `slope_deg` on both sides.
    Valley,
}

/// Table `[terrain]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainConfig {
    /// Shape of the ground: `flat`, `hills`, `rugged`, `rough` or `valley`.
    pub kind: TerrainKind,
    /// Edge length of the square height field, m, 4..=100. Default 16: a 20 s episode at 0.3 m/s stays on it.
    pub size_m: f64,
    /// Distance of its grid points, m, 0.02..=1. Default 0.1: a foot ball (radius 19 mm) meets single facets.
    pub cell_m: f64,
    /// Largest random height of `rugged` and `rough`, m, 0..=0.3. Default 0.04 (the paper's rugged terrain).
    pub height_m: f64,
    /// Steepest slope of `hills`, `rough` and `valley`, degrees, 0..=40. Default 15 (the paper's hills and valley).
    pub slope_deg: f64,
    /// Shortest wave of `hills` and `rough`, m, 0.5..=20; the longest is three times that. Default 2: about two body lengths.
    pub wavelength_m: f64,
}

impl Default for TerrainConfig {
    fn default() -> Self {
        Self {
            kind: TerrainKind::Flat,
            size_m: 16.0,
            cell_m: 0.1,
            height_m: 0.04,
            slope_deg: 15.0,
            wavelength_m: 2.0,
        }
    }
}

impl TerrainConfig {
    /// Checks every field's range.
    ///
    /// # Errors
    /// [`SimError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), SimError> {
        let check = |field, value: f64, low: f64, high: f64, reason| {
            crate::config::check_range("terrain", field, value, low, high, reason)
        };
        check("size_m", self.size_m, 4.0, 100.0, "must be 4 to 100 m")?;
        check("cell_m", self.cell_m, 0.02, 1.0, "must be 0.02 to 1 m")?;
        check("height_m", self.height_m, 0.0, 0.3, "must be 0 to 0.3 m")?;
        check(
            "slope_deg",
            self.slope_deg,
            0.0,
            40.0,
            "must be 0 to 40 degrees",
        )?;
        check(
            "wavelength_m",
            self.wavelength_m,
            0.5,
            20.0,
            "must be 0.5 to 20 m",
        )?;
        let points = self.size_m / self.cell_m;
        check(
            "cell_m",
            points,
            1.0,
            MAX_POINTS,
            "gives more than 2048 grid points along an edge; use a larger cell or a smaller field",
        )
    }
}

/// A square grid of heights centred on the origin.
#[derive(Debug, Clone, PartialEq)]
pub struct HeightGrid {
    points: usize,
    cell_m: f64,
    /// `[points (y), points (x)]`, from the smallest x and y, m.
    heights_m: Vec<f32>,
}

impl HeightGrid {
    /// Grid points along one edge.
    #[must_use]
    pub fn points(&self) -> usize {
        self.points
    }

    /// Edge length, m.
    #[must_use]
    pub fn size_m(&self) -> f64 {
        self.cell_m * (self.points - 1) as f64
    }

    /// Height at grid point `(ix, iy)`, m.
    #[must_use]
    pub fn at(&self, ix: usize, iy: usize) -> f32 {
        self.heights_m[iy * self.points + ix]
    }

    /// Height and slope (∂z/∂x, ∂z/∂y) at `(x, y)`; `None` beyond the edge.
    fn sample(&self, x_m: f64, y_m: f64) -> Option<(f64, [f64; 2])> {
        let half = self.size_m() / 2.0;
        let (gx, gy) = ((x_m + half) / self.cell_m, (y_m + half) / self.cell_m);
        let last = (self.points - 1) as f64;
        let inside = (0.0..=last).contains(&gx) && (0.0..=last).contains(&gy);
        if !inside {
            return None; // also where x or y is not a number
        }
        let (ix, iy) = (
            (gx as usize).min(self.points - 2),
            (gy as usize).min(self.points - 2),
        );
        let (u, v) = (gx - ix as f64, gy - iy as f64);
        let h = |dx: usize, dy: usize| f64::from(self.at(ix + dx, iy + dy));
        let (du, dv) = if u >= v {
            (h(1, 0) - h(0, 0), h(1, 1) - h(1, 0))
        } else {
            (h(1, 1) - h(0, 1), h(0, 1) - h(0, 0))
        };
        Some((
            h(0, 0) + u * du + v * dv,
            [du / self.cell_m, dv / self.cell_m],
        ))
    }
}

/// The ground every lane stands on.
#[derive(Debug, Clone, PartialEq)]
pub enum Terrain {
    /// The plane z = 0, without end.
    Flat,
    /// A height field, and the plane around it.
    HeightField(HeightGrid),
}

impl Terrain {
    /// Draws the terrain of `config` from `seed`.
    ///
    /// # Errors
    /// [`SimError::Config`] when a field is out of range.
    pub fn generate(config: &TerrainConfig, seed: u64) -> Result<Self, SimError> {
        config.validate()?;
        if config.kind == TerrainKind::Flat {
            return Ok(Self::Flat);
        }
        let mut stream = Stream::new(Key::for_run(seed), Purpose::Terrain);
        let points = (config.size_m / config.cell_m).round() as usize + 1;
        let slope = config.slope_deg.to_radians().tan();
        let mut heights = match config.kind {
            TerrainKind::Flat | TerrainKind::Rugged => vec![0.0; points * points],
            TerrainKind::Hills | TerrainKind::Rough => hills(config, points, slope, &mut stream),
            TerrainKind::Valley => valley(config, points, slope),
        };
        if matches!(config.kind, TerrainKind::Rugged | TerrainKind::Rough) {
            for h in &mut heights {
                *h += stream.uniform_f64(0.0, config.height_m);
            }
        }
        lower_margin(&mut heights, points, config.cell_m);
        let heights_m = heights.iter().map(|&h| h as f32).collect();
        Ok(Self::HeightField(HeightGrid {
            points,
            cell_m: config.cell_m,
            heights_m,
        }))
    }

    /// Height of the ground at `(x, y)`, world, m.
    #[must_use]
    pub fn height_m(&self, x_m: f32, y_m: f32) -> f32 {
        match self {
            Self::Flat => 0.0,
            Self::HeightField(grid) => grid
                .sample(f64::from(x_m), f64::from(y_m))
                .map_or(-APRON_DROP_M as f32, |(h, _)| h as f32),
        }
    }

    /// Unit normal of the ground at `(x, y)`, world.
    #[must_use]
    pub fn normal(&self, x_m: f32, y_m: f32) -> [f32; 3] {
        let slope = match self {
            Self::Flat => None,
            Self::HeightField(grid) => grid.sample(f64::from(x_m), f64::from(y_m)),
        };
        let [sx, sy] = slope.map_or([0.0, 0.0], |(_, s)| s);
        let length = (sx * sx + sy * sy + 1.0).sqrt();
        [
            (-sx / length) as f32,
            (-sy / length) as f32,
            (1.0 / length) as f32,
        ]
    }
}

/// Sum of sine waves of random direction and phase, scaled so that no facet is steeper than `slope`, lowest point 0.
fn hills(config: &TerrainConfig, points: usize, slope: f64, stream: &mut Stream) -> Vec<f64> {
    let waves: Vec<[f64; 4]> = (0..HILL_WAVES)
        .map(|_| {
            let wavelength = config.wavelength_m * stream.uniform_f64(1.0, 3.0);
            let (sin, cos) = stream.uniform_f64(0.0, TAU).sin_cos();
            let phase = stream.uniform_f64(0.0, TAU);
            // amplitude proportional to the wavelength: every wave is equally steep
            [
                cos * TAU / wavelength,
                sin * TAU / wavelength,
                phase,
                wavelength,
            ]
        })
        .collect();
    let mut heights = Vec::with_capacity(points * points);
    for iy in 0..points {
        for ix in 0..points {
            let (x, y) = (ix as f64 * config.cell_m, iy as f64 * config.cell_m);
            heights.push(
                waves
                    .iter()
                    .map(|[kx, ky, phase, a]| a * (kx * x + ky * y + phase).sin())
                    .sum(),
            );
        }
    }
    let steepest = steepest_facet(&heights, points, config.cell_m).max(1e-12);
    let lowest = heights.iter().copied().fold(f64::INFINITY, f64::min);
    for h in &mut heights {
        *h = (*h - lowest) * slope / steepest;
    }
    heights
}

/// Floor 1 m wide along x, walls of constant slope.
fn valley(config: &TerrainConfig, points: usize, slope: f64) -> Vec<f64> {
    const FLOOR_HALF_WIDTH_M: f64 = 0.5;
    let half = config.cell_m * (points - 1) as f64 / 2.0;
    (0..points * points)
        .map(|i| {
            let y = (i / points) as f64 * config.cell_m - half;
            (y.abs() - FLOOR_HALF_WIDTH_M).max(0.0) * slope
        })
        .collect()
}

/// Largest |∇z| over all facets.
fn steepest_facet(heights: &[f64], points: usize, cell_m: f64) -> f64 {
    let mut steepest = 0.0_f64;
    for iy in 0..points - 1 {
        for ix in 0..points - 1 {
            let h = |dx: usize, dy: usize| heights[(iy + dy) * points + ix + dx];
            let right = (h(1, 0) - h(0, 0)).hypot(h(1, 1) - h(1, 0));
            let left = (h(1, 1) - h(0, 1)).hypot(h(0, 1) - h(0, 0));
            steepest = steepest.max(right).max(left);
        }
    }
    steepest / cell_m
}

/// Ramps the outermost [`MARGIN_M`] down to 0.
fn lower_margin(heights: &mut [f64], points: usize, cell_m: f64) {
    for iy in 0..points {
        for ix in 0..points {
            let steps = ix.min(iy).min(points - 1 - ix).min(points - 1 - iy);
            heights[iy * points + ix] *= (steps as f64 * cell_m / MARGIN_M).min(1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grid(config: &TerrainConfig, seed: u64) -> HeightGrid {
        match Terrain::generate(config, seed).unwrap() {
            Terrain::HeightField(g) => g,
            Terrain::Flat => panic!("expected a height field"),
        }
    }

    fn config(kind: TerrainKind) -> TerrainConfig {
        TerrainConfig {
            kind,
            ..TerrainConfig::default()
        }
    }

    #[test]
    fn heights_are_interpolated_on_two_triangles() {
        // One cell of 2 m: corners h00 = 0, h10 = 1, h01 = 2, h11 = 5 (first index x).
        let t = Terrain::HeightField(HeightGrid {
            points: 2,
            cell_m: 2.0,
            heights_m: vec![0.0, 1.0, 2.0, 5.0],
        });
        // u = 0.75, v = 0.25 (right triangle): 0 + 0.75·1 + 0.25·(5 − 1) = 1.75
        assert!((t.height_m(0.5, -0.5) - 1.75).abs() < 1e-6);
        // u = 0.25, v = 0.75 (left triangle): 0 + 0.25·(5 − 2) + 0.75·2 = 2.25
        assert!((t.height_m(-0.5, 0.5) - 2.25).abs() < 1e-6);
        // slopes there: ∂x = 3/2, ∂y = 2/2 → normal ∝ (−1.5, −1, 1), length √4.25
        let n = t.normal(-0.5, 0.5);
        let l = 4.25_f32.sqrt();
        for (got, want) in n.iter().zip([-1.5 / l, -1.0 / l, 1.0 / l]) {
            assert!((got - want).abs() < 1e-6);
        }
        assert_eq!(t.height_m(1.5, 0.0), -APRON_DROP_M as f32);
        assert_eq!(t.height_m(f32::NAN, 0.0), -APRON_DROP_M as f32);
    }

    #[test]
    fn hills_reach_their_slope_and_no_more() {
        let g = grid(&config(TerrainKind::Hills), 3);
        let mut steepest = 0.0_f64;
        for i in 0..4000 {
            // inside the margin, points off the grid lines
            let x = -6.9 + f64::from(i % 63) * 0.219;
            let y = -6.9 + f64::from(i / 63) * 0.217;
            let (_, [sx, sy]) = g.sample(x, y).unwrap();
            steepest = steepest.max(sx.hypot(sy));
        }
        let limit = 15.0_f64.to_radians().tan();
        assert!(steepest <= limit + 1e-6, "slope {steepest}");
        assert!(steepest > 0.6 * limit, "slope {steepest}");
    }

    #[test]
    fn rugged_stays_within_its_height_and_ends_at_zero() {
        let g = grid(&config(TerrainKind::Rugged), 3);
        assert!(g.heights_m.iter().all(|&h| (0.0..=0.04).contains(&h)));
        assert!(g.heights_m.iter().any(|&h| h > 0.038));
        assert!((0..g.points).all(|i| g.at(i, 0) == 0.0 && g.at(0, i) == 0.0));
    }

    #[test]
    fn valley_walls_rise() {
        let t = Terrain::generate(&config(TerrainKind::Valley), 0).unwrap();
        assert_eq!(t.height_m(1.0, 0.3), 0.0);
        // 2.5 m from the middle: 2 m of wall at 15°
        let want = 2.0 * 15.0_f64.to_radians().tan();
        assert!((f64::from(t.height_m(-1.0, -2.5)) - want).abs() < 1e-4);
    }

    #[test]
    fn same_seed_same_ground() {
        for kind in [TerrainKind::Hills, TerrainKind::Rugged, TerrainKind::Rough] {
            let c = config(kind);
            assert_eq!(grid(&c, 7), grid(&c, 7));
            assert_ne!(grid(&c, 7), grid(&c, 8));
        }
    }

    #[test]
    fn refuses_what_is_out_of_range() {
        let tiny = TerrainConfig {
            cell_m: 0.001,
            ..config(TerrainKind::Rugged)
        };
        assert!(
            Terrain::generate(&tiny, 0)
                .unwrap_err()
                .to_string()
                .starts_with("terrain.cell_m = 0.001")
        );
        let many = TerrainConfig {
            size_m: 100.0,
            cell_m: 0.02,
            ..config(TerrainKind::Rugged)
        };
        assert!(many.validate().is_err());
        let nan = TerrainConfig {
            slope_deg: f64::NAN,
            ..config(TerrainKind::Hills)
        };
        assert!(nan.validate().is_err());
    }
}
