//! The run folder: where everything that a run leaves behind lies.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use caudata_durable::{Owner, OwnerError};
use caudata_studies::files;
use caudata_telemetry::{DRAIN_DEADLINE, ExitCode, Failure, FailureExt};

/// Longest `git.diff` that is kept, bytes. A larger one is cut, and says so.
const DIFF_BYTES_MAX: usize = 4 << 20;

/// How long the processes of an earlier command may take to end whose supervisor was killed: they have
/// [`DRAIN_DEADLINE`] to save.
const OWNER_PATIENCE: Duration = Duration::from_secs(15).saturating_add(DRAIN_DEADLINE);

/// Every event of the learner, one JSON object per line.
pub const PROGRESS: &str = "progress.jsonl";

/// How an event says that something was learnt.
const ITERATION: &str = r#""event":"iteration""#;

/// `runs/<time>_<name>/`. One process has it at a time: whoever holds `supervisor.lock`, and of the learners
/// whoever holds [`caudata_actor::LEARNER_LOCK`].
#[derive(Clone, Debug)]
pub struct RunFolder {
    root: PathBuf,
    run_id: String,
    /// Made by this command.
    new: bool,
    /// The configuration that it had before this command, and how much of [`PROGRESS`].
    before: Option<(Vec<u8>, usize)>,
    _owner: Arc<Owner>,
}

/// Called while another process has the folder: waits a moment and answers whether to try again.
pub type Wait<'a> = &'a mut dyn FnMut(&OwnerError) -> bool;

impl RunFolder {
    /// Makes the folder of a new run: at `out`, or `<out_dir>/<time>_<name>`.
    pub fn create(out: Option<&Path>, out_dir: &Path, name: &str) -> Result<Self, Failure> {
        let time = timestamp(SystemTime::now());
        let new = out.is_none_or(|out| !out.exists());
        let root = match out {
            Some(out) => out.to_owned(),
            None => unused(out_dir, &format!("{time}_{name}"))?,
        };
        if root.join("config.toml").exists() {
            let message = format!("{} holds a run already", root.display());
            return Err(Failure::message(ExitCode::CannotCreate, message)
                .hint("add --resume to go on with it, or give another --out"));
        }
        // Also the name of the stream on the policy server, which knows no capitals.
        let run_id = format!("{name}-{time}-{}", std::process::id()).to_ascii_lowercase();
        Self::make(&root, run_id, new)
    }

    /// The folder of a run with a given id at `root`: made, or taken up again as by [`RunFolder::reopen`].
    pub fn of_run(root: &Path, run_id: &str, wait: Wait<'_>) -> Result<Self, Failure> {
        if !root.join("run_id.txt").exists() {
            return Self::make(root, run_id.to_owned(), !root.exists());
        }
        let folder = Self::reopen(Some(root), root, wait)?;
        if folder.run_id != run_id {
            let message = format!("{} holds the run `{}`", root.display(), folder.run_id);
            return Err(Failure::message(ExitCode::CannotCreate, message)
                .hint(format!("`{run_id}` needs a folder of its own: cluster.run_dir")));
        }
        Ok(folder)
    }

    fn make(root: &Path, run_id: String, new: bool) -> Result<Self, Failure> {
        let root = absolute(root)?;
        files::make_folder(&root)?;
        let owner = owned(&root, Duration::ZERO, &mut |_| false)?;
        let folder = Self { root, run_id, new, before: None, _owner: owner };
        for part in [folder.logs(), folder.ledgers(), folder.checkpoints(), folder.curves()] {
            files::make_folder(&part)?;
        }
        folder.write("run_id.txt", folder.run_id.as_bytes())?;
        folder.write_git_state()?;
        Ok(folder)
    }

    /// The folder of an earlier run: `out`, or the newest one under `out_dir`. Processes of an earlier
    /// command that are still ending in it are waited for.
    pub fn reopen(out: Option<&Path>, out_dir: &Path, wait: Wait<'_>) -> Result<Self, Failure> {
        let root = match out {
            Some(out) => out.to_owned(),
            None => newest(out_dir).ok_or_else(|| {
                let message = format!("there is no run to resume under {}", out_dir.display());
                Failure::message(ExitCode::NoInput, message).hint("give its folder with --out")
            })?,
        };
        let id_path = root.join("run_id.txt");
        if !id_path.is_file() {
            files::run_folder(&root)?;
        }
        let run_id = fs::read_to_string(&id_path)
            .or_exit_with(ExitCode::NoInput, || format!("cannot read {}", id_path.display()))?;
        let folder = Self {
            _owner: owned(&root, OWNER_PATIENCE, wait)?,
            root: absolute(&root)?,
            run_id: run_id.trim().to_owned(),
            new: false,
            before: None,
        };
        for part in [folder.logs(), folder.ledgers()] {
            files::make_folder(&part)?;
        }
        Ok(folder)
    }

    /// Remembers the configuration of a run that goes on, and writes one that differs.
    ///
    /// # Errors
    /// As [`RunFolder::write`].
    pub fn goes_on(&mut self, differing: Option<&String>) -> Result<(), Failure> {
        self.before = fs::read(self.config()).ok().map(|config| (config, self.told().len()));
        differing.map_or(Ok(()), |text| self.write("config.toml", text.as_bytes()).map(drop))
    }

    /// Nothing was started: the folder is not a run, and its name can be used again; one that was to go on is as
    /// it was. Logs stay, but not of what was `refused`: that has said why.
    pub fn disown(&self, refused: bool) {
        if self.put_back() {
            return;
        }
        if refused && self.new {
            let _ = fs::remove_dir_all(&self.root);
            return;
        }
        for path in [self.config(), self.root.join("run_id.txt")] {
            let _ = fs::remove_file(path);
        }
    }

    /// As [`RunFolder::disown`] of what was refused, unless it has learnt something.
    pub fn disown_unused(&self) {
        let empty = |folder: &Path| fs::read_dir(folder).is_ok_and(|mut f| f.next().is_none());
        if self.new && empty(&self.checkpoints()) && !self.told().contains(ITERATION) {
            self.disown(true);
        }
    }

    /// What the learner has told so far.
    fn told(&self) -> String {
        fs::read_to_string(self.progress()).unwrap_or_default()
    }

    /// Whether the run was to go on; its configuration is the old one again unless it learnt with the new one.
    pub fn put_back(&self) -> bool {
        let Some((config, told)) = &self.before else { return false };
        if self.told().get(*told..).is_none_or(|since| !since.contains(ITERATION)) {
            let _ = self.write("config.toml", config);
        }
        true
    }

    /// The folder itself, absolute.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Identifier of the run, the same after a resume.
    pub fn run_id(&self) -> &str {
        &self.run_id
    }

    /// The configuration in effect.
    pub fn config(&self) -> PathBuf {
        self.root.join("config.toml")
    }

    /// Logs of the child processes.
    pub fn logs(&self) -> PathBuf {
        self.root.join("logs")
    }

    /// The actors' counts.
    pub fn ledgers(&self) -> PathBuf {
        self.root.join("ledgers")
    }

    /// The learner's checkpoints.
    pub fn checkpoints(&self) -> PathBuf {
        self.root.join("checkpoints")
    }

    /// Curves as pictures.
    pub fn curves(&self) -> PathBuf {
        self.root.join("curves")
    }

    /// The newest policy.
    pub fn policy(&self) -> PathBuf {
        self.root.join("policy.onnx")
    }

    /// The last policy, where policy.onnx is an older one that was chosen.
    pub fn last_policy(&self) -> PathBuf {
        self.root.join("last_policy.onnx")
    }

    /// The log of the simulated robot.
    pub fn robot_log(&self) -> PathBuf {
        self.root.join("robot")
    }

    /// Every event of the learner, one JSON object per line.
    pub fn progress(&self) -> PathBuf {
        self.root.join(PROGRESS)
    }

    /// Ledger of one incarnation of one actor.
    pub fn ledger(&self, actor_id: u32, incarnation: u64) -> PathBuf {
        caudata_actor::ledger_path(&self.ledgers(), actor_id, incarnation)
    }

    /// The first incarnation of this actor that has not been used in this run.
    pub fn next_incarnation(&self, actor_id: u32) -> u64 {
        caudata_actor::ledgers_in(&self.ledgers())
            .iter()
            .filter(|ledger| ledger.actor_id == actor_id)
            .map(|ledger| ledger.incarnation + 1)
            .max()
            .unwrap_or(0)
    }

    /// Writes a whole file into the folder.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<PathBuf, Failure> {
        let path = self.root.join(name);
        files::write_whole(&path, bytes)?;
        Ok(path)
    }

    /// The state of the code, as rsl_rl keeps it: commit and status in `git.txt`, changes in `git.diff`.
    fn write_git_state(&self) -> Result<(), Failure> {
        let built = caudata_telemetry::build_info();
        let commit = git(&["rev-parse", "HEAD"]).unwrap_or_else(|| "no repository\n".into());
        let status = git(&["status", "--short"]).unwrap_or_default();
        let text = format!(
            "caudata {}, {}\nwhen the run began: checkout at {commit}{status}",
            built.version, built.code
        );
        self.write("git.txt", text.as_bytes())?;
        let mut diff = git(&["diff", "HEAD"]).unwrap_or_default().into_bytes();
        if diff.len() > DIFF_BYTES_MAX {
            diff.truncate(DIFF_BYTES_MAX);
            diff.extend(b"\n(cut here: the difference is larger than 4 MiB)\n");
        }
        self.write("git.diff", &diff)?;
        Ok(())
    }
}

/// Takes a run folder for this process and the learner that it starts.
fn owned(root: &Path, patience: Duration, wait: Wait<'_>) -> Result<Arc<Owner>, Failure> {
    let began = Instant::now();
    let mut take = |name: &str| {
        let left = patience.saturating_sub(began.elapsed());
        Owner::take(&root.join(name), left, &mut *wait).map_err(|error| match &error {
            OwnerError::Taken { .. } => {
                Failure::new(ExitCode::InUse, error).hint("wait until it has ended, or stop it")
            }
            OwnerError::Io { source, .. } => Failure::new(ExitCode::of_io(source, true), error),
        })
    };
    let owner = take("supervisor.lock")?;
    // A supervisor that was killed is outlived by its learner, which saves first. The next learner takes this
    // lock itself.
    drop(take(caudata_actor::LEARNER_LOCK)?);
    Ok(Arc::new(owner))
}

/// What git says about the checkout around this executable, else around the current directory.
fn git(arguments: &[&str]) -> Option<String> {
    let beside = std::env::current_exe().ok()?;
    let places = [beside.parent()?.to_owned(), PathBuf::from(".")];
    places.iter().find_map(|place| {
        let output = Command::new("git").arg("-C").arg(place).args(arguments).output().ok()?;
        output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
    })
}

fn absolute(path: &Path) -> Result<PathBuf, Failure> {
    std::path::absolute(path)
        .or_exit_with(ExitCode::CannotCreate, || format!("no such path: {}", path.display()))
}

/// A new folder of this name in `out_dir`, or with a number behind it: two runs may begin in one second.
fn unused(out_dir: &Path, name: &str) -> Result<PathBuf, Failure> {
    /// More than anybody starts in a second.
    const RUNS_A_SECOND: usize = 1000;
    files::make_folder(out_dir)?;
    for number in 1..RUNS_A_SECOND {
        let root = out_dir.join(match number {
            1 => name.to_owned(),
            again => format!("{name}-{again}"),
        });
        match fs::create_dir(&root) {
            Ok(()) => return Ok(root),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => {
                return Err(error).or_exit_with(ExitCode::CannotCreate, || {
                    format!("cannot make {}", root.display())
                });
            }
        }
    }
    let message = format!("{} has {RUNS_A_SECOND} runs of this second", out_dir.display());
    Err(Failure::message(ExitCode::CannotCreate, message))
}

/// The folder of the run that began, or learnt, last.
pub fn newest(out_dir: &Path) -> Option<PathBuf> {
    let folders = fs::read_dir(out_dir).ok()?.flatten().map(|entry| entry.path());
    let written = |path: PathBuf| fs::metadata(path).and_then(|file| file.modified()).ok();
    let dated = folders.filter_map(|path| {
        let began = written(path.join("run_id.txt"))?;
        Some((written(path.join(PROGRESS)).map_or(began, |learnt| began.max(learnt)), path))
    });
    dated.max().map(|(_, path)| path)
}

/// `20261121-083312` (UTC): sorts by time and needs no escaping anywhere.
fn timestamp(now: SystemTime) -> String {
    /// The last second whose year has four digits.
    const LAST: Duration = Duration::from_secs(253_402_300_799);
    let now = now.clamp(UNIX_EPOCH, UNIX_EPOCH + LAST);
    // `2026-11-21T08:33:12Z`
    let time = humantime::format_rfc3339_seconds(now).to_string();
    let time = time.trim_end_matches('Z').replace(['-', ':'], "");
    time.replace('T', "-")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_of_known_days() {
        // `date -u -d @951782400` is 2000-02-29, a leap day; 1767225599 is the last second of 2025.
        let at = |seconds| timestamp(UNIX_EPOCH + Duration::from_secs(seconds));
        assert_eq!(at(0), "19700101-000000");
        assert_eq!(at(951_782_400), "20000229-000000");
        assert_eq!(at(1_767_225_599), "20251231-235959");
    }

    #[test]
    fn two_runs_of_one_second_have_a_folder_each() {
        let dir = tempfile::tempdir().unwrap();
        let names = ["now_walk", "now_walk-2", "now_walk-3"];
        for name in names {
            assert_eq!(unused(dir.path(), "now_walk").unwrap(), dir.path().join(name));
        }
    }

    fn locked(root: &Path) -> Owner {
        let path = root.join(caudata_actor::LEARNER_LOCK);
        Owner::take(&path, Duration::ZERO, |_| false).unwrap()
    }

    #[test]
    fn a_folder_is_made_once_and_found_again() {
        let dir = tempfile::tempdir().unwrap();
        let made = RunFolder::create(None, dir.path(), "walk").unwrap();
        fs::write(made.config(), "").unwrap();
        assert_eq!(made.next_incarnation(3), 0);
        fs::write(made.ledger(3, 4), [0; 8]).unwrap();
        let (run_id, root) = (made.run_id().to_owned(), made.root().to_owned());
        let refused = RunFolder::reopen(None, dir.path(), &mut |_| false).unwrap_err();
        assert_eq!(refused.code(), ExitCode::InUse, "one owner at a time");
        drop(made);
        // A learner that outlives its supervisor is waited for.
        let mut learner = Some(locked(&root));
        let made = RunFolder::reopen(None, dir.path(), &mut |_| learner.take().is_some()).unwrap();
        assert!(learner.is_none());
        drop(made);
        let again = RunFolder::reopen(None, dir.path(), &mut |_| false).unwrap();
        assert_eq!((again.run_id(), again.root()), (run_id.as_str(), root.as_path()));
        let made = again.clone();
        assert_eq!((again.next_incarnation(3), again.next_incarnation(30)), (5, 0));
        let taken = RunFolder::create(Some(made.root()), dir.path(), "walk").unwrap_err();
        assert_eq!(taken.code(), ExitCode::CannotCreate);
        made.disown(true);
        drop((made, again));
        let made = RunFolder::create(Some(&root), dir.path(), "walk").unwrap();
        made.disown(true);
        assert!(root.exists(), "others have put something into it");
        let new = dir.path().join("new");
        for (refused, stays) in [(false, true), (true, false)] {
            let _ = fs::remove_dir_all(&new);
            let made = RunFolder::create(Some(&new), dir.path(), "walk").unwrap();
            made.disown(refused);
            assert_eq!(new.exists(), stays);
        }
    }

    #[test]
    fn a_run_that_does_not_go_on_keeps_its_configuration() {
        let dir = tempfile::tempdir().unwrap();
        let mut folder = RunFolder::create(None, dir.path(), "walk").unwrap();
        let event = format!("{{{ITERATION}}}\n");
        for (learnt, stays) in [("", "old"), (event.as_str(), "new")] {
            fs::write(folder.config(), "old").unwrap();
            fs::write(folder.progress(), &event).unwrap();
            folder.goes_on(Some(&"new".to_owned())).unwrap();
            fs::write(folder.progress(), event.clone() + learnt).unwrap();
            assert!(folder.put_back());
            assert_eq!(fs::read_to_string(folder.config()).unwrap(), stays);
        }
    }

    #[test]
    fn the_newest_run_is_the_one_that_learnt_last() {
        let dir = tempfile::tempdir().unwrap();
        // clocks of files tick too slowly to tell runs of a test apart
        let at = |name: &str, file: &str, s: u64| {
            let file = fs::File::create(dir.path().join(name).join(file)).unwrap();
            file.set_modified(std::time::UNIX_EPOCH + Duration::from_secs(s)).unwrap();
        };
        for (s, name) in (1..).zip(["20260101-000000_quick", "second", "first"]) {
            RunFolder::create(Some(&dir.path().join(name)), dir.path(), name).unwrap();
            at(name, "run_id.txt", s);
            at(name, PROGRESS, s);
        }
        assert_eq!(newest(dir.path()), Some(dir.path().join("first")));
        at("second", PROGRESS, 4);
        assert_eq!(newest(dir.path()), Some(dir.path().join("second")));
    }

    #[test]
    fn nothing_to_resume_is_said() {
        let dir = tempfile::tempdir().unwrap();
        let failure = RunFolder::reopen(None, dir.path(), &mut |_| false).unwrap_err();
        assert_eq!(failure.code(), ExitCode::NoInput);
    }
}
