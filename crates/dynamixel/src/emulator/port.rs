//! An emulated bus behind the host's port trait, in one process and with a time of its own: waiting costs
//! nothing.

use std::io;
use std::time::{Duration, Instant};

use crate::emulator::EmulatedBus;
use crate::port::Port;

/// What a byte of noise takes: ten bits at a million a second, µs.
const NOISE_US: u64 = 10;

/// The host's end of an [`EmulatedBus`]. Its time moves when the host waits.
#[derive(Debug)]
pub struct EmulatedPort {
    /// The far end.
    pub bus: EmulatedBus,
    /// Time over there, µs.
    pub now_us: u64,
    /// When its time began, by the machine's clock, which is not looked at again.
    start: Instant,
    arrived: Vec<u8>,
    /// Noise without end: as many bytes as the host takes.
    pub babbles: bool,
}

impl EmulatedPort {
    /// A port to `bus`.
    pub fn new(bus: EmulatedBus) -> Self {
        Self { bus, now_us: 0, start: Instant::now(), arrived: Vec::new(), babbles: false }
    }

    /// Lets time pass.
    pub fn wait_us(&mut self, us: u64) {
        self.now_us += us;
        self.bus.pass(self.now_us);
    }
}

impl Port for EmulatedPort {
    fn now(&self) -> Instant {
        self.start + Duration::from_micros(self.now_us)
    }

    fn send(&mut self, bytes: &[u8], _: Instant) -> io::Result<()> {
        self.bus.hear(bytes, self.now_us);
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        if self.babbles {
            buffer.fill(0xFF);
            self.wait_us(buffer.len() as u64 * NOISE_US);
            return Ok(buffer.len());
        }
        if self.arrived.is_empty() {
            let left = deadline.saturating_duration_since(self.now());
            let end = self.now_us + left.as_micros() as u64;
            let due = self.bus.next_due_us().map_or(end, |due| due.min(end));
            self.wait_us(due.saturating_sub(self.now_us));
            self.bus.collect(self.now_us, &mut self.arrived);
        }
        let count = self.arrived.len().min(buffer.len());
        buffer[..count].copy_from_slice(&self.arrived[..count]);
        self.arrived.drain(..count);
        Ok(count)
    }

    fn discard_input(&mut self) -> io::Result<()> {
        self.bus.collect(self.now_us, &mut self.arrived);
        self.arrived.clear();
        Ok(())
    }

    fn set_baud(&mut self, baud: u32) -> io::Result<()> {
        self.bus.host_baud = baud;
        Ok(())
    }
}
