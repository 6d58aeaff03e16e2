//! Transactions with servos: one question, its answers, a deadline.
//!
//! The protocol numbers nothing, so a late answer looks like one to the next question. Input is thrown away
//! before every question, and after a question that missed answers the bus is left quiet first ([`QUIET`]).

use std::io;
use std::time::{Duration, Instant};

use crate::frame::{BROADCAST_ID, FRAME_MAX, Framer, Instruction, STATUS, encode, unstuff};
use crate::group::{Answer, GroupRead, GroupWrite};
use crate::port::Port;
use crate::status::{ErrorNumber, StatusError};
use crate::units::wire_us;
use crate::xm430::Register;

/// Time for one answer during set-up: 500 µs of return delay at 57,600 baud fit.
pub const SETUP_DEADLINE: Duration = Duration::from_millis(50);

/// How long answers that are too late are waited for before the next question.
pub const QUIET: Duration = Duration::from_millis(1);
/// Fast Sync Reads in a row that may fail before plain Sync Read is used instead.
pub const FAST_FAILURES_MAX: u32 = 3;

/// Why a question has no answer.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum BusFault {
    /// The port fails.
    #[error("the serial port failed: {0}")]
    Port(#[from] io::Error),
    /// Nothing in time.
    #[error("servo {id} did not answer within {} ms", deadline.as_millis())]
    Silent { id: u8, deadline: Duration },
    /// The servo says no.
    #[error("servo {id} refused: {error}")]
    Refused { id: u8, error: ErrorNumber },
}

/// What a bus counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusCounts {
    /// Questions.
    pub transactions: u64,
    /// Servos that did not answer in time.
    pub silent: u64,
    /// Frames with a wrong CRC.
    pub crc_errors: u64,
    /// Bytes that belonged to no frame.
    pub skipped_bytes: u64,
    /// Whole frames that answered nothing that was asked.
    pub unexpected: u64,
    /// Answers with the alert bit.
    pub alerts: u64,
}

/// Answer of one servo to a ping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pong {
    /// Model number.
    pub model: u16,
    /// Version of its firmware.
    pub firmware: u8,
    /// Error byte.
    pub error: StatusError,
}

/// The host's end of the bus.
#[derive(Debug)]
pub struct Bus<P> {
    port: P,
    baud: u32,
    framer: Framer,
    request: Vec<u8>,
    scratch: Box<[u8]>,
    /// Bytes taken after the deadline of this question.
    late_bytes: usize,
    unquiet: bool,
    fast_failures: u32,
    /// Time for one answer during set-up.
    pub setup_deadline: Duration,
    counts: BusCounts,
}

impl<P: Port> Bus<P> {
    /// A bus over `port`, which is set to `baud` already.
    pub fn new(port: P, baud: u32) -> Self {
        Self {
            port,
            baud,
            framer: Framer::new(),
            request: Vec::with_capacity(256),
            scratch: vec![0; FRAME_MAX].into_boxed_slice(),
            late_bytes: 0,
            unquiet: false,
            fast_failures: 0,
            setup_deadline: SETUP_DEADLINE,
            counts: BusCounts::default(),
        }
    }

    /// Waits at least `deadline` for each answer during set-up, where nothing moves: for a far end that is
    /// slow.
    pub fn be_patient(&mut self, deadline: Duration) {
        self.setup_deadline = SETUP_DEADLINE.max(deadline);
    }

    /// What was counted so far.
    pub fn counts(&self) -> BusCounts {
        BusCounts {
            crc_errors: self.framer.crc_errors,
            skipped_bytes: self.framer.skipped,
            ..self.counts
        }
    }

    /// Bits per second.
    pub fn baud(&self) -> u32 {
        self.baud
    }

    /// The time that deadlines of this bus are told by.
    pub fn now(&self) -> Instant {
        self.port.now()
    }

    /// The port.
    pub fn port_mut(&mut self) -> &mut P {
        &mut self.port
    }

    /// Changes the speed of this end.
    ///
    /// # Errors
    /// [`BusFault::Port`].
    pub fn set_baud(&mut self, baud: u32) -> Result<(), BusFault> {
        self.port.set_baud(baud)?;
        self.baud = baud;
        Ok(())
    }

    /// Asks whether servo `id` is there.
    pub fn ping(&mut self, id: u8, deadline: Duration) -> Result<Pong, BusFault> {
        let (error, length) = self.ask(id, Instruction::Ping, &[], 3, deadline)?;
        let &[low, high, firmware] = &self.scratch[..length] else {
            return Err(BusFault::Silent { id, deadline });
        };
        Ok(Pong { model: u16::from_le_bytes([low, high]), firmware, error })
    }

    /// Reads one register, sign by its size. The error byte comes along: it may hold an alert.
    pub fn read(
        &mut self,
        id: u8,
        register: &Register,
        deadline: Duration,
    ) -> Result<(i32, StatusError), BusFault> {
        let [a0, a1] = register.address.to_le_bytes();
        let [s0, s1] = register.size.to_le_bytes();
        let size = usize::from(register.size);
        let (error, _) = self.ask(id, Instruction::Read, &[a0, a1, s0, s1], size, deadline)?;
        let value = register.value_in(&self.scratch[..size], register.address);
        value.map(|value| (value, error)).ok_or(BusFault::Silent { id, deadline })
    }

    /// Reads `out.len()` bytes from `address`.
    pub fn read_block(
        &mut self,
        id: u8,
        address: u16,
        out: &mut [u8],
        deadline: Duration,
    ) -> Result<StatusError, BusFault> {
        let [a0, a1] = address.to_le_bytes();
        let [s0, s1] = (out.len() as u16).to_le_bytes();
        let parameters = [a0, a1, s0, s1];
        let (error, length) = self.ask(id, Instruction::Read, &parameters, out.len(), deadline)?;
        out.copy_from_slice(&self.scratch[..length]);
        Ok(error)
    }

    /// Writes one register.
    pub fn write(
        &mut self,
        id: u8,
        register: &Register,
        value: i32,
        deadline: Duration,
    ) -> Result<StatusError, BusFault> {
        let [a0, a1] = register.address.to_le_bytes();
        let [v0, v1, v2, v3] = register.bytes_of(value);
        let parameters = [a0, a1, v0, v1, v2, v3];
        let used = 2 + usize::from(register.size);
        let (error, _) = self.ask(id, Instruction::Write, &parameters[..used], 0, deadline)?;
        Ok(error)
    }

    /// Restarts a servo: its torque goes off, and everything that is not kept without power is as new.
    pub fn reboot(&mut self, id: u8, deadline: Duration) -> Result<StatusError, BusFault> {
        let (error, _) = self.ask(id, Instruction::Reboot, &[], 0, deadline)?;
        Ok(error)
    }

    /// Reads a group; who did not answer in time is [`crate::Answer::Silent`] in it.
    ///
    /// # Errors
    /// [`BusFault::Port`] only.
    pub fn read_group(
        &mut self,
        group: &mut GroupRead,
        deadline: Duration,
    ) -> Result<(), BusFault> {
        group.begin();
        let end = self.now() + deadline;
        self.begin(end)?;
        self.port.send(&group.request, end)?;
        while group.missing() > 0 && self.listen(end)? {
            while let Some(frame) = self.framer.next_frame() {
                if frame.instruction() != STATUS {
                    continue;
                }
                let body = &frame.body()[1..];
                let id = frame.id();
                let taken = if group.fast && id == BROADCAST_ID {
                    group.take_common(body)
                } else {
                    self.scratch[..body.len()].copy_from_slice(body);
                    let length = unstuff(&mut self.scratch[..body.len()]);
                    match &self.scratch[..length] {
                        [error, data @ ..] => group.take(id, StatusError(*error), data),
                        [] => false,
                    }
                };
                self.counts.unexpected += u64::from(!taken);
            }
        }
        let missing = group.missing();
        self.counts.silent += missing as u64;
        self.unquiet = missing > 0;
        for answer in &group.answers {
            let error = match answer {
                Answer::Silent => continue,
                Answer::Data(error) | Answer::Refused(error) => *error,
            };
            self.counts.alerts += u64::from(error.alert());
        }
        if group.fast {
            let failed = missing == group.len();
            self.fast_failures = if failed { self.fast_failures + 1 } else { 0 };
        }
        Ok(())
    }

    /// Whether Fast Sync Read failed so often in a row that plain Sync Read should take its place.
    pub fn fast_is_hopeless(&self) -> bool {
        self.fast_failures >= FAST_FAILURES_MAX
    }

    /// Writes a group. Nobody answers.
    ///
    /// # Errors
    /// [`BusFault::Port`].
    pub fn write_group(
        &mut self,
        group: &mut GroupWrite,
        deadline: Duration,
    ) -> Result<(), BusFault> {
        group.prepare();
        self.counts.transactions += 1;
        let end = self.now() + deadline;
        self.port.send(&group.request, end)?;
        Ok(())
    }

    /// Writes one register of every servo at once. Nobody answers.
    ///
    /// # Errors
    /// [`BusFault::Port`].
    pub fn broadcast(&mut self, register: &Register, value: i32) -> Result<(), BusFault> {
        let [a0, a1] = register.address.to_le_bytes();
        let [v0, v1, v2, v3] = register.bytes_of(value);
        let used = 2 + usize::from(register.size);
        self.request.clear();
        encode(
            BROADCAST_ID,
            Instruction::Write as u8,
            &[a0, a1, v0, v1, v2, v3][..used],
            &mut self.request,
        );
        self.counts.transactions += 1;
        let wire = Duration::from_micros(2 * wire_us(self.request.len(), self.baud));
        let end = self.now() + wire + QUIET * 10;
        self.port.send(&self.request, end)?;
        Ok(())
    }

    /// One question to one servo; error byte, and length of the parameters, which are in `scratch`.
    fn ask(
        &mut self,
        id: u8,
        instruction: Instruction,
        parameters: &[u8],
        expected: usize,
        deadline: Duration,
    ) -> Result<(StatusError, usize), BusFault> {
        let end = self.now() + deadline;
        self.begin(end)?;
        self.request.clear();
        encode(id, instruction as u8, parameters, &mut self.request);
        self.port.send(&self.request, end)?;
        while self.listen(end)? {
            while let Some(frame) = self.framer.next_frame() {
                if frame.instruction() != STATUS {
                    continue;
                }
                let (from, body) = (frame.id(), &frame.body()[1..]);
                self.scratch[..body.len()].copy_from_slice(body);
                let length = unstuff(&mut self.scratch[..body.len()]);
                if from != id || length == 0 {
                    self.counts.unexpected += 1;
                    continue;
                }
                let error = StatusError(self.scratch[0]);
                self.counts.alerts += u64::from(error.alert());
                if let Some(error) = error.number() {
                    return Err(BusFault::Refused { id, error });
                }
                if length - 1 != expected {
                    self.counts.unexpected += 1;
                    continue;
                }
                self.scratch.copy_within(1..length, 0);
                return Ok((error, length - 1));
            }
        }
        self.counts.silent += 1;
        self.unquiet = true;
        Err(BusFault::Silent { id, deadline })
    }

    /// Before a question: nothing old is left over.
    fn begin(&mut self, end: Instant) -> Result<(), BusFault> {
        self.counts.transactions += 1;
        if std::mem::take(&mut self.unquiet) {
            let quiet = end.min(self.now() + QUIET);
            while self.port.receive(&mut self.scratch, quiet)? > 0 && self.now() < quiet {}
        }
        self.port.discard_input()?;
        self.framer.clear();
        self.late_bytes = 0;
        Ok(())
    }

    /// Takes what arrives; false at the deadline. What is there already is taken after it too, for a machine
    /// that was busy, but only as much as one question can bring: a bus that babbles without end must not
    /// hold the caller.
    fn listen(&mut self, end: Instant) -> Result<bool, BusFault> {
        if self.late_bytes > FRAME_MAX {
            return Ok(false);
        }
        let room = self.framer.room().min(self.scratch.len());
        let room = room.max(1);
        let count = self.port.receive(&mut self.scratch[..room], end)?;
        self.framer.push(&self.scratch[..count]);
        if self.now() > end {
            self.late_bytes += count;
        }
        Ok(count > 0)
    }
}
