//! An I²C bus, and a serial bridge to one.

use std::io::{self, ErrorKind};
use std::time::{Duration, Instant};

use caudata_dynamixel::Port;

/// Most bytes that one transfer reads through a bridge.
pub const BRIDGE_BYTES_MAX: usize = 64;
/// Speed of the bridge's serial port.
pub const BRIDGE_BAUD: u32 = 115_200;

/// Transfers to chips with 7-bit addresses.
pub trait I2c {
    /// Writes `bytes`.
    ///
    /// # Errors
    /// What the bus says, also where no chip acknowledges.
    fn write(&mut self, chip: u8, bytes: &[u8]) -> io::Result<()>;

    /// Writes `bytes`, then reads as many as `out` takes.
    ///
    /// # Errors
    /// As [`I2c::write`].
    fn write_read(&mut self, chip: u8, bytes: &[u8], out: &mut [u8]) -> io::Result<()>;
}

impl<T: I2c + ?Sized> I2c for Box<T> {
    fn write(&mut self, chip: u8, bytes: &[u8]) -> io::Result<()> {
        (**self).write(chip, bytes)
    }

    fn write_read(&mut self, chip: u8, bytes: &[u8], out: &mut [u8]) -> io::Result<()> {
        (**self).write_read(chip, bytes, out)
    }
}

/// A serial bridge in the manner of NXP's SC18IM700 (data sheet, "ASCII command protocol"): `S`, address and
/// direction, count, bytes, `P`; a read is answered with its bytes. It lets a computer without an I²C bus, or
/// an emulated robot, take part.
#[derive(Debug)]
pub struct BridgeI2c<P> {
    port: P,
    deadline: Duration,
}

impl<P: Port> BridgeI2c<P> {
    /// A bridge behind `port` that may take `deadline` for a transfer.
    pub fn new(port: P, deadline: Duration) -> Self {
        Self { port, deadline }
    }
}

impl<P: Port> I2c for BridgeI2c<P> {
    fn write(&mut self, chip: u8, bytes: &[u8]) -> io::Result<()> {
        let request = [&[b'S', chip << 1, bytes.len() as u8], bytes, b"P"].concat();
        self.port.send(&request, Instant::now() + self.deadline)
    }

    fn write_read(&mut self, chip: u8, bytes: &[u8], out: &mut [u8]) -> io::Result<()> {
        let end = Instant::now() + self.deadline;
        let mut request = [0; 16];
        let used = 7 + bytes.len();
        if used > request.len() || out.len() > BRIDGE_BYTES_MAX {
            return Err(io::Error::new(
                ErrorKind::InvalidInput,
                "transfer too long for the bridge",
            ));
        }
        request[..3].copy_from_slice(&[b'S', chip << 1, bytes.len() as u8]);
        request[3..3 + bytes.len()].copy_from_slice(bytes);
        let read = [b'S', chip << 1 | 1, out.len() as u8, b'P'];
        request[3 + bytes.len()..used].copy_from_slice(&read);
        self.port.discard_input()?;
        self.port.send(&request[..used], end)?;
        let mut have = 0;
        while have < out.len() {
            match self.port.receive(&mut out[have..], end)? {
                0 => {
                    return Err(io::Error::new(
                        ErrorKind::TimedOut,
                        format!("chip {chip:#04x} gave {have} of {} bytes", out.len()),
                    ));
                }
                count => have += count,
            }
        }
        Ok(())
    }
}
