//! `caudata policy average`: one policy from the last versions of a training.

use std::path::{Path, PathBuf};

use caudata_policy::PolicyFile;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct AverageArgs {
    /// Policies of one training, or its run folder: all that its policy server keeps
    #[arg(required = true, value_name = "RUN|P.onnx")]
    from: Vec<PathBuf>,
    /// Leave out older versions
    #[arg(long, default_value_t = 0)]
    least: u64,
    /// Leave out newer versions
    #[arg(long, default_value_t = u64::MAX, hide_default_value = true)]
    most: u64,
    /// Where to write it
    #[arg(long, value_name = "P.onnx")]
    out: PathBuf,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn average(args: &AverageArgs) -> Result<(), Failure> {
    let mut versions = Vec::new();
    for path in &args.from {
        for file in files_of(path)? {
            versions.push(files::policy(&file)?);
        }
    }
    versions.retain(|v| (args.least..=args.most).contains(&v.metadata().version));
    versions.sort_by_key(|v| v.metadata().version);
    versions.dedup_by_key(|v| v.metadata().version);
    let numbers = |v: Option<&PolicyFile>| v.map_or(0, |v| v.metadata().version);
    let (first, last) = (numbers(versions.first()), numbers(versions.last()));
    let mean = caudata_policy::average(&versions).or_exit(ExitCode::BadInput)?;
    files::write_whole(&args.out, mean.bytes())?;
    let said = json!({
        "versions": versions.len(), "first": first, "last": last,
        "sha256": mean.sha256_hex(), "out": args.out,
    });
    say::either(args.json, &said, |_| {
        let (n, out) = (versions.len(), args.out.display());
        say::line(format!("the mean of {n} versions, {first} to {last}, is in {out}"));
    })
}

/// The file itself, or every policy that the server of a run keeps.
fn files_of(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let kept = path.join("registry").join("blobs");
    let listed = std::fs::read_dir(&kept).or_exit_with(ExitCode::NoInput, || {
        format!(
            "no versions in {}: it is not the folder of a run with a policy server",
            kept.display()
        )
    })?;
    let paths = listed.filter_map(Result::ok).map(|entry| entry.path());
    Ok(paths.filter(|p| p.extension().is_some_and(|e| e == "onnx")).collect())
}
