//! From limp to walking and back: soft start, blend into the policy, return to stand, damped stop.
//!
//! ```text
//! Rise ──▶ Settle ──▶ Walk ──▶ Halt ──▶ Return ──▶ Rest ──▶ Off
//!                      ▲ └─ no command ─▶ Stand ──┘ (asked to stop)
//!                      └──── command back ──┘
//!   └────────┴──────── asked to stop ──────▲                  ▲
//!   any ── policy or body out of order ──────────▶ Damped ────┘
//! ```
//! What balances on its feet or wheels tips over in a pose that is held: its policy takes over as soon as it has
//! risen, unblended, stands whenever the robot is to stand, and only brakes behind it.
//!
//! Pure: one call per control tick, time counts in ticks.

use caudata_task::PerJoint;
use serde::{Deserialize, Serialize};

/// How fast joints move towards the nominal pose, rad/s.
pub const RAMP_RADPS: f32 = 0.5;
/// Standing still before the policy takes over, and before the torque goes off, s.
pub const SETTLE_S: f32 = 0.5;
/// From the pose held to the policy's targets, s.
pub const BLEND_S: f32 = 0.5;
/// How long the policy is commanded to stand before the robot returns to the nominal pose, s: one that trots
/// has two feet in the air, and falls over them when it is held where it is.
pub const HALT_S: f32 = 1.0;
/// How long the servos only brake before they go limp, s.
pub const DAMPED_S: f32 = 1.0;

/// What the robot is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// From wherever it lies to the nominal pose.
    Rise,
    /// Standing.
    Settle,
    /// The policy decides.
    Walk,
    /// The policy decides, commanded to stand.
    Halt,
    /// In the nominal pose, ready to walk on.
    Stand,
    /// Back to the nominal pose.
    Return,
    /// Standing, about to let go.
    Rest,
    /// Targets follow the measured pose: only the damping works.
    Damped,
    /// Torque off; done.
    Off,
}

impl Stage {
    /// Whether the policy decides.
    pub fn is_policys(self) -> bool {
        matches!(self, Self::Walk | Self::Halt)
    }
}

/// The sequence of one run.
#[derive(Clone, Debug)]
pub struct Motion {
    stage: Stage,
    nominal_rad: PerJoint,
    balances: bool,
    ticks_in_stage: u32,
    period_s: f32,
    blend_from_rad: PerJoint,
    blend_tick: u32,
}

impl Motion {
    /// Begins in [`Stage::Rise`]. Whether the robot tips over without its policy: `balances`.
    pub fn new(nominal_rad: PerJoint, period_s: f32, balances: bool) -> Self {
        Self {
            stage: Stage::Rise,
            nominal_rad,
            balances,
            ticks_in_stage: 0,
            period_s,
            blend_from_rad: nominal_rad,
            blend_tick: 0,
        }
    }

    /// The present stage.
    pub fn stage(&self) -> Stage {
        self.stage
    }

    /// Stands in another pose from now on.
    pub fn stand_in(&mut self, nominal_rad: PerJoint) {
        self.nominal_rad = nominal_rad;
    }

    /// Whether it stands by its policy alone.
    pub fn balances(&self) -> bool {
        self.balances
    }

    /// Asks to come to an end in order: let the policy stop, stand, then torque off.
    pub fn halt(&mut self) {
        match self.stage {
            Stage::Walk => self.enter(Stage::Halt),
            Stage::Halt => {}
            _ => self.finish(),
        }
    }

    /// Asks to come to an end in order without the policy: stand, then torque off.
    pub fn finish(&mut self) {
        let upright = [Stage::Rise, Stage::Settle, Stage::Stand];
        if self.stage.is_policys() || upright.contains(&self.stage) {
            self.enter(self.behind_the_policy());
        }
    }

    fn behind_the_policy(&self) -> Stage {
        if self.balances { Stage::Damped } else { Stage::Return }
    }

    /// Returns to the nominal pose and waits there; what balances goes on under its policy.
    pub fn stand(&mut self) {
        if self.stage == Stage::Walk && !self.balances {
            self.enter(Stage::Stand);
        }
    }

    /// Walks on after [`Motion::stand`], once it stands.
    pub fn resume(&mut self, sent_rad: PerJoint) -> bool {
        let stands = self.stage == Stage::Stand && sent_rad == self.nominal_rad;
        if stands {
            self.enter(Stage::Walk);
            self.blend_again(sent_rad);
        }
        stands
    }

    /// Stops at once: brake, then torque off.
    pub fn damp(&mut self) {
        if !matches!(self.stage, Stage::Damped | Stage::Off) {
            self.enter(Stage::Damped);
        }
    }

    /// Blends anew, from `from_rad` into a policy that was just changed.
    pub fn blend_again(&mut self, from_rad: PerJoint) {
        self.blend_from_rad = from_rad;
        self.blend_tick = 0;
    }

    /// The targets of this tick. `policy_rad` counts where the policy decides; `sent_rad` went out in the tick
    /// before (the measured pose before the first), `measured_rad` is the present pose.
    pub fn targets(
        &mut self,
        policy_rad: PerJoint,
        sent_rad: PerJoint,
        measured_rad: PerJoint,
    ) -> PerJoint {
        self.ticks_in_stage += 1;
        match self.stage {
            Stage::Rise if self.balances => self.ramp(sent_rad, Stage::Walk),
            Stage::Rise => self.ramp(sent_rad, Stage::Settle),
            Stage::Settle => {
                if self.in_stage_for(SETTLE_S) {
                    self.enter(Stage::Walk);
                    self.blend_again(sent_rad);
                }
                self.nominal_rad
            }
            Stage::Walk => self.blended(policy_rad),
            Stage::Halt => {
                if self.in_stage_for(HALT_S) {
                    self.enter(self.behind_the_policy());
                }
                self.blended(policy_rad)
            }
            Stage::Stand => self.step_towards_nominal(sent_rad),
            Stage::Return => self.ramp(sent_rad, Stage::Rest),
            Stage::Rest => {
                if self.in_stage_for(SETTLE_S) {
                    self.enter(Stage::Off);
                }
                self.nominal_rad
            }
            Stage::Damped => {
                if self.in_stage_for(DAMPED_S) {
                    self.enter(Stage::Off);
                }
                measured_rad
            }
            Stage::Off => sent_rad,
        }
    }

    fn enter(&mut self, stage: Stage) {
        tracing::debug!(from = ?self.stage, to = ?stage, "stage");
        self.stage = stage;
        self.ticks_in_stage = 0;
    }

    fn in_stage_for(&self, seconds: f32) -> bool {
        self.ticks_in_stage >= ticks(seconds, self.period_s)
    }

    /// One step of at most `RAMP_RADPS` per joint towards the nominal pose.
    fn step_towards_nominal(&self, sent_rad: PerJoint) -> PerJoint {
        let step = RAMP_RADPS * self.period_s;
        PerJoint::from_fn(sent_rad.len(), |i| {
            sent_rad[i] + (self.nominal_rad[i] - sent_rad[i]).max(-step).min(step)
        })
    }

    /// Towards the nominal pose, and on to the next stage once it is reached.
    fn ramp(&mut self, sent_rad: PerJoint, then: Stage) -> PerJoint {
        let targets = self.step_towards_nominal(sent_rad);
        if targets == self.nominal_rad {
            self.enter(then);
        }
        targets
    }

    fn blended(&mut self, policy_rad: PerJoint) -> PerJoint {
        let whole = ticks(BLEND_S, self.period_s);
        self.blend_tick = (self.blend_tick + 1).min(whole);
        if self.blend_tick == whole || self.balances {
            return policy_rad;
        }
        let share = self.blend_tick as f32 / whole as f32;
        PerJoint::from_fn(policy_rad.len(), |i| {
            (1.0 - share) * self.blend_from_rad[i] + share * policy_rad[i]
        })
    }
}

/// Ticks that make up `seconds`, at least one.
fn ticks(seconds: f32, period_s: f32) -> u32 {
    ((seconds / period_s).round() as u32).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ZERO: PerJoint = PerJoint::filled(16, 0.0);
    const POLICY: PerJoint = PerJoint::filled(16, 0.5);

    /// Runs until the stage changes; how many ticks that took, and the last targets.
    fn run(motion: &mut Motion, sent: &mut PerJoint) -> u32 {
        let stage = motion.stage();
        for tick in 1..10_000 {
            *sent = motion.targets(POLICY, *sent, PerJoint::filled(16, 0.3));
            if motion.stage() != stage {
                return tick;
            }
        }
        panic!("stays in {stage:?}");
    }

    #[test]
    fn rises_at_half_a_radian_per_second() {
        // The farthest joint is 0.2 rad away: 0.01 rad per tick (0.5 rad/s at 50 Hz), 20 ticks.
        let mut motion = Motion::new(ZERO, 0.02, false);
        let mut sent = PerJoint::filled(16, 0.05);
        sent[4] = -0.2;
        let first = motion.targets(POLICY, sent, sent);
        assert!((first[4] + 0.19).abs() < 1e-6 && (first[0] - 0.04).abs() < 1e-6);
        sent = first;
        assert!((19..=20).contains(&run(&mut motion, &mut sent)));
        assert_eq!((motion.stage(), sent), (Stage::Settle, ZERO));
        // 0.5 s of standing are 25 ticks.
        assert_eq!(run(&mut motion, &mut sent), 25);
        assert_eq!((motion.stage(), sent), (Stage::Walk, ZERO));
    }

    #[test]
    fn a_wheel_is_not_led_back() {
        let mut motion = Motion::new(ZERO, 0.02, false);
        let mut rolled = ZERO;
        rolled[3] = 26.5;
        motion.stand_in(rolled);
        // 0.2 rad of a leg at 0.5 rad/s, whatever the wheel has turned
        let mut sent = rolled;
        sent[4] = -0.2;
        assert!((20..=21).contains(&run(&mut motion, &mut sent)));
        assert_eq!((motion.stage(), sent), (Stage::Settle, rolled));
    }

    fn walking() -> Motion {
        let mut motion = Motion::new(ZERO, 0.02, false);
        let mut sent = ZERO;
        while motion.stage() != Stage::Walk {
            sent = motion.targets(POLICY, sent, ZERO);
        }
        motion
    }

    #[test]
    fn the_policy_is_blended_in_over_25_ticks() {
        let mut motion = walking();
        let sent: Vec<f32> = (0..26).map(|_| motion.targets(POLICY, ZERO, ZERO)[0]).collect();
        // Tick k of 25 gives k/25 of 0.5.
        assert!((sent[0] - 0.02).abs() < 1e-6);
        assert!((sent[11] - 0.24).abs() < 1e-6);
        assert_eq!(sent[24..], [0.5, 0.5]);
        // A changed policy is blended in from what was sent last.
        motion.blend_again(PerJoint::filled(16, 1.0));
        assert!((motion.targets(POLICY, ZERO, ZERO)[0] - 0.98).abs() < 1e-6);
    }

    #[test]
    fn asked_to_finish_it_stands_before_it_lets_go() {
        let mut motion = walking();
        let mut sent = PerJoint::filled(16, 0.1);
        motion.finish();
        assert_eq!(motion.stage(), Stage::Return);
        // 0.1 rad at 0.01 rad per tick.
        assert!((10..=11).contains(&run(&mut motion, &mut sent)));
        assert_eq!((motion.stage(), sent), (Stage::Rest, ZERO));
        assert_eq!(run(&mut motion, &mut sent), 25);
        assert_eq!(motion.stage(), Stage::Off);
        motion.finish();
        assert_eq!(motion.stage(), Stage::Off, "off is the end");
    }

    #[test]
    fn a_policy_that_walks_stops_before_the_robot_stands() {
        let mut motion = walking();
        motion.halt();
        let mut sent = ZERO;
        motion.halt();
        // 1 s are 50 ticks, in which the policy decides.
        assert_eq!(run(&mut motion, &mut sent), 50);
        assert_eq!((motion.stage(), sent), (Stage::Return, POLICY));
        motion.halt();
        assert_eq!(motion.stage(), Stage::Return);
    }

    #[test]
    fn what_balances_is_its_policys_from_rising_to_braking() {
        let mut motion = Motion::new(ZERO, 0.02, true);
        let mut sent = PerJoint::filled(16, 0.1);
        // 0.1 rad at 0.01 rad per tick, and no standing in that pose
        assert!((10..=11).contains(&run(&mut motion, &mut sent)));
        assert_eq!(motion.stage(), Stage::Walk);
        assert_eq!(motion.targets(POLICY, sent, ZERO), POLICY, "its first action counts in full");
        motion.stand();
        assert_eq!(motion.stage(), Stage::Walk);
        motion.halt();
        assert_eq!(run(&mut motion, &mut sent), 50);
        assert_eq!(motion.stage(), Stage::Damped);
        assert_eq!(run(&mut motion, &mut sent), 50);
        assert_eq!(motion.stage(), Stage::Off);
    }

    #[test]
    fn damped_follows_the_measured_pose_for_a_second_then_lets_go() {
        let mut motion = walking();
        motion.damp();
        let mut sent = ZERO;
        assert_eq!(run(&mut motion, &mut sent), 50);
        assert_eq!((motion.stage(), sent), (Stage::Off, PerJoint::filled(16, 0.3)));
        motion.damp();
        assert_eq!(motion.stage(), Stage::Off);
    }

    #[test]
    fn without_a_command_it_stands_and_walks_on_only_from_there() {
        let mut motion = walking();
        motion.stand();
        // 0.1 rad at 0.01 rad per tick: 10 ticks until it stands.
        let mut sent = PerJoint::filled(16, 0.1);
        for _ in 0..9 {
            sent = motion.targets(POLICY, sent, ZERO);
            assert!(!motion.resume(sent));
        }
        for _ in 0..100 {
            sent = motion.targets(POLICY, sent, ZERO);
        }
        assert_eq!((motion.stage(), sent), (Stage::Stand, ZERO));
        assert!(motion.resume(sent));
        // Blended in anew: tick 1 of 25.
        assert!((motion.targets(POLICY, sent, ZERO)[0] - 0.02).abs() < 1e-6);
    }
}
