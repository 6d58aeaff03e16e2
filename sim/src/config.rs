//! `[engine]` of the configuration file.

use caudata_declare::{named, settings};
use caudata_model::{BaseKind, Joint, JointKind, RobotModel};
use serde::{Deserialize, Serialize};

use crate::SimError;

named! {
    /// Which engine.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum EngineKind {
        /// Articulated bodies in vector lanes, compliant contact. The engine for training and diagnosis.
        Batch = "batch",
        /// Rapier multibody joints, one world per lane.
        Rapier = "rapier",
        /// MuJoCo in a Python process beside, one model per lane.
        Mujoco = "mujoco",
    }
}

/// Numbers that the batch engine computes with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Precision {
    /// f32 in vector lanes.
    Single,
    /// f64, one lane at a time, the same code: the reference; about thirteen times slower.
    Double,
}

settings! {
    /// Table `[engine]`: step sizes and solver settings.
    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct EngineConfig {
        /// The engine, `batch`, `rapier` or `mujoco`. Default `batch`. The others are independent referees,
        /// some hundred times slower: `rapier` is tuned for `dt_s` = 0.004 and `substeps` = 5; `mujoco` needs
        /// a Python with MuJoCo, named by `CAUDATA_MUJOCO_PYTHON`.
        pub kind: EngineKind = EngineKind::Batch,
        /// Physics step, s, 0.0002..=0.01. Default 0.002: an open-loop trot then travels within 2 % of its
        /// small-step limit. Smaller is more accurate and proportionally slower; above about 5 ms foot
        /// contact gets coarse, and with `rapier` the servo loop soft (it is explicit there).
        pub dt_s: f64 = 0.002,
        /// Physics steps per control period, 1..=200; `substeps * dt_s` is the control period. Default 10 (20
        /// ms).
        pub substeps: u32 = 10,
        /// `rapier`: solver iterations per physics step, 1..=16. Each costs nearly a whole step. Default 1.
        pub solver_iterations: u32 = 1,
        /// `rapier`: natural frequency of the contact constraint, Hz, 1..=1000. Higher is stiffer: less
        /// sinking in, harder impacts. Default 60 (Rapier's value against fixed ground).
        pub contact_frequency_hz: f64 = 60.0,
        /// `rapier`: damping ratio of the contact constraint, 0.1..=50. Higher pushes penetration out more
        /// slowly. Default 10 (Rapier's).
        pub contact_damping_ratio: f64 = 10.0,
        /// `rapier`: gap at which contacts are prepared ahead of touching, m, 0..=0.05. Too small: fast feet
        /// sink in before they are noticed. Too large: more contact points to solve. Default 0.005.
        pub contact_margin_m: f64 = 0.005,
        /// Whether backlash hinges are held at zero although the model has them. Default false. True is about
        /// 1.5 times as fast (four of the Polymander's 28 degrees of freedom less) and walks like a stiffer
        /// robot: farther, with less power.
        pub lock_backlash: bool = false,
        /// Whether the base link is held in the air (a robot on a stand) although the model lets it move.
        /// Default false.
        pub fixed_base: bool = false,
        /// Whether legs touch the trunk and other legs, with the shapes that touch the ground. Default false:
        /// gaits on land do not need it (legs of the Polymander meet only when it bends its spine with hips
        /// at their ends), and every pair costs.
        pub self_collision: bool = false,
        /// `batch`: whether, with `self_collision`, the shapes meet that are to be looked at, instead of
        /// those that touch the ground; boxes with rounded edges. Default false: a salamander's ground
        /// contact set is balls, between which a leg can pass through the trunk; its shells cost more.
        pub self_shells: bool = false,
        /// Joint speed, and spin of the base, beyond which a lane counts as diverged, rad/s. Default 200 (the
        /// servos end at 8).
        pub max_joint_speed_radps: f64 = 200.0,
        /// Base speed beyond which a lane counts as diverged, m/s. Default 50.
        pub max_base_speed_mps: f64 = 50.0,
        /// `batch`: lanes per vector register, 0 (the widest the processor has), 1, 4, 8 or 16. Default 0.
        /// Others are for measuring.
        pub lane_width: u32 = 0,
        /// `batch`: `single` or `double`. Default `single`.
        pub precision: Precision = Precision::Single,
        /// `batch`: friction as MuJoCo's elliptic cone has it, instead of Coulomb's on a bristle. Default
        /// false. True: open-loop gaits go as in MuJoCo, but a sliding foot lifts itself, and sticking sets
        /// in over the contact's time constant.
        pub convex_friction: bool = false,
        /// `batch`: stiffness of a contact point's friction bristle, N/m, 100..=1e6. Default 30000. Softer:
        /// feet give way sideways before they hold. Stiffer: sticking needs smaller steps.
        pub bristle_stiffness_n_per_m: f64 = 30_000.0,
        /// `batch`: damping of that bristle, N·s/m, 0..=1e4. Default 100: sticking feet come to rest within a
        /// step or two. Zero: they ring.
        pub bristle_damping_ns_per_m: f64 = 100.0,
        /// `batch`: how many times faster contacts push back than the MJCF's `solref` says, 0.1..=10. Default
        /// 1. Harder: feet land with a jolt, and small steps are needed. Softer: they sink in.
        pub contact_hardness: f64 = 1.0,
        /// `batch`: whether dampers and the servo's damping act at the time of the positions, half a step on
        /// from that of the velocities. Default false. True: a servo's loop answers as in much smaller steps,
        /// with an error of the second order in `dt_s`; bristles of friction, stops and gears keep theirs of
        /// the first. `sim rollout` and diagnosis simulate so.
        pub centred: bool = false,
    }
}

impl EngineConfig {
    /// The Rapier engine with the step that it is tuned for: 4 ms, five per control period.
    pub fn rapier() -> Self {
        Self { kind: EngineKind::Rapier, dt_s: 0.004, substeps: 5, ..Self::default() }
    }

    /// The control period, s.
    pub fn control_period_s(&self) -> f64 {
        self.dt_s * f64::from(self.substeps)
    }

    /// Checks every field's range.
    ///
    /// # Errors
    /// [`SimError::Config`] naming the field.
    pub fn validate(&self) -> Result<(), SimError> {
        #[rustfmt::skip]
        let ranges = [
            ("dt_s", self.dt_s, 0.0002, 0.01, "must be 0.0002 to 0.01 s"),
            ("substeps", f64::from(self.substeps), 1.0, 200.0, "must be 1 to 200"),
            ("solver_iterations", f64::from(self.solver_iterations), 1.0, 16.0, "must be 1 to 16"),
            ("contact_frequency_hz", self.contact_frequency_hz, 1.0, 1000.0, "must be 1 to 1000 Hz"),
            ("contact_damping_ratio", self.contact_damping_ratio, 0.1, 50.0, "must be 0.1 to 50"),
            ("contact_margin_m", self.contact_margin_m, 0.0, 0.05, "must be 0 to 0.05 m"),
            ("max_joint_speed_radps", self.max_joint_speed_radps, 10.0, 1e4, "must be 10 to 10000 rad/s"),
            ("max_base_speed_mps", self.max_base_speed_mps, 1.0, 1e3, "must be 1 to 1000 m/s"),
            ("bristle_stiffness_n_per_m", self.bristle_stiffness_n_per_m, 100.0, 1e6, "must be 100 to 1000000 N/m"),
            ("bristle_damping_ns_per_m", self.bristle_damping_ns_per_m, 0.0, 1e4, "must be 0 to 10000 N·s/m"),
            ("contact_hardness", self.contact_hardness, 0.1, 10.0, "must be 0.1 to 10"),
        ];
        check_ranges("engine", &ranges)
    }

    /// Whether the base moves.
    pub(crate) fn frees_base(&self, model: &RobotModel) -> bool {
        model.base() == BaseKind::Free && !self.fixed_base
    }

    /// Whether a joint is held at zero.
    pub(crate) fn holds(&self, joint: &Joint) -> bool {
        joint.locked || self.lock_backlash && joint.kind == JointKind::Backlash
    }
}

/// Refuses the first value outside its `low..=high`.
pub(crate) fn check_ranges(
    table: &'static str,
    ranges: &[(&'static str, f64, f64, f64, &'static str)],
) -> Result<(), SimError> {
    let mut ranges = ranges.iter();
    ranges.try_for_each(|&(field, value, low, high, reason)| {
        check_range(table, field, value, low, high, reason)
    })
}

/// Refuses a value outside `low..=high` (and not-a-number).
pub(crate) fn check_range(
    table: &'static str,
    field: &'static str,
    value: f64,
    low: f64,
    high: f64,
    reason: &'static str,
) -> Result<(), SimError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(SimError::Config { table, field, value: value.to_string(), reason })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_is_valid_and_makes_50_hz() {
        let c = EngineConfig::default();
        c.validate().unwrap();
        assert!((c.control_period_s() - 0.02).abs() < 1e-12);
    }

    #[test]
    fn names_the_field_that_is_wrong() {
        let c = EngineConfig { dt_s: 0.1, ..EngineConfig::default() };
        assert_eq!(
            c.validate().unwrap_err().to_string(),
            "engine.dt_s = 0.1: must be 0.0002 to 0.01 s"
        );
        let c = EngineConfig { contact_margin_m: f64::NAN, ..EngineConfig::default() };
        assert!(c.validate().is_err());
    }

    #[test]
    fn unknown_keys_are_errors() {
        let text = r#"{ "dt_s": 0.002, "sub_steps": 10 }"#;
        assert!(serde_json::from_str::<EngineConfig>(text).is_err());
    }
}
