//! From land into water and back: does it get there, and does it swim there rather than walk?

use caudata_sim::Terrain;
use serde::{Deserialize, Serialize};

use crate::Estimate;
use crate::gait::Measure;
use crate::scenario::Goal;
use crate::trace::{Frame, Trace};
use crate::wave::{Wave, WaveResult};

/// Length of the robot from nose to tail, m (its facts file).
pub const BODY_LENGTH_M: f64 = 1.105;
/// Time left out at the start of an episode before motion on land or in water is looked at, s.
const SETTLE_S: f64 = 1.0;
/// Shortest stretch on land or in water that is measured, s: two strides.
const SHORTEST_S: f64 = 1.6;
/// How far from the origin the waterline is looked for, m, and how finely.
const WATERLINE_WITHIN_M: f32 = 10.0;
const WATERLINE_STEP_M: f32 = 0.001;

/// Land at small x, water at large x, and what an episode there is for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shore {
    pub waterline_x_m: f64,
    goal: Goal,
}

/// One episode at the shore.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Passage {
    /// When it got there.
    reached_s: Option<f64>,
    on_land: Option<Motion>,
    in_water: Option<Motion>,
}

/// How it moved in a stretch.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Motion {
    speed_mps: f64,
    power_w: f64,
    /// Standard deviation of the leg joints, mean over joints.
    leg_swing_rad: f64,
    /// Share of time and feet.
    foot_contact: f64,
    wave: Option<Wave>,
}

impl Shore {
    /// Where the ground of a `shore` goes below the water's surface along x, y = 0; `None` on other terrain.
    pub fn of(terrain: &Terrain, goal: Goal) -> Option<Self> {
        let surface_m = terrain.water_level_m?;
        let steps = (WATERLINE_WITHIN_M / WATERLINE_STEP_M) as i32;
        let x = |i: i32| i as f32 * WATERLINE_STEP_M;
        let wet = |i: &i32| terrain.height_m(x(*i), 0.0) < surface_m;
        let first = (0..steps).find(wet).filter(|&i| i > 0)?;
        Some(Self { waterline_x_m: f64::from(x(first)), goal })
    }

    fn is_in_water(&self, frame: &Frame) -> bool {
        f64::from(frame.com_m[0]) >= self.waterline_x_m + BODY_LENGTH_M
    }

    fn is_on_land(&self, frame: &Frame) -> bool {
        f64::from(frame.com_m[0]) <= self.waterline_x_m - BODY_LENGTH_M / 2.0
    }

    /// Looks at one episode.
    pub fn passage(&self, trace: &Trace, measure: &Measure) -> Passage {
        let frames = &trace.frames;
        let water = frames.iter().position(|f| self.is_in_water(f));
        let land_after = |from: usize| {
            let land = frames[from..].iter().position(|f| self.is_on_land(f))?;
            Some(from + land)
        };
        let reached = match self.goal {
            Goal::IntoWater => water,
            Goal::OntoLand => land_after(0),
            Goal::Ahead => None,
            Goal::ThereAndBack => water.and_then(land_after),
        };
        let motion = |inside: &dyn Fn(&Frame) -> bool| {
            let settled = trace.after(SETTLE_S);
            Motion::of(longest_run(settled, inside), trace.period_s, measure)
        };
        Passage {
            reached_s: reached.map(|frame| (frame + 1) as f64 * trace.period_s),
            on_land: motion(&|f| self.is_on_land(f)),
            in_water: motion(&|f| self.is_in_water(f)),
        }
    }
}

/// The longest run of frames that are all `inside`.
fn longest_run<'a>(frames: &'a [Frame], inside: &dyn Fn(&Frame) -> bool) -> &'a [Frame] {
    frames
        .chunk_by(|a, b| inside(a) == inside(b))
        .filter(|run| run.first().is_some_and(inside))
        .max_by_key(|run| run.len())
        .unwrap_or_default()
}

impl Motion {
    fn of(frames: &[Frame], period_s: f64, measure: &Measure) -> Option<Self> {
        if frames.len() as f64 * period_s < SHORTEST_S {
            return None;
        }
        let mean = |value: &dyn Fn(&Frame) -> f64| {
            frames.iter().map(value).sum::<f64>() / frames.len() as f64
        };
        let legs: Vec<usize> =
            (0..measure.anatomy.in_leg.len()).filter(|&j| measure.anatomy.in_leg[j]).collect();
        let swing = |joint: usize| {
            let middle = mean(&|f| f64::from(f.joint_pos_rad[joint]));
            mean(&|f| (f64::from(f.joint_pos_rad[joint]) - middle).powi(2)).sqrt()
        };
        let joints = legs.len().max(1) as f64;
        Some(Self {
            speed_mps: mean(&|f| f64::from(f.velocity_mps[0])),
            power_w: mean(&|f| f.power_w.iter().map(|&p| f64::from(p.abs())).sum()),
            leg_swing_rad: legs.into_iter().map(swing).sum::<f64>() / joints,
            foot_contact: mean(&|f| {
                let touching = |&&n: &&f32| f64::from(n) > measure.contact_force_n;
                f.foot_force_n.iter().filter(touching).count() as f64
                    / f.foot_force_n.len().max(1) as f64
            }),
            wave: Wave::of(frames, period_s, &measure.anatomy.in_leg),
        })
    }
}

/// All episodes of a scenario at the shore. On land: the centre of mass half a body length before the
/// waterline; in water: a whole one beyond it; of each the longest stretch after the first second. Null where
/// no episode had one.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TransitionResult {
    /// Share of the episodes that got where they were to go.
    pub reached: Estimate,
    /// When those did, s.
    pub reached_s: Option<Estimate>,
    /// Speed forward in water, heading frame, m/s.
    pub swim_speed_mps: Option<Estimate>,
    /// Σ|q̇τ| in water, W.
    pub swim_power_w: Option<Estimate>,
    /// Standard deviation of the leg joints, mean over joints: on land and in water, rad.
    pub leg_swing_rad: [Option<f64>; 2],
    /// The second over the first.
    pub leg_swing_kept: Option<f64>,
    /// Share of time that a foot touches ground: on land and in water.
    pub foot_contact: [Option<f64>; 2],
    /// The wave along the body on land.
    pub wave_on_land: Option<WaveResult>,
    /// The wave along the body in water.
    pub wave_in_water: Option<WaveResult>,
}

impl TransitionResult {
    /// Sums up the passages of some episodes.
    pub(crate) fn of(passages: &[Passage]) -> Self {
        let land: Vec<Motion> = passages.iter().filter_map(|p| p.on_land).collect();
        let water: Vec<Motion> = passages.iter().filter_map(|p| p.in_water).collect();
        let estimate = |values: Vec<f64>| (!values.is_empty()).then(|| Estimate::of(&values));
        let over = |motions: &[Motion], value: fn(&Motion) -> f64| {
            estimate(motions.iter().map(value).collect())
        };
        let mean = |motions: &[Motion], value| over(motions, value).map(|e| e.mean);
        let waves = |motions: &[Motion]| {
            WaveResult::of(&motions.iter().filter_map(|m| m.wave).collect::<Vec<_>>())
        };
        let times: Vec<f64> = passages.iter().filter_map(|p| p.reached_s).collect();
        let swing: fn(&Motion) -> f64 = |m| m.leg_swing_rad;
        let contact: fn(&Motion) -> f64 = |m| m.foot_contact;
        let leg_swing_rad = [mean(&land, swing), mean(&water, swing)];
        Self {
            reached: Estimate::share(times.len(), passages.len()),
            reached_s: estimate(times),
            swim_speed_mps: over(&water, |m| m.speed_mps),
            swim_power_w: over(&water, |m| m.power_w),
            leg_swing_kept: match leg_swing_rad {
                [Some(land), Some(water)] if land > 0.0 => Some(water / land),
                _ => None,
            },
            leg_swing_rad,
            foot_contact: [mean(&land, contact), mean(&water, contact)],
            wave_on_land: waves(&land),
            wave_in_water: waves(&water),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::tests::measure;
    use caudata_sim::{TerrainConfig, TerrainKind};
    use std::f64::consts::TAU;

    fn shore(goal: Goal) -> Shore {
        let terrain = Terrain::generate(&TerrainConfig::of(TerrainKind::Shore), 1).unwrap();
        Shore::of(&terrain, goal).unwrap()
    }

    /// 20 s: out at 0.3 m/s from −0.5 m for `out_s`, then back. Legs swing 0.4 rad on land and 0.1 rad in
    /// water, feet touch on land only.
    fn trace(out_s: f64) -> Trace {
        let frame = |i: i32| {
            let t = f64::from(i) * 0.02;
            let x = -0.5 + 0.3 * (t.min(out_s) - (t - out_s).max(0.0));
            let wet = x > 0.9;
            let mut frame = Frame {
                com_m: [x as f32, 0.0, 0.4],
                velocity_mps: [0.3, 0.0],
                ..Frame::still(16, 4)
            };
            let swing = if wet { 0.1 } else { 0.4 };
            for q in &mut frame.joint_pos_rad {
                *q = (swing * (TAU * 1.25 * t).sin()) as f32;
            }
            frame.foot_force_n = [if wet { 0.0 } else { 12.0 }; 4].into();
            frame
        };
        Trace { period_s: 0.02, clock_hz: 1.25, frames: (0..1000).map(frame).collect(), fell: None }
    }

    #[test]
    fn the_waterline_of_the_shore() {
        // land 0.1 m above the water, 15° from x = 0.5 m on: 0.5 + 0.1/tan 15° = 0.873 m
        let x = shore(Goal::IntoWater).waterline_x_m;
        assert!((x - 0.873).abs() < 0.03, "{x}");
        assert_eq!(Shore::of(&Terrain::flat(), Goal::IntoWater), None);
    }

    #[test]
    fn a_passage_by_hand() {
        let shore = shore(Goal::IntoWater);
        let passage = shore.passage(&trace(20.0), &measure());
        // (waterline + 1.105 + 0.5)/0.3
        let expected = (shore.waterline_x_m + 1.105 + 0.5) / 0.3;
        assert!((passage.reached_s.unwrap() - expected).abs() < 0.041);
        let (land, water) = (passage.on_land.unwrap(), passage.in_water.unwrap());
        assert_eq!((land.foot_contact, water.foot_contact), (1.0, 0.0));
        // a sine's standard deviation is its amplitude over √2; land is left before a whole number of swings
        assert!((water.leg_swing_rad - 0.1 / 2.0_f64.sqrt()).abs() < 2e-3);
        assert!((land.leg_swing_rad - 0.4 / 2.0_f64.sqrt()).abs() < 0.03);
    }

    #[test]
    fn each_goal_is_reached_in_its_own_way() {
        let reached = |goal, out_s| shore(goal).passage(&trace(out_s), &measure()).reached_s;
        // 9 s out: to 2.2 m, into the water, and back at 0.32 m after 15.3 s
        assert!(reached(Goal::IntoWater, 9.0).is_some());
        let back = reached(Goal::ThereAndBack, 9.0).unwrap();
        assert!((15.0..15.6).contains(&back), "{back}");
        // 6 s out: to 1.3 m, never a body length into the water
        assert_eq!(reached(Goal::IntoWater, 6.0), None);
        assert_eq!(reached(Goal::ThereAndBack, 6.0), None);
        // on land from the first step
        assert_eq!(reached(Goal::OntoLand, 6.0), Some(0.02));
    }

    #[test]
    fn episodes_are_summed_up() {
        let shore = shore(Goal::IntoWater);
        let passage = |out_s| shore.passage(&trace(out_s), &measure());
        let result = TransitionResult::of(&[passage(20.0), passage(6.0)]);
        assert_eq!(result.reached.mean, 0.5);
        assert!((result.swim_speed_mps.unwrap().mean - 0.3).abs() < 1e-6);
        let kept = result.leg_swing_kept.unwrap();
        assert!((kept - 0.25).abs() < 0.03, "{kept}");
        assert!(!result.wave_in_water.unwrap().travels_to_the_tail);
        let nowhere = TransitionResult::of(&[passage(1.0)]);
        assert_eq!(nowhere.swim_speed_mps, None);
    }
}
