//! The ground and the water over it: flat, or a height field drawn from a seed.
//!
//! `config.rs` says what can be asked for, `generate.rs` draws it, `grid.rs` holds and interpolates it. World
//! frame: z up; all heights are ≥ 0, so that the one plane under every height field lies at
//! −[`APRON_DROP_M`].

mod config;
mod generate;
mod grid;
mod map;

use caudata_model::RobotModel;

use crate::SimError;

pub use config::{TerrainConfig, TerrainKind};
pub use grid::HeightGrid;

/// How far the plane around (and under) a height field lies below 0, m: deep enough that a foot on the field
/// never touches both.
pub const APRON_DROP_M: f64 = 0.002;

/// The ground every lane stands on, and the still water that may cover it.
#[derive(Debug, Clone, PartialEq)]
pub struct Terrain {
    /// `None`: the plane z = 0, without end.
    grid: Option<HeightGrid>,
    /// Height of the water's surface, world, m; `None`: dry. Below it is water wherever the ground is lower,
    /// without end.
    pub water_level_m: Option<f32>,
}

impl Terrain {
    /// The dry plane z = 0, without end.
    pub fn flat() -> Self {
        Self { grid: None, water_level_m: None }
    }

    /// Refuses a robot that would be in water and whose file does not say how that acts.
    ///
    /// # Errors
    /// [`SimError::NoWater`].
    pub fn check_robot(&self, robot: &RobotModel) -> Result<(), SimError> {
        match self.water_level_m {
            Some(_) if robot.water().is_none() => {
                Err(SimError::NoWater { robot: robot.name().to_owned() })
            }
            _ => Ok(()),
        }
    }

    /// Draws the terrain of `config` from `seed`.
    ///
    /// # Errors
    /// [`SimError::Config`] when a field is out of range.
    pub fn generate(config: &TerrainConfig, seed: u64) -> Result<Self, SimError> {
        config.validate()?;
        Ok(Self {
            grid: generate::grid(config, seed)?,
            water_level_m: config.surface_m().map(|z| z as f32),
        })
    }

    /// The height field; `None` on the plane without end.
    pub fn grid(&self) -> Option<&HeightGrid> {
        self.grid.as_ref()
    }

    /// Height of the ground at `(x, y)`, world, m.
    pub fn height_m(&self, x_m: f32, y_m: f32) -> f32 {
        match &self.grid {
            None => 0.0,
            Some(grid) => grid
                .sample(f64::from(x_m), f64::from(y_m))
                .map_or(-APRON_DROP_M as f32, |(h, _)| h as f32),
        }
    }

    /// Unit normal of the facet at `(x, y)`, world.
    pub fn normal(&self, x_m: f32, y_m: f32) -> [f32; 3] {
        let slope = self.grid.as_ref().and_then(|g| g.sample(f64::from(x_m), f64::from(y_m)));
        let [sx, sy] = slope.map_or([0.0, 0.0], |(_, s)| s);
        let length = (sx * sx + sy * sy + 1.0).sqrt();
        [(-sx / length) as f32, (-sy / length) as f32, (1.0 / length) as f32]
    }

    /// Factor on the robot's friction coefficients at `(x, y)`; 1 but on slippery patches.
    pub fn friction_factor(&self, x_m: f32, y_m: f32) -> f32 {
        self.grid.as_ref().map_or(1.0, |g| g.friction_factor(f64::from(x_m), f64::from(y_m)))
    }

    /// Whether any place has another friction factor than 1.
    pub fn has_patches(&self) -> bool {
        self.grid.as_ref().is_some_and(|g| g.friction().iter().any(|&f| f != 1.0))
    }

    /// A number that differs between terrains (FNV-1a over everything): snapshots keep it, to be restored on
    /// the same ground only.
    pub fn fingerprint(&self) -> u64 {
        const PRIME: u64 = 0x0000_0100_0000_01b3;
        let mut hash = 0xcbf2_9ce4_8422_2325_u64;
        let mut add = |word: u32| {
            hash = (hash ^ u64::from(word)).wrapping_mul(PRIME);
            hash ^= hash >> 32;
        };
        add(self.water_level_m.map_or(u32::MAX, f32::to_bits));
        if let Some(grid) = &self.grid {
            add(grid.points() as u32);
            add((grid.cell_m as f32).to_bits());
            let values = grid.heights_m().iter().chain(grid.friction());
            values.for_each(|v| add(v.to_bits()));
        }
        hash
    }
}

#[cfg(test)]
mod tests;
