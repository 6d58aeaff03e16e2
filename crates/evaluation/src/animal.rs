//! The animal as a yardstick: published kinematics of walking and swimming salamanders beside the robot's.
//!
//! A report, not a target: the robot has four joints where the animal has a spine.

use crate::anatomy::Anatomy;
use crate::result::{AnimalRow, ScenarioResult};

/// Least change of the duty factor with speed that counts as falling, s: the source gives no size, so any fall
/// down to this is within the animal's range.
const STEEPEST_S: f64 = -1.0;
/// Where a standing wave ends and a travelling one begins, degrees along the trunk. The source says standing and
/// travelling without a figure; an eighth of a cycle is ours.
const STANDING_DEG: f64 = 45.0;

/// Speeds at which animals were filmed, snout-vent lengths per second.
const WALK_PER_S: f64 = 0.63;
const TROT_PER_S: f64 = 2.9;

const NEWT: &str = "Ashley-Ross, Lundin and Johnson 2009, J Exp Zool A 311:240 (Taricha)";
const GIANT_SALAMANDER: &str = "Ashley-Ross 1994, J Exp Biol 193:255 (Dicamptodon)";
const GIANT_SALAMANDER_SPEED: &str = "Ashley-Ross 1994, J Exp Biol 193:285 (Dicamptodon)";
const TIGER_SALAMANDER: &str = "Frolich and Biewener 1992, J Exp Biol 162:107 (Ambystoma)";

fn row(
    name: &'static str,
    unit: &'static str,
    animal: [f64; 2],
    robot: Option<f64>,
    source: &'static str,
) -> AnimalRow {
    let score = robot.map(|x| {
        let nearest = x.clamp(animal[0], animal[1]);
        match x == nearest {
            true => 1.0,
            false if x <= 0.0 || nearest <= 0.0 => 0.0,
            false => (x / nearest).min(nearest / x),
        }
    });
    AnimalRow { name: name.into(), unit: unit.into(), animal, robot, score, source: source.into() }
}

/// The table from walks straight ahead and from swimming; empty for robots of another build.
pub fn animal(scenarios: &[ScenarioResult], anatomy: &Anatomy) -> Vec<AnimalRow> {
    let bends = anatomy.in_trunk.iter().any(|&is| is);
    if !bends || anatomy.sides.is_empty() || anatomy.snout_vent_m <= 0.0 {
        return Vec::new();
    }
    let per_s = |s: &ScenarioResult| s.vx_mps.mean / anatomy.snout_vent_m;
    let nearest = |to: f64| {
        let walks = scenarios.iter().filter(|s| s.walks() == Some(true) && s.command[0] > 0.0);
        walks.min_by(|a, b| (per_s(a) - to).abs().total_cmp(&(per_s(b) - to).abs()))
    };
    let (walk, trot) = (nearest(WALK_PER_S), nearest(TROT_PER_S));
    let duty = |s: &ScenarioResult| {
        let hind = anatomy.sides.iter().map(|side| s.duty_factor[side[0]]);
        hind.sum::<f64>() / anatomy.sides.len() as f64
    };
    let stride = walk.and_then(|s| s.stride);
    let slope = walk.zip(trot).and_then(|(slow, fast)| {
        let faster = per_s(fast) - per_s(slow);
        (faster > 0.1).then(|| (duty(fast) - duty(slow)) / faster)
    });
    // a policy that knows no water wags its legs there
    let swims =
        |s: &&ScenarioResult| s.name == crate::suite::SWIM && s.vx_mps.mean > 0.5 * s.command[0];
    let swim = scenarios.iter().find(swims);
    let lag = |s: Option<&ScenarioResult>| s.and_then(|s| trunk_lag_rad(s, anatomy));
    let degrees = |x: Option<f64>| x.map(f64::to_degrees);
    vec![
        row("duty factor of the hind feet at a walk", "1", [0.77, 0.77], walk.map(duty), NEWT),
        row(
            "… and its change per snout-vent length/s",
            "s",
            [STEEPEST_S, 0.0],
            slope,
            GIANT_SALAMANDER_SPEED,
        ),
        row(
            "fore foot after the hind foot of its side, strides",
            "1",
            [0.25, 0.5],
            stride.map(|s| s.limb_phase),
            NEWT,
        ),
        row(
            "trunk, from side to side",
            "°",
            [66.0, 66.0],
            degrees(stride.map(|s| s.trunk_rad)),
            GIANT_SALAMANDER,
        ),
        row(
            "hind girdle, from side to side",
            "°",
            [30.0, 40.0],
            degrees(stride.map(|s| s.pelvis_rad)),
            GIANT_SALAMANDER,
        ),
        row(
            "lag along the trunk on land: a standing wave",
            "°",
            [-STANDING_DEG, STANDING_DEG],
            degrees(lag(walk)),
            TIGER_SALAMANDER,
        ),
        row(
            "lag along the trunk swimming: a travelling wave",
            "°",
            [STANDING_DEG, 360.0],
            degrees(lag(swim)),
            TIGER_SALAMANDER,
        ),
    ]
}

/// Mean of the scores that there are.
pub fn score(rows: &[AnimalRow]) -> Option<f64> {
    let scores: Vec<f64> = rows.iter().filter_map(|r| r.score).collect();
    (!scores.is_empty()).then(|| scores.iter().sum::<f64>() / scores.len() as f64)
}

/// How far the last joint of the trunk lags behind the first, rad.
fn trunk_lag_rad(scenario: &ScenarioResult, anatomy: &Anatomy) -> Option<f64> {
    let wave = scenario.wave.as_ref()?;
    let body = (0..anatomy.in_leg.len()).filter(|&j| !anatomy.in_leg[j]);
    let trunk: Vec<usize> = body
        .enumerate()
        .filter(|&(_, joint)| anatomy.in_trunk[joint])
        .map(|(place, _)| place)
        .collect();
    let (first, last) = (*trunk.first()?, *trunk.last()?);
    Some(wave.lag_rad[last] - wave.lag_rad[first])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_by_hand() {
        let score = |animal, robot| row("x", "1", animal, Some(robot), "").score.unwrap();
        assert_eq!(score([0.25, 0.5], 0.5), 1.0);
        // half of the nearer end, and twice of it
        assert_eq!(score([66.0, 66.0], 33.0), 0.5);
        assert_eq!(score([30.0, 40.0], 80.0), 0.5);
        // on the other side of nothing
        assert_eq!(score([45.0, 360.0], -10.0), 0.0);
        assert_eq!(row("x", "1", [1.0, 1.0], None, "").score, None);
    }

    #[test]
    fn a_robot_that_cannot_bend_has_no_table() {
        let quadruped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../robots/quadruped.robot.toml");
        let model = caudata_model::RobotModel::load(std::path::Path::new(quadruped)).unwrap();
        assert!(animal(&[], &Anatomy::of(&std::sync::Arc::new(model))).is_empty());
    }
}
