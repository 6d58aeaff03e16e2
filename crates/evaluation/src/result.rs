//! What an evaluation found.

use std::borrow::Cow;
use std::collections::BTreeMap;

use caudata_task::PerFoot;
use serde::{Deserialize, Serialize};

use crate::gait::Gait;
use crate::posture::PostureResult;
use crate::righting::RightingResult;
use crate::stride::Stride;
use crate::transition::{Passage, TransitionResult};
use crate::wave::{Wave, WaveResult};
use crate::{Estimate, GateReport, Suite};

/// Share of the commanded way from which on an episode has arrived.
const ARRIVED_SHARE: f64 = 0.8;

/// A policy in all scenarios of a suite.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SuiteResult {
    /// The suite.
    pub suite: Suite,
    /// The engine.
    pub engine: Cow<'static, str>,
    /// Version of the policy.
    pub policy_version: u64,
    /// SHA-256 of the policy's bytes, hex.
    pub policy_sha256: String,
    /// One entry per scenario.
    pub scenarios: Vec<ScenarioResult>,
    /// The same on a second engine, where that was asked for.
    pub referee: Option<Referee>,
    /// The project's targets, for the suite `acceptance`; else empty.
    pub acceptance: Vec<Row>,
    /// Salamanders beside the robot, for the suite `animal`; else empty.
    #[serde(default)]
    pub animal: Vec<AnimalRow>,
}

impl SuiteResult {
    /// The scenario of that name.
    pub fn scenario(&self, name: &str) -> Option<&ScenarioResult> {
        self.scenarios.iter().find(|s| s.name == name)
    }
}

/// What another engine says of the same policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Referee {
    /// The engine.
    pub engine: Cow<'static, str>,
    /// Its results, for all scenarios or some.
    pub scenarios: Vec<ScenarioResult>,
}

impl Referee {
    /// Its result for the scenario of that name.
    pub fn scenario(&self, name: &str) -> Option<&ScenarioResult> {
        self.scenarios.iter().find(|s| s.name == name)
    }
}

/// One of the project's targets for a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// What is measured.
    pub name: Cow<'static, str>,
    /// Its unit; `1` for pure numbers.
    pub unit: Cow<'static, str>,
    /// The limit that is owed.
    pub owed: f64,
    /// The figure that is aimed at.
    pub aim: f64,
    /// Whether it must be at least that (else at most).
    pub at_least: bool,
    /// What was measured; `None`: nothing could be.
    pub measured: Option<f64>,
    /// Whether what is owed is met, gates and falls included.
    pub met: bool,
    /// Whether the aim is.
    pub aim_met: bool,
    /// Why not, where the figure alone does not say it.
    pub note: String,
}

/// One quantity of the animal and of the robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AnimalRow {
    /// What.
    pub name: Cow<'static, str>,
    /// Its unit; `1` for pure numbers.
    pub unit: Cow<'static, str>,
    /// The animal's, least and most.
    pub animal: [f64; 2],
    /// The robot's; `None` where it was not measured.
    pub robot: Option<f64>,
    /// 1 within the animal's range, else how many times it is the nearer end of it, or that of it; `None`
    /// where nothing was measured.
    pub score: Option<f64>,
    /// Where the animal's figure is from.
    pub source: Cow<'static, str>,
}

/// A policy in one scenario. Means are over episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ScenarioResult {
    /// Its name.
    pub name: String,
    /// Episodes.
    pub episodes: usize,
    /// Episodes that ended by failing, per reason.
    pub falls: BTreeMap<Cow<'static, str>, usize>,
    /// Share of episodes that ended by failing.
    pub fall_share: Estimate,
    /// Mean command: vx, vy (m/s), yaw rate (rad/s).
    pub command: [f64; 3],
    /// Mean velocity forward, heading frame, m/s.
    pub vx_mps: Estimate,
    /// Mean velocity to the left, heading frame, m/s.
    pub vy_mps: Estimate,
    /// Mean yaw rate, rad/s.
    pub yaw_rate_radps: Estimate,
    /// Root mean square over episodes of (mean velocity or yaw rate − command): vx, vy (m/s), yaw rate
    /// (rad/s).
    pub rmse_of_means: [f64; 3],
    /// Mean over episodes of the root mean square error of whole strides.
    pub rmse_of_strides: [f64; 3],
    /// Way from start to end over time, m/s.
    pub drift_mps: Estimate,
    /// Σ|q̇τ|, W.
    pub power_w: Estimate,
    /// Power over weight times speed.
    pub cost_of_transport: Estimate,
    /// Strongest frequency in the feet's heights, Hz.
    pub stride_hz: Estimate,
    /// Share of time on the ground per foot: FL, FR, HL, HR.
    pub duty_factor: PerFoot<f64>,
    /// Height that each foot reaches, m.
    pub clearance_m: PerFoot<f64>,
    /// Speed of feet in stance, m/s.
    pub slip_mps: Estimate,
    /// Share of joint power above 6 Hz.
    pub vibration_share: Estimate,
    /// Share of time with trunk or legs on the ground.
    pub trunk_contact_share: Estimate,
    /// Largest torque of any motor in any episode, N·m.
    pub torque_peak_nm: f64,
    /// Root mean square torque, N·m.
    pub torque_rms_nm: f64,
    /// Share of time and motors at 95 % or more of what the servo can give at that speed.
    pub servo_limit_share: f64,
    /// Largest joint speed in any episode, rad/s.
    pub joint_speed_peak_radps: f64,
    /// Root mean square joint acceleration, rad/s².
    pub joint_accel_rms_radps2: f64,
    /// How it holds itself; `None` where nothing could be measured.
    pub posture: Option<PostureResult>,
    /// Whether it walks; `None` where the scenario is not about walking.
    pub gates: Option<GateReport>,
    /// The wave along the body; `None` where it hardly bends.
    pub wave: Option<WaveResult>,
    /// How limbs and trunk go together; `None` for robots without two girdles.
    #[serde(default)]
    pub stride: Option<Stride>,
    /// The least share of the commanded speed that any episode reached; 1 where none was commanded.
    #[serde(default)]
    pub speed_share_least: f64,
    /// Getting into the water or out of it; `None` where the scenario is not about that.
    pub transition: Option<TransitionResult>,
    /// Share of the episodes that, once they had settled, came at least 80 % of the way ahead that was commanded
    /// and did not fall; `None` where the scenario is not about that.
    #[serde(default)]
    pub arrived: Option<Estimate>,
    /// Getting up again; `None` where the scenario is not about that.
    #[serde(default)]
    pub righting: Option<RightingResult>,
}

/// What an episode contributes.
#[derive(Clone, Debug, Default)]
pub(crate) struct Episode {
    pub command: [f32; 3],
    pub fell: Option<&'static str>,
    /// `None`: over too soon to be measured.
    pub gait: Option<Gait>,
    /// At a shore.
    pub passage: Option<Passage>,
    pub wave: Option<Wave>,
    /// When it was upright for good, s.
    pub righted_s: Option<f64>,
}

impl Episode {
    /// Whether it did not fall and, once it had settled, came at least [`ARRIVED_SHARE`] of the way ahead that was
    /// commanded.
    pub(crate) fn arrived(&self) -> bool {
        let far = |gait: &Gait| gait.ahead_mps >= ARRIVED_SHARE * f64::from(self.command[0]);
        self.fell.is_none() && self.gait.as_ref().is_some_and(far)
    }
}

impl ScenarioResult {
    /// Sums up the episodes of one scenario of a robot with so many feet.
    pub(crate) fn of(
        name: &str,
        feet: usize,
        episodes: &[Episode],
        gates: Option<GateReport>,
    ) -> Self {
        let gaits: Vec<&Gait> = episodes.iter().filter_map(|e| e.gait.as_ref()).collect();
        let estimate = |value: &dyn Fn(&Gait) -> f64| {
            let values: Vec<f64> = gaits.iter().map(|g| value(g)).collect();
            Estimate::of(&values)
        };
        let mean = |value: &dyn Fn(&Gait) -> f64| estimate(value).mean;
        let most = |value: fn(&Gait) -> f64| gaits.iter().map(|g| value(g)).fold(0.0, f64::max);
        let mut falls = BTreeMap::new();
        for reason in episodes.iter().filter_map(|e| e.fell) {
            *falls.entry(reason.into()).or_insert(0) += 1;
        }
        Self {
            name: name.to_owned(),
            episodes: episodes.len(),
            fall_share: Estimate::share(falls.values().sum(), episodes.len()),
            falls,
            command: std::array::from_fn(|i| {
                let sum: f64 = episodes.iter().map(|e| f64::from(e.command[i])).sum();
                sum / episodes.len().max(1) as f64
            }),
            vx_mps: estimate(&|g| g.velocity_mps[0]),
            vy_mps: estimate(&|g| g.velocity_mps[1]),
            yaw_rate_radps: estimate(&|g| g.yaw_rate_radps),
            rmse_of_means: rmse_of_means(episodes),
            rmse_of_strides: std::array::from_fn(|i| mean(&|g| g.tracking_rmse[i])),
            drift_mps: estimate(&|g| g.drift_mps),
            power_w: estimate(&|g| g.power_w),
            cost_of_transport: estimate(&|g| g.cost_of_transport),
            stride_hz: estimate(&|g| g.stride_hz),
            duty_factor: PerFoot::from_fn(feet, |foot| mean(&|g| g.duty_factor[foot])),
            clearance_m: PerFoot::from_fn(feet, |foot| mean(&|g| g.clearance_m[foot])),
            slip_mps: estimate(&|g| g.slip_mps),
            vibration_share: estimate(&|g| g.vibration_share),
            trunk_contact_share: estimate(&|g| g.trunk_contact_share),
            torque_peak_nm: most(|g| g.torque_peak_nm),
            torque_rms_nm: mean(&|g| g.torque_rms_nm),
            servo_limit_share: mean(&|g| g.servo_limit_share),
            joint_speed_peak_radps: most(|g| g.joint_speed_peak_radps),
            joint_accel_rms_radps2: mean(&|g| g.joint_accel_rms_radps2),
            gates,
            stride: Stride::mean(gaits.iter().filter_map(|g| g.stride)),
            speed_share_least: gaits.iter().map(|g| g.speed_share).fold(1.0, f64::min),
            ..Self::default()
        }
    }

    /// Whether it walks by the gates and without falling in more than 5 % of the episodes; `None` where it is
    /// not about walking.
    pub fn walks(&self) -> Option<bool> {
        Some(self.gates.as_ref()?.walks && self.stays_up())
    }

    /// Whether it falls in at most 5 % of the episodes.
    pub fn stays_up(&self) -> bool {
        const FALLS_MOST: f64 = 0.05;
        self.fall_share.mean <= FALLS_MOST
    }
}

fn rmse_of_means(episodes: &[Episode]) -> [f64; 3] {
    let mut squares = [0.0; 3];
    let mut n = 0.0;
    for episode in episodes {
        let Some(gait) = &episode.gait else { continue };
        let [vx, vy] = gait.velocity_mps;
        for (i, got) in [vx, vy, gait.yaw_rate_radps].into_iter().enumerate() {
            squares[i] += (got - f64::from(episode.command[i])).powi(2);
        }
        n += 1.0;
    }
    squares.map(|sum| (sum / f64::max(n, 1.0)).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::tests::{measure, trot};

    #[test]
    fn falls_and_errors_by_hand() {
        let gait = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        let episode = |command, fell, gait| Episode { command, fell, gait, ..Episode::default() };
        let episodes = [
            episode([0.3, 0.0, 0.0], None, Some(gait.clone())),
            episode([0.5, 0.0, 0.1], None, Some(gait)),
            episode([0.3, 0.0, 0.0], Some("tilted"), None),
        ];
        let result = ScenarioResult::of("x", 4, &episodes, None);
        assert_eq!((result.episodes, result.falls["tilted"]), (3, 1));
        assert!((result.fall_share.mean - 1.0 / 3.0).abs() < 1e-12);
        // errors 0 and −0.2: √(0.04/2); 0 and −0.1: √(0.01/2)
        assert!((result.rmse_of_means[0] - 0.02_f64.sqrt()).abs() < 1e-4);
        assert!((result.rmse_of_means[2] - 0.005_f64.sqrt()).abs() < 1e-4);
        assert_eq!(result.walks(), None);
    }

    #[test]
    fn who_falls_too_often_does_not_walk() {
        let gait = Gait::of(&trot(1.4, 0.0), &measure()).unwrap();
        let walks = GateReport { walks: true, gates: Vec::new() };
        let mut episodes = vec![
            Episode {
                command: [0.3, 0.0, 0.0],
                fell: None,
                gait: Some(gait),
                ..Episode::default()
            };
            20
        ];
        episodes[0].fell = Some("tilted");
        let result = |e: &[Episode]| ScenarioResult::of("x", 4, e, Some(walks.clone())).walks();
        assert_eq!(result(&episodes), Some(true));
        episodes[1].fell = Some("tilted");
        assert_eq!(result(&episodes), Some(false));
    }
}
