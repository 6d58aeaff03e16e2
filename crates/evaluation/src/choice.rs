//! Which of the last versions of a training to keep. Single versions wander: one vibrates, or carries its tail,
//! where another a few iterations before walks by every gate.

use std::sync::Arc;

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use serde::Serialize;

use crate::acceptance::objections;
use crate::{EvaluationError, Scenario, Settings, Suite, run_scenario};

/// A velocity this near an end of the range that was drawn is at that end, m/s.
const AT_END_MPS: f32 = 1e-4;

/// How a version walks at the commands that it was trained for.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Tried {
    /// The version.
    pub version: u64,
    /// Commands that it was judged at.
    pub commands: usize,
    /// Those that it does not walk at, each with what is against it.
    pub missed: Vec<String>,
}

impl Tried {
    /// Runs `policy` at the commands of the suite `flat` that lie within the range that its training drew from,
    /// and at the speed that it is judged at. What was trained in deep water is judged at none.
    ///
    /// # Errors
    /// As [`run_scenario`].
    pub fn of(
        config: &Config,
        model: &Arc<RobotModel>,
        policy: &PolicyFile,
        settings: &Settings,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Self, EvaluationError> {
        let mut tried = Self { version: policy.metadata().version, ..Self::default() };
        for scenario in scenarios(config, model.total_mass_kg()) {
            let result = run_scenario(config, model, policy, &scenario, settings, go_on)?.result;
            tried.commands += 1;
            let against = objections(&result);
            if !against.is_empty() {
                tried.missed.push(format!("{}: {against}", result.name));
            }
        }
        Ok(tried)
    }

    /// Whether it walks by every gate at all of them.
    pub fn walks(&self) -> bool {
        self.missed.is_empty()
    }
}

fn scenarios(config: &Config, mass_kg: f64) -> Vec<Scenario> {
    if config.terrain.is_deep_water() {
        return Vec::new();
    }
    let [low, high] = config.task.command.vx_mps;
    let mut all = Suite::Flat.scenarios(mass_kg, config.evaluation.command_mps as f32);
    let mut first = true;
    all.retain(|scenario| {
        let vx = scenario.commands[0][0];
        let inside = vx > low + AT_END_MPS && vx < high - AT_END_MPS;
        scenario.judged && (std::mem::take(&mut first) || inside)
    });
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_config::Source;

    fn commands(set: &[&str]) -> Vec<String> {
        let overrides = set.iter().map(|&s| s.to_owned()).collect();
        let source = Source { preset: Some("flat".into()), overrides, ..Source::default() };
        let config = Config::load(&source).unwrap();
        scenarios(&config, 2.6).into_iter().map(|scenario| scenario.name).collect()
    }

    #[test]
    fn versions_are_judged_at_what_was_drawn() {
        let all = ["0.3", "0.1", "0.2", "0.4", "0.5"].map(|v| format!("flat {v} m/s"));
        let back = ["back 0.2 m/s".to_owned()];
        assert_eq!(commands(&[]), [all.as_slice(), back.as_slice()].concat());
        // at 0.2 and at 0.4 only from one side
        let own = commands(&["task.command.vx_mps=[0.2, 0.4]"]);
        assert_eq!(own, ["flat 0.3 m/s"]);
        let own = commands(&["task.command.vx_mps=[0.5, 0.5]"]);
        assert_eq!(own, ["flat 0.3 m/s"], "the speed that it is judged at, whatever was drawn");
        assert!(commands(&["terrain.kind=deep_water"]).is_empty());
    }
}
