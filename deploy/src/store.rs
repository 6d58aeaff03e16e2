//! The robot's folder: `state.json` with its copy `state.copy.json`, `blobs/<sha256>.onnx`, and beside each of these its signed
//! announcement, `blobs/<sha256>.<version>.<stream>.manifest`, where the stream is the first half of its name's SHA-256. What is read from it is checked as if it came from outside.

use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable::{self as durable, Disk, OsDisk};
use caudata_policy::MAX_FILE_BYTES;
use caudata_proto::registry::Manifest;
use caudata_signing::Trust;
use sha2::{Digest, Sha256};

use crate::DeployError;
use crate::state::{PolicyRef, RobotState, STATE_FORMAT, Sha256Digest};
use crate::steps::Step;

/// Largest state file that is read, bytes.
const STATE_BYTES_MAX: u64 = 1 << 20;
/// The state, twice.
const COPIES: [&str; 2] = ["state.json", "state.copy.json"];

/// The state and the policies on disk. Every change is on the disk before it counts.
#[derive(Debug)]
pub struct PolicyStore {
    disk: Arc<dyn Disk>,
    folder: PathBuf,
    state: RobotState,
    /// The state was lost.
    torn: bool,
    /// Version of the trust file that this process goes by, 0 without one. Every state that is written says it: one that could not be written down at
    /// once is then not forgotten, nor written over where one of the two copies has it already.
    trust_version: u64,
}

impl PolicyStore {
    /// Opens the folder, making it where it is absent.
    ///
    /// # Errors
    /// [`DeployError::StateDamaged`] where `state.json` cannot be understood (it then says nothing about what may run, so
    /// nothing does), [`DeployError::Folder`] and [`DeployError::Durable`] where the disk refuses.
    pub fn open(folder: &Path) -> Result<Self, DeployError> {
        Self::open_on(Arc::new(OsDisk), folder)
    }

    /// [`PolicyStore::open`] on a disk that may be a rehearsed one.
    ///
    /// # Errors
    /// As [`PolicyStore::open`].
    pub fn open_on(disk: Arc<dyn Disk>, folder: &Path) -> Result<Self, DeployError> {
        let blobs = folder.join("blobs");
        fs::create_dir_all(&blobs).map_err(|source| DeployError::Folder {
            path: blobs.clone(),
            source,
        })?;
        durable::remove_leftovers(folder)?;
        durable::remove_leftovers(&blobs)?;
        Ok(Self {
            disk,
            folder: folder.to_owned(),
            state: read_state(folder)?.unwrap_or_default(),
            torn: false,
            trust_version: 0,
        })
    }

    /// Opens the folder although no copy of the state can be read: nothing is known, so that nothing may be taken until
    /// [`PolicyStore::recover`] said what is too old. The damaged copies are kept aside for a person.
    ///
    /// # Errors
    /// As [`PolicyStore::open`], but not for damage.
    pub fn open_torn(folder: &Path) -> Result<Self, DeployError> {
        Ok(Self::open_torn_on(Arc::new(OsDisk), folder))
    }

    /// [`PolicyStore::open_torn`] on a disk that may be a rehearsed one.
    fn open_torn_on(disk: Arc<dyn Disk>, folder: &Path) -> Self {
        Self {
            disk,
            folder: folder.to_owned(),
            state: RobotState::default(),
            torn: true,
            trust_version: 0,
        }
    }

    /// Whether the state was lost and nothing took its place yet.
    pub fn is_torn(&self) -> bool {
        self.torn
    }

    /// Begins a new state after a server proved, freshly, that `stream` is at `floor`: nothing older is taken, and no trust file older than the one of
    /// `trust_version`, by which it was proved. Each damaged copy is kept aside and then replaced: at no time is there a folder without any, which would
    /// look like that of a robot that never had a state.
    ///
    /// # Errors
    /// [`DeployError::Durable`], [`DeployError::Folder`]; it is then as torn as before, here. On the disk one copy may be the new one already: the next
    /// start goes on from it.
    pub fn recover(
        &mut self,
        stream: &str,
        floor: u64,
        trust_version: u64,
    ) -> Result<(), DeployError> {
        let copies = COPIES.map(|name| self.folder.join(name));
        for path in &copies {
            // One that reads is what an attempt of before could still write.
            if matches!(read_copy(path), Err(DeployError::StateDamaged { .. })) {
                self.keep_aside(path)?;
            }
        }
        let state = RobotState::recovered(stream, floor, trust_version);
        let text = encode(&state)?;
        for path in &copies {
            durable::replace_on(&*self.disk, path, &text)?;
        }
        self.state = state;
        self.torn = false;
        Ok(())
    }

    /// Copies the damaged file at `path`, of one that is too large the beginning, to where a person finds it.
    fn keep_aside(&self, path: &Path) -> Result<(), DeployError> {
        let mut bytes = Vec::new();
        fs::File::open(path)
            .and_then(|file| file.take(STATE_BYTES_MAX).read_to_end(&mut bytes))
            .map_err(|source| DeployError::Folder {
                path: path.to_owned(),
                source,
            })?;
        let mut aside = path.as_os_str().to_owned();
        aside.push(".damaged");
        Ok(durable::replace_on(&*self.disk, Path::new(&aside), &bytes)?)
    }

    /// The trust file at `path`, of which `version` is in force, is what this robot goes by: from now on no older one is.
    ///
    /// # Errors
    /// [`DeployError::OlderTrust`] where a newer one was in force here before.
    pub fn trust(&mut self, path: &Path, version: u64) -> Result<(), DeployError> {
        check_trust(&self.state, path, version)?;
        self.trust_version = version;
        // A lost state says nothing about trust files; [`PolicyStore::recover`] writes it down.
        if self.torn {
            return Ok(());
        }
        if let Err(error) = self.update(|state| state.saw_trust(version)) {
            // A card that takes nothing more must not keep a robot from running what is on it. The next change says it again.
            tracing::error!(%error, version, "cannot write down which trust file is in force");
        }
        Ok(())
    }

    /// Reads the state without changing anything; `None` where there is none.
    ///
    /// # Errors
    /// As [`PolicyStore::open`].
    pub fn peek(folder: &Path) -> Result<Option<RobotState>, DeployError> {
        read_state(folder)
    }

    /// What the robot knows.
    pub fn state(&self) -> &RobotState {
        &self.state
    }

    /// Changes the state and writes it; files that no policy needs any more are removed.
    ///
    /// # Errors
    /// [`DeployError::Durable`]; the state is then as it was, on disk and here.
    pub fn update(&mut self, change: impl FnOnce(&mut RobotState)) -> Result<(), DeployError> {
        let mut state = self.state.clone();
        change(&mut state);
        if state == self.state {
            return Ok(());
        }
        // What was lost must not be overwritten by what looks like a beginning.
        if self.torn {
            return Err(DeployError::StateLost);
        }
        state.saw_trust(self.trust_version);
        let text = encode(&state)?;
        // Both hold the same: whichever survives says the newest that was promised.
        for name in COPIES {
            durable::replace_on(&*self.disk, &self.folder.join(name), &text)?;
        }
        self.state = state;
        self.remove_unneeded();
        Ok(())
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Keeps the bytes of a policy. Call before the state names it.
    ///
    /// # Errors
    /// [`DeployError::Durable`].
    pub fn put(&self, policy: &PolicyRef, bytes: &[u8]) -> Result<(), DeployError> {
        // Replaces a file of this name, which could only be a damaged one.
        let path = blob(&self.folder, policy.sha256);
        Ok(durable::replace_on(&*self.disk, &path, bytes)?)
    }

    /// Whether the disk takes a file as large as the policy's, `size` bytes: tried and taken back.
    ///
    /// # Errors
    /// [`DeployError::Durable`] where it does not.
    pub fn reserve(&self, policy: &PolicyRef, size: u64) -> Result<(), DeployError> {
        let bytes = vec![0; usize::try_from(size).unwrap_or(0).min(MAX_FILE_BYTES)];
        let name = format!("{}.reserved{}", policy.sha256, durable::TEMPORARY_SUFFIX);
        let path = self.folder.join("blobs").join(name);
        let taken = self.disk.write_synced(&path, &bytes);
        let _ = self.disk.remove(&path);
        taken.map_err(|(action, source)| {
            durable::DurableError::from_io(action, &path, source).into()
        })
    }

    /// Keeps the announcement of a policy with its signatures. Call before the state names it.
    ///
    /// # Errors
    /// [`DeployError::Durable`].
    pub fn put_manifest(&self, manifest: &Manifest) -> Result<(), DeployError> {
        let path = manifest_file(&self.folder, &crate::keeper::reference(manifest));
        Ok(durable::replace_on(
            &*self.disk,
            &path,
            &manifest.to_bytes(),
        )?)
    }

    /// [`read_policy`] of this folder.
    ///
    /// # Errors
    /// As [`read_policy`].
    pub fn get(&self, policy: &PolicyRef, trust: Option<&Trust>) -> Result<Arc<[u8]>, DeployError> {
        read_policy(&self.folder, policy, trust)
    }

    /// Failing here costs nothing but space. Of announcements only those of what is on the disk stay: the same bytes can be announced in many streams
    /// and under many numbers.
    fn remove_unneeded(&self) {
        let on_disk = self.state.on_disk();
        let announced = on_disk.iter().flat_map(|policy| {
            [manifest_file, older_manifest_file].map(|file| file(&self.folder, policy))
        });
        let announced: Vec<PathBuf> = announced.collect();
        let Ok(entries) = fs::read_dir(self.folder.join("blobs")) else {
            return;
        };
        for entry in entries.flatten() {
            let name = entry.file_name();
            let digest = name.to_str().and_then(|n| n.split('.').next());
            let digest = digest.and_then(|d| d.parse::<Sha256Digest>().ok());
            let path = entry.path();
            let stale = path.extension() == Some(MANIFEST.as_ref()) && !announced.contains(&path);
            if digest.is_some_and(|d| stale || !self.state.needs(d)) {
                let _ = self.disk.remove(&path);
            }
        }
    }
}

/// What the names of announcements end with.
const MANIFEST: &str = "manifest";
/// Largest manifest file that is read, bytes: the evaluation summary is most of it.
const MANIFEST_BYTES_MAX: u64 = 128 << 10;

/// The bytes of a policy, as they were put into the robot's folder. With `trust`, keys of it must have signed the announcement that
/// was kept beside them.
///
/// # Errors
/// [`DeployError::BlobMissing`], also for a missing announcement; [`DeployError::BlobDamaged`] where the bytes have another hash,
/// [`DeployError::NotSigned`] where nobody trusted announced them as this policy.
pub fn read_policy(
    folder: &Path,
    policy: &PolicyRef,
    trust: Option<&Trust>,
) -> Result<Arc<[u8]>, DeployError> {
    let path = blob(folder, policy.sha256);
    let bytes = read_bounded(&path, MAX_FILE_BYTES as u64)?;
    let found = Sha256Digest(Sha256::digest(&bytes).into());
    if Step::StoredHash.on() && found != policy.sha256 {
        return Err(DeployError::BlobDamaged { path });
    }
    if let Some(trust) = trust.filter(|_| Step::StoredSignature.on()) {
        let path = kept_manifest_file(folder, policy);
        let manifest = Manifest::from_bytes(&read_bounded(&path, MANIFEST_BYTES_MAX)?);
        let signed = manifest.is_ok_and(|manifest| {
            crate::keeper::reference(&manifest) == *policy && trust.check(&manifest).is_ok()
        });
        if !signed {
            return Err(DeployError::NotSigned { path });
        }
    }
    Ok(bytes.into())
}

fn read_bounded(path: &Path, bytes_max: u64) -> Result<Vec<u8>, DeployError> {
    let missing = |source| DeployError::BlobMissing {
        path: path.to_owned(),
        source,
    };
    if fs::metadata(path).map_err(missing)?.len() > bytes_max {
        return Err(DeployError::BlobDamaged {
            path: path.to_owned(),
        });
    }
    fs::read(path).map_err(missing)
}

fn blob(folder: &Path, sha256: Sha256Digest) -> PathBuf {
    folder.join("blobs").join(format!("{sha256}.onnx"))
}

/// Where the announcement of `policy` lies. By its stream too: the same bytes may bear the same version in two streams, and neither announcement
/// may take the place of the other, whenever the power goes.
pub(crate) fn manifest_file(folder: &Path, policy: &PolicyRef) -> PathBuf {
    let stream = Sha256Digest(Sha256::digest(&policy.stream).into()).to_string();
    let (sha256, version) = (policy.sha256, policy.version);
    let name = format!("{sha256}.{version}.{}.{MANIFEST}", &stream[..32]);
    folder.join("blobs").join(name)
}

/// Where it lies in folders of before, which did not tell streams apart.
fn older_manifest_file(folder: &Path, policy: &PolicyRef) -> PathBuf {
    let name = format!("{}.{}.{MANIFEST}", policy.sha256, policy.version);
    folder.join("blobs").join(name)
}

/// The older one where there is only that, so that what is said about the announcement names the file that was looked at, or should be there.
fn kept_manifest_file(folder: &Path, policy: &PolicyRef) -> PathBuf {
    let (file, older) = (
        manifest_file(folder, policy),
        older_manifest_file(folder, policy),
    );
    match (fs::exists(&file), fs::exists(&older)) {
        (Ok(false), Ok(true)) => older,
        _ => file,
    }
}

/// Refuses the trust file at `path`, of which `version` is in force, where a newer one was in force on the robot of `state`.
///
/// # Errors
/// [`DeployError::OlderTrust`].
pub fn check_trust(state: &RobotState, path: &Path, version: u64) -> Result<(), DeployError> {
    if state.takes_trust(version) {
        return Ok(());
    }
    Err(DeployError::OlderTrust {
        path: path.to_owned(),
        found: version,
        seen: state.trust_version,
    })
}

/// Refuses to go without any trust file where one was in force on the robot of `state`, which is kept in `folder`: whoever left it out would take what
/// nobody signed.
///
/// # Errors
/// [`DeployError::TrustLeftOut`].
pub fn check_without_trust(state: &RobotState, folder: &Path) -> Result<(), DeployError> {
    if state.takes_trust(0) {
        return Ok(());
    }
    Err(DeployError::TrustLeftOut {
        folder: folder.to_owned(),
        seen: state.trust_version,
    })
}

/// A state file: the state, and the SHA-256 of its compact JSON, so that a flipped bit is noticed.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct StateFile {
    sha256: Sha256Digest,
    state: RobotState,
}

fn digest(state: &RobotState) -> Result<Sha256Digest, String> {
    let text = serde_json::to_vec(state).map_err(|e| e.to_string())?;
    Ok(Sha256Digest(Sha256::digest(text).into()))
}

fn encode(state: &RobotState) -> Result<Vec<u8>, DeployError> {
    let file = digest(state).map(|sha256| StateFile {
        sha256,
        state: state.clone(),
    });
    file.and_then(|file| serde_json::to_vec_pretty(&file).map_err(|e| e.to_string()))
        .map_err(|what| DeployError::Internal { what })
}

/// The newest state that can be read; `None` where there never was one.
fn read_state(folder: &Path) -> Result<Option<RobotState>, DeployError> {
    let mut newest: Option<RobotState> = None;
    let mut damage = None;
    for name in COPIES {
        let path = folder.join(name);
        match read_copy(&path) {
            Ok(None) => {}
            Ok(Some(state)) => {
                if newest
                    .as_ref()
                    .is_none_or(|n| n.generation < state.generation)
                {
                    newest = Some(state);
                }
            }
            Err(DeployError::StateDamaged { path, reason }) => {
                damage.get_or_insert((path, reason));
            }
            Err(error) => return Err(error),
        }
    }
    match (newest, damage) {
        (None, Some((path, reason))) => Err(DeployError::StateDamaged { path, reason }),
        (Some(state), Some((path, reason))) => {
            tracing::error!(path = %path.display(), reason, "one copy of the state is damaged; the other is used");
            Ok(Some(state))
        }
        (newest, None) => Ok(newest),
    }
}

fn read_copy(path: &Path) -> Result<Option<RobotState>, DeployError> {
    let damaged = |reason: String| DeployError::StateDamaged {
        path: path.to_owned(),
        reason,
    };
    match fs::metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Ok(meta) if meta.len() > STATE_BYTES_MAX => return Err(damaged("it is too large".into())),
        _ => {}
    }
    let bytes = fs::read(path).map_err(|source| DeployError::Folder {
        path: path.to_owned(),
        source,
    })?;
    let file: StateFile = serde_json::from_slice(&bytes).map_err(|e| damaged(e.to_string()))?;
    if file.state.format != STATE_FORMAT {
        return Err(damaged(format!("its format is `{}`", file.state.format)));
    }
    if digest(&file.state).map_err(damaged)? != file.sha256 {
        return Err(damaged("it is not what was written".to_owned()));
    }
    Ok(Some(file.state))
}

#[cfg(test)]
mod tests {
    use caudata_durable::rehearsal::Rehearsal;

    use super::*;

    fn policy(bytes: &[u8]) -> PolicyRef {
        PolicyRef {
            stream: "s".to_owned(),
            version: 1,
            sha256: Sha256Digest(Sha256::digest(bytes).into()),
            reverts_to: None,
        }
    }

    #[test]
    fn what_was_adopted_is_there_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let one = policy(b"one");
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.put(&one, b"one").unwrap();
        store.update(|s| s.adopt(one.clone())).unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        assert_eq!(store.state().active, Some(one.clone()));
        assert_eq!(*store.get(&one, None).unwrap(), *b"one");
    }

    #[test]
    fn a_truncated_or_missing_file_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let one = policy(b"one");
        let store = PolicyStore::open(folder.path()).unwrap();
        let missing = store.get(&one, None).unwrap_err();
        assert!(
            matches!(missing, DeployError::BlobMissing { .. }),
            "{missing}"
        );
        store.put(&one, b"one").unwrap();
        let path = blob(folder.path(), one.sha256);
        fs::write(&path, b"on").unwrap();
        let damaged = store.get(&one, None).unwrap_err();
        assert!(
            matches!(damaged, DeployError::BlobDamaged { .. }),
            "{damaged}"
        );
        assert!(damaged.to_string().contains(&one.sha256.to_string()));
    }

    #[test]
    fn a_state_that_cannot_be_read_stops_everything() {
        let folder = tempfile::tempdir().unwrap();
        for text in ["", "{", "{\"format\":\"x\"}"] {
            fs::write(folder.path().join("state.json"), text).unwrap();
            let error = PolicyStore::open(folder.path()).unwrap_err();
            assert!(matches!(error, DeployError::StateDamaged { .. }), "{error}");
        }
    }

    #[test]
    fn files_that_no_policy_needs_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = PolicyStore::open(folder.path()).unwrap();
        for bytes in [b"one", b"two", b"six"] {
            let policy = policy(bytes);
            store.put(&policy, bytes).unwrap();
            store.update(|s| s.adopt(policy.clone())).unwrap();
            if bytes == b"one" {
                store.update(|s| s.confirm(policy.sha256)).unwrap();
            }
        }
        assert!(store.get(&policy(b"one"), None).is_ok(), "last good");
        assert!(
            store.get(&policy(b"two"), None).is_err(),
            "neither active nor good"
        );
        assert!(store.get(&policy(b"six"), None).is_ok(), "active");
    }

    /// A folder that holds `one` (version 1), adopted, with both copies of the state.
    fn adopted() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.put(&policy(b"one"), b"one").unwrap();
        store.update(|s| s.adopt(policy(b"one"))).unwrap();
        folder
    }

    #[test]
    fn fault_15_one_damaged_copy_forgets_nothing() {
        for name in COPIES {
            let whole = fs::read(adopted().path().join(name)).unwrap();
            // Cut anywhere, or any single bit flipped: the other copy speaks, or the damaged one still says the same.
            for at in (0..whole.len()).step_by(7) {
                let mut flipped = whole.clone();
                flipped[at] ^= 0x10;
                for damaged in [&whole[..at], &flipped] {
                    let folder = adopted();
                    fs::write(folder.path().join(name), damaged).unwrap();
                    let store = PolicyStore::open(folder.path()).unwrap();
                    assert_eq!(store.state().active, Some(policy(b"one")), "{name} {at}");
                    assert_eq!(store.state().seen["s"], 1);
                }
            }
        }
    }

    #[test]
    fn fault_16_both_copies_damaged_is_not_an_empty_state() {
        let folder = adopted();
        for name in COPIES {
            fs::write(folder.path().join(name), b"{").unwrap();
        }
        let error = PolicyStore::open(folder.path()).unwrap_err();
        assert!(matches!(error, DeployError::StateDamaged { .. }), "{error}");
    }

    #[test]
    fn the_newer_copy_wins_where_power_went_between_the_two() {
        let folder = adopted();
        let old = fs::read(folder.path().join(COPIES[1])).unwrap();
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.update(|s| s.confirm(policy(b"one").sha256)).unwrap();
        fs::write(folder.path().join(COPIES[1]), old).unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        assert_eq!(store.state().last_good, Some(policy(b"one")));
    }

    #[test]
    fn fault_16_a_lost_state_takes_nothing_until_a_floor_is_proved() {
        let folder = adopted();
        for name in COPIES {
            fs::write(folder.path().join(name), b"{").unwrap();
        }
        let mut store = PolicyStore::open_torn(folder.path()).unwrap();
        assert!(store.is_torn());
        let error = store.update(|s| s.adopt(policy(b"one"))).unwrap_err();
        assert!(matches!(error, DeployError::StateLost), "{error}");
        // As torn as before, not new.
        assert!(PolicyStore::open(folder.path()).is_err());
        store.recover("s", 9, 2).unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        let here = Sha256Digest([7; 32]);
        let older = crate::state::Decision::Older { have: 9 };
        assert_eq!(store.state().decide(&policy(b"one"), here), older);
        for name in COPIES {
            let aside = folder.path().join(format!("{name}.damaged"));
            assert_eq!(fs::read(aside).unwrap(), b"{", "{name}");
        }
        // Nor do the keys come back that were given up before it was proved.
        let error = check_trust(store.state(), Path::new("t"), 1).unwrap_err();
        assert!(matches!(error, DeployError::OlderTrust { .. }), "{error}");
    }

    /// A folder whose state is lost: both copies are damaged, or the only one that is there.
    fn lost(root: &Path, damaged: &[&str]) {
        drop(walked(root));
        for name in COPIES {
            match damaged.contains(&name) {
                true => fs::write(root.join(name), b"{").unwrap(),
                false => fs::remove_file(root.join(name)).unwrap(),
            }
        }
    }

    /// Whether a robot that starts with this folder is still torn; else it goes by the new state. It never takes itself for a new one.
    fn torn_or_recovered(folder: &Path) -> bool {
        match PolicyStore::open(folder) {
            Err(DeployError::StateDamaged { .. }) => true,
            Err(error) => panic!("{error}"),
            Ok(store) => {
                assert_eq!(store.state().seen.get("s"), Some(&9));
                assert_eq!(store.state().trust_version, 2);
                false
            }
        }
    }

    const LOSSES: [&[&str]; 3] = [&COPIES, &[COPIES[0]], &[COPIES[1]]];

    #[test]
    fn fault_16_a_power_cut_while_a_lost_state_is_begun_anew_leaves_no_robot_that_never_had_one() {
        for damaged in LOSSES {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("state");
            lost(&root, damaged);
            let disk = Arc::new(Rehearsal::new(&root).unwrap());
            let mut store = PolicyStore::open_torn_on(disk.clone(), &root);
            let first = disk.steps();
            store.recover("s", 9, 2).unwrap();
            let last = disk.steps();
            let (mut torn, mut recovered) = (0, 0);
            for step in first..=last {
                let below = folder.path().join(format!("cuts-{step}"));
                for left in disk.cut(step, &below).unwrap() {
                    let still = torn_or_recovered(&left);
                    assert!(!still || step < last, "promised");
                    torn += u32::from(still);
                    recovered += u32::from(!still);
                    if still {
                        PolicyStore::open_torn(&left)
                            .unwrap()
                            .recover("s", 9, 2)
                            .unwrap();
                        assert!(!torn_or_recovered(&left));
                    }
                }
                fs::remove_dir_all(&below).unwrap();
            }
            assert!(torn > 0 && recovered > 0, "both were seen");
        }
    }

    #[test]
    fn fault_16_a_full_disk_while_a_lost_state_is_begun_anew_leaves_no_robot_that_never_had_one() {
        for damaged in LOSSES {
            for step in 0.. {
                let folder = tempfile::tempdir().unwrap();
                lost(folder.path(), damaged);
                let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
                let mut store = PolicyStore::open_torn_on(disk.clone(), folder.path());
                disk.fail_writes_at(disk.steps() + step, 28);
                let result = store.recover("s", 9, 2);
                disk.heal();
                let Err(error) = result else {
                    assert!(step > 5, "it has few steps");
                    break;
                };
                assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::IoError);
                assert!(store.is_torn());
                torn_or_recovered(folder.path());
                // The next answer of the server does it, and what was damaged is still there for a person.
                store.recover("s", 9, 2).unwrap();
                assert!(!torn_or_recovered(folder.path()));
                for name in damaged {
                    let aside = folder.path().join(format!("{name}.damaged"));
                    assert_eq!(fs::read(aside).unwrap(), b"{", "{name}");
                }
            }
        }
    }

    /// Version 1 ran well, version 2 is active.
    fn walked(folder: &Path) -> PolicyStore {
        let mut store = PolicyStore::open(folder).unwrap();
        for (bytes, version) in [(&b"one"[..], 1), (&b"two"[..], 2)] {
            let policy = PolicyRef {
                version,
                ..policy(bytes)
            };
            store.put(&policy, bytes).unwrap();
            store.update(|s| s.adopt(policy.clone())).unwrap();
            if version == 1 {
                store.update(|s| s.confirm(policy.sha256)).unwrap();
            }
        }
        store
    }

    type Change = fn(&mut PolicyStore) -> Result<(), DeployError>;

    /// Each change that a robot's folder undergoes.
    const CHANGES: [(&str, Change); 4] = [
        ("a newer one is taken", |store| {
            let six = PolicyRef {
                version: 3,
                ..policy(b"six")
            };
            store.put(&six, b"six")?;
            store.update(|s| s.adopt(six))
        }),
        ("begun", |store| {
            store.update(|s| {
                s.begin(policy(b"two").sha256);
            })
        }),
        ("confirmed", |store| {
            store.update(|s| s.confirm(policy(b"two").sha256))
        }),
        ("quarantined", |store| {
            let two = store.state().active.clone().unwrap();
            store.update(|s| s.quarantine(two, "falls".into(), crate::state::Blame::Policy))
        }),
    ];

    /// What a robot that starts with this folder finds: its state, with every policy that it names there and whole.
    fn found(folder: &Path) -> RobotState {
        let store = PolicyStore::open(folder).unwrap();
        let state = store.state().clone();
        assert!(!state.on_disk().is_empty(), "never to nothing");
        for policy in state.on_disk() {
            store.get(&policy, None).unwrap();
        }
        state
    }

    #[test]
    fn fault_29_a_power_cut_at_any_write_leaves_the_old_or_the_new_state_with_its_policies() {
        let mut states = 0;
        for (name, change) in CHANGES {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path().join("state");
            drop(walked(&root));
            let old = found(&root);
            let disk = Arc::new(Rehearsal::new(&root).unwrap());
            let mut store = PolicyStore::open_on(disk.clone(), &root).unwrap();
            let first = disk.steps();
            change(&mut store).unwrap();
            let last = disk.steps();
            let new = store.state().clone();
            assert_ne!(old, new, "{name}");
            let (mut olds, mut news) = (0, 0);
            for step in first..=last {
                let below = folder.path().join(format!("cuts-{step}"));
                for left in disk.cut(step, &below).unwrap() {
                    let found = found(&left);
                    assert!(found == old || found == new, "{name} cut after {step}");
                    assert!(step < last || found == new, "{name}: promised");
                    olds += u32::from(found == old);
                    news += u32::from(found == new);
                    // And it goes on from there.
                    let mut store = PolicyStore::open(&left).unwrap();
                    store.update(|s| s.adopt(policy(b"nix"))).unwrap();
                    states += 1;
                }
                fs::remove_dir_all(&below).unwrap();
            }
            assert!(olds > 0 && news > 0, "{name}: both were seen");
        }
        assert!(states > 50, "{states}");
    }

    #[test]
    fn fault_30_a_full_disk_at_any_write_refuses_the_change_and_harms_nothing() {
        for (name, change) in CHANGES {
            for step in 0.. {
                let folder = tempfile::tempdir().unwrap();
                drop(walked(folder.path()));
                let old = found(folder.path());
                let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
                let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
                disk.fail_writes_at(disk.steps() + step, 28);
                let result = change(&mut store);
                disk.heal();
                let Err(error) = result else {
                    assert!(step > 3, "{name} has few steps");
                    break;
                };
                assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::IoError);
                assert_eq!(*store.state(), old, "{name} at {step}: as it was, here");
                // One copy may be the new one already: then the change counts after a restart, whole.
                found(folder.path());
                change(&mut store).unwrap();
                assert_eq!(found(folder.path()), *store.state());
            }
        }
    }

    #[test]
    fn fault_30_a_disk_that_would_not_take_a_policy_says_so_before_it_is_fetched() {
        let folder = tempfile::tempdir().unwrap();
        drop(walked(folder.path()));
        let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
        let store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
        let before = fs::read_dir(folder.path().join("blobs")).unwrap().count();
        store.reserve(&policy(b"six"), 100_000).unwrap();
        disk.fail_writes_at(disk.steps(), 30);
        let error = store.reserve(&policy(b"six"), 100_000).unwrap_err();
        assert!(matches!(error, DeployError::Durable(_)), "{error}");
        let after = fs::read_dir(folder.path().join("blobs")).unwrap().count();
        assert_eq!(before, after, "nothing is left of it");
    }

    #[test]
    fn what_the_loop_loads_was_signed_as_this_very_policy() {
        let folder = tempfile::tempdir().unwrap();
        let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
        let trust = Trust::parse(&key.trust_file()).unwrap();
        let store = PolicyStore::open(folder.path()).unwrap();
        let one = policy(b"one");
        store.put(&one, b"one").unwrap();
        let read = || read_policy(folder.path(), &one, Some(&trust));
        // Each error names the file that it is about.
        let named = |wanted: PathBuf| match read() {
            Err(DeployError::BlobMissing { path, .. } | DeployError::NotSigned { path }) => {
                assert_eq!(path, wanted);
            }
            other => panic!("{other:?}"),
        };
        let (newer, older) = (
            manifest_file(folder.path(), &one),
            older_manifest_file(folder.path(), &one),
        );
        assert!(matches!(read(), Err(DeployError::BlobMissing { .. })));
        named(newer.clone());
        let mut manifest = announced(&one, &key);
        manifest.signatures.clear();
        fs::write(&older, manifest.to_bytes()).unwrap();
        assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
        named(older.clone());
        store.put_manifest(&manifest).unwrap();
        named(newer);
        assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
        key.sign(&mut manifest);
        store.put_manifest(&manifest).unwrap();
        assert_eq!(*read().unwrap(), *b"one");
        // Signed, but announced in another stream: under the name of this policy it does not count.
        let path = manifest_file(folder.path(), &one);
        manifest.stream = caudata_proto::registry::StreamName::new("other").unwrap();
        key.sign(&mut manifest);
        fs::write(&path, manifest.to_bytes()).unwrap();
        assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
        fs::write(&path, b"no manifest").unwrap();
        assert!(matches!(read(), Err(DeployError::NotSigned { .. })));
        // A folder that was written before streams were told apart.
        manifest.stream = caudata_proto::registry::StreamName::new("s").unwrap();
        key.sign(&mut manifest);
        fs::remove_file(&path).unwrap();
        fs::write(older, manifest.to_bytes()).unwrap();
        assert_eq!(*read().unwrap(), *b"one");
    }

    #[test]
    fn announcements_that_no_policy_needs_are_removed_although_its_bytes_are() {
        let folder = tempfile::tempdir().unwrap();
        let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.put(&policy(b"one"), b"one").unwrap();
        let announcements = || -> Vec<PathBuf> {
            let entries = fs::read_dir(folder.path().join("blobs")).unwrap();
            let paths = entries.map(|entry| entry.unwrap().path());
            let mut paths: Vec<_> = paths.filter(|p| p.extension().unwrap() != "onnx").collect();
            paths.sort();
            paths
        };
        // The same bytes under one number after the other, as a robot gets them whose operators go back again and again.
        for version in 1..10 {
            let of = |version| PolicyRef {
                version,
                ..policy(b"one")
            };
            let manifest = announced(&of(version), &key);
            fs::write(
                older_manifest_file(folder.path(), &of(version)),
                manifest.to_bytes(),
            )
            .unwrap();
            store.put_manifest(&manifest).unwrap();
            store.update(|s| s.adopt(of(version))).unwrap();
            if version == 1 {
                store.update(|s| s.confirm(of(1).sha256)).unwrap();
            }
            let mut needed: Vec<PathBuf> = [1, version]
                .into_iter()
                .flat_map(|v| {
                    [manifest_file, older_manifest_file].map(|f| f(folder.path(), &of(v)))
                })
                .collect();
            needed.sort();
            needed.dedup();
            assert_eq!(announcements(), needed, "{version}");
        }
    }

    /// The announcement of `policy`, signed by `key`.
    fn announced(policy: &PolicyRef, key: &caudata_signing::ReleaseKey) -> Manifest {
        let mut manifest = Manifest {
            stream: caudata_proto::registry::StreamName::new(&policy.stream).unwrap(),
            version: policy.version,
            sha256: policy.sha256.0,
            size: 3,
            created_unix_ms: 5,
            run_id: "r".into(),
            contract_hash: [2; 32],
            robot_name: "polymander".into(),
            robot_hash: [3; 32],
            env_steps: 9,
            training_commit: String::new(),
            config_hash: String::new(),
            evaluation_json: None,
            reverts_to: None,
            signatures: Vec::new(),
        };
        key.sign(&mut manifest);
        manifest
    }

    #[test]
    fn fault_29_a_power_cut_at_any_write_leaves_every_policy_with_its_own_signature() {
        let key = caudata_signing::ReleaseKey::from_seed("release", &[7; 32]);
        let trust = Trust::parse(&key.trust_file()).unwrap();
        let take = |store: &mut PolicyStore, policy: &PolicyRef| {
            store.put(policy, b"one").unwrap();
            store.put_manifest(&announced(policy, &key)).unwrap();
            store.update(|s| s.adopt(policy.clone())).unwrap();
        };
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("state");
        let one = policy(b"one");
        let mut store = PolicyStore::open(&root).unwrap();
        take(&mut store, &one);
        store.update(|s| s.confirm(one.sha256)).unwrap();
        drop(store);
        // The same bytes under the same number, released into another stream.
        let same = PolicyRef {
            stream: "release/s".to_owned(),
            ..one.clone()
        };
        let disk = Arc::new(Rehearsal::new(&root).unwrap());
        let mut store = PolicyStore::open_on(disk.clone(), &root).unwrap();
        let first = disk.steps();
        take(&mut store, &same);
        let mut found = Vec::new();
        for step in first..=disk.steps() {
            let below = folder.path().join(format!("cuts-{step}"));
            for left in disk.cut(step, &below).unwrap() {
                let state = PolicyStore::open(&left).unwrap().state().clone();
                for policy in state.on_disk() {
                    let read = read_policy(&left, &policy, Some(&trust));
                    assert_eq!(*read.unwrap(), *b"one", "{policy} cut after {step}");
                }
                found.push(state.active);
            }
            fs::remove_dir_all(&below).unwrap();
        }
        assert!(found.contains(&Some(one)) && found.contains(&Some(same)));
    }

    #[test]
    fn fault_23_a_trust_file_that_is_older_than_one_of_before_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = Path::new("trust.toml");
        let mut store = PolicyStore::open(folder.path()).unwrap();
        store.trust(path, 1).unwrap();
        store.trust(path, 3).unwrap();
        store.trust(path, 3).unwrap();
        // Also after a restart, whichever copy of the state survives.
        for name in COPIES {
            let other = tempfile::tempdir().unwrap();
            fs::copy(folder.path().join(name), other.path().join(name)).unwrap();
            let mut store = PolicyStore::open(other.path()).unwrap();
            let error = store.trust(path, 2).unwrap_err();
            assert_eq!(
                error.to_string(),
                "trust file trust.toml: version 2 is in force, and on this robot version 3 was: put the newer files back"
            );
            assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::BadInput);
            store.trust(path, 4).unwrap();
        }
    }

    #[test]
    fn fault_30_a_disk_that_takes_nothing_does_not_keep_a_robot_from_its_trust_file() {
        let folder = tempfile::tempdir().unwrap();
        drop(walked(folder.path()));
        let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
        let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
        disk.fail_writes_at(disk.steps(), 28);
        store.trust(Path::new("t"), 2).unwrap();
        assert_eq!(store.state().trust_version, 0, "it is not promised");
        disk.heal();
        store.trust(Path::new("t"), 2).unwrap();
        assert_eq!(found(folder.path()).trust_version, 2);
    }

    #[test]
    fn fault_30_a_trust_version_that_could_not_be_written_comes_with_the_next_change() {
        for step in 0.. {
            let folder = tempfile::tempdir().unwrap();
            drop(walked(folder.path()));
            let disk = Arc::new(Rehearsal::new(folder.path()).unwrap());
            let mut store = PolicyStore::open_on(disk.clone(), folder.path()).unwrap();
            disk.fail_writes_at(disk.steps() + step, 28);
            store.trust(Path::new("t"), 2).unwrap();
            disk.heal();
            if store.state().trust_version == 2 {
                assert!(step > 3, "it has few steps");
                break;
            }
            store.update(|s| s.confirm(policy(b"two").sha256)).unwrap();
            // In each copy: also where the first one had it and the second one had not.
            for name in COPIES {
                let state = read_copy(&folder.path().join(name)).unwrap().unwrap();
                assert_eq!(state.trust_version, 2, "{name} at {step}");
            }
        }
    }

    #[test]
    fn fault_23_the_first_trust_file_is_not_written_down_and_a_later_one_cannot_be_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = walked(folder.path());
        store.trust(Path::new("t"), 1).unwrap();
        store.update(|s| s.confirm(policy(b"two").sha256)).unwrap();
        let text = fs::read_to_string(folder.path().join(COPIES[0])).unwrap();
        assert!(
            !text.contains("trust_version"),
            "the program before reads it: {text}"
        );
        check_without_trust(store.state(), folder.path()).unwrap();
        store.trust(Path::new("t"), 2).unwrap();
        let error = check_without_trust(&found(folder.path()), Path::new("state")).unwrap_err();
        assert_eq!(
            error.to_string(),
            "robot state state: trust file version 2 was in force on this robot and none is given: give it with --trust"
        );
        assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::BadInput);
    }
}
