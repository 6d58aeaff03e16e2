//! The robot's folder: `state.json` with its copy `state.copy.json`, `blobs/<sha256>.onnx`, and beside each
//! of these its signed announcement, `blobs/<sha256>.<version>.<stream>.manifest`, where the stream is the
//! first half of its name's SHA-256. What is read from it is checked as if it came from outside.

mod state_file;

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_durable::{self as durable, Disk, OsDisk};
use caudata_policy::MAX_FILE_BYTES;
use caudata_proto::checks::Check;
use caudata_proto::registry::Manifest;
use caudata_signing::Trust;
use sha2::{Digest, Sha256};
use state_file::{COPIES, encode, read_beginning, read_copy, read_state};

use crate::DeployError;
use crate::state::{Decision, OFFER, Offer, PolicyRef, RobotState, Sha256Digest};

/// Damaged copies of one state file that are kept.
const ASIDE_MAX: u32 = 16;
/// The state and the policies on disk. Every change is on the disk before it counts.
#[derive(Debug)]
pub struct PolicyStore {
    disk: Arc<dyn Disk>,
    folder: PathBuf,
    state: RobotState,
    /// The state was lost.
    torn: bool,
    /// Version of the trust file that this process goes by, 0 without one. Every state that is written says
    /// it: one that could not be written down at once is then not forgotten, nor written over where one of
    /// the two copies has it already.
    trust_version: u64,
}

impl PolicyStore {
    /// Opens the folder, making it where it is absent.
    ///
    /// # Errors
    /// [`DeployError::StateDamaged`] where `state.json` cannot be understood (it then says nothing about what
    /// may run, so nothing does), [`DeployError::Folder`] and [`DeployError::Durable`] where the disk
    /// refuses.
    pub fn open(folder: &Path) -> Result<Self, DeployError> {
        Self::open_on(Arc::new(OsDisk), folder)
    }

    /// [`PolicyStore::open`] on a disk that may be a rehearsed one.
    ///
    /// # Errors
    /// As [`PolicyStore::open`].
    pub fn open_on(disk: Arc<dyn Disk>, folder: &Path) -> Result<Self, DeployError> {
        let blobs = folder.join("blobs");
        fs::create_dir_all(&blobs).map_err(DeployError::folder(&blobs))?;
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

    /// Opens the folder although no copy of the state can be read: nothing is known, so that nothing may be
    /// taken until [`PolicyStore::recover`] said what is too old. The damaged copies are kept aside for a
    /// person.
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

    /// Begins a new state after a server proved, freshly, that `stream` is at `floor`: nothing older is
    /// taken, and no trust file older than the one of `trust_version`, by which it was proved. Each damaged
    /// copy is kept aside and then replaced: at no time is there a folder without any, which would look like
    /// that of a robot that never had a state.
    ///
    /// # Errors
    /// [`DeployError::Durable`], [`DeployError::Folder`]; it is then as torn as before, here. On the disk one
    /// copy may be the new one already: the next start goes on from it.
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

    /// Copies the damaged file at `path`, of one that is too large the beginning, to where a person finds it:
    /// beside what was damaged before. Past [`ASIDE_MAX`] of them the newest gives way.
    fn keep_aside(&self, path: &Path) -> Result<(), DeployError> {
        let bytes = read_beginning(path)?;
        let aside = (1..=ASIDE_MAX).map(|number| {
            let mut aside = path.as_os_str().to_owned();
            aside.push(match number {
                1 => ".damaged".to_owned(),
                number => format!(".damaged-{number}"),
            });
            PathBuf::from(aside)
        });
        let mut last = path.to_owned();
        for aside in aside {
            match fs::exists(&aside) {
                // Kept by an attempt that was cut short.
                Ok(true) if read_beginning(&aside)? == bytes => return Ok(()),
                Ok(false) => return Ok(durable::replace_on(&*self.disk, &aside, &bytes)?),
                _ => last = aside,
            }
        }
        Ok(durable::replace_on(&*self.disk, &last, &bytes)?)
    }

    /// The trust file at `path`, of which `version` is in force, is what this robot goes by: from now on no
    /// older one is.
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
            // A card that takes nothing more must not keep a robot from running what is on it. The next
            // change says it again.
            tracing::error!(%error, version, "cannot write down which trust file is in force");
        }
        Ok(())
    }

    /// What to do about `offered` on the robot model with hash `robot`.
    pub fn decide(&self, offered: &PolicyRef, robot: Sha256Digest) -> Decision {
        let offer = Offer { state: &self.state, lost: self.torn, policy: offered, robot };
        offer.decide(OFFER)
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
        let path = manifest_file(&self.folder, &PolicyRef::from(manifest));
        Ok(durable::replace_on(&*self.disk, &path, &manifest.to_bytes())?)
    }

    /// [`read_policy`] of this folder.
    ///
    /// # Errors
    /// As [`read_policy`].
    pub fn get(&self, policy: &PolicyRef, trust: Option<&Trust>) -> Result<Arc<[u8]>, DeployError> {
        read_policy(&self.folder, policy, trust)
    }

    /// Failing here costs nothing but space. Of announcements only those of what is on the disk stay: the
    /// same bytes can be announced in many streams and under many numbers.
    fn remove_unneeded(&self) {
        let on_disk = self.state.on_disk();
        let announced: Vec<PathBuf> =
            on_disk.iter().map(|policy| manifest_file(&self.folder, policy)).collect();
        let Ok(entries) = fs::read_dir(self.folder.join("blobs")) else { return };
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

/// A policy as it was found in the robot's folder.
pub struct Stored<'a> {
    folder: &'a Path,
    policy: &'a PolicyRef,
    trust: Option<&'a Trust>,
    path: PathBuf,
    bytes: Vec<u8>,
}

/// Looks at a policy in the robot's folder.
pub type StoredCheck = fn(&Stored<'_>) -> Result<(), DeployError>;

/// What a policy in the robot's folder must be.
pub const STORED: &[Check<StoredCheck>] = &[
    // The bytes on the disk are those that were put there.
    Check::new("stored hash", |stored| {
        let found = Sha256Digest(Sha256::digest(&stored.bytes).into());
        match found == stored.policy.sha256 {
            true => Ok(()),
            false => Err(DeployError::BlobDamaged { path: stored.path.clone() }),
        }
    }),
    // The announcement on the disk is this policy's, and signed.
    Check::new("stored signature", |stored| {
        let Some(trust) = stored.trust else { return Ok(()) };
        let path = manifest_file(stored.folder, stored.policy);
        let manifest = Manifest::from_bytes(&read_bounded(&path, MANIFEST_BYTES_MAX)?);
        let signed = manifest.is_ok_and(|manifest| {
            PolicyRef::from(&manifest) == *stored.policy && trust.check(&manifest).is_ok()
        });
        if signed { Ok(()) } else { Err(DeployError::NotSigned { path }) }
    }),
];

/// The bytes of a policy, as they were put into the robot's folder. With `trust`, keys of it must have signed
/// the announcement that was kept beside them.
///
/// # Errors
/// [`DeployError::BlobMissing`], also for a missing announcement; [`DeployError::BlobDamaged`] where the
/// bytes have another hash, [`DeployError::NotSigned`] where nobody trusted announced them as this policy.
pub fn read_policy(
    folder: &Path,
    policy: &PolicyRef,
    trust: Option<&Trust>,
) -> Result<Arc<[u8]>, DeployError> {
    read_policy_by(STORED, folder, policy, trust)
}

/// [`read_policy`] by these checks.
fn read_policy_by(
    checks: &[Check<StoredCheck>],
    folder: &Path,
    policy: &PolicyRef,
    trust: Option<&Trust>,
) -> Result<Arc<[u8]>, DeployError> {
    let path = blob(folder, policy.sha256);
    let stored =
        Stored { folder, policy, trust, bytes: read_bounded(&path, MAX_FILE_BYTES as u64)?, path };
    checks.iter().try_for_each(|check| (check.refuse)(&stored))?;
    Ok(stored.bytes.into())
}

/// The bytes of a file of the robot's folder; one that is too large is damaged.
pub(crate) fn read_bounded(path: &Path, bytes_max: u64) -> Result<Vec<u8>, DeployError> {
    durable::read_at_most(path, bytes_max).map_err(|source| match source.kind() {
        ErrorKind::FileTooLarge => DeployError::BlobDamaged { path: path.to_owned() },
        _ => DeployError::BlobMissing { path: path.to_owned(), source },
    })
}

fn blob(folder: &Path, sha256: Sha256Digest) -> PathBuf {
    folder.join("blobs").join(format!("{sha256}.onnx"))
}

/// Where the announcement of `policy` lies. By its stream too: the same bytes may bear the same version in
/// two streams, and neither announcement may take the place of the other, whenever the power goes.
pub(crate) fn manifest_file(folder: &Path, policy: &PolicyRef) -> PathBuf {
    let stream = Sha256Digest(Sha256::digest(&policy.stream).into()).to_string();
    let (sha256, version) = (policy.sha256, policy.version);
    let name = format!("{sha256}.{version}.{}.{MANIFEST}", &stream[..32]);
    folder.join("blobs").join(name)
}

/// Refuses the trust file at `path`, of which `version` is in force, where a newer one was in force on the
/// robot of `state`.
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

/// Refuses to go without any trust file where one was in force on the robot of `state`, which is kept in
/// `folder`: whoever left it out would take what nobody signed.
///
/// # Errors
/// [`DeployError::TrustLeftOut`].
pub fn check_without_trust(state: &RobotState, folder: &Path) -> Result<(), DeployError> {
    if state.takes_trust(0) {
        return Ok(());
    }
    Err(DeployError::TrustLeftOut { folder: folder.to_owned(), seen: state.trust_version })
}

#[cfg(test)]
mod tests;
