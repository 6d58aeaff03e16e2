//! The last thing between a policy and the servos: finite, within the joint limits, not too far from what was
//! sent last.

use caudata_task::{JointTable, PerJoint};

/// Actions in a row that may be held because they were not finite; with this many the robot is stopped.
pub const HELD_IN_A_ROW_MAX: u32 = 3;

/// Ticks in a row that a policy on trial may want a quarter of the joints or more at their limits (1 s).
/// Single joints lie at a limit in good gaits: of the joint-ticks of `policies/flat.onnx` 9 % do.
pub const PINNED_TICKS_MAX: u32 = 50;
/// A target this near to a limit lies at it, rad.
const AT_LIMIT_RAD: f32 = 1e-5;

/// What became of an action that is not finite.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Held {
    /// The last target is sent again.
    Hold,
    /// The policy cannot be trusted any more.
    Stop,
}

/// Checks every target before it is sent.
#[derive(Clone, Debug)]
pub struct OutputGate {
    lower_rad: PerJoint,
    upper_rad: PerJoint,
    step_max_rad: f32,
    last_rad: PerJoint,
    in_a_row: u32,
    held: u64,
    rate_limited: u64,
    pinned_ticks: u32,
    saturated: u64,
}

impl OutputGate {
    /// A gate for the limits of `joints`; targets move by at most `step_max_rad` per tick, from `start_rad`
    /// on.
    pub fn new(joints: &JointTable, step_max_rad: f32, start_rad: PerJoint) -> Self {
        Self {
            lower_rad: joints.lower_rad,
            upper_rad: joints.upper_rad,
            step_max_rad,
            last_rad: start_rad,
            in_a_row: 0,
            held: 0,
            rate_limited: 0,
            pinned_ticks: 0,
            saturated: 0,
        }
    }

    /// What may be sent instead of `targets_rad`: within the limits, and near enough to the last one.
    pub fn pass(&mut self, targets_rad: PerJoint) -> PerJoint {
        let mut limited = false;
        for i in 0..targets_rad.len() {
            // A target that is not a number leaves the joint where it was sent last.
            let wanted = if targets_rad[i].is_nan() {
                self.last_rad[i]
            } else {
                targets_rad[i].max(self.lower_rad[i]).min(self.upper_rad[i])
            };
            let step = wanted - self.last_rad[i];
            limited |= step.abs() > self.step_max_rad;
            self.last_rad[i] += step.max(-self.step_max_rad).min(self.step_max_rad);
        }
        self.rate_limited += u64::from(limited);
        self.last_rad
    }

    /// Counts the joints that a policy wants at a limit or beyond it; for how many ticks in a row these were
    /// a quarter of all or more.
    pub fn watch_limits(&mut self, policy_rad: &PerJoint) -> u32 {
        let inside = |i: &usize| {
            policy_rad[*i] > self.lower_rad[*i] + AT_LIMIT_RAD
                && policy_rad[*i] < self.upper_rad[*i] - AT_LIMIT_RAD
        };
        let joints = policy_rad.len();
        let at_limits = joints - (0..joints).filter(inside).count();
        self.saturated += at_limits as u64;
        self.pinned_ticks = if at_limits >= joints.div_ceil(4) { self.pinned_ticks + 1 } else { 0 };
        self.pinned_ticks
    }

    /// Joint-ticks at a limit so far.
    pub fn saturated(&self) -> u64 {
        self.saturated
    }

    /// Counts an action that is not finite.
    pub fn hold(&mut self) -> Held {
        self.held += 1;
        self.in_a_row += 1;
        if self.in_a_row >= HELD_IN_A_ROW_MAX {
            return Held::Stop;
        }
        Held::Hold
    }

    /// A good action came: the row is broken.
    pub fn good(&mut self) {
        self.in_a_row = 0;
    }

    /// What was sent last, rad.
    pub fn last_rad(&self) -> PerJoint {
        self.last_rad
    }

    /// Actions held so far.
    pub fn held(&self) -> u64 {
        self.held
    }

    /// Ticks in which at least one joint's target was slowed down.
    pub fn rate_limited(&self) -> u64 {
        self.rate_limited
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gate() -> OutputGate {
        let joints = JointTable {
            nominal_rad: PerJoint::filled(16, 0.0),
            lower_rad: PerJoint::filled(16, -0.5),
            upper_rad: PerJoint::filled(16, 1.0),
        };
        OutputGate::new(&joints, 0.25, PerJoint::filled(16, 0.0))
    }

    #[test]
    fn targets_stay_within_the_limits() {
        let mut gate = gate();
        // 0 → 9: limited to 1.0 by the joint, reached in steps of 0.25.
        let sent: Vec<f32> = (0..5).map(|_| gate.pass(PerJoint::filled(16, 9.0))[3]).collect();
        assert_eq!(sent, [0.25, 0.5, 0.75, 1.0, 1.0]);
        assert_eq!(gate.rate_limited(), 3, "the last two steps were 0.25 and 0");
        for _ in 0..10 {
            gate.pass(PerJoint::filled(16, f32::NEG_INFINITY));
        }
        assert_eq!(gate.last_rad(), PerJoint::filled(16, -0.5));
    }

    #[test]
    fn a_target_that_is_not_a_number_moves_nothing() {
        let mut gate = gate();
        gate.pass(PerJoint::filled(16, 0.2));
        let mut targets = PerJoint::filled(16, 0.3);
        targets[7] = f32::NAN;
        let sent = gate.pass(targets);
        assert_eq!((sent[7], sent[8]), (0.2, 0.3));
    }

    #[test]
    fn three_bad_actions_in_a_row_stop_two_do_not() {
        let mut gate = gate();
        assert_eq!([gate.hold(), gate.hold()], [Held::Hold; 2]);
        gate.good();
        assert_eq!([gate.hold(), gate.hold()], [Held::Hold; 2]);
        assert_eq!(gate.hold(), Held::Stop);
        assert_eq!(gate.held(), 5);
    }

    #[test]
    fn joints_at_their_limits_are_counted() {
        let mut gate = gate();
        let mut wanted = PerJoint::filled(16, 0.2);
        wanted[3] = 1.0;
        wanted[9] = f32::NAN;
        wanted[10] = -0.5;
        assert_eq!(gate.watch_limits(&wanted), 0, "three joints of sixteen");
        wanted[11] = 7.0;
        assert_eq!([1, 2].map(|_| gate.watch_limits(&wanted)), [1, 2]);
        wanted[3] = 0.999;
        assert_eq!(gate.watch_limits(&wanted), 0);
        // 3 + 4 + 4 + 3
        assert_eq!(gate.saturated(), 14);
    }
}
