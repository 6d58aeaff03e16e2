//! Terrains and places on the command line.

use caudata_runlog::{LogMeta, Setting};
use caudata_sim::{TerrainConfig, TerrainKind};
use clap::builder::{PossibleValuesParser, TypedValueParser};

/// The kinds of terrain, as words on the command line.
pub fn terrain_parser() -> impl TypedValueParser<Value = TerrainKind> {
    PossibleValuesParser::new(TerrainKind::ALL.map(TerrainKind::name)).map(|name| {
        // The parser let through no other word.
        TerrainKind::of_name(&name).unwrap_or(TerrainKind::Flat)
    })
}

/// Writes a terrain into the circumstances of a log: its kind, its seed, and each number that is not the default
/// as `terrain_<key>`.
pub fn note(meta: &mut LogMeta, terrain: &TerrainConfig, seed: u64) {
    let keys = |terrain: &TerrainConfig| match serde_json::to_value(terrain) {
        Ok(serde_json::Value::Object(keys)) => keys,
        _ => serde_json::Map::new(),
    };
    let defaults = keys(&TerrainConfig::default());
    meta.terrain = terrain.kind.name().to_owned();
    // as text: a number would lose digits beyond 2^53
    let seed = Setting::Text(seed.to_string());
    meta.settings.insert("seed".to_owned(), seed);
    for (key, value) in keys(terrain) {
        if let (Some(number), true) = (value.as_f64(), defaults.get(&key) != Some(&value)) {
            let value = Setting::Number(number);
            meta.settings.insert(format!("terrain_{key}"), value);
        }
    }
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
