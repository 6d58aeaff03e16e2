//! What a policy does instead of walking.

use std::sync::Arc;

use caudata_config::Config;
use caudata_evaluation::{Scenario, ScenarioResult, Settings, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_studies::failures::refused;
use caudata_telemetry::{Failure, StopFlag};
use serde::Serialize;

/// Score from which a robot counts as walking here. Short trainings of healthy tasks come to 0.87 and more (ten
/// seeds of two robots), and miss gates of slip and posture that more training meets.
pub const WALKS: f64 = 0.8;
/// Share of a commanded difference from which a robot follows its command. Healthy tasks come to 0.4 and more in
/// short trainings (of a yaw rate to 0.02 to 0.8, which says nothing).
const OBEYS: f64 = 0.4;
/// How episodes are rolled out: short, for the answer is coarse.
const SETTINGS: Settings =
    Settings { episodes: 12, episode_s: 8.0, settle_s: 2.0, seed: 1, film: false };

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
    /// How much of the difference between two commanded forward velocities it makes, 0 to 1.
    pub obeys: f64,
    /// Share of the episodes that ended by failing.
    pub fall_share: f64,
    /// Why most of them did.
    pub fell_by: Option<String>,
    /// What is to be seen, strongest first; empty where it walks.
    pub signs: Vec<Sign>,
}

/// How much of a commanded difference comes, 0 to 1: 1 all of it, 0 none of it, or twice as much.
fn share_of(difference: f64, commanded: f32) -> f64 {
    if commanded == 0.0 {
        return 1.0;
    }
    let near = 1.0 - (difference / f64::from(commanded) - 1.0).abs();
    // an episode that is over before it can be measured gives no velocity at all
    if near.is_finite() { near.clamp(0.0, 1.0) } else { 0.0 }
}

impl Behaviour {
    /// Whether that is walking.
    pub fn walks(&self) -> bool {
        self.score >= WALKS
    }

    /// Rolls a policy out at the forward velocity that its configuration is judged at, and at a slower walk,
    /// the slowest of the configuration that is known to train such a robot.
    ///
    /// # Errors
    /// When the policy does not fit, the simulation cannot be built, or `stop` is raised.
    pub fn of(
        config: &Config,
        reference: &Config,
        model: &Arc<RobotModel>,
        policy: &PolicyFile,
        stop: &StopFlag,
    ) -> Result<Self, Failure> {
        let roll = |command: [f32; 3]| {
            let scenario = Scenario::trained("explain", command, &config.terrain);
            let go_on = || !stop.is_set();
            run_scenario(config, model, policy, &scenario, &SETTINGS, &go_on)
                .map(|episodes| episodes.result)
                .map_err(|error| refused(error, stop))
        };
        let fast = config.evaluation.command_mps as f32;
        let walking = roll([fast, 0.0, 0.0])?;
        let vibration_hz = config.evaluation.gates.vibration_hz;
        let mut found = Self::judged(&walking, f64::from(fast), vibration_hz);
        let slow = reference.task.command.vx_mps[0].max(0.0);
        let slower = roll([slow, 0.0, 0.0])?;
        found.obeys = share_of(found.vx_mps - slower.vx_mps.mean, fast - slow);
        found.score *= 0.5 + 0.5 * (found.obeys / OBEYS).min(1.0);
        if found.walks() {
            found.signs.clear();
        } else if found.vx_mps.abs() > 0.2 * found.command_mps && found.obeys < 0.5 * OBEYS {
            found.signs.insert(0, Sign::IgnoresCommand);
        }
        Ok(found)
    }

    fn judged(result: &ScenarioResult, command: f64, vibration_hz: f64) -> Self {
        let (vx, vy) = (result.vx_mps.mean, result.vy_mps.mean);
        let (yaw, falls) = (result.yaw_rate_radps.mean, result.fall_share.mean);
        // what has no feet lies or rolls on the ground
        let belly = match result.duty_factor.is_empty() {
            true => 0.0,
            false => result.trunk_contact_share.mean,
        };
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
            (moves && idle > 0 && idle < result.duty_factor.len(), Sign::FewerLegs),
            (moves && (0.15..WALKS).contains(&share), Sign::Slow),
        ];
        let fell_by = result.falls.iter().max_by_key(|(_, n)| **n);
        Self {
            score,
            command_mps: command,
            vx_mps: vx,
            fall_share: falls,
            fell_by: fell_by.map(|(reason, _)| reason.to_string()),
            signs: seen.iter().filter(|s| s.0).map(|s| s.1).collect(),
            obeys: 0.0,
        }
    }
}
