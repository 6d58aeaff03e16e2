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
        Some(ErrorNumber(self.0 & 0x7F)).filter(|number| number.0 != 0)
    }
}

/// Why an instruction was not carried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorNumber(pub u8);

impl ErrorNumber {
    /// Could not be processed.
    pub const RESULT_FAIL: Self = Self(1);
    /// Unknown instruction, or Action without Reg Write.
    pub const INSTRUCTION: Self = Self(2);
    /// The CRC of what was sent is wrong.
    pub const CRC: Self = Self(3);
    /// The value is out of range.
    pub const DATA_RANGE: Self = Self(4);
    /// Fewer bytes than the register has.
    pub const DATA_LENGTH: Self = Self(5);
    /// Above or below the limit that another register sets.
    pub const DATA_LIMIT: Self = Self(6);
    /// Read-only, write-only, or locked while the torque is on.
    pub const ACCESS: Self = Self(7);
}

impl fmt::Display for ErrorNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::RESULT_FAIL => write!(f, "it could not be processed"),
            Self::INSTRUCTION => write!(f, "unknown instruction"),
            Self::CRC => write!(f, "it arrived damaged"),
            Self::DATA_RANGE => write!(f, "value out of range, or the bus watchdog has fired"),
            Self::DATA_LENGTH => write!(f, "too few bytes"),
            Self::DATA_LIMIT => write!(f, "value beyond a limit register"),
            Self::ACCESS => write!(f, "not writable now (torque on?)"),
            Self(n) => write!(f, "unknown error {n}"),
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
        assert_eq!(StatusError(0x87).number(), Some(ErrorNumber::ACCESS));
        assert_eq!(StatusError(0x7F).number(), Some(ErrorNumber(0x7F)));
        assert_eq!(ErrorNumber(6).to_string(), "value beyond a limit register");
        assert_eq!(ErrorNumber(8).to_string(), "unknown error 8");
    }

    #[test]
    fn hardware_errors_have_names() {
        assert_eq!(HardwareError(0x24).to_string(), "overheating, overload");
        assert_eq!(HardwareError(0).to_string(), "none");
        assert_eq!(HardwareError(0x41).to_string(), "supply voltage (unknown bits 0x40)");
    }
}
