//! Inferences per second of ONNX Runtime on one thread, for the quick and the paper's network.
#![allow(clippy::print_stdout)]

#[path = "common/mod.rs"]
mod common;

use std::error::Error;
use std::time::{Duration, Instant};

use caudata_policy::{Activation, Inference, PolicyFile, build_onnx};

/// How long each figure is measured.
const MEASURE: Duration = Duration::from_millis(500);

fn main() -> Result<(), Box<dyn Error>> {
    for hidden in [&[128, 128][..], &[512, 256, 128]] {
        let spec = common::network(hidden, Activation::Elu);
        let bytes = build_onnx(&spec, &common::metadata()?)?;
        let mut inference = Inference::new(&PolicyFile::parse(bytes.into())?, 1)?;
        for lanes in [1, 64, 256] {
            let obs = vec![0.1; lanes * 97];
            let mut actions = vec![0.0; lanes * 16];
            inference.run(&obs, lanes, &mut actions)?;
            let (start, mut runs) = (Instant::now(), 0_u32);
            while start.elapsed() < MEASURE {
                inference.run(&obs, lanes, &mut actions)?;
                runs += 1;
            }
            let run_us = start.elapsed().as_secs_f64() * 1e6 / f64::from(runs);
            println!(
                "97-{hidden:?}-16, N = {lanes}: {run_us:.1} us per run, {:.0} inferences/s",
                lanes as f64 * 1e6 / run_us
            );
        }
    }
    Ok(())
}
