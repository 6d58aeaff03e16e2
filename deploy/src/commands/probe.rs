//! `caudata-robot probe`: the child that looks at a candidate from standard input. People do not call it.

use std::io::Read;
use std::path::PathBuf;
use std::time::Instant;

use caudata_policy::MAX_FILE_BYTES;

use crate::DeployError;
use crate::commands::source::load_model;
use crate::probe::limit_this_process;
use crate::state::{PolicyRef, Sha256Digest};
use crate::verify::{Refusal, verify};

/// Runs whose time is taken.
const TIMED_RUNS: usize = 200;
/// Half of them must be faster: a quarter of a tick.
const MEDIAN_MAX_US: u128 = 5_000;

#[derive(Debug, clap::Args)]
pub struct ProbeArgs {
    #[arg(long)]
    robot: PathBuf,
    #[arg(long)]
    stream: String,
    #[arg(long)]
    version_number: u64,
    #[arg(long)]
    file_version: u64,
    #[arg(long)]
    sha256: Sha256Digest,
}

pub fn run(args: &ProbeArgs) -> Result<(), DeployError> {
    let model = load_model(&args.robot)?;
    limit_this_process()?;
    let mut bytes = Vec::new();
    std::io::stdin()
        .lock()
        .take(MAX_FILE_BYTES as u64 + 1)
        .read_to_end(&mut bytes)
        .map_err(DeployError::system("its standard input"))?;
    let policy = PolicyRef {
        stream: args.stream.clone(),
        version: args.version_number,
        sha256: args.sha256,
        reverts_to: (args.file_version != args.version_number).then_some(args.file_version),
    };
    let verified = verify(bytes.into(), &policy, &model);
    let mut verified = verified.map_err(|error| DeployError::unverified(&policy, error))?;
    let obs = verified.file.spec().obs_mean.clone();
    let mut actions = vec![0.0; verified.file.metadata().contract.act_dim()];
    let mut took = Vec::with_capacity(TIMED_RUNS);
    for _ in 0..TIMED_RUNS {
        let begun = Instant::now();
        let ran = verified.inference.run(&obs, 1, &mut actions);
        ran.map_err(|error| DeployError::refused(&policy, error))?;
        took.push(begun.elapsed().as_micros());
    }
    took.sort_unstable();
    let median_us = took[TIMED_RUNS / 2];
    if median_us > MEDIAN_MAX_US {
        return Err(DeployError::refused(&policy, Refusal::TooSlow { median_us }));
    }
    Ok(())
}
