//! `caudata gap effects`: the catalogue that diagnosis searches.

use caudata_gap::GapError;
use caudata_gap::effects::{self, ALL, Effect};
use caudata_gap::place::Domain;
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;

use crate::say;

#[derive(Debug, Args)]
pub struct EffectsArgs {
    /// Only these, with what tells them apart
    #[arg(value_name = "EFFECT")]
    ids: Vec<String>,
}

pub fn run(args: &EffectsArgs) -> Result<(), Failure> {
    if args.ids.is_empty() {
        let head = ["effect", "acts on", "parameters", "shown by"];
        say::table(&head, ALL.iter().map(|effect| row(effect)));
        return Ok(());
    }
    for id in &args.ids {
        let unknown = || Failure::new(ExitCode::BadConfig, GapError::UnknownEffect(id.clone()));
        one(effects::find(id).ok_or_else(unknown)?);
    }
    Ok(())
}

fn row(effect: &Effect) -> Vec<String> {
    let parameters: Vec<String> =
        effect.parameters.iter().map(|p| format!("{} ({})", p.name, p.unit)).collect();
    vec![
        effect.id.to_owned(),
        acts_on(effect.domain).to_owned(),
        parameters.join(", "),
        effect.trial.to_owned(),
    ]
}

fn one(effect: &Effect) {
    say::line(format!("{}: {}", effect.id, effect.signature));
    let [_, on, parameters, trial] = &row(effect)[..] else { return };
    say::line(format!("  acts on {on}; parameters {parameters}; shown by the trial {trial}"));
    let alike: Vec<&str> = effect.look_alikes().collect();
    if !alike.is_empty() {
        say::line(format!("  looks like {}", alike.join(", ")));
    }
}

fn acts_on(domain: Domain) -> &'static str {
    match domain {
        Domain::Robot => "the robot",
        Domain::Joints => "joints",
        Domain::Links => "a link",
        Domain::AllLinks => "all links",
        Domain::Play => "hinges with play",
        Domain::Feet => "feet",
    }
}
