//! Frames that say who sent them and prove that they are whole.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use caudata_transport::{ActorLink, Frame, LearnerLink, SendError};

/// Far beyond anything a healthy link takes, on a busy machine too. Reaching it fails the test.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// One attempt within that.
pub const ATTEMPT: Duration = Duration::from_millis(200);
/// Sender, incarnation, number, checksum.
const HEAD: usize = 32;

/// Who sent a frame, and which of its frames it is, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Label {
    pub sender: u64,
    pub incarnation: u64,
    pub number: u64,
}

/// A frame of `bytes` bytes (at least 32) with this label, a body that depends on it, and a checksum over
/// both.
pub fn frame(label: Label, bytes: usize) -> Vec<u8> {
    let mut out = vec![0; bytes.max(HEAD)];
    for (i, byte) in out[HEAD..].iter_mut().enumerate() {
        *byte = (label.number as usize).wrapping_mul(31).wrapping_add(i) as u8;
    }
    for (slot, field) in [label.sender, label.incarnation, label.number].iter().enumerate() {
        out[8 * slot..8 * slot + 8].copy_from_slice(&field.to_le_bytes());
    }
    let sum = checksum(&out);
    out[24..32].copy_from_slice(&sum.to_le_bytes());
    out
}

/// The label of a frame that is whole; panics on a torn one.
pub fn check(frame: &[u8]) -> Label {
    let field = |slot: usize| u64::from_le_bytes(frame[8 * slot..8 * slot + 8].try_into().unwrap());
    assert_eq!(field(3), checksum(frame), "torn frame");
    Label { sender: field(0), incarnation: field(1), number: field(2) }
}

/// FNV-1a over 64-bit words, the checksum's own place left out.
fn checksum(frame: &[u8]) -> u64 {
    let mix = |sum: u64, word: u64| (sum ^ word).wrapping_mul(0x0000_0100_0000_01b3);
    let mut sum = mix(0xcbf2_9ce4_8422_2325, frame.len() as u64);
    for part in [&frame[..24], &frame[HEAD..]] {
        for chunk in part.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            sum = mix(sum, u64::from_le_bytes(word));
        }
    }
    sum
}

/// Sends, trying the same frame again while the learner is behind or away.
pub fn send(actor: &mut dyn ActorLink, frame: &[u8]) {
    let start = Instant::now();
    loop {
        match actor.send(frame, ATTEMPT) {
            Ok(()) => return,
            Err(SendError::Full { .. } | SendError::Disconnected { .. })
                if start.elapsed() < PATIENCE => {}
            Err(error) => panic!("send: {error}"),
        }
    }
}

/// Flushes, with patience.
pub fn flush(actor: &mut dyn ActorLink) {
    actor.flush(PATIENCE).unwrap();
}

/// The next frame, with patience.
pub fn recv(learner: &mut dyn LearnerLink) -> Frame {
    learner.recv(PATIENCE).unwrap().expect("a frame within the patience of the test")
}

/// Checks what arrives: whole, in order per sender and incarnation, none twice, none left out.
#[derive(Default)]
pub struct Ledger {
    last: BTreeMap<(u64, u64), u64>,
}

impl Ledger {
    pub fn take(&mut self, frame: &Frame) -> Label {
        let label = check(&frame.bytes);
        let last = self.last.entry((label.sender, label.incarnation)).or_insert(0);
        assert_eq!(label.number, *last + 1, "{label:?}");
        *last = label.number;
        label
    }

    /// As [`Self::take`], when what came before the first frame went to somebody else.
    pub fn follows(&mut self, label: Label) {
        let key = (label.sender, label.incarnation);
        let last = self.last.insert(key, label.number);
        assert!(last.is_none_or(|last| label.number == last + 1), "{label:?}");
    }

    /// The number of the last frame, or how many came from this sender in this incarnation.
    pub fn count(&self, sender: u64, incarnation: u64) -> u64 {
        let count = self.last.get(&(sender, incarnation));
        count.copied().unwrap_or_default()
    }

    pub fn total(&self) -> u64 {
        self.last.values().sum()
    }
}

/// Waits until `done`, looking often; panics when patience ends.
pub fn wait_until(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
