//! A bus of emulated servos: bytes in, bytes out, with the timing of a wire and the faults of a bad one. Time
//! is an argument.

mod port;
mod pty;
mod servo;

use std::collections::VecDeque;

use caudata_random::{Key, Purpose, Stream};

use crate::frame::{BROADCAST_ID, Framer, Instruction, PREFIX, STATUS, encode, unstuff};
use crate::group::common_answer;
use crate::units::wire_us;

pub use port::EmulatedPort;
pub use pty::Pty;
pub use servo::{BOOT_US, EmulatedServo, Present};

/// Answers that wait to be sent; more are dropped, as on a wire that is busy.
const QUEUE_MAX: usize = 64;

/// How bad the wire is. Chances are per answer, between 0 and 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WireFaults {
    /// One byte is missing.
    pub lost_byte: f32,
    /// One bit is flipped.
    pub flipped_bit: f32,
    /// It comes [`WireFaults::late_us`] later.
    pub late: f32,
    /// See [`WireFaults::late`], µs.
    pub late_us: u64,
    /// Noise of up to 16 bytes comes before it.
    pub noise: f32,
}

/// Emulated servos on one wire.
#[derive(Debug)]
pub struct EmulatedBus {
    /// The servos, to look at and to change from outside.
    pub servos: Vec<EmulatedServo>,
    /// How bad the wire is.
    pub faults: WireFaults,
    stream: Stream,
    /// How fast the host sends and listens. A servo at another speed hears noise and says nothing.
    pub host_baud: u32,
    framer: Framer,
    queue: VecDeque<(u64, Vec<u8>)>,
    free_at_us: u64,
    /// Group writes of goal positions so far.
    pub goal_writes: u64,
}

impl EmulatedBus {
    /// `servos` on a good wire; `seed` is for its faults.
    pub fn new(servos: Vec<EmulatedServo>, seed: u64) -> Self {
        Self {
            servos,
            faults: WireFaults::default(),
            stream: Stream::new(Key::for_run(seed), Purpose::CommandLoss),
            host_baud: 1_000_000,
            framer: Framer::new(),
            queue: VecDeque::new(),
            free_at_us: 0,
            goal_writes: 0,
        }
    }

    /// Lets time pass: watchdogs.
    pub fn pass(&mut self, now_us: u64) {
        for servo in &mut self.servos {
            servo.pass(now_us);
        }
    }

    /// Hears bytes from the host.
    pub fn hear(&mut self, bytes: &[u8], now_us: u64) {
        self.pass(now_us);
        self.framer.push(bytes);
        let mut questions = Vec::new();
        while let Some(frame) = self.framer.next_frame() {
            let mut body = frame.body().to_vec();
            let length = unstuff(&mut body);
            body.truncate(length);
            questions.push((frame.id(), body, frame.raw.len()));
        }
        for (id, body, length) in questions {
            let heard_at = now_us.max(self.free_at_us) + wire_us(length, self.host_baud);
            self.free_at_us = heard_at;
            if let Some((&instruction, parameters)) = body.split_first() {
                self.obey(id, instruction, parameters, heard_at);
            }
        }
    }

    fn obey(&mut self, id: u8, instruction: u8, parameters: &[u8], now_us: u64) {
        match Instruction::from_byte(instruction) {
            Some(Instruction::SyncRead) => self.sync_read(parameters, now_us),
            Some(Instruction::FastSyncRead) => self.fast_sync_read(parameters, now_us),
            Some(Instruction::SyncWrite) => self.sync_write(parameters, now_us),
            Some(Instruction::BulkRead) => {
                for request in parameters.chunks_exact(5) {
                    self.answer_of(request[0], Instruction::Read, &request[1..], now_us);
                }
            }
            Some(Instruction::BulkWrite) => self.bulk_write(parameters, now_us),
            // What servos say to others, or an instruction that is unknown here.
            _ if instruction == STATUS => {}
            None => {}
            Some(single) => {
                for index in 0..self.servos.len() {
                    let servo = &self.servos[index];
                    if id == BROADCAST_ID || servo.id() == id {
                        let servo_id = servo.id();
                        self.answer_of(servo_id, single, parameters, now_us);
                    }
                }
            }
        }
    }

    /// The servo with this id hears the question; whether it answers is up to it.
    fn answer_of(&mut self, id: u8, instruction: Instruction, parameters: &[u8], now_us: u64) {
        let baud = self.host_baud;
        let hears = |s: &&mut EmulatedServo| s.id() == id && s.hears(baud, now_us);
        let Some(servo) = self.servos.iter_mut().find(hears) else { return };
        let delay = servo.return_delay_us();
        if let Some((error, data)) = servo.obey(instruction, parameters, now_us) {
            let mut body = vec![error.0];
            body.extend_from_slice(&data);
            let mut frame = Vec::new();
            encode(id, STATUS, &body, &mut frame);
            self.send(frame, delay);
        }
    }

    fn sync_read(&mut self, parameters: &[u8], now_us: u64) {
        let Some((what, ids)) = parameters.split_at_checked(4) else { return };
        for id in ids {
            self.answer_of(*id, Instruction::Read, what, now_us);
        }
    }

    /// The servos' shares follow each other without a gap. Behind one that is silent nobody knows when to
    /// begin: the rest is missing and the host finds no whole frame.
    fn fast_sync_read(&mut self, parameters: &[u8], now_us: u64) {
        let Some((what, ids)) = parameters.split_at_checked(4) else { return };
        let (baud, mut shares, mut delay) = (self.host_baud, Vec::new(), 0);
        for id in ids {
            let hears = |s: &&mut EmulatedServo| s.id() == *id && s.hears(baud, now_us);
            let Some(servo) = self.servos.iter_mut().find(hears) else { continue };
            delay = delay.max(servo.return_delay_us());
            if let Some((error, data)) = servo.obey(Instruction::Read, what, now_us) {
                shares.push((*id, error, data));
            }
        }
        let mut frame = Vec::new();
        common_answer(&shares, &mut frame);
        if shares.len() < ids.len() {
            frame.truncate(PREFIX);
        }
        self.send(frame, delay);
    }

    fn sync_write(&mut self, parameters: &[u8], now_us: u64) {
        let Some((&[a0, a1, l0, l1], data)) = parameters.split_first_chunk::<4>() else { return };
        let length = usize::from(u16::from_le_bytes([l0, l1]));
        if u16::from_le_bytes([a0, a1]) == crate::xm430::GOAL_POSITION.address {
            self.goal_writes += 1;
        }
        for share in data.chunks_exact(length + 1) {
            self.write_quietly(share[0], [a0, a1], &share[1..], now_us);
        }
    }

    fn bulk_write(&mut self, mut parameters: &[u8], now_us: u64) {
        while let Some((&[id, a0, a1, l0, l1], rest)) = parameters.split_first_chunk::<5>() {
            let length = usize::from(u16::from_le_bytes([l0, l1]));
            let Some((data, rest)) = rest.split_at_checked(length) else { return };
            self.write_quietly(id, [a0, a1], data, now_us);
            parameters = rest;
        }
    }

    fn write_quietly(&mut self, id: u8, address: [u8; 2], data: &[u8], now_us: u64) {
        let baud = self.host_baud;
        let hears = |s: &&mut EmulatedServo| s.id() == id && s.hears(baud, now_us);
        if let Some(servo) = self.servos.iter_mut().find(hears) {
            let parameters = [&address, data].concat();
            servo.obey(Instruction::Write, &parameters, now_us);
        }
    }

    /// Puts an answer on the wire, the faults of the wire included.
    fn send(&mut self, mut frame: Vec<u8>, delay_us: u64) {
        let (faults, stream) = (self.faults, &mut self.stream);
        let mut at = |frame: &[u8]| stream.below(frame.len().max(1) as u64) as usize;
        let mut noise = Vec::new();
        let mut late_us = 0;
        if faults != WireFaults::default() && !frame.is_empty() {
            let (lost, flipped) = (at(&frame), at(&frame));
            let bit = at(&[0; 8]);
            let noisy = at(&[0; 16]) + 1;
            if self.stream.chance(faults.flipped_bit) {
                frame[flipped] ^= 1 << bit;
            }
            if self.stream.chance(faults.lost_byte) {
                frame.remove(lost);
            }
            if self.stream.chance(faults.late) {
                late_us = faults.late_us;
            }
            if self.stream.chance(faults.noise) {
                noise = (0..noisy).map(|_| self.stream.next_u32() as u8).collect();
            }
        }
        noise.extend_from_slice(&frame);
        if self.queue.len() < QUEUE_MAX {
            let wire = wire_us(noise.len(), self.host_baud);
            self.free_at_us += delay_us + wire + late_us;
            self.queue.push_back((self.free_at_us, noise));
        }
    }

    /// When the next answer has arrived, µs.
    pub fn next_due_us(&self) -> Option<u64> {
        self.queue.front().map(|(due, _)| *due)
    }

    /// Appends to `out` what has arrived at the host by `now_us`.
    pub fn collect(&mut self, now_us: u64, out: &mut Vec<u8>) {
        while self.next_due_us().is_some_and(|due| due <= now_us) {
            if let Some((_, bytes)) = self.queue.pop_front() {
                out.extend_from_slice(&bytes);
            }
        }
    }
}
