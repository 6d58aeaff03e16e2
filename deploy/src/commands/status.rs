//! `caudata-robot status`.

use std::path::PathBuf;

use crate::DeployError;
use crate::commands::say::{say, say_json};
use crate::state::{PolicyRef, RobotState};
use crate::store::PolicyStore;

#[derive(Debug, clap::Args)]
pub struct StatusArgs {
    /// Folder in which this robot keeps its policies
    #[arg(long, value_name = "DIR")]
    state: PathBuf,
    /// One JSON object instead of lines
    #[arg(long)]
    json: bool,
}

pub fn run(args: &StatusArgs) -> Result<(), DeployError> {
    let state = PolicyStore::peek(&args.state)?.unwrap_or_default();
    if args.json {
        return say_json(&state);
    }
    print(&state);
    Ok(())
}

fn print(state: &RobotState) {
    let line = |what: &str, policy: &Option<PolicyRef>| match policy {
        Some(policy) => say(&format!("{what:<9} {policy}, sha256 {}", policy.sha256)),
        None => say(&format!("{what:<9} none")),
    };
    line("active", &state.active);
    line("last good", &state.last_good);
    if state.active != state.last_good {
        say(
            "          the active one is not through its trial: a robot that runs may not have it yet",
        );
    }
    if state.trust_version > 0 {
        say(&format!("trusts    trust file version {}", state.trust_version));
    }
    for entry in &state.quarantined {
        say(&format!("refused   {}: {}", entry.policy, entry.reason));
    }
}
