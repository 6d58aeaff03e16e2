//! What counts as walking. Rewards for velocity can be had by vibrating, in any simulator; these gates
//! cannot.

use std::borrow::Cow;

pub use caudata_config::GatesConfig as Limits;
use serde::{Deserialize, Serialize};

use crate::gait::Gait;

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

/// All gates of a scenario, on means over its episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GateReport {
    /// Whether this is walking: there was something to measure, and every gate is met.
    pub walks: bool,
    /// The gates.
    pub gates: Vec<Gate>,
}

impl GateReport {
    /// Judges the episodes of one scenario. `flat`: on ground on which a trunk that touches it is a fault.
    #[must_use]
    pub fn of(gaits: &[Gait], limits: &Limits, flat: bool) -> Self {
        let Some(first) = gaits.first() else {
            return Self::default();
        };
        let mean = |value: &dyn Fn(&Gait) -> f64| {
            gaits.iter().map(value).sum::<f64>() / gaits.len() as f64
        };
        let mut gates = Vec::new();
        if limits.speed_share > 0.0 {
            let share = mean(&|g| g.speed_share);
            gates.push(gate(
                "share of the commanded speed",
                share,
                Some(limits.speed_share),
                None,
            ));
        }
        if first.duty_factor.len() > 0 {
            gates.extend(of_feet(
                &mean,
                first.duty_factor.len(),
                first.clock_hz > 0.0,
                limits,
            ));
        }
        gates.push(gate(
            "power, W",
            mean(&|g| g.power_w),
            None,
            Some(limits.power_w),
        ));
        gates.push(gate(
            format!("joint power above {} Hz", limits.vibration_hz),
            mean(&|g| g.vibration_share),
            None,
            Some(limits.vibration_share),
        ));
        if flat && first.duty_factor.len() > 0 {
            let share = mean(&|g| g.trunk_contact_share);
            let most = Some(limits.trunk_contact_share);
            gates.push(gate("trunk on the ground", share, None, most));
        }
        Self {
            walks: gates.iter().all(|g| g.met),
            gates,
        }
    }

    /// Names of the gates that are not met.
    #[must_use]
    pub fn missed(&self) -> Vec<&str> {
        self.gates
            .iter()
            .filter(|g| !g.met)
            .map(|g| g.name.as_ref())
            .collect()
    }
}

/// The gates of a robot with so many feet, the worst foot deciding.
fn of_feet(
    mean: &dyn Fn(&dyn Fn(&Gait) -> f64) -> f64,
    feet: usize,
    clock: bool,
    limits: &Limits,
) -> Vec<Gate> {
    let each = |value: &dyn Fn(&Gait, usize) -> f64| {
        let values = (0..feet).map(|foot| mean(&|g| value(g, foot)));
        values.fold([f64::INFINITY, f64::NEG_INFINITY], |[lo, hi], v| {
            [lo.min(v), hi.max(v)]
        })
    };
    let duty = each(&|g, foot| g.duty_factor[foot]);
    let clearance = each(&|g, foot| g.clearance_m[foot]);
    let [least, most] = limits.duty_factor;
    let mut gates = Vec::new();
    if clock {
        let off = mean(&|g| (g.stride_hz / g.clock_hz - 1.0).abs());
        let most = Some(limits.stride_off_clock);
        gates.push(gate("stride frequency off the clock", off, None, most));
    }
    gates.extend([
        gate("duty factor, least", duty[0], Some(least), None),
        gate("duty factor, most", duty[1], None, Some(most)),
        gate(
            "stance slip, m/s",
            mean(&|g| g.slip_mps),
            None,
            Some(limits.slip_mps),
        ),
        gate("clearance, m", clearance[0], Some(limits.clearance_m), None),
    ]);
    gates
}

fn gate(
    name: impl Into<Cow<'static, str>>,
    value: f64,
    at_least: Option<f64>,
    at_most: Option<f64>,
) -> Gate {
    let met =
        at_least.is_none_or(|least| value >= least) && at_most.is_none_or(|most| value <= most);
    Gate {
        name: name.into(),
        value,
        at_least,
        at_most,
        met: met && value.is_finite(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::tests::{measure, trot};

    fn judged(stride_hz: f64, shake: f64) -> GateReport {
        let gait = Gait::of(&trot(stride_hz, shake), &measure()).unwrap();
        GateReport::of(&[gait], &Limits::default(), true)
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
        let spoil: [(&str, Spoil); 8] = [
            ("stride frequency off the clock", |g| g.stride_hz = 2.8),
            ("duty factor, least", |g| g.duty_factor[2] = 0.39),
            ("duty factor, most", |g| g.duty_factor[1] = 0.71),
            ("power, W", |g| g.power_w = 12.1),
            ("stance slip, m/s", |g| g.slip_mps = 0.061),
            ("clearance, m", |g| g.clearance_m[3] = 0.029),
            ("joint power above 6 Hz", |g| g.vibration_share = 0.051),
            ("trunk on the ground", |g| g.trunk_contact_share = 0.011),
        ];
        for (name, change) in spoil {
            let mut gait = good.clone();
            change(&mut gait);
            assert_eq!(
                GateReport::of(&[gait], &Limits::default(), true).missed(),
                [name]
            );
        }
    }

    #[test]
    fn nothing_measured_is_not_walking() {
        assert!(!GateReport::of(&[], &Limits::default(), true).walks);
    }
}
