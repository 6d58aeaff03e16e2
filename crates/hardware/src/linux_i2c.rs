//! A Linux I²C bus (`/dev/i2c-N`). The only `unsafe` code of this crate: the one ioctl that names the chip to
//! talk to.
#![allow(unsafe_code)]

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::path::Path;

use rustix::ioctl::{IntegerSetter, ioctl};

use crate::i2c::I2c;

/// `I2C_SLAVE` of linux/i2c-dev.h.
const I2C_SLAVE: rustix::ioctl::Opcode = 0x0703;

/// A bus. The kernel's driver bounds how long a transfer takes (1 s unless set otherwise).
#[derive(Debug)]
pub struct LinuxI2c {
    file: File,
    chip: Option<u8>,
}

impl LinuxI2c {
    /// Opens the bus at `path`.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().read(true).write(true).open(path)?;
        Ok(Self { file, chip: None })
    }

    fn talk_to(&mut self, chip: u8) -> io::Result<()> {
        if self.chip != Some(chip) {
            // SAFETY: I2C_SLAVE takes an integer by value, a 7-bit address, and writes to no memory of ours.
            unsafe {
                let address = IntegerSetter::<I2C_SLAVE>::new_usize(usize::from(chip & 0x7F));
                ioctl(&self.file, address)?;
            }
            self.chip = Some(chip);
        }
        Ok(())
    }
}

impl I2c for LinuxI2c {
    fn write(&mut self, chip: u8, bytes: &[u8]) -> io::Result<()> {
        self.talk_to(chip)?;
        self.file.write_all(bytes)
    }

    fn write_read(&mut self, chip: u8, bytes: &[u8], out: &mut [u8]) -> io::Result<()> {
        self.write(chip, bytes)?;
        self.file.read_exact(out)
    }
}
