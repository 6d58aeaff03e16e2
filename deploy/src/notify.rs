//! Signs of life between a process and whoever watches it: systemd's protocol (sd_notify), so that the same
//! program runs under `caudata-robot run` and under systemd.
//!
//! A datagram holds lines `KEY=value`. Ours: `READY=1` (the work has begun), `WATCHDOG=1` (it still goes on),
//! `STOPPING=1` (it is over, what follows is tidying up), and two that systemd ignores: `X_KILL=1` (the kill
//! button was pressed) and `X_BRAKES=1` (the loop brakes, or has let go). All but the sign of life are
//! states, not events: each datagram repeats those that were ever said, so that one that found no room is
//! made good by the next.

use std::ffi::OsString;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::path::Path;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use crate::DeployError;

/// Environment variable with the socket of whoever watches.
pub const SOCKET_VAR: &str = "NOTIFY_SOCKET";
/// How long the last word of a process waits for room: a watcher that gets no processor for seconds has a
/// queue of ten datagrams, all full.
const LAST_WORD_MAX: Duration = Duration::from_secs(5);
/// How often it is tried.
const LAST_WORD_EVERY: Duration = Duration::from_millis(5);

/// What can be said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Word {
    /// The work goes on.
    Alive,
    /// The work has begun.
    Ready,
    /// The work is over.
    Stopping,
    /// The kill button was pressed.
    Kill,
    /// The loop brakes, or has let go.
    Brakes,
}

impl Word {
    /// Those that stay true once they are.
    const STATES: [Self; 4] = [Self::Ready, Self::Stopping, Self::Kill, Self::Brakes];

    const fn line(self) -> &'static str {
        match self {
            Self::Alive => "WATCHDOG=1\n",
            Self::Ready => "READY=1\n",
            Self::Stopping => "STOPPING=1\n",
            Self::Kill => "X_KILL=1\n",
            Self::Brakes => "X_BRAKES=1\n",
        }
    }

    const fn bit(self) -> u8 {
        1 << self as u8
    }
}

/// Room for every line at once.
const WORD_BYTES_MAX: usize = 96;
/// Datagrams looked at in one go: a child that floods must not hold its supervisor.
const WORDS_AT_ONCE: usize = 64;

/// Speaks to whoever watches this process, if anybody does. Never waits, but for its last word.
#[derive(Debug, Default)]
pub struct Notifier {
    socket: Option<UnixDatagram>,
    /// Bits of the states that were said.
    said: AtomicU8,
}

impl Notifier {
    /// By [`SOCKET_VAR`]; mute where nobody asked to be told.
    ///
    /// # Errors
    /// Where the socket cannot be reached: a loop that cannot say that it has taken hold of the servos would
    /// be taken for one that has not.
    pub fn from_environment() -> Result<Self, DeployError> {
        Self::named(std::env::var_os(SOCKET_VAR))
    }

    fn named(name: Option<OsString>) -> Result<Self, DeployError> {
        let Some(name) = name else { return Ok(Self::default()) };
        Self::to(&name.to_string_lossy())
            .map_err(DeployError::system("a word to the supervisor (NOTIFY_SOCKET)"))
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
        Ok(Self { socket: Some(socket), said: AtomicU8::new(0) })
    }

    /// Says `word`, and every state of before once more. A watcher that is gone or busy misses the datagram,
    /// not the state. Allocates nothing.
    pub fn say(&self, word: Word) {
        let _ = self.send(word);
    }

    /// Says `word` until there is room for it, at most for five seconds: nothing is said after it that would
    /// repeat it. Whether it was taken.
    pub fn say_last(&self, word: Word) -> bool {
        let begun = Instant::now();
        loop {
            match self.send(word) {
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                taken => return taken.is_ok(),
            }
            if begun.elapsed() > LAST_WORD_MAX {
                return false;
            }
            std::thread::sleep(LAST_WORD_EVERY);
        }
    }

    fn send(&self, word: Word) -> io::Result<()> {
        let Some(socket) = &self.socket else { return Ok(()) };
        if word != Word::Alive {
            self.said.fetch_or(word.bit(), Ordering::Relaxed);
        }
        let said = self.said.load(Ordering::Relaxed);
        let states = Word::STATES.iter().filter(|w| said & w.bit() != 0);
        // Whoever begins lives: a watcher that heard of the beginning alone would take it for silent since
        // its start.
        let lives = matches!(word, Word::Alive | Word::Ready);
        let first = lives.then_some(&Word::Alive);
        let (mut text, mut length) = ([0; WORD_BYTES_MAX], 0);
        for line in first.into_iter().chain(states).map(|w| w.line().as_bytes()) {
            text[length..length + line.len()].copy_from_slice(line);
            length += line.len();
        }
        socket.send(&text[..length]).map(drop)
    }
}

/// What a child has said since it was last listened to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// [`Word::Alive`]. States, which are repeated, are no sign of life.
    pub alive: bool,
    /// [`Word::Ready`].
    pub ready: bool,
    /// [`Word::Stopping`].
    pub stopping: bool,
    /// [`Word::Kill`].
    pub kill: bool,
    /// [`Word::Brakes`].
    pub brakes: bool,
}

/// The supervisor's ear for one child.
#[derive(Debug)]
pub struct Ear(UnixDatagram);

impl Ear {
    /// Listens under `path`; what was there is replaced.
    pub fn open(path: &Path) -> io::Result<Self> {
        bind(path).map(Self)
    }

    /// Takes what has come. Never waits.
    pub fn listen(&self) -> Heard {
        let mut heard = Heard::default();
        let mut buffer = [0; 256];
        for _ in 0..WORDS_AT_ONCE {
            let Ok(length) = self.0.recv(&mut buffer) else { break };
            let text = String::from_utf8_lossy(&buffer[..length]);
            for line in text.lines() {
                let is = |word: Word| line == word.line().trim_end();
                heard.alive |= is(Word::Alive);
                heard.ready |= is(Word::Ready);
                heard.stopping |= is(Word::Stopping);
                heard.kill |= is(Word::Kill);
                heard.brakes |= is(Word::Brakes);
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

    fn pair() -> (tempfile::TempDir, Ear, Notifier) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ear");
        let ear = Ear::open(&path).unwrap();
        let notifier = Notifier::to(&path.display().to_string()).unwrap();
        (folder, ear, notifier)
    }

    #[test]
    fn a_supervisor_that_cannot_be_reached_is_an_error_and_none_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let nobody = folder.path().join("nobody");
        let error = Notifier::named(Some(nobody.into_os_string())).unwrap_err();
        assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::OsResource);
        assert!(error.to_string().contains("NOTIFY_SOCKET"), "{error}");
        Notifier::named(None).unwrap().say(Word::Ready);
    }

    #[test]
    fn words_arrive_and_a_missing_supervisor_holds_nobody_up() {
        let (folder, ear, notifier) = pair();
        assert_eq!(ear.listen(), Heard::default());
        notifier.say(Word::Ready);
        notifier.say(Word::Kill);
        let heard = ear.listen();
        assert!(heard.alive && heard.ready && heard.kill && !heard.brakes);
        assert_eq!(ear.listen(), Heard::default(), "each datagram is heard once");
        notifier.say(Word::Brakes);
        let heard = ear.listen();
        assert!(heard.ready && heard.kill && heard.brakes);
        assert!(!heard.alive, "a state is no sign of life");
        // What systemd or another program may add harms nobody.
        let other = UnixDatagram::unbound().unwrap();
        other.send_to(b"STATUS=walking\nWATCHDOG=1", folder.path().join("ear")).unwrap();
        assert!(ear.listen().alive);
        // A flood fills the socket's queue; the speaker does not wait for it to be read.
        for _ in 0..10_000 {
            notifier.say(Word::Alive);
        }
        drop(ear);
        notifier.say(Word::Alive);
        assert!(!notifier.say_last(Word::Stopping), "nobody is there");
        Notifier::default().say(Word::Alive);
        assert!(Notifier::default().say_last(Word::Stopping));
    }

    #[test]
    fn what_found_no_room_is_said_again_and_the_last_word_waits_for_it() {
        let (_folder, ear, notifier) = pair();
        let full = |notifier: &Notifier| (0..10_000).for_each(|_| notifier.say(Word::Alive));
        full(&notifier);
        // Both find the queue full.
        notifier.say(Word::Ready);
        notifier.say(Word::Brakes);
        while ear.listen() != Heard::default() {}
        notifier.say(Word::Alive);
        let heard = ear.listen();
        assert!(heard.alive && heard.ready && heard.brakes && !heard.stopping);
        // A supervisor that gets no processor for a while.
        full(&notifier);
        let reader = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(50));
            let mut stopping = false;
            loop {
                match ear.listen() {
                    heard if heard == Heard::default() => return (ear, stopping),
                    heard => stopping |= heard.stopping,
                }
            }
        });
        assert!(notifier.say_last(Word::Stopping));
        let (ear, heard) = reader.join().unwrap();
        assert!(heard || ear.listen().stopping);
    }
}
