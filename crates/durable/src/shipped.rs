//! Files that came with the program: robots, policies, wiring.

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Where files that came with the program are, in a process whose executable does not lie beside them.
static HOME: OnceLock<PathBuf> = OnceLock::new();

/// Makes [`shipped`] look below `home` instead of above this executable, for a library that another program
/// loads. Only the first call counts.
pub fn set_home(home: &Path) {
    let _ = HOME.set(home.to_owned());
}

/// A file that came with the program (`robots/…`, `policies/…`): a relative path is looked for in the current
/// directory and then in the folders above this executable. What is not found stays as it is.
pub fn shipped(path: &Path) -> PathBuf {
    match HOME.get() {
        Some(home) => find_upwards(path, home),
        None => find_upwards(path, &std::env::current_exe().unwrap_or_default()),
    }
}

/// [`shipped`] for a flag's value.
///
/// # Errors
/// None.
pub fn shipped_flag(path: &str) -> Result<PathBuf, Infallible> {
    Ok(shipped(Path::new(path)))
}

fn find_upwards(path: &Path, from: &Path) -> PathBuf {
    if path.is_absolute() || path.exists() {
        return path.to_owned();
    }
    from.ancestors()
        .map(|folder| folder.join(path))
        .find(|candidate| candidate.exists())
        .unwrap_or_else(|| path.to_owned())
}
