//! Command delay: what the servo sees of a stepwise command after a fixed time.

use serde::{Deserialize, Serialize};

use crate::params::MAX_COMMAND_DELAY_S;

/// The last commands of one lane, newest first, enough for [`MAX_COMMAND_DELAY_S`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CommandHistory {
    width: usize,
    /// `[depth, width]`
    values: Vec<f32>,
}

impl CommandHistory {
    /// History for control periods of `period_s`, filled with `rest` (what the servos hold before the first command).
    #[must_use]
    pub fn new(period_s: f64, rest: &[f32]) -> Self {
        // One more than whole periods of delay, one for the command before it.
        let depth = (f64::from(MAX_COMMAND_DELAY_S) / period_s).floor() as usize + 2;
        Self {
            width: rest.len(),
            values: rest.repeat(depth),
        }
    }

    /// A new command, valid from now on.
    pub fn push(&mut self, targets: &[f32]) {
        let w = self.width;
        let kept = self.values.len() - w;
        self.values.copy_within(..kept, w);
        self.values[..w].copy_from_slice(&targets[..w]);
    }

    /// What joint `joint` is told during the physics step that starts `since_push_s` after the last push and lasts `dt_s`:
    /// the delayed stepwise command, averaged over that step (so a delay of a fraction of a step acts as one).
    #[must_use]
    pub fn delayed(
        &self,
        joint: usize,
        delay_s: f64,
        period_s: f64,
        since_push_s: f64,
        dt_s: f64,
    ) -> f32 {
        // A delay of whole periods looks further back; what is left shifts the switch-over inside this period.
        let whole = (delay_s / period_s).floor();
        let left_s = delay_s - whole * period_s;
        let newer = (((since_push_s + dt_s - left_s) / dt_s).clamp(0.0, 1.0)) as f32;
        let new = self.at(whole as usize, joint);
        if newer >= 1.0 {
            return new;
        }
        let old = self.at(whole as usize + 1, joint);
        old + (new - old) * newer
    }

    fn at(&self, age: usize, joint: usize) -> f32 {
        let deepest = self.values.len() / self.width.max(1) - 1;
        self.values[age.min(deepest) * self.width + joint]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Commands 1, 2, 3 (newest), period 20 ms, physics step 4 ms.
    fn seen(delay_ms: f64, since_ms: f64) -> f32 {
        let mut h = CommandHistory::new(0.02, &[0.0]);
        for c in [1.0, 2.0, 3.0] {
            h.push(&[c]);
        }
        h.delayed(0, delay_ms * 1e-3, 0.02, since_ms * 1e-3, 0.004)
    }

    fn check(got: f32, want: f32) {
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
}
