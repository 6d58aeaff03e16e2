//! What a policy does instead of walking.

use std::sync::Arc;

use caudata_config::Config;
use caudata_evaluation::{Scenario, ScenarioResult, Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_studies::failures::refused;
use caudata_telemetry::{Failure, StopFlag};
use serde::Serialize;

/// Score from which a robot counts as walking here. Short trainings come to 0.75 and more of a healthy task,
/// and miss gates of slip and posture that more training meets.
pub const WALKS: f64 = 0.6;
/// How episodes are rolled out: short, for the answer is coarse.
const SETTINGS: Settings = Settings {
    episodes: 12,
    episode_s: 8.0,
    settle_s: 2.0,
    seed: 1,
    film: false,
};

/// Something that a robot does which does not walk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Sign {
    /// Hardly any motion.
    StandsStill,
    /// Episodes end by failing.
    Falls,
    /// Joint power above the frequency of steps.
    Vibrates,
    /// Trunk or legs lie on the ground.
    Belly,
    /// A foot that never leaves the ground, or never meets it, while others step.
    FewerLegs,
    /// Turns although it is not told to.
    Turns,
    /// The same velocity whatever is commanded.
    IgnoresCommand,
    /// Backward or sideways.
    OtherWay,
    /// The right way, slowly.
    Slow,
}

impl Sign {
    /// In words, as the end of "it …".
    pub fn words(self) -> &'static str {
        match self {
            Self::StandsStill => "stands still",
            Self::Falls => "falls, or its episodes end at once",
            Self::Vibrates => "vibrates",
            Self::Belly => "slides on its belly",
            Self::FewerLegs => "walks on fewer legs than it has",
            Self::Turns => "turns",
            Self::IgnoresCommand => "ignores the command",
            Self::OtherWay => "goes another way than it is told",
            Self::Slow => "is slow",
        }
    }
}

/// What it does, in figures and signs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Behaviour {
    /// 1: exactly as commanded, on its feet; 0: nothing of it.
    pub score: f64,
    /// Forward velocity commanded, m/s.
    pub command_mps: f64,
    /// Velocity forward, m/s.
    pub vx_mps: f64,
    /// Share of the episodes that ended by failing.
    pub fall_share: f64,
    /// Why most of them did.
    pub fell_by: Option<String>,
    /// What is to be seen, strongest first; empty where it walks.
    pub signs: Vec<Sign>,
}

impl Behaviour {
    /// Whether that is walking.
    pub fn walks(&self) -> bool {
        self.score >= WALKS
    }

    /// Rolls a policy out at the forward velocity that its configuration is judged at, and standing.
    ///
    /// # Errors
    /// When the policy does not fit, the simulation cannot be built, or `stop` is raised.
    pub fn of(
        config: &Config,
        model: &Arc<RobotModel>,
        policy: &PolicyFile,
        stop: &StopFlag,
    ) -> Result<Self, Failure> {
        let roll = |vx: f32| {
            let scenario = Scenario::walk("explain", [vx, 0.0, 0.0]);
            let go_on = || !stop.is_set();
            run_scenario(config, model, policy, &scenario, &SETTINGS, &go_on)
                .map_err(|error| refused(error, stop))
        };
        let command = config.evaluation.command_mps;
        let walking = roll(command as f32)?.result;
        let mut found = Self::judged(&walking, command, config.evaluation.gates.vibration_hz);
        if !found.walks() {
            let standing = roll(0.0)?.result;
            let (told, untold) = (walking.vx_mps.mean, standing.vx_mps.mean);
            if told.abs() > 0.2 * command && (told - untold).abs() < 0.3 * told.abs() {
                found.signs.insert(0, Sign::IgnoresCommand);
            }
        }
        Ok(found)
    }

    fn judged(result: &ScenarioResult, command: f64, vibration_hz: f64) -> Self {
        let (vx, vy) = (result.vx_mps.mean, result.vy_mps.mean);
        let (yaw, falls) = (result.yaw_rate_radps.mean, result.fall_share.mean);
        let belly = result.trunk_contact_share.mean;
        let share = vx / command;
        let vibrates = vibration_hz > 0.0 && result.vibration_share.mean > 0.3;
        let turning = (2.0 * (yaw.abs() - 0.15)).clamp(0.0, 1.0);
        let score = (1.0 - (share - 1.0).abs()).clamp(0.0, 1.0)
            * (1.0 - falls)
            * (1.0 - belly).clamp(0.0, 1.0)
            * (1.0 - turning)
            * if vibrates { 0.7 } else { 1.0 };
        // an episode that is over before it can be measured gives no velocity at all
        let score = if score.is_finite() { score } else { 0.0 };
        let on_ground = |duty: &f64| *duty > 0.97 || *duty < 0.03;
        let idle = result.duty_factor.iter().filter(|d| on_ground(d)).count();
        let moves = vx.abs().max(vy.abs()) > 0.15 * command;
        let seen = [
            (falls > 0.3, Sign::Falls),
            (!moves && yaw.abs() < 0.2, Sign::StandsStill),
            (belly > 0.3, Sign::Belly),
            (vibrates, Sign::Vibrates),
            (share < -0.15 || vy.abs() > 0.5 * command, Sign::OtherWay),
            (yaw.abs() > 0.25, Sign::Turns),
            (
                moves && idle > 0 && idle < result.duty_factor.len(),
                Sign::FewerLegs,
            ),
            (moves && (0.15..0.7).contains(&share), Sign::Slow),
        ];
        let fell_by = result.falls.iter().max_by_key(|(_, n)| **n);
        Self {
            score,
            command_mps: command,
            vx_mps: vx,
            fall_share: falls,
            fell_by: fell_by.map(|(reason, _)| reason.to_string()),
            signs: match score >= WALKS {
                true => Vec::new(),
                false => seen.iter().filter(|s| s.0).map(|s| s.1).collect(),
            },
        }
    }
}
