//! One published version as it stands on disk: a small JSON file beside the blobs.

use caudata_proto::registry::{Manifest, RegistryError};
use caudata_proto::wire::registry as wire;
use serde::{Deserialize, Serialize};

use crate::store::hex;

/// Format of the record files; a store with a newer one is refused rather than misread.
pub const RECORD_FORMAT: u32 = 1;

/// One version: the manifest, and the change counter at which it was published.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Store-wide change counter at publication; grows by one with each version.
    pub generation: u64,
    /// What was published.
    pub manifest: Manifest,
}

/// Why a record file could not be read.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// Not the JSON this server writes.
    #[error("not a record: {0}")]
    Json(#[from] serde_json::Error),
    /// Written by another version of the server.
    #[error(
        "record format {found} is unknown, this server writes {RECORD_FORMAT}; use a newer server"
    )]
    Format {
        /// The format found.
        found: u32,
    },
    /// A hash that is not hexadecimal.
    #[error("`{field}` is not hexadecimal")]
    Hex {
        /// Which field.
        field: &'static str,
    },
    /// A word that is none of those it can be.
    #[error("`{word}` is not a state of a robot's report")]
    Word {
        /// The word.
        word: String,
    },
    /// A value that no published manifest can have.
    #[error(transparent)]
    Manifest(#[from] RegistryError),
}

impl Record {
    /// The file's content.
    ///
    /// # Errors
    /// [`RecordError::Json`], which would be a bug.
    pub fn to_json(&self) -> Result<Vec<u8>, RecordError> {
        Ok(serde_json::to_vec_pretty(&OnDisk::from(self))?)
    }

    /// Reads a file's content, with the same checks as a manifest from the network.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn from_json(bytes: &[u8]) -> Result<Self, RecordError> {
        let on_disk: OnDisk = serde_json::from_slice(bytes)?;
        if on_disk.format != RECORD_FORMAT {
            return Err(RecordError::Format {
                found: on_disk.format,
            });
        }
        on_disk.check()
    }
}

/// The JSON form: hashes as hexadecimal, so that a person can follow them to the blob.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OnDisk {
    format: u32,
    generation: u64,
    stream: String,
    version: u64,
    sha256: String,
    size: u64,
    created_unix_ms: u64,
    run_id: String,
    contract_hash: String,
    robot_name: String,
    robot_hash: String,
    env_steps: u64,
    training_commit: String,
    config_hash: String,
    evaluation_json: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    reverts_to: Option<u64>,
    signatures: Vec<(String, String)>,
}

impl From<&Record> for OnDisk {
    fn from(record: &Record) -> Self {
        let manifest = record.manifest.clone();
        Self {
            format: RECORD_FORMAT,
            generation: record.generation,
            stream: manifest.stream.to_string(),
            version: manifest.version,
            sha256: hex(&manifest.sha256),
            size: manifest.size,
            created_unix_ms: manifest.created_unix_ms,
            run_id: manifest.run_id,
            contract_hash: hex(&manifest.contract_hash),
            robot_name: manifest.robot_name,
            robot_hash: hex(&manifest.robot_hash),
            env_steps: manifest.env_steps,
            training_commit: manifest.training_commit,
            config_hash: manifest.config_hash,
            evaluation_json: manifest.evaluation_json.unwrap_or_default(),
            reverts_to: manifest.reverts_to,
            signatures: manifest
                .signatures
                .into_iter()
                .map(|signature| (signature.key_id, hex(&signature.signature)))
                .collect(),
        }
    }
}

impl OnDisk {
    fn check(self) -> Result<Record, RecordError> {
        let signatures = self
            .signatures
            .into_iter()
            .map(|(key_id, signature)| {
                Ok(wire::Signature {
                    key_id,
                    signature: from_hex("signatures", &signature)?,
                })
            })
            .collect::<Result<_, RecordError>>()?;
        let manifest = wire::Manifest {
            stream: self.stream,
            version: self.version,
            sha256: from_hex("sha256", &self.sha256)?,
            size: self.size,
            created_unix_ms: self.created_unix_ms,
            run_id: self.run_id,
            contract_hash: from_hex("contract_hash", &self.contract_hash)?,
            robot_name: self.robot_name,
            robot_hash: from_hex("robot_hash", &self.robot_hash)?,
            env_steps: self.env_steps,
            training_commit: self.training_commit,
            config_hash: self.config_hash,
            evaluation_json: self.evaluation_json,
            reverts_to: self.reverts_to,
            signatures,
        };
        Ok(Record {
            generation: self.generation,
            manifest: manifest.try_into()?,
        })
    }
}

/// A SHA-256 of 64 hexadecimal digits.
pub fn from_hex_32(field: &'static str, text: &str) -> Result<[u8; 32], RecordError> {
    let bytes = from_hex(field, text)?;
    bytes.try_into().map_err(|_| RecordError::Hex { field })
}

fn from_hex(field: &'static str, text: &str) -> Result<Vec<u8>, RecordError> {
    let digits = text.as_bytes();
    let pairs = digits.chunks_exact(2);
    if !pairs.remainder().is_empty() {
        return Err(RecordError::Hex { field });
    }
    pairs
        .map(|pair| {
            let pair = std::str::from_utf8(pair).map_err(|_| RecordError::Hex { field })?;
            u8::from_str_radix(pair, 16).map_err(|_| RecordError::Hex { field })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::manifest;

    #[test]
    fn a_record_comes_back_equal_and_shows_its_hash_in_hexadecimal() {
        let record = Record {
            generation: 7,
            manifest: manifest("polymander/flat", 3, b"bytes"),
        };
        let text = record.to_json().unwrap();
        assert_eq!(Record::from_json(&text).unwrap(), record);
        let text = String::from_utf8(text).unwrap();
        assert!(text.contains(&hex(&record.manifest.sha256)), "{text}");
    }

    #[test]
    fn a_record_of_another_format_or_with_a_torn_end_is_refused() {
        let record = Record {
            generation: 1,
            manifest: manifest("s", 1, b"x"),
        };
        let text = String::from_utf8(record.to_json().unwrap()).unwrap();
        let newer = text.replace("\"format\": 1", "\"format\": 2");
        assert!(matches!(
            Record::from_json(newer.as_bytes()),
            Err(RecordError::Format { found: 2 })
        ));
        for end in 0..text.len() {
            assert!(Record::from_json(&text.as_bytes()[..end]).is_err());
        }
        let bad = text.replace(&hex(&record.manifest.robot_hash), "zz");
        assert!(matches!(
            Record::from_json(bad.as_bytes()),
            Err(RecordError::Hex {
                field: "robot_hash"
            })
        ));
    }
}
