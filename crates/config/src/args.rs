//! The flags that choose a configuration, the same in every binary.

use std::path::{Path, PathBuf};

use crate::layers::layers;
use crate::{Config, ConfigError, Source};

/// The override that names a robot file.
pub fn robot_assignment(path: &Path) -> String {
    format!("robot={}", toml::Value::from(path.display().to_string()))
}

/// Flags that choose a configuration. Later ones win: preset, file, overrides.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct ConfigArgs {
    /// A configuration that comes with the program; `caudata config presets` lists them
    #[arg(long, value_name = "NAME", help_heading = "Configuration")]
    pub preset: Option<String>,
    /// A TOML file; keys it does not have come from the preset and the defaults
    #[arg(long, value_name = "FILE.toml", help_heading = "Configuration")]
    pub config: Option<PathBuf>,
    /// Robot file, instead of the configuration's
    #[arg(long, value_name = "FILE.robot.toml", help_heading = "Configuration")]
    pub robot: Option<PathBuf>,
    /// Set one key, for instance learner.ppo.gamma=0.98; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE", help_heading = "Configuration")]
    pub overrides: Vec<String>,
}

impl ConfigArgs {
    /// The source that the flags describe.
    pub fn source(&self) -> Source {
        Source {
            preset: self.preset.clone(),
            file: self.config.clone(),
            overrides: self.assignments(),
        }
    }

    /// Every `--set` in order, and `--robot FILE` as one more.
    pub fn assignments(&self) -> Vec<String> {
        let robot = self.robot.as_deref().map(robot_assignment);
        self.overrides.iter().cloned().chain(robot).collect()
    }

    /// Whether preset, file or overrides have this key of a section.
    ///
    /// # Errors
    /// As [`Config::load`], of what cannot be read.
    pub fn sets(&self, section: &str, key: &str) -> Result<bool, ConfigError> {
        let layers = layers(&self.source())?;
        let has = |table: &toml::Table| table.get(section).is_some_and(|s| s.get(key).is_some());
        Ok(layers.iter().any(|(_, layer)| has(layer)))
    }

    /// Reads and checks the configuration that the flags describe.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn load(&self) -> Result<Config, ConfigError> {
        Config::load(&self.source())
    }
}
