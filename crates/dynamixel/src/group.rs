//! The same registers of many servos at once: what is prepared once and used at every tick, without
//! allocating.

use crate::frame::{BROADCAST_ID, HEADER, Instruction, encode, finish};
use crate::status::StatusError;

/// What one servo of a group said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// Nothing in time.
    Silent,
    /// Its registers, and its error byte: an alert comes with good data.
    Data(StatusError),
    /// It refused.
    Refused(StatusError),
}

/// Reads the same registers of several servos.
#[derive(Clone, Debug)]
pub struct GroupRead {
    pub(crate) ids: Vec<u8>,
    pub(crate) length: usize,
    pub(crate) request: Vec<u8>,
    pub(crate) fast: bool,
    pub(crate) data: Vec<u8>,
    pub(crate) answers: Vec<Answer>,
}

impl GroupRead {
    /// Sync Read, or Fast Sync Read with one common answer, of `length` bytes from `address`.
    pub fn new(ids: &[u8], address: u16, length: u16, fast: bool) -> Self {
        let instruction = if fast { Instruction::FastSyncRead } else { Instruction::SyncRead };
        let [a0, a1] = address.to_le_bytes();
        let [l0, l1] = length.to_le_bytes();
        let mut parameters = vec![a0, a1, l0, l1];
        parameters.extend_from_slice(ids);
        let mut request = Vec::new();
        encode(BROADCAST_ID, instruction as u8, &parameters, &mut request);
        Self {
            ids: ids.to_vec(),
            length: usize::from(length),
            request,
            fast,
            data: vec![0; ids.len() * usize::from(length)],
            answers: vec![Answer::Silent; ids.len()],
        }
    }

    /// How many servos.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// What servo number `index` of the group said last.
    pub fn answer(&self, index: usize) -> Answer {
        self.answers[index]
    }

    /// Its registers, as last answered; older data stay where it was silent.
    pub fn data(&self, index: usize) -> &[u8] {
        &self.data[index * self.length..(index + 1) * self.length]
    }

    pub(crate) fn begin(&mut self) {
        self.answers.fill(Answer::Silent);
    }

    pub(crate) fn missing(&self) -> usize {
        let silent = |a: &&Answer| **a == Answer::Silent;
        self.answers.iter().filter(silent).count()
    }

    /// Takes a servo's answer; false where it does not belong here.
    pub(crate) fn take(&mut self, id: u8, error: StatusError, data: &[u8]) -> bool {
        let waits = |i: &usize| self.ids[*i] == id && self.answers[*i] == Answer::Silent;
        let Some(index) = (0..self.ids.len()).find(waits) else { return false };
        if error.number().is_some() {
            self.answers[index] = Answer::Refused(error);
            return true;
        }
        if data.len() != self.length {
            return false;
        }
        self.data[index * self.length..(index + 1) * self.length].copy_from_slice(data);
        self.answers[index] = Answer::Data(error);
        true
    }

    /// Takes the common answer of Fast Sync Read: per servo error, id, data, and (but for the last) the CRC
    /// of all so far, which the CRC of the whole makes superfluous. `body` begins after the instruction byte.
    pub(crate) fn take_common(&mut self, body: &[u8]) -> bool {
        let stride = self.length + 4;
        if body.len() + 2 != stride * self.ids.len() {
            return false;
        }
        let whole = body.chunks(stride).all(|block| block[1] <= crate::frame::ID_MAX);
        whole
            && body
                .chunks(stride)
                .all(|block| self.take(block[1], StatusError(block[0]), &block[2..2 + self.length]))
    }
}

/// Writes the same registers of several servos; nobody answers.
#[derive(Clone, Debug)]
pub struct GroupWrite {
    address: u16,
    length: usize,
    ids: Vec<u8>,
    data: Vec<u8>,
    parameters: Vec<u8>,
    pub(crate) request: Vec<u8>,
}

impl GroupWrite {
    /// Writes `length` bytes (1 to 4) from `address`.
    pub fn new(ids: &[u8], address: u16, length: u16) -> Self {
        let length = usize::from(length.clamp(1, 4));
        let parameters = Vec::with_capacity(4 + ids.len() * (1 + length));
        // Twice: every byte could be stuffed.
        let request = Vec::with_capacity(HEADER.len() + 6 + 2 * (5 + ids.len() * (1 + length)));
        Self {
            address,
            length,
            ids: ids.to_vec(),
            data: vec![0; ids.len() * length],
            parameters,
            request,
        }
    }

    /// What servo number `index` of the group is to get.
    pub fn set(&mut self, index: usize, value: i32) {
        let bytes = value.to_le_bytes();
        let (start, length) = (index * self.length, self.length);
        self.data[start..start + length].copy_from_slice(&bytes[..length]);
    }

    pub(crate) fn prepare(&mut self) {
        self.parameters.clear();
        self.parameters.extend_from_slice(&self.address.to_le_bytes());
        self.parameters.extend_from_slice(&(self.length as u16).to_le_bytes());
        for (id, data) in self.ids.iter().zip(self.data.chunks(self.length)) {
            self.parameters.push(*id);
            self.parameters.extend_from_slice(data);
        }
        self.request.clear();
        encode(BROADCAST_ID, Instruction::SyncWrite as u8, &self.parameters, &mut self.request);
    }
}

/// The common answer of several servos to Fast Sync Read, as they send it: not stuffed, each servo's share
/// followed by the CRC of everything before.
pub fn common_answer(shares: &[(u8, StatusError, Vec<u8>)], out: &mut Vec<u8>) {
    let start = out.len();
    out.extend_from_slice(&HEADER);
    let body: usize = shares.iter().map(|(_, _, data)| data.len() + 4).sum();
    let length = (body + 1) as u16;
    out.push(BROADCAST_ID);
    out.extend_from_slice(&length.to_le_bytes());
    out.push(crate::frame::STATUS);
    for (index, (id, error, data)) in shares.iter().enumerate() {
        out.extend_from_slice(&[error.0, *id]);
        out.extend_from_slice(data);
        if index + 1 < shares.len() {
            let crc = crate::crc::crc16(&out[start..]);
            out.extend_from_slice(&crc.to_le_bytes());
        }
    }
    finish(start, out);
}
