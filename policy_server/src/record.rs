//! One published version as it stands on disk: a small JSON file beside the blobs.

use caudata_proto::registry::Manifest;
use caudata_proto::wire::registry as wire;
use serde::{Deserialize, Serialize};

use crate::error::RecordError;
use crate::files::{seal, unseal};

/// Format of the record files; a store with a newer one is refused rather than misread. Those of format 1
/// have no checksum, and are written anew when they are found.
pub const RECORD_FORMAT: u32 = 2;

/// One version: the manifest, and the change counter at which it was published.
#[derive(Clone, Debug, PartialEq)]
pub struct Record {
    /// Store-wide change counter at publication; grows by one with each version.
    pub generation: u64,
    /// What was published.
    pub manifest: Manifest,
}

/// The JSON form: hashes as hexadecimal, so that a person can follow them to the blob.
#[derive(Serialize, Deserialize)]
struct OnDisk {
    format: u32,
    generation: u64,
    #[serde(flatten)]
    manifest: wire::Manifest,
}

#[derive(Deserialize)]
struct Format {
    format: u32,
}

impl Record {
    /// The file's content.
    ///
    /// # Errors
    /// [`RecordError::Json`], which would be a bug.
    pub fn to_json(&self) -> Result<Vec<u8>, RecordError> {
        seal(&OnDisk {
            format: RECORD_FORMAT,
            generation: self.generation,
            manifest: self.manifest.clone().into(),
        })
    }

    /// Reads a file's content, with the same checks as a manifest from the network.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn from_json(bytes: &[u8]) -> Result<Self, RecordError> {
        Ok(Self::read(bytes)?.0)
    }

    /// As [`Record::from_json`]; also whether it had a checksum.
    pub(crate) fn read(bytes: &[u8]) -> Result<(Self, bool), RecordError> {
        let (Format { format }, sealed) = unseal(bytes)?;
        match (format, sealed) {
            (1, false) | (RECORD_FORMAT, true) => {}
            (1..=RECORD_FORMAT, _) => return Err(RecordError::Checksum),
            (found, _) => return Err(RecordError::Format { found }),
        }
        let (on_disk, _) = unseal::<OnDisk>(bytes)?;
        let record = Self {
            generation: on_disk.generation,
            manifest: on_disk.manifest.try_into()?,
        };
        Ok((record, sealed))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::manifest;
    use caudata_proto::hex::hex;

    #[test]
    fn a_record_comes_back_equal_and_shows_its_hash_in_hexadecimal() {
        let record = Record {
            generation: 7,
            manifest: manifest("polymander/flat", 3, b"bytes"),
        };
        let text = record.to_json().unwrap();
        assert_eq!(Record::read(&text).unwrap(), (record.clone(), true));
        let text = String::from_utf8(text).unwrap();
        assert!(text.contains(&hex(&record.manifest.sha256)), "{text}");
        serde_json::from_str::<serde_json::Value>(&text).unwrap();
    }

    #[test]
    fn a_record_of_another_format_or_with_a_torn_end_or_a_flipped_bit_is_refused() {
        let record = Record {
            generation: 1,
            manifest: manifest("s", 1, b"x"),
        };
        let text = record.to_json().unwrap();
        for end in 0..text.len() {
            assert!(Record::from_json(&text[..end]).is_err());
        }
        for bit in 0..8 * text.len() {
            let mut flipped = text.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Record::from_json(&flipped).is_err(), "bit {bit}");
        }
        let newer = seal(&serde_json::json!({"format": 3})).unwrap();
        let error = Record::from_json(&newer).unwrap_err();
        assert!(matches!(error, RecordError::Format { found: 3 }), "{error}");
    }

    #[test]
    fn a_record_of_an_older_server_is_read() {
        let mut record = Record {
            generation: 4,
            manifest: manifest("s", 1, b"x"),
        };
        record.manifest.signatures = vec![caudata_proto::registry::Signature {
            key_id: "release-1".into(),
            signature: vec![1, 2],
        }];
        let m = &record.manifest;
        let text = serde_json::json!({
            "format": 1, "generation": 4, "stream": "s", "version": 1, "sha256": hex(&m.sha256), "size": 1,
            "created_unix_ms": m.created_unix_ms, "run_id": "run-1", "contract_hash": hex(&m.contract_hash),
            "robot_name": "polymander", "robot_hash": hex(&m.robot_hash), "env_steps": 1000, "training_commit": "",
            "config_hash": "", "evaluation_json": "", "signatures": [["release-1", "0102"]],
        });
        let text = serde_json::to_vec_pretty(&text).unwrap();
        assert_eq!(Record::read(&text).unwrap(), (record, false));
    }
}
