//! Terrains and places on the command line.

use caudata_sim::TerrainKind;
use clap::builder::{PossibleValuesParser, TypedValueParser};

/// The kinds of terrain, as words on the command line.
pub fn terrain_parser() -> impl TypedValueParser<Value = TerrainKind> {
    PossibleValuesParser::new(TerrainKind::ALL.map(TerrainKind::name)).map(|name| {
        // The parser let through no other word.
        TerrainKind::of_name(&name).unwrap_or(TerrainKind::Flat)
    })
}

/// Reads `X,Y`.
pub fn pair(text: &str) -> Result<[f32; 2], String> {
    numbers(text).ok_or_else(|| "must be two numbers, like 0.5,-1".to_owned())
}

/// Reads `X,Y,Z`.
pub fn triple(text: &str) -> Result<[f32; 3], String> {
    numbers(text).ok_or_else(|| "must be three numbers, like 0.3,0,-0.1".to_owned())
}

/// Reads an angle of a turn at most.
pub fn degrees(text: &str) -> Result<f32, String> {
    match numbers(text) {
        Some([x]) if x.abs() <= 360.0 => Ok(x),
        _ => Err("must be -360 to 360 degrees".to_owned()),
    }
}

/// So many finite numbers with commas between them.
fn numbers<const N: usize>(text: &str) -> Option<[f32; N]> {
    let parts = text.split(',').map(|part| part.trim().parse::<f32>().ok());
    let parts: Vec<f32> = parts.collect::<Option<_>>()?;
    let parts: [f32; N] = parts.try_into().ok()?;
    parts.iter().all(|part| part.is_finite()).then_some(parts)
}
