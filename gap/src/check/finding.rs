//! What a check looks at, and what it says.

use caudata_model::RobotModel;
use caudata_runlog::RunLog;

use super::series::Grid;

/// Kind of a note that asks whether a base that counts as free was held.
pub(crate) const MAYBE_HELD: &str = "base";

/// A fault of one run, before it is given the run's name.
#[derive(Clone, Debug)]
pub(super) struct Finding {
    pub kind: &'static str,
    pub at: String,
    pub detail: String,
    /// Whether it must be put right first.
    pub fatal: bool,
}

/// One run being looked at.
pub(super) struct Run<'a> {
    pub name: String,
    pub log: &'a RunLog,
    pub robot: &'a RobotModel,
    pub grid: Grid,
}

impl Run<'_> {
    /// Gains in force at actuated joint `index`, the motor's own damping with them: N·m/rad, N·m·s/rad.
    pub(super) fn gains(&self, index: usize) -> (f64, f64) {
        let (kp, kd) = self.log.meta.gains(self.robot.actuated_names()[index]);
        let robot = self.robot;
        let kd = kd.unwrap_or(robot.kd_nm_s_per_rad(index));
        (kp.unwrap_or(robot.kp_nm_per_rad(index)), kd + robot.servo(index).kd_min_nm_s_per_rad)
    }
}

impl Finding {
    /// A fault that must be put right first.
    pub(super) fn fatal(kind: &'static str, at: impl Into<String>, detail: String) -> Self {
        Self { kind, at: at.into(), detail, fatal: true }
    }

    /// Something worth knowing.
    pub(super) fn note(kind: &'static str, at: impl Into<String>, detail: String) -> Self {
        Self { kind, at: at.into(), detail, fatal: false }
    }
}
