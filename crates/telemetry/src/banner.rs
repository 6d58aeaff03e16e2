//! Who is speaking: name, version, commit, process id.

use std::fmt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// What this executable is, as far as it knows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BuildInfo {
    /// Version of the workspace.
    pub version: &'static str,
    /// Where the code stands.
    pub code: Code,
}

/// Which commit, and how it is known.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Code {
    /// Commit that the executable was compiled from.
    BuiltFrom(String),
    /// The executable lies in a checkout, and this is what is checked out *now*: it may have been compiled
    /// before.
    CheckedOut(String),
    /// Neither.
    Unknown,
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BuiltFrom(commit) => write!(f, "built from {commit}"),
            Self::CheckedOut(commit) => write!(f, "checkout at {commit}"),
            Self::Unknown => write!(f, "commit unknown"),
        }
    }
}

/// Version and commit of this executable.
///
/// A packaged build sets `CAUDATA_GIT_COMMIT` when it compiles. Without it, an executable that lies inside a
/// checkout (`target/release/…`) can only say what is checked out there: baking the commit in would rebuild
/// every crate at every commit.
pub fn build_info() -> &'static BuildInfo {
    static INFO: OnceLock<BuildInfo> = OnceLock::new();
    INFO.get_or_init(|| {
        let built_from = option_env!("CAUDATA_GIT_COMMIT").filter(|commit| !commit.is_empty());
        let code = match built_from {
            Some(commit) => Code::BuiltFrom(commit.to_owned()),
            None => std::env::current_exe()
                .ok()
                .and_then(|exe| checkout_commit(&exe))
                .map_or(Code::Unknown, Code::CheckedOut),
        };
        BuildInfo { version: env!("CARGO_PKG_VERSION"), code }
    })
}

impl BuildInfo {
    /// The commit in one word, for files that name what trained a policy: of a packaged build the commit it
    /// was compiled from, else what is checked out, with `-dirty` where files differ from it and `-unchecked`
    /// where git cannot be asked. Empty where nothing is known.
    pub fn commit_word(&self) -> String {
        match &self.code {
            Code::BuiltFrom(commit) => commit.clone(),
            Code::CheckedOut(commit) => {
                let folder = std::env::current_exe().ok();
                let folder = folder.as_deref().and_then(Path::parent);
                let suffix = match folder.and_then(is_dirty) {
                    Some(true) => "-dirty",
                    Some(false) => "",
                    None => "-unchecked",
                };
                format!("{commit}{suffix}")
            }
            Code::Unknown => String::new(),
        }
    }
}

/// Whether tracked files around `folder` differ from the commit.
fn is_dirty(folder: &Path) -> Option<bool> {
    let output = Command::new("git")
        .arg("-C")
        .arg(folder)
        .args(["status", "--porcelain", "--untracked-files=no"])
        .output()
        .ok()?;
    output.status.success().then_some(!output.stdout.is_empty())
}

/// Says who is speaking, as the first line of the log.
pub(crate) fn log_banner(process_name: &str) {
    let info = build_info();
    tracing::info!(
        version = info.version,
        code = %info.code,
        pid = std::process::id(),
        "{process_name} starts"
    );
}

/// The commit checked out in the repository around `path`.
fn checkout_commit(path: &Path) -> Option<String> {
    let git = path.ancestors().map(|dir| dir.join(".git")).find(|git| git.exists())?;
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
    fn what_is_checked_out_is_not_said_to_be_what_was_built() {
        let now = Code::CheckedOut("abc".into());
        assert_eq!(now.to_string(), "checkout at abc");
        let built = BuildInfo { version: "1", code: Code::BuiltFrom("abc".into()) };
        assert_eq!(
            (built.code.to_string().as_str(), built.commit_word().as_str()),
            ("built from abc", "abc")
        );
    }

    #[test]
    fn changed_files_are_told_from_committed_ones() {
        let dir = std::env::temp_dir().join(format!("caudata-dirty-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let git = |arguments: &[&str]| {
            let mut command = Command::new("git");
            command.arg("-C").arg(&dir).args(arguments);
            assert!(command.output().unwrap().status.success(), "{arguments:?}");
        };
        git(&["init", "-q"]);
        std::fs::write(dir.join("a"), "1").unwrap();
        git(&["add", "a"]);
        let who = ["-c", "user.name=t", "-c", "user.email=t@t"];
        git(&[&who[..], &["commit", "-q", "-m", "a"]].concat());
        assert_eq!(is_dirty(&dir), Some(false));
        std::fs::write(dir.join("a"), "2").unwrap();
        assert_eq!(is_dirty(&dir), Some(true));
        std::fs::remove_dir_all(&dir).unwrap();
        assert_eq!(is_dirty(&dir), None);
    }

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
