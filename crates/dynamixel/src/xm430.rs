//! The control table of XM430-W210 and XM430-W350: addresses, sizes, who may write, and what a new servo
//! holds.

/// Where a register lives, and so when it can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Area {
    /// Kept without power; written only while the torque is off.
    Eeprom,
    /// Lost on reboot.
    Ram,
}

/// One register.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Register {
    /// Its name in the manual.
    pub name: &'static str,
    /// Where it begins.
    pub address: u16,
    /// Bytes: 1, 2 or 4, little endian.
    pub size: u16,
    /// Where it lives.
    pub area: Area,
    /// Whether it can be written at all.
    pub writable: bool,
    /// What a new servo holds.
    pub initial: i32,
}

const fn r(
    name: &'static str,
    address: u16,
    size: u16,
    area: Area,
    writable: bool,
    initial: i32,
) -> Register {
    Register { name, address, size, area, writable, initial }
}

macro_rules! registers {
    ($($(#[$doc:meta])* $id:ident = $name:literal, $address:literal, $size:literal, $area:ident, $writable:literal, $initial:literal;)*) => {
        $($(#[$doc])* pub const $id: Register = r($name, $address, $size, Area::$area, $writable, $initial);)*
        /// All registers that are used here, by address.
        pub const REGISTERS: &[Register] = &[$($id),*];
    };
}

registers! {
    /// 1030: W210, 1020: W350.
    MODEL_NUMBER = "Model Number", 0, 2, Eeprom, false, 1030;
    /// Version of the firmware.
    FIRMWARE_VERSION = "Firmware Version", 6, 1, Eeprom, false, 46;
    /// Id on the bus.
    ID = "ID", 7, 1, Eeprom, true, 1;
    /// Code of the baud rate; see [`crate::units::baud_of_register`].
    BAUD_RATE = "Baud Rate", 8, 1, Eeprom, true, 1;
    /// Pause before an answer, 2 µs.
    RETURN_DELAY_TIME = "Return Delay Time", 9, 1, Eeprom, true, 250;
    /// Bit 0: direction reversed. Bit 3: torque on by a goal.
    DRIVE_MODE = "Drive Mode", 10, 1, Eeprom, true, 0;
    /// 3: position; 5: position with a current limit.
    OPERATING_MODE = "Operating Mode", 11, 1, Eeprom, true, 3;
    /// Added to the position, counts.
    HOMING_OFFSET = "Homing Offset", 20, 4, Eeprom, true, 0;
    /// °C.
    TEMPERATURE_LIMIT = "Temperature Limit", 31, 1, Eeprom, true, 80;
    /// 0.1 V.
    MAX_VOLTAGE_LIMIT = "Max Voltage Limit", 32, 2, Eeprom, true, 160;
    /// 0.1 V.
    MIN_VOLTAGE_LIMIT = "Min Voltage Limit", 34, 2, Eeprom, true, 95;
    /// 885 is all of it.
    PWM_LIMIT = "PWM Limit", 36, 2, Eeprom, true, 885;
    /// 2.69 mA.
    CURRENT_LIMIT = "Current Limit", 38, 2, Eeprom, true, 1193;
    /// 0.229 rev/min.
    VELOCITY_LIMIT = "Velocity Limit", 44, 4, Eeprom, true, 330;
    /// Counts.
    MAX_POSITION_LIMIT = "Max Position Limit", 48, 4, Eeprom, true, 4095;
    /// Counts.
    MIN_POSITION_LIMIT = "Min Position Limit", 52, 4, Eeprom, true, 0;
    /// Which hardware errors switch the torque off.
    SHUTDOWN = "Shutdown", 63, 1, Eeprom, true, 52;
    /// 1: on.
    TORQUE_ENABLE = "Torque Enable", 64, 1, Ram, true, 0;
    /// 2: every instruction is answered; 1: only reading.
    STATUS_RETURN_LEVEL = "Status Return Level", 68, 1, Ram, true, 2;
    /// See [`crate::HardwareError`].
    HARDWARE_ERROR_STATUS = "Hardware Error Status", 70, 1, Ram, false, 0;
    /// Divided by 16: gain.
    POSITION_D_GAIN = "Position D Gain", 80, 2, Ram, true, 0;
    /// Divided by 65,536: gain.
    POSITION_I_GAIN = "Position I Gain", 82, 2, Ram, true, 0;
    /// Divided by 128: gain.
    POSITION_P_GAIN = "Position P Gain", 84, 2, Ram, true, 800;
    /// 20 ms; 0: off; −1: has fired, goals are refused until 0 is written.
    BUS_WATCHDOG = "Bus Watchdog", 98, 1, Ram, true, 0;
    /// 2.69 mA; the limit in operating mode 5.
    GOAL_CURRENT = "Goal Current", 102, 2, Ram, true, 1193;
    /// 0: no limit.
    PROFILE_ACCELERATION = "Profile Acceleration", 108, 4, Ram, true, 0;
    /// 0: no limit.
    PROFILE_VELOCITY = "Profile Velocity", 112, 4, Ram, true, 0;
    /// Counts.
    GOAL_POSITION = "Goal Position", 116, 4, Ram, true, 2048;
    /// ms, 0 to 32,767 and again; starts anew on reboot.
    REALTIME_TICK = "Realtime Tick", 120, 2, Ram, false, 0;
    /// 2.69 mA, signed.
    PRESENT_CURRENT = "Present Current", 126, 2, Ram, false, 0;
    /// 0.229 rev/min, signed.
    PRESENT_VELOCITY = "Present Velocity", 128, 4, Ram, false, 0;
    /// Counts.
    PRESENT_POSITION = "Present Position", 132, 4, Ram, false, 2048;
    /// 0.1 V.
    PRESENT_INPUT_VOLTAGE = "Present Input Voltage", 144, 2, Ram, false, 120;
    /// °C.
    PRESENT_TEMPERATURE = "Present Temperature", 146, 1, Ram, false, 25;
}

/// Bytes of the control table that the emulated servo holds.
pub const TABLE_BYTES: usize = 147;

/// Model number of the faster servo.
pub const MODEL_W210: u16 = 1030;
/// Model number of the stronger servo.
pub const MODEL_W350: u16 = 1020;
/// Model number of the XL330-M288-T, whose control table is the same where this one is used.
pub const MODEL_XL330_M288: u16 = 1200;
/// Model number of the XL330-M077-T, likewise.
pub const MODEL_XL330_M077: u16 = 1190;

/// What is read at every tick: current, velocity and position, side by side.
pub const TICK_ADDRESS: u16 = PRESENT_CURRENT.address;
/// Its length.
pub const TICK_BYTES: u16 = 10;
/// What is looked after in turns: torque, alert, gains and watchdog.
pub const CARE_ADDRESS: u16 = TORQUE_ENABLE.address;
/// Its length.
pub const CARE_BYTES: u16 = BUS_WATCHDOG.address + 1 - TORQUE_ENABLE.address;
/// Supply and temperature.
pub const SUPPLY_ADDRESS: u16 = PRESENT_INPUT_VOLTAGE.address;
/// Its length.
pub const SUPPLY_BYTES: u16 = 3;

/// The register that begins at `address`.
pub fn register_at(address: u16) -> Option<&'static Register> {
    REGISTERS.iter().find(|r| r.address == address)
}

impl Register {
    /// Its value within `block`, which begins at `block_address`; signed by size. `None` where it is not in
    /// there.
    pub fn value_in(&self, block: &[u8], block_address: u16) -> Option<i32> {
        let start = usize::from(self.address.checked_sub(block_address)?);
        let bytes = block.get(start..start + usize::from(self.size))?;
        Some(match *bytes {
            [a] => i32::from(a),
            [a, b] => i32::from(i16::from_le_bytes([a, b])),
            [a, b, c, d] => i32::from_le_bytes([a, b, c, d]),
            _ => return None,
        })
    }

    /// `value` as bytes; the first [`Register::size`] of them are the register.
    pub fn bytes_of(&self, value: i32) -> [u8; 4] {
        value.to_le_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn registers_lie_in_order_and_do_not_overlap() {
        for pair in REGISTERS.windows(2) {
            let end = pair[0].address + pair[0].size;
            assert!(end <= pair[1].address, "{} / {}", pair[0].name, pair[1].name);
        }
        let last = REGISTERS.last().unwrap();
        assert_eq!(usize::from(last.address + last.size), TABLE_BYTES);
    }

    #[test]
    fn the_tick_block_holds_current_velocity_and_position() {
        // −3, −2 and 1 in little endian.
        let block = [0xFD, 0xFF, 0xFE, 0xFF, 0xFF, 0xFF, 1, 0, 0, 0];
        let values = [PRESENT_CURRENT, PRESENT_VELOCITY, PRESENT_POSITION]
            .map(|r| r.value_in(&block, TICK_ADDRESS));
        assert_eq!(values, [Some(-3), Some(-2), Some(1)]);
        assert_eq!(PRESENT_TEMPERATURE.value_in(&block, TICK_ADDRESS), None);
        assert_eq!(GOAL_POSITION.value_in(&block, TICK_ADDRESS), None);
        assert_eq!((CARE_BYTES, SUPPLY_BYTES, TICK_BYTES), (35, 3, 10));
    }
}
