//! Which of the last versions of a training to keep. Single versions wander: one vibrates, carries its tail or
//! stays in the water, where another a few iterations before does all that it was trained for.

use std::sync::Arc;

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::TerrainKind;
use serde::Serialize;

use crate::acceptance::{falls_in, objections};
use crate::suite::STAND;
use crate::{EvaluationError, Gate, Scenario, ScenarioResult, Settings, Suite, run_scenario};

/// A velocity this near an end of the range that was drawn is at that end, m/s.
const AT_END_MPS: f32 = 1e-4;
/// Share of the episodes at a shore that must arrive: the acceptance table's aim for coming ashore.
const ARRIVE_SHARE: f64 = 0.95;

/// What it lacks to fall in every episode: as much as ten gates that are missed altogether.
const FALL: f64 = 10.0;

/// How a version does what it was trained for.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Tried {
    /// The version.
    pub version: u64,
    /// Scenarios that it was judged in.
    pub scenarios: usize,
    /// Those that it fails in, each with what is against it.
    pub missed: Vec<String>,
    /// What it lacks: [`Gate::lacks`] of each gate; ten times the share of the episodes in which it falls; of a
    /// missed passage at a shore the share that did not arrive.
    pub shortfall: f64,
}

impl Tried {
    /// Runs `policy` at the commands of the suite `flat` that lie within the range that its training drew from,
    /// standing still where it drew that, and at the speed that it is judged at; the latter again on the ground
    /// of its training, where that is not flat; into the water and ashore, where it was trained at a shore. What
    /// was trained in deep water is judged at nothing.
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
        let falls = FALL * result.fall_share.mean;
        let (against, lacks) = match (&result.transition, &result.gates) {
            (Some(passage), _) if passage.reached.mean >= ARRIVE_SHARE => return,
            (Some(passage), _) => {
                let share = passage.reached.mean;
                (format!("{:.0} % arrive", 100.0 * share), 1.0 - share)
            }
            (None, Some(report)) if report.gates.is_empty() => (objections(result), FALL),
            (None, Some(report)) => {
                (objections(result), falls + report.gates.iter().map(Gate::lacks).sum::<f64>())
            }
            (None, None) if result.stays_up() => return,
            (None, None) => (falls_in(result), falls),
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
        match scenario.judged {
            true => std::mem::take(&mut first) || inside,
            false => scenario.name == STAND && config.task.command.zero_share > 0.0,
        }
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
        let [judged, slower @ ..] =
            ["0.3", "0.1", "0.2", "0.4", "0.5"].map(|v| format!("flat {v} m/s"));
        let ends = [vec![judged, "stand".into()], slower.to_vec(), vec!["back 0.2 m/s".into()]];
        assert_eq!(commands(&[]), ends.concat());
        // at 0.2 and at 0.4 only from one side
        let drawn = "task.command.vx_mps=[0.2, 0.4]";
        assert_eq!(commands(&[drawn]), ["flat 0.3 m/s", "stand"]);
        let own = commands(&[drawn, "task.command.zero_share=0"]);
        assert_eq!(own, ["flat 0.3 m/s"]);
        let own = commands(&["task.command.vx_mps=[0.5, 0.5]", "task.command.zero_share=0"]);
        assert_eq!(own, ["flat 0.3 m/s"], "the speed that it is judged at, whatever was drawn");
        assert!(commands(&["terrain.kind=deep_water"]).is_empty());
    }

    #[test]
    fn versions_are_judged_on_the_ground_of_their_training() {
        let drawn = "task.command.vx_mps=[0.2, 0.4]";
        let own = commands(&[drawn, "terrain.kind=rough", "terrain.size_m=32"]);
        assert_eq!(own, ["flat 0.3 m/s", "stand", "rough 0.3 m/s"]);
        let own = commands(&[drawn, "terrain.kind=shore"]);
        assert_eq!(own[..2], ["flat 0.3 m/s", "stand"]);
        let to = ["into the water", "onto land", "onto land, 10°", "there and back"];
        assert_eq!(own[2..], to.map(|to| format!("shore: {to}")));
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
        assert_eq!((tried.scenarios, tried.shortfall), (2, 0.25));
        assert_eq!(tried.missed, ["shore: 75 % arrive"]);
    }

    /// 24 W where 15 are allowed lack 1 − 15/24 = 0.375, 0.6 of the speed where 0.9 are wanted 1 − 2/3; one fall of 16
    /// makes 10/16 more.
    #[test]
    fn a_walk_lacks_what_its_gates_do_and_a_fall_much_more() {
        let gate = |value, at_least, at_most, met| Gate {
            name: "one".into(),
            value,
            at_least,
            at_most,
            met,
        };
        let gates = vec![gate(24.0, None, Some(15.0), false), gate(0.6, Some(0.9), None, false)];
        let report = GateReport { walks: false, gates };
        let walk = |gates, falls| ScenarioResult {
            name: "flat".into(),
            gates,
            fall_share: Estimate::share(falls, 16),
            ..ScenarioResult::default()
        };
        let lacks = |gates, falls| {
            let mut tried = Tried::default();
            tried.add(&walk(gates, falls));
            (tried.shortfall, tried.missed)
        };
        let (shortfall, missed) = lacks(Some(report.clone()), 0);
        assert!((shortfall - 0.375 - 1.0 / 3.0).abs() < 1e-9);
        assert_eq!(missed, ["flat: gates missed: one; one"]);
        assert!((lacks(Some(report), 1).0 - shortfall - 0.625).abs() < 1e-9);
        assert_eq!(lacks(Some(GateReport::default()), 0).0, 10.0, "nothing to measure");
        let standing = |falls| lacks(None, falls);
        assert_eq!(standing(0), (0.0, vec![]));
        assert_eq!(standing(1), (0.625, vec!["flat: falls in 6.2 %".to_owned()]));
    }
}
