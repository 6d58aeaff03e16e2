//! One published version as it stands on disk: a small JSON file beside the blobs.

use caudata_proto::registry::Manifest;
use caudata_proto::wire::registry as wire;
use serde::{Deserialize, Serialize};

use crate::error::RecordError;
use crate::files::{seal, unseal};

/// Format of the record files; a store with a newer one is refused rather than misread.
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
    pub fn from_json(bytes: &[u8]) -> Result<Self, RecordError> {
        let Format { format: found } = unseal(bytes)?;
        if found != RECORD_FORMAT {
            return Err(RecordError::Format { found });
        }
        let on_disk: OnDisk = unseal(bytes)?;
        Ok(Self { generation: on_disk.generation, manifest: on_disk.manifest.try_into()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::manifest;
    use caudata_proto::hex::hex;

    #[test]
    fn a_record_comes_back_equal_and_shows_its_hash_in_hexadecimal() {
        let record = Record { generation: 7, manifest: manifest("polymander/flat", 3, b"bytes") };
        let text = record.to_json().unwrap();
        assert_eq!(Record::from_json(&text).unwrap(), record);
        let text = String::from_utf8(text).unwrap();
        assert!(text.contains(&hex(&record.manifest.sha256)), "{text}");
        serde_json::from_str::<serde_json::Value>(&text).unwrap();
    }

    #[test]
    fn a_record_of_another_format_or_with_a_torn_end_or_a_flipped_bit_is_refused() {
        let record = Record { generation: 1, manifest: manifest("s", 1, b"x") };
        let text = record.to_json().unwrap();
        for end in 0..text.len() {
            assert!(Record::from_json(&text[..end]).is_err());
        }
        for bit in 0..8 * text.len() {
            let mut flipped = text.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert!(Record::from_json(&flipped).is_err(), "bit {bit}");
        }
        let unsealed = br#"{"format": 2, "generation": 1}"#;
        let error = Record::from_json(unsealed).unwrap_err();
        assert!(matches!(error, RecordError::Checksum), "{error}");
        let newer = seal(&serde_json::json!({"format": 3})).unwrap();
        let error = Record::from_json(&newer).unwrap_err();
        assert!(matches!(error, RecordError::Format { found: 3 }), "{error}");
    }
}
