//! The flight recorder: the last 30 s, in memory, whether or not a log is written.

use std::time::Duration;

use crate::flight_log::LogRow;

/// How much is remembered, s.
pub const REMEMBERED_S: f64 = 30.0;
/// Rows that fit at the fastest sensible control rate.
const REMEMBERED_ROWS_MAX: usize = 30_000;

/// A ring of rows; its memory is taken once.
#[derive(Debug)]
pub struct LastMoments {
    rows: Vec<LogRow>,
    capacity: usize,
    /// Where the oldest row is, once the ring is full.
    oldest: usize,
}

impl LastMoments {
    /// A ring for [`REMEMBERED_S`] at one row per `period`.
    pub fn new(period: Duration) -> Self {
        let rows = (REMEMBERED_S / period.as_secs_f64().max(1e-3)).round() as usize;
        let capacity = rows.clamp(1, REMEMBERED_ROWS_MAX);
        Self { rows: Vec::with_capacity(capacity), capacity, oldest: 0 }
    }

    /// Remembers a row; the oldest is forgotten.
    pub fn push(&mut self, row: LogRow) {
        if self.rows.len() < self.capacity {
            self.rows.push(row);
            return;
        }
        self.rows[self.oldest] = row;
        self.oldest = (self.oldest + 1) % self.capacity;
    }

    /// All rows, oldest first.
    pub fn iter(&self) -> impl Iterator<Item = &LogRow> {
        let (new, old) = self.rows.split_at(self.oldest);
        old.iter().chain(new)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::{GroundTruth, ImuReading, ServoReadings};

    fn row(time_s: f64) -> LogRow {
        LogRow {
            command_rad: [0.0; 16].into(),
            torque: true,
            servos: ServoReadings {
                time_s,
                pos_rad: [0.0; 16].into(),
                vel_radps: [0.0; 16].into(),
                current_a: [0.0; 16].into(),
                supply_v: 12.0,
            },
            imu: ImuReading { gyro_radps: [0.0; 3], acc_mps2: [0.0; 3], gravity: None },
            gravity: [0.0, 0.0, -1.0],
            truth: GroundTruth::default(),
        }
    }

    #[test]
    fn the_last_thirty_seconds_in_order_and_no_memory_is_taken_later() {
        let mut last_moments = LastMoments::new(Duration::from_millis(20));
        let room = last_moments.rows.capacity();
        for tick in 0..4000 {
            last_moments.push(row(f64::from(tick)));
        }
        let times: Vec<f64> = last_moments.iter().map(|r| r.servos.time_s).collect();
        // 30 s at 50 Hz are 1500 rows: 2500 to 3999.
        let expected: Vec<f64> = (2500..4000).map(f64::from).collect();
        assert_eq!(times, expected);
        assert_eq!(last_moments.rows.capacity(), room);
    }
}
