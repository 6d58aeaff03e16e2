//! The way of a command to its servo: what a servo is told of a stepwise command after a delay of its own.
//!
//! The delay counts to the fraction of a physics step. A servo that is served later on the bus than another
//! (sampling skew) has a longer delay. A command frame that is lost leaves every servo with the one before it
//! (one synchronous write carries all joints).

use std::collections::VecDeque;

use crate::real::Real;
use serde::{Deserialize, Serialize};

/// Longest command delay (with skew) that is kept, s.
pub const MAX_COMMAND_DELAY_S: f32 = 0.1;

/// Up to this depth each age is compared for all lanes at once; deeper histories are read lane by lane.
const SCAN: usize = 16;

/// The last commands, newest first, enough for [`MAX_COMMAND_DELAY_S`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommandHistory<R> {
    width: usize,
    /// `[depth, width]`. A ring: with short periods it is deep, and a new command must not move all the
    /// others.
    values: VecDeque<R>,
}

/// What one joint is told during a control period: one command until a switch-over, then another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scheduled<R> {
    /// Before the switch-over, rad.
    pub older_rad: R,
    /// After it, rad.
    pub newer_rad: R,
    /// Time of the switch-over from the start of the period, s.
    pub switch_s: R,
}

impl<R: Real> Scheduled<R> {
    /// The same command all the time.
    #[inline(always)]
    pub fn constant(command_rad: R) -> Self {
        Self { older_rad: command_rad, newer_rad: command_rad, switch_s: R::zero() }
    }

    /// The command's mean over the physics step that starts `since_s` into the period and lasts `dt_s` (so a
    /// delay of a fraction of a step acts as one), rad. `per_dt`: 1/dt.
    #[inline(always)]
    pub fn over_step(&self, since_s: R, dt_s: R, per_dt: R) -> R {
        let newer = ((since_s + dt_s - self.switch_s) * per_dt).clamp(R::zero(), R::one());
        // not old + (new − old)·share: that would not be exactly the new command at share 1
        R::select(
            R::one().le(newer),
            self.newer_rad,
            self.older_rad + (self.newer_rad - self.older_rad) * newer,
        )
    }
}

impl<R: Real> CommandHistory<R> {
    /// History for control periods of `period_s`, filled with `rest_rad` (what the servos hold before the
    /// first command).
    pub fn new(period_s: f64, rest_rad: &[R]) -> Self {
        // One more than whole periods of delay, one for the command before it.
        let depth = (f64::from(MAX_COMMAND_DELAY_S) / period_s).floor() as usize + 2;
        Self { width: rest_rad.len(), values: rest_rad.repeat(depth).into() }
    }

    /// What lane `lane` holds, newest command first. `[depth, width]`, rad.
    pub fn lane(&self, lane: usize) -> Vec<f64> {
        self.values.iter().map(|v| v.lane(lane)).collect()
    }

    /// Replaces what lane `lane` holds by what [`lane`](Self::lane) gave. Whether the length fitted; if not,
    /// nothing changes.
    pub fn set_lane(&mut self, lane: usize, values_rad: &[f64]) -> bool {
        if values_rad.len() != self.values.len() {
            return false;
        }
        for (all, one) in self.values.iter_mut().zip(values_rad) {
            *all = all.with_lane(lane, *one);
        }
        true
    }

    /// A new command, on its way from now on; where `lost`, the one before it once more.
    #[inline(always)]
    pub fn push(&mut self, targets_rad: &[R], lost: R::Mask) {
        let w = self.width;
        // the oldest row's place becomes the newest's
        self.values.rotate_right(w);
        for joint in 0..w {
            self.values[joint] = R::select(lost, self.values[w + joint], targets_rad[joint]);
        }
    }

    /// The newest command of joint `joint`, rad.
    #[inline(always)]
    pub fn newest(&self, joint: usize) -> R {
        self.values[joint]
    }

    /// What joint `joint` is told during the control period (of `period_s`) that began with the last push,
    /// with a delay of `delay_s`.
    #[inline(always)]
    pub fn schedule(&self, joint: usize, delay_s: R, period_s: f64) -> Scheduled<R> {
        // A delay of whole periods looks further back; what is left shifts the switch-over inside this
        // period.
        let whole = (delay_s * R::splat(1.0 / period_s)).floor().max(R::zero());
        let switch_s = delay_s - whole * R::splat(period_s);
        let depth = self.values.len() / self.width.max(1);
        let (mut newer_rad, mut older_rad) = (self.at(0, joint), self.at(1, joint));
        if depth <= SCAN {
            for age in 1..depth {
                let this = R::splat(age as f64 - 0.5).lt(whole);
                newer_rad = R::select(this, self.at(age, joint), newer_rad);
                older_rad = R::select(this, self.at(age + 1, joint), older_rad);
            }
        } else {
            for lane in 0..R::LANES {
                let age = whole.lane(lane) as usize;
                newer_rad = newer_rad.with_lane(lane, self.at(age, joint).lane(lane));
                older_rad = older_rad.with_lane(lane, self.at(age + 1, joint).lane(lane));
            }
        }
        Scheduled { older_rad, newer_rad, switch_s }
    }

    /// The command of joint `joint` that is `age` periods old, or the oldest there is.
    #[inline(always)]
    fn at(&self, age: usize, joint: usize) -> R {
        let depth = self.values.len() / self.width.max(1);
        self.values[age.min(depth - 1) * self.width + joint]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Commands 1, 2, 3 (newest), period 20 ms, physics step 4 ms.
    fn seen(delay_ms: f64, since_ms: f64) -> f64 {
        let mut h = CommandHistory::new(0.02, &[0.0]);
        for c in [1.0, 2.0, 3.0] {
            h.push(&[c], false);
        }
        let s = h.schedule(0, delay_ms * 1e-3, 0.02);
        s.over_step(since_ms * 1e-3, 0.004, 250.0)
    }

    fn check(got: f64, want: f64) {
        assert!((got - want).abs() < 1e-5, "got {got}, want {want}");
    }

    #[test]
    fn no_delay_is_the_newest_command() {
        check(seen(0.0, 0.0), 3.0);
        check(seen(0.0, 16.0), 3.0);
    }

    #[test]
    fn a_fraction_of_a_step_is_blended() {
        check(seen(1.0, 0.0), 2.75); // 1 of 4 ms still the old command
        check(seen(6.0, 0.0), 2.0);
        check(seen(6.0, 4.0), 2.5); // switches at 6 ms, half way through 4..8
        check(seen(6.0, 8.0), 3.0);
    }

    #[test]
    fn whole_periods_look_further_back() {
        check(seen(20.0, 0.0), 2.0);
        check(seen(45.0, 0.0), 0.0); // before the first command: rest
        check(seen(45.0, 8.0), 1.0); // 45 = 2·20 + 5 ms
        check(seen(100.0, 16.0), 0.0); // the longest delay still has history
    }

    #[test]
    fn short_periods_have_deep_histories() {
        // 1 ms periods of one 1 ms step; commands 1, 2, … 60: 37.5 ms ago it was half 22, half 23
        let mut h = CommandHistory::new(0.001, &[0.0_f64]);
        for c in 1..=60 {
            h.push(&[f64::from(c)], false);
        }
        let s = h.schedule(0, 0.0375, 0.001);
        check(s.over_step(0.0, 0.001, 1000.0), 22.5);
    }

    #[test]
    fn a_lost_frame_repeats_the_one_before() {
        let mut h = CommandHistory::new(0.02, &[0.5, 0.6]);
        h.push(&[1.0, 2.0], true);
        assert_eq!((h.newest(0), h.newest(1)), (0.5, 0.6));
        h.push(&[3.0, 4.0], false);
        h.push(&[5.0, 6.0], true);
        assert_eq!((h.newest(0), h.newest(1)), (3.0, 4.0));
    }
}
