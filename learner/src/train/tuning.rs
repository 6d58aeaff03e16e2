//! Changes while the run goes on: those of its record, which are made again, and those that are asked for in
//! its folder.

use std::path::PathBuf;

use caudata_actor::Retunes;
use caudata_config::{
    CHANGES, CHANGES_MAX, Change, Changes, Config, ConfigError, TransportKind, asked,
};

use super::settings::TrainSettings;
use crate::LearnerError;

/// The configuration as it is, and how it came to be so.
pub(super) struct Tuning {
    run_dir: PathBuf,
    first: Config,
    now: Config,
    record: Changes,
    /// `None`: the actors are other processes.
    actors: Option<Retunes>,
}

impl Tuning {
    /// Reads the record of a run that begins, or goes on, with `iteration` iterations done.
    ///
    /// # Errors
    /// The record cannot be read, or asks for what cannot be.
    pub fn open(
        settings: &TrainSettings,
        iteration: u64,
        inproc: bool,
    ) -> Result<Self, LearnerError> {
        let mut first = settings.config.clone();
        if !inproc && first.transport.kind == TransportKind::Inproc {
            // Told otherwise by `--transport`.
            first.transport.kind = TransportKind::Zenoh;
        }
        let refused = |error: ConfigError| LearnerError::setting(error.to_string());
        let record = Changes::of_run(&settings.run_dir, &first).map_err(refused)?;
        let now = match iteration.checked_sub(1) {
            Some(before) => record.at(&first, before).map_err(refused)?,
            None => first.clone(),
        };
        let actors = inproc.then(Retunes::default);
        if let Some(actors) = actors.as_ref().filter(|_| now.task != first.task) {
            actors.add(0, now.task.clone());
        }
        Ok(Self { run_dir: settings.run_dir.clone(), first, now, record, actors })
    }

    /// The configuration as it is.
    pub fn now(&self) -> &Config {
        &self.now
    }

    /// Where the actors of this process learn of their task.
    pub fn retunes(&self) -> Retunes {
        self.actors.clone().unwrap_or_default()
    }

    /// Makes the changes of this iteration, the first policy of which will be `version`; answers them. What is
    /// refused goes to `refused`, a line each.
    ///
    /// # Errors
    /// The record cannot be written.
    pub fn make(
        &mut self,
        iteration: u64,
        version: u64,
        refused: &mut dyn FnMut(String),
    ) -> Result<Vec<Change>, LearnerError> {
        for (path, set) in asked(&self.run_dir) {
            let taken = set.map_err(LearnerError::setting);
            let record = taken.and_then(|set| self.with(Change { iteration, set }));
            let written = record.and_then(|record| {
                let text = record.to_toml();
                let text = text.map_err(|error| LearnerError::setting(error.to_string()))?;
                Ok((record, text))
            });
            match written {
                Ok((record, text)) => {
                    caudata_durable::replace(&self.run_dir.join(CHANGES), text.as_bytes())?;
                    self.record = record;
                }
                Err(error) => refused(format!("a change is refused: {error}")),
            }
            match std::fs::remove_file(&path) {
                // who asked takes the request back after a while
                Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                    return Err(LearnerError::write(&path, error));
                }
                _ => {}
            }
        }
        let all = self.record.change.iter();
        let due: Vec<Change> = all.filter(|c| c.iteration == iteration).cloned().collect();
        if due.is_empty() {
            return Ok(due);
        }
        let now = self.record.at(&self.first, iteration);
        self.now = now.map_err(|error| LearnerError::setting(error.to_string()))?;
        if let Some(actors) = &self.actors {
            actors.add(version, self.now.task.clone());
        }
        Ok(due)
    }

    /// The record with one more change, if it is fine with everything that comes later, too.
    fn with(&self, change: Change) -> Result<Changes, LearnerError> {
        let mut record = self.record.clone();
        if record.change.len() >= CHANGES_MAX {
            let message = format!("this run has changed {CHANGES_MAX} times");
            return Err(LearnerError::setting(message));
        }
        let before = |other: &Change| other.iteration <= change.iteration;
        let at = record.change.partition_point(before);
        record.change.insert(at, change);
        let all = record.at(&self.first, u64::MAX);
        all.map_err(|error| LearnerError::setting(error.to_string()))?;
        Ok(record)
    }
}
