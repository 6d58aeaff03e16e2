//! Flags that several commands take.

use std::ffi::OsString;
use std::path::Path;

use caudata_config::{Config, ConfigArgs, PRESETS, Preset, Source};
use caudata_evaluation::Suite;
use caudata_model::RobotModel;
use caudata_sim::EngineKind;
use caudata_task::PolicyContract;
use clap::ValueEnum;
use clap::builder::{PossibleValuesParser, TypedValueParser};

/// The suites, as words on the command line.
pub fn suite_parser() -> impl TypedValueParser<Value = Suite> {
    PossibleValuesParser::new(Suite::ALL.map(Suite::name)).map(|name| {
        let named = |suite: &Suite| suite.name() == name;
        Suite::ALL.into_iter().find(named).unwrap_or(Suite::Flat)
    })
}

/// The engines, as words on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum EngineName {
    /// Articulated bodies in vector lanes, as in training
    Batch,
    /// Rapier multibody joints
    Rapier,
}

impl From<EngineName> for EngineKind {
    fn from(name: EngineName) -> Self {
        match name {
            EngineName::Batch => EngineKind::Batch,
            EngineName::Rapier => EngineKind::Rapier,
        }
    }
}

impl EngineName {
    /// Those that were named; all where none was.
    pub fn or_all(named: &[Self]) -> Vec<Self> {
        match named {
            [] => Self::value_variants().to_vec(),
            some => some.to_vec(),
        }
    }
}

/// Threads that this machine has.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// The flags as given, else this preset, or for another robot the one that is made for it.
pub fn or_preset(flags: &ConfigArgs, preset: &str) -> ConfigArgs {
    let mut source = flags.source();
    source.or_preset(preset);
    ConfigArgs { preset: source.preset, ..flags.clone() }
}

/// The flags as given; with a robot and neither preset nor file the preset that is made for it.
pub fn of_robot(flags: &ConfigArgs) -> ConfigArgs {
    match flags.robot.is_some() && flags.config.is_none() {
        true => or_preset(flags, "quick"),
        false => flags.clone(),
    }
}

/// The flags as given, else the configuration that lies beside a policy, else the preset as
/// [`or_preset`].
pub fn or_beside(flags: &ConfigArgs, policy: &Path, preset: &str) -> ConfigArgs {
    let mut flags = flags.clone();
    let beside = policy.with_file_name("config.toml");
    if flags.preset.is_none() && flags.config.is_none() && beside.is_file() {
        flags.config = Some(beside);
    }
    or_preset(&flags, preset)
}

/// The presets in whose tasks a policy's numbers mean what they meant in training; the one that it was most
/// likely trained with first.
pub fn presets_for(contract: &PolicyContract) -> Vec<&'static str> {
    let differences = |preset: &&Preset| {
        let config = Config::load(&Source::preset(preset.name)).ok()?;
        let model = RobotModel::load(&config.robot_path()).ok()?;
        let own = PolicyContract::new(&model, &config.task).ok()?;
        let differences = contract.differences(&own);
        let breaking = differences.iter().any(|d| d.is_breaking());
        (!breaking).then_some(differences.len())
    };
    let fitting = PRESETS.iter().map(|preset| (differences(&preset), preset.name));
    let mut fitting: Vec<(usize, &str)> =
        fitting.filter_map(|(differences, name)| Some((differences?, name))).collect();
    fitting.sort_by_key(|(differences, _)| *differences);
    fitting.into_iter().map(|(_, name)| name).collect()
}

/// The flags again, for a program that takes them too.
pub fn as_words(flags: &ConfigArgs) -> Vec<OsString> {
    let mut words: Vec<OsString> = Vec::new();
    if let Some(preset) = &flags.preset {
        words.extend(["--preset".into(), preset.into()]);
    }
    if let Some(file) = &flags.config {
        words.extend(["--config".into(), file.into()]);
    }
    for change in flags.assignments() {
        words.extend(["--set".into(), change.into()]);
    }
    words
}
