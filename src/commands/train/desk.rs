//! Where changes of a running training are asked for: by its live page, and by `caudata tune`.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use caudata_config::{Changes, Config, ConfigError, ask};
use caudata_live::{LivePage, Settings};
use caudata_telemetry::progress::{Changed, Event};
use caudata_telemetry::{ExitCode, Failure, FailureExt};

/// Changes that the page is told of, the newest.
const MADE_TOLD: usize = 32;

/// The settings of one run, as they are now.
pub struct Desk {
    run: PathBuf,
    first: Config,
    record: Changes,
    now: Mutex<Now>,
}

struct Now {
    config: Config,
    made: Vec<Changed>,
}

impl Desk {
    /// Opens that of the run in a folder, whose configuration is `first`, with its record of changes.
    ///
    /// # Errors
    /// When the record cannot be used.
    pub fn open(run: &Path, first: &Config) -> Result<Self, Failure> {
        let record = Changes::of_run(run, first).or_exit(ExitCode::BadInput)?;
        let desk = Self {
            run: run.to_owned(),
            first: first.clone(),
            record,
            now: Mutex::new(Now { config: first.clone(), made: Vec::new() }),
        };
        desk.begin(u64::MAX);
        Ok(desk)
    }

    /// The settings with which a learner begins that has done so many iterations.
    fn begin(&self, iteration: u64) {
        let all = self.record.change.iter();
        let before = all.filter(|change| change.iteration < iteration);
        let made =
            before.map(|change| Changed { iteration: change.iteration, set: change.set.clone() });
        let before = iteration.checked_sub(1);
        let config = before.and_then(|before| self.record.at(&self.first, before).ok());
        *self.now() =
            Now { config: config.unwrap_or_else(|| self.first.clone()), made: made.collect() };
    }

    /// Asks the learner for a change; answers the request, a file that is gone once it is taken.
    ///
    /// # Errors
    /// What is wrong with a setting, in a line.
    pub fn ask(&self, set: &[String]) -> Result<PathBuf, ConfigError> {
        self.now().config.changed(&self.first, set)?;
        ask(&self.run, set)
    }

    /// What may change, and what has.
    pub fn settings(&self) -> Settings {
        let now = self.now();
        Settings {
            values: now.config.changeable(),
            made: now.made[now.made.len().saturating_sub(MADE_TOLD)..].to_vec(),
        }
    }

    /// Follows an event of the learner, and shows it on the page.
    pub fn follow(&self, event: &Event, page: &LivePage) {
        match event {
            Event::Iteration(iteration) => return page.training(iteration),
            Event::Started(started) => self.begin(started.iteration),
            Event::Changed(change) => {
                let mut now = self.now();
                // The learner has checked it.
                if let Ok(config) = now.config.changed(&self.first, &change.set) {
                    now.config = config;
                }
                now.made.push(change.clone());
            }
            Event::Warning(warning) => return page.note(&warning.message),
            _ => return,
        }
        page.settings(&self.settings());
    }

    fn now(&self) -> MutexGuard<'_, Now> {
        self.now.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
