//! `caudata`: the command line. Each command is thin: the work is in the crates.
// Printing to standard output is what a command line is for.
#![allow(clippy::print_stdout)]

mod commands;
mod say;

use caudata_telemetry::{Failure, LogArgs, Process, parse_args};
use clap::{CommandFactory, Parser, Subcommand};

/// Trains whole-body locomotion policies for a salamander robot and carries them to the robot.
///
/// A first run: `caudata train --preset quick`. It takes about a minute on two cores and ends with
/// the paths of its curves, its policy and a log of the simulated robot.
#[derive(Debug, Parser)]
#[command(name = "caudata", version, verbatim_doc_comment, after_help = EXIT_CODES)]
struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    log: LogArgs,
}

const EXIT_CODES: &str = "\
Exit codes: 0 done · 64 configuration or flag · 65 bad input file · 66 input missing · 69 service gone
  70 internal · 71 port in use or system resource · 73 output cannot be made · 74 disk full or I/O
  75 starved or timed out · 76 protocol · 77 policy refused · 78 checkpoint damaged · 79 target missed
  80 ambiguous · 81 partly explained · 82 unexplained · 83 insufficient data · 84 data fault
  86 torque may be on · 87 run folder in use · 130 interrupted twice";

#[derive(Debug, Subcommand)]
enum Command {
    /// Train on this machine: start, watch and stop everything, then evaluate the policy
    Train(commands::train::TrainArgs),
    /// Change settings of a training that runs: weights of rewards, learning rate, ranges of commands and
    /// randomisation
    Tune(say::WithJson<commands::tune::Wish>),
    /// Run this host's part of a cluster: policy server, learner, some actors; or go on with it
    Up(commands::cluster::up::UpArgs),
    /// Run actors on this host for a learner elsewhere
    Actors(commands::cluster::actors::ActorsArgs),
    /// Show a running training at a glance
    Status(commands::cluster::status::StatusArgs),
    /// Make the certificates of a lab
    #[command(subcommand)]
    Pki(commands::cluster::pki::PkiCommand),
    /// Drive a robot in the browser, under a policy
    Play(commands::play::PlayArgs),
    /// Measure a policy in simulation
    Eval(commands::eval::EvalArgs),
    /// Why a run's policy does not walk: the most likely mistake in its task or robot, what to change, and
    /// short trainings that show it
    Explain(say::WithJson<caudata_explain::Plan>),
    /// Runs of training side by side
    #[command(subcommand)]
    Runs(commands::runs::RunsCommand),
    /// A training for each seed and each point of a grid of settings, and a table of them
    Sweep(say::WithJson<commands::sweep::Plan>),
    /// Print or check the configuration in effect
    #[command(subcommand)]
    Config(commands::config::ConfigCommand),
    /// Simulate without training
    #[command(subcommand)]
    Sim(commands::sim::SimCommand),
    /// Policies: on a policy server, or in a file
    #[command(subcommand)]
    Policy(commands::policy::PolicyCommand),
    /// Robot files: check them, make one from another format
    #[command(subcommand, alias = "robot-model")]
    Robot(commands::robot::RobotCommand),
    /// What a task is made of
    #[command(subcommand)]
    Task(commands::task::TaskCommand),
    /// Logs of robots and simulations, in the forms that other tools open
    #[command(subcommand)]
    Log(commands::log::LogCommand),
    /// Show what the simulation gets wrong, name the cause, extend the model
    #[command(subcommand)]
    Gap(commands::gap::GapCommand),
    /// From measured logs to a policy for the robot as it is: diagnose, train in the extended model,
    /// evaluate, publish
    Adapt(commands::adapt::AdaptArgs),
    /// Measure how fast the parts are on this machine
    #[command(subcommand)]
    Bench(commands::bench::BenchCommand),
    /// Print what a shell needs to complete these commands
    Completions(commands::shell::CompletionsArgs),
    /// Write these pages as man pages
    #[command(hide = true)]
    Man(commands::shell::ManArgs),
}

fn main() -> std::process::ExitCode {
    let mut args: Args = parse_args();
    if args.log.log == QUIET_DEFAULT_OF.0 {
        // On a terminal the progress line belongs to the user; the children's logs are in files.
        args.log.log = QUIET_DEFAULT_OF.1.to_owned();
    }
    Process::run("caudata", &args.log, |process| {
        dispatch(&args.command, process).and_then(|()| say::written())
    })
}

/// The shared default filter, and what the command line makes of it.
const QUIET_DEFAULT_OF: (&str, &str) = ("info", "warn");

fn dispatch(command: &Command, process: &Process) -> Result<(), Failure> {
    match command {
        Command::Train(args) => commands::train::run(args, process),
        Command::Up(args) => commands::cluster::up::run(args, process),
        Command::Actors(args) => commands::cluster::actors::run(args, process),
        Command::Status(args) => commands::cluster::status::run(args),
        Command::Pki(command) => commands::cluster::pki::run(command),
        Command::Play(args) => commands::play::run(args, process),
        Command::Eval(args) => commands::eval::run(args, process),
        Command::Explain(args) => commands::explain::run(args, process),
        Command::Sweep(args) => commands::sweep::run(&args.plan, args.json, process),
        Command::Tune(args) => commands::tune::run(&args.plan, args.json, process),
        Command::Runs(command) => commands::runs::run(command),
        Command::Config(command) => commands::config::run(command),
        Command::Sim(command) => commands::sim::run(command, &process.stop),
        Command::Policy(command) => commands::policy::run(command),
        Command::Robot(command) => commands::robot::run(command),
        Command::Task(command) => commands::task::run(command),
        Command::Log(command) => commands::log::run(command),
        Command::Gap(command) => commands::gap::run(command, process),
        Command::Adapt(args) => commands::adapt::run(args, process),
        Command::Bench(command) => commands::bench::run(command),
        Command::Completions(args) => commands::shell::completions(args, Args::command()),
        Command::Man(args) => commands::shell::man(args, Args::command()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The page of a command and, below it, those of its subcommands.
    fn write_pages(command: &mut clap::Command, path: &str, out: &mut String) {
        use std::fmt::Write;
        let help = command.render_help().to_string();
        let lines: Vec<&str> = help.lines().map(str::trim_end).collect();
        write!(out, "\n## {path}\n\n```text\n{}\n```\n", lines.join("\n").trim()).unwrap();
        for inner in command
            .get_subcommands_mut()
            .filter(|inner| inner.get_name() != "help" && !inner.is_hide_set())
        {
            let path = format!("{path} {}", inner.get_name());
            write_pages(inner, &path, out);
        }
    }

    /// `docs/reference/command-line.md` is what `-h` prints. When this fails, run it with
    /// `CAUDATA_WRITE_DOCS=1`, read what has changed, and commit it.
    #[test]
    fn the_help_reads_as_it_is_documented() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/reference/command-line.md");
        let mut page = String::from(
            "# Command line\n\nWhat `-h` prints; `--help` says more. Made by a test in `src/main.rs`; edit the flags there.\n",
        );
        let mut command = Args::command();
        command.build();
        write_pages(&mut command, "caudata", &mut page);
        if std::env::var_os("CAUDATA_WRITE_DOCS").is_some() {
            std::fs::write(path, &page).unwrap();
        }
        let kept = std::fs::read_to_string(path).unwrap_or_default();
        assert!(
            kept == page,
            "docs/reference/command-line.md is out of date: run this test with CAUDATA_WRITE_DOCS=1"
        );
    }

    #[test]
    fn the_exit_codes_of_the_help_are_those_of_the_program() {
        for code in caudata_telemetry::ExitCode::all() {
            let number = code.number().to_string();
            assert!(
                EXIT_CODES.split_whitespace().any(|word| word == number),
                "{number} is missing"
            );
        }
    }
}
