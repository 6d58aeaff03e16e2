//! How many files and connections a process may have open.

use nix::sys::resource::{Resource, getrlimit, setrlimit};

/// More are not asked for, whatever the system would give.
const FILES_MAX: u64 = 1 << 16;

/// Raises the soft limit of open files to the hard one, and answers what it then is. Systems begin processes
/// with about a thousand for programs that cannot deal with more; connections alone can be twice as many
/// here.
pub fn raise_file_limit() -> u64 {
    let Ok((soft, hard)) = getrlimit(Resource::RLIMIT_NOFILE) else { return 1024 };
    let wanted = hard.min(FILES_MAX).max(soft);
    match setrlimit(Resource::RLIMIT_NOFILE, wanted, hard) {
        Ok(()) => wanted,
        Err(error) => {
            tracing::warn!(%error, soft, wanted, "the limit of open files stays as it is");
            soft
        }
    }
}
