//! Changes that a run is asked for, as files in its folder: whoever may write there may ask. The learner takes
//! them between two iterations.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use crate::ConfigError;

/// The folder of requests in a run folder.
const FOLDER: &str = "asked";
/// Requests that may wait.
const WAITING_MAX: usize = 16;
/// Bytes of one.
const BYTES_MAX: u64 = 32 << 10;

/// Leaves a request in the folder of a run; the file is gone once the learner has taken it.
///
/// # Errors
/// [`ConfigError::Changes`] where too many wait, or the file cannot be written.
pub fn ask(run: &Path, set: &[String]) -> Result<PathBuf, ConfigError> {
    let folder = run.join(FOLDER);
    let refused = |message: String| {
        let origin = folder.display().to_string();
        ConfigError::Changes { origin, message }
    };
    let cannot = |error: &dyn std::fmt::Display| refused(format!("cannot be written: {error}"));
    std::fs::create_dir_all(&folder).map_err(|error| cannot(&error))?;
    if waiting(run).len() >= WAITING_MAX {
        return Err(refused(format!("holds {WAITING_MAX} requests that nobody has taken yet")));
    }
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let now_ns = since.unwrap_or_default().as_nanos();
    let path = folder.join(format!("{now_ns:020}-{}.json", std::process::id()));
    let text = serde_json::to_vec(set).map_err(|error| cannot(&error))?;
    caudata_durable::create_new(&path, &text).map_err(|error| cannot(&error))?;
    Ok(path)
}

/// The requests that wait, the oldest first.
fn waiting(run: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(run.join(FOLDER)).into_iter().flatten();
    let mut paths: Vec<PathBuf> = entries
        .flatten()
        // a folder cannot be read, and a pipe would be waited for
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|end| end == "json"))
        .collect();
    paths.sort();
    paths.truncate(WAITING_MAX);
    paths
}

/// The requests that wait, each with its file, which is left for the caller to remove.
pub fn asked(run: &Path) -> Vec<(PathBuf, Result<Vec<String>, String>)> {
    let read = |path: PathBuf| {
        let text = caudata_durable::read_text_at_most(&path, BYTES_MAX);
        let set = text.map_err(|error| error.to_string());
        let set = set.and_then(|text| serde_json::from_str(&text).map_err(|e| e.to_string()));
        (path, set)
    };
    waiting(run).into_iter().map(read).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_taken_in_order_and_do_not_pile_up() {
        let dir = tempfile::tempdir().unwrap();
        assert!(asked(dir.path()).is_empty());
        for number in 0..WAITING_MAX {
            ask(dir.path(), &[format!("a={number}")]).unwrap();
        }
        let refused = ask(dir.path(), &[]).unwrap_err().to_string();
        assert!(refused.contains("nobody has taken"), "{refused}");
        let found = asked(dir.path());
        let first = found[0].1.as_ref().unwrap();
        assert_eq!((found.len(), first[0].as_str()), (WAITING_MAX, "a=0"));
        std::fs::write(&found[0].0, "no list").unwrap();
        assert!(asked(dir.path())[0].1.is_err());
        std::fs::create_dir(dir.path().join(FOLDER).join("0.json")).unwrap();
        assert_eq!(asked(dir.path()).len(), WAITING_MAX);
    }
}
