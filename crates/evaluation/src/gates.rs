//! What counts as walking. Rewards for velocity can be had by vibrating, in any simulator; these gates
//! cannot. Nor can they be had by walking like a crippled animal.

use std::borrow::Cow;

use caudata_config::GatesConfig;
use serde::{Deserialize, Serialize};

use crate::gait::Gait;
use crate::posture::Posture;

// The limits of posture and of going straight, which `[evaluation.gates]` has as a whole.

/// Largest distance of a joint's mean from nominal or from its mirror image, whichever is nearer, rad.
const OFF_RAD: f64 = 10.0_f64.to_radians();
/// Largest share of time that a joint is at an end stop.
const AT_STOP_SHARE: f64 = 0.02;
/// Largest |mean yaw rate − commanded|, rad/s; not looked at on rough ground, which turns a robot aside.
const YAW_OFF_RADPS: f64 = 0.02;
/// The gate of that.
const YAW_OFF: &str = "yaw off the command, rad/s";
/// Largest |velocity to the left − commanded|, m/s; likewise.
const SIDE_OFF_MPS: f64 = 0.01;
/// Largest difference between the swings of a leg's joint and its counterpart's, rad.
const SIDES_APART_RAD: f64 = 5.0_f64.to_radians();
/// Largest difference between the duty factors of a foot and the one on the other side.
const DUTY_APART: f64 = 0.05;
/// Largest share of the tail in the power.
const TAIL_POWER_SHARE: f64 = 0.15;
/// Largest share of one joint in the bend of the trunk.
const TRUNK_BEND_SHARE: f64 = 0.5;
/// Largest share of time in which parts of the robot overlap.
const OVERLAP_SHARE: f64 = 1e-3;
/// The same of a robot whose posture is not judged: legs may brush now and then.
const BRUSH_SHARE: f64 = 1e-2;

/// One gate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gate {
    /// What is looked at.
    pub name: Cow<'static, str>,
    /// What was found, worst foot where there is one per foot.
    pub value: f64,
    /// Smallest value that passes; `None`: none.
    pub at_least: Option<f64>,
    /// Largest value that passes; `None`: none.
    pub at_most: Option<f64>,
    /// Whether it passes.
    pub met: bool,
}

impl Gate {
    /// Its name with what was found and what passes.
    pub fn told(&self) -> String {
        let limits = self.at_least.map(|x| format!("at least {x}")).into_iter();
        let limits = limits.chain(self.at_most.map(|x| format!("at most {x}")));
        let limits: Vec<String> = limits.collect();
        // three digits that count: 0.0014 must not read as its limit of 0.001
        let before = self.value.abs().max(1e-6).log10().floor() as i32;
        let digits = usize::try_from(2 - before).unwrap_or(0);
        format!("{} {:.digits$} ({})", self.name, self.value, limits.join(", "))
    }

    /// How far beyond its limit: 1 − value/limit of one that is too small, 1 − limit/value of one that is too large;
    /// 0 where it passes, at most 1.
    pub fn lacks(&self) -> f64 {
        let below = self.at_least.map_or(0.0, |least| 1.0 - self.value / least);
        let above = self.at_most.map_or(0.0, |most| 1.0 - most / self.value);
        if self.met { 0.0 } else { below.max(above).min(1.0) }
    }
}

/// All gates of a scenario, on means over its episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GateReport {
    /// Whether this is walking: there was something to measure, and every gate is met.
    pub walks: bool,
    /// The gates.
    pub gates: Vec<Gate>,
}

impl GateReport {
    /// Judges the episodes of one scenario, on `flat` ground or not.
    pub fn of(gaits: &[Gait], limits: &GatesConfig, flat: bool) -> Self {
        if gaits.is_empty() {
            return Self::default();
        }
        let means = Means(gaits);
        let mut gates = means.of_walking(limits, flat);
        if limits.posture {
            gates.extend(means.of_posture(flat));
        }
        let overlap = if limits.posture { OVERLAP_SHARE } else { BRUSH_SHARE };
        gates.push(at_most("overlaps itself", means.of(|g| g.posture.overlap_share), overlap));
        Self { walks: gates.iter().all(|g| g.met), gates }
    }

    /// Names of the gates that are not met.
    pub fn missed(&self) -> Vec<&str> {
        self.gates.iter().filter(|g| !g.met).map(|g| g.name.as_ref()).collect()
    }
}

/// Means over episodes, of which there is at least one.
struct Means<'a>(&'a [Gait]);

impl Means<'_> {
    fn of(&self, value: impl Fn(&Gait) -> f64) -> f64 {
        self.0.iter().map(value).sum::<f64>() / self.0.len() as f64
    }

    /// Smallest and largest of `count` means.
    fn ends(&self, count: usize, value: impl Fn(&Gait, usize) -> f64) -> [f64; 2] {
        let mut ends = [f64::INFINITY, f64::NEG_INFINITY];
        for i in 0..count {
            let mean = self.of(|g| value(g, i));
            ends = [ends[0].min(mean), ends[1].max(mean)];
        }
        ends
    }

    fn of_walking(&self, limits: &GatesConfig, flat: bool) -> Vec<Gate> {
        let mut gates = Vec::new();
        if limits.speed_share > 0.0 {
            let share = self.of(|g| g.speed_share);
            gates.push(at_least("share of the commanded speed", share, limits.speed_share));
        }
        let feet = self.0[0].duty_factor.len();
        if feet > 0 {
            gates.extend(self.of_feet(feet, limits));
        }
        let vibration = self.of(|g| g.vibration_share);
        let name = format!("joint power above {} Hz", limits.vibration_hz);
        gates.push(at_most("power, W", self.of(|g| g.power_w), limits.power_w));
        gates.push(at_most(name, vibration, limits.vibration_share));
        if flat && feet > 0 {
            let (share, most) = (self.of(|g| g.trunk_contact_share), limits.trunk_contact_share);
            gates.push(at_most("trunk on the ground", share, most));
        }
        if flat && !limits.posture {
            gates.push(at_most(
                YAW_OFF,
                self.of(|g| g.posture.yaw_off_radps),
                limits.yaw_off_radps,
            ));
        }
        gates
    }

    /// The gates of a robot with feet, the worst foot deciding.
    fn of_feet(&self, feet: usize, limits: &GatesConfig) -> Vec<Gate> {
        let duty = self.ends(feet, |g, foot| g.duty_factor[foot]);
        let clearance = self.ends(feet, |g, foot| g.clearance_m[foot]);
        let mut gates = vec![
            at_least("duty factor, least", duty[0], limits.duty_factor[0]),
            at_most("duty factor, most", duty[1], limits.duty_factor[1]),
            at_most("stance slip, m/s", self.of(|g| g.slip_mps), limits.slip_mps),
            at_least("clearance, m", clearance[0], limits.clearance_m),
        ];
        // a robot without a clock keeps no time
        if self.0[0].clock_hz > 0.0 {
            let off_clock = self.of(|g| (g.stride_hz / g.clock_hz - 1.0).abs());
            gates.push(at_most(
                "stride frequency off the clock",
                off_clock,
                limits.stride_off_clock,
            ));
        }
        gates
    }

    fn of_posture(&self, flat: bool) -> Vec<Gate> {
        let joints = self.0[0].posture.off_rad.len();
        let off = self.ends(joints, |g, joint| g.posture.off_rad[joint])[1];
        let at_stop = self.ends(joints, |g, joint| g.posture.at_stop_share[joint])[1];
        let of = |value: fn(&Posture) -> f64| self.of(|g| value(&g.posture));
        let (sides, duty) = (of(|p| p.sides_apart_rad), of(|p| p.duty_apart));
        let (tail, bend) = (of(|p| p.tail_power_share), of(|p| p.trunk_bend_share));
        let mut gates = vec![
            at_most("joint off nominal and mirror, rad", off, OFF_RAD),
            at_most("at an end stop", at_stop, AT_STOP_SHARE),
            at_most("leg swing apart left and right, rad", sides, SIDES_APART_RAD),
            at_most("duty factor apart left and right", duty, DUTY_APART),
            at_most("tail's share of the power", tail, TAIL_POWER_SHARE),
            at_most("trunk bend in one joint", bend, TRUNK_BEND_SHARE),
        ];
        if flat {
            let (yaw, side) = (of(|p| p.yaw_off_radps), of(|p| p.side_off_mps));
            gates.push(at_most(YAW_OFF, yaw, YAW_OFF_RADPS));
            gates.push(at_most("sideways off the command, m/s", side, SIDE_OFF_MPS));
        }
        gates
    }
}

fn at_most(name: impl Into<Cow<'static, str>>, value: f64, most: f64) -> Gate {
    gate(name, value, None, Some(most))
}

fn at_least(name: &'static str, value: f64, least: f64) -> Gate {
    gate(name, value, Some(least), None)
}

fn gate(
    name: impl Into<Cow<'static, str>>,
    value: f64,
    at_least: Option<f64>,
    at_most: Option<f64>,
) -> Gate {
    let met =
        at_least.is_none_or(|least| value >= least) && at_most.is_none_or(|most| value <= most);
    Gate { name: name.into(), value, at_least, at_most, met: met && value.is_finite() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::tests::{measure, trot};

    fn judged(stride_hz: f64, shake: f64) -> GateReport {
        let gait = Gait::of(&trot(stride_hz, shake), &measure()).unwrap();
        GateReport::of(&[gait], &GatesConfig::default(), true)
    }

    #[test]
    fn a_trot_walks() {
        let report = judged(1.4, 0.0);
        assert!(report.walks, "{:?}", report.missed());
    }

    #[test]
    fn vibrating_is_not_walking() {
        let report = judged(1.4, 0.5);
        assert!(!report.walks);
        assert_eq!(report.missed(), ["joint power above 6 Hz"]);
    }

    #[test]
    fn each_limit_can_fail_alone() {
        let good = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        type Spoil = fn(&mut Gait);
        let spoil: [(&str, Spoil); 17] = [
            ("stride frequency off the clock", |g| g.stride_hz = 2.8),
            ("duty factor, least", |g| g.duty_factor[2] = 0.39),
            ("duty factor, most", |g| g.duty_factor[1] = 0.71),
            ("power, W", |g| g.power_w = 12.1),
            ("stance slip, m/s", |g| g.slip_mps = 0.061),
            ("clearance, m", |g| g.clearance_m[3] = 0.029),
            ("joint power above 6 Hz", |g| g.vibration_share = 0.051),
            ("trunk on the ground", |g| g.trunk_contact_share = 0.011),
            ("joint off nominal and mirror, rad", |g| g.posture.off_rad[3] = 0.18),
            ("at an end stop", |g| g.posture.at_stop_share[0] = 0.021),
            ("leg swing apart left and right, rad", |g| g.posture.sides_apart_rad = 0.09),
            ("duty factor apart left and right", |g| g.posture.duty_apart = 0.06),
            ("tail's share of the power", |g| g.posture.tail_power_share = 0.16),
            ("trunk bend in one joint", |g| g.posture.trunk_bend_share = 0.51),
            ("overlaps itself", |g| g.posture.overlap_share = 0.002),
            ("yaw off the command, rad/s", |g| g.posture.yaw_off_radps = 0.021),
            ("sideways off the command, m/s", |g| g.posture.side_off_mps = 0.011),
        ];
        for (name, change) in spoil {
            let mut gait = good.clone();
            change(&mut gait);
            assert_eq!(GateReport::of(&[gait], &GatesConfig::default(), true).missed(), [name]);
        }
    }

    #[test]
    fn no_robot_may_go_through_itself() {
        let limits = GatesConfig { posture: false, ..GatesConfig::default() };
        let mut gait = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        for (share, missed) in [(0.009, &[][..]), (0.08, &["overlaps itself"])] {
            gait.posture.overlap_share = share;
            assert_eq!(GateReport::of(&[gait.clone()], &limits, true).missed(), missed);
        }
        let report = GateReport::of(&[gait], &limits, true);
        let missed = report.gates.iter().find(|gate| !gate.met).map(Gate::told);
        assert_eq!(missed.as_deref(), Some("overlaps itself 0.0800 (at most 0.01)"));
    }

    /// Also where posture is not judged a robot that is told to go straight must not go in circles; rough ground may
    /// turn it.
    #[test]
    fn a_robot_in_circles_does_not_walk() {
        let limits = GatesConfig { posture: false, ..GatesConfig::default() };
        let mut gait = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        gait.posture.yaw_off_radps = 0.09;
        assert!(GateReport::of(&[gait.clone()], &limits, true).walks);
        gait.posture.yaw_off_radps = 0.11;
        assert_eq!(GateReport::of(&[gait.clone()], &limits, true).missed(), [YAW_OFF]);
        assert!(GateReport::of(&[gait], &limits, false).walks);
    }

    #[test]
    fn nothing_measured_is_not_walking() {
        assert!(!GateReport::of(&[], &GatesConfig::default(), true).walks);
    }
}
