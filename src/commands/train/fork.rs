//! `caudata train --from RUN@ITERATION`: a new run that begins with a checkpoint of another one.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use caudata_config::{CHANGES, Change, Changes, Config, ConfigError, Source};
use caudata_studies::{Asked, differences, files};
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use super::folder::RunFolder;

/// Where it came from, in its run folder.
const ORIGIN: &str = "from.toml";

/// `RUN@ITERATION`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    run: PathBuf,
    iteration: u64,
}

impl FromStr for Origin {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "must be RUN@ITERATION, for instance runs/walk@100".to_owned();
        let (run, iteration) = text.rsplit_once('@').ok_or_else(wrong)?;
        Ok(Self { run: run.into(), iteration: iteration.parse().map_err(|_| wrong())? })
    }
}

/// What a run goes on with that begins with another's checkpoint.
pub struct Fork<'a> {
    origin: &'a Origin,
    /// The configuration that both began with.
    pub config: Config,
    changes: Changes,
}

impl<'a> Fork<'a> {
    /// Reads the other run. Of `overrides` those that may change while a run goes on do so at that iteration;
    /// of the others none may decide how training goes.
    ///
    /// # Errors
    /// When there is no such checkpoint, or an override is refused.
    pub fn read(origin: &'a Origin, overrides: &[String]) -> Result<Self, Failure> {
        files::run_folder(&origin.run)?;
        let mut source = Source::file(&origin.run.join("config.toml"));
        let before = Config::load(&source).or_exit(ExitCode::NoInput)?;
        let mut changes = Changes::of_run(&origin.run, &before).or_exit(ExitCode::BadInput)?;
        let until = changes.change.partition_point(|c| c.iteration <= origin.iteration);
        changes.change.truncate(until);
        let mut set = Vec::new();
        for over in overrides {
            match before.changed(&before, std::slice::from_ref(over)) {
                Err(ConfigError::Fixed { .. }) => source.overrides.push(over.clone()),
                // what is wrong with one alone may be right with the others: they are checked together below
                _ => set.push(over.clone()),
            }
        }
        let config = Config::load(&source).or_exit(ExitCode::BadConfig)?;
        same_training(&before, &config)?;
        if !set.is_empty() {
            let iteration = origin.iteration;
            changes.change.push(Change { iteration, set });
            changes.at(&config, u64::MAX).or_exit(ExitCode::BadConfig)?;
        }
        let fork = Self { origin, config, changes };
        let checkpoint = fork.checkpoint(&origin.run);
        if !checkpoint.is_dir() {
            let message = format!("{} is not there", checkpoint.display());
            return Err(Failure::message(ExitCode::NoInput, message)
                .hint("learner.checkpoint_every and learner.keep_checkpoints say which are kept"));
        }
        Ok(fork)
    }

    /// Name of the checkpoint.
    pub fn name(&self) -> String {
        format!("iter_{:06}", self.origin.iteration)
    }

    fn checkpoint(&self, run: &Path) -> PathBuf {
        run.join("checkpoints").join(self.name())
    }

    /// Puts into a new run folder what it begins with, and where that is from.
    ///
    /// # Errors
    /// When something cannot be copied.
    pub fn fill(&self, folder: &RunFolder) -> Result<(), Failure> {
        let Origin { run, iteration } = self.origin;
        copy_files(&self.checkpoint(run), &self.checkpoint(folder.root()))?;
        // What its actors had sent is part of the account.
        copy_files(&run.join("ledgers"), &folder.ledgers())?;
        if !self.changes.change.is_empty() {
            let text = self.changes.to_toml().or_exit(ExitCode::Internal)?;
            folder.write(CHANGES, text.as_bytes())?;
        }
        let id = std::fs::read_to_string(run.join("run_id.txt")).unwrap_or_default();
        let run = std::path::absolute(run).or_exit(ExitCode::NoInput)?;
        let text = format!(
            "run = {:?}\nrun_id = {:?}\niteration = {iteration}\n",
            run.display().to_string(),
            id.trim()
        );
        folder.write(ORIGIN, text.as_bytes())?;
        Ok(())
    }
}

/// Refuses a configuration under which a run would not go on as it began.
pub fn same_training(before: &Config, now: &Config) -> Result<(), Failure> {
    if before.robot_path() != now.robot_path() {
        let [was, is] = [before, now].map(|config| files::robot(&config.robot_path()));
        let (was, is) = (was?, is?);
        if was.hash() != is.hash() {
            let message = format!(
                "a run that goes on keeps its robot: it is `{}` of {}",
                was.name(),
                before.robot_path().display()
            );
            return Err(Failure::message(ExitCode::BadConfig, message)
                .hint("another robot is another run: leave --resume and --from out"));
        }
    }
    if before.hash() == now.hash() {
        return Ok(());
    }
    let message = format!(
        "a run that goes on must keep what decides its training: {}",
        differing(before, now).join(", ")
    );
    Err(Failure::message(ExitCode::BadConfig, message)
        .hint("only names, length, transport, services and telemetry may change so; `caudata tune` changes weights while \
               it runs, and `--from RUN@ITERATION --set …` begins another run where this one stands"))
}

/// The keys of decisive sections whose values differ, in words.
fn differing(before: &Config, now: &Config) -> Vec<String> {
    const DECISIVE: [&str; 6] = ["run.seed", "actors.", "learner.", "engine.", "terrain.", "task."];
    let decisive = |config: &Config| -> Asked {
        let all = config.entries().into_iter();
        all.filter(|(key, _)| DECISIVE.iter().any(|prefix| key.starts_with(prefix))).collect()
    };
    differences(&decisive(before), &decisive(now))
}

/// Copies the files of a folder into another, which is made.
fn copy_files(from: &Path, to: &Path) -> Result<(), Failure> {
    let copy = || -> std::io::Result<()> {
        std::fs::create_dir_all(to)?;
        for entry in std::fs::read_dir(from)? {
            let entry = entry?;
            if entry.file_type()?.is_file() {
                std::fs::copy(entry.path(), to.join(entry.file_name()))?;
            }
        }
        Ok(())
    };
    copy().or_exit_with(ExitCode::CannotCreate, || {
        format!("cannot copy {} to {}", from.display(), to.display())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_origin_is_a_run_and_an_iteration() {
        let origin = "runs/a@b@100".parse::<Origin>().unwrap();
        assert_eq!((origin.run, origin.iteration), ("runs/a@b".into(), 100));
        for wrong in ["runs/a", "runs/a@", "runs/a@-1", "100"] {
            assert!(wrong.parse::<Origin>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_key_that_keeps_a_run_from_going_on_is_named() {
        let config = |set: &str| Config::load(&Source::default().set(set)).unwrap();
        let (before, now) = (config("learner.ppo.gamma=0.97"), config("learner.ppo.gamma=0.9"));
        assert_eq!(differing(&before, &now), ["learner.ppo.gamma was 0.97 and is 0.9"]);
        assert!(differing(&before, &config("learner.ppo.gamma=0.97")).is_empty());
    }
}
