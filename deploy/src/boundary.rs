//! What passes between the two processes of a robot: the agent (network, keeping, trying) and the loop.
//!
//! ```text
//! agent ── staged.json (which policy runs next) ──▶ loop     <run folder>, replaced as a whole
//! agent ── loop.sock (velocity commands, kill) ───▶ loop     one datagram every 20 ms, newest wins
//! agent ◀── told/<number>.json (what became of it) ─ loop    <state folder>, on the disk before it counts
//! ```
//!
//! Files under names that stay, and one socket: either end may die and come back, and neither ever waits for the other while the
//! robot moves. A policy's bytes are read by the loop's process itself from the store, and checked again there.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_durable as durable;
use caudata_task::COMMAND_DIM;
use serde::{Deserialize, Serialize};

use crate::DeployError;
use crate::command_link::{CommandLink, LinkView};
use crate::notify;
use crate::state::PolicyRef;
use crate::updates::PolicyEvent;

/// `format` of `staged.json`.
pub const STAGED_FORMAT: &str = "caudata.staged.v1";
/// Stream that the policy which came with the program counts as; no stream of a server can have this name.
pub const FACTORY: &str = "(factory)";
/// Events that wait for an agent; with more, the newest is lost with a line in the log.
pub const TOLD_MAX: usize = 256;
/// Largest file of the boundary, bytes.
const FILE_MAX: u64 = 64 << 10;
/// Length of a command datagram: kill, age (µs), three numbers.
const COMMAND_BYTES: usize = 1 + 8 + 4 * COMMAND_DIM;
/// Age of a command that never came, µs.
const NEVER_US: u64 = u64::MAX;
/// Datagrams looked at in one tick.
const AT_ONCE: usize = 16;

/// The folder of sockets and of `staged.json`, for this user only. Nothing in it outlives a restart of the computer.
#[derive(Clone, Debug)]
pub struct RunFolder(PathBuf);

impl RunFolder {
    /// Makes the folder where it is absent.
    ///
    /// # Errors
    /// [`DeployError::Folder`].
    pub fn open(path: &Path) -> Result<Self, DeployError> {
        let made = fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(path);
        made.map_err(|source| DeployError::Folder {
            path: path.to_owned(),
            source,
        })?;
        Ok(Self(path.to_owned()))
    }

    /// A file in it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    fn staged(&self) -> PathBuf {
        self.file("staged.json")
    }

    fn commands(&self) -> PathBuf {
        self.file("loop.sock")
    }

    /// Whether a loop is there to hear.
    pub fn has_loop(&self) -> bool {
        let socket = UnixDatagram::unbound();
        socket.is_ok_and(|socket| socket.connect(self.commands()).is_ok())
    }
}

/// Keeps a second process of the same kind out as long as it lives; the system lets go of it however the process ends.
///
/// # Errors
/// [`DeployError::Folder`], also where another one is there.
pub fn alone(lock: PathBuf) -> Result<File, DeployError> {
    let refused = |source| DeployError::Folder {
        path: lock.clone(),
        source,
    };
    let file = File::create(&lock).map_err(refused)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => Err(refused(io::Error::new(
            io::ErrorKind::AddrInUse,
            "another process of this robot is running",
        ))),
        Err(fs::TryLockError::Error(source)) => Err(refused(source)),
    }
}

/// What the loop is to run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Staged {
    /// [`STAGED_FORMAT`].
    pub format: String,
    /// Grows with every policy that is staged.
    pub number: u64,
    /// Which start of the loop it is for ([`PolicyEvent::Ready`]).
    pub run: u64,
    /// Which policy; of stream [`FACTORY`]: the file that both processes were started with.
    pub policy: PolicyRef,
    /// Whether it went through its trial on this robot before.
    pub proved: bool,
}

impl Staged {
    /// What is staged; `None` where there is nothing that can be understood.
    pub fn read(folder: &RunFolder) -> Option<Self> {
        let text = small_file(&folder.staged())?;
        let staged: Self = serde_json::from_slice(&text).ok()?;
        (staged.format == STAGED_FORMAT).then_some(staged)
    }

    /// Stages it, as a whole.
    ///
    /// # Errors
    /// [`DeployError::Durable`].
    pub fn write(&self, folder: &RunFolder) -> Result<(), DeployError> {
        Ok(durable::replace(&folder.staged(), &json(self)?)?)
    }

    /// Forgets what was staged for another start.
    pub fn clear(folder: &RunFolder) {
        let _ = fs::remove_file(folder.staged());
    }
}

/// The loop's end of `told/`.
#[derive(Debug)]
pub struct Teller {
    folder: PathBuf,
    next: u64,
}

impl Teller {
    /// Goes on after what waits there already.
    ///
    /// # Errors
    /// [`DeployError::Folder`].
    pub fn open(state: &Path) -> Result<Self, DeployError> {
        let folder = told(state);
        fs::create_dir_all(&folder).map_err(|source| DeployError::Folder {
            path: folder.clone(),
            source,
        })?;
        durable::remove_leftovers(&folder)?;
        let last = waiting(&folder).last().map_or(0, |(number, _)| *number);
        Ok(Self {
            folder,
            next: last + 1,
        })
    }

    /// Writes an event down; it is on the disk when this returns.
    ///
    /// # Errors
    /// [`DeployError::Durable`]; [`DeployError::Internal`] where [`TOLD_MAX`] wait already.
    pub fn tell(&mut self, event: &PolicyEvent) -> Result<(), DeployError> {
        if waiting(&self.folder).len() >= TOLD_MAX {
            return Err(DeployError::Internal {
                what: format!("{TOLD_MAX} events wait for an agent"),
            });
        }
        let path = self.folder.join(format!("{:020}.json", self.next));
        durable::replace(&path, &json(event)?)?;
        self.next += 1;
        Ok(())
    }
}

/// Takes what the loop told, oldest first: each event goes to `note` and is then forgotten. What cannot be understood is put aside.
/// Answers how many there were.
pub fn take_told(state: &Path, mut note: impl FnMut(PolicyEvent)) -> usize {
    let all = waiting(&told(state));
    for (_, path) in &all {
        let event = small_file(path).and_then(|text| serde_json::from_slice(&text).ok());
        match event {
            Some(event) => {
                note(event);
                let _ = fs::remove_file(path);
            }
            None => {
                tracing::error!(path = %path.display(), "what the loop told cannot be understood");
                let _ = fs::rename(path, path.with_extension("damaged"));
            }
        }
    }
    all.len()
}

fn told(state: &Path) -> PathBuf {
    state.join("told")
}

/// Number and path of what waits in `folder`, oldest first.
fn waiting(folder: &Path) -> Vec<(u64, PathBuf)> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let numbered = |path: PathBuf| {
        let name = path.file_name()?.to_str()?.strip_suffix(".json")?;
        Some((name.parse().ok()?, path))
    };
    let mut all: Vec<(u64, PathBuf)> = entries.filter_map(|e| numbered(e.path())).collect();
    all.sort();
    all
}

fn small_file(path: &Path) -> Option<Vec<u8>> {
    let small = fs::metadata(path).is_ok_and(|m| m.len() <= FILE_MAX);
    small.then(|| fs::read(path).ok()).flatten()
}

fn json(value: &impl Serialize) -> Result<Vec<u8>, DeployError> {
    serde_json::to_vec_pretty(value).map_err(|e| DeployError::Internal {
        what: e.to_string(),
    })
}

/// The agent's end of the commands.
#[derive(Debug)]
pub struct CommandSender {
    socket: UnixDatagram,
    to: PathBuf,
}

impl CommandSender {
    /// To the loop of `folder`, whether or not it is there yet.
    ///
    /// # Errors
    /// [`DeployError::System`].
    pub fn new(folder: &RunFolder) -> Result<Self, DeployError> {
        let opened = UnixDatagram::unbound().and_then(|socket| {
            socket.set_nonblocking(true)?;
            Ok(socket)
        });
        let socket = opened.map_err(|source| DeployError::System {
            what: "a socket",
            source,
        })?;
        Ok(Self {
            socket,
            to: folder.commands(),
        })
    }

    /// Passes on what the link shows now. A loop that is not there misses it; the next one comes in 20 ms.
    pub fn send(&self, view: &LinkView) {
        let _ = self.socket.send_to(&encode(view), &self.to);
    }
}

/// The loop's end: a socket that is looked at, never waited for.
#[derive(Debug)]
pub struct LocalLink {
    socket: UnixDatagram,
    newest: LinkView,
    came: Instant,
}

impl LocalLink {
    /// Listens in `folder`. Also without a link this shows that a loop is there.
    ///
    /// # Errors
    /// [`DeployError::Folder`].
    pub fn open(folder: &RunFolder) -> Result<Self, DeployError> {
        let path = folder.commands();
        let socket = notify::bind(&path).map_err(|source| DeployError::Folder { path, source })?;
        Ok(Self {
            socket,
            newest: LinkView {
                command: [0.0; COMMAND_DIM],
                age: Duration::MAX,
                killed: false,
            },
            came: Instant::now(),
        })
    }
}

impl CommandLink for LocalLink {
    fn view(&mut self) -> LinkView {
        let mut buffer = [0; COMMAND_BYTES + 1];
        for _ in 0..AT_ONCE {
            let Ok(length) = self.socket.recv(&mut buffer) else {
                break;
            };
            if let Some(view) = decode(&buffer[..length]) {
                // A kill stays in force, also where the agent that heard it is gone.
                let killed = view.killed || self.newest.killed;
                self.newest = LinkView { killed, ..view };
                self.came = Instant::now();
            }
        }
        LinkView {
            age: self.newest.age.saturating_add(self.came.elapsed()),
            ..self.newest
        }
    }
}

fn encode(view: &LinkView) -> [u8; COMMAND_BYTES] {
    let mut out = [0; COMMAND_BYTES];
    let age_us = u64::try_from(view.age.as_micros()).unwrap_or(NEVER_US);
    out[0] = u8::from(view.killed);
    out[1..9].copy_from_slice(&age_us.to_le_bytes());
    for (place, value) in out[9..].chunks_exact_mut(4).zip(view.command) {
        place.copy_from_slice(&value.to_le_bytes());
    }
    out
}

fn decode(bytes: &[u8]) -> Option<LinkView> {
    let bytes: &[u8; COMMAND_BYTES] = bytes.try_into().ok()?;
    let mut command = [0.0; COMMAND_DIM];
    for (value, place) in command.iter_mut().zip(bytes[9..].chunks_exact(4)) {
        *value = f32::from_le_bytes(place.try_into().ok()?);
    }
    let age_us = u64::from_le_bytes(bytes[1..9].try_into().ok()?);
    let sane = bytes[0] <= 1 && command.iter().all(|v| v.is_finite());
    sane.then_some(LinkView {
        command,
        age: Duration::from_micros(age_us),
        killed: bytes[0] == 1,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::state::Sha256Digest;

    fn policy(version: u64) -> PolicyRef {
        PolicyRef {
            stream: "s".to_owned(),
            version,
            sha256: Sha256Digest([1; 32]),
            reverts_to: None,
        }
    }

    #[test]
    fn what_is_told_arrives_once_in_order_and_over_restarts_of_either_end() {
        let folder = tempfile::tempdir().unwrap();
        let state = folder.path();
        let mut teller = Teller::open(state).unwrap();
        teller.tell(&PolicyEvent::Begun(policy(1))).unwrap();
        let good = PolicyEvent::Good {
            policy: policy(1),
            walked_s: 10.0,
        };
        teller.tell(&good).unwrap();
        // The loop died and came back; one event was torn on its way.
        let mut teller = Teller::open(state).unwrap();
        teller.tell(&PolicyEvent::Ended(policy(1))).unwrap();
        fs::write(told(state).join("00000000000000000009.json"), "{").unwrap();
        let mut words = Vec::new();
        let count = take_told(state, |event| words.push(event));
        assert_eq!((count, words.len()), (4, 3));
        assert!(matches!(&words[0], PolicyEvent::Begun(p) if p.version == 1));
        assert!(matches!(&words[1], PolicyEvent::Good { walked_s, .. } if *walked_s == 10.0));
        assert!(matches!(&words[2], PolicyEvent::Ended(_)));
        assert_eq!(take_told(state, |_| panic!("told twice")), 0);
    }

    #[test]
    fn an_agent_that_never_comes_back_does_not_fill_the_disk() {
        let folder = tempfile::tempdir().unwrap();
        let mut teller = Teller::open(folder.path()).unwrap();
        for _ in 0..TOLD_MAX {
            teller.tell(&PolicyEvent::Begun(policy(1))).unwrap();
        }
        assert!(teller.tell(&PolicyEvent::Begun(policy(1))).is_err());
    }

    #[test]
    fn staged_is_read_back_and_nothing_else_is_taken_for_it() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::open(&folder.path().join("run")).unwrap();
        assert_eq!(Staged::read(&run), None);
        let staged = Staged {
            format: STAGED_FORMAT.to_owned(),
            number: 3,
            run: 7,
            policy: policy(2),
            proved: true,
        };
        staged.write(&run).unwrap();
        assert_eq!(Staged::read(&run), Some(staged.clone()));
        for text in ["", "{", r#"{"format":"x"}"#] {
            fs::write(run.staged(), text).unwrap();
            assert_eq!(Staged::read(&run), None);
        }
        Staged::clear(&run);
        assert_eq!(Staged::read(&run), None);
    }

    #[test]
    fn commands_arrive_age_when_the_agent_is_gone_and_a_kill_stays() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::open(folder.path()).unwrap();
        let sender = CommandSender::new(&run).unwrap();
        let view = |vx, age_ms, killed| LinkView {
            command: [vx, 0.0, -0.1],
            age: Duration::from_millis(age_ms),
            killed,
        };
        // Nobody is there: nothing happens.
        sender.send(&view(0.9, 0, false));
        assert!(!run.has_loop());
        let mut link = LocalLink::open(&run).unwrap();
        assert!(run.has_loop());
        assert_eq!(link.view().age, Duration::MAX, "never heard anything");
        sender.send(&view(0.1, 5, false));
        sender.send(&view(0.2, 5, false));
        let seen = link.view();
        assert_eq!(seen.command, [0.2, 0.0, -0.1], "the newest wins");
        assert!(seen.age >= Duration::from_millis(5));
        let later = link.view();
        assert!(later.age >= seen.age && !later.killed);
        // Nothing but whole, finite datagrams counts.
        for bytes in [&[1_u8][..], &[0xFF; COMMAND_BYTES], &[0; COMMAND_BYTES + 1]] {
            sender.socket.send_to(bytes, &sender.to).unwrap();
            assert_eq!(link.view().command, [0.2, 0.0, -0.1]);
        }
        sender.send(&view(0.0, 0, true));
        sender.send(&view(0.3, 0, false));
        assert!(link.view().killed);
        drop(link);
        sender.send(&view(0.3, 0, false));
        assert!(!run.has_loop());
    }

    #[test]
    fn a_second_process_of_the_same_kind_is_kept_out() {
        let folder = tempfile::tempdir().unwrap();
        let first = alone(folder.path().join("lock")).unwrap();
        assert!(alone(folder.path().join("lock")).is_err());
        drop(first);
        assert!(alone(folder.path().join("lock")).is_ok());
    }
}
