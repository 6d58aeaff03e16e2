//! `caudata config`: the configuration in effect.

use caudata_config::{ConfigArgs, PRESETS};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand};

use crate::say;

#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Print every key with its value in effect, as TOML
    Show(ShowArgs),
    /// Check a configuration and say nothing more than that it is good
    Check(ConfigArgs),
    /// List the presets
    Presets,
}

#[derive(Debug, Args)]
pub struct ShowArgs {
    #[command(flatten)]
    config: ConfigArgs,
    /// One JSON object instead of TOML
    #[arg(long)]
    json: bool,
}

pub fn run(command: &ConfigCommand) -> Result<(), Failure> {
    match command {
        ConfigCommand::Show(args) => show(args),
        ConfigCommand::Check(args) => {
            let config = args.load().or_exit(ExitCode::BadConfig)?;
            say::line(format!("good; hash {}", config.hash_hex()));
            Ok(())
        }
        ConfigCommand::Presets => {
            let rows = PRESETS
                .iter()
                .map(|preset| vec![preset.name.into(), preset.about.into()]);
            say::table(&[], rows);
            Ok(())
        }
    }
}

fn show(args: &ShowArgs) -> Result<(), Failure> {
    let config = args.config.load().or_exit(ExitCode::BadConfig)?;
    if args.json {
        return say::json(&config);
    }
    say::line(config.to_toml().or_exit(ExitCode::BadConfig)?.trim_end());
    Ok(())
}
