//! Signs of life between a process and whoever watches it: systemd's protocol (sd_notify), so that the same program runs under
//! `caudata-robot run` and under systemd.
//!
//! A datagram holds lines `KEY=value`. Ours: `READY=1` (the work has begun), `WATCHDOG=1` (it still goes on), `STOPPING=1` (it is
//! over, what follows is tidying up), and two that systemd ignores: `X_KILL=1` (the kill button was pressed) and `X_BRAKES=1` (the
//! loop brakes, or has let go).

use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;

/// Environment variable with the socket of whoever watches.
pub const SOCKET_VAR: &str = "NOTIFY_SOCKET";
/// The work has begun.
pub const READY: &str = "READY=1";
/// The work goes on.
pub const ALIVE: &str = "WATCHDOG=1";
/// The work is over.
pub const STOPPING: &str = "STOPPING=1";
/// The kill button was pressed.
pub const KILL: &str = "X_KILL=1";
/// The loop brakes, or has let go.
pub const BRAKES: &str = "X_BRAKES=1";
/// Datagrams looked at in one go: a child that floods must not hold its supervisor.
const AT_ONCE: usize = 64;

/// Speaks to whoever watches this process, if anybody does. Never waits.
#[derive(Debug, Default)]
pub struct Notifier(Option<UnixDatagram>);

impl Notifier {
    /// By [`SOCKET_VAR`].
    pub fn from_environment() -> Self {
        let Some(name) = std::env::var_os(SOCKET_VAR) else {
            return Self::default();
        };
        Self::to(&name.to_string_lossy()).unwrap_or_else(|error| {
            tracing::warn!(%error, "cannot speak to the supervisor");
            Self::default()
        })
    }

    /// To the socket `name`; `@name` is an abstract one, as systemd writes it.
    fn to(name: &str) -> io::Result<Self> {
        let address = match name.strip_prefix('@') {
            Some(name) => SocketAddr::from_abstract_name(name)?,
            None => SocketAddr::from_pathname(name)?,
        };
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        socket.connect_addr(&address)?;
        Ok(Self(Some(socket)))
    }

    /// Says `line`. A supervisor that is gone or busy misses it.
    pub fn say(&self, line: &str) {
        if let Some(socket) = &self.0 {
            let _ = socket.send(line.as_bytes());
        }
    }
}

/// What a child has said since it was last listened to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// Anything at all.
    pub alive: bool,
    /// [`READY`].
    pub ready: bool,
    /// [`STOPPING`].
    pub stopping: bool,
    /// [`KILL`].
    pub kill: bool,
    /// [`BRAKES`].
    pub brakes: bool,
}

/// The supervisor's ear for one child.
#[derive(Debug)]
pub struct Ear(UnixDatagram);

impl Ear {
    /// Listens under `path`; what was there is replaced.
    ///
    /// # Errors
    /// What the system says.
    pub fn open(path: &Path) -> io::Result<Self> {
        bind(path).map(Self)
    }

    /// Takes what has come. Never waits.
    pub fn listen(&self) -> Heard {
        let mut heard = Heard::default();
        let mut buffer = [0; 256];
        for _ in 0..AT_ONCE {
            let Ok(length) = self.0.recv(&mut buffer) else {
                break;
            };
            let text = String::from_utf8_lossy(&buffer[..length]);
            for line in text.lines() {
                heard.alive |= line == ALIVE || line == READY;
                heard.ready |= line == READY;
                heard.stopping |= line == STOPPING;
                heard.kill |= line == KILL;
                heard.brakes |= line == BRAKES;
            }
        }
        heard
    }
}

/// A datagram socket under a name in the file system that does not wait.
pub(crate) fn bind(path: &Path) -> io::Result<UnixDatagram> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let socket = UnixDatagram::bind(path)?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_arrive_and_a_missing_supervisor_holds_nobody_up() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ear");
        let ear = Ear::open(&path).unwrap();
        assert_eq!(ear.listen(), Heard::default());
        let notifier = Notifier::to(&path.display().to_string()).unwrap();
        notifier.say(READY);
        notifier.say("STATUS=walking\nX_KILL=1\n");
        let heard = ear.listen();
        assert!(heard.ready && heard.alive && heard.kill && !heard.brakes);
        assert!(!ear.listen().alive, "each word is heard once");
        // A flood fills the socket's queue; the speaker does not wait for it to be read.
        for _ in 0..10_000 {
            notifier.say(ALIVE);
        }
        drop(ear);
        notifier.say(ALIVE);
        Notifier::default().say(ALIVE);
    }
}
