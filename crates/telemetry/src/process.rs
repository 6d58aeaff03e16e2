//! The frame around every binary's work: logging, banner, signals, and one line when it fails.

use std::process::ExitCode as OsExitCode;

use crate::exit::{ExitCode, Failure, FailureExt};
use crate::logging::LogArgs;
use crate::parent::die_with_parent;
use crate::stop::{DRAIN_DEADLINE, Insistence, StopFlag};

/// What a running process has in its hands.
#[derive(Clone, Debug)]
pub struct Process {
    /// Name in logs, for instance `caudata-actor`.
    pub name: &'static str,
    /// Raised by the first SIGINT or SIGTERM, or when the supervisor dies.
    pub stop: StopFlag,
    /// What a second signal does.
    pub insistence: Insistence,
}

impl Process {
    /// Sets up logs and signals, runs `work`, prints a failure as `error: …` and `hint: …`, and
    /// returns the exit code.
    pub fn run(
        name: &'static str,
        log: &LogArgs,
        work: impl FnOnce(&Process) -> Result<(), Failure>,
    ) -> OsExitCode {
        Self::run_as(name, log, false, work)
    }

    /// As [`Process::run`]; `queued`, for a process that moves something: it never waits for whoever reads its log.
    pub fn run_as(
        name: &'static str,
        log: &LogArgs,
        queued: bool,
        work: impl FnOnce(&Process) -> Result<(), Failure>,
    ) -> OsExitCode {
        let process = Process { name, stop: StopFlag::new(), insistence: Insistence::default() };
        let result = process.set_up(log, queued).and_then(|()| work(&process));
        let mut words = Vec::new();
        let code = match result {
            Ok(()) => ExitCode::Ok,
            Err(failure) => {
                tracing::debug!(code = failure.code().number(), "ends with an error");
                // Writing to a Vec cannot fail.
                let _ = failure.write_to(&mut words);
                failure.code()
            }
        };
        crate::logging::last_words(&words);
        code.into()
    }

    fn set_up(&self, log: &LogArgs, queued: bool) -> Result<(), Failure> {
        match queued {
            true => crate::logging::init_queued_logging(self.name, log.log_format, &log.log),
            false => crate::logging::init_logging(self.name, log.log_format, &log.log),
        }
        .or_exit(ExitCode::BadConfig)?;
        crate::files::raise_file_limit();
        crate::stop::stop_on_signals(&self.stop, &self.insistence, DRAIN_DEADLINE)
            .or_exit_with(ExitCode::OsResource, || "cannot install signal handlers")?;
        die_with_parent(&self.stop);
        Ok(())
    }
}

/// Parses the command line; a wrong one ends the process with [`ExitCode::BadConfig`] (64), `--help` and
/// `--version` with 0.
pub fn parse_args<A: clap::Parser>() -> A {
    A::try_parse().unwrap_or_else(|error| {
        let _ = error.print();
        let code = if error.use_stderr() { ExitCode::BadConfig } else { ExitCode::Ok };
        std::process::exit(i32::from(code.number()))
    })
}
