//! A child process must not outlive the supervisor that started it.

use crate::stop::StopFlag;

/// Environment variable in which a supervisor tells a child its own process id.
pub const PARENT_PID_VAR: &str = "CAUDATA_PARENT_PID";

/// When [`PARENT_PID_VAR`] is set, this process is sent SIGTERM as soon as its parent ends, however it
/// ends (`kill -9` included), and therefore drains like on Ctrl-C.
///
/// Linux does it (`PR_SET_PDEATHSIG`); the signal belongs to the *thread* that started the child, so a
/// supervisor starts children from its main thread. A parent that died before this call is noticed
/// by its process id. On other systems only the latter check is made.
pub fn die_with_parent(stop: &StopFlag) {
    let Ok(expected) = std::env::var(PARENT_PID_VAR) else { return };
    #[cfg(target_os = "linux")]
    if let Err(error) = nix::sys::prctl::set_pdeathsig(nix::sys::signal::Signal::SIGTERM) {
        tracing::warn!(%error, "cannot tie this process to its parent's life");
    }
    if nix::unistd::getppid().to_string() != expected {
        stop.request("the parent process is gone");
    }
}
