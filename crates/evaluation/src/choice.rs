//! Which of the last versions of a training to keep. Single versions wander: one vibrates, carries its tail or
//! stays in the water, where another a few iterations before does all that it was trained for.

use std::sync::Arc;

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::TerrainKind;
use serde::Serialize;

use crate::acceptance::objections;
use crate::{EvaluationError, Scenario, ScenarioResult, Settings, Suite, run_scenario};

/// A velocity this near an end of the range that was drawn is at that end, m/s.
const AT_END_MPS: f32 = 1e-4;
/// Share of the episodes at a shore that must arrive: the acceptance table's aim for coming ashore.
const ARRIVE_SHARE: f64 = 0.95;

/// How a version does what it was trained for.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Tried {
    /// The version.
    pub version: u64,
    /// Scenarios that it was judged in.
    pub scenarios: usize,
    /// Those that it fails in, each with what is against it.
    pub missed: Vec<String>,
    /// What it lacks: 1 for each walk that is missed, and of a missed passage at a shore the share of the
    /// episodes that did not arrive.
    pub shortfall: f64,
}

impl Tried {
    /// Runs `policy` at the commands of the suite `flat` that lie within the range that its training drew from,
    /// and at the speed that it is judged at; the latter again on the ground of its training, where that is not
    /// flat; into the water and ashore, where it was trained at a shore. What was trained in deep water is
    /// judged at nothing.
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
            tried.add(&run_scenario(config, model, policy, &scenario, settings, go_on)?.result);
        }
        Ok(tried)
    }

    fn add(&mut self, result: &ScenarioResult) {
        self.scenarios += 1;
        let (against, lacks) = match &result.transition {
            Some(passage) if passage.reached.mean >= ARRIVE_SHARE => return,
            Some(passage) => {
                let share = passage.reached.mean;
                (format!("{:.0} % arrive", 100.0 * share), 1.0 - share)
            }
            None => (objections(result), 1.0),
        };
        if !against.is_empty() {
            self.missed.push(format!("{}: {against}", result.name));
            self.shortfall += lacks;
        }
    }

    /// Whether it fails in none of them.
    pub fn passes(&self) -> bool {
        self.missed.is_empty()
    }
}

fn scenarios(config: &Config, mass_kg: f64) -> Vec<Scenario> {
    let speed_mps = config.evaluation.command_mps as f32;
    let [low, high] = config.task.command.vx_mps;
    let mut all = Suite::Flat.scenarios(mass_kg, speed_mps);
    let mut first = true;
    all.retain(|scenario| {
        let vx = scenario.commands[0][0];
        let inside = vx > low + AT_END_MPS && vx < high - AT_END_MPS;
        scenario.judged && (std::mem::take(&mut first) || inside)
    });
    match config.terrain.kind {
        TerrainKind::Flat => {}
        TerrainKind::DeepWater => all.clear(),
        TerrainKind::Shore => {
            let shore = Suite::Transition.scenarios(mass_kg, speed_mps);
            all.extend(shore.into_iter().filter(|scenario| scenario.goal.is_some()));
        }
        kind => all.push(Scenario {
            terrain: config.terrain.clone(),
            spawn_half_extent_m: config.task.reset.spawn_half_extent_m,
            ..Scenario::walk(&format!("{} {speed_mps} m/s", kind.name()), [speed_mps, 0.0, 0.0])
        }),
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Estimate, GateReport, TransitionResult};
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

    #[test]
    fn versions_are_judged_on_the_ground_of_their_training() {
        let drawn = "task.command.vx_mps=[0.2, 0.4]";
        let own = commands(&[drawn, "terrain.kind=rough", "terrain.size_m=32"]);
        assert_eq!(own, ["flat 0.3 m/s", "rough 0.3 m/s"]);
        let own = commands(&[drawn, "terrain.kind=shore"]);
        let [into, onto] = ["shore: into the water", "shore: onto land"];
        assert_eq!(
            own,
            ["flat 0.3 m/s", into, onto, "shore: onto land, 10°", "shore: there and back"]
        );
    }

    #[test]
    fn who_stays_in_the_water_lacks_the_share_that_does() {
        let shore = |reached| ScenarioResult {
            name: "shore".into(),
            transition: Some(TransitionResult { reached, ..TransitionResult::default() }),
            ..ScenarioResult::default()
        };
        let mut tried = Tried::default();
        // 31 of 32 are 97 %
        tried.add(&shore(Estimate::share(31, 32)));
        assert!(tried.passes());
        tried.add(&shore(Estimate::share(24, 32)));
        let gates = Some(GateReport { walks: false, gates: Vec::new() });
        tried.add(&ScenarioResult { name: "flat".into(), gates, ..ScenarioResult::default() });
        assert_eq!((tried.scenarios, tried.shortfall), (3, 1.25));
        assert_eq!(tried.missed, ["shore: 75 % arrive", "flat: falls in 0.0 %"]);
    }
}
