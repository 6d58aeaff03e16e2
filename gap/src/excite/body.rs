//! Motions of the whole robot: walking, swimming, rocking, and joints working against each other.

use std::f64::consts::{PI, TAU};

use caudata_model::RobotModel;

use super::legs::{Leg, carried};
use super::limits::JointLimits;
use super::wave::Wave;

/// Swing of the hips in a walk, rad. Feet that stand pass it on to the trunk, which works harder for it than
/// the hips do: at 0.3 rad a spine joint of the salamander is at 48 % of its torque.
const HIP_SWING_RAD: f64 = 0.25;
/// How far the joint that lifts a foot does, rad.
const LIFT_RAD: f64 = 0.35;
/// Share that strides of one side are shorter by where the trunk would be bent by a radian: 40 % at the 0.12 rad of
/// the turning trial.
const SHORTER_PER_RAD: f64 = 3.3;

/// Commands of all joints being written.
pub(super) struct Body<'a> {
    pub limits: &'a [JointLimits],
    rate_hz: f64,
    legs: Vec<Leg>,
    /// Joints that belong to no leg, head to tail.
    spine: Vec<usize>,
    /// Whether one of them turns some legs against others.
    bends: bool,
    nominal: Vec<f64>,
    /// One row per period. `[T][A]`
    pub rows: Vec<Vec<f64>>,
}

impl<'a> Body<'a> {
    pub fn new(robot: &RobotModel, limits: &'a [JointLimits], rate_hz: f64) -> Self {
        let carries = carried(robot);
        let beyond = |a: usize| carries.iter().filter(|c| c.contains(&a)).count();
        let legs = Leg::all(robot);
        let spine =
            (0..limits.len()).filter(|a| !legs.iter().any(|l| l.joints.contains(a))).collect();
        let bends = (0..limits.len()).any(|a| (2..carries.len()).contains(&beyond(a)));
        let nominal = robot.nominal_pos_rad().to_vec();
        Self { limits, rate_hz, legs, spine, bends, rows: vec![nominal.clone()], nominal }
    }

    fn put(&mut self, mut row: Vec<f64>) {
        for (q, l) in row.iter_mut().zip(self.limits) {
            *q = q.clamp(l.range_rad.0, l.range_rad.1);
        }
        self.rows.push(row);
    }

    /// How far joint `a` may swing, at most `size_rad` (of a slide, so many of what counts as a radian).
    fn sine(&self, a: usize, size_rad: f64, hz: f64) -> f64 {
        self.limits[a].sine_rad(size_rad * self.limits[a].per_radian, hz)
    }

    fn count(&self, s: f64) -> usize {
        (s * self.rate_hz).round().max(1.0) as usize
    }

    /// Writes `s` seconds of `pose(t, fade)`; `fade` goes from 0 to 1 and back over the first and last second
    /// (a third of a short one).
    fn play(&mut self, s: f64, pose: impl Fn(&Self, f64, f64, &mut Vec<f64>)) {
        let n = self.count(s);
        let ramp_s = 1.0f64.min(s / 3.0);
        for k in 1..=n {
            let t = k as f64 / self.rate_hz;
            let edge = (t / ramp_s).min((s - t) / ramp_s).clamp(0.0, 1.0);
            let fade = 0.5 * (1.0 - (PI * edge).cos());
            let mut row = self.nominal.clone();
            pose(self, t, fade, &mut row);
            self.put(row);
        }
    }

    /// Nominal pose.
    pub fn hold(&mut self, s: f64) {
        self.play(s, |_, _, _, _| {});
    }

    /// Every joint by a wave of its own.
    fn each(&mut self, write: impl Fn(&mut Wave<'_>, usize)) {
        let columns: Vec<Vec<f64>> = self
            .limits
            .iter()
            .enumerate()
            .map(|(a, l)| {
                let mut wave = Wave::new(l, self.rate_hz, if a % 2 == 0 { 1.0 } else { -1.0 }, 1.0);
                write(&mut wave, a);
                wave.finish().0
            })
            .collect();
        let n = columns.iter().map(Vec::len).max().unwrap_or(0);
        for k in 0..n {
            let row =
                columns.iter().map(|c| c.get(k).or(c.last()).copied().unwrap_or(0.0)).collect();
            self.put(row);
        }
    }

    pub fn all_chirp(&mut self) {
        self.each(|w, _| {
            let c = w.limits.nominal_rad;
            w.chirp(c, 0.08, 0.5, 5.0, 12.0);
        });
    }

    pub fn all_steps(&mut self) {
        self.each(|w, _| {
            let c = w.limits.nominal_rad;
            let size = w.reach(c, 0.35);
            w.hold(0.5);
            for x in [1.0, 0.0, -1.0, 0.0, 1.0, -1.0, 0.0] {
                w.step(c + w.sign * size * x, 1.0);
            }
        });
    }

    /// The first joint steps all the time; the others chirp in the middle third.
    pub fn load_probe(&mut self) {
        self.each(|w, a| {
            let c = w.limits.nominal_rad;
            if a == 0 {
                for _ in 0..12 {
                    w.step(c + 0.3 * w.limits.per_radian, 0.5);
                    w.step(c, 0.5);
                }
            } else {
                w.hold(4.0);
                w.sine(c, 0.4, 2.0, 4.0);
                w.hold(4.0);
            }
        });
    }

    /// Legs of one side (or one end) stretch while the others give way: the trunk rolls (or pitches).
    pub fn rock(&mut self, roll: bool) {
        for hz in [0.3, 0.8, 1.6] {
            self.play(6.0, |b, t, fade, row| {
                for leg in &b.legs {
                    let up = if if roll { leg.left } else { leg.front } { 1.0 } else { -1.0 };
                    let knee = leg.lift.joint;
                    let stretch = -leg.lift.sign * b.sine(knee, 0.3, hz);
                    row[knee] += fade * up * stretch * (TAU * hz * t).sin();
                }
            });
        }
    }

    /// Each knee lifts its foot for a second and a half, slowly up, slowly down.
    pub fn lift_feet(&mut self) {
        for i in 0..self.legs.len() {
            self.play(3.0, |b, _, fade, row| {
                let lift = b.legs[i].lift;
                row[lift.joint] += lift.sign * 0.7 * b.limits[lift.joint].per_radian * fade;
            });
            self.hold(0.5);
        }
    }

    /// A trot: diagonal legs together, hips swing, knees lift in the swing, the spine bends with them.
    /// `height`: 1 nominal, less is lower.
    pub fn gait(&mut self, hz: f64, height: f64, bend_rad: f64, s: f64) {
        // what has no trunk to bend turns by shorter strides on one side
        let shorter = if self.bends { 0.0 } else { SHORTER_PER_RAD * bend_rad };
        self.play(s, |b, t, fade, row| {
            let phase = TAU * hz * t;
            for leg in &b.legs {
                let phase = if leg.with_first { phase } else { phase + PI };
                let (hip, knee) = (leg.swing.joint, leg.lift.joint);
                let stride = if leg.left { 1.0 - shorter } else { 1.0 };
                let swing = stride * b.sine(hip, HIP_SWING_RAD, hz) * phase.sin();
                row[hip] += fade * leg.swing.sign * swing;
                let least = LIFT_RAD * b.limits[knee].per_radian;
                let low = (1.0 - height) * row[knee].abs().max(least);
                let lift = low + least * phase.cos().max(0.0);
                row[knee] += fade * leg.lift.sign * lift;
            }
            for &a in b.trunk() {
                let bend = bend_rad * b.limits[a].per_radian;
                row[a] += fade * (bend + b.sine(a, 0.1, hz) * phase.cos());
            }
        });
    }

    /// Spine joints between the legs: the first half or so; the tail trails.
    fn trunk(&self) -> &[usize] {
        &self.spine[..self.spine.len().div_ceil(2)]
    }

    /// A travelling wave from head to tail, one wave on the body, growing towards the tail; legs folded back.
    pub fn swim(&mut self, hz: f64, size_rad: f64, s: f64) {
        self.play(s, |b, t, fade, row| {
            let n = b.spine.len().max(1) as f64;
            for (i, &a) in b.spine.iter().enumerate() {
                let x = i as f64 / n;
                let size = b.sine(a, size_rad * (0.4 + 0.6 * x), hz);
                row[a] += fade * size * (TAU * (hz * t - x)).sin();
            }
            for leg in &b.legs {
                let (hip, range) = (leg.swing.joint, b.limits[leg.swing.joint].range_rad);
                let back = if leg.swing.sign > 0.0 { range.0 } else { range.1 };
                row[hip] += fade * (back - row[hip]) * 0.9;
            }
        });
    }

    pub fn bob(&mut self) {
        for _ in 0..4 {
            self.play(1.0, |b, _, fade, row| {
                for leg in &b.legs {
                    let lift = leg.lift;
                    row[lift.joint] += lift.sign * 0.6 * b.limits[lift.joint].per_radian * fade;
                }
            });
            self.hold(3.0);
        }
    }

    pub fn has_legs(&self) -> bool {
        !self.legs.is_empty()
    }
}
