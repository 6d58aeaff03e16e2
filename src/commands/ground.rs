//! Terrains and places on the command line.

use caudata_sim::TerrainKind;
use clap::ValueEnum;
use clap::builder::PossibleValue;

/// A [`TerrainKind`] that clap can read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ground(pub TerrainKind);

const ALL: [Ground; TerrainKind::ALL.len()] = {
    let mut all = [Ground(TerrainKind::Flat); TerrainKind::ALL.len()];
    let mut i = 0;
    while i < all.len() {
        all[i] = Ground(TerrainKind::ALL[i]);
        i += 1;
    }
    all
};

impl ValueEnum for Ground {
    fn value_variants<'a>() -> &'a [Self] {
        &ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.0.name()))
    }
}

/// Reads `X,Y`.
pub fn pair(text: &str) -> Result<[f32; 2], String> {
    let parts: Vec<f32> = text
        .split(',')
        .map(|part| {
            part.trim()
                .parse()
                .map_err(|_| format!("`{part}` is not a number"))
        })
        .collect::<Result<_, _>>()?;
    match parts.as_slice() {
        [x, y] if x.is_finite() && y.is_finite() => Ok([*x, *y]),
        _ => Err("must be two numbers, like 0.5,-1".to_owned()),
    }
}
