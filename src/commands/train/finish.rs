//! The end of a run: is the policy the same everywhere, how well does it walk, does the account add up.

use std::path::PathBuf;
use std::sync::Arc;

use caudata_config::Config;
use caudata_evaluation::{ScenarioResult, Summary};
use caudata_model::RobotModel;
use caudata_proto::registry::StreamName;
use caudata_registry_client::RegistryClient;
use caudata_telemetry::progress::{ActorsPolicy, Finished, MeanSe};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use serde::Serialize;

use super::accounting::{Balance, balance};
use super::choose::{self, CHOSEN, Choice, choose};
use super::folder::RunFolder;
use super::robot::{RobotRun, run_robot};
use super::supervise::Outcome;
use super::view::clock;
use crate::commands::eval;
use crate::commands::policy::{block_on, hex};
use crate::say;

/// Page of the evaluation, in the run folder.
const EVALUATION: &str = "evaluation.html";

/// What a run amounts to; `report.json`, and the last line with `--json`.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Run.
    run_id: String,
    /// Its folder.
    folder: PathBuf,
    /// The learner's last word.
    finished: Finished,
    /// Iterations of the run that were done before this command.
    first_iteration: u64,
    /// Actors that were started again.
    actor_restarts: usize,
    /// How often the learner gave no sign of life for longer than `cluster.hang_timeout_s`.
    learner_silences: usize,
    /// What became of every chunk.
    accounting: Balance,
    /// Which of the last versions is the policy.
    choice: Choice,
    /// The policy's SHA-256 wherever it lies.
    policy: PolicyHashes,
    /// In the environment, if it was evaluated there.
    evaluation: Option<ScenarioResult>,
    /// On the simulated robot, if it was run there.
    robot: Option<RobotRun>,
    /// Why it was not run there, though it was to be.
    robot_failure: Option<String>,
    /// The same as a failure of the command.
    #[serde(skip)]
    failure: Option<Failure>,
}

/// The policy's SHA-256 wherever it lies, hex.
#[derive(Debug, Serialize)]
struct PolicyHashes {
    version: u64,
    learner: String,
    run_folder: String,
    server: String,
    robot: Option<String>,
    /// What the actors ran, which learn from every version but the last.
    actors: Option<ActorsHash>,
    /// Whether all are the same, each where it lies.
    same: bool,
}

/// The newest policy that actors ran and that was published too (else the newest that they ran), with its
/// SHA-256 in their memory, as the learner made it, and on the server (null where the server does not hold
/// that version).
#[derive(Debug, Serialize)]
struct ActorsHash {
    version: u64,
    actors: String,
    learner: String,
    server: Option<String>,
    same: bool,
}

/// Looks at what the run has left: account, hashes, evaluation, robot.
pub fn evaluate(
    config: &Config,
    folder: &RunFolder,
    model: Arc<RobotModel>,
    outcome: &mut Outcome,
    stop: &StopFlag,
) -> Result<Report, Failure> {
    let [runs, judged] = [config.evaluation.robot_run_s > 0.0, config.evaluation.episodes > 0];
    let choice = match judged && config.evaluation.choose_from > 0 {
        true => choose(config, folder, &model, outcome, stop)?,
        false => Choice::last(outcome),
    };
    let policy = eval::read_policy(&folder.policy())?;
    let stream = config.policy_server.stream_of(folder.run_id());
    let version = choice.version;
    let on_server = hash_on_server(stream, version, outcome)?.ok_or_else(|| {
        let message = format!("the policy server does not have version {version} of {stream}");
        Failure::message(ExitCode::Unavailable, message)
    })?;
    let actors = match &outcome.finished.actors_policy {
        Some(ran) => Some(ActorsHash::new(ran, hash_on_server(stream, ran.version, outcome)?)),
        None => None,
    };
    let mut share =
        say::Share::new("parts of the evaluation", usize::from(runs) + usize::from(judged));
    let mut evaluation = None;
    if judged {
        let page = folder.root().join(EVALUATION);
        let result = eval::evaluate(config, &model, &policy, &page, stop)?;
        let summary = Summary::of(&result, model.hash_hex(), config.run.seed);
        eval::write_summary(&folder.policy(), &summary)?;
        eval::to_tensorboard(folder.root(), &result)?;
        evaluation = result.scenarios.into_iter().next();
        share.one_more();
    }
    // last: what the client refuses to run has its page and its report all the same
    let label = if choice.tried.is_empty() { "latest" } else { CHOSEN };
    let server = outcome.server_addr.to_string();
    let ran = runs.then(|| run_robot(config, folder, &server, label, stop)).transpose();
    let (robot, failure) = match ran {
        Ok(robot) => (robot, None),
        Err(failure) => (None, Some(after_training(failure, folder))),
    };
    let finished = outcome.finished.clone();
    let robot_hash = robot.as_ref().map(|robot| robot.policy_sha256.clone());
    let hashes = [policy.sha256_hex(), on_server.clone()];
    let same = hashes.iter().chain(&robot_hash).all(|hash| *hash == choice.learner_sha256)
        && actors.as_ref().is_none_or(|actors| actors.same);
    Ok(Report {
        run_id: folder.run_id().to_owned(),
        folder: folder.root().to_owned(),
        first_iteration: outcome.first_iteration,
        actor_restarts: outcome.restarts,
        learner_silences: outcome.learner_silences,
        accounting: balance(&finished.actors, &outcome.ledgers),
        policy: PolicyHashes {
            version,
            learner: choice.learner_sha256.clone(),
            run_folder: policy.sha256_hex(),
            server: on_server,
            robot: robot_hash,
            actors,
            same,
        },
        choice,
        finished,
        evaluation,
        robot,
        robot_failure: failure.as_ref().map(ToString::to_string),
        failure,
    })
}

/// Training itself went well: the policy is there, and is refused or can be tried again.
pub fn after_training(failure: Failure, folder: &RunFolder) -> Failure {
    let policy = folder.policy().display().to_string();
    // what a robot refuses it refuses again
    let (how, longer) = match failure.code() {
        ExitCode::PolicyRefused => ("train it longer", " --iterations N"),
        _ => ("make up for it", ""),
    };
    failure.context("training is complete, its evaluation is not").hint(format!(
        "the last policy is {policy}; {how} with: caudata train --resume --out {}{longer}",
        folder.root().display()
    ))
}

/// The hash of a version on the server; `None` where the server does not hold it.
fn hash_on_server(
    stream: &str,
    version: u64,
    outcome: &Outcome,
) -> Result<Option<String>, Failure> {
    let stream = StreamName::new(stream).or_exit(ExitCode::BadConfig)?;
    let address = outcome.server_addr.to_string();
    block_on(async {
        let mut client = RegistryClient::new(&address)?;
        match client.manifest(&stream, Some(version)).await {
            Ok(manifest) => Ok(Some(hex(&manifest.sha256))),
            Err(error) if error.is_not_found() => Ok(None),
            Err(error) => Err(error),
        }
    })
}

impl ActorsHash {
    fn new(ran: &ActorsPolicy, server: Option<String>) -> Self {
        let same = ran.learner_sha256 == ran.sha256
            && server.as_ref().is_none_or(|hash| *hash == ran.sha256);
        Self {
            version: ran.version,
            same,
            actors: ran.sha256.clone(),
            learner: ran.learner_sha256.clone(),
            server,
        }
    }
}

impl Report {
    /// An error when the run broke a promise: a chunk unaccounted for, a policy that is not the same everywhere, or
    /// one that the robot client did not run.
    pub fn verdict(self) -> Result<(), Failure> {
        if let Some(problem) = self.accounting.problems.first() {
            return Err(Failure::message(ExitCode::Internal, format!("accounting: {problem}")));
        }
        if !self.policy.same {
            let message = "the policy is not the same everywhere; report.json has the hashes";
            return Err(Failure::message(ExitCode::Internal, message));
        }
        self.failure.map_or(Ok(()), Err)
    }

    fn path(&self, name: &str) -> String {
        self.folder.join(name).display().to_string()
    }
}

/// The report as lines for a person.
pub fn print(report: &Report) {
    let finished = &report.finished;
    say::line(trained(finished, report.first_iteration));
    if let (Some(first), Some(last)) = (finished.first_tenth_return, finished.last_tenth_return) {
        say::line(improvement("return per episode", 2, first, last));
    }
    if let (Some(first), Some(last)) = (finished.first_tenth, finished.last_tenth) {
        say::line(improvement("reward per step", 4, first, last));
    }
    let account = &report.accounting;
    say::line(format!(
        "rollouts: {} sent = {} accepted + {} rejected + {} dropped + {} lost with killed actors ({})",
        account.sent,
        account.accepted,
        account.rejected,
        account.dropped,
        account.lost,
        if account.holds { "adds up" } else { "does NOT add up" }
    ));
    for line in &account.incomplete {
        say::line(format!("warning: rollouts: {line}"));
    }
    if report.learner_silences > 0 {
        let times = report.learner_silences;
        say::line(format!("the learner stood still: {times} times"));
    }
    if report.actor_restarts > 0 {
        say::line(format!("actors started again: {}", report.actor_restarts));
    }
    choose::print(&report.choice);
    say::line(format!(
        "policy version {}, sha256 {} {}",
        report.policy.version,
        report.policy.learner,
        match report.policy.same {
            true => "(learner, server and file have the same)",
            false => "(learner, server and file do NOT have the same)",
        }
    ));
    if let Some(actors) = &report.policy.actors {
        say::line(format!(
            "actors ran version {}, sha256 {} ({}{})",
            actors.version,
            actors.actors,
            if actors.same { "as the learner made it" } else { "NOT as it was made" },
            if actors.server.is_some() { " and the server holds it" } else { "" },
        ));
    }
    if let Some(evaluation) = &report.evaluation {
        eval::print(evaluation);
    }
    if let Some(robot) = &report.robot {
        robot.print();
    }
    say::line(format!("curves   {}", report.path("curves")));
    say::line(format!("policy   {}", report.path("policy.onnx")));
    if report.evaluation.is_some() {
        say::line(format!("page     {}", report.path(EVALUATION)));
    }
    if let Some(robot) = &report.robot {
        say::line(format!("log      {}", robot.log.display()));
    }
    say::line(format!("report   {}", report.path("report.json")));
}

/// How much was trained: in all, and by this command where it went on from a checkpoint.
fn trained(finished: &Finished, before: u64) -> String {
    let (done, steps) = (finished.iteration, finished.steps_total);
    let time = clock(finished.wall_s);
    match done - before.min(done) {
        now if before == 0 => {
            format!("trained {now} iterations, {steps} environment steps, in {time}")
        }
        now => format!(
            "trained {now} iterations more in {time}: {done} iterations, {steps} environment steps in all"
        ),
    }
}

/// How far the last tenth lies above the first, in standard errors of the difference.
fn improvement(what: &str, digits: usize, first: MeanSe, last: MeanSe) -> String {
    let error = (first.standard_error.powi(2) + last.standard_error.powi(2)).sqrt();
    let gain = last.mean - first.mean;
    let in_errors = if error > 0.0 { gain / error } else { 0.0 };
    format!(
        "{what}, first tenth {:.digits$} ± {:.digits$}, last tenth {:.digits$} ± {:.digits$}: {in_errors:+.1} standard errors",
        first.mean, first.standard_error, last.mean, last.standard_error
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_evaluation::Tried;

    #[test]
    fn improvement_by_hand() {
        // (2 − 1)/√(0.3² + 0.4²) = 1/0.5 = 2.
        let at = |mean, standard_error| MeanSe { mean, standard_error, n: 10 };
        assert_eq!(
            improvement("return", 1, at(1.0, 0.3), at(2.0, 0.4)),
            "return, first tenth 1.0 ± 0.3, last tenth 2.0 ± 0.4: +2.0 standard errors"
        );
    }

    #[test]
    fn a_run_that_went_on_tells_its_own_part_from_the_whole() {
        let finished =
            Finished { iteration: 7, steps_total: 700, wall_s: 7.0, ..Finished::default() };
        let line = "trained 7 iterations, 700 environment steps, in 0:07";
        assert_eq!(trained(&finished, 0), line);
        let line = "trained 3 iterations more in 0:07: 7 iterations, 700 environment steps in all";
        assert_eq!(trained(&finished, 4), line);
    }

    #[test]
    fn the_actors_hash_must_be_the_learners_and_the_servers() {
        let mut ran = ActorsPolicy {
            version: 3,
            sha256: "a".into(),
            learner_sha256: "a".into(),
            published: true,
        };
        assert!(ActorsHash::new(&ran, Some("a".into())).same);
        assert!(ActorsHash::new(&ran, None).same);
        assert!(!ActorsHash::new(&ran, Some("b".into())).same);
        ran.learner_sha256 = "b".into();
        assert!(!ActorsHash::new(&ran, None).same);
    }

    #[test]
    fn the_documentation_names_every_key_of_the_report() {
        let page = concat!(env!("CARGO_MANIFEST_DIR"), "/docs/reference/json.md");
        let page = std::fs::read_to_string(page).unwrap();
        let report = Report {
            run_id: "r".into(),
            folder: "f".into(),
            finished: Finished::default(),
            first_iteration: 0,
            actor_restarts: 0,
            learner_silences: 0,
            accounting: Balance::default(),
            choice: Choice { tried: vec![Tried::default()], ..Choice::default() },
            policy: PolicyHashes {
                version: 0,
                learner: String::new(),
                run_folder: String::new(),
                server: String::new(),
                robot: None,
                actors: Some(ActorsHash::new(&ActorsPolicy::default(), None)),
                same: true,
            },
            evaluation: Some(ScenarioResult::default()),
            robot: None,
            robot_failure: None,
            failure: None,
        };
        let report = serde_json::to_value(&report).unwrap();
        let objects = [
            &report,
            &report["accounting"],
            &report["policy"],
            &report["policy"]["actors"],
            &report["choice"],
            &report["choice"]["tried"][0],
            &report["evaluation"],
        ];
        for key in objects.iter().flat_map(|object| object.as_object().unwrap().keys()) {
            assert!(
                page.contains(&format!("`{key}`")),
                "docs/reference/json.md does not name `{key}`"
            );
        }
    }
}
