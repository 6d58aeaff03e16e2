//! `caudata task`: what a task file may name, and a first one for a robot.

use std::path::PathBuf;

use caudata_config::Config;
use caudata_task::expression::{FUNCTIONS, Known, SIGNALS};
use caudata_task::layout::Part;
use caudata_task::reward::{Sense, TERMS};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;
use serde_json::{Value, json};

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
        TaskCommand::Terms { json } => say::either(*json, &terms(), print),
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

/// What a task file may name.
fn terms() -> Value {
    let rewards = TERMS.iter().map(|term| {
        json!({
            "name": term.name,
            "sense": match term.sense {
                Sense::Reward => "reward",
                Sense::Guide => "guide",
                Sense::Cost => "cost",
            },
            "cost": term.sense == Sense::Cost,
            "unit": term.unit,
            "default_weight": term.default_weight,
            "about": plain(term.about),
        })
    });
    let observations = Part::ALL.map(|part| {
        let frame = part.frame(&["each foot".to_owned()]);
        json!({ "name": part.name(), "unit": part.unit(), "values": frame })
    });
    let signals = SIGNALS.iter().map(|signal| {
        json!({
            "name": signal.name,
            "values": signal.shape.name(),
            "unit": signal.unit.to_string(),
            "sensed": signal.known == Known::Sensed,
            "about": plain(signal.about),
        })
    });
    let functions = FUNCTIONS.iter().map(|f| {
        let call = format!("{}({})", f.name, ["a", "b", "c"][..f.arguments].join(", "));
        json!({ "name": f.name, "arguments": f.arguments, "call": call, "about": f.about })
    });
    json!({
        "rewards": rewards.collect::<Vec<_>>(),
        "observations": observations,
        "signals": signals.collect::<Vec<_>>(),
        "functions": functions.collect::<Vec<_>>(),
    })
}

/// The same as tables.
fn print(terms: &Value) {
    let table = |about: &str, list: &str, keys: &str| {
        say::line(about);
        say::records(terms[list].as_array().map_or(&[][..], Vec::as_slice), keys);
    };
    table(
        "Reward terms: weights in [task.reward.weights]; own ones in [[task.reward.term]]",
        "rewards",
        "name sense unit default_weight about",
    );
    table(
        "\nObservation terms: [[task.observation.term]] name = ..., or name and value",
        "observations",
        "name unit values",
    );
    table(
        "\nSignals for values of one's own (radians are pure numbers); sensed: known to the robot as well",
        "signals",
        "name values unit sensed about",
    );
    table(
        "\nFunctions, beside + - * / ^ < > <= >= and .x .y .z .JOINT .FOOT",
        "functions",
        "call about",
    );
}
