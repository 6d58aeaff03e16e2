//! Keys that sign: policies, what a server says about labels, trust files.

use std::io::{Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use caudata_proto::hex::hex;
use caudata_proto::registry::{Freshness, Manifest, Signature, SignedFreshness};
use ed25519_dalek::{Signer, SigningKey};

use crate::error::{SigningError, check_private, content, file_error, from_hex, read_small};

/// `format` of a trust file.
pub const TRUST_FORMAT: &str = "caudata.trust.v1";
/// First bytes of what is signed: a signature for anything else does not count here.
const MANIFEST_DOMAIN: &[u8] = b"caudata.manifest.v1\0";
/// The same for what a server says about where a label leads.
const FRESHNESS_DOMAIN: &[u8] = b"caudata.freshness.v1\0";

/// The bytes that are signed: every field, each behind its length, in the order of the manifest.
pub fn signed_bytes(manifest: &Manifest) -> Vec<u8> {
    let mut out = MANIFEST_DOMAIN.to_vec();
    let mut put = |field: &[u8]| {
        out.extend_from_slice(&(field.len() as u64).to_le_bytes());
        out.extend_from_slice(field);
    };
    put(manifest.stream.to_string().as_bytes());
    put(&manifest.version.to_le_bytes());
    put(&manifest.sha256);
    put(&manifest.size.to_le_bytes());
    put(&manifest.created_unix_ms.to_le_bytes());
    put(manifest.run_id.as_bytes());
    put(&manifest.contract_hash);
    put(manifest.robot_name.as_bytes());
    put(&manifest.robot_hash);
    put(&manifest.env_steps.to_le_bytes());
    put(manifest.training_commit.as_bytes());
    put(manifest.config_hash.as_bytes());
    put(manifest.evaluation_json.as_deref().unwrap_or_default().as_bytes());
    // Only where it is there, so that signatures of before still count.
    if let Some(old) = manifest.reverts_to {
        put(&old.to_le_bytes());
    }
    out
}

/// The bytes that are signed to say where a label leads, the asking side's nonce first.
pub fn freshness_bytes(said: &Freshness) -> Vec<u8> {
    let mut out = FRESHNESS_DOMAIN.to_vec();
    let mut put = |field: &[u8]| {
        out.extend_from_slice(&(field.len() as u64).to_le_bytes());
        out.extend_from_slice(field);
    };
    put(&said.nonce);
    put(said.stream.as_str().as_bytes());
    put(said.label.as_str().as_bytes());
    put(&said.version.to_le_bytes());
    put(&said.sha256);
    out
}

/// The system's random source.
const RANDOM: &str = "/dev/urandom";

/// Bytes of the system's random source.
///
/// # Errors
/// Where it cannot be read.
pub fn random_bytes<const N: usize>() -> std::io::Result<[u8; N]> {
    let mut bytes = [0; N];
    std::fs::File::open(RANDOM)?.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// A key that signs.
pub struct ReleaseKey {
    pub(crate) id: String,
    pub(crate) key: SigningKey,
}

impl ReleaseKey {
    /// A new key from the system's random source.
    ///
    /// # Errors
    /// [`SigningError::File`].
    pub fn generate(id: &str) -> Result<Self, SigningError> {
        let seed = random_bytes().map_err(file_error(Path::new(RANDOM)))?;
        Ok(Self::from_seed(id, &seed))
    }

    /// The key that belongs to a seed.
    pub fn from_seed(id: &str, seed: &[u8; 32]) -> Self {
        Self { id: id.to_owned(), key: SigningKey::from_bytes(seed) }
    }

    /// Reads a key file: 64 hexadecimal digits and the key's name, which older files do not have.
    ///
    /// # Errors
    /// [`SigningError`], also where others may use the file ([`check_private`]) or the key has another name.
    pub fn read(path: &Path, id: &str) -> Result<Self, SigningError> {
        check_private(path)?;
        let text = read_small(path)?;
        let text = text.trim();
        let (seed, name) = text.split_once(' ').unwrap_or((text, id));
        let seed = from_hex(seed);
        let seed = seed.ok_or_else(|| content(path, "a key is 64 hexadecimal digits"))?;
        if name != id.trim() {
            return Err(content(path, format!("this key's name is `{name}`, not `{id}`")));
        }
        Ok(Self::from_seed(id, &seed))
    }

    /// Writes a new key file, readable by its owner only.
    ///
    /// # Errors
    /// [`SigningError::File`], also where there is a file of this name.
    pub fn write(&self, path: &Path) -> Result<(), SigningError> {
        let mut file = std::fs::OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(path)
            .map_err(file_error(path))?;
        let text = format!("{} {}\n", hex(&self.key.to_bytes()), self.id);
        file.write_all(text.as_bytes()).map_err(file_error(path))
    }

    /// A trust file that trusts this key alone.
    pub fn trust_file(&self) -> String {
        format!("format = \"{TRUST_FORMAT}\"\nthreshold = 1\n\n{}", self.trust_lines("key"))
    }

    /// The lines of a trust file by which robots take this key as a `key`, which releases policies, as a
    /// `fresh_key`, which says where labels lead, or as a `root_key`, which may name the next trust file.
    pub fn trust_lines(&self, table: &str) -> String {
        let public = hex(self.key.verifying_key().as_bytes());
        format!("[[{table}]]\nid = \"{}\"\npublic = \"{public}\"\n", self.id)
    }

    /// Says, signed, where a label leads.
    pub fn vouch(&self, said: Freshness) -> SignedFreshness {
        let signature = self.key.sign(&freshness_bytes(&said)).to_bytes().to_vec();
        let key_id = self.id.clone();
        SignedFreshness { said, signature: Signature { key_id, signature } }
    }

    /// Adds a signature to `manifest`, in place of one by the same key id.
    pub fn sign(&self, manifest: &mut Manifest) {
        let signature = self.key.sign(&signed_bytes(manifest)).to_bytes().to_vec();
        manifest.signatures.retain(|s| s.key_id != self.id);
        manifest.signatures.push(Signature { key_id: self.id.clone(), signature });
    }
}
