//! Taking over a newer policy, at a moment that is safe.

use caudata_task::COMMAND_DIM;

use super::plan::{STILL_RADPS, STILL_TICKS, Sensed, Trial, mean_speed};
use super::{ControlLoop, version_gauge};
use crate::bus::Robot;
use crate::motion::Stage;
use crate::pacing::Clock;
use crate::runner::PolicyRunner;
use crate::updates::PolicyEvent;

/// A robot that was made to stand for a swap and does not come to rest by then gets it all the same (2 s):
/// its targets stand still.
pub const STAND_TICKS_MAX: u32 = 100;

impl<R: Robot, C: Clock> ControlLoop<'_, R, C> {
    /// A newer policy gets in only at a safe moment: before walking has begun, or standing. While the robot
    /// walks it waits; where that takes too long, the robot is made to stand.
    pub(super) fn look_for_swap(&mut self, sensed: &Sensed, wanted: &[f32; COMMAND_DIM]) {
        if self.walk_on && self.motion.resume(self.gate.last_rad()) {
            self.walk_on = false;
        }
        let speed = mean_speed(&sensed.servos.vel_radps);
        let stage = self.motion.stage();
        // Held still by the loop, or commanded to stand and standing.
        let held = matches!(stage, Stage::Settle | Stage::Stand);
        let asked = stage == Stage::Walk && *wanted == [0.0; COMMAND_DIM];
        let still = (held || asked) && speed < STILL_RADPS;
        self.still_ticks = if still { self.still_ticks + 1 } else { 0 };
        if !self.updates.waits() {
            self.swap_ticks = 0;
            if self.stand_ticks.take().is_some() {
                self.walk_on();
            }
            return;
        }
        self.swap_ticks = self.swap_ticks.saturating_add(1);
        self.metrics.armed.set(1);
        let at_rest = self.gate.last_rad() == self.runner.joints().nominal_rad;
        let stood_long = self.stand_ticks.is_some_and(|ticks| ticks >= STAND_TICKS_MAX);
        let safe = match stage {
            Stage::Rise => true,
            Stage::Settle => true,
            // Slow on its way to the nominal pose is not there.
            Stage::Stand => at_rest && (self.still_ticks >= STILL_TICKS || stood_long),
            Stage::Walk => self.still_ticks >= STILL_TICKS || stood_long,
            // On its way to the end: the next run begins with it.
            Stage::Halt | Stage::Return | Stage::Rest | Stage::Damped | Stage::Off => false,
        };
        if safe {
            self.swap_policy(speed, wanted);
        } else {
            self.hurry(stage);
        }
    }

    /// Makes the robot stand where a newer policy has waited for too long.
    fn hurry(&mut self, stage: Stage) {
        if let Some(ticks) = &mut self.stand_ticks {
            let stands =
                self.motion.balances() || self.gate.last_rad() == self.runner.joints().nominal_rad;
            *ticks += u32::from(stands);
            return;
        }
        let waited = self.plan.period * self.swap_ticks;
        if stage == Stage::Walk && self.plan.swap_wait.is_some_and(|limit| waited >= limit) {
            let waited_s = waited.as_secs_f32();
            tracing::info!(waited_s, "a newer policy waits: the robot stands to let it in");
            self.counts.stands_for_swap += 1;
            self.stand_ticks = Some(0);
            self.motion.stand();
        }
    }

    /// Takes over a newer policy, with empty history, blended in from what was sent last.
    fn swap_policy(&mut self, speed: f32, commanded: &[f32; COMMAND_DIM]) {
        let Some(verified) = self.updates.take() else { return };
        match PolicyRunner::new(verified, Some(self.runner.clock())) {
            Ok(runner) => {
                let stage = self.motion.stage();
                let waited_s = self.plan.period.as_secs_f32() * self.swap_ticks as f32;
                let policy = runner.policy();
                tracing::info!(version = policy.version, sha256 = %policy.sha256, ?stage, waited_s, speed_radps = speed, ?commanded, "policy swapped in");
                let old = std::mem::replace(&mut self.runner, runner);
                self.updates.tell(PolicyEvent::Replaced(Box::new(old)));
                self.updates.tell(PolicyEvent::Begun(self.runner.policy().clone()));
                self.metrics.policy_version.set(version_gauge(&self.runner));
                self.metrics.armed.set(0);
                self.counts.swaps += 1;
                // Rising, the robot moves by the loop's own ramp, not by a policy.
                if stage != Stage::Rise {
                    self.counts.swap_speed_radps = self.counts.swap_speed_radps.max(speed);
                }
                self.trial = Trial::default();
                self.wheels_stand(self.gate.last_rad());
                self.motion.blend_again(self.gate.last_rad());
            }
            Err(error) => tracing::error!(%error, "policy not swapped in"),
        }
        self.swap_ticks = 0;
        if self.stand_ticks.take().is_some() {
            self.walk_on();
        }
    }

    /// After standing for a swap. With a command link the link decides.
    fn walk_on(&mut self) {
        let stands = self.motion.stage() == Stage::Stand;
        self.walk_on = stands && self.link.is_none() && !self.motion.resume(self.gate.last_rad());
    }
}
