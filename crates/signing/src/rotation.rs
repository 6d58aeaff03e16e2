//! How a robot comes to trust other keys: each trust file may have a successor beside it, numbered, signed by
//! the root keys of the one before and by its own. Whoever stole an old root key can name no successor any
//! more once a newer file is in force, and a release key never can.
//!
//! `trust.toml` (version 1), `trust.toml.2` and `trust.toml.2.sig`, `trust.toml.3`, … The exact bytes of a
//! file are signed. A signature file has one line for each signature: the key's name, a space, 128
//! hexadecimal digits.

use std::io::Write;
use std::path::{Path, PathBuf};

use caudata_proto::hex::hex;
use ed25519_dalek::Signer;

use crate::error::{SigningError, content, file_error, from_hex, read_small};
use crate::key::ReleaseKey;
use crate::trust::Trust;

/// First bytes of what is signed.
const TRUST_DOMAIN: &[u8] = b"caudata.trust.v1\0";
/// Successors that are followed.
const CHAIN_MAX: usize = 1024;
/// Why a trust file does not follow on another.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum NoSuccessor {
    /// It does not read.
    #[error("{0}")]
    Content(String),
    /// It is not the next one.
    #[error("it is version {found}, the one after {from} is {}", from.saturating_add(1))]
    OutOfTurn { from: u64, found: u64 },
    /// Keys that may say so did not sign it.
    #[error("{whose} root keys signed it {valid} times, {needed} are needed")]
    Unsigned { whose: &'static str, valid: usize, needed: usize },
}

/// A signature over a trust file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrustSignature {
    /// Name of the root key.
    pub key_id: String,
    /// Ed25519.
    pub signature: [u8; 64],
}

fn signed(text: &str) -> Vec<u8> {
    [TRUST_DOMAIN, text.as_bytes()].concat()
}

impl ReleaseKey {
    /// Signs a trust file.
    pub fn sign_trust(&self, text: &str) -> TrustSignature {
        TrustSignature {
            key_id: self.id.clone(),
            signature: self.key.sign(&signed(text)).to_bytes(),
        }
    }
}

impl Trust {
    /// The trust file `text`, where it is the next one after this.
    pub fn successor(
        &self,
        text: &str,
        signatures: &[TrustSignature],
    ) -> Result<Self, NoSuccessor> {
        let next = Self::parse(text).map_err(NoSuccessor::Content)?;
        if Some(next.version) != self.version.checked_add(1) {
            return Err(NoSuccessor::OutOfTurn { from: self.version, found: next.version });
        }
        let bytes = signed(text);
        // By the old ones, who hand over, and by the new ones, who show that they hold their keys.
        for (whose, trust) in [("the old", self), ("its own", &next)] {
            let by = |(id, key): &&(String, ed25519_dalek::VerifyingKey)| {
                signatures.iter().any(|s| {
                    let form = ed25519_dalek::Signature::from_bytes(&s.signature);
                    s.key_id == *id && key.verify_strict(&bytes, &form).is_ok()
                })
            };
            let valid = trust.root_keys.iter().filter(by).count();
            let needed = trust.root_threshold;
            if trust.root_keys.is_empty() || valid < needed {
                return Err(NoSuccessor::Unsigned { whose, valid, needed });
            }
        }
        Ok(next)
    }

    /// The trust file after which `version` is the next one: the first one at `path`, or one of its
    /// successors. Whoever signs `version` must be one of its root keys.
    ///
    /// # Errors
    /// [`SigningError`], also where the chain does not reach that far.
    pub fn before(path: &Path, version: u64) -> Result<Self, SigningError> {
        let mut trust = Self::first(path)?;
        let from = trust.version;
        for _ in 0..CHAIN_MAX {
            if trust.version.checked_add(1) == Some(version) {
                return Ok(trust);
            }
            match trust.next(path)? {
                Some(next) => trust = next,
                None => break,
            }
        }
        let to = trust.version;
        let reason = format!(
            "it and its successors go from version {from} to {to}: {version} is not the next of any"
        );
        Err(content(path, reason))
    }

    /// Whether `key` is, under its name, one of the root keys.
    pub fn has_root(&self, key: &ReleaseKey) -> bool {
        let public = key.key.verifying_key();
        self.root_keys.iter().any(|(id, known)| *id == key.id && *known == public)
    }

    /// The successor beside `path`; `None` where no file is there. One that is there and does not follow is
    /// an error: a robot that passed over it would go on trusting what was given up.
    fn next(&self, path: &Path) -> Result<Option<Self>, SigningError> {
        let Some(next) = self.version.checked_add(1) else { return Ok(None) };
        let file = successor_path(path, next);
        if !is_there(&file)? {
            self.nothing_beyond(path, next)?;
            return Ok(None);
        }
        let text = read_small(&file)?;
        let signatures = read_signatures(&file)?;
        let next = self.successor(&text, &signatures).map_err(|why| content(&file, why))?;
        Ok(Some(next))
    }

    /// Follows the successors beside `path`, as far as they go.
    pub(crate) fn newest(mut self, path: &Path) -> Result<Self, SigningError> {
        // Once more than there may be successors: only where nothing is behind the last one was it the last.
        for _ in 0..=CHAIN_MAX {
            match self.next(path)? {
                Some(next) => self = next,
                None => return Ok(self),
            }
        }
        let reason = format!(
            "more than {CHAIN_MAX} trust files follow it: give robots a newer one to begin with"
        );
        Err(content(path, reason))
    }
}

impl Trust {
    /// Refuses a successor beyond the missing `next`: a file that was lost must not bring back the keys that
    /// it gave up.
    fn nothing_beyond(&self, path: &Path, next: u64) -> Result<(), SigningError> {
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let first = path.file_name().unwrap_or_default().to_string_lossy();
        for entry in std::fs::read_dir(folder).map_err(file_error(folder))? {
            let name = entry.map_err(file_error(folder))?.file_name();
            let name = name.to_string_lossy();
            let version = name
                .strip_prefix(first.as_ref())
                .and_then(|rest| rest.strip_prefix('.'))
                .and_then(|digits| digits.parse::<u64>().ok());
            if version.is_some_and(|version| version > next) {
                let reason =
                    format!("{name} lies beside it and version {next} does not: put it back");
                return Err(content(path, reason));
            }
        }
        Ok(())
    }
}

/// Whether there is anything at `path`. A card that fails and a link that leads nowhere are not "nothing".
fn is_there(path: &Path) -> Result<bool, SigningError> {
    match std::fs::symlink_metadata(path) {
        Ok(_) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(file_error(path)(error)),
    }
}

/// Where the trust file of `version` is looked for, beside the first one.
pub fn successor_path(first: &Path, version: u64) -> PathBuf {
    let mut name = first.as_os_str().to_owned();
    name.push(format!(".{version}"));
    name.into()
}

fn signatures_path(file: &Path) -> PathBuf {
    let mut name = file.as_os_str().to_owned();
    name.push(".sig");
    name.into()
}

/// The signatures over the trust file `file`; none where there is no file of them.
pub fn read_signatures(file: &Path) -> Result<Vec<TrustSignature>, SigningError> {
    let path = signatures_path(file);
    if !is_there(&path)? {
        return Ok(Vec::new());
    }
    let text = read_small(&path)?;
    let parse = |line: &str| {
        let (key_id, digits) = line.rsplit_once(' ')?;
        let (first, second) = digits.split_at_checked(64)?;
        let halves = [from_hex(first)?, from_hex(second)?];
        Some(TrustSignature {
            key_id: key_id.to_owned(),
            signature: std::array::from_fn(|i| halves[i / 32][i % 32]),
        })
    };
    let lines = text.lines().enumerate();
    lines
        .map(|(number, line)| {
            let wrong = || format!("line {} is not a name and 128 hexadecimal digits", number + 1);
            parse(line).ok_or_else(|| content(&path, wrong()))
        })
        .collect()
}

/// Adds `signature` to those over `file`.
///
/// # Errors
/// [`SigningError::File`].
pub fn add_signature(file: &Path, signature: &TrustSignature) -> Result<(), SigningError> {
    let path = signatures_path(file);
    let line = format!("{} {}\n", signature.key_id, hex(&signature.signature));
    std::fs::OpenOptions::new()
        .append(true)
        .create(true)
        .open(&path)
        .and_then(|mut file| file.write_all(line.as_bytes()))
        .map_err(file_error(&path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trust::tests::key;

    /// Release key `release`, root keys `roots`, of which `threshold` must sign.
    fn file(version: u64, release: u8, roots: &[u8], threshold: usize) -> String {
        let mut text = key(release).trust_file().replacen(
            "threshold = 1\n",
            &format!("threshold = 1\nversion = {version}\nroot_threshold = {threshold}\n"),
            1,
        );
        for root in roots {
            text += "\n";
            text += &key(*root).trust_lines("root_key");
        }
        text
    }

    fn by(text: &str, roots: &[u8]) -> Vec<TrustSignature> {
        roots.iter().map(|n| key(*n).sign_trust(text)).collect()
    }

    fn unsigned(whose: &'static str, valid: usize, needed: usize) -> Option<NoSuccessor> {
        Some(NoSuccessor::Unsigned { whose, valid, needed })
    }

    #[test]
    fn fault_23_from_root_key_1_to_2_to_3_and_what_the_old_one_signs_then_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("trust.toml");
        std::fs::write(&first, file(1, 101, &[1], 1)).unwrap();
        let put = |version: u64, text: &str, roots: &[u8]| {
            let path = successor_path(&first, version);
            std::fs::write(&path, text).unwrap();
            let _ = std::fs::remove_file(signatures_path(&path));
            for signature in by(text, roots) {
                add_signature(&path, &signature).unwrap();
            }
        };
        let mut manifest = crate::trust::tests::manifest();
        key(101).sign(&mut manifest);
        assert_eq!(Trust::read(&first).unwrap().check(&manifest), Ok(()));
        // To root key 2 and release key 102.
        put(2, &file(2, 102, &[2], 1), &[1, 2]);
        let second = Trust::read(&first).unwrap();
        assert_eq!(second.version(), 2);
        assert!(second.check(&manifest).is_err(), "the old release key");
        key(102).sign(&mut manifest);
        assert_eq!(second.check(&manifest), Ok(()));
        // To root key 3, by the old root key, by a release key, and by the one that may.
        let third = file(3, 102, &[3], 1);
        for roots in [&[1, 3][..], &[102, 3]] {
            put(3, &third, roots);
            let error = Trust::read(&first).unwrap_err().to_string();
            assert!(error.contains("the old root keys signed it 0 times"), "{error}");
        }
        put(3, &third, &[2, 3]);
        assert_eq!(Trust::read(&first).unwrap().version(), 3);
        // The first file again, as the fourth, by the first key: neither its number nor its signature is
        // right.
        put(4, &file(1, 101, &[1], 1), &[1]);
        assert!(Trust::read(&first).is_err());
        put(4, &file(4, 101, &[1], 1), &[1]);
        assert!(Trust::read(&first).is_err());
    }

    #[test]
    fn fault_23_a_successor_needs_old_and_new_keys_its_turn_and_its_exact_bytes() {
        let trust = Trust::parse(&file(1, 101, &[1, 2, 3], 2)).unwrap();
        let text = file(2, 101, &[4, 5], 2);
        let why =
            |text: &str, signatures: &[TrustSignature]| trust.successor(text, signatures).err();
        assert_eq!(why(&text, &by(&text, &[1, 3, 4, 5])), None);
        assert_eq!(why(&text, &by(&text, &[1, 4, 5])), unsigned("the old", 1, 2));
        // The same key twice is one key, and a signature counts for the key that made it only.
        let twice = by(&text, &[1, 1, 4, 5]);
        assert_eq!(why(&text, &twice), unsigned("the old", 1, 2));
        let mut renamed = by(&text, &[1, 1, 4, 5]);
        renamed[1].key_id = "k2".into();
        assert_eq!(why(&text, &renamed), unsigned("the old", 1, 2));
        assert_eq!(why(&text, &by(&text, &[1, 2, 4])), unsigned("its own", 1, 2));
        // Another text of the same meaning was not signed.
        let spaced = format!("{text}\n");
        assert_eq!(why(&spaced, &by(&text, &[1, 2, 4, 5])), unsigned("the old", 0, 2));
        for version in [0, 1, 3, u64::MAX] {
            let text = file(version, 101, &[4, 5], 2);
            let refused = why(&text, &by(&text, &[1, 2, 4, 5]));
            assert!(
                matches!(refused, Some(NoSuccessor::OutOfTurn { .. } | NoSuccessor::Content(_))),
                "{version}: {refused:?}"
            );
        }
        // Without root keys there is no successor, whoever signs it; and none that could have no successor
        // itself.
        let plain = Trust::parse(&key(101).trust_file()).unwrap();
        assert_eq!(plain.version(), 1);
        let refused = plain.successor(&text, &by(&text, &[101, 4, 5])).err();
        assert_eq!(refused, unsigned("the old", 0, 1));
        let last =
            key(101).trust_file().replacen("threshold = 1\n", "threshold = 1\nversion = 2\n", 1);
        assert_eq!(why(&last, &by(&last, &[1, 2])), unsigned("its own", 0, 1));
    }

    #[test]
    fn fault_23_a_successor_that_was_lost_or_cannot_be_read_does_not_bring_back_the_first() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("trust.toml");
        std::fs::write(&first, file(1, 101, &[1], 1)).unwrap();
        for version in [2, 3] {
            let path = successor_path(&first, version);
            let text = file(version, 101, &[1], 1);
            std::fs::write(&path, &text).unwrap();
            add_signature(&path, &key(1).sign_trust(&text)).unwrap();
        }
        assert_eq!(Trust::read(&first).unwrap().version(), 3);
        std::fs::remove_file(successor_path(&first, 2)).unwrap();
        let error = Trust::read(&first).unwrap_err().to_string();
        assert!(error.contains("trust.toml.3 lies beside it and version 2 does not"), "{error}");
        // A link that leads nowhere is not "no file".
        std::os::unix::fs::symlink("nowhere", successor_path(&first, 2)).unwrap();
        let error = Trust::read(&first).unwrap_err().to_string();
        assert!(error.contains("trust.toml.2"), "{error}");
        // Other files that begin like it are none of its successors.
        for version in [2, 3] {
            std::fs::remove_file(successor_path(&first, version)).unwrap();
        }
        for other in ["trust.toml.bak", "trust.toml.3.sig", "trust.toml3"] {
            std::fs::write(folder.path().join(other), "").unwrap();
        }
        assert_eq!(Trust::read(&first).unwrap().version(), 1);
    }

    #[test]
    fn the_file_that_another_follows_is_found_and_knows_its_root_keys() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("trust.toml");
        std::fs::write(&first, file(1, 101, &[1], 1)).unwrap();
        let path = successor_path(&first, 2);
        let text = file(2, 102, &[2], 1);
        std::fs::write(&path, &text).unwrap();
        let before = |version| Trust::before(&first, version).map(|trust| trust.version());
        // Nobody signed version 2 yet: it has a file before it, and none after it.
        assert_eq!(before(2).unwrap(), 1);
        let error = before(3).unwrap_err().to_string();
        assert!(error.contains("signed it 0 times"), "{error}");
        for root in [1, 2] {
            add_signature(&path, &key(root).sign_trust(&text)).unwrap();
        }
        assert_eq!((before(2).unwrap(), before(3).unwrap()), (1, 2));
        for version in [0, 1, 4, u64::MAX] {
            let error = before(version).unwrap_err().to_string();
            let line = format!("from version 1 to 2: {version} is not the next of any");
            assert!(error.contains(&line), "{error}");
        }
        let trust = Trust::before(&first, 3).unwrap();
        assert!(trust.has_root(&key(2)));
        // The one before, a release key, and another key under a root key's name.
        let renamed = ReleaseKey::from_seed(&key(2).id, &[77; 32]);
        for other in [key(1), key(102), renamed] {
            assert!(!trust.has_root(&other), "{}", other.id);
        }
    }

    #[test]
    fn a_chain_without_end_ends() {
        let folder = tempfile::tempdir().unwrap();
        let first = folder.path().join("trust.toml");
        std::fs::write(&first, file(1, 101, &[1], 1)).unwrap();
        for version in 2..=CHAIN_MAX as u64 + 2 {
            let path = successor_path(&first, version);
            let text = file(version, 101, &[1], 1);
            std::fs::write(&path, &text).unwrap();
            add_signature(&path, &key(1).sign_trust(&text)).unwrap();
        }
        let error = Trust::read(&first).unwrap_err().to_string();
        assert!(error.contains("more than 1024"), "{error}");
        // As many as are followed, of which the last one is also the last that can be put there.
        let last = CHAIN_MAX as u64 + 1;
        std::fs::remove_file(successor_path(&first, last + 1)).unwrap();
        assert_eq!(Trust::read(&first).unwrap().version(), last);
        assert_eq!(Trust::before(&first, last).unwrap().version(), last - 1);
        assert!(Trust::before(&first, last + 1).is_err());
        // Spoilt signatures are said so.
        std::fs::write(folder.path().join("trust.toml.2.sig"), "k1 00\n").unwrap();
        let error = Trust::read(&first).unwrap_err().to_string();
        assert!(error.contains("line 1 is not a name"), "{error}");
    }
}
