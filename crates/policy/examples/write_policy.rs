//! Writes a policy with random weights, and an observation with its actions beside it, so that
//! other tools can be tried on them: `cargo run --example write_policy -- FOLDER`.

#[path = "common/mod.rs"]
mod common;

use std::error::Error;
use std::fs;
use std::path::PathBuf;

use caudata_policy::{Activation, build_onnx, evaluate_mlp};

fn main() -> Result<(), Box<dyn Error>> {
    let folder = PathBuf::from(std::env::args().nth(1).ok_or("name a folder")?);
    fs::create_dir_all(&folder)?;
    let obs: Vec<f32> = (0..97).map(|i| (i as f32 / 10.0).sin()).collect();
    for activation in Activation::ALL {
        let spec = common::network(&[128, 128], activation);
        let mut actions = vec![0.0; 16];
        evaluate_mlp(&spec, &obs, 1, &mut actions)?;
        let name = format!("{activation:?}").to_lowercase();
        fs::write(
            folder.join(format!("{name}.onnx")),
            build_onnx(&spec, &common::metadata()?)?,
        )?;
        let pair = serde_json::json!({ "obs": obs, "actions": actions });
        fs::write(folder.join(format!("{name}.json")), pair.to_string())?;
    }
    Ok(())
}
