//! What a reading goes through on its way: a low-pass, and a delay. Both work on several channels at once and
//! are sampled at a fixed period.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::drive::filter::lag_share;

/// Longest delay that is kept, s.
pub const MAX_SENSOR_DELAY_S: f64 = 1.0;

/// A first-order low-pass `y' = (x − y)/τ`, exact for an input that holds from sample to sample (a velocity
/// estimate's or an IMU's filter).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lag {
    share: f32,
    /// Empty before the first sample, which it starts from.
    values: Vec<f32>,
}

impl Lag {
    /// Time constant `time_s` (0: none), sampled every `period_s`. For a corner frequency f, τ = 1/(2πf).
    pub fn new(time_s: f64, period_s: f64) -> Self {
        Self {
            share: lag_share(time_s, period_s) as f32,
            values: Vec::new(),
        }
    }

    /// Replaces a sample by its filtered value. Every call has as many channels as the first.
    pub fn apply(&mut self, sample: &mut [f32]) {
        if self.values.is_empty() {
            self.values.extend_from_slice(sample);
        }
        for (value, x) in self.values.iter_mut().zip(sample) {
            *value += self.share * (*x - *value);
            *x = *value;
        }
    }
}

/// A delay, fractions of a sampling period included: between two samples, on the line from one to the other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Delay {
    whole: usize,
    fraction: f32,
    /// Newest first, at most `whole + 2`.
    past: VecDeque<Vec<f32>>,
}

impl Delay {
    /// A delay of `delay_s`, cut at [`MAX_SENSOR_DELAY_S`], of samples taken every `period_s`.
    pub fn new(delay_s: f64, period_s: f64) -> Self {
        let samples = delay_s.clamp(0.0, MAX_SENSOR_DELAY_S) / period_s;
        let whole = (samples + 1e-9).floor(); // 0.06/0.02 must be 3
        Self {
            whole: whole as usize,
            fraction: (samples - whole).max(0.0) as f32,
            past: VecDeque::new(),
        }
    }

    /// Replaces a sample by the delayed one; before the first sample everything was as in the first.
    pub fn apply(&mut self, sample: &mut [f32]) {
        let mut newest = if self.past.len() > self.whole + 1 {
            self.past.pop_back().unwrap_or_default()
        } else {
            Vec::new()
        };
        newest.clear();
        newest.extend_from_slice(sample);
        self.past.push_front(newest);
        let last = self.past.len() - 1;
        let (newer, older) = (
            &self.past[self.whole.min(last)],
            &self.past[(self.whole + 1).min(last)],
        );
        for (i, x) in sample.iter_mut().enumerate() {
            *x = newer[i] + self.fraction * (older[i] - newer[i]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_through_the_low_pass() {
        // τ = 40 ms sampled at 20 ms: 1 − e^(−1/2) = 0.3935 of the way, then 1 − e^(−1)
        let mut lag = Lag::new(0.04, 0.02);
        let mut x = [0.0, 5.0];
        lag.apply(&mut x);
        assert_eq!(x, [0.0, 5.0], "starts from the first sample");
        for want in [0.393_469, 0.632_121] {
            let mut x = [1.0, 5.0];
            lag.apply(&mut x);
            assert!((x[0] - want).abs() < 1e-6 && x[1] == 5.0, "{x:?}");
        }
        let mut x = [7.0];
        let mut none = Lag::new(0.0, 0.02);
        none.apply(&mut [1.0]);
        none.apply(&mut x);
        assert_eq!(x, [7.0]);
    }

    #[test]
    fn a_delay_of_two_and_a_half_samples() {
        // a ramp of 1 per sample comes out 2.5 lower, once it has been on for that long
        let mut delay = Delay::new(0.05, 0.02);
        let read: Vec<f32> = (0..6)
            .map(|k| {
                let mut x = [k as f32];
                delay.apply(&mut x);
                x[0]
            })
            .collect();
        assert_eq!(read, [0.0, 0.0, 0.0, 0.5, 1.5, 2.5]);
        // whole samples, exactly
        let mut three = Delay::new(0.06, 0.02);
        let read: Vec<f32> = (0..5)
            .map(|k| {
                let mut x = [k as f32];
                three.apply(&mut x);
                x[0]
            })
            .collect();
        assert_eq!(read, [0.0, 0.0, 0.0, 0.0, 1.0]);
        let mut x = [3.0];
        Delay::new(0.0, 0.02).apply(&mut x);
        assert_eq!(x, [3.0]);
    }
}
