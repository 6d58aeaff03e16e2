//! Terrains and places on the command line.

use caudata_sim::TerrainKind;
use clap::builder::{PossibleValuesParser, TypedValueParser};

/// The kinds of terrain, as words on the command line.
pub fn terrain_parser() -> impl TypedValueParser<Value = TerrainKind> {
    PossibleValuesParser::new(TerrainKind::ALL.map(TerrainKind::name)).map(|name| {
        let named = |kind: &TerrainKind| kind.name() == name;
        TerrainKind::ALL
            .into_iter()
            .find(named)
            .unwrap_or(TerrainKind::Flat)
    })
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
