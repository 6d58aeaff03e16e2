//! What can be wrong with a configuration. Each error names the place and what to do.

use std::path::PathBuf;

/// What is wrong with a configuration.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read configuration {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    /// Not TOML.
    #[error("{origin}, line {line}, column {column}: {message}")]
    Syntax { origin: String, line: usize, column: usize, message: String },
    /// No such preset.
    #[error("there is no preset `{name}`; there are: {known}")]
    UnknownPreset { name: String, known: String },
    /// No such key.
    #[error("unknown key `{key}` in {origin}{}", suggestion.as_ref().map(|s| format!("; did you mean `{s}`?")).unwrap_or_default())]
    UnknownKey { key: String, origin: String, suggestion: Option<String> },
    /// A value of the wrong type, or a word that is not one of the allowed ones.
    #[error(
        "wrong value{}{}: {message}",
        key.as_ref().map(|k| format!(" for `{k}`")).unwrap_or_default(),
        origin.as_ref().map(|o| format!(" in {o}")).unwrap_or_default()
    )]
    WrongType { key: Option<String>, origin: Option<String>, message: String },
    /// A value outside its range, or values that do not fit each other.
    #[error("`{key}` = {value}: {rule}")]
    OutOfRange { key: &'static str, value: String, rule: String },
    /// A section that another crate checks.
    #[error("section `{section}`: {message}")]
    Section { section: &'static str, message: String },
    /// A key that stays as it is while a run goes on.
    #[error("`{key}` cannot change while a run goes on: {reason}")]
    Fixed { key: String, reason: &'static str },
    /// Changes that cannot be taken as they are.
    #[error("{origin} {message}")]
    Changes { origin: String, message: String },
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
