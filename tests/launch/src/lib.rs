//! What the tests of `docker/` share: the files, the programs, and the manifests as JSON.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result};
use serde::de::Deserialize;
use serde_json::Value;

/// The repository.
#[must_use]
pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// A file of the repository, as text.
///
/// # Errors
/// When it cannot be read.
pub fn read(path: &str) -> Result<String> {
    std::fs::read_to_string(repository().join(path)).with_context(|| path.to_owned())
}

/// The documents of a YAML file, merge keys applied, as JSON.
///
/// # Errors
/// When it is not YAML.
pub fn yaml(text: &str) -> Result<Vec<Value>> {
    serde_yaml_ng::Deserializer::from_str(text)
        .map(|document| {
            let mut value = serde_yaml_ng::Value::deserialize(document)?;
            value.apply_merge()?;
            Ok(serde_json::to_value(value)?)
        })
        .collect()
}

/// A program of this workspace beside the test executable, when it has been built.
#[must_use]
pub fn program(name: &str) -> Option<PathBuf> {
    // …/target/release/deps/<test> → …/target/release/<name>
    let test = std::env::current_exe().ok()?;
    let path = test.parent()?.parent()?.join(name);
    path.is_file().then_some(path)
}

/// The long flags that `name --help` lists. `None` when it has not been built.
///
/// # Errors
/// When it cannot be run.
pub fn flags_of(name: &str, subcommand: &[&str]) -> Result<Option<Vec<String>>> {
    let Some(path) = program(name) else {
        return Ok(None);
    };
    let output = Command::new(path).args(subcommand).arg("--help").output()?;
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let flags = text.split(|c: char| c.is_whitespace() || c == ',' || c == '[');
    Ok(Some(
        flags
            .filter(|word| word.starts_with("--"))
            .map(|word| word.trim_end_matches('.').to_owned())
            .collect(),
    ))
}

/// Whether a tool is on this machine.
#[must_use]
pub fn has_tool(name: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(name).is_file())
}

/// Says on standard error, past what the test harness captures, that a test did not run, and why.
pub fn skipped(why: &str) {
    use std::io::Write;
    let test = std::thread::current();
    let name = test.name().unwrap_or("a test");
    // Nobody can be told if even this fails.
    let _ = writeln!(std::io::stderr(), "skipped: {name}: {why}");
}
