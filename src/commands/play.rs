//! `caudata play`: a robot walks in the browser under a policy, and is driven there.

use std::path::PathBuf;
use std::time::Duration;

use caudata_config::ConfigArgs;
use caudata_live::{Policy, Show};
use caudata_sim::TerrainKind;
use caudata_studies::{files, flags};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;

use crate::commands::eval;
use crate::commands::ground::terrain_parser;
use crate::commands::page::PageArgs;
use crate::commands::robot;
use crate::say;

/// Pause between two looks whether to end.
const PAUSE: Duration = Duration::from_secs(1);

#[derive(Debug, Args)]
pub struct PlayArgs {
    /// The policy; without one the robot holds its nominal pose
    #[arg(value_name = "P.onnx")]
    policy: Option<PathBuf>,
    /// Shape of the ground at first; default: `[terrain]`
    #[arg(long, value_parser = terrain_parser())]
    terrain: Option<TerrainKind>,
    #[command(flatten)]
    page: PageArgs,
    /// The task; without these flags, the config.toml beside the policy, else the preset that it was trained with
    #[command(flatten)]
    config: ConfigArgs,
}

pub fn run(args: &PlayArgs, process: &Process) -> Result<(), Failure> {
    let (mut config, model, policy) = match &args.policy {
        Some(path) => {
            let policy = files::policy(path)?;
            let (config, model) = eval::task_of(path, &policy, &args.config)?;
            (config, model, Policy::Fixed(Box::new(policy)))
        }
        None => {
            let flags = flags::or_preset(&args.config, "quick");
            let (config, model) = robot::configured(&flags)?;
            (config, model, Policy::None)
        }
    };
    if let Some(kind) = args.terrain {
        config.terrain.kind = kind;
    }
    let show = Show { config, model, policy };
    // What cannot be shown is refused here, not on the page.
    show.check().or_exit(ExitCode::BadConfig)?;
    let page = args.page.serve(show, None, &|line| say::line(line))?;
    say::line(format!("page  {}", page.address()));
    say::line("Ctrl-C ends it");
    while !process.stop.wait(PAUSE) {}
    Ok(())
}
