//! A run folder as it is read, and the configuration that is known to train such a robot.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::{Changes, Config, Preset, Source};
use caudata_model::RobotModel;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use toml::{Table, Value};

/// Sections that decide how training goes.
const DECISIVE: [&str; 6] =
    ["actors.", "learner.", "engine.", "terrain.", "task.", "evaluation.command_mps"];
/// Keys among them that decide how fast it goes, or what is kept of it.
const INCIDENTAL: [&str; 13] = [
    "actors.threads",
    "actors.max_lead",
    "actors.lockstep",
    "actors.policy_timeout_s",
    "actors.flush_timeout_s",
    "actors.restarts_per_minute",
    "learner.device",
    "learner.threads",
    "learner.publish_every",
    "learner.checkpoint_every",
    "learner.keep_checkpoints",
    "learner.warm_start.",
    "task.stagger_first_episode",
];

/// What is explained.
#[derive(Clone, Debug)]
pub struct Run {
    /// Its folder.
    pub folder: PathBuf,
    /// Its configuration, with the changes that were made while it ran.
    pub config: Config,
    /// These changes, `a.b=c` each, in order.
    changed: Vec<String>,
    /// What is known to train such a robot: the preset for it, or what follows from its file.
    pub reference: Config,
    /// Its robot.
    pub model: Arc<RobotModel>,
}

impl Run {
    /// Reads the configuration of a run folder, and the robot.
    ///
    /// # Errors
    /// Exit codes 64 to 66 where a file of it is missing or wrong.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let config = folder.join("config.toml");
        files::run_folder(folder)?;
        let config = Config::load(&Source::file(&config)).or_exit(ExitCode::BadConfig)?;
        let changes = Changes::of_run(folder, &config).or_exit(ExitCode::BadInput)?;
        let config = changes.at(&config, u64::MAX).or_exit(ExitCode::BadInput)?;
        let robot = config.robot_path();
        let model = Arc::new(files::robot(&robot)?);
        // a run is named after its preset where nobody named it
        let wanted = match Preset::find(&config.run.name) {
            Some(preset) => preset.name,
            None => "quick",
        };
        let source = Source::preset(Preset::for_robot(wanted, model.name()));
        let source = source.set(assignment("robot", &text(&robot)));
        let mut reference = Config::load(&source).or_exit(ExitCode::BadConfig)?;
        if config.terrain.is_deep_water() {
            // land is no cure for what is to swim
            reference.terrain = config.terrain.clone();
        }
        Ok(Self {
            folder: folder.to_owned(),
            reference,
            config,
            changed: changes.settings(),
            model,
        })
    }

    /// The configuration with assignments (`a.b=c`) on top.
    ///
    /// # Errors
    /// Exit code 64 where that is no valid configuration.
    pub fn with(&self, sets: &[String]) -> Result<Config, Failure> {
        let source = Source {
            preset: None,
            file: Some(self.folder.join("config.toml")),
            overrides: [&self.changed, sets].concat(),
        };
        Config::load(&source).or_exit(ExitCode::BadConfig)
    }

    /// Keys whose values differ from the reference and may matter: key, value, the reference's value.
    pub fn differences(&self) -> Vec<(String, String, String)> {
        let reference = self.reference.entries();
        let matters = |key: &str| {
            DECISIVE.iter().any(|prefix| key.starts_with(prefix))
                && !INCIDENTAL.iter().any(|prefix| key.starts_with(prefix))
        };
        let own = self.config.entries().into_iter();
        own.filter(|(key, _)| matters(key))
            .filter_map(|(key, value)| {
                let (_, other) = reference.iter().find(|(name, _)| *name == key)?;
                (value != *other).then(|| (key, value, other.clone()))
            })
            .collect()
    }
}

/// A path as TOML text.
pub(crate) fn text(path: &Path) -> String {
    Value::from(path.display().to_string()).to_string()
}

/// `key=value`.
pub(crate) fn assignment(key: &str, value: &str) -> String {
    format!("{key}={value}")
}

/// The numbers of a value in TOML text; empty where it is none.
pub(crate) fn numbers(value: &str) -> Vec<f64> {
    let parsed = format!("v = {value}").parse::<Table>().ok();
    let number = |v: &Value| v.as_float().or_else(|| v.as_integer().map(|i| i as f64));
    match parsed.as_ref().and_then(|table| table.get("v")) {
        Some(Value::Array(all)) => all.iter().filter_map(number).collect(),
        Some(one) => number(one).into_iter().collect(),
        None => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::numbers;

    #[test]
    fn values_are_read_as_numbers() {
        assert_eq!(numbers("-0.02"), [-0.02]);
        assert_eq!(numbers("[1, 2.5]"), [1.0, 2.5]);
        assert!(numbers("\"alternate\"").is_empty() && numbers("[]").is_empty());
    }
}
