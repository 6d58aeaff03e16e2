//! Which policy versions may have been handed out, on disk before they are. A learner that is killed goes on
//! from a checkpoint that is older than what its actors have; its versions must go on behind theirs, because
//! bytes under a version never change.

use std::path::{Path, PathBuf};

use crate::LearnerError;

/// Versions that are noted at once, so that not every one costs a write. A learner that was killed leaves out
/// at most so many.
const AHEAD: u64 = 64;

/// The note in the run folder: run id and version.
#[derive(Debug)]
pub(super) struct Versions {
    path: PathBuf,
    run_id: String,
    /// Every version up to this one may have been handed out.
    noted: Option<u64>,
}

impl Versions {
    /// What an earlier process of this run has noted in `run_dir`, if there was one.
    ///
    /// # Errors
    /// The note cannot be read, or is none.
    pub fn open(run_dir: &Path, run_id: &str) -> Result<Self, LearnerError> {
        let path = run_dir.join("versions");
        let noted = match std::fs::read_to_string(&path) {
            Ok(text) => noted(&text, run_id).ok_or_else(|| {
                let path = path.display();
                LearnerError::setting(format!(
                    "{path} is not a note of versions; remove it if no actor of this run is left"
                ))
            })?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
            Err(error) => {
                let path = path.display();
                return Err(LearnerError::setting(format!("cannot read {path}: {error}")));
            }
        };
        Ok(Self { path, run_id: run_id.to_owned(), noted })
    }

    /// The highest version that may have been handed out.
    pub fn highest(&self) -> Option<u64> {
        self.noted
    }

    /// To be called before `version` is handed out.
    ///
    /// # Errors
    /// The note cannot be written.
    pub fn before(&mut self, version: u64) -> Result<(), LearnerError> {
        match self.noted {
            Some(noted) if version <= noted => Ok(()),
            _ => self.note(version + AHEAD),
        }
    }

    /// No version above `version` was handed out, nor will be.
    ///
    /// # Errors
    /// The note cannot be written.
    pub fn at_the_end(&mut self, version: u64) -> Result<(), LearnerError> {
        self.note(version)
    }

    fn note(&mut self, version: u64) -> Result<(), LearnerError> {
        let text = format!("{} {version}\n", self.run_id);
        caudata_durable::replace(&self.path, text.as_bytes())?;
        self.noted = Some(version);
        Ok(())
    }
}

/// `None`: not a note. `Some(None)`: of another run.
fn noted(text: &str, run_id: &str) -> Option<Option<u64>> {
    let (of, version) = text.trim_end().rsplit_once(' ')?;
    let version = version.parse().ok()?;
    Some((of == run_id).then_some(version))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_handed_out_is_known_to_the_next_process() {
        let dir = tempfile::tempdir().unwrap();
        let open = |run_id| Versions::open(dir.path(), run_id).unwrap();
        let mut versions = open("run");
        assert_eq!(versions.highest(), None);
        versions.before(7).unwrap();
        // Killed here: anything up to 7 + 64 may have been handed out.
        assert_eq!(open("run").highest(), Some(71));
        versions.before(71).unwrap();
        assert_eq!(open("run").highest(), Some(71));
        versions.before(72).unwrap();
        assert_eq!(open("run").highest(), Some(136));
        // In good order nothing is left out.
        versions.at_the_end(73).unwrap();
        assert_eq!(open("run").highest(), Some(73));
        assert_eq!(open("another").highest(), None);
    }

    #[test]
    fn what_is_no_note_is_named() {
        let dir = tempfile::tempdir().unwrap();
        for bad in ["", "run", "run x"] {
            std::fs::write(dir.path().join("versions"), bad).unwrap();
            let error = Versions::open(dir.path(), "run").unwrap_err();
            assert!(error.to_string().contains("versions"), "{error}");
        }
    }
}
