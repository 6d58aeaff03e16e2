//! Which effects a set of runs cannot tell, and what to record so that it can.
//!
//! A table of needs: each row names effects of the catalogue and what must have been recorded for them to
//! show at all. Being able to show is not being told apart; that is for the diagnosis.

use std::collections::BTreeMap;

use caudata_model::{BaseKind, RobotModel};
use caudata_runlog::{BaseHold, RunLog};
use serde::{Deserialize, Serialize};

use super::excites::{JointExcitation, RunExcitation};
use crate::effects::{self, Effect, Layer};
use crate::excitation::Excitation;
use crate::trial::{Role, Run, Trial};
use crate::{excite, reading};

/// An effect that cannot show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Blind {
    /// What is missing.
    pub missing: String,
    /// A trial of the battery that would show it (`caudata gap excite`); empty where the battery has none for
    /// this robot.
    pub record: String,
}

/// All runs together.
struct Evidence<'a> {
    runs: &'a [RunExcitation],
    robot: &'a RobotModel,
}

impl Evidence<'_> {
    fn has(&self, kind: &str) -> bool {
        self.runs.iter().any(|r| r.channels.contains_key(kind))
    }

    /// What counts as a radian at a joint.
    fn per_radian(&self, j: &JointExcitation) -> f64 {
        let at = self.robot.actuated_names().iter().position(|name| *name == j.joint);
        at.map_or(1.0, |a| self.robot.per_radian(a))
    }

    /// How far a joint goes, rad; of a slide, of what counts as one.
    fn span_rad(&self, j: &JointExcitation) -> f64 {
        (j.range_rad[1] - j.range_rad[0]) / self.per_radian(j)
    }

    /// Whether one joint in one run has it.
    fn joint(&self, test: impl Fn(&JointExcitation) -> bool) -> bool {
        self.runs.iter().any(|r| r.joints.iter().any(&test))
    }

    /// Greatest of a figure, summed over the runs, among the joints.
    fn total(&self, of: impl Fn(&JointExcitation) -> f64) -> f64 {
        let mut sums: BTreeMap<&str, f64> = BTreeMap::new();
        for j in self.runs.iter().flat_map(|r| &r.joints) {
            *sums.entry(&j.joint).or_insert(0.0) += of(j);
        }
        sums.into_values().fold(0.0, f64::max)
    }

    fn moving_joints(&self) -> usize {
        let most = |r: &RunExcitation| r.joints.iter().filter(|j| j.speed_rms_radps > 0.05).count();
        self.runs.iter().map(most).max().unwrap_or(0)
    }

    fn free(&self) -> bool {
        self.runs.iter().any(|r| r.base == BaseHold::Free)
    }

    fn wet(&self) -> bool {
        self.runs.iter().any(|r| r.base == BaseHold::Water)
    }

    /// Something outside the joints that sees where links are.
    fn sees_links(&self) -> bool {
        ["imu.grav", "imu.acc", "foot", "mocap", "base.pos", "contact"].iter().any(|k| self.has(k))
    }
}

type Need = (&'static [&'static str], fn(&Evidence<'_>) -> Option<&'static str>, &'static str);

fn unless(holds: bool, missing: &'static str) -> Option<&'static str> {
    (!holds).then_some(missing)
}

/// Effects, what is missing for them (`None`: nothing), and the trial that gives just that.
#[rustfmt::skip]
const NEEDS: &[Need] = &[
    (&["encoder_offset"], |e| unless((e.has("cur") || e.has("tau") || e.sees_links()) && e.total(|j| j.holds as f64) >= 4.0, "holds in four or more poses with current, IMU, foot or motion capture"), "holds"),
    (&["encoder_gain"], |e| unless(e.has("mocap") || e.has("foot") || e.has("cur") || e.has("tau"), "motion capture, foot positions or motor current: angles alone cannot show it"), "sweep_full"),
    (&["velocity_lag"], |e| unless(e.has("vel") && e.joint(|j| j.band_hz[1] > 1.0), "speeds logged, above 1 Hz"), "chirp_medium"),
    (&["current_bias"], |e| unless(e.has("cur"), "motor current"), "holds"),
    (&["current_lag"], |e| unless(e.has("cur") && e.joint(|j| j.band_hz[1] > 1.0), "motor current, above 1 Hz"), "chirp_medium"),
    (&["imu_tilt"], |e| unless(e.has("imu.acc") || e.has("imu.grav"), "accelerometer or gravity direction"), "rest"),
    (&["gyro_bias"], |e| unless(e.has("imu.gyro"), "gyroscope"), "rest"),
    (&["imu_delay"], |e| unless(e.has("imu.gyro") && e.moving_joints() > 0, "gyroscope while the trunk moves"), "rock_x"),
    (&["mocap_frame"], |e| unless(e.has("mocap"), "motion capture"), "holds"),
    (&["command_delay", "command_low_pass", "servo_loop_delay"], |e| unless(e.joint(|j| j.band_hz[1] >= 2.5 && j.band_hz[0] > 0.0 && j.band_hz[1] / j.band_hz[0] >= 4.0), "commands over two octaves, up to 2.5 Hz or more"), "chirp_small"),
    (&["measurement_delay"], |e| unless(e.has("imu.gyro") || e.has("mocap") || e.total(|j| j.off_s) > 0.2, "a second sensor (IMU, motion capture) or a drop with the servo let go"), "drop_high"),
    (&["bus_skew"], |e| unless(e.moving_joints() >= 3 && e.joint(|j| j.band_hz[1] > 1.0), "three or more joints moving at once above 1 Hz"), "all_chirp"),
    (&["dropped_frames"], |e| unless(e.moving_joints() > 0, "motion"), "prbs"),
    (&["clock_drift"], |e| unless(e.runs.iter().any(|r| r.duration_s >= 100.0), "one run of 100 s or more"), "gait_long"),
    (&["profile_limit"], |e| unless(e.total(|j| j.steps[2] as f64) >= 1.0 || e.joint(|j| j.speed_max_radps > 4.0 * e.per_radian(j)), "large steps"), "steps_large"),
    (&["kp_error", "duty_supply", "controller_dead_band", "integral_action"], |e| unless(e.total(|j| j.holds as f64) >= 3.0, "holds under load"), "holds"),
    (&["kd_error"], |e| unless(e.total(|j| (j.steps[0] + j.steps[1] + j.steps[2]) as f64) >= 2.0 || e.joint(|j| j.band_hz[1] > 2.5), "steps, or commands above 2.5 Hz"), "steps_medium"),
    (&["damping_on_error"], |e| unless(e.joint(|j| j.band_hz[1] > 1.0) || e.total(|j| j.steps[2] as f64) >= 2.0, "commands that move, above 1 Hz or in steps"), "steps_medium"),
    (&["damping_lag"], |e| unless(e.joint(|j| j.band_hz[1] > 2.5) || e.total(|j| j.fast_s) > 0.3, "fast motion"), "chirp_large"),
    (&["torque_constant"], |e| unless(e.has("cur"), "motor current"), "holds"),
    (&["winding_resistance", "voltage_limit", "supply_level"], |e| unless(e.total(|j| j.fast_s) > 0.3, "fast motion (above 1.5 rad/s) for 0.3 s or more"), "steps_large"),
    (&["torque_limit", "motor_torque", "braking_asymmetry"], |e| unless(e.joint(|j| j.steps[2] > 0) || e.joint(|j| j.effort > 0.5), "large steps or loads near the torque limit"), "steps_large"),
    (&["supply_sag"], |e| unless(e.has("volt") && e.moving_joints() >= 2, "supply voltage, with several joints under load"), "all_steps"),
    (&["thermal_derating"], |e| unless(e.has("temp") && e.runs.iter().any(|r| r.warming_k > 8.0), "temperature over a hard hold of some minutes"), "hot_hold"),
    (&["coulomb_friction", "viscous_friction", "direction_asymmetry"], |e| unless(e.total(|j| j.reversals as f64) >= 4.0, "reversals"), "triangle_medium"),
    (&["stribeck_friction", "cogging"], |e| unless(e.total(|j| j.slow_s) > 2.0, "slow motion (0.02 to 0.3 rad/s) for 2 s or more"), "triangle_slow"),
    (&["load_dependent_friction", "drive_asymmetry"], |e| unless(e.joint(|j| e.span_rad(j) > 0.8 && j.reversals >= 2), "one speed under several loads: lift and lower over 0.8 rad or more"), "lift_lower"),
    (&["pre_sliding"], |e| unless(e.total(|j| j.small_reversals as f64) >= 4.0, "reversals of a few mrad"), "micro"),
    (&["gear_backlash", "play_behind_encoder", "gear_compliance"], |e| unless(e.total(|j| j.reversals as f64) >= 6.0 && (e.has("cur") || e.joint(|j| j.band_hz[1] > 2.0)), "reversals at small load, with current or above 2 Hz"), "micro"),
    (&["friction_drift"], |e| unless(e.runs.len() >= 3 || e.runs.iter().any(|r| r.duration_s > 200.0), "a session: three or more runs, or one of some minutes"), "gait_long"),
    (&["girdle_play"], |e| unless(e.sees_links(), "IMU, foot positions or motion capture: encoders sit before the play and cannot show it"), "rock_x"),
    (&["parallel_spring"], |e| unless(e.total(|j| j.holds as f64) >= 4.0, "holds over the range"), "holds"),
    (&["hard_stop"], |e| {
        let limits: BTreeMap<&str, (f64, f64)> = e.robot.actuated_names().into_iter().zip(e.robot.joint_limits_rad().iter().copied()).collect();
        unless(e.joint(|j| limits.get(j.joint.as_str()).is_some_and(|(low, high)| j.range_rad[1] - j.range_rad[0] > 0.85 * (high - low))), "motion over the whole range")
    }, "sweep_full"),
    (&["link_mass", "link_com", "point_mass"], |e| unless(e.total(|j| j.holds as f64) >= 3.0 && e.joint(|j| e.span_rad(j) > 0.6), "holds in several poses"), "holds"),
    (&["link_inertia", "armature"], |e| unless(e.joint(|j| j.band_hz[1] > 2.5) || e.total(|j| j.fast_s) > 0.3, "fast motion"), "chirp_large"),
    (&["payload"], |e| unless(e.has("cur") || e.has("base.pos") || e.has("imu.acc") || e.total(|j| j.holds as f64) >= 3.0, "holds with current"), "holds"),
    (&["floor_slope"], |e| unless(e.free() && (e.has("imu.acc") || e.has("imu.grav")), "the robot on the ground, with its IMU"), "rest"),
    (&["contact_friction"], |e| unless(e.free() && (e.has("base.vel") || e.has("base.pos") || e.has("mocap")), "walking on the ground, with where the base is"), "gait"),
    (&["belly_friction"], |e| unless(e.free() && (e.has("base.vel") || e.has("base.pos")), "low walking on the ground, with where the base is"), "gait_low"),
    (&["linear_drag", "quadratic_drag", "added_mass", "buoyancy", "buoyancy_centre", "heave_damping", "water_current", "water_level"], |e| unless(e.wet(), "runs in water (base = \"water\")"), "swim"),
];

/// What the runs excite by the catalogue's own measure; none where no run can be replayed.
fn excitation(logs: &[(&str, &RunLog)], robot: &RobotModel) -> Option<Excitation> {
    let trial = |(name, log): &(&str, &RunLog)| {
        let (name, log, role) = ((*name).to_owned(), (*log).clone(), Role::Fit);
        reading::trial(robot, &Run { name, log, role, sha256: String::new() }).ok()
    };
    let trials: Vec<Trial> = logs.iter().filter_map(trial).collect();
    (!trials.is_empty()).then(|| Excitation::of(robot, &trials.iter().collect::<Vec<_>>()))
}

/// Effects that these runs cannot show, by id. Effects that the robot cannot have (water without water, feet
/// without feet) are left out.
pub fn blind(
    logs: &[(&str, &RunLog)],
    runs: &[RunExcitation],
    robot: &RobotModel,
) -> BTreeMap<String, Blind> {
    let evidence = Evidence { runs, robot };
    let impossible = |effect: &Effect| match (effect.layer, effect.id) {
        (Layer::Contact, _) | (_, "floor_slope") => robot.feet().is_empty(),
        (Layer::Water, _) => robot.water().is_none(),
        (_, "girdle_play") => robot.backlash().joints.is_empty(),
        (_, "bus_skew" | "supply_sag") => robot.actuated().len() < 2,
        // what a robot carries that hangs on a stand is the stand's
        (_, "payload") => {
            let rests = robot.feet().is_empty() && robot.water().is_none();
            rests || robot.base() == BaseKind::Fixed
        }
        (_, "imu_tilt" | "gyro_bias" | "imu_delay") => robot.imu_site().is_none(),
        _ => false,
    };
    let excitation = excitation(logs, robot);
    let trials = excite::names(robot, None);
    let mut out = BTreeMap::new();
    let had = |e: &&&Effect| excitation.as_ref().is_none_or(|runs| (e.of_runs)(runs));
    for effect in effects::ALL.iter().filter(|e| !impossible(e)).filter(had) {
        let need = NEEDS.iter().find(|n| n.0.contains(&effect.id));
        let unseen = || {
            let places = effect.places(robot);
            let why = places.iter().map(|p| (effect.unseen)(excitation.as_ref()?, p));
            Some((*why.collect::<Option<Vec<&str>>>()?.first()?, effect.trial))
        };
        let missing = need.and_then(|n| Some((n.1(&evidence)?, n.2)));
        let Some((missing, trial)) = missing.or_else(unseen) else { continue };
        // a trial that this robot cannot do is replaced by the one of its own that shows most of it
        let record = match trials.contains(&trial) {
            true => trial.to_owned(),
            false => excite::next(robot, &[effect.id], &[]).map_or_else(String::new, |n| n.trial),
        };
        out.insert(effect.id.to_owned(), Blind { missing: missing.to_owned(), record });
    }
    out
}
