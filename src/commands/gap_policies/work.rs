//! One policy after the other: trained and evaluated, as far as that has not been done.

use std::path::Path;
use std::sync::Arc;

use caudata_evaluation::{Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_sim::EngineKind;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::Value;

use super::figures::Run;
use super::speed::{self, Walks};
use super::{Effort, Given, Policy, Robots, Runs, Way};
use crate::commands::eval::{self, read_policy};
use crate::commands::out_folder::write_whole;
use crate::commands::steps::{Steps, Test, Training, last_json};

/// What all trainings share.
pub struct Work<'a> {
    pub robots: &'a Robots<'a>,
    /// Folder for all of them.
    pub out: &'a Path,
    pub effort: &'a Effort,
    pub given: &'a Given,
    /// The true robot, read.
    pub truth: &'a Arc<RobotModel>,
    pub steps: Steps,
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
        let in_truth = self.evaluate(&format!("{name}_in_truth"), &policy, self.robots.truth)?;
        let walks = self.forward(&name, &policy)?;
        let in_rapier = serde_json::json!({ "scenarios": [&walks.result] });
        let read = |evaluation: &Value| {
            let lacks = || {
                Failure::message(
                    ExitCode::Internal,
                    format!("the evaluation of {name} lacks figures"),
                )
            };
            Run::of(evaluation).ok_or_else(lacks)
        };
        Ok(Policy {
            seed,
            runs: Runs {
                at_home: read(&at_home)?,
                in_truth: read(&in_truth)?,
                in_rapier: read(&in_rapier)?,
            },
            policy,
            at_home,
            in_truth,
            in_rapier: walks.result.clone(),
            walks,
        })
    }

    fn evaluate(&mut self, name: &str, policy: &Path, robot: &Path) -> Result<Value, Failure> {
        let test = Test {
            flags: &self.given.flags,
            policy,
            robot,
            suite: self.effort.suite,
            episodes: self.effort.episodes,
        };
        let file = self.out.join(format!("{name}.json"));
        self.steps
            .evaluate(&format!("evaluate {name}"), &test, &file)
    }

    /// Forward velocities that change, on the true robot, in the engine that policies are not trained in.
    fn forward(&mut self, name: &str, policy: &Path) -> Result<Walks, Failure> {
        let file = self.out.join(format!("{name}_in_rapier.json"));
        let step = format!("evaluate {name}_in_rapier");
        let policy = read_policy(policy)?;
        if file.is_file() {
            let walks: Walks = last_json(&file)?;
            if walks.policy_sha256 == policy.sha256_hex() {
                self.steps.is_there(&step, &file);
                return Ok(walks);
            }
        }
        let mut config = self.given.config.clone();
        config.robot = std::path::absolute(self.robots.truth).or_exit(ExitCode::NoInput)?;
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
        let outcome = self.steps.inside(&step, &what, |stop| {
            let go_on = || !stop.is_set();
            run_scenario(
                &config,
                truth,
                &policy,
                &speed::scenario(),
                &settings,
                &go_on,
            )
            .map_err(|error| eval::failure(error, stop))
        })?;
        let walks = Walks::of(&policy, &outcome)?;
        write_whole(
            &file,
            &serde_json::to_vec(&walks).or_exit(ExitCode::Internal)?,
        )?;
        Ok(walks)
    }
}
