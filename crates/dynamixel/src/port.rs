//! A port that bytes go through, and the serial port of a Linux machine.

use std::fs::{File, TryLockError};
use std::io::{self, ErrorKind};
use std::path::Path;
use std::time::Instant;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::termios::{
    ControlModes, OptionalActions, QueueSelector, SpecialCodeIndex, tcflush, tcgetattr, tcsetattr,
};

/// Bytes out and in, each with a deadline.
pub trait Port {
    /// What deadlines are told by: the machine's clock, or the time of a far end that has its own.
    fn now(&self) -> Instant {
        Instant::now()
    }

    /// Sends all of `bytes`.
    ///
    /// # Errors
    /// `TimedOut` at the deadline; what the system says.
    fn send(&mut self, bytes: &[u8], deadline: Instant) -> io::Result<()>;

    /// What has arrived, at least one byte; 0 where nothing came until `deadline`.
    ///
    /// # Errors
    /// What the system says; a port that is gone is `UnexpectedEof`.
    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize>;

    /// Throws away what has arrived and was not received.
    fn discard_input(&mut self) -> io::Result<()>;

    /// Bits per second from now on.
    ///
    /// # Errors
    /// What the system says, also where the port cannot go that fast.
    fn set_baud(&mut self, baud: u32) -> io::Result<()>;
}

/// A serial port: raw bytes, 8 bits, no parity, one stop bit, no flow control.
///
/// USB adapters with an FTDI chip hold bytes back for 16 ms unless their latency timer is 1 ms
/// (`/sys/bus/usb-serial/devices/ttyUSB0/latency_timer`); a tick of 20 ms does not work otherwise.
/// `caudata-robot doctor` measures the round trip.
#[derive(Debug)]
pub struct SerialPort {
    file: File,
}

impl Drop for SerialPort {
    fn drop(&mut self) {
        // A child process that is just being started shares the lock until it runs its own program.
        let _ = self.file.unlock();
    }
}

impl SerialPort {
    /// Opens the port at `path` for this program alone: two that speak on one bus take each other's answers.
    /// Nothing about the port is changed where another program has it. The system lets go of the lock however
    /// the program ends.
    ///
    /// # Errors
    /// `ResourceBusy` where another program has it; what the system says; a file that is no terminal cannot
    /// be set up.
    pub fn open(path: &Path, baud: u32) -> io::Result<Self> {
        let (port, alone) = Self::open_whoever_has_it(path)?;
        if !alone {
            return Err(io::Error::new(ErrorKind::ResourceBusy, "another program has this port"));
        }
        port.at(baud)
    }

    /// Opens the port at `path` also where another program has it, for orders that count whatever others do;
    /// with `true` where this program has it alone.
    ///
    /// # Errors
    /// As [`SerialPort::open`], but for `ResourceBusy`.
    pub fn open_anyway(path: &Path, baud: u32) -> io::Result<(Self, bool)> {
        let (port, alone) = Self::open_whoever_has_it(path)?;
        Ok((port.at(baud)?, alone))
    }

    fn at(mut self, baud: u32) -> io::Result<Self> {
        self.set_baud(baud)?;
        self.discard_input()?;
        Ok(self)
    }

    fn open_whoever_has_it(path: &Path) -> io::Result<(Self, bool)> {
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = File::from(open(path, flags, Mode::empty())?);
        let alone = match file.try_lock() {
            Ok(()) => true,
            Err(TryLockError::WouldBlock) => false,
            Err(TryLockError::Error(error)) => return Err(error),
        };
        Ok((Self { file }, alone))
    }

    /// Waits for `wanted`; false at the deadline.
    fn ready(&self, wanted: PollFlags, deadline: Instant) -> io::Result<bool> {
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let timeout = Timespec {
                tv_sec: i64::try_from(left.as_secs()).unwrap_or(i64::MAX),
                tv_nsec: i64::from(left.subsec_nanos()),
            };
            let mut fds = [PollFd::new(&self.file, wanted)];
            match poll(&mut fds, Some(&timeout)) {
                Ok(0) => return Ok(false),
                Ok(_) => return Ok(true),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(e.into()),
            }
        }
    }
}

fn gone() -> io::Error {
    io::Error::new(ErrorKind::UnexpectedEof, "the port is gone")
}

impl Port for SerialPort {
    fn send(&mut self, mut bytes: &[u8], deadline: Instant) -> io::Result<()> {
        while !bytes.is_empty() {
            match rustix::io::write(&self.file, bytes) {
                Ok(0) => return Err(gone()),
                Ok(n) => bytes = &bytes[n..],
                Err(rustix::io::Errno::INTR) => {}
                Err(rustix::io::Errno::AGAIN) => {
                    if !self.ready(PollFlags::OUT, deadline)? {
                        return Err(io::Error::new(ErrorKind::TimedOut, "the port takes no bytes"));
                    }
                }
                Err(e) => return Err(e.into()),
            }
        }
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8], deadline: Instant) -> io::Result<usize> {
        loop {
            match rustix::io::read(&self.file, &mut *buffer) {
                Ok(0) => return Err(gone()),
                Ok(n) => return Ok(n),
                Err(rustix::io::Errno::INTR) => {}
                Err(rustix::io::Errno::AGAIN) => {
                    if !self.ready(PollFlags::IN, deadline)? {
                        return Ok(0);
                    }
                }
                Err(e) => return Err(e.into()),
            }
        }
    }

    fn discard_input(&mut self) -> io::Result<()> {
        tcflush(&self.file, QueueSelector::IFlush).map_err(Into::into)
    }

    fn set_baud(&mut self, baud: u32) -> io::Result<()> {
        let mut settings = tcgetattr(&self.file)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
        settings.control_modes -=
            ControlModes::CSTOPB | ControlModes::PARENB | ControlModes::CRTSCTS;
        // With 0 an empty port would look like one that is gone.
        settings.special_codes[SpecialCodeIndex::VMIN] = 1;
        settings.special_codes[SpecialCodeIndex::VTIME] = 0;
        settings.set_speed(baud)?;
        tcsetattr(&self.file, OptionalActions::Now, &settings)?;
        Ok(())
    }
}
