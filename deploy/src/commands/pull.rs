//! `caudata-robot pull`.

use caudata_telemetry::Metrics;
use serde::Serialize;

use crate::DeployError;
use crate::commands::say::{say, say_json};
use crate::commands::source::{Source, SourceArgs};
use crate::state::PolicyRef;

#[derive(Debug, clap::Args)]
pub struct PullArgs {
    #[command(flatten)]
    source: SourceArgs,
    /// One JSON object as the last line of standard output
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Pulled<'a> {
    robot: &'a str,
    policy: &'a PolicyRef,
    bytes: usize,
    env_steps: u64,
}

pub fn run(args: &PullArgs) -> Result<(), DeployError> {
    let (source, _) = Source::open(&args.source, None, &Metrics::new())?;
    let verified = source.pull()?;
    let policy = &verified.policy;
    if args.json {
        return say_json(&Pulled {
            robot: source.model.name(),
            policy,
            bytes: verified.file.bytes().len(),
            env_steps: verified.file.metadata().env_steps,
        });
    }
    say(&format!("{policy}, sha256 {}", policy.sha256));
    Ok(())
}
