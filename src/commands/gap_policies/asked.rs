//! What a folder of policies was asked for: another call goes on in it only with the same.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use super::{Effort, Given, Way, write};

/// Its file, beside the runs.
const FILE: &str = "asked.json";
/// Keys that every training sets for itself.
const OWN: [&str; 3] = ["robot", "run.seed", "run.iterations"];
/// So many differences are named.
const NAMED: usize = 3;

/// Keys and flags with their values.
pub type Asked = BTreeMap<String, String>;

/// All that decides what one training and its evaluations come to; not how many there are. Robots and policy by their SHA-256: a file that has changed is another.
pub fn all(effort: &Effort, given: &Given, models: &[Arc<RobotModel>; 3]) -> Asked {
    let keys = given.config.entries().into_iter();
    let mut asked: Asked = keys
        .filter(|(key, _)| !OWN.contains(&key.as_str()))
        .collect();
    let [robot, extended, truth] = models.each_ref().map(|model| model.hash_hex());
    for (flag, value) in [
        ("--robot", robot),
        ("--extended", extended),
        ("--truth", truth),
        ("--policy", given.start.clone().unwrap_or("none".to_owned())),
        ("--iterations", effort.iterations.to_string()),
        ("--suite", effort.suite.name().to_owned()),
        ("--episodes", effort.episodes.to_string()),
        ("--referee-episodes", effort.referee_episodes.to_string()),
    ] {
        asked.insert(flag.to_owned(), value);
    }
    asked
}

/// Writes what is asked for into a new folder; compares it with what stands in one that is there.
///
/// # Errors
/// Exit code 73 where it is not the same, or the folder has runs and does not say how they were made.
pub fn same_as_before(out: &Path, asked: &Asked) -> Result<(), Failure> {
    let path = out.join(FILE);
    let refused = |message: String| {
        Failure::message(ExitCode::CannotCreate, message).hint("choose another --out")
    };
    if !path.exists() {
        let run = out.join(format!("{}_1", Way::AsGiven.name()));
        if run.exists() {
            let message = format!("{} is there, and {} is not", run.display(), path.display());
            return Err(refused(message));
        }
        let text = serde_json::to_vec_pretty(asked).or_exit(ExitCode::Internal)?;
        return write(&path, &text);
    }
    let text = std::fs::read(&path).or_exit_with(ExitCode::NoInput, || {
        format!("cannot read {}", path.display())
    })?;
    let before: Asked = serde_json::from_slice(&text)
        .or_exit_with(ExitCode::BadInput, || path.display().to_string())?;
    let differences = differences(&before, asked);
    if differences.is_empty() {
        return Ok(());
    }
    let more = differences.len().saturating_sub(NAMED);
    let mut named = differences;
    named.truncate(NAMED);
    if more > 0 {
        named.push(format!("{more} more"));
    }
    let (out, named) = (out.display(), named.join(", "));
    Err(refused(format!("{out} was made with other flags: {named}")))
}

/// In words.
fn differences(before: &Asked, now: &Asked) -> Vec<String> {
    let mut keys: Vec<&String> = before.keys().chain(now.keys()).collect();
    keys.sort_unstable();
    keys.dedup();
    let value = |of: &Asked, key: &str| of.get(key).map_or("absent".to_owned(), Clone::clone);
    keys.into_iter()
        .filter_map(|key| {
            let (was, is) = (value(before, key), value(now, key));
            (was != is).then(|| format!("{key} was {was} and is {is}"))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(pairs: &[(&str, &str)]) -> Asked {
        let owned = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        pairs.iter().map(owned).collect()
    }

    #[test]
    fn a_folder_goes_on_with_what_it_was_made_with_only() {
        let folder = tempfile::tempdir().unwrap();
        let first = asked(&[("a", "1"), ("b", "2")]);
        same_as_before(folder.path(), &first).unwrap();
        same_as_before(folder.path(), &first).unwrap();
        let other = asked(&[("a", "1"), ("b", "3"), ("c", "4")]);
        let refused = same_as_before(folder.path(), &other).unwrap_err();
        assert_eq!(refused.code(), ExitCode::CannotCreate);
        let mut said = Vec::new();
        refused.write_to(&mut said).unwrap();
        let said = String::from_utf8(said).unwrap();
        let wanted = "b was 2 and is 3, c was absent and is 4";
        assert!(said.contains(wanted), "{said}");
        same_as_before(folder.path(), &first).unwrap();
    }

    #[test]
    fn runs_of_unknown_flags_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("as_given_1")).unwrap();
        let refused = same_as_before(folder.path(), &Asked::new()).unwrap_err();
        assert_eq!(refused.code(), ExitCode::CannotCreate);
        assert!(!folder.path().join(FILE).exists());
    }
}
