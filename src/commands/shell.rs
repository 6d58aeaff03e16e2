//! `caudata completions` and `caudata man`: what a shell and a reader of manuals want to know of the
//! commands.

use std::io::Write;
use std::path::PathBuf;

use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap_complete::Shell;

#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// The shell; its script goes to standard output
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Folder for the pages, one for each command
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Prints the completions of `command`.
pub fn completions(args: &CompletionsArgs, mut command: clap::Command) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, "caudata", &mut script);
    // A reader that has gone away is no error.
    let _ = std::io::stdout().write_all(&script);
    Ok(())
}

/// Writes the pages of `command` and all below it.
pub fn man(args: &ManArgs, command: clap::Command) -> Result<(), Failure> {
    caudata_studies::files::make_folder(&args.out)?;
    clap_mangen::generate_to(command, &args.out)
        .or_exit_with(ExitCode::CannotCreate, || format!("cannot write {}", args.out.display()))
}
