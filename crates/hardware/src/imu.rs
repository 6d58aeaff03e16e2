//! The IMU: an LSM6DSOX.

use std::io::{self, ErrorKind};

use crate::i2c::I2c;
use crate::registers::*;
use crate::wiring::ImuWiring;

/// One sample, in the robot's axes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImuSample {
    /// Angular velocity, rad/s.
    pub gyro_radps: [f32; 3],
    /// Specific force, m/s².
    pub acc_mps2: [f32; 3],
    /// A value is at the end of its range.
    pub saturated: bool,
}

/// The chip on its bus.
#[derive(Debug)]
pub struct ImuChip<B> {
    bus: B,
    wiring: ImuWiring,
}

impl<B: I2c> ImuChip<B> {
    /// Looks for the chip and sets ranges and rates.
    ///
    /// # Errors
    /// What the bus says; another chip at the address is `InvalidData`.
    pub fn start(mut bus: B, wiring: &ImuWiring) -> io::Result<Self> {
        identify(&mut bus, wiring.address)?;
        for (register, value) in [
            (LSM6_CTRL3_C, LSM6_CTRL3_C_VALUE),
            (LSM6_CTRL8_XL, LSM6_CTRL8_XL_VALUE),
            (LSM6_CTRL1_XL, LSM6_CTRL1_XL_VALUE),
            (LSM6_CTRL2_G, LSM6_CTRL2_G_VALUE),
        ] {
            set(&mut bus, wiring.address, register, value)?;
        }
        Ok(Self { bus, wiring: wiring.clone() })
    }

    /// The bus, for tests to play tricks on.
    pub fn bus_mut(&mut self) -> &mut B {
        &mut self.bus
    }

    /// The newest rates and accelerations.
    pub fn sample(&mut self) -> io::Result<ImuSample> {
        let mut block = [0; 12];
        self.bus.write_read(self.wiring.address, &[LSM6_OUT], &mut block)?;
        let raw: [i16; 6] =
            std::array::from_fn(|i| i16::from_le_bytes([block[2 * i], block[2 * i + 1]]));
        let vector =
            |first: usize, lsb: f32| std::array::from_fn(|axis| f32::from(raw[first + axis]) * lsb);
        Ok(ImuSample {
            gyro_radps: self.wiring.turned(vector(0, LSM6_RATE_LSB_RADPS)),
            acc_mps2: self.wiring.turned(vector(3, LSM6_ACC_LSB_MPS2)),
            saturated: raw.iter().any(|v| *v == i16::MAX || *v == i16::MIN),
        })
    }
}

fn identify(bus: &mut impl I2c, chip: u8) -> io::Result<()> {
    let mut id = [0];
    bus.write_read(chip, &[WHO_AM_I], &mut id)?;
    let [found] = id;
    if found == LSM6_ID {
        return Ok(());
    }
    Err(io::Error::new(
        ErrorKind::InvalidData,
        format!("chip {chip:#04x} says {found:#04x}, an LSM6DSOX says {LSM6_ID:#04x}"),
    ))
}

/// Writes a register and reads it back: a chip that takes no settings gives numbers of another scale.
fn set(bus: &mut impl I2c, chip: u8, register: u8, value: u8) -> io::Result<()> {
    bus.write(chip, &[register, value])?;
    let mut found = [0];
    bus.write_read(chip, &[register], &mut found)?;
    if found[0] == value {
        return Ok(());
    }
    let found = found[0];
    Err(io::Error::new(
        ErrorKind::InvalidData,
        format!(
            "chip {chip:#04x} holds {found:#04x} in register {register:#04x}, not {value:#04x}"
        ),
    ))
}
