//! The envelope of an engine's snapshot: what it must match to be restored, and a check sum.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::{EngineConfig, SimError};

/// What a snapshot belongs to.
pub(crate) struct Owner<'a> {
    /// Changes whenever the layout of what is saved does.
    pub format: &'static str,
    pub model_hash: [u8; 32],
    pub config: &'a EngineConfig,
    /// [`Terrain::fingerprint`](crate::Terrain::fingerprint).
    pub terrain: u64,
    pub lanes: usize,
}

/// The same as it is written.
#[derive(Serialize, Deserialize)]
struct Envelope {
    format: String,
    model_hash: [u8; 32],
    config: String,
    terrain: u64,
    lanes: usize,
}

impl Owner<'_> {
    fn envelope(&self) -> Envelope {
        Envelope {
            format: self.format.to_owned(),
            model_hash: self.model_hash,
            config: format!("{:?}", self.config),
            terrain: self.terrain,
            lanes: self.lanes,
        }
    }

    /// `content` as bytes, the last eight of them a check sum.
    pub fn save(&self, content: &impl Serialize) -> Result<Vec<u8>, SimError> {
        let mut bytes = encode(&(self.envelope(), content))?;
        let sum = fingerprint(&bytes);
        bytes.extend_from_slice(&sum.to_le_bytes());
        Ok(bytes)
    }

    /// What is in `bytes`, checked against the owner.
    pub fn load<T: DeserializeOwned>(&self, bytes: &[u8]) -> Result<T, SimError> {
        let (body, sum) =
            bytes.split_last_chunk::<8>().ok_or_else(|| refused("it is too short"))?;
        if fingerprint(body) != u64::from_le_bytes(*sum) {
            return Err(refused("its check sum is wrong; it is damaged or not a snapshot"));
        }
        let (found, content) =
            postcard::take_from_bytes::<Envelope>(body).map_err(|e| refused(&e.to_string()))?;
        let own = self.envelope();
        #[rustfmt::skip]
        let matches = [
            (found.format == own.format, "it was written by another version"),
            (found.model_hash == own.model_hash, "it belongs to another robot model"),
            (found.config == own.config, "it was taken with another engine configuration"),
            (found.terrain == own.terrain, "it was taken on another terrain"),
            (found.lanes == own.lanes, "it has another number of lanes"),
        ];
        match matches.iter().find(|(same, _)| !same) {
            Some((_, reason)) => Err(refused(reason)),
            None => decode(content),
        }
    }
}

/// FNV-1a over 64-bit words and the remaining bytes: finds damage, not malice.
fn fingerprint(bytes: &[u8]) -> u64 {
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    let (words, rest) = bytes.as_chunks::<8>();
    let mut hash = 0xcbf2_9ce4_8422_2325_u64;
    for word in words {
        hash = (hash ^ u64::from_le_bytes(*word)).wrapping_mul(PRIME);
        hash ^= hash >> 32;
    }
    for byte in rest {
        hash = (hash ^ u64::from(*byte)).wrapping_mul(PRIME);
    }
    hash
}

pub(crate) fn encode<T: Serialize + ?Sized>(value: &T) -> Result<Vec<u8>, SimError> {
    postcard::to_stdvec(value)
        .map_err(|e| SimError::Snapshot { action: "written", reason: e.to_string() })
}

pub(crate) fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, SimError> {
    postcard::from_bytes(bytes).map_err(|e| refused(&e.to_string()))
}

pub(crate) fn refused(reason: &str) -> SimError {
    SimError::Snapshot { action: "restored", reason: reason.to_owned() }
}
