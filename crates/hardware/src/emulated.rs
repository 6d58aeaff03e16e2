//! An emulated chip: a register map that answers as an LSM6DSOX does, directly or behind an emulated serial bridge.

use std::collections::VecDeque;
use std::io;

use crate::i2c::{BRIDGE_BYTES_MAX, I2c};
use crate::registers::*;

/// The second low-pass filter as the mean of this many samples: five of 4 ms let through half the power at 22
/// Hz, the chip's does at 21 Hz.
const FILTER_SAMPLES: usize = 5;
/// Longest request that a bridge understands.
const REQUEST_MAX: usize = 64;

/// The chip.
#[derive(Clone, Debug)]
pub struct EmulatedImu {
    lsm6: [u8; 0x80],
    /// Accelerations felt last, for the low-pass filter.
    acc_mps2: VecDeque<[f32; 3]>,
    /// Its cable is cut: nobody acknowledges.
    pub unplugged: bool,
}

impl Default for EmulatedImu {
    fn default() -> Self {
        let mut lsm6 = [0; 0x80];
        lsm6[usize::from(WHO_AM_I)] = LSM6_ID;
        lsm6[usize::from(LSM6_CTRL3_C)] = 0b100;
        Self { lsm6, acc_mps2: VecDeque::with_capacity(FILTER_SAMPLES), unplugged: false }
    }
}

/// In units of `lsb`, saturated as the chip does.
fn raw(value: f32, lsb: f32) -> [u8; 2] {
    ((value / lsb).round() as i16).to_le_bytes()
}

impl EmulatedImu {
    /// What the chip feels from now on, in its own axes: rad/s, m/s². To be called every 4 ms.
    pub fn feel(&mut self, gyro_radps: [f32; 3], acc_mps2: [f32; 3]) {
        let acc_mps2 = self.filtered(acc_mps2);
        for axis in 0..3 {
            let at = usize::from(LSM6_OUT) + 2 * axis;
            self.lsm6[at..at + 2].copy_from_slice(&raw(gyro_radps[axis], LSM6_RATE_LSB_RADPS));
            let at = at + 6;
            self.lsm6[at..at + 2].copy_from_slice(&raw(acc_mps2[axis], LSM6_ACC_LSB_MPS2));
        }
        self.lsm6[usize::from(LSM6_STATUS)] = 0b11;
    }

    /// The acceleration behind the low-pass filter, where that is on.
    fn filtered(&mut self, acc_mps2: [f32; 3]) -> [f32; 3] {
        if self.acc_mps2.len() == FILTER_SAMPLES {
            self.acc_mps2.pop_front();
        }
        self.acc_mps2.push_back(acc_mps2);
        if self.lsm6[usize::from(LSM6_CTRL1_XL)] & LSM6_LPF2 == 0 {
            return acc_mps2;
        }
        let count = self.acc_mps2.len() as f32;
        [0, 1, 2].map(|axis| self.acc_mps2.iter().map(|a| a[axis]).sum::<f32>() / count)
    }

    fn chip(&mut self, chip: u8) -> io::Result<&mut [u8; 0x80]> {
        match chip {
            LSM6_ADDRESS if !self.unplugged => Ok(&mut self.lsm6),
            _ => Err(io::Error::other("no chip acknowledges")),
        }
    }
}

impl I2c for EmulatedImu {
    fn write(&mut self, chip: u8, bytes: &[u8]) -> io::Result<()> {
        let registers = self.chip(chip)?;
        if let Some((first, values)) = bytes.split_first() {
            for (offset, value) in values.iter().enumerate() {
                let register = (usize::from(first & 0x7F) + offset) % registers.len();
                if register != usize::from(WHO_AM_I) {
                    registers[register] = *value;
                }
            }
        }
        Ok(())
    }

    fn write_read(&mut self, chip: u8, bytes: &[u8], out: &mut [u8]) -> io::Result<()> {
        let registers = self.chip(chip)?;
        let Some(first) = bytes.first() else { return Ok(()) };
        // it counts up with IF_INC set
        let counts_up = registers[usize::from(LSM6_CTRL3_C)] & 0b100 != 0;
        for (offset, value) in out.iter_mut().enumerate() {
            let offset = if counts_up { offset } else { 0 };
            *value = registers[(usize::from(first & 0x7F) + offset) % registers.len()];
        }
        Ok(())
    }
}

/// The chip's end of a serial bridge: bytes in, bytes out.
#[derive(Clone, Debug, Default)]
pub struct EmulatedBridge {
    /// The chip.
    pub imu: EmulatedImu,
    request: Vec<u8>,
}

impl EmulatedBridge {
    /// Hears bytes and appends what it answers to `out`. A request that makes no sense is dropped.
    pub fn hear(&mut self, bytes: &[u8], out: &mut Vec<u8>) {
        for byte in bytes {
            self.request.push(*byte);
            match parse(&self.request) {
                Request::Incomplete if self.request.len() < REQUEST_MAX => {}
                Request::Whole { chip, write, read } => {
                    let mut answer = vec![0; read];
                    let done = match read {
                        0 => self.imu.write(chip, &write),
                        _ => self.imu.write_read(chip, &write, &mut answer),
                    };
                    // Without an acknowledgement a bridge says nothing.
                    if done.is_ok() {
                        out.extend_from_slice(&answer);
                    }
                    self.request.clear();
                }
                Request::Incomplete | Request::Nonsense => self.request.clear(),
            }
        }
    }
}

enum Request {
    Incomplete,
    Nonsense,
    Whole { chip: u8, write: Vec<u8>, read: usize },
}

fn parse(request: &[u8]) -> Request {
    match request {
        [b'S'] | [b'S', _] => Request::Incomplete,
        [b'S', address, count, rest @ ..] if address & 1 == 0 => {
            let Some((write, rest)) = rest.split_at_checked(usize::from(*count)) else {
                return Request::Incomplete;
            };
            let (chip, write) = (address >> 1, write.to_vec());
            match rest {
                [] | [b'S'] | [b'S', _] | [b'S', _, _] => Request::Incomplete,
                [b'P'] => Request::Whole { chip, write, read: 0 },
                [b'S', again, count, b'P']
                    if again >> 1 == chip
                        && again & 1 == 1
                        && usize::from(*count) <= BRIDGE_BYTES_MAX =>
                {
                    let read = usize::from(*count);
                    Request::Whole { chip, write, read }
                }
                _ => Request::Nonsense,
            }
        }
        _ => Request::Nonsense,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imu::ImuChip;
    use crate::wiring::{Axis, ImuWiring};
    use proptest::prelude::*;

    fn wiring() -> ImuWiring {
        ImuWiring {
            bus: String::new(),
            address: LSM6_ADDRESS,
            axes: [Axis::PlusX, Axis::PlusY, Axis::PlusZ],
        }
    }

    #[test]
    fn values_come_back_within_half_a_unit_in_the_robots_axes() {
        let mut chips = EmulatedImu::default();
        chips.feel([1.0, -0.5, 0.25], [0.0, -9.8, 1.0]);
        // The chip's y points forward, its x to the right (minus left), z up.
        let turned = ImuWiring { axes: [Axis::PlusY, Axis::MinusX, Axis::PlusZ], ..wiring() };
        let mut imu = ImuChip::start(chips, &turned).unwrap();
        let sample = imu.sample().unwrap();
        for (found, expected) in sample.gyro_radps.iter().zip([-0.5, -1.0, 0.25]) {
            assert!((found - expected).abs() < 0.51 * LSM6_RATE_LSB_RADPS, "{sample:?}");
        }
        for (found, expected) in sample.acc_mps2.iter().zip([-9.8, 0.0, 1.0]) {
            assert!((found - expected).abs() < 0.51 * LSM6_ACC_LSB_MPS2, "{sample:?}");
        }
        assert!(!sample.saturated);
    }

    #[test]
    fn the_filter_takes_the_mean_of_twenty_milliseconds() {
        let mut imu = ImuChip::start(EmulatedImu::default(), &wiring()).unwrap();
        // A spike of 20 m/s² in one of five samples.
        for z in [10.0, 10.0, 30.0, 10.0, 10.0] {
            imu.bus_mut().feel([0.0; 3], [0.0, 0.0, z]);
        }
        let z = imu.sample().unwrap().acc_mps2[2];
        assert!((z - 14.0).abs() < LSM6_ACC_LSB_MPS2, "{z}");
    }

    #[test]
    fn the_end_of_the_range_is_told() {
        let mut chips = EmulatedImu::default();
        // ±500 °/s are 8.7 rad/s (32,767 units of 17.5 m°/s are 10 rad/s); 4 g are 39 m/s².
        chips.feel([20.0, 0.0, 0.0], [0.0, 0.0, 9.8]);
        let mut imu = ImuChip::start(chips, &wiring()).unwrap();
        assert!(imu.sample().unwrap().saturated);
    }

    #[test]
    fn another_chip_at_the_address_is_refused() {
        let mut other = EmulatedImu::default();
        other.lsm6[usize::from(WHO_AM_I)] = 0x3D;
        let error = ImuChip::start(other, &wiring()).unwrap_err();
        assert!(error.to_string().contains("0x3d"), "{error}");
    }

    #[test]
    fn a_bridge_speaks_the_data_sheets_commands() {
        let mut bridge = EmulatedBridge::default();
        let mut out = Vec::new();
        // S, 0x6A write, one byte (WHO_AM_I), S, 0x6A read, one byte, P.
        bridge.hear(&[b'S', 0xD4, 1, 0x0F, b'S', 0xD5, 1, b'P'], &mut out);
        assert_eq!(out, [LSM6_ID]);
        out.clear();
        bridge.hear(&[b'S', 0xD4, 2, LSM6_CTRL1_XL, 0x58, b'P'], &mut out);
        assert!(out.is_empty());
        bridge.hear(&[b'S', 0xD4, 1, LSM6_CTRL1_XL, b'S', 0xD5, 1, b'P'], &mut out);
        assert_eq!(out, [0x58]);
        bridge.imu.unplugged = true;
        out.clear();
        bridge.hear(&[b'S', 0xD4, 1, 0x0F, b'S', 0xD5, 1, b'P'], &mut out);
        assert!(out.is_empty(), "nobody acknowledges");
    }

    proptest! {
        #[test]
        fn a_bridge_takes_anything_and_stays_bounded(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
            let mut bridge = EmulatedBridge::default();
            let mut out = Vec::new();
            bridge.hear(&bytes, &mut out);
            prop_assert!(bridge.request.len() <= REQUEST_MAX);
        }
    }
}
