//! The datagrams of the command link, and the key that they are made with.

use std::path::Path;

use caudata_signing::check_private;
use caudata_task::COMMAND_DIM;
use hmac::{Hmac, Mac};
use sha2::Sha256;

use crate::DeployError;

/// Length of a datagram.
pub const DATAGRAM: usize = 4 + 1 + 8 + 8 + 12 + TAG;
/// Shortest key, bytes.
pub const KEY_MIN: usize = 16;
/// Longest key, bytes.
const KEY_MAX: u64 = 4096;

const TAG: usize = 16;
const MAGIC: &[u8; 4] = b"CDL1";

/// The secret that both ends hold.
#[derive(Clone)]
pub struct LinkKey(pub(super) Hmac<Sha256>);

impl LinkKey {
    /// The bytes of a file, which must be at least [`KEY_MIN`], and which only its owner may write and only
    /// its group read.
    ///
    /// # Errors
    /// [`DeployError::LinkKey`], [`DeployError::Key`].
    pub fn read(path: &Path) -> Result<Self, DeployError> {
        let wrong = |reason: String| DeployError::LinkKey { path: path.to_owned(), reason };
        check_private(path)?;
        let bytes =
            caudata_durable::read_at_most(path, KEY_MAX).map_err(|e| wrong(e.to_string()))?;
        if bytes.len() < KEY_MIN {
            return Err(wrong(format!("a key has at least {KEY_MIN} bytes")));
        }
        let keyed = Hmac::new_from_slice(&bytes).map_err(|e| wrong(e.to_string()))?;
        Ok(Self(keyed))
    }

    /// HMAC-SHA-256 of `said`.
    pub(super) fn hmac(&self, said: &[u8]) -> Hmac<Sha256> {
        self.0.clone().chain_update(said)
    }

    /// Whether a datagram bears the tag that this key gives it; the time taken tells nothing.
    pub(super) fn made(&self, bytes: &[u8]) -> bool {
        let (said, tag) = bytes.split_at(bytes.len().saturating_sub(TAG));
        tag.len() == TAG && self.hmac(said).verify_truncated_left(tag).is_ok()
    }
}

/// What a datagram says.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(u8)]
pub enum Kind {
    /// What is your nonce?
    Ask = 0,
    /// This is my nonce.
    Tell = 1,
    /// A velocity, of a sender without a dead-man's button.
    Velocity = 2,
    /// Stop at once.
    Kill = 3,
    /// A velocity, and somebody holds the dead-man's button.
    Held = 4,
    /// Nobody holds the dead-man's button: stand.
    Released = 5,
}

/// One datagram.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Message {
    /// What it says.
    pub kind: Kind,
    /// The robot's nonce; 0 in [`Kind::Ask`].
    pub nonce: u64,
    /// Grows with every datagram of a sender.
    pub sequence: u64,
    /// vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
}

impl Message {
    /// As it goes over the network.
    pub fn encode(&self, key: &LinkKey) -> [u8; DATAGRAM] {
        let mut out = [0; DATAGRAM];
        out[..4].copy_from_slice(MAGIC);
        out[4] = self.kind as u8;
        out[5..13].copy_from_slice(&self.nonce.to_le_bytes());
        out[13..21].copy_from_slice(&self.sequence.to_le_bytes());
        for (i, value) in self.command.iter().enumerate() {
            out[21 + 4 * i..25 + 4 * i].copy_from_slice(&value.to_le_bytes());
        }
        let tag = key.hmac(&out[..DATAGRAM - TAG]).finalize().into_bytes();
        out[DATAGRAM - TAG..].copy_from_slice(&tag[..TAG]);
        out
    }

    /// Out of a datagram; `None` for anything that this key did not make.
    pub fn decode(bytes: &[u8], key: &LinkKey) -> Option<Self> {
        Self::read(bytes).filter(|_| key.made(bytes))
    }

    /// What a datagram says, whoever made it.
    pub(super) fn read(bytes: &[u8]) -> Option<Self> {
        let said: &[u8; DATAGRAM] = bytes.try_into().ok()?;
        let kind = match (said.starts_with(MAGIC), said[4]) {
            (true, 0) => Kind::Ask,
            (true, 1) => Kind::Tell,
            (true, 2) => Kind::Velocity,
            (true, 3) => Kind::Kill,
            (true, 4) => Kind::Held,
            (true, 5) => Kind::Released,
            _ => return None,
        };
        let eight = |at: usize| Some(u64::from_le_bytes(said[at..at + 8].try_into().ok()?));
        let mut command = [0.0; COMMAND_DIM];
        for (i, value) in command.iter_mut().enumerate() {
            *value = f32::from_le_bytes(said[21 + 4 * i..25 + 4 * i].try_into().ok()?);
        }
        Some(Self { kind, nonce: eight(5)?, sequence: eight(13)?, command })
    }
}
