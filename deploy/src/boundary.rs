//! What passes between the two processes of a robot: the agent (network, keeping, trying) and the loop.
//!
//! ```text
//! agent ── staged.json (which policy runs next, or that none can) ──▶ loop     <run folder>, replaced as a whole
//! agent ── loop.sock (velocity commands, kill) ───▶ loop     one datagram every 20 ms, newest wins
//! agent ◀── told/<number>.json (what became of it) ─ loop    <state folder>, on the disk before it counts
//! ```
//!
//! Files under names that stay, and one socket: either end may die and come back, and neither ever waits for
//! the other while the robot moves. A policy's bytes are read by the loop's process itself from the store,
//! and checked again there.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::Duration;

use caudata_durable::{self as durable, Owner, OwnerError};
use caudata_task::COMMAND_DIM;
use nix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use crate::DeployError;
use crate::command_link::{CommandLink, LinkView};
use crate::notify;
use crate::state::PolicyRef;
use crate::updates::PolicyEvent;

/// `format` of `staged.json`.
pub const STAGED_FORMAT: &str = "caudata.staged.v2";
/// Stream that the policy which came with the program counts as; no stream of a server can have this name.
pub const FACTORY: &str = "(factory)";
/// Events that wait for an agent; with more, the newest is lost with a line in the log.
pub const TOLD_MAX: usize = 256;
/// The loop's page of metrics, in the run folder, while there is a loop.
pub const LOOP_PAGE: &str = "loop.prom";
/// Largest file of the boundary, bytes.
const FILE_MAX: u64 = 64 << 10;
/// Length of a command datagram: kill and released, when it came (µs), three numbers.
const COMMAND_BYTES: usize = 1 + 8 + 4 * COMMAND_DIM;
/// Time of a command that never came, µs.
const NEVER_US: u64 = u64::MAX;
/// Bits of its first byte.
const KILLED: u8 = 1;
const RELEASED: u8 = 2;
/// Datagrams looked at in one tick.
const COMMANDS_AT_ONCE: usize = 16;

/// The folder of sockets and of `staged.json`, for this user only. Nothing in it outlives a restart of the
/// computer.
#[derive(Clone, Debug)]
pub struct RunFolder(PathBuf);

impl RunFolder {
    /// Makes the folder where it is absent. Whoever may write in it can command the robot, so that it must be
    /// this user's alone.
    ///
    /// # Errors
    /// [`DeployError::Folder`]; [`DeployError::Exposed`] where others may use it.
    pub fn open(path: &Path) -> Result<Self, DeployError> {
        let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(path);
        let found = made.and_then(|()| fs::metadata(path));
        let found = found.map_err(DeployError::folder(path))?;
        let (mode, owner) = (found.mode() & 0o7777, found.uid());
        let user = nix::unistd::geteuid().as_raw();
        if mode & 0o077 != 0 || owner != user {
            let path = path.to_owned();
            return Err(DeployError::Exposed { path, mode, owner });
        }
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

/// Keeps a second process of the same kind out as long as it lives; the system lets go of it however the
/// process ends.
///
/// # Errors
/// [`DeployError::Folder`], also where another one is there.
pub fn alone(lock: &Path) -> Result<Owner, DeployError> {
    Owner::now(lock).map_err(not_alone)
}

/// The same by a folder that is there: it takes no file, and so works on a disk that takes none.
///
/// # Errors
/// As [`alone`].
pub fn alone_in(folder: &Path) -> Result<Owner, DeployError> {
    let path = folder.to_owned();
    let opened = File::open(folder).map_err(DeployError::folder(path))?;
    Owner::of(opened, folder).map_err(not_alone)
}

fn not_alone(error: OwnerError) -> DeployError {
    let (path, source) = match error {
        OwnerError::Io { path, source } => (path, source),
        OwnerError::Taken { path, .. } => {
            let running = "another process of this robot is running";
            (path, io::Error::new(io::ErrorKind::AddrInUse, running))
        }
    };
    DeployError::Folder { path, source }
}

/// What the loop is told to run.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Staged {
    /// [`STAGED_FORMAT`].
    pub format: String,
    /// Grows with every answer.
    pub number: u64,
    /// Which start of the loop it is for ([`PolicyEvent::Ready`]).
    pub run: u64,
    /// The answer.
    pub answer: Answer,
}

/// What the agent answers a loop that asks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Answer {
    /// Run this.
    Policy {
        /// Which; of stream [`FACTORY`]: the file that both processes were started with.
        policy: PolicyRef,
        /// Whether it went through its trial on this robot before.
        proved: bool,
    },
    /// There is nothing that may run here. Asking again changes nothing.
    Nothing {
        /// Why, in one line.
        reason: String,
    },
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

/// The loop's end of `told/`: in the state folder, and in the run folder where the state's disk takes
/// nothing.
#[derive(Debug)]
pub struct Teller {
    places: Vec<Place>,
    /// No second loop on one state.
    _alone: Owner,
}

#[derive(Debug)]
struct Place {
    folder: PathBuf,
    next: u64,
}

impl Place {
    /// Goes on after what waits there already.
    fn open(folder: PathBuf) -> Result<Self, DeployError> {
        fs::create_dir_all(&folder).map_err(DeployError::folder(&folder))?;
        durable::remove_leftovers(&folder)?;
        let last = waiting(&folder).last().map_or(0, |(number, _)| *number);
        Ok(Self { folder, next: last + 1 })
    }

    fn tell(&mut self, text: &[u8]) -> Result<(), DeployError> {
        if waiting(&self.folder).len() >= TOLD_MAX {
            return Err(DeployError::Internal {
                what: format!("{TOLD_MAX} events wait for an agent"),
            });
        }
        let path = self.folder.join(format!("{:020}.json", self.next));
        durable::replace(&path, text)?;
        self.next += 1;
        Ok(())
    }
}

impl Teller {
    /// Goes on after what waits there already.
    ///
    /// # Errors
    /// [`DeployError::Folder`], also where another loop tells in this state folder.
    pub fn open(state: &Path, run: &RunFolder) -> Result<Self, DeployError> {
        let [in_state, in_run] = told(state, run);
        let mut places = Vec::with_capacity(2);
        match Place::open(in_state.clone()) {
            Ok(place) => places.push(place),
            Err(error) => {
                tracing::error!(%error, "the state's disk takes nothing: what is learnt about policies is lost with the power")
            }
        }
        places.push(Place::open(in_run.clone())?);
        let alone = match places.len() {
            2 => alone_in(&in_state)?,
            _ => alone_in(&in_run)?,
        };
        Ok(Self { places, _alone: alone })
    }

    /// Writes an event down; it is on the disk, or where there is none in the run folder, when this returns.
    ///
    /// # Errors
    /// [`DeployError::Durable`]; [`DeployError::Internal`] where [`TOLD_MAX`] wait already.
    pub fn tell(&mut self, event: &PolicyEvent) -> Result<(), DeployError> {
        let text = json(event)?;
        let mut refused = None;
        for place in &mut self.places {
            match place.tell(&text) {
                Ok(()) => return Ok(()),
                Err(error @ DeployError::Internal { .. }) => return Err(error),
                Err(error) => {
                    tracing::error!(%error, "cannot tell here");
                    refused = Some(error);
                }
            }
        }
        refused.map_or(Ok(()), Err)
    }
}

/// The agent's end of `told/`.
#[derive(Debug)]
pub struct Told {
    folders: [PathBuf; 2],
    /// Heard, and not to be removed from a disk that takes nothing.
    stuck: BTreeSet<PathBuf>,
}

impl Told {
    /// Watches the folders of this state and run, whether or not they are there yet.
    pub fn of(state: &Path, run: &RunFolder) -> Self {
        Self { folders: told(state, run), stuck: BTreeSet::new() }
    }

    /// Takes what the loop told, oldest first: each event goes to `note` and is then forgotten. What cannot
    /// be understood is put aside. Answers how many there were.
    pub fn take(&mut self, mut note: impl FnMut(PolicyEvent)) -> usize {
        let all = self.folders.iter().flat_map(|folder| waiting(folder));
        let new: Vec<PathBuf> =
            all.map(|(_, path)| path).filter(|path| !self.stuck.contains(path)).collect();
        for path in &new {
            let event = small_file(path).and_then(|text| serde_json::from_slice(&text).ok());
            let away = match event {
                Some(event) => {
                    note(event);
                    fs::remove_file(path)
                }
                None => {
                    tracing::error!(path = %path.display(), "what the loop told cannot be understood");
                    fs::rename(path, path.with_extension("damaged"))
                }
            };
            // Bounded by the number of files that wait there.
            if away.is_err() && path.exists() {
                self.stuck.insert(path.clone());
            }
        }
        new.len()
    }
}

fn told(state: &Path, run: &RunFolder) -> [PathBuf; 2] {
    [state.join("told"), run.file("told")]
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
    durable::read_at_most(path, FILE_MAX).ok()
}

fn json(value: &impl Serialize) -> Result<Vec<u8>, DeployError> {
    serde_json::to_vec_pretty(value).map_err(|e| DeployError::Internal { what: e.to_string() })
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
        let socket = opened.map_err(DeployError::system("a socket"))?;
        Ok(Self { socket, to: folder.commands() })
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
    /// When the newest command came to this computer, by [`now`]; `None`: none ever did.
    came: Option<Duration>,
}

impl LocalLink {
    /// Listens in `folder`. Also without a link this shows that a loop is there.
    ///
    /// # Errors
    /// [`DeployError::Folder`].
    pub fn open(folder: &RunFolder) -> Result<Self, DeployError> {
        let path = folder.commands();
        let socket = notify::bind(&path).map_err(DeployError::folder(path))?;
        Ok(Self {
            socket,
            newest: LinkView {
                command: [0.0; COMMAND_DIM],
                age: Duration::MAX,
                killed: false,
                released: false,
            },
            came: None,
        })
    }
}

impl CommandLink for LocalLink {
    fn view(&mut self) -> LinkView {
        let mut buffer = [0; COMMAND_BYTES + 1];
        for _ in 0..COMMANDS_AT_ONCE {
            let Ok(length) = self.socket.recv(&mut buffer) else { break };
            if let Some((view, came)) = decode(&buffer[..length]) {
                // A kill stays in force, also where the agent that heard it is gone.
                let killed = view.killed || self.newest.killed;
                self.newest = LinkView { killed, ..view };
                self.came = came;
            }
        }
        // By when it came to this computer, not by when it is read: what has waited here since the loop was
        // down is old.
        let age = |came: Duration| now().saturating_sub(came);
        LinkView { age: self.came.map_or(Duration::MAX, age), ..self.newest }
    }
}

/// Time since this computer was started: the same in all its processes. Looking at it takes no system call.
fn now() -> Duration {
    // This clock cannot be refused on Linux; a time of 0 would make every command look fresh, so that the end
    // of time stands in.
    clock_gettime(ClockId::CLOCK_BOOTTIME).map_or(Duration::MAX, Duration::from)
}

fn encode(view: &LinkView) -> [u8; COMMAND_BYTES] {
    let mut out = [0; COMMAND_BYTES];
    let came = now().checked_sub(view.age);
    let came_us = came.map_or(NEVER_US, |came| u64::try_from(came.as_micros()).unwrap_or(NEVER_US));
    out[0] = KILLED * u8::from(view.killed) + RELEASED * u8::from(view.released);
    out[1..9].copy_from_slice(&came_us.to_le_bytes());
    for (place, value) in out[9..].chunks_exact_mut(4).zip(view.command) {
        place.copy_from_slice(&value.to_le_bytes());
    }
    out
}

/// What the agent saw, and when its command came.
fn decode(bytes: &[u8]) -> Option<(LinkView, Option<Duration>)> {
    let bytes: &[u8; COMMAND_BYTES] = bytes.try_into().ok()?;
    let mut command = [0.0; COMMAND_DIM];
    for (value, place) in command.iter_mut().zip(bytes[9..].chunks_exact(4)) {
        *value = f32::from_le_bytes(place.try_into().ok()?);
    }
    let came_us = u64::from_le_bytes(bytes[1..9].try_into().ok()?);
    let sane = bytes[0] <= (KILLED | RELEASED) && command.iter().all(|v| v.is_finite());
    let view = LinkView {
        command,
        age: Duration::MAX,
        killed: bytes[0] & KILLED != 0,
        released: bytes[0] & RELEASED != 0,
    };
    let came = (came_us != NEVER_US).then(|| Duration::from_micros(came_us));
    sane.then_some((view, came))
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

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

    /// A state folder and a run folder.
    fn folders() -> (tempfile::TempDir, PathBuf, RunFolder) {
        let folder = tempfile::tempdir().unwrap();
        let state = folder.path().join("state");
        let run = RunFolder::open(&folder.path().join("run")).unwrap();
        (folder, state, run)
    }

    #[test]
    fn what_is_told_arrives_once_in_order_and_over_restarts_of_either_end() {
        let (_folder, state, run) = folders();
        let mut teller = Teller::open(&state, &run).unwrap();
        teller.tell(&PolicyEvent::Begun(policy(1))).unwrap();
        let good = PolicyEvent::Good { policy: policy(1), walked_s: 10.0 };
        teller.tell(&good).unwrap();
        drop(teller);
        // The loop died and came back; one event was torn on its way.
        let mut teller = Teller::open(&state, &run).unwrap();
        teller.tell(&PolicyEvent::Ended(policy(1))).unwrap();
        fs::write(state.join("told/00000000000000000009.json"), "{").unwrap();
        let mut words = Vec::new();
        let count = Told::of(&state, &run).take(|event| words.push(event));
        assert_eq!((count, words.len()), (4, 3));
        assert!(matches!(&words[0], PolicyEvent::Begun(p) if p.version == 1));
        assert!(matches!(&words[1], PolicyEvent::Good { walked_s, .. } if *walked_s == 10.0));
        assert!(matches!(&words[2], PolicyEvent::Ended(_)));
        assert_eq!(Told::of(&state, &run).take(|_| panic!("told twice")), 0);
    }

    #[test]
    fn an_agent_that_never_comes_back_does_not_fill_the_disk() {
        let (_folder, state, run) = folders();
        let mut teller = Teller::open(&state, &run).unwrap();
        for _ in 0..TOLD_MAX {
            teller.tell(&PolicyEvent::Begun(policy(1))).unwrap();
        }
        assert!(teller.tell(&PolicyEvent::Begun(policy(1))).is_err());
    }

    #[test]
    fn fault_30_where_the_states_disk_takes_nothing_the_run_folder_does() {
        let (_folder, state, run) = folders();
        // A file where the folder should be: nothing can be made in it, whoever asks.
        fs::create_dir_all(&state).unwrap();
        fs::write(state.join("told"), "").unwrap();
        let mut teller = Teller::open(&state, &run).unwrap();
        teller.tell(&PolicyEvent::Ready { run: 7 }).unwrap();
        let mut heard = Vec::new();
        assert_eq!(Told::of(&state, &run).take(|event| heard.push(event)), 1);
        assert!(matches!(heard[0], PolicyEvent::Ready { run: 7 }));
    }

    #[test]
    fn what_cannot_be_removed_is_not_heard_again() {
        let (_folder, state, run) = folders();
        // A folder of that name is not removed as a file is: it stays, as on a disk that takes nothing.
        fs::create_dir_all(state.join("told/00000000000000000001.json")).unwrap();
        fs::create_dir_all(state.join("told/00000000000000000001.damaged/full")).unwrap();
        let mut told = Told::of(&state, &run);
        assert_eq!(told.take(|_| panic!("it says nothing")), 1);
        assert_eq!(told.take(|_| panic!("it says nothing")), 0);
    }

    #[test]
    fn a_second_loop_on_one_state_is_kept_out_whatever_its_run_folder() {
        let (folder, state, run) = folders();
        let other = RunFolder::open(&folder.path().join("other")).unwrap();
        let first = Teller::open(&state, &run).unwrap();
        let error = Teller::open(&state, &other).unwrap_err().to_string();
        assert!(error.contains("another process"), "{error}");
        drop(first);
        assert!(Teller::open(&state, &other).is_ok());
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
            answer: Answer::Policy { policy: policy(2), proved: true },
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
        let run = RunFolder::open(&folder.path().join("run")).unwrap();
        let sender = CommandSender::new(&run).unwrap();
        let view = |vx, age_ms, killed| LinkView {
            command: [vx, 0.0, -0.1],
            age: Duration::from_millis(age_ms),
            killed,
            released: false,
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
    fn commands_that_waited_for_a_loop_are_as_old_as_they_are() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::open(&folder.path().join("run")).unwrap();
        let sender = CommandSender::new(&run).unwrap();
        let mut link = LocalLink::open(&run).unwrap();
        // The loop is not reading: as much as the socket holds waits, and what comes then is refused.
        let fresh = LinkView {
            command: [0.3, 0.0, 0.0],
            age: Duration::ZERO,
            killed: false,
            released: false,
        };
        // A message says when its command came in whole microseconds.
        let resolution = Duration::from_micros(1);
        let sent = Instant::now();
        for _ in 0..1000 {
            sender.send(&fresh);
        }
        let waited = Duration::from_millis(250);
        std::thread::sleep(waited);
        // However many of them are read: none counts as one that has just come.
        for _ in 0..100 {
            let seen = link.view();
            assert!(seen.age >= waited, "{:?}", seen.age);
            assert!(seen.age <= sent.elapsed() + resolution);
        }
        let sent = Instant::now();
        sender.send(&fresh);
        let seen = link.view();
        assert!(seen.age <= sent.elapsed() + resolution, "{:?}", seen.age);
    }

    #[test]
    fn a_button_that_is_let_go_of_passes_the_boundary() {
        let view = LinkView {
            command: [0.1, 0.2, 0.3],
            age: Duration::ZERO,
            killed: false,
            released: true,
        };
        let (seen, came) = decode(&encode(&view)).unwrap();
        assert!(seen.released && !seen.killed && came.is_some());
        assert_eq!(seen.command, view.command);
        let never = LinkView { age: Duration::MAX, released: false, killed: true, ..view };
        let (seen, came) = decode(&encode(&never)).unwrap();
        assert!(!seen.released && seen.killed && came.is_none());
    }

    #[test]
    fn a_folder_that_others_may_use_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run");
        RunFolder::open(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o700);
        for mode in [0o701, 0o750, 0o777, 0o1777] {
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            let error = RunFolder::open(&path).unwrap_err();
            let text = error.to_string();
            assert!(matches!(error, DeployError::Exposed { .. }), "{text}");
            assert!(text.contains(&format!("{mode:o}")), "{text}");
            // It is said, and nothing is changed: it may be somebody's for something else.
            assert_eq!(fs::metadata(&path).unwrap().mode() & 0o7777, mode);
        }
        fs::set_permissions(&path, fs::Permissions::from_mode(0o700)).unwrap();
        RunFolder::open(&path).unwrap();
    }

    #[test]
    fn a_second_process_of_the_same_kind_is_kept_out() {
        let folder = tempfile::tempdir().unwrap();
        let first = alone(&folder.path().join("lock")).unwrap();
        assert!(alone(&folder.path().join("lock")).is_err());
        drop(first);
        assert!(alone(&folder.path().join("lock")).is_ok());
    }
}
