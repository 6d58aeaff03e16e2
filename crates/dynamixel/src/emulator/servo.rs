//! One emulated XM430: its control table, who may write what and when, its watchdog and its reboot.

use crate::frame::Instruction;
use crate::status::{ErrorNumber, HardwareError, StatusError};
use crate::units::{BUS_WATCHDOG_LSB_MS, RETURN_DELAY_LSB_US, baud_of_register};
use crate::xm430::{self, Area, REGISTERS, Register, TABLE_BYTES};

/// How long a servo says nothing after a reboot, µs.
pub const BOOT_US: u64 = 300_000;
/// Value of Bus Watchdog that says that it has fired (−1).
const FIRED: u8 = 0xFF;

/// What its sensors show, in units of its registers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Present {
    /// Counts.
    pub position: i32,
    /// 0.229 rev/min.
    pub velocity: i32,
    /// 2.69 mA.
    pub current: i16,
    /// 0.1 V.
    pub voltage: u16,
    /// °C.
    pub temperature: u8,
}

/// One servo.
#[derive(Clone, Debug)]
pub struct EmulatedServo {
    table: [u8; TABLE_BYTES],
    heard_us: u64,
    boots_until_us: u64,
    booted_us: u64,
    /// Its cable is cut.
    pub unplugged: bool,
    /// Keeps its torque as it is, whatever it is told: a servo that does not let go.
    pub jammed: bool,
}

impl EmulatedServo {
    /// A servo as it comes from the factory, but for its id.
    pub fn new(id: u8, model: u16) -> Self {
        let mut servo = Self {
            table: [0; TABLE_BYTES],
            heard_us: 0,
            boots_until_us: 0,
            booted_us: 0,
            unplugged: false,
            jammed: false,
        };
        for register in REGISTERS {
            servo.put(register, register.initial);
        }
        servo.put(&xm430::MODEL_NUMBER, i32::from(model));
        servo.put(&xm430::ID, i32::from(id));
        servo
    }

    /// Its id.
    pub fn id(&self) -> u8 {
        self.get(&xm430::ID) as u8
    }

    /// A register's value.
    pub fn get(&self, register: &Register) -> i32 {
        register.value_in(&self.table, 0).unwrap_or_default()
    }

    /// Sets a register, whatever the rules for the bus are.
    pub fn put(&mut self, register: &Register, value: i32) {
        let (start, size) = (usize::from(register.address), usize::from(register.size));
        self.table[start..start + size].copy_from_slice(&register.bytes_of(value)[..size]);
    }

    /// Whether the torque is on.
    pub fn torque_on(&self) -> bool {
        self.get(&xm430::TORQUE_ENABLE) == 1
    }

    /// Where it turns to, counts; where it is, when its watchdog has fired.
    pub fn goal(&self) -> i32 {
        self.get(&xm430::GOAL_POSITION)
    }

    /// Whether its watchdog has fired.
    pub fn watchdog_fired(&self) -> bool {
        self.table[usize::from(xm430::BUS_WATCHDOG.address)] == FIRED
    }

    /// Takes over what its sensors show.
    pub fn sense(&mut self, present: Present, now_us: u64) {
        self.put(&xm430::PRESENT_POSITION, present.position);
        self.put(&xm430::PRESENT_VELOCITY, present.velocity);
        self.put(&xm430::PRESENT_CURRENT, i32::from(present.current));
        self.put(&xm430::PRESENT_INPUT_VOLTAGE, i32::from(present.voltage));
        self.put(&xm430::PRESENT_TEMPERATURE, i32::from(present.temperature));
        let tick = (now_us.saturating_sub(self.booted_us) / 1000) % 32_768;
        self.put(&xm430::REALTIME_TICK, tick as i32);
    }

    /// A hardware error is latched. Those named in Shutdown switch the torque off.
    pub fn raise(&mut self, error: HardwareError) {
        let all = self.get(&xm430::HARDWARE_ERROR_STATUS) | i32::from(error.0);
        self.put(&xm430::HARDWARE_ERROR_STATUS, all);
        if all & self.get(&xm430::SHUTDOWN) != 0 {
            self.put(&xm430::TORQUE_ENABLE, 0);
        }
    }

    /// Restarts: what is not kept without power is as new.
    pub fn reboot(&mut self, now_us: u64) {
        for register in REGISTERS.iter().filter(|r| r.area == Area::Ram) {
            self.put(register, register.initial);
        }
        self.boots_until_us = now_us + BOOT_US;
        self.booted_us = now_us;
    }

    /// Whether it understands a host of this speed now.
    pub(super) fn hears(&self, baud: u32, now_us: u64) -> bool {
        let own = baud_of_register(self.get(&xm430::BAUD_RATE) as u8);
        !self.unplugged && now_us >= self.boots_until_us && own == Some(baud)
    }

    pub(super) fn return_delay_us(&self) -> u64 {
        self.get(&xm430::RETURN_DELAY_TIME) as u64 * RETURN_DELAY_LSB_US
    }

    /// Lets time pass: the watchdog.
    pub(super) fn pass(&mut self, now_us: u64) {
        let units = self.table[usize::from(xm430::BUS_WATCHDOG.address)];
        let limit_us = u64::from(units) * BUS_WATCHDOG_LSB_MS * 1000;
        let silent_us = now_us.saturating_sub(self.heard_us);
        if (1..=127).contains(&units) && self.torque_on() && silent_us > limit_us {
            self.put(&xm430::BUS_WATCHDOG, i32::from(FIRED));
            self.put(&xm430::GOAL_POSITION, self.get(&xm430::PRESENT_POSITION));
        }
    }

    pub(super) fn error(&self, number: Option<ErrorNumber>) -> StatusError {
        let alert = self.get(&xm430::HARDWARE_ERROR_STATUS) != 0;
        StatusError(u8::from(alert) << 7 | number.map_or(0, |number| number.0))
    }

    /// Does as it is told; error byte and data of the answer. `None`: it does not answer this.
    pub(super) fn obey(
        &mut self,
        instruction: Instruction,
        parameters: &[u8],
        now_us: u64,
    ) -> Option<(StatusError, Vec<u8>)> {
        self.heard_us = now_us;
        let level = self.get(&xm430::STATUS_RETURN_LEVEL);
        let (number, data, level_needed) = match instruction {
            Instruction::Ping => {
                let model = self.get(&xm430::MODEL_NUMBER).to_le_bytes();
                let firmware = self.get(&xm430::FIRMWARE_VERSION) as u8;
                (None, vec![model[0], model[1], firmware], 0)
            }
            Instruction::Read => match self.read(parameters) {
                Ok(data) => (None, data, 1),
                Err(number) => (Some(number), Vec::new(), 1),
            },
            Instruction::Write => (self.write(parameters).err(), Vec::new(), 2),
            Instruction::Reboot => {
                let error = self.error(None);
                self.reboot(now_us);
                return (level >= 2).then_some((error, Vec::new()));
            }
            _ => (Some(ErrorNumber::INSTRUCTION), Vec::new(), 2),
        };
        (level >= level_needed).then(|| (self.error(number), data))
    }

    fn read(&self, parameters: &[u8]) -> Result<Vec<u8>, ErrorNumber> {
        let &[a0, a1, l0, l1] = parameters else { return Err(ErrorNumber::DATA_LENGTH) };
        let start = usize::from(u16::from_le_bytes([a0, a1]));
        let length = usize::from(u16::from_le_bytes([l0, l1]));
        let bytes = self.table.get(start..start + length);
        bytes.map(<[u8]>::to_vec).ok_or(ErrorNumber::DATA_RANGE)
    }

    fn write(&mut self, parameters: &[u8]) -> Result<(), ErrorNumber> {
        let Some((&[a0, a1], mut data)) = parameters.split_first_chunk::<2>() else {
            return Err(ErrorNumber::DATA_LENGTH);
        };
        let mut address = u16::from_le_bytes([a0, a1]);
        while !data.is_empty() {
            let register = xm430::register_at(address).ok_or(ErrorNumber::ACCESS)?;
            let size = usize::from(register.size);
            let (value, rest) = data.split_at_checked(size).ok_or(ErrorNumber::DATA_LENGTH)?;
            let value = register.value_in(value, address).ok_or(ErrorNumber::DATA_LENGTH)?;
            self.write_one(register, value)?;
            address += register.size;
            data = rest;
        }
        Ok(())
    }

    fn write_one(&mut self, register: &Register, value: i32) -> Result<(), ErrorNumber> {
        let locked = register.area == Area::Eeprom && self.torque_on();
        if !register.writable || locked {
            return Err(ErrorNumber::ACCESS);
        }
        let at = |r: &Register| r.address == register.address;
        let goal = at(&xm430::GOAL_POSITION) || at(&xm430::GOAL_CURRENT);
        if goal && self.watchdog_fired() {
            return Err(ErrorNumber::DATA_RANGE);
        }
        if at(&xm430::GOAL_POSITION) && self.get(&xm430::OPERATING_MODE) == 3 {
            let low = self.get(&xm430::MIN_POSITION_LIMIT);
            let high = self.get(&xm430::MAX_POSITION_LIMIT);
            if !(low..=high).contains(&value) {
                return Err(ErrorNumber::DATA_LIMIT);
            }
        }
        let fits = match register.address {
            a if a == xm430::TORQUE_ENABLE.address => (0..=1).contains(&value),
            a if a == xm430::BUS_WATCHDOG.address => (0..=127).contains(&value),
            a if a == xm430::BAUD_RATE.address => baud_of_register(value as u8).is_some(),
            a if a == xm430::ID.address => (0..=252).contains(&value),
            a if a == xm430::OPERATING_MODE.address => [0, 1, 3, 4, 5, 16].contains(&value),
            _ => true,
        };
        if !fits {
            return Err(ErrorNumber::DATA_RANGE);
        }
        // A latched error that shuts down keeps the torque off until a reboot.
        let latched = self.get(&xm430::HARDWARE_ERROR_STATUS) & self.get(&xm430::SHUTDOWN) != 0;
        if at(&xm430::TORQUE_ENABLE) && value == 1 && latched {
            return Err(ErrorNumber::ACCESS);
        }
        if at(&xm430::TORQUE_ENABLE) && self.jammed {
            return Ok(());
        }
        self.put(register, value);
        Ok(())
    }
}
