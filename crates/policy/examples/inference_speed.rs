//! Inferences per second of ONNX Runtime on one thread, for the quick and the paper's network.
#![allow(clippy::print_stdout)]

#[path = "common/mod.rs"]
mod common;

use std::error::Error;
use std::time::{Duration, Instant};

use caudata_policy::{Activation, Inference, PolicyFile, build_onnx};

/// How long each figure is measured.
const MEASURE: Duration = Duration::from_secs(1);

fn main() -> Result<(), Box<dyn Error>> {
    for hidden in [&[128, 128][..], &[512, 256, 128]] {
        let spec = common::network(hidden, Activation::Elu);
        let bytes = build_onnx(&spec, &common::metadata()?)?;
        let mut inference = Inference::new(&PolicyFile::parse(bytes.into())?, 1)?;
        for lanes in [1, 64, 256] {
            let obs = vec![0.1; lanes * 97];
            let mut actions = vec![0.0; lanes * 16];
            inference.run(&obs, lanes, &mut actions)?;
            // The fastest run is what the code takes; the median shows what else the machine does.
            let mut runs_us = Vec::new();
            let start = Instant::now();
            while start.elapsed() < MEASURE {
                let run = Instant::now();
                inference.run(&obs, lanes, &mut actions)?;
                runs_us.push(run.elapsed().as_secs_f64() * 1e6);
            }
            runs_us.sort_by(f64::total_cmp);
            let (best_us, median_us) = (runs_us[0], runs_us[runs_us.len() / 2]);
            println!(
                "97-{hidden:?}-16, N = {lanes}: {best_us:.1} us (median {median_us:.1}), {:.0} inferences/s",
                lanes as f64 * 1e6 / best_us
            );
        }
    }
    Ok(())
}
