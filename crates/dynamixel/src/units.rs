//! Register values and SI units, both ways. Conversions to registers saturate; what is not a number stays at
//! the centre.

use std::f64::consts::TAU;

/// Positions per turn.
pub const COUNTS_PER_TURN: f64 = 4096.0;
/// Position in the middle of a turn.
pub const CENTRE_COUNTS: i32 = 2048;
/// One unit of velocity: 0.229 rev/min, rad/s.
pub const VELOCITY_LSB_RADPS: f64 = 0.229 * TAU / 60.0;
/// One unit of current, A.
pub const CURRENT_LSB_A: f64 = 0.002_69;
/// One unit of voltage, V.
pub const VOLTAGE_LSB_V: f64 = 0.1;
/// One unit of Return Delay Time, µs.
pub const RETURN_DELAY_LSB_US: u64 = 2;
/// One unit of Bus Watchdog, ms.
pub const BUS_WATCHDOG_LSB_MS: u64 = 20;

/// Angle from the centre of the turn, rad.
pub fn counts_to_rad(counts: i32) -> f64 {
    (f64::from(counts) - f64::from(CENTRE_COUNTS)) * (TAU / COUNTS_PER_TURN)
}

/// The position nearest to an angle from the centre.
pub fn rad_to_counts(angle_rad: f64) -> i32 {
    if angle_rad.is_nan() {
        return CENTRE_COUNTS;
    }
    let counts = (angle_rad * (COUNTS_PER_TURN / TAU)).round() as i32;
    counts.saturating_add(CENTRE_COUNTS)
}

/// Baud rate of a value of register 8.
pub fn baud_of_register(value: u8) -> Option<u32> {
    Some(match value {
        0 => 9_600,
        1 => 57_600,
        2 => 115_200,
        3 => 1_000_000,
        4 => 2_000_000,
        5 => 3_000_000,
        6 => 4_000_000,
        7 => 4_500_000,
        _ => return None,
    })
}

/// The value of register 8 for a baud rate.
pub fn register_of_baud(baud: u32) -> Option<u8> {
    (0..8).find(|value| baud_of_register(*value) == Some(baud))
}

/// How long `bytes` take on the wire (8 bits, no parity, one stop bit), µs.
pub fn wire_us(bytes: usize, baud: u32) -> u64 {
    (bytes as u64 * 10 * 1_000_000).div_ceil(u64::from(baud.max(1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_by_hand() {
        assert_eq!((rad_to_counts(0.0), counts_to_rad(2048)), (2048, 0.0));
        // A quarter turn is 1024 counts.
        assert_eq!(rad_to_counts(TAU / 4.0), 3072);
        assert!((counts_to_rad(0) + TAU / 2.0).abs() < 1e-12);
        assert_eq!(rad_to_counts(f64::NAN), 2048);
        // Saturates without wrapping round.
        assert_eq!(rad_to_counts(1e30), i32::MAX);
    }

    #[test]
    fn every_count_comes_back() {
        for counts in -9000..9000 {
            assert_eq!(rad_to_counts(counts_to_rad(counts)), counts);
        }
    }

    #[test]
    fn one_unit_of_velocity_and_a_frame_on_the_wire() {
        assert!((VELOCITY_LSB_RADPS - 0.023_980_8).abs() < 1e-7);
        // 14 bytes of 10 bits at 1 Mbit/s.
        assert_eq!(wire_us(14, 1_000_000), 140);
        // At 57,600 a byte takes 173.6 µs.
        assert_eq!(wire_us(1, 57_600), 174);
        assert_eq!(register_of_baud(1_000_000), Some(3));
        assert_eq!(register_of_baud(250_000), None);
    }
}
