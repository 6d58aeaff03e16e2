//! `caudata policy join`: one policy of two.

use std::path::PathBuf;

use caudata_policy::PolicyFile;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct JoinArgs {
    /// Acts while the value is below; its origin and version are those of the result
    #[arg(value_name = "LOW.onnx")]
    low: PathBuf,
    /// Acts while the value is above
    #[arg(value_name = "HIGH.onnx")]
    high: PathBuf,
    /// Which value of the observation: a term of one value (`medium`), or a component of one of three
    /// (`gravity.z`, −1 upright, 1 on its back)
    #[arg(long, value_name = "TERM[.AXIS]")]
    on: String,
    /// Below or above what
    #[arg(long, allow_negative_numbers = true)]
    at: f32,
    /// Where to write it
    #[arg(long, value_name = "P.onnx")]
    out: PathBuf,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn join(args: &JoinArgs) -> Result<(), Failure> {
    let (low, high) = (files::policy(&args.low)?, files::policy(&args.high)?);
    // an observation may begin with the other's
    let more = if low.spec().obs_dim() < high.spec().obs_dim() { &high } else { &low };
    let index = index_of(more, &args.on).ok_or_else(|| {
        let terms = more.metadata().contract.observation.slices().iter();
        let terms: Vec<String> = terms
            .filter_map(|s| match s.len {
                1 => Some(s.name.clone()),
                3 => Some(format!("{}.x, .y, .z", s.name)),
                _ => None,
            })
            .collect();
        Failure::message(
            ExitCode::BadInput,
            format!(
                "`--on {}`: the policy observes no such value; it has {}",
                args.on,
                terms.join("; ")
            ),
        )
    })?;
    let joined = caudata_policy::join(&low, &high, index, args.at).or_exit(ExitCode::BadInput)?;
    files::write_whole(&args.out, joined.bytes())?;
    let said =
        json!({ "on": args.on, "at": args.at, "sha256": joined.sha256_hex(), "out": args.out });
    say::either(args.json, &said, |_| {
        say::line(format!(
            "{}: below {} of {} as {}, above as {}",
            args.out.display(),
            args.at,
            args.on,
            args.low.display(),
            args.high.display()
        ));
    })
}

/// Where a value lies in the policy's observation.
fn index_of(policy: &PolicyFile, on: &str) -> Option<usize> {
    let (name, axis) = on.split_once('.').unwrap_or((on, ""));
    let slice = policy.metadata().contract.observation.slice(name)?;
    match (slice.len, axis) {
        (1, "") => Some(slice.start),
        (3, "x" | "y" | "z") => Some(slice.start + usize::from(axis.as_bytes()[0] - b'x')),
        _ => None,
    }
}
