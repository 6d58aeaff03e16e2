//! Message layouts, little-endian, fixed size, each with a magic number: what is not ours is not parsed.

use crate::{Control, PolicyUpdate};

/// "CDU1": actor to learner.
const UP_MAGIC: u32 = u32::from_le_bytes(*b"CDU1");
/// "CDS1": learner to actor.
const STATUS_MAGIC: u32 = u32::from_le_bytes(*b"CDS1");
/// "CDP1": a policy, or a piece of one.
const POLICY_MAGIC: u32 = u32::from_le_bytes(*b"CDP1");

/// Reads little-endian fields one after the other; `None` once the bytes are used up.
struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.0.split_first_chunk::<N>()?;
        self.0 = tail;
        Some(*head)
    }

    fn u32(&mut self) -> Option<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Option<u64> {
        self.take().map(u64::from_le_bytes)
    }
}

/// What an actor's message is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum UpKind {
    /// A frame follows the head.
    Data,
    /// "Where are you?", and the sign of life.
    Probe,
    /// The link ends.
    Bye,
}

/// Head of every message from actor to learner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct UpHead {
    pub kind: UpKind,
    /// The sender: unique per link, so that a restarted actor is another link.
    pub link: u64,
    /// Data: number of the frame that follows. Probe: number of the probe. Bye: 0.
    pub number: u64,
    /// Lowest frame number not yet acknowledged: where a learner that does not know the link begins.
    pub base: u64,
}

impl UpHead {
    pub(crate) const LEN: usize = 32;

    pub(crate) fn encode(&self) -> [u8; Self::LEN] {
        let kind: u32 = match self.kind {
            UpKind::Data => 1,
            UpKind::Probe => 2,
            UpKind::Bye => 3,
        };
        let mut out = [0; Self::LEN];
        out[0..4].copy_from_slice(&UP_MAGIC.to_le_bytes());
        out[4..8].copy_from_slice(&kind.to_le_bytes());
        out[8..16].copy_from_slice(&self.link.to_le_bytes());
        out[16..24].copy_from_slice(&self.number.to_le_bytes());
        out[24..32].copy_from_slice(&self.base.to_le_bytes());
        out
    }

    /// `None` for anything that no actor of ours sends.
    pub(crate) fn decode(bytes: &[u8]) -> Option<Self> {
        let mut reader = Reader(bytes);
        if reader.u32()? != UP_MAGIC {
            return None;
        }
        let kind = match reader.u32()? {
            1 => UpKind::Data,
            2 => UpKind::Probe,
            3 => UpKind::Bye,
            _ => return None,
        };
        let head = Self { kind, link: reader.u64()?, number: reader.u64()?, base: reader.u64()? };
        let numbered = head.base >= 1 && (kind != UpKind::Data || head.number >= head.base);
        (numbered && reader.0.is_empty()).then_some(head)
    }
}

/// The learner's answer to one link. Within an epoch no field goes back, so only the newest answer matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Status {
    /// Which learner process this is; another one starts over.
    pub epoch: u64,
    pub link: u64,
    /// Every frame up to this number is in the learner's hands.
    pub received: u64,
    /// Frames up to this number may be sent.
    pub granted: u64,
    /// Number of the last probe seen.
    pub probe: u64,
    /// Counts policies; the actor fetches when it grows. 0: none yet.
    pub generation: u64,
    /// Largest frame the learner takes, bytes: its limit counts when the two sides differ.
    pub max_frame_bytes: u64,
    /// The newest policy says stop.
    pub stop: bool,
}

impl Status {
    pub(crate) const LEN: usize = 64;

    pub(crate) fn encode(&self) -> [u8; Self::LEN] {
        let mut out = [0; Self::LEN];
        out[0..4].copy_from_slice(&STATUS_MAGIC.to_le_bytes());
        out[4..8].copy_from_slice(&u32::from(self.stop).to_le_bytes());
        let fields = [
            self.epoch,
            self.link,
            self.received,
            self.granted,
            self.probe,
            self.generation,
            self.max_frame_bytes,
        ];
        for (slot, field) in out[8..].chunks_exact_mut(8).zip(fields) {
            slot.copy_from_slice(&field.to_le_bytes());
        }
        out
    }

    /// The status at the start of `bytes`, which may hold more of them.
    pub(crate) fn decode(bytes: &[u8]) -> Option<Self> {
        let mut reader = Reader(bytes);
        if reader.u32()? != STATUS_MAGIC {
            return None;
        }
        let stop = match reader.u32()? {
            0 => false,
            1 => true,
            _ => return None,
        };
        Some(Self {
            epoch: reader.u64()?,
            link: reader.u64()?,
            received: reader.u64()?,
            granted: reader.u64()?,
            probe: reader.u64()?,
            generation: reader.u64()?,
            max_frame_bytes: reader.u64()?,
            stop,
        })
    }
}

/// Head of a policy or of a piece of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PolicyHead {
    pub epoch: u64,
    pub generation: u64,
    pub version: u64,
    pub sha256: [u8; 32],
    pub control: Control,
    /// Size of the whole policy, bytes.
    pub total: u64,
    /// Where the bytes that follow begin in it.
    pub offset: u64,
}

impl PolicyHead {
    pub(crate) const LEN: usize = 80;

    pub(crate) fn of(update: &PolicyUpdate, epoch: u64, generation: u64, offset: usize) -> Self {
        Self {
            epoch,
            generation,
            version: update.version,
            sha256: update.sha256,
            control: update.control,
            total: update.bytes.len() as u64,
            offset: offset as u64,
        }
    }

    pub(crate) fn encode(&self) -> [u8; Self::LEN] {
        let control: u32 = match self.control {
            Control::Run => 0,
            Control::Stop => 1,
        };
        let mut out = [0; Self::LEN];
        out[0..4].copy_from_slice(&POLICY_MAGIC.to_le_bytes());
        out[4..8].copy_from_slice(&control.to_le_bytes());
        let fields = [self.epoch, self.generation, self.version, self.total, self.offset];
        for (slot, field) in out[8..48].chunks_exact_mut(8).zip(fields) {
            slot.copy_from_slice(&field.to_le_bytes());
        }
        out[48..].copy_from_slice(&self.sha256);
        out
    }

    /// The head and the bytes behind it, which never reach past `total`.
    pub(crate) fn decode(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let mut reader = Reader(bytes);
        if reader.u32()? != POLICY_MAGIC {
            return None;
        }
        let control = match reader.u32()? {
            0 => Control::Run,
            1 => Control::Stop,
            _ => return None,
        };
        let head = Self {
            control,
            epoch: reader.u64()?,
            generation: reader.u64()?,
            version: reader.u64()?,
            total: reader.u64()?,
            offset: reader.u64()?,
            sha256: reader.take()?,
        };
        let end = head.offset.checked_add(reader.0.len() as u64)?;
        (end <= head.total).then_some((head, reader.0))
    }

    pub(crate) fn into_update(self, bytes: Vec<u8>) -> PolicyUpdate {
        PolicyUpdate {
            version: self.version,
            sha256: self.sha256,
            bytes: bytes.into(),
            control: self.control,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn up_heads_round_trip(
            kind in prop_oneof![Just(UpKind::Data), Just(UpKind::Probe), Just(UpKind::Bye)],
            link: u64,
            base in 1..u64::MAX / 2,
            ahead in 0..1000_u64,
        ) {
            let head = UpHead { kind, link, number: base + ahead, base };
            prop_assert_eq!(UpHead::decode(&head.encode()), Some(head));
        }

        #[test]
        fn statuses_and_policy_heads_round_trip(numbers: [u64; 7], stop: bool, sha256: [u8; 32], bytes: Vec<u8>) {
            let [epoch, link, received, granted, probe, generation, max_frame_bytes] = numbers;
            let status = Status { epoch, link, received, granted, probe, generation, max_frame_bytes, stop };
            prop_assert_eq!(Status::decode(&status.encode()), Some(status));
            let control = if stop { Control::Stop } else { Control::Run };
            let update = PolicyUpdate { version: link, sha256, bytes: bytes.clone().into(), control };
            let head = PolicyHead::of(&update, epoch, generation, 0);
            let message = [&head.encode()[..], &bytes].concat();
            let (decoded, rest) = PolicyHead::decode(&message).unwrap();
            prop_assert_eq!(rest, &bytes[..]);
            prop_assert_eq!(decoded.into_update(rest.to_vec()), update);
        }

        /// Hostile bytes: an answer or none, never a panic.
        #[test]
        fn any_bytes_are_survived(bytes: Vec<u8>, which in 0..3_u8) {
            let magic: &[u8; 4] = [b"CDU1", b"CDS1", b"CDP1"][usize::from(which)];
            let framed = [magic, &bytes[..]].concat();
            let _ = (UpHead::decode(&framed), Status::decode(&framed), PolicyHead::decode(&framed));
        }
    }

    #[test]
    fn foreign_short_and_inconsistent_messages_are_refused() {
        let head = UpHead { kind: UpKind::Data, link: 7, number: 3, base: 2 };
        let good = head.encode();
        assert!(UpHead::decode(&good).is_some());
        assert!(UpHead::decode(&good[..UpHead::LEN - 1]).is_none());
        // A frame number below the base was acknowledged before: nobody sends it.
        assert!(UpHead::decode(&UpHead { number: 1, ..head }.encode()).is_none());
        // Numbers begin at 1.
        assert!(UpHead::decode(&UpHead { base: 0, ..head }.encode()).is_none());
        // One byte too many.
        assert!(UpHead::decode(&[&good[..], b"x"].concat()).is_none());
        // A piece that reaches past the end of its policy: 3 bytes at offset 2 of 4.
        let update = PolicyUpdate {
            version: 1,
            sha256: [0; 32],
            bytes: vec![0; 4].into(),
            control: Control::Run,
        };
        let piece = PolicyHead::of(&update, 1, 1, 2).encode();
        assert!(PolicyHead::decode(&[&piece[..], b"ab"].concat()).is_some());
        assert!(PolicyHead::decode(&[&piece[..], b"abc"].concat()).is_none());
        // Not ours at all.
        assert!(Status::decode(&good).is_none());
    }
}
