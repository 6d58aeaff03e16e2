//! What was measured, as one flat vector: by stretch of a run, then by channel, then by time.

use std::ops::Range;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use crate::trial::{Channel, Kind, Trial};

/// Time after the start of a stretch that does not count: what friction and loops remember from before is not known, s.
const SETTLE_S: f64 = 0.15;
/// Most samples that count; denser recordings are thinned out evenly.
const MOST_SAMPLES: usize = 400_000;
/// Blocks for statistics are at least so long, s.
pub const BLOCK_S: f64 = 1.0;
/// Stretches of a free robot, s: it diverges from its simulation, so it is put back to what was measured.
const FREE_SEGMENT_S: f64 = 0.8;
/// Time before each that is simulated and does not count, s: where play hangs, how friction is wound up and how hard each foot presses is not measured, and
/// comes about in it. At its end the robot is put to what was measured once more.
const FREE_LEAD_S: f64 = 0.3;
/// Time over which speeds at a start are taken, s, to each side.
const SPEED_WINDOW_S: f64 = 0.03;

/// How runs are cut.
#[derive(Debug, Clone, Copy)]
pub struct SegmentOptions {
    /// Length of a stretch of a held robot, s; infinite: the whole run.
    pub fixed_s: f64,
    /// Length of a stretch of a free or swimming robot, s.
    pub free_s: f64,
    /// Time before a stretch of a held robot that is simulated and does not count, s: what a joint that rests remembers of how it came there.
    pub lead_s: f64,
}

impl Default for SegmentOptions {
    fn default() -> Self {
        Self {
            fixed_s: f64::INFINITY,
            free_s: FREE_SEGMENT_S,
            lead_s: 0.0,
        }
    }
}

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
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.end_s - self.start_s
    }
}

/// What was measured when a stretch begins.
#[derive(Debug, Clone, Default)]
pub struct Start {
    /// Joint positions as shown, rad. `[A]`
    pub pos_rad: Vec<f64>,
    /// Joint velocities, rad/s. `[A]`
    pub vel_radps: Vec<f64>,
    /// Base position, world, m.
    pub base_pos_m: Option<[f64; 3]>,
    /// Roll, pitch, yaw of the base, rad.
    pub base_rpy_rad: Option<[f64; 3]>,
    /// Velocity of the base, world, m/s.
    pub base_vel_mps: Option<[f64; 3]>,
    /// Angular velocity of the base, body, rad/s.
    pub base_angvel_radps: Option<[f64; 3]>,
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
    #[must_use]
    pub fn new(model: &RobotModel, trials: Vec<Trial>, options: SegmentOptions) -> Self {
        let total: usize = trials
            .iter()
            .flat_map(|t| &t.channels)
            .map(|c| c.value.len())
            .sum();
        let stride = total.div_ceil(MOST_SAMPLES).max(1);
        let mut data = Self::default();
        for (number, trial) in trials.iter().enumerate() {
            let length_s = match trial.base {
                BaseHold::Fixed => options.fixed_s,
                _ => options.free_s,
            };
            let (first, last) = replay_span(trial);
            let count = ((last - first) / length_s).floor().max(1.0);
            let each = (last - first) / count;
            for k in 0..count as usize {
                let cut = |k: f64| first + k * each;
                let (from_s, end_s, lead_s) = match trial.base {
                    BaseHold::Fixed => {
                        let from_s = cut(k as f64);
                        (
                            from_s,
                            cut(k as f64 + 1.0),
                            options.lead_s.min(from_s - first),
                        )
                    }
                    // at a stamp: between two of them a step of the simulation would straddle a command
                    _ => (
                        stamp_near(trial, cut(k as f64)),
                        stamp_near(trial, cut(k as f64 + 1.0)).min(last),
                        FREE_LEAD_S,
                    ),
                };
                let span_s = (from_s - lead_s, from_s, end_s);
                data.push(model, number, trial, span_s, stride);
            }
        }
        data.trials = trials;
        data
    }

    fn push(
        &mut self,
        model: &RobotModel,
        number: usize,
        trial: &Trial,
        (start_s, from_s, end_s): (f64, f64, f64),
        stride: usize,
    ) {
        let begin = self.value.len();
        let first_block = self.blocks;
        let blocks = ((end_s - from_s) / BLOCK_S).floor().max(1.0);
        let block_s = (end_s - from_s) / blocks;
        let free = trial.base != BaseHold::Fixed;
        let settle_s = if free { 0.04 } else { SETTLE_S };
        let counts_s = if free {
            from_s + settle_s
        } else {
            from_s.max(start_s + settle_s)
        };
        let mut pieces = Vec::new();
        for (index, channel) in trial.channels.iter().enumerate() {
            let from = self.value.len();
            let low = channel.time_s.partition_point(|&t| t < counts_s);
            let high = channel.time_s.partition_point(|&t| t < end_s);
            for k in (low..high).step_by(stride) {
                let t = channel.time_s[k];
                if trial.masked_s.iter().any(|(a, b)| (*a..=*b).contains(&t)) {
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
            start: start(model, trial, start_s.max(replay_span(trial).0)),
            again: free.then(|| (from_s, start(model, trial, from_s))),
        });
    }

    /// The same runs with these stretches alone, in this order.
    #[must_use]
    pub fn only(&self, keep: &[usize]) -> Self {
        let mut out = Self {
            trials: self.trials.clone(),
            ..Self::default()
        };
        for &s in keep {
            let segment = &self.segments[s];
            let (from, to) = (segment.range.start, out.value.len());
            let moved = |r: &Range<usize>| r.start - from + to..r.end - from + to;
            let blocks = &self.block[segment.range.clone()];
            let first = blocks.iter().min().copied().unwrap_or(0);
            let last = blocks.iter().max().copied().unwrap_or(0);
            out.block
                .extend(blocks.iter().map(|b| b - first + out.blocks as u32));
            out.blocks += (last - first) as usize + 1;
            out.time_s
                .extend_from_slice(&self.time_s[segment.range.clone()]);
            out.value
                .extend_from_slice(&self.value[segment.range.clone()]);
            let pieces = segment.pieces.iter().map(|p| Piece {
                range: moved(&p.range),
                ..p.clone()
            });
            out.segments.push(Segment {
                range: moved(&segment.range),
                pieces: pieces.collect(),
                ..segment.clone()
            });
        }
        out
    }

    /// Simulated time of one candidate, s.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.segments.iter().map(Segment::duration_s).sum()
    }

    /// Number of samples.
    #[must_use]
    pub fn len(&self) -> usize {
        self.value.len()
    }

    /// Whether there is nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.value.is_empty()
    }

    /// 0: held, 1: on the ground, 2: in water.
    #[must_use]
    pub fn hold(&self, segment: usize) -> usize {
        match self.trials[self.segments[segment].trial].base {
            BaseHold::Fixed => 0,
            BaseHold::Free => 1,
            BaseHold::Water => 2,
        }
    }
}

/// From when every joint's position and a command are known.
fn replay_span(trial: &Trial) -> (f64, f64) {
    let (mut first, mut last) = trial.span_s;
    for c in trial.channels.iter().filter(|c| c.kind == Kind::Position) {
        first = first.max(c.time_s[0]);
        last = last.min(c.time_s[c.time_s.len() - 1] + 1e-6);
    }
    (first, last.max(first + 1e-3))
}

/// Roll and pitch of a body in which gravity points along (`gx`, `gy`, ·), rad: gravity in the body is (sin p, −cos p·sin r, −cos p·cos r).
pub(super) fn roll_pitch(gx: f64, gy: f64) -> [f64; 2] {
    let pitch = gx.clamp(-1.0, 1.0).asin();
    let roll = (-gy / pitch.cos().max(1e-3)).clamp(-1.0, 1.0).asin();
    [roll, pitch]
}

/// The stamp of a position that is nearest to `t_s`.
fn stamp_near(trial: &Trial, t_s: f64) -> f64 {
    let Some(c) = trial.channels.iter().find(|c| c.kind == Kind::Position) else {
        return t_s;
    };
    let after = c.time_s.partition_point(|&t| t < t_s);
    let near = [after.saturating_sub(1), after]
        .into_iter()
        .filter_map(|k| c.time_s.get(k).copied())
        .min_by(|a, b| (a - t_s).abs().total_cmp(&(b - t_s).abs()));
    near.unwrap_or(t_s)
}

fn start(model: &RobotModel, trial: &Trial, t_s: f64) -> Start {
    let joints = model.actuated().len();
    let mut start = Start {
        pos_rad: model.nominal_pos_rad().to_vec(),
        vel_radps: vec![0.0; joints],
        ..Start::default()
    };
    for a in 0..joints {
        if let Some(c) = trial.channel(Kind::Position, a) {
            let (pos, slope) = line(c, t_s);
            start.pos_rad[a] = pos;
            start.vel_radps[a] = slope;
        }
        if let Some(c) = trial.channel(Kind::Velocity, a) {
            let near = c
                .time_s
                .partition_point(|&t| t < t_s)
                .min(c.value.len() - 1);
            // a reported speed is less noisy than a difference of counts, and later: take the smaller
            let reported = c.value[near];
            let slope = start.vel_radps[a];
            start.vel_radps[a] = if reported * slope <= 0.0 {
                0.0
            } else if reported.abs() < slope.abs() {
                reported
            } else {
                slope
            };
        }
    }
    let three = |kind: Kind| -> Option<[(f64, f64); 3]> {
        let mut out = [(0.0, 0.0); 3];
        for (axis, out) in out.iter_mut().enumerate() {
            *out = line(trial.channel(kind, axis)?, t_s);
        }
        Some(out)
    };
    if let Some(p) = three(Kind::BasePosition) {
        start.base_pos_m = Some(p.map(|x| x.0));
        start.base_vel_mps = Some(p.map(|x| x.1));
    }
    if let Some(v) = three(Kind::BaseVelocity) {
        start.base_vel_mps = Some(v.map(|x| x.0));
    }
    let attitude = three(Kind::BaseAttitude);
    let gravity = three(Kind::Gravity);
    let down = match (attitude, gravity) {
        (Some(a), _) => Some((a[0].0, a[1].0, a[2].0)),
        (None, Some(g)) => Some((g[0].0, g[1].0, 0.0)),
        _ => None,
    };
    if let Some((gx, gy, yaw)) = down {
        let [roll, pitch] = roll_pitch(gx, gy);
        start.base_rpy_rad = Some([roll, pitch, yaw]);
    }
    if let Some(w) = three(Kind::Gyro) {
        start.base_angvel_radps = Some(w.map(|x| x.0));
    }
    start
}

/// Value and slope of a channel at `t_s` by a straight line through its samples nearby.
fn line(c: &Channel, t_s: f64) -> (f64, f64) {
    let low = c.time_s.partition_point(|&t| t < t_s - SPEED_WINDOW_S);
    let high = c.time_s.partition_point(|&t| t <= t_s + SPEED_WINDOW_S);
    let n = (high - low) as f64;
    if n < 1.0 {
        let k = c
            .time_s
            .partition_point(|&t| t < t_s)
            .min(c.value.len() - 1);
        return (c.value[k], 0.0);
    }
    let (t, y) = (&c.time_s[low..high], &c.value[low..high]);
    let mean_t = t.iter().sum::<f64>() / n;
    let mean_y = y.iter().sum::<f64>() / n;
    let (mut sxx, mut sxy) = (0.0, 0.0);
    for (t, y) in t.iter().zip(y) {
        sxx += (t - mean_t).powi(2);
        sxy += (t - mean_t) * (y - mean_y);
    }
    let slope = if sxx > 1e-9 { sxy / sxx } else { 0.0 };
    (mean_y + slope * (t_s - mean_t), slope)
}

#[cfg(test)]
mod tests {
    use super::*;

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
