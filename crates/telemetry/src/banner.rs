//! Who is speaking: name, version, commit, process id.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// What this executable was made from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BuildInfo {
    /// Version of the workspace.
    pub version: &'static str,
    /// Commit (40 hex digits), or `unknown`.
    pub commit: String,
}

/// Version and commit of this executable.
///
/// A packaged build sets `CAUDATA_GIT_COMMIT` when it compiles. Without it, an executable that lies inside
/// a checkout (`target/release/…`) reports the commit that is checked out *now*: baking the commit in would
/// rebuild every crate at every commit. Outside both, the commit is `unknown`.
pub fn build_info() -> &'static BuildInfo {
    static INFO: OnceLock<BuildInfo> = OnceLock::new();
    INFO.get_or_init(|| BuildInfo {
        version: env!("CARGO_PKG_VERSION"),
        commit: option_env!("CAUDATA_GIT_COMMIT")
            .filter(|commit| !commit.is_empty())
            .map(str::to_owned)
            .or_else(|| checkout_commit(&std::env::current_exe().ok()?))
            .unwrap_or_else(|| "unknown".to_owned()),
    })
}

/// Says who is speaking, as the first line of the log.
pub(crate) fn log_banner(process_name: &str) {
    let info = build_info();
    tracing::info!(
        version = info.version,
        commit = info.commit,
        pid = std::process::id(),
        "{process_name} starts"
    );
}

/// The commit checked out in the repository around `path`.
fn checkout_commit(path: &Path) -> Option<String> {
    let git = path
        .ancestors()
        .map(|dir| dir.join(".git"))
        .find(|git| git.exists())?;
    let git = resolve_git_dir(git)?;
    let head = std::fs::read_to_string(git.join("HEAD")).ok()?;
    let head = head.trim();
    match head.strip_prefix("ref: ") {
        None => Some(head.to_owned()),
        Some(reference) => read_reference(&git, reference),
    }
}

/// In a linked work tree `.git` is a file that names the directory.
fn resolve_git_dir(git: PathBuf) -> Option<PathBuf> {
    if git.is_dir() {
        return Some(git);
    }
    let text = std::fs::read_to_string(&git).ok()?;
    let named = text.trim().strip_prefix("gitdir: ")?;
    Some(git.parent()?.join(named))
}

fn read_reference(git: &Path, reference: &str) -> Option<String> {
    let common = std::fs::read_to_string(git.join("commondir"))
        .map_or_else(|_| git.to_owned(), |dir| git.join(dir.trim()));
    if let Ok(commit) = std::fs::read_to_string(common.join(reference)) {
        return Some(commit.trim().to_owned());
    }
    let packed = std::fs::read_to_string(common.join("packed-refs")).ok()?;
    packed.lines().find_map(|line| {
        let (commit, name) = line.split_once(' ')?;
        (name == reference).then(|| commit.to_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_a_loose_and_a_packed_reference() {
        let dir = std::env::temp_dir().join(format!("caudata-banner-{}", std::process::id()));
        let git = dir.join(".git");
        std::fs::create_dir_all(git.join("refs/heads")).unwrap();
        std::fs::write(git.join("HEAD"), "ref: refs/heads/main\n").unwrap();
        std::fs::write(git.join("packed-refs"), "# pack\nabc refs/heads/main\n").unwrap();
        let exe = dir.join("target/release/caudata");
        assert_eq!(checkout_commit(&exe).as_deref(), Some("abc"));
        std::fs::write(git.join("refs/heads/main"), "def\n").unwrap();
        assert_eq!(checkout_commit(&exe).as_deref(), Some("def"));
        std::fs::remove_dir_all(&dir).unwrap();
    }
}
