//! The output folder of a study: it is one process's at a time, and a call goes on in it only if it asks for
//! what the folder was made with.

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use caudata_config::Config;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use nix::fcntl::{FcntlArg, FdFlag, fcntl};

use crate::files;

/// What a folder was made with, beside what was made.
const ASKED: &str = "asked.json";
/// Locked by the process that works in the folder.
const LOCK: &str = "lock";
/// So many differences are named.
const NAMED: usize = 3;

/// Keys and flags that decide what is made, with their values; of files their SHA-256: one that has changed
/// is another.
pub type Asked = BTreeMap<String, String>;

/// The keys of `config` but for `own`, which the command sets itself, and `flags`; a program of another
/// version makes something else too.
pub fn asked<'a>(
    config: &Config,
    own: &[&str],
    flags: impl IntoIterator<Item = (&'a str, String)>,
) -> Asked {
    let keys = config.entries().into_iter();
    let mut asked: Asked = keys.filter(|(key, _)| !own.contains(&key.as_str())).collect();
    let flags = flags.into_iter().map(|(flag, value)| (flag.to_owned(), value));
    asked.extend(flags);
    asked.insert("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned());
    asked
}

/// A folder that no other process takes as long as this lives.
#[derive(Debug)]
pub struct OutFolder {
    /// The system lets go of it when this process and its steps have ended, however they do.
    lock: File,
}

impl Drop for OutFolder {
    fn drop(&mut self) {
        // A child that was started for something else may have inherited it.
        let _ = self.lock.unlock();
    }
}

impl OutFolder {
    /// Takes the folder `out`, which is made where it is absent. Whatever is in it was made by an earlier
    /// call, which must have asked for the same.
    ///
    /// # Errors
    /// Exit code 73 where another process has it, it was made with something else, or it does not say with
    /// what; then nothing is changed in it.
    pub fn take(out: &Path, asked: &Asked) -> Result<Self, Failure> {
        let taken = Self::lock(out)?;
        let path = out.join(ASKED);
        if path.exists() {
            same_as_before(out, &path, asked)?;
        } else {
            if let Some(other) = other_than_lock(out)? {
                let (other, path) = (other.display(), path.display());
                return Err(refused(format!("{other} is there, and {path} is not")));
            }
            files::write_json(&path, asked)?;
        }
        Ok(taken)
    }

    /// The same whatever is in it.
    ///
    /// # Errors
    /// Exit code 73 where another process has it.
    pub fn lock(out: &Path) -> Result<Self, Failure> {
        files::make_folder(out)?;
        Ok(Self { lock: locked(out)? })
    }
}

/// Something in the folder.
fn other_than_lock(out: &Path) -> Result<Option<PathBuf>, Failure> {
    let cannot = || format!("cannot read {}", out.display());
    let entries = std::fs::read_dir(out).or_exit_with(ExitCode::NoInput, cannot)?;
    let mut paths = entries.filter_map(|entry| Some(entry.ok()?.path()));
    Ok(paths.find(|path| path.file_name().is_some_and(|name| name != LOCK)))
}

fn refused(message: String) -> Failure {
    Failure::message(ExitCode::CannotCreate, message).hint("choose another --out")
}

fn locked(out: &Path) -> Result<File, Failure> {
    let path = out.join(LOCK);
    let cannot = || format!("cannot write {}", path.display());
    let file = File::create(&path).or_exit_with(ExitCode::CannotCreate, cannot)?;
    match file.try_lock() {
        Ok(()) => {
            // Inherited by the steps: a step that outlives this process by a moment still has the folder.
            fcntl(&file, FcntlArg::F_SETFD(FdFlag::empty())).or_exit(ExitCode::OsResource)?;
            Ok(file)
        }
        Err(TryLockError::WouldBlock) => {
            let message = format!("another process is at work in {}", out.display());
            Err(Failure::message(ExitCode::CannotCreate, message)
                .hint("wait until it ends, stop it, or choose another --out"))
        }
        Err(TryLockError::Error(error)) => Err(Failure::new(ExitCode::of_io(&error, true), error)
            .context(format!("cannot lock {}", path.display()))),
    }
}

/// Compares what is asked for with what `out` was made with, as the file `path` says.
fn same_as_before(out: &Path, path: &Path, asked: &Asked) -> Result<(), Failure> {
    let before: Asked = files::read_json(path)?;
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
    Err(refused(format!("{out} was made with something else: {named}")))
}

/// Keys that differ, in words.
pub fn differences(before: &Asked, now: &Asked) -> Vec<String> {
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

    fn asked_of(pairs: &[(&str, &str)]) -> Asked {
        let owned = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        pairs.iter().map(owned).collect()
    }

    fn said(failure: &Failure) -> String {
        let mut said = Vec::new();
        failure.write_to(&mut said).unwrap();
        String::from_utf8(said).unwrap()
    }

    #[test]
    fn a_folder_goes_on_with_what_it_was_made_with_only() {
        let folder = tempfile::tempdir().unwrap();
        let take = |asked: &Asked| OutFolder::take(folder.path(), asked).map(drop);
        let first = asked_of(&[("a", "1"), ("b", "2")]);
        take(&first).unwrap();
        take(&first).unwrap();
        let other = asked_of(&[("a", "1"), ("b", "3"), ("c", "4")]);
        let refused = take(&other).unwrap_err();
        assert_eq!(refused.code(), ExitCode::CannotCreate);
        let wanted = "b was 2 and is 3, c was absent and is 4";
        assert!(said(&refused).contains(wanted), "{refused:?}");
        take(&first).unwrap();
    }

    #[test]
    fn what_was_made_with_nobody_knows_what_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("run")).unwrap();
        let refused = OutFolder::take(folder.path(), &Asked::new()).unwrap_err();
        assert_eq!(refused.code(), ExitCode::CannotCreate);
        assert!(!folder.path().join(ASKED).exists());
    }

    #[test]
    fn a_folder_is_one_process_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let take = |asked: &Asked| OutFolder::take(folder.path(), asked);
        let first = asked_of(&[("a", "1")]);
        let taken = take(&first).unwrap();
        let refused = take(&asked_of(&[("a", "2")])).unwrap_err();
        assert_eq!(refused.code(), ExitCode::CannotCreate);
        assert!(said(&refused).contains("another process is at work"));
        let kept = std::fs::read_to_string(folder.path().join(ASKED)).unwrap();
        assert!(kept.contains("\"1\""), "{kept}");
        drop(taken);
        take(&first).unwrap();
    }
}
