//! What counts as walking. Rewards for velocity can be had by vibrating, in any simulator; these gates
//! cannot.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use crate::gait::Gait;

/// The limits. Defaults are the project's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest |stride frequency / clock − 1|.
    pub stride_off_clock: f64,
    /// Smallest and largest duty factor of each foot.
    pub duty_factor: [f64; 2],
    /// Largest mean power, W.
    pub power_w: f64,
    /// Largest share of time with the trunk on the ground; not looked at on rough ground.
    pub trunk_contact_share: Option<f64>,
    /// Largest slip of a foot in stance, m/s.
    pub slip_mps: f64,
    /// Smallest height that every foot reaches, m.
    pub clearance_m: f64,
    /// Largest share of joint power above [`crate::gait::VIBRATION_HZ`].
    pub vibration_share: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            stride_off_clock: 0.15,
            duty_factor: [0.4, 0.7],
            power_w: 12.0,
            trunk_contact_share: Some(0.01),
            slip_mps: 0.06,
            clearance_m: 0.03,
            vibration_share: 0.05,
        }
    }
}

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
    /// Judges the episodes of one scenario.
    #[must_use]
    pub fn of(gaits: &[Gait], limits: &Limits) -> Self {
        if gaits.is_empty() {
            return Self::default();
        }
        let mean = |value: &dyn Fn(&Gait) -> f64| {
            gaits.iter().map(value).sum::<f64>() / gaits.len() as f64
        };
        let feet = gaits[0].duty_factor.len();
        let clearance = (0..feet).map(|foot| mean(&|g| g.clearance_m[foot]));
        let feet: Vec<f64> = (0..feet)
            .map(|foot| mean(&|g| g.duty_factor[foot]))
            .collect();
        let off_clock = mean(&|g| (g.stride_hz / g.clock_hz - 1.0).abs());
        let lowest = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
        let highest = |values: &[f64]| values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut gates = vec![
            gate(
                "stride frequency off the clock",
                off_clock,
                None,
                Some(limits.stride_off_clock),
            ),
            gate(
                "duty factor, least",
                lowest(&feet),
                Some(limits.duty_factor[0]),
                None,
            ),
            gate(
                "duty factor, most",
                highest(&feet),
                None,
                Some(limits.duty_factor[1]),
            ),
            gate("power, W", mean(&|g| g.power_w), None, Some(limits.power_w)),
            gate(
                "stance slip, m/s",
                mean(&|g| g.slip_mps),
                None,
                Some(limits.slip_mps),
            ),
            gate(
                "clearance, m",
                lowest(&clearance.collect::<Vec<_>>()),
                Some(limits.clearance_m),
                None,
            ),
            gate(
                "joint power above 6 Hz",
                mean(&|g| g.vibration_share),
                None,
                Some(limits.vibration_share),
            ),
        ];
        if let Some(most) = limits.trunk_contact_share {
            let share = mean(&|g| g.trunk_contact_share);
            gates.push(gate("trunk on the ground", share, None, Some(most)));
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

fn gate(name: &'static str, value: f64, at_least: Option<f64>, at_most: Option<f64>) -> Gate {
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
        GateReport::of(&[gait], &Limits::default())
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
            assert_eq!(GateReport::of(&[gait], &Limits::default()).missed(), [name]);
        }
    }

    #[test]
    fn nothing_measured_is_not_walking() {
        assert!(!GateReport::of(&[], &Limits::default()).walks);
    }
}
