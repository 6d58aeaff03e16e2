//! The trial of a policy: what it must show on this robot before it is trusted; and its falls.

use caudata_proto::registry::TRIAL_S;
use caudata_task::{COMMAND_DIM, PerJoint};

use super::plan::Sensed;
use super::{ControlLoop, FALLEN_FOR, FALLEN_GRAVITY_Z};
use crate::bus::Robot;
use crate::gate::{HELD_IN_A_ROW_MAX, Held, PINNED_TICKS_MAX};
use crate::motion::Stage;
use crate::pacing::Clock;
use crate::summary::{Ended, rounded};
use crate::updates::PolicyEvent;

impl<R: Robot, C: Clock> ControlLoop<'_, R, C> {
    /// How long the present policy has walked as it was told to, s.
    fn walked_s(&self) -> f64 {
        rounded(f64::from(self.trial.walked_ticks) * self.plan.period.as_secs_f64())
    }

    /// Whoever waits for a version to be reported as good learns what it lacks.
    pub(super) fn say_how_the_trial_stands(&self) {
        let walked_s = rounded(f64::from(self.trial.ticks) * self.plan.period.as_secs_f64());
        let told = self.trial.told_ticks > 0;
        if told && !self.runner.is_proved() && !self.trial.is_over(self.plan.period) {
            tracing::info!(
                policy = %self.runner.policy(),
                walked_s,
                of_s = TRIAL_S,
                "its trial is not over: only time in which the robot goes where it is told to counts"
            );
        }
    }

    /// A policy that never went through its trial here and falls is not begun with again. One that did may
    /// have met a stone.
    fn blame_a_fall(&mut self) {
        if self.runner.is_proved() || self.trial.is_over(self.plan.period) {
            return;
        }
        self.updates.tell(PolicyEvent::Bad {
            policy: self.runner.policy().clone(),
            reason: "fell in its trial".to_owned(),
            walked_s: self.walked_s(),
            fell: true,
        });
    }

    /// Stops a robot that has lain for too long.
    pub(super) fn watch_for_a_fall(&mut self, sensed: &Sensed) {
        // An IMU that gives no number says nothing about being upright: it counts as lying.
        let finite = |v: &[f32; 3]| v.iter().all(|x| x.is_finite());
        let sane = finite(&sensed.imu.gyro_radps) && finite(&sensed.imu.acc_mps2);
        let sane = sane && finite(&sensed.gravity);
        let lies = sensed.gravity[2] > FALLEN_GRAVITY_Z || !sane;
        let stage = self.motion.stage();
        // Its policy, which gets it up, has not begun.
        let waits = matches!(stage, Stage::Rise | Stage::Settle) && self.plan.get_up > FALLEN_FOR;
        let counts = lies && !(waits && sane);
        self.fallen_ticks = if counts { self.fallen_ticks + 1 } else { 0 };
        // Whatever it does: one that tips over while it stands must not walk on its back when the link
        // returns.
        let braking = matches!(stage, Stage::Damped | Stage::Off);
        let patience = match stage {
            Stage::Walk | Stage::Halt if sane => self.plan.get_up,
            _ => FALLEN_FOR,
        };
        if self.plan.period * self.fallen_ticks >= patience && !braking {
            tracing::error!(gravity = ?sensed.gravity, ?stage, "the robot fell: stopping");
            if stage.is_policys() {
                self.blame_a_fall();
            }
            self.ended = Some(Ended::Fallen);
            self.motion.damp();
        }
    }

    /// A policy that wants many joints at their limits for a second does not pass its trial. One that passed
    /// before may be leaning on something.
    pub(super) fn judge_trial(
        &mut self,
        sensed: &Sensed,
        targets: &PerJoint,
        command: &[f32; COMMAND_DIM],
    ) {
        // One that is getting up presses its joints against their limits, and does not walk.
        if self.fallen_ticks > 0 {
            return;
        }
        let ticks = self.gate.watch_limits(targets);
        if self.trial.is_over(self.plan.period) {
            return;
        }
        self.trial.count(command, &sensed.servos, self.going);
        let fails = !self.runner.is_proved() && ticks >= PINNED_TICKS_MAX;
        if !fails && !self.trial.is_over(self.plan.period) {
            return;
        }
        let policy = self.runner.policy().clone();
        let walked_s = self.walked_s();
        if !fails {
            self.updates.tell(PolicyEvent::Good { policy, walked_s });
            return;
        }
        let reason = format!("wanted joints at their limits for {ticks} ticks in a row");
        tracing::error!(%policy, reason, "the policy does not pass its trial: stopping");
        self.updates.tell(PolicyEvent::Bad { policy, reason, walked_s, fell: false });
        self.ended.get_or_insert(Ended::Saturated);
        self.motion.finish();
    }

    pub(super) fn bad_action(&mut self) {
        self.metrics.held_actions.inc();
        self.trial.ticks = 0;
        if self.gate.hold() == Held::Stop {
            let policy = self.runner.policy().clone();
            tracing::error!(%policy, "actions are not finite: stopping");
            let reason = format!("gave {HELD_IN_A_ROW_MAX} actions in a row that are not finite");
            self.updates.tell(PolicyEvent::Bad {
                policy,
                reason,
                walked_s: self.walked_s(),
                fell: false,
            });
            self.ended = Some(Ended::BadActions);
            self.motion.damp();
        }
    }
}
