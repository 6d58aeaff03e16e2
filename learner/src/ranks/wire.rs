//! The bytes between ranks: frames of a fixed head and a payload of little-endian numbers.
//!
//! ```text
//! magic "CRNK" | kind u8 | 3 zero bytes | length of the payload u64 | payload
//! ```
//!
//! Both sides check that they speak the same version before anything else; after that each knows what must come next, and anything else ends
//! the connection.

use super::RankIdentity;
use crate::ppo::{Head, LossSettings, Minibatch, sums};

/// Of the frames and of what they mean; a rank of another version is refused.
pub const VERSION: u32 = 1;
/// First bytes of a frame.
pub const MAGIC: [u8; 4] = *b"CRNK";
/// Bytes before the payload.
pub const HEAD_BYTES: usize = 16;
/// Longest payload: a batch of two million samples of a hundred numbers.
pub const PAYLOAD_MAX: u64 = 1 << 30;
/// Longest payload between two who have not introduced themselves yet.
pub const GREETING_MAX: u64 = 64 << 10;
/// Longest word in a greeting or refusal.
const TEXT_MAX: usize = 1024;

/// What a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    /// Rank to rank 0, once: [`Hello`].
    Hello = 1,
    /// Rank 0: you are in.
    Welcome = 2,
    /// Rank 0: you are not, with the reason.
    Refused = 3,
    /// Rank 0: parameters `[P]`, good until the next.
    Parameters = 4,
    /// Rank 0: a new update begins; the tables of the last one are forgotten.
    Begin = 5,
    /// Rank 0: one more table: rows u64, then numbers row by row.
    Table = 6,
    /// Rank 0: [`Forward`]; the rank answers with [`Kind::Outputs`].
    Forward = 7,
    /// Rank: what its shards say, row by row; empty where it has none.
    Outputs = 8,
    /// Rank 0: what the epochs draw from.
    Drawn = 9,
    /// Rank 0: a new pass, in this order: u32 each.
    Shuffle = 10,
    /// Rank 0: a minibatch; the rank begins with its shards.
    Gradient = 11,
    /// Rank 0: what the shards before yours give; the rank answers with [`Kind::Total`].
    Before = 12,
    /// Rank: the same with its own added.
    Total = 13,
    /// Rank 0: the run ended in good order.
    End = 14,
}

impl Kind {
    const ALL: [Self; 14] = [
        Self::Hello,
        Self::Welcome,
        Self::Refused,
        Self::Parameters,
        Self::Begin,
        Self::Table,
        Self::Forward,
        Self::Outputs,
        Self::Drawn,
        Self::Shuffle,
        Self::Gradient,
        Self::Before,
        Self::Total,
        Self::End,
    ];

    /// The kind with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| *kind as u8 == number)
    }
}

/// How a rank introduces itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Hello {
    /// [`VERSION`].
    pub version: u32,
    /// Its number, from 1.
    pub rank: u32,
    /// How many there are, rank 0 included.
    pub ranks: u32,
    /// Parameters of its network.
    pub parameters: u64,
    /// Of its run.
    pub identity: RankIdentity,
}

/// Which outputs are wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Forward {
    /// Of which network.
    pub head: Head,
    /// For which table.
    pub table: u32,
    /// For so many of its first rows.
    pub rows: u64,
}

/// Writes the payload of one frame.
#[derive(Debug, Default)]
pub struct Writer(pub Vec<u8>);

impl Writer {
    pub fn u8(&mut self, value: u8) {
        self.0.push(value);
    }

    pub fn u32(&mut self, value: u32) {
        self.0.extend(value.to_le_bytes());
    }

    pub fn u64(&mut self, value: u64) {
        self.0.extend(value.to_le_bytes());
    }

    pub fn f64(&mut self, value: f64) {
        self.0.extend(value.to_le_bytes());
    }

    pub fn f32s(&mut self, values: &[f32]) {
        let first = self.0.len();
        self.0.resize(first + 4 * values.len(), 0);
        for (bytes, value) in self.0[first..].chunks_exact_mut(4).zip(values) {
            bytes.copy_from_slice(&value.to_le_bytes());
        }
    }

    pub fn u32s(&mut self, values: impl IntoIterator<Item = u32>) {
        values.into_iter().for_each(|value| self.u32(value));
    }

    pub fn text(&mut self, text: &str) {
        // Far below the limit: names and hashes of ours.
        let mut end = text.len().min(TEXT_MAX);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.u32(end as u32);
        self.0.extend(&text.as_bytes()[..end]);
    }

    pub fn hello(&mut self, hello: &Hello) {
        self.u32(hello.version);
        self.u32(hello.rank);
        self.u32(hello.ranks);
        self.u64(hello.parameters);
        self.text(&hello.identity.run_id);
        self.text(&hello.identity.config_hash);
        self.text(&hello.identity.contract_hash);
    }

    pub fn forward(&mut self, forward: &Forward) {
        self.u8(match forward.head {
            Head::Policy => 0,
            Head::Value => 1,
        });
        self.u32(forward.table);
        self.u64(forward.rows);
    }

    pub fn minibatch(&mut self, minibatch: &Minibatch) {
        self.u64(minibatch.part.0 as u64);
        self.u64(minibatch.part.1 as u64);
        self.f64(minibatch.loss.clip);
        self.f64(minibatch.loss.value_weight);
        self.f64(minibatch.loss.entropy_weight);
        self.u8(minibatch.scale_advantages.into());
    }

    pub fn sums(&mut self, sums: &[f64; sums::COUNT]) {
        sums.iter().for_each(|&sum| self.f64(sum));
    }
}

/// Reads the payload of one frame. Errors are in words: what is wrong with the bytes.
#[derive(Debug)]
pub struct Reader<'a>(pub &'a [u8]);

type Read<T> = Result<T, String>;

impl Reader<'_> {
    fn take<const N: usize>(&mut self) -> Read<[u8; N]> {
        let (first, rest) = self
            .0
            .split_first_chunk::<N>()
            .ok_or_else(|| "a frame ends too early".to_owned())?;
        self.0 = rest;
        Ok(*first)
    }

    pub fn u8(&mut self) -> Read<u8> {
        Ok(self.take::<1>()?[0])
    }

    pub fn u32(&mut self) -> Read<u32> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    pub fn u64(&mut self) -> Read<u64> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    pub fn f64(&mut self) -> Read<f64> {
        Ok(f64::from_le_bytes(self.take()?))
    }

    /// A count or an index that this machine can hold.
    pub fn size(&mut self) -> Read<usize> {
        let value = self.u64()?;
        usize::try_from(value).map_err(|_| format!("{value} is no size"))
    }

    /// All that is left.
    pub fn f32s(&mut self) -> Read<Vec<f32>> {
        let (all, rest) = self.0.as_chunks::<4>();
        if !rest.is_empty() {
            return Err("a frame ends within a number".to_owned());
        }
        self.0 = rest;
        Ok(all.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    /// All that is left.
    pub fn u32s(&mut self) -> Read<Vec<u32>> {
        let (all, rest) = self.0.as_chunks::<4>();
        if !rest.is_empty() {
            return Err("a frame ends within a number".to_owned());
        }
        self.0 = rest;
        Ok(all.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
    }

    pub fn text(&mut self) -> Read<String> {
        let length = self.u32()? as usize;
        if length > TEXT_MAX || length > self.0.len() {
            return Err(format!("a text of {length} bytes"));
        }
        let (text, rest) = self.0.split_at(length);
        self.0 = rest;
        String::from_utf8(text.to_vec()).map_err(|error| error.to_string())
    }

    pub fn hello(&mut self) -> Read<Hello> {
        let version = self.u32()?;
        if version != VERSION {
            return Err(format!(
                "it speaks version {version} of the ranks' protocol, this one {VERSION}: start all ranks from the same build"
            ));
        }
        Ok(Hello {
            version,
            rank: self.u32()?,
            ranks: self.u32()?,
            parameters: self.u64()?,
            identity: RankIdentity {
                run_id: self.text()?,
                config_hash: self.text()?,
                contract_hash: self.text()?,
            },
        })
    }

    pub fn forward(&mut self) -> Read<Forward> {
        let head = match self.u8()? {
            0 => Head::Policy,
            1 => Head::Value,
            other => return Err(format!("network {other}")),
        };
        Ok(Forward {
            head,
            table: self.u32()?,
            rows: self.u64()?,
        })
    }

    pub fn minibatch(&mut self) -> Read<Minibatch> {
        Ok(Minibatch {
            part: (self.size()?, self.size()?),
            loss: LossSettings {
                clip: self.f64()?,
                value_weight: self.f64()?,
                entropy_weight: self.f64()?,
            },
            scale_advantages: self.u8()? != 0,
        })
    }

    pub fn sums(&mut self) -> Read<[f64; sums::COUNT]> {
        let mut sums = [0.0; sums::COUNT];
        for sum in &mut sums {
            *sum = self.f64()?;
        }
        Ok(sums)
    }
}

/// Refuses payloads that the other side would not take.
///
/// # Errors
/// In words.
pub fn check_length(length: u64, max: u64) -> Result<(), String> {
    match length <= max {
        true => Ok(()),
        false => Err(format!("a frame of {length} bytes, more than {max}")),
    }
}

/// The head of a frame.
///
/// # Errors
/// In words, when the payload is too long.
pub fn head(kind: Kind, payload: usize) -> Result<[u8; HEAD_BYTES], String> {
    let length = payload as u64;
    check_length(length, PAYLOAD_MAX)?;
    let mut head = [0; HEAD_BYTES];
    head[..4].copy_from_slice(&MAGIC);
    head[4] = kind as u8;
    head[8..].copy_from_slice(&length.to_le_bytes());
    Ok(head)
}

/// Kind and length of the payload behind a head, which is `max` at most.
///
/// # Errors
/// In words, when these are no bytes of a rank.
pub fn parse_head(head: &[u8; HEAD_BYTES], max: u64) -> Read<(Kind, u64)> {
    let [m0, m1, m2, m3, kind, _, _, _, length @ ..] = *head;
    if [m0, m1, m2, m3] != MAGIC {
        return Err("the other side is no rank of a learner".to_owned());
    }
    let length = u64::from_le_bytes(length);
    let kind = Kind::from_number(kind).ok_or_else(|| format!("a frame of kind {kind}"))?;
    check_length(length, max)?;
    Ok((kind, length))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn hello() -> Hello {
        Hello {
            version: VERSION,
            rank: 3,
            ranks: 4,
            parameters: 7,
            identity: RankIdentity {
                run_id: "läuft".into(),
                config_hash: "c".into(),
                contract_hash: "d".into(),
            },
        }
    }

    #[test]
    fn what_is_written_is_read() {
        let minibatch = Minibatch {
            part: (5, 9),
            loss: LossSettings {
                clip: 0.2,
                value_weight: 1.5,
                entropy_weight: 0.0,
            },
            scale_advantages: true,
        };
        let forward = Forward {
            head: Head::Value,
            table: 1,
            rows: 99,
        };
        let mut writer = Writer::default();
        writer.hello(&hello());
        writer.forward(&forward);
        writer.minibatch(&minibatch);
        writer.sums(&[1.0, f64::INFINITY, -0.0, 4.0]);
        writer.f32s(&[0.5, -3.0]);
        let mut reader = Reader(&writer.0);
        assert_eq!(reader.hello().unwrap(), hello());
        assert_eq!(reader.forward().unwrap(), forward);
        assert_eq!(reader.minibatch().unwrap(), minibatch);
        assert_eq!(reader.sums().unwrap()[1], f64::INFINITY);
        assert_eq!(reader.f32s().unwrap(), [0.5, -3.0]);
        assert!(reader.0.is_empty());
        let head = head(Kind::Total, 77).unwrap();
        assert_eq!(parse_head(&head, 77), Ok((Kind::Total, 77)));
    }

    #[test]
    fn foreign_bytes_and_other_versions_are_named() {
        let mut web = [0; HEAD_BYTES];
        web[..14].copy_from_slice(b"GET / HTTP/1.1");
        let refused = parse_head(&web, PAYLOAD_MAX).unwrap_err();
        assert!(refused.contains("no rank"), "{refused}");
        let long = head(Kind::Table, PAYLOAD_MAX as usize).unwrap();
        assert!(parse_head(&long, PAYLOAD_MAX).is_ok());
        let refused = parse_head(&long, GREETING_MAX).unwrap_err();
        assert!(refused.contains("more than 65536"), "{refused}");
        let refused = head(Kind::Table, PAYLOAD_MAX as usize + 1).unwrap_err();
        assert!(refused.contains("more than 1073741824"), "{refused}");
        let mut writer = Writer::default();
        writer.hello(&Hello {
            version: 9,
            ..hello()
        });
        assert!(Reader(&writer.0).hello().unwrap_err().contains("version 9"));
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_without_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
            let _ = Reader(&bytes).hello();
            let _ = Reader(&bytes).forward();
            let _ = Reader(&bytes).minibatch();
            let _ = Reader(&bytes).sums();
            let _ = Reader(&bytes).f32s();
            let _ = Reader(&bytes).u32s();
            if let Some(head) = bytes.first_chunk() {
                let _ = parse_head(head, PAYLOAD_MAX);
            }
        }
    }
}
