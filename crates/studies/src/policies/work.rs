//! One policy after the other: trained and evaluated, as far as that has not been done.

use std::path::Path;
use std::sync::Arc;

use caudata_evaluation::{Settings, SuiteResult, run_scenario};
use caudata_model::RobotModel;
use caudata_sim::EngineKind;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use super::figures::Run;
use super::results::{Policy, Runs};
use super::speed::{self, Walks};
use super::ways::{Effort, Given, Robots, Way};
use crate::failures::refused;
use crate::files;
use crate::steps::{Steps, Test, Training};

/// What all trainings share.
pub struct Work<'a> {
    pub robots: &'a Robots,
    /// Folder for all of them.
    pub out: &'a Path,
    pub effort: &'a Effort,
    pub given: &'a Given,
    /// The true robot, read.
    pub truth: &'a Arc<RobotModel>,
    pub steps: Steps<'a>,
}

impl Work<'_> {
    /// Trains one policy and tests it, as far as that has not been done.
    ///
    /// # Errors
    /// Where a step fails or is stopped.
    pub fn policy(&mut self, way: Way, set: &[String], seed: u64) -> Result<Policy, Failure> {
        self.steps.go_on()?;
        let name = format!("{}_{seed}", way.name());
        let home = way.robot(self.robots);
        let training = Training {
            flags: &self.given.flags,
            robot: home,
            start: self.effort.policy.as_deref(),
            iterations: self.effort.iterations,
            seed: Some(seed),
            set,
            out: self.out.join(&name),
            progress: Some(self.out.join(format!("{name}.log"))),
        };
        let policy = self.steps.train(&format!("train {name}"), &training)?;
        let at_home = self.evaluate(&format!("{name}_at_home"), &policy, home)?;
        let in_truth = self.evaluate(&format!("{name}_in_truth"), &policy, &self.robots.truth)?;
        let walks = self.forward(&name, &policy)?;
        Ok(Policy {
            seed,
            runs: Runs {
                at_home: Run::of(&at_home.scenarios),
                in_truth: Run::of(&in_truth.scenarios),
                in_rapier: Run::of(std::slice::from_ref(&walks.result)),
            },
            policy,
            at_home,
            in_truth,
            in_rapier: walks.result.clone(),
            walks,
        })
    }

    fn evaluate(
        &mut self,
        name: &str,
        policy: &Path,
        robot: &Path,
    ) -> Result<SuiteResult, Failure> {
        let test = Test {
            config: &self.given.config,
            policy,
            robot,
            suite: self.effort.suite,
            episodes: self.effort.episodes,
        };
        let file = self.out.join(format!("{name}.json"));
        self.steps.evaluate(&format!("evaluate {name}"), &test, &file)
    }

    /// Forward velocities that change, on the true robot, in the engine that policies are not trained in.
    fn forward(&mut self, name: &str, policy: &Path) -> Result<Walks, Failure> {
        let file = self.out.join(format!("{name}_in_rapier.json"));
        let step = format!("evaluate {name}_in_rapier");
        let policy = files::policy(policy)?;
        let kept = files::read_json::<Walks>(&file).ok();
        if let Some(kept) = kept.filter(|kept| kept.policy_sha256 == policy.sha256_hex()) {
            self.steps.is_there(&step, &file);
            return Ok(kept);
        }
        let mut config = self.given.config.clone();
        config.robot = std::path::absolute(&self.robots.truth).or_exit(ExitCode::NoInput)?;
        config.engine.kind = EngineKind::Rapier;
        let settings = Settings {
            episodes: self.effort.referee_episodes,
            episode_s: speed::EPISODE_S,
            film: true, // keeps velocities
            ..Settings::default()
        };
        let what = format!(
            "{} episodes of {} s in Rapier, forward velocities that change",
            settings.episodes, settings.episode_s
        );
        let truth = self.truth;
        self.steps.run(&step, &what, |stop, _| {
            let scenario = speed::scenario();
            let go_on = || !stop.is_set();
            let outcome = run_scenario(&config, truth, &policy, &scenario, &settings, &go_on)
                .map_err(|error| refused(error, stop))?;
            let walks = Walks::of(&policy, outcome);
            let bytes = serde_json::to_vec(&walks).or_exit(ExitCode::Internal)?;
            files::write_whole(&file, &bytes)?;
            Ok(walks)
        })
    }
}
