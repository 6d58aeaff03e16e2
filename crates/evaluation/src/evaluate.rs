//! A policy in all scenarios of a suite, on one engine or two.

use std::sync::Arc;

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::EngineKind;

use crate::acceptance::acceptance;
use crate::anatomy::Anatomy;
use crate::animal::animal;
use crate::result::Referee;
use crate::run::{Outcome, Settings, run_scenario};
use crate::{EvaluationError, Scenario, ScenarioResult, Suite, SuiteResult, suite};

/// Episodes on the second engine for the suite `acceptance`: it is a hundred times slower, and its row needs
/// a speed to a few per cent.
const REFEREE_EPISODES: u32 = 32;

/// What is evaluated, and how.
pub struct Evaluation<'a> {
    /// The configuration that the policy was trained with: robot, engine, action and observation come from
    /// it.
    pub config: &'a Config,
    /// The robot.
    pub model: &'a Arc<RobotModel>,
    /// The policy.
    pub policy: &'a PolicyFile,
    /// The scenarios.
    pub suite: Suite,
    /// How long, how often.
    pub settings: Settings,
    /// Another engine than the configuration's, to run everything on too.
    pub referee: Option<EngineKind>,
}

impl Evaluation<'_> {
    /// How many scenarios there are to run, on all engines.
    pub fn scenarios(&self) -> usize {
        let speed_mps = self.config.evaluation.command_mps as f32;
        let all = self.suite.scenarios(self.model.total_mass_kg(), speed_mps).len();
        match (self.referee, self.suite) {
            (Some(_), _) => 2 * all,
            (None, Suite::Acceptance) => all + 1,
            (None, _) => all,
        }
    }

    /// Runs it. `go_on` is asked before every control step; `done` is told about every scenario, with the
    /// name of the engine.
    ///
    /// # Errors
    /// When the policy does not fit the robot, the simulation cannot be built, or `go_on` says no.
    pub fn run(
        &self,
        go_on: &(dyn Fn() -> bool + Sync),
        done: &mut dyn FnMut(&str, &ScenarioResult),
    ) -> Result<(SuiteResult, Vec<Outcome>), EvaluationError> {
        let scenarios = self
            .suite
            .scenarios(self.model.total_mass_kg(), self.config.evaluation.command_mps as f32);
        let engine = self.config.engine.kind;
        let mut outcomes = Vec::new();
        for scenario in &scenarios {
            let outcome = self.scenario(self.config, scenario, &self.settings, go_on)?;
            done(engine.name(), &outcome.result);
            outcomes.push(outcome);
        }
        let referee = self.referee(&scenarios, go_on, done)?;
        let mut result = SuiteResult {
            suite: self.suite,
            engine: engine.name().into(),
            policy_version: self.policy.metadata().version,
            policy_sha256: self.policy.sha256_hex(),
            scenarios: outcomes.iter().map(|o| o.result.clone()).collect(),
            referee,
            acceptance: Vec::new(),
            animal: Vec::new(),
        };
        if self.suite == Suite::Animal {
            result.animal = animal(&result.scenarios, &Anatomy::of(self.model));
        }
        // the project's targets are for the robot and the speed of the paper
        let speed_mps = self.config.evaluation.command_mps as f32;
        if self.suite == Suite::Acceptance && speed_mps == suite::PAPER_COMMAND_MPS {
            result.acceptance = acceptance(&result);
        }
        Ok((result, outcomes))
    }

    fn scenario(
        &self,
        config: &Config,
        scenario: &Scenario,
        settings: &Settings,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Outcome, EvaluationError> {
        run_scenario(config, self.model, self.policy, scenario, settings, go_on)
    }

    /// The other engine: on everything if asked, else, for the table of targets, on its one scenario.
    fn referee(
        &self,
        scenarios: &[Scenario],
        go_on: &(dyn Fn() -> bool + Sync),
        done: &mut dyn FnMut(&str, &ScenarioResult),
    ) -> Result<Option<Referee>, EvaluationError> {
        let mut settings = Settings { film: false, ..self.settings };
        let (kind, chosen) = match (self.referee, self.suite) {
            (Some(kind), _) => (kind, scenarios),
            (None, Suite::Acceptance) => {
                settings.episodes = settings.episodes.min(REFEREE_EPISODES);
                (EngineKind::Rapier, &scenarios[..1])
            }
            (None, _) => return Ok(None),
        };
        let mut config = self.config.clone();
        config.engine.kind = kind;
        let engine = config.engine.kind.name();
        let mut results = Vec::new();
        for scenario in chosen {
            let outcome = self.scenario(&config, scenario, &settings, go_on)?;
            done(engine, &outcome.result);
            results.push(outcome.result);
        }
        Ok(Some(Referee { engine: engine.into(), scenarios: results }))
    }
}
