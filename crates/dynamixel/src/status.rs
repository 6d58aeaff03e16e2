//! What servos answer: the error byte, and what the alert in it stands for.

use std::fmt;

/// The error byte of a status packet: an alert (a hardware error is latched) and the number of what went
/// wrong.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StatusError(pub u8);

impl StatusError {
    /// Register 70 says more.
    pub fn alert(self) -> bool {
        self.0 & 0x80 != 0
    }

    /// Why the instruction was not carried out; `None` where it was.
    pub fn number(self) -> Option<ErrorNumber> {
        ErrorNumber::from_byte(self.0 & 0x7F)
    }
}

/// Why an instruction was not carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorNumber {
    /// 1: could not be processed.
    ResultFail,
    /// 2: unknown instruction, or Action without Reg Write.
    Instruction,
    /// 3: the CRC of what was sent is wrong.
    Crc,
    /// 4: the value is out of range.
    DataRange,
    /// 5: fewer bytes than the register has.
    DataLength,
    /// 6: above or below the limit that another register sets.
    DataLimit,
    /// 7: read-only, write-only, or locked while the torque is on.
    Access,
    /// A number that the manual does not know.
    Unknown(u8),
}

impl ErrorNumber {
    fn from_byte(byte: u8) -> Option<Self> {
        Some(match byte {
            0 => return None,
            1 => Self::ResultFail,
            2 => Self::Instruction,
            3 => Self::Crc,
            4 => Self::DataRange,
            5 => Self::DataLength,
            6 => Self::DataLimit,
            7 => Self::Access,
            other => Self::Unknown(other),
        })
    }

    /// Its number on the wire.
    pub fn to_byte(self) -> u8 {
        match self {
            Self::ResultFail => 1,
            Self::Instruction => 2,
            Self::Crc => 3,
            Self::DataRange => 4,
            Self::DataLength => 5,
            Self::DataLimit => 6,
            Self::Access => 7,
            Self::Unknown(byte) => byte,
        }
    }
}

impl fmt::Display for ErrorNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ResultFail => write!(f, "it could not be processed"),
            Self::Instruction => write!(f, "unknown instruction"),
            Self::Crc => write!(f, "it arrived damaged"),
            Self::DataRange => write!(f, "value out of range, or the bus watchdog has fired"),
            Self::DataLength => write!(f, "too few bytes"),
            Self::DataLimit => write!(f, "value beyond a limit register"),
            Self::Access => write!(f, "not writable now (torque on?)"),
            Self::Unknown(n) => write!(f, "unknown error {n}"),
        }
    }
}

/// Hardware Error Status, register 70.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HardwareError(pub u8);

impl HardwareError {
    /// Bit 0: supply outside its limits.
    pub const INPUT_VOLTAGE: u8 = 1;
    /// Bit 2: too hot.
    pub const OVERHEATING: u8 = 1 << 2;
    /// Bit 3: the motor's encoder fails.
    pub const ENCODER: u8 = 1 << 3;
    /// Bit 4: electrical shock, or too little power.
    pub const ELECTRICAL_SHOCK: u8 = 1 << 4;
    /// Bit 5: overload for long.
    pub const OVERLOAD: u8 = 1 << 5;

    /// Nothing is latched.
    pub fn is_none(self) -> bool {
        self.0 == 0
    }
}

impl fmt::Display for HardwareError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = [
            (Self::INPUT_VOLTAGE, "supply voltage"),
            (Self::OVERHEATING, "overheating"),
            (Self::ENCODER, "encoder"),
            (Self::ELECTRICAL_SHOCK, "electrical shock"),
            (Self::OVERLOAD, "overload"),
        ];
        let mut rest = self.0;
        let mut first = true;
        for (bit, name) in names {
            if self.0 & bit != 0 {
                let comma = if first { "" } else { ", " };
                write!(f, "{comma}{name}")?;
                first = false;
                rest &= !bit;
            }
        }
        match (rest, first) {
            (0, true) => write!(f, "none"),
            (0, false) => Ok(()),
            (rest, _) => write!(f, " (unknown bits {rest:#04x})"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alert_and_number_are_told_apart() {
        assert_eq!((StatusError(0).alert(), StatusError(0).number()), (false, None));
        assert_eq!((StatusError(0x80).alert(), StatusError(0x80).number()), (true, None));
        assert_eq!(StatusError(0x87).number(), Some(ErrorNumber::Access));
        assert_eq!(StatusError(0x7F).number(), Some(ErrorNumber::Unknown(0x7F)));
        for number in 1..=0x7F_u8 {
            let error = StatusError(number).number().unwrap();
            assert_eq!(error.to_byte(), number);
        }
    }

    #[test]
    fn hardware_errors_have_names() {
        assert_eq!(HardwareError(0x24).to_string(), "overheating, overload");
        assert_eq!(HardwareError(0).to_string(), "none");
        assert_eq!(HardwareError(0x41).to_string(), "supply voltage (unknown bits 0x40)");
    }
}
