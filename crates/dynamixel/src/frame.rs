//! Frames on the wire: `FF FF FD 00 | id | length (2) | instruction, parameters | CRC (2)`, written and found
//! in a stream.
//!
//! Length counts everything after itself. Within instruction and parameters, `FF FF FD` is followed by one
//! more `FD` (byte stuffing), which length and CRC include. Only the answer to Fast Sync Read is not stuffed.

use crate::crc::crc16;

/// First bytes of every frame; the fourth is reserved.
pub const HEADER: [u8; 4] = [0xFF, 0xFF, 0xFD, 0x00];
/// All servos at once.
pub const BROADCAST_ID: u8 = 0xFE;
/// Highest id of a single servo.
pub const ID_MAX: u8 = 252;
/// Longest frame taken from the wire, bytes. The largest answer here is that of 16 servos to Fast Sync Read
/// of 35 bytes: 636.
pub const FRAME_MAX: usize = 1024;
/// Header, id and length.
pub const PREFIX: usize = 7;
/// Instruction byte of a status packet.
pub const STATUS: u8 = 0x55;

/// What is asked of a servo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, enum_iterator::Sequence)]
#[repr(u8)]
pub enum Instruction {
    /// Are you there?
    Ping = 0x01,
    /// Read registers.
    Read = 0x02,
    /// Write registers.
    Write = 0x03,
    /// Write registers at the next `Action`.
    RegWrite = 0x04,
    /// Do what `RegWrite` prepared.
    Action = 0x05,
    /// Restart.
    Reboot = 0x08,
    /// Clear position turns or errors.
    Clear = 0x10,
    /// The same registers of many servos, one answer each.
    SyncRead = 0x82,
    /// The same registers of many servos.
    SyncWrite = 0x83,
    /// As `SyncRead`, in one common answer.
    FastSyncRead = 0x8A,
    /// Different registers of many servos.
    BulkRead = 0x92,
    /// Different registers of many servos.
    BulkWrite = 0x93,
}

impl Instruction {
    /// The instruction with this number.
    pub fn from_byte(byte: u8) -> Option<Self> {
        enum_iterator::all().find(|i: &Self| *i as u8 == byte)
    }
}

/// Appends one frame to `out`. Parameters beyond what a length of 16 bits holds are a bug of the caller;
/// nothing here makes any.
pub fn encode(id: u8, instruction: u8, parameters: &[u8], out: &mut Vec<u8>) {
    let start = out.len();
    out.extend_from_slice(&HEADER);
    out.extend_from_slice(&[id, 0, 0]);
    out.push(instruction);
    let mut last3 = [0, 0, instruction];
    for &byte in parameters {
        out.push(byte);
        last3 = [last3[1], last3[2], byte];
        if last3 == [0xFF, 0xFF, 0xFD] {
            out.push(0xFD);
            last3 = [0; 3];
        }
    }
    finish(start, out);
}

/// Sets length and CRC of the frame that begins at `start` and ends with its last parameter.
pub(crate) fn finish(start: usize, out: &mut Vec<u8>) {
    let length = (out.len() - start - PREFIX + 2) as u16;
    out[start + 5..start + 7].copy_from_slice(&length.to_le_bytes());
    let crc = crc16(&out[start..]);
    out.extend_from_slice(&crc.to_le_bytes());
}

/// Takes stuffing out of instruction and parameters, in place; the number of bytes left.
pub fn unstuff(body: &mut [u8]) -> usize {
    let mut kept = 0;
    let mut last3 = [0; 3];
    for i in 0..body.len() {
        let byte = body[i];
        if last3 == [0xFF, 0xFF, 0xFD] && byte == 0xFD {
            last3 = [0; 3];
            continue;
        }
        last3 = [last3[1], last3[2], byte];
        body[kept] = byte;
        kept += 1;
    }
    kept
}

/// One frame whose CRC is right, as it came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// All of it, header to CRC.
    pub raw: &'a [u8],
}

impl<'a> Frame<'a> {
    /// Whose it is.
    pub fn id(&self) -> u8 {
        self.raw[4]
    }

    /// [`STATUS`] in what servos send.
    pub fn instruction(&self) -> u8 {
        self.raw[PREFIX]
    }

    /// Instruction and parameters, stuffing included.
    pub fn body(&self) -> &'a [u8] {
        &self.raw[PREFIX..self.raw.len() - 2]
    }
}

/// Finds frames in a stream of bytes. Bytes that belong to none are skipped and counted.
#[derive(Clone, Debug)]
pub struct Framer {
    bytes: Vec<u8>,
    /// Length of the frame that [`Framer::next_frame`] gave last, taken away by the next call.
    given: usize,
    /// Frames whose CRC was wrong.
    pub crc_errors: u64,
    /// Bytes that were part of no frame.
    pub skipped: u64,
}

impl Default for Framer {
    fn default() -> Self {
        Self::new()
    }
}

impl Framer {
    /// Without bytes.
    pub fn new() -> Self {
        Self { bytes: Vec::with_capacity(2 * FRAME_MAX), given: 0, crc_errors: 0, skipped: 0 }
    }

    /// Forgets all bytes.
    pub fn clear(&mut self) {
        self.given = 0;
        self.bytes.clear();
    }

    /// Bytes that may be pushed now.
    pub fn room(&self) -> usize {
        2 * FRAME_MAX - (self.bytes.len() - self.given)
    }

    /// Takes bytes from the wire. More than [`Framer::room`] push out the oldest.
    pub fn push(&mut self, bytes: &[u8]) {
        self.drop_given();
        let bytes = &bytes[bytes.len().saturating_sub(2 * FRAME_MAX)..];
        let over = (self.bytes.len() + bytes.len()).saturating_sub(2 * FRAME_MAX);
        self.skip(over);
        self.bytes.extend_from_slice(bytes);
    }

    fn drop_given(&mut self) {
        self.bytes.drain(..self.given);
        self.given = 0;
    }

    fn skip(&mut self, count: usize) {
        self.bytes.drain(..count);
        self.skipped += count as u64;
    }

    /// The next whole frame; `None` where more bytes are needed.
    pub fn next_frame(&mut self) -> Option<Frame<'_>> {
        self.drop_given();
        loop {
            let start = header_or_its_beginning(&self.bytes);
            self.skip(start);
            let [_, _, _, _, _, low, high, ..] = self.bytes[..] else { return None };
            let whole = PREFIX + usize::from(u16::from_le_bytes([low, high]));
            // Shorter than instruction and CRC, or longer than anything that is ever sent: not a frame.
            if !(PREFIX + 3..=FRAME_MAX).contains(&whole) {
                self.skip(1);
                continue;
            }
            if self.bytes.len() < whole {
                return None;
            }
            let crc = u16::from_le_bytes([self.bytes[whole - 2], self.bytes[whole - 1]]);
            if crc16(&self.bytes[..whole - 2]) == crc {
                self.given = whole;
                let raw = &self.bytes[..whole];
                return Some(Frame { raw });
            }
            self.crc_errors += 1;
            self.skip(1);
        }
    }
}

/// Where the first header is, or the end of `bytes` that may become one.
fn header_or_its_beginning(bytes: &[u8]) -> usize {
    (0..bytes.len())
        .find(|&at| {
            let rest = &bytes[at..];
            let known = rest.len().min(HEADER.len());
            rest[..known] == HEADER[..known]
        })
        .unwrap_or(bytes.len())
}
