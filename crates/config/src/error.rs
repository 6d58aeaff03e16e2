//! What can be wrong with a configuration. Each error names the place and what to do.

use std::path::PathBuf;

/// What is wrong with a configuration.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read configuration {path}: {source}")]
    Read {
        /// File.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not TOML.
    #[error("{origin}, line {line}, column {column}: {message}")]
    Syntax {
        /// File, preset or override.
        origin: String,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// What the parser says.
        message: String,
    },
    /// No such preset.
    #[error("there is no preset `{name}`; there are: {known}")]
    UnknownPreset {
        /// What was asked for.
        name: String,
        /// What there is.
        known: String,
    },
    /// No such key.
    #[error("unknown key `{key}` in {origin}{}", suggestion.as_ref().map(|s| format!("; did you mean `{s}`?")).unwrap_or_default())]
    UnknownKey {
        /// Full key.
        key: String,
        /// File, preset or override.
        origin: String,
        /// Nearest known key.
        suggestion: Option<String>,
    },
    /// A value of the wrong type, or a word that is not one of the allowed ones.
    #[error("wrong value{}: {message}", key.as_ref().map(|k| format!(" for `{k}`")).unwrap_or_default())]
    WrongType {
        /// Full key, where known.
        key: Option<String>,
        /// What was expected.
        message: String,
    },
    /// A value outside its range, or values that do not fit each other.
    #[error("`{key}` = {value}: {rule}")]
    OutOfRange {
        /// Full key.
        key: &'static str,
        /// The value.
        value: String,
        /// The rule it breaks.
        rule: String,
    },
    /// A section that another crate checks.
    #[error("section `{section}`: {message}")]
    Section {
        /// Its name.
        section: &'static str,
        /// What its owner says.
        message: String,
    },
    /// A key that stays as it is while a run goes on.
    #[error("`{key}` cannot change while a run goes on: {reason}")]
    Fixed {
        /// Full key.
        key: String,
        /// Why.
        reason: &'static str,
    },
    /// Changes that cannot be taken as they are.
    #[error("{origin} {message}")]
    Changes {
        /// File, or what it is.
        origin: String,
        /// What is wrong.
        message: String,
    },
    /// A robot that the preset cannot be worked out for.
    #[error("{0}")]
    Robot(String),
    /// An override that is not `key=value`.
    #[error("override `{0}` is not of the form key=value, for instance learner.ppo.gamma=0.98")]
    BadOverride(String),
    /// A value that TOML cannot hold.
    #[error("the configuration cannot be written as TOML: {0}")]
    Unrepresentable(String),
}
