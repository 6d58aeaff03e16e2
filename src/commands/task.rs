//! `caudata task`: what a task file may name, and a first one for a robot.

use std::path::PathBuf;

use caudata_config::Config;
use caudata_task::expression::{FUNCTIONS, Known, SIGNALS};
use caudata_task::layout::Part;
use caudata_task::reward::{Sense, TERMS};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;

use crate::commands::robot;
use crate::say;

#[derive(Debug, Subcommand)]
pub enum TaskCommand {
    /// List reward and observation terms, and the signals and functions that a term of one's own may use
    Terms {
        /// One JSON object instead of tables
        #[arg(long)]
        json: bool,
    },
    /// Print a first task file for a robot: what follows from its size, mass, legs and servos
    New {
        /// The robot file
        #[arg(long, value_name = "FILE.robot.toml")]
        robot: PathBuf,
    },
}

pub fn run(command: &TaskCommand) -> Result<(), Failure> {
    match command {
        TaskCommand::Terms { json: true } => terms_json(),
        TaskCommand::Terms { json: false } => {
            terms();
            Ok(())
        }
        TaskCommand::New { robot: file } => {
            let model = robot::load(file)?;
            let text = Config::derived(&model).or_exit(ExitCode::BadInput)?;
            say::line(text.trim_end());
            Ok(())
        }
    }
}

/// One line of documentation: its spaces and code marks are for readers of code.
fn plain(about: &str) -> String {
    about.trim().replace(['`', '[', ']'], "")
}

fn terms() {
    say::line("Reward terms: weights in [task.reward.weights]; own ones in [[task.reward.term]]");
    let rows = TERMS.iter().map(|term| {
        let sense = match term.sense {
            Sense::Reward => "reward",
            Sense::Guide => "guide",
            Sense::Cost => "cost",
        };
        let weight = format!("{}", term.default_weight);
        [term.name, sense, term.unit, &weight, &plain(term.about)].map(str::to_owned).to_vec()
    });
    say::table(&["term", "", "unit", "weight", "value"], rows);
    say::line("\nObservation terms: [[task.observation.term]] name = ..., or name and value");
    let rows = Part::ALL.map(|part| {
        let frame = part.frame(&["each foot".to_owned()]);
        vec![part.name().to_owned(), part.unit().to_owned(), frame]
    });
    say::table(&["term", "unit", "values"], rows);
    say::line("\nSignals for values of one's own (radians are pure numbers)");
    let rows = SIGNALS.iter().map(|signal| {
        let known = match signal.known {
            Known::Sensed => "robot and simulation",
            Known::Simulated => "simulation",
        };
        let unit = signal.unit.to_string();
        [signal.name, signal.shape.name(), &unit, known, &plain(signal.about)]
            .map(str::to_owned)
            .to_vec()
    });
    say::table(&["signal", "values", "unit", "known to", ""], rows);
    say::line("\nFunctions, beside + - * / ^ < > <= >= and .x .y .z .JOINT .FOOT");
    let rows = FUNCTIONS.iter().map(|function| {
        let arguments = ["a", "b", "c"][..function.arguments].join(", ");
        let call = format!("{}({arguments})", function.name);
        vec![call, function.about.to_owned()]
    });
    say::table(&[], rows);
}

fn terms_json() -> Result<(), Failure> {
    let rewards = TERMS.iter().map(|term| {
        serde_json::json!({
            "name": term.name,
            "cost": term.sense == Sense::Cost,
            "unit": term.unit,
            "default_weight": term.default_weight,
            "about": plain(term.about),
        })
    });
    let observations =
        Part::ALL.map(|part| serde_json::json!({ "name": part.name(), "unit": part.unit() }));
    let signals = SIGNALS.iter().map(|signal| {
        serde_json::json!({
            "name": signal.name,
            "values": signal.shape.name(),
            "unit": signal.unit.to_string(),
            "sensed": signal.known == Known::Sensed,
            "about": plain(signal.about),
        })
    });
    let functions = FUNCTIONS.iter().map(|function| {
        serde_json::json!({
            "name": function.name,
            "arguments": function.arguments,
            "about": function.about,
        })
    });
    say::json(&serde_json::json!({
        "rewards": rewards.collect::<Vec<_>>(),
        "observations": observations,
        "signals": signals.collect::<Vec<_>>(),
        "functions": functions.collect::<Vec<_>>(),
    }))
}
