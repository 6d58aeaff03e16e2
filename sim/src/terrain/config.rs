//! `[terrain]` of the configuration file.

use std::path::PathBuf;

use caudata_declare::{named, settings};
use serde::{Deserialize, Serialize};

use crate::SimError;
use crate::config::{check_range, check_ranges};

/// Largest number of grid points along one edge: 16 MiB of heights.
const MAX_GRID_POINTS: f64 = 2048.0;

/// Coarsest cell of `steps`: their risers are one cell wide.
const STEPS_CELL_M: f64 = 0.02;

named! {
    /// Shape of the ground.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum TerrainKind {
        /// The plane z = 0, without end.
        Flat = "flat",
        /// Smooth hills; steepest slope `slope_deg`.
        Hills = "hills",
        /// Independent random heights from 0 to `height_m` at the grid points.
        Rugged = "rugged",
        /// `hills` with `rugged` on top.
        Rough = "rough",
        /// `rough` with 2 cm and 15°, whatever `height_m` and `slope_deg` say.
        RoughEasy = "rough_easy",
        /// `rough` with 4 cm and 15°.
        RoughMedium = "rough_medium",
        /// `rough` with 4 cm and 25°.
        RoughHard = "rough_hard",
        /// A valley along x: a floor 1 m wide, then walls rising with `slope_deg` on both sides.
        Valley = "valley",
        /// One plane that rises along +x with `slope_deg`, from edge to edge.
        Slope = "slope",
        /// Terraces along x: every `step_length_m` a drop of `height_m` towards +x. The origin is in the middle
        /// of one.
        Steps = "steps",
        /// Level ground with square patches of low friction.
        Slippery = "slippery",
        /// Land around the origin, a beach going down with `slope_deg` from x = 0.5 m on, then a pool; its
        /// surface at `water_level_m`.
        Shore = "shore",
        /// A pool without end: level ground at z = 0 under `water_level_m` of water.
        DeepWater = "deep_water",
        /// The paper's training ground in one field: four squares, flat, `hills`, `rugged` and `valley`, each
        /// ending at 0 at its border.
        Mixed = "mixed",
        /// Heights from the file `map`, stretched over the whole field.
        Map = "map",
    }
}

settings! {
    /// Table `[terrain]`.
    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct TerrainConfig {
        /// Shape of the ground: `flat`, `hills`, `rugged`, `rough`, `rough_easy`, `rough_medium`,
        /// `rough_hard`, `valley`, `slope`, `steps`, `slippery`, `shore`, `deep_water`, `mixed` or `map`.
        pub kind: TerrainKind = TerrainKind::Flat,
        /// Edge length of the square height field, m, 4..=100. Default 16: a 20 s episode at 0.3 m/s stays on
        /// it. `mixed` needs about twice that.
        pub size_m: f64 = 16.0,
        /// Distance of its grid points, m, 0.02..=1. Default 0.1: a foot ball (radius 19 mm) meets single
        /// facets. `steps` uses 0.02 at most, because its risers are one cell wide.
        pub cell_m: f64 = 0.1,
        /// Largest random height of `rugged` and `rough`, and drop of each of the `steps`, m, 0..=0.3.
        /// Default 0.04 (the paper's rugged terrain).
        pub height_m: f64 = 0.04,
        /// Steepest slope of `hills`, `rough`, `valley`, `slope` and `shore`, degrees, 0..=40. Default 15
        /// (the paper's hills and valley). Above about 38° (atan of foot friction 0.8) nothing stands.
        pub slope_deg: f64 = 15.0,
        /// Shortest wave of `hills` and `rough`, m, 0.5..=20; the longest is three times that. Default 2:
        /// about two body lengths.
        pub wavelength_m: f64 = 2.0,
        /// Length of each of the `steps`, m, 0.2..=20. Default 1.5: the robot (1.1 m) stands wholly on one
        /// before it meets the next.
        pub step_length_m: f64 = 1.5,
        /// Edge of the patches of `slippery`, m, 0.1..=5. Default 0.3: one foot at a time is on one; much
        /// larger, and whole strides are.
        pub patch_m: f64 = 0.3,
        /// Share of the ground of `slippery` that is slippery, 0..=1. Default 0.3.
        pub patch_share: f64 = 0.3,
        /// Factor on the friction coefficients there, 0..=1. Default 0.25: foot friction 0.8 becomes 0.2, wet
        /// tiles. 0 is perfect ice.
        pub patch_friction: f64 = 0.25,
        /// Height of still water's surface above z = 0, m, 0..=10; any kind can be flooded. Default 0, which
        /// is dry but for `shore` (0.4 m) and `deep_water` (2 m: the robot, 1.1 m long, can dive upright).
        pub water_level_m: f64 = 0.0,
        /// How hard the ground is along its right edge (smallest y), as a share of what it is along its left
        /// edge, 0..=1: slopes (their tangents), steps and random heights grow evenly from the one to the
        /// other. `map`, `mixed` and `slippery` stay as they are. Default 1: the same everywhere. Below it a
        /// training whose episodes start all over the field meets every grade from the start, and learns the
        /// hard ones by the easy ones; too small: most of it is easy.
        pub easiest_share: f64 = 1.0,
        /// File of `map`: a square PNG in shades of grey, whose white is `height_m` high, or a square CSV of
        /// heights in m. Its first row has the largest y. Default empty.
        pub map: PathBuf,
    }
}

impl TerrainKind {
    /// Whether there is water whatever the other keys say.
    pub fn is_wet(self) -> bool {
        matches!(self, Self::Shore | Self::DeepWater)
    }
}

impl TerrainConfig {
    /// The defaults with another kind.
    pub fn of(kind: TerrainKind) -> Self {
        Self { kind, ..Self::default() }
    }

    /// Checks every field's range.
    ///
    /// # Errors
    /// [`SimError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), SimError> {
        #[rustfmt::skip]
        let ranges = [
            ("size_m", self.size_m, 4.0, 100.0, "must be 4 to 100 m"),
            ("cell_m", self.cell_m, 0.02, 1.0, "must be 0.02 to 1 m"),
            ("height_m", self.height_m, 0.0, 0.3, "must be 0 to 0.3 m"),
            ("slope_deg", self.slope_deg, 0.0, 40.0, "must be 0 to 40 degrees"),
            ("wavelength_m", self.wavelength_m, 0.5, 20.0, "must be 0.5 to 20 m"),
            ("step_length_m", self.step_length_m, 0.2, 20.0, "must be 0.2 to 20 m"),
            ("patch_m", self.patch_m, 0.1, 5.0, "must be 0.1 to 5 m"),
            ("patch_share", self.patch_share, 0.0, 1.0, "must be 0 to 1"),
            ("patch_friction", self.patch_friction, 0.0, 1.0, "must be 0 to 1"),
            ("easiest_share", self.easiest_share, 0.0, 1.0, "must be 0 to 1"),
            ("water_level_m", self.water_level_m, 0.0, 10.0, "must be 0 to 10 m"),
        ];
        check_ranges("terrain", &ranges)?;
        if self.kind == TerrainKind::Map && self.map.as_os_str().is_empty() {
            return Err(SimError::Config {
                table: "terrain",
                field: "map",
                value: "\"\"".to_owned(),
                reason: "must name a .png or .csv file for the kind `map`",
            });
        }
        if self.kind == TerrainKind::Shore {
            let gentlest = self.easiest_share * self.slope_deg.to_radians().tan();
            check_range(
                "terrain",
                "slope_deg",
                gentlest.atan().to_degrees(),
                2.0,
                40.0,
                "must be 2 to 40 degrees everywhere on a shore, or the land never reaches the water",
            )?;
        }
        check_range(
            "terrain",
            "cell_m",
            self.size_m / self.grid_cell_m(),
            1.0,
            MAX_GRID_POINTS,
            "gives more than 2048 grid points along an edge; use a larger cell or a smaller field",
        )
    }

    /// Distance of the grid points that are really drawn, m.
    pub(super) fn grid_cell_m(&self) -> f64 {
        match self.kind {
            TerrainKind::Steps => self.cell_m.min(STEPS_CELL_M),
            _ => self.cell_m,
        }
    }

    /// Largest random height, m, and steepest slope, degrees, with the grades of `rough` applied.
    pub(super) fn grade(&self) -> (f64, f64) {
        match self.kind {
            TerrainKind::RoughEasy => (0.02, 15.0),
            TerrainKind::RoughMedium => (0.04, 15.0),
            TerrainKind::RoughHard => (0.04, 25.0),
            _ => (self.height_m, self.slope_deg),
        }
    }

    /// Whether there is no land.
    pub fn is_deep_water(&self) -> bool {
        self.kind == TerrainKind::DeepWater
    }

    /// Height of the water's surface, m; `None`: dry.
    pub(super) fn surface_m(&self) -> Option<f64> {
        match self.kind {
            _ if self.water_level_m > 0.0 => Some(self.water_level_m),
            TerrainKind::Shore => Some(0.4),
            TerrainKind::DeepWater => Some(2.0),
            _ => None,
        }
    }
}
