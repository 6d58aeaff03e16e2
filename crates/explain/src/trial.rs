//! A short training with some suspects put right, and how its policy walks.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_config::{Config, TransportKind};
use caudata_model::RobotModel;
use caudata_studies::failures::stopped;
use caudata_studies::{files, training};
use caudata_task::observation::ObservationTerm;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use toml::{Table, Value};

use crate::behaviour::Behaviour;
use crate::report::Trial;
use crate::run::{Run, assignment};
use crate::suspect::{Edit, Seen, Suspect};

/// Environment steps of a training: after half as many one quadruped in five stands still, and every biped.
const ENV_STEPS: u64 = 120 * 6144;
/// Fewest and most iterations, whatever the batch.
const ITERATIONS: [u64; 2] = [40, 400];
/// How often a training is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// The program that trains, and when to stop.
#[derive(Clone, Debug)]
pub struct Trainer {
    /// `caudata-learner`.
    pub learner: PathBuf,
    /// Raised where a person asks to stop.
    pub stop: StopFlag,
    /// When no training may run any more.
    pub until: Instant,
}

impl Trainer {
    /// Trains a configuration into `folder` in one process; the policy, or nothing where time was up.
    ///
    /// # Errors
    /// [`ExitCode::Internal`] where the learner refuses the configuration or fails, others where it cannot be
    /// started or a person asked to stop.
    pub fn train(&self, config: &Config, folder: &Path) -> Result<Option<PathBuf>, Failure> {
        let mut config = config.clone();
        config.transport.kind = TransportKind::Inproc;
        config.telemetry.metrics = false;
        config.learner.checkpoint_every = config.run.iterations;
        files::make_folder(folder)?;
        let file = folder.join("config.toml");
        files::write_whole(&file, config.to_toml().or_exit(ExitCode::BadConfig)?.as_bytes())?;
        let log = std::fs::File::create(folder.join("progress.jsonl"));
        let said = std::fs::File::create(folder.join("learner.log"));
        let words = ["--config".into(), file.into_os_string()];
        let mut child = training::command(&self.learner, &words, "explain", folder)
            .stdout(log.or_exit(ExitCode::CannotCreate)?)
            .stderr(said.or_exit(ExitCode::CannotCreate)?)
            .spawn()
            .or_exit(ExitCode::OsResource)?;
        loop {
            if let Some(status) = child.try_wait().or_exit(ExitCode::Internal)? {
                if status.success() {
                    return Ok(Some(folder.join("policy.onnx")));
                }
                let said = std::fs::read_to_string(folder.join("learner.log")).unwrap_or_default();
                let said = said.lines().find(|line| !line.trim().is_empty()).unwrap_or("");
                let message = format!("a training ended with {status}: {said}");
                return Err(Failure::message(ExitCode::Internal, message));
            }
            if self.stop.is_set() || Instant::now() >= self.until {
                // nothing of it is needed: it need not save
                child.kill().and_then(|()| child.wait()).or_exit(ExitCode::Internal)?;
                return if self.stop.is_set() { Err(stopped(&self.stop)) } else { Ok(None) };
            }
            std::thread::sleep(LOOK_EVERY);
        }
    }
}

/// Where trainings begin, and what is the same in all of them.
pub(crate) struct Start<'a> {
    pub run: &'a Run,
    pub trainer: &'a Trainer,
    pub seed: u64,
    /// How many times as long as usual.
    pub times: u64,
    /// The policy that they begin with, and costs in full from the first step; `None`: from nothing, as the run.
    pub from: Option<&'a Path>,
}

impl Start<'_> {
    /// Trains with these suspects put right, in `folder`; the policy stays there. `None` where time was up.
    ///
    /// # Errors
    /// [`ExitCode::BadConfig`] where the suspects cannot be put right together, else as [`Trainer::train`].
    pub fn trial(&self, suspects: &[&Suspect], folder: &Path) -> Result<Option<Trial>, Failure> {
        let began = Instant::now();
        files::make_folder(folder)?;
        let mut config = apply(self.run, suspects, folder)?;
        config.run.seed = self.seed;
        let all = ENV_STEPS.div_ceil(config.actors.steps_per_iteration().max(1));
        config.run.iterations = self.times * all.clamp(ITERATIONS[0], ITERATIONS[1]);
        if let Some(policy) = self.from {
            config.learner.warm_start.policy = policy.to_owned();
            let reward = &mut config.task.reward;
            (reward.costs_at_start, reward.costs_full_after_env_steps) = (1.0, 0);
            config.task.push.full_after_env_steps = 0;
        }
        let Some(policy) = self.trainer.train(&config, folder)? else { return Ok(None) };
        let model = Arc::new(files::robot(&config.robot_path())?);
        let policy = files::policy(&policy)?;
        Ok(Some(Trial {
            put_right: suspects.iter().map(|suspect| suspect.id).collect(),
            seed: self.seed,
            iterations: config.run.iterations,
            behaviour: Behaviour::of(
                &config,
                &self.run.reference,
                &model,
                &policy,
                &self.trainer.stop,
            )?,
            seconds: began.elapsed().as_secs_f64(),
        }))
    }
}

/// The run's configuration with suspects put right; files of another robot go into `folder`.
pub(crate) fn apply(run: &Run, suspects: &[&Suspect], folder: &Path) -> Result<Config, Failure> {
    let mut edits: Vec<&Edit> = Vec::new();
    let mut open: Vec<&Edit> = suspects.iter().rev().map(|suspect| &suspect.edit).collect();
    while let Some(edit) = open.pop() {
        match edit {
            Edit::All(inner) => open.extend(inner),
            one => edits.push(one),
        }
    }
    let sets = edits.iter().filter_map(|edit| match edit {
        Edit::Set(sets) => Some(sets.clone()),
        _ => None,
    });
    let mut config = run.with(&sets.flatten().collect::<Vec<_>>())?;
    let task = &mut config.task;
    for edit in &edits {
        match edit {
            Edit::Term { table, name, weight } if table.ends_with("term") => match weight {
                Some(weight) => {
                    let of = task.reward.term.iter_mut().filter(|term| term.name == *name);
                    of.for_each(|term| term.weight = *weight);
                }
                None => task.reward.term.retain(|term| term.name != *name),
            },
            Edit::Term { name, .. } => task.termination.when.retain(|when| when.name != *name),
            Edit::Observe { name, value } => observe(&mut task.observation.term, name, value),
            _ => {}
        }
    }
    if edits.iter().any(|e| matches!(e, Edit::Axis { .. } | Edit::Nominal { .. })) {
        config.robot = mended(&config.robot_path(), &edits, folder)?;
        let _: RobotModel = files::robot(&config.robot)?;
    }
    Ok(config)
}

/// Puts a term of an observation right, or adds it.
fn observe(terms: &mut Vec<ObservationTerm>, name: &str, value: &Seen) {
    let there = terms.iter_mut().find(|term| term.name == name);
    match (there, value) {
        (Some(term), Seen::BuiltIn) => term.value.clear(),
        (Some(term), Seen::Quiet) => term.noise_std = 0.0,
        (None, _) => {
            terms.push(ObservationTerm { name: name.to_owned(), ..ObservationTerm::default() })
        }
    }
}

/// A copy of a robot file in `folder` with joints put right.
fn mended(robot: &Path, edits: &[&Edit], folder: &Path) -> Result<PathBuf, Failure> {
    let read = |path: &Path| -> Result<String, Failure> {
        String::from_utf8(files::read(path)?).or_exit(ExitCode::BadInput)
    };
    let mut file: Table = read(robot)?.parse().or_exit(ExitCode::BadInput)?;
    let name = file.get("mjcf").and_then(Value::as_str).unwrap_or_default().to_owned();
    let mut mjcf = read(&robot.with_file_name(&name))?;
    for edit in edits {
        match edit {
            Edit::Axis { joint, axis } => mjcf = turned(&mjcf, joint, *axis),
            Edit::Nominal { joint, rad } => {
                let pose = file.get_mut("pose").and_then(|pose| pose.get_mut("nominal_rad"));
                if let Some(Value::Table(pose)) = pose {
                    pose.insert(joint.clone(), Value::Float(*rad));
                }
            }
            _ => {}
        }
    }
    let copy = folder.join("mended.robot.toml");
    files::write_whole(&copy, file.to_string().as_bytes())?;
    files::write_whole(&folder.join(name), mjcf.as_bytes())?;
    Ok(copy)
}

/// An MJCF whose joint of that name turns about `axis`.
pub fn turned(mjcf: &str, joint: &str, [x, y, z]: [f64; 3]) -> String {
    let named = format!("name=\"{joint}\"");
    let mut out = String::with_capacity(mjcf.len() + 32);
    let mut rest = mjcf;
    while let Some(at) = rest.find("<joint") {
        let end = at + rest[at..].find('>').map_or(rest.len() - at, |end| end + 1);
        let (before, tag) = (&rest[..at], &rest[at..end]);
        out.push_str(before);
        match tag.contains(&named) {
            true => {
                let bare = match tag.find(" axis=\"") {
                    Some(from) => {
                        let value = from + " axis=\"".len();
                        let after = value + tag[value..].find('"').map_or(0, |end| end + 1);
                        format!("{}{}", &tag[..from], &tag[after..])
                    }
                    None => tag.to_owned(),
                };
                out.push_str(&bare.replacen("<joint", &format!("<joint axis=\"{x} {y} {z}\""), 1));
            }
            false => out.push_str(tag),
        }
        rest = &rest[end..];
    }
    out + rest
}

/// What putting a suspect right changes, in words that `--set` takes, or about the robot file.
pub(crate) fn change(run: &Run, suspect: &Suspect) -> Vec<String> {
    let words = edit_words(&suspect.edit);
    if !words.is_empty() {
        return words;
    }
    let (before, after) = (run.config.entries(), apply(run, &[suspect], &run.folder));
    let after = after.map_or_else(|_| Vec::new(), |config| config.entries());
    let differs = |(a, b): &(&(String, String), &(String, String))| a != b;
    let pairs = before.iter().zip(&after).filter(differs);
    pairs.map(|(_, (key, value))| assignment(key, value)).collect()
}

/// What is to be changed in the robot file, in words; empty where it is the configuration.
fn edit_words(edit: &Edit) -> Vec<String> {
    match edit {
        Edit::All(inner) => inner.iter().flat_map(edit_words).collect(),
        Edit::Axis { joint, axis: [x, y, z] } => {
            vec![format!("in the robot's MJCF: joint {joint} with axis=\"{x} {y} {z}\"")]
        }
        Edit::Nominal { joint, rad } => {
            vec![format!("in the robot file: [pose.nominal_rad] {joint} = {rad:.4}")]
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::turned;

    #[test]
    fn one_joint_is_turned_round_whatever_it_said_before() {
        let mjcf = r#"<joint name="a"/><joint class="k" name="b" axis="0 1 0" range="0 1"/>"#;
        assert_eq!(
            turned(mjcf, "b", [0.0, -1.0, 0.0]),
            r#"<joint name="a"/><joint axis="0 -1 0" class="k" name="b" range="0 1"/>"#
        );
        assert_eq!(
            turned(mjcf, "a", [1.0, 0.0, 0.0]),
            mjcf.replacen("<joint name", "<joint axis=\"1 0 0\" name", 1)
        );
    }
}
