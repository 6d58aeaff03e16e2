//! What was measured, as one flat vector: by stretch of a run, then by channel, then by time.

use std::ops::Range;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use super::cuts::{Cut, SegmentOptions, Servos, free_cuts, held_cuts, replay_span};
use super::starts::{Start, start, swinging};
use crate::trial::{Kind, Trial};

/// Time after the start of a stretch that does not count: what friction and loops remember from before is not
/// known, s.
const SETTLE_S: f64 = 0.15;
/// Most samples that count; denser recordings are thinned out evenly.
const MOST_SAMPLES: usize = 400_000;
/// Blocks for statistics are at least so long, s.
pub const BLOCK_S: f64 = 1.0;

/// A stretch of a run that one lane replays.
#[derive(Debug, Clone)]
pub struct Segment {
    /// Which trial.
    pub trial: usize,
    /// s.
    pub start_s: f64,
    /// s.
    pub end_s: f64,
    /// Its samples in the flat vector.
    pub range: Range<usize>,
    /// Its channels' samples.
    pub pieces: Vec<Piece>,
    /// Measured start.
    pub start: Start,
    /// When what can be measured is put to what was measured once more, s, and that.
    pub again: Option<(f64, Start)>,
}

impl Segment {
    /// s.
    pub fn duration_s(&self) -> f64 {
        self.end_s - self.start_s
    }
}

/// One channel's samples in one stretch.
#[derive(Debug, Clone)]
pub struct Piece {
    /// What it is.
    pub kind: Kind,
    /// As in [`Channel::index`].
    pub index: usize,
    /// Channel of the trial.
    pub channel: usize,
    /// Places in the flat vector.
    pub range: Range<usize>,
}

/// Trials and their samples.
#[derive(Debug, Clone, Default)]
pub struct Data {
    /// In order of recording.
    pub trials: Vec<Trial>,
    /// In order.
    pub segments: Vec<Segment>,
    /// Stamps, s. `[N]`
    pub time_s: Vec<f64>,
    /// Measured values. `[N]`
    pub value: Vec<f64>,
    /// Block of each sample; blocks never reach over two stretches. `[N]`
    pub block: Vec<u32>,
    /// Number of blocks.
    pub blocks: usize,
}

impl Data {
    /// Cuts `trials` into stretches and samples.
    pub fn new(model: &RobotModel, trials: Vec<Trial>, options: SegmentOptions) -> Self {
        let total: usize = trials.iter().flat_map(|t| &t.channels).map(|c| c.value.len()).sum();
        let stride = total.div_ceil(MOST_SAMPLES).max(1);
        let mut data = Self::default();
        for (number, trial) in trials.iter().enumerate() {
            let cuts = match trial.base {
                BaseHold::Fixed => held_cuts(trial, options),
                BaseHold::Free => free_cuts(trial, options.free_s),
                BaseHold::Water => free_cuts(trial, options.swimming_s),
            };
            for cut in cuts {
                data.push(model, number, trial, cut, stride);
            }
        }
        data.trials = trials;
        data
    }

    fn push(&mut self, model: &RobotModel, number: usize, trial: &Trial, cut: Cut, stride: usize) {
        let Cut { start_s, from_s, end_s, .. } = cut;
        let begin = self.value.len();
        let first_block = self.blocks;
        let blocks = ((end_s - from_s) / BLOCK_S).floor().max(1.0);
        let block_s = (end_s - from_s) / blocks;
        let free = trial.base != BaseHold::Fixed;
        let settle_s = if free { 0.04 } else { SETTLE_S };
        let counts_s = if free { from_s + settle_s } else { from_s.max(start_s + settle_s) };
        let mut pieces = Vec::new();
        for (index, channel) in trial.channels.iter().enumerate() {
            let from = self.value.len();
            let low = channel.time_s.partition_point(|&t| t < counts_s);
            let high = channel.time_s.partition_point(|&t| t < end_s);
            for k in (low..high).step_by(stride) {
                let t = channel.time_s[k];
                if trial.is_left_out(t) {
                    continue;
                }
                self.time_s.push(t);
                self.value.push(channel.value[k]);
                let block = ((t - from_s) / block_s).floor().clamp(0.0, blocks - 1.0);
                self.block.push((first_block + block as usize) as u32);
            }
            if self.value.len() > from {
                pieces.push(Piece {
                    kind: channel.kind,
                    index: channel.index,
                    channel: index,
                    range: from..self.value.len(),
                });
            }
        }
        self.blocks += blocks as usize;
        self.segments.push(Segment {
            trial: number,
            start_s,
            end_s,
            range: begin..self.value.len(),
            pieces,
            // a robot that is recorded from its first row on stood there before
            start: match cut.servos {
                Servos::Hold => start(model, trial, start_s.max(replay_span(trial).0)),
                Servos::Switched { .. } | Servos::WereLoose => {
                    swinging(model, trial, start_s, cut.servos)
                }
            },
            again: free.then(|| (from_s, start(model, trial, from_s))),
        });
    }

    /// The same runs with these stretches alone, in this order.
    pub fn only(&self, keep: &[usize]) -> Self {
        let mut out = Self { trials: self.trials.clone(), ..Self::default() };
        for &s in keep {
            let segment = &self.segments[s];
            let (from, to) = (segment.range.start, out.value.len());
            let moved = |r: &Range<usize>| r.start - from + to..r.end - from + to;
            let blocks = &self.block[segment.range.clone()];
            let first = blocks.iter().min().copied().unwrap_or(0);
            let last = blocks.iter().max().copied().unwrap_or(0);
            out.block.extend(blocks.iter().map(|b| b - first + out.blocks as u32));
            out.blocks += (last - first) as usize + 1;
            out.time_s.extend_from_slice(&self.time_s[segment.range.clone()]);
            out.value.extend_from_slice(&self.value[segment.range.clone()]);
            let pieces =
                segment.pieces.iter().map(|p| Piece { range: moved(&p.range), ..p.clone() });
            out.segments.push(Segment {
                range: moved(&segment.range),
                pieces: pieces.collect(),
                ..segment.clone()
            });
        }
        out
    }

    /// All channels' samples, stretch by stretch.
    pub fn pieces(&self) -> impl Iterator<Item = &Piece> {
        self.segments.iter().flat_map(|s| &s.pieces)
    }

    /// The same with the stretch that each belongs to.
    pub fn parts(&self) -> impl Iterator<Item = (&Segment, &Piece)> {
        self.segments.iter().flat_map(|s| s.pieces.iter().map(move |p| (s, p)))
    }

    /// Simulated time of one candidate, s.
    pub fn duration_s(&self) -> f64 {
        self.segments.iter().map(Segment::duration_s).sum()
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.value.len()
    }

    /// Whether there is nothing.
    pub fn is_empty(&self) -> bool {
        self.value.is_empty()
    }

    /// 0: held, 1: on the ground, 2: in water.
    pub fn hold(&self, segment: usize) -> usize {
        match self.trials[self.segments[segment].trial].base {
            BaseHold::Fixed => 0,
            BaseHold::Free => 1,
            BaseHold::Water => 2,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::starts::{ImuPlace, line, roll_pitch};
    use super::*;
    use crate::trial::{Channel, Steps};

    #[test]
    fn what_was_covered_is_bridged() {
        // 3 rad/s, nothing from 1.0 to 1.15 s
        let time_s = vec![0.99, 1.0, 1.15, 1.16];
        let c = Channel {
            kind: Kind::BasePosition,
            index: 0,
            name: "x".into(),
            value: time_s.iter().map(|t| 3.0 * t).collect(),
            time_s,
        };
        let near = |(value, slope): (f64, f64), want: (f64, f64)| {
            assert!((value - want.0).abs() < 1e-9 && (slope - want.1).abs() < 1e-6);
        };
        near(line(&c, 1.08), (3.24, 3.0));
        // beyond both ends there is nothing to go by
        near(line(&c, 2.0), (3.48, 0.0));
        near(line(&c, 0.5), (2.97, 0.0));
    }

    #[test]
    fn a_still_base_with_a_turning_neck_is_still() {
        let model = salamander();
        let neck = model.actuated_names().iter().position(|n| *n == "spine_1");
        let mut run = run_of(Steps::default());
        run.base = BaseHold::Water;
        let like = run.channels[0].clone();
        let channel = |kind, index, value: f64| Channel {
            kind,
            index,
            value: vec![value; like.time_s.len()],
            ..like.clone()
        };
        let neck = neck.unwrap();
        run.channels = vec![channel(Kind::Velocity, neck, 0.8)];
        let ramp = like.time_s.iter().map(|t| 0.3 + 0.8 * (t - 5.0));
        run.channels.push(Channel { value: ramp.collect(), ..channel(Kind::Position, neck, 0.0) });
        // the joint turns the IMU's link by 0.8 rad/s about the base's z, one way or the other
        let mut turning = Start {
            pos_rad: vec![0.0; model.actuated().len()],
            vel_radps: vec![0.0; model.actuated().len()],
            ..Start::default()
        };
        turning.vel_radps[neck] = 0.8;
        let way = ImuPlace::of(&model, &turning).unwrap().angvel_radps[2].signum();
        for (axis, rate) in [0.0, 0.0, 0.8 * way].into_iter().enumerate() {
            run.channels.push(channel(Kind::Gyro, axis, rate));
        }
        let w = start(&model, &run, 5.0).base_angvel_radps.unwrap();
        assert!(w.iter().all(|x| x.abs() < 1e-6), "{w:?}");
    }

    fn salamander() -> RobotModel {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../robots/polymander.robot.toml");
        RobotModel::load(&file).unwrap()
    }

    fn run_of(enabled: Steps) -> Trial {
        // 0 to 10 s at 100 Hz, at 0.5 rad until 4 s, then at 3 rad/s
        let time_s: Vec<f64> = (0..=1000).map(|k| f64::from(k) * 0.01).collect();
        let value = time_s.iter().map(|t| 0.5 + 3.0 * (t - 4.0).max(0.0));
        let value: Vec<f64> = value.collect();
        let position = Channel { kind: Kind::Position, index: 0, name: "a".into(), time_s, value };
        Trial { enabled: vec![Some(enabled)], ..Trial::bare(BaseHold::Fixed, 10.0, vec![position]) }
    }

    #[test]
    fn roll_and_pitch_by_gravity_all_the_way_round() {
        let near = |got: [f64; 2], want: [f64; 2]| {
            for (g, w) in got.iter().zip(want) {
                assert!((g - w).abs() < 1e-9, "{got:?} {want:?}");
            }
        };
        // gravity in the body is (sin p, −cos p·sin r, −cos p·cos r)
        for (roll, pitch) in [(0.3_f64, -0.2_f64), (1.5, 0.1), (1.7, 0.1), (3.0, 0.4)] {
            let [x, y, z] = [pitch.sin(), -pitch.cos() * roll.sin(), -pitch.cos() * roll.cos()];
            near(roll_pitch(x, y, z), [roll, pitch]);
        }
    }

    #[test]
    fn a_gyroscope_beyond_a_joint_turns_with_it() {
        let model = salamander();
        let joints = model.actuated().len();
        // the salamander's IMU sits behind the first joint of its spine, which turns about z, and ahead of
        // the second
        let names = model.actuated_names();
        let at = |name: &str| names.iter().position(|n| *n == name).unwrap();
        let mut start =
            Start { pos_rad: vec![0.0; joints], vel_radps: vec![0.0; joints], ..Start::default() };
        start.pos_rad[at("spine_1")] = 0.5;
        start.vel_radps[at("spine_1")] = 2.0;
        start.vel_radps[at("spine_2")] = 3.0;
        let imu = ImuPlace::of(&model, &start).unwrap();
        let axis_z = imu.angvel_radps[2] / 2.0;
        assert!((axis_z.abs() - 1.0).abs() < 1e-9, "{:?}", imu.angvel_radps);
        // what points ahead there points to the side in the base
        let ahead = imu.base_from_imu.rotate([1.0, 0.0, 0.0]);
        let want = [0.5_f64.cos(), axis_z * 0.5_f64.sin(), 0.0];
        for (a, w) in ahead.iter().zip(want) {
            assert!((a - w).abs() < 1e-9, "{ahead:?} {want:?}");
        }
    }

    #[test]
    fn what_is_let_go_is_cut_into_short_stretches() {
        // off for 0.5 s, which is too short to be one, and from 4 to 6.4 s: two stretches of 1.2 s where 1 s
        // is asked for
        let run = run_of(Steps {
            time_s: vec![0.0, 1.0, 1.5, 4.0, 6.4],
            value: vec![1.0, 0.0, 1.0, 0.0, 1.0],
            ..Steps::default()
        });
        let options = SegmentOptions { loose_s: 1.0, ..SegmentOptions::default() };
        let cuts = |run, options| -> Vec<(f64, f64, Servos)> {
            let round = |x: f64| (x * 1e3).round() / 1e3;
            (held_cuts(run, options).into_iter())
                .map(|c| (round(c.from_s), round(c.end_s), c.servos))
                .collect()
        };
        let switched = |at_s| Servos::Switched { at_s };
        assert_eq!(
            cuts(&run, options),
            [
                (0.0, 4.0, Servos::Hold),
                (4.0, 5.2, switched(4.0)),
                (5.2, 6.4, switched(4.0)),
                // caught in its swing
                (6.4, 10.0, switched(6.4))
            ]
        );
        let whole = SegmentOptions { loose_s: f64::INFINITY, ..options };
        assert_eq!(cuts(&run, whole), [(0.0, 10.0, Servos::Hold)]);
        let loose =
            run_of(Steps { time_s: vec![0.0, 1.0], value: vec![0.0, 1.0], ..Steps::default() });
        assert_eq!(
            cuts(&loose, options),
            [(0.0, 1.0, Servos::WereLoose), (1.0, 10.0, switched(1.0))]
        );
    }

    #[test]
    fn a_swing_begins_with_the_speed_of_its_positions() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        let model = RobotModel::load(path.as_ref()).unwrap();
        let run = run_of(Steps::default());
        // at the very moment of letting go nothing moves yet, though the line through both sides has a slope
        let dropped = Servos::Switched { at_s: 4.0 };
        let begin = swinging(&model, &run, 4.0, dropped);
        assert!(begin.vel_radps[0].abs() < 1e-9, "{begin:?}");
        let later = swinging(&model, &run, 5.0, dropped);
        assert!((later.vel_radps[0] - 3.0).abs() < 1e-9, "{later:?}");
        assert!((later.pos_rad[0] - 3.5).abs() < 1e-9, "{later:?}");
        // let go before the run began, so that it swings already at its first row
        let mut early = run_of(Steps::default());
        early.channels[0].value = early.channels[0].time_s.iter().map(|t| 2.0 * t).collect();
        let first = swinging(&model, &early, 0.0, Servos::WereLoose);
        assert!((first.vel_radps[0] - 2.0).abs() < 1e-9, "{first:?}");
    }

    #[test]
    fn a_part_has_its_own_samples_and_blocks() {
        // two stretches of two channels, two samples each; blocks 0 and 1, and 2
        let piece = |channel: usize, from: usize| Piece {
            kind: Kind::Position,
            index: channel,
            channel,
            range: from..from + 2,
        };
        let segment = |k: usize| Segment {
            trial: k,
            start_s: 0.0,
            end_s: 2.0,
            range: 4 * k..4 * k + 4,
            pieces: vec![piece(0, 4 * k), piece(1, 4 * k + 2)],
            start: Start::default(),
            again: None,
        };
        let whole = Data {
            trials: Vec::new(),
            segments: vec![segment(0), segment(1)],
            time_s: (0..8).map(f64::from).collect(),
            value: (10..18).map(f64::from).collect(),
            block: vec![0, 1, 0, 1, 2, 2, 2, 2],
            blocks: 3,
        };
        let part = whole.only(&[1]);
        assert_eq!(part.value, [14.0, 15.0, 16.0, 17.0]);
        assert_eq!(part.time_s, [4.0, 5.0, 6.0, 7.0]);
        assert_eq!((part.block.as_slice(), part.blocks), (&[0, 0, 0, 0][..], 1));
        assert_eq!(part.segments[0].range, 0..4);
        assert_eq!(part.segments[0].pieces[1].range, 2..4);
        assert_eq!(part.segments[0].trial, 1);
        let all = whole.only(&[0, 1]);
        assert_eq!((all.value, all.block), (whole.value, whole.block));
        assert_eq!(all.blocks, 3);
        assert_eq!(part.duration_s(), 2.0);
    }
}
