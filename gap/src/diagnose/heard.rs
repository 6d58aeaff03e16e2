//! Which command each servo acts on, told by current, angle and speed together, and how often a run is behind
//! its repeats by it.

use caudata_runlog::BaseHold;

use crate::replay::Replayer;
use crate::trial::{Kind, Steps, Trial};

/// Frames that ask for less are too small to be missed, rad …
const LEAST_STEP_RAD: f64 = 0.008;
/// … and those that ask for less than so many times what repeats differ by where next to nothing is asked
/// for.
const TIMES_NOISE: f64 = 8.0;
/// Share of the samples, those with the smallest frames, by which noise is told.
const QUIET_SHARE: f64 = 0.25;
/// A run is behind from this share of the last frame on, …
const BEHIND_FRAMES: f64 = 0.5;
/// … it was not before below this one, …
const ABREAST: f64 = 0.3;
/// … and it fell behind at one stroke if it is this far behind at once: what two runs drift apart by goes
/// past the first one slowly.
const ONE_STROKE: f64 = 0.75;
/// Rows by which what is measured may come after its command.
const MOST_ROWS: usize = 4;
/// Samples of two runs that are compared lie no farther apart than this share of a frame.
const NEAR: f64 = 0.45;
/// Share of samples that are behind where frames are lost; a lab that loses one frame in a thousand has 0.001
/// to 0.003, play up to 0.014.
const LEAST_BEHIND: f64 = 0.015;
/// A run must fall behind so often: fewer times tell a rate to no better than a third.
const LEAST_TIMES: usize = 12;
/// Where frames are lost, a run falls behind at one stroke in at least this share of the times: on bench rigs
/// 0.58 to 0.76 of them, 0.5 where gears have play, 0.1
/// where all commands are late by nearly a row, so that jitter of stamps decides which one is heard.
const LEAST_AT_ONE_STROKE: f64 = 0.4;
/// A run with losses is behind the others in this share of the samples at which it parts from them: 0.64 (a
/// third of all frames lost) to 0.95 on bench rigs, and 0.2 to 0.57
/// of those without losses (203 cases of seeds 101 to 113) …
const LEAST_BEHIND_MOST: f64 = 0.6;
/// … and more often than ahead by so many standard deviations of chance.
const BEYOND_CHANCE: f64 = 3.0;

/// How often a run was behind its repeats.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Tally {
    /// Samples of all runs after a frame that is large enough.
    pub samples: usize,
    /// Those of them that are behind.
    pub behind: usize,
    /// How often a run fell behind.
    pub times: usize,
    /// How often at one stroke.
    pub at_one_stroke: usize,
    /// Samples of one run of at least three that are behind the middle of them.
    pub behind_most: usize,
    /// Samples of one run of at least three that are as far ahead of the middle of them.
    pub ahead_of_most: usize,
}

impl Tally {
    pub(super) fn add(&mut self, other: Self) {
        self.samples += other.samples;
        self.behind += other.behind;
        self.times += other.times;
        self.at_one_stroke += other.at_one_stroke;
        self.behind_most += other.behind_most;
        self.ahead_of_most += other.ahead_of_most;
    }

    pub(super) fn share_behind(&self) -> f64 {
        self.behind as f64 / self.samples.max(1) as f64
    }

    /// Samples for which a run stays behind, on average.
    pub(super) fn length(&self) -> f64 {
        self.behind as f64 / self.times.max(1) as f64
    }

    /// Whether a run that parts from its repeats is behind them and not as often ahead: what friction, play
    /// and supply make of repeats has no direction.
    fn lags(&self) -> bool {
        let (behind, ahead) = (self.behind_most as f64, self.ahead_of_most as f64);
        // samples of one burst are one
        let by_chance = ((behind + ahead) * self.length()).sqrt();
        behind > LEAST_BEHIND_MOST * (behind + ahead) && behind - ahead > BEYOND_CHANCE * by_chance
    }

    /// Whether none are: a share of [`LEAST_BEHIND`] would have shown [`LEAST_TIMES`] times, and fewer are behind.
    pub(super) fn shows_none(&self) -> bool {
        self.samples as f64 * LEAST_BEHIND >= LEAST_TIMES as f64
            && self.share_behind() < LEAST_BEHIND
    }

    /// Whether frames are lost.
    pub(super) fn shows_losses(&self) -> bool {
        self.times >= LEAST_TIMES
            && self.share_behind() >= LEAST_BEHIND
            && self.at_one_stroke as f64 >= LEAST_AT_ONE_STROKE * self.times as f64
            && self.lags()
    }
}

/// Runs that repeat each other, and the joint that tells most: the bus loses a frame of all joints at once,
/// so that more of them would say the same again.
#[derive(Debug, Clone, Copy)]
pub(super) struct Group<'a> {
    pub runs: &'a [Trial],
    pub joint: usize,
    /// Frames that ask for less do not count, rad.
    pub least_rad: f64,
}

impl Group<'_> {
    /// What simulating it comes to, s of joints.
    pub(super) fn seconds(&self) -> f64 {
        let joints = self.runs.first().map_or(0, |r| r.commands.len());
        let each = self.runs.iter().map(Trial::duration_s);
        each.sum::<f64>() * joints as f64
    }
}

/// The groups of repeats among `trials` on a stand in which a joint is asked for anything.
pub(super) fn watched<'a>(replayer: &Replayer, trials: &'a [Trial]) -> Vec<Group<'a>> {
    let joints = replayer.model().actuated().len();
    let groups = trials.iter().filter(|t| t.base == BaseHold::Fixed);
    let groups = groups.map(|t| &t.members[..]).filter(|m| m.len() > 1);
    let most = |runs: &'a [Trial]| {
        let each = (0..joints).filter_map(|joint| {
            let together = Together::of(replayer, runs, joint)?;
            let least_rad = LEAST_STEP_RAD * replayer.model().per_radian(joint);
            let least_rad = least_rad.max(TIMES_NOISE * together.noise_rad(1));
            let large =
                (0..together.time_s.len()).filter(|k| together.step(*k, 1).abs() > least_rad);
            Some((large.count(), Group { runs, joint, least_rad }))
        });
        // of joints that are asked for as much the first
        let most = each.rev().max_by_key(|(large, _)| *large)?;
        (most.0 > 0).then_some(most.1)
    };
    groups.filter_map(most).collect()
}

/// The command that a servo acts on, as its own law says, rad.
struct Heard {
    time_s: Vec<f64>,
    rad: Vec<f64>,
}

impl Heard {
    /// By joint `a` in a run; none where what is needed is not logged.
    fn of(replayer: &Replayer, trial: &Trial, a: usize) -> Option<Self> {
        let plant = replayer.plant(trial, &[]);
        let kp = f64::from(plant.lane.kp_nm_per_rad[a]).max(1e-6);
        let kd = f64::from(plant.lane.kd_nms_per_rad[a]);
        let position = trial.channel(Kind::Position, a)?;
        let speed = trial.channel(Kind::Velocity, a)?;
        let (torque, per_unit_nm) = match trial.channel(Kind::Torque, a) {
            Some(torque) => (torque, 1.0),
            None => (
                trial.channel(Kind::Current, a)?,
                f64::from(plant.lane.joints[a].torque_constant_nm_per_a),
            ),
        };
        let rad =
            |(&t, &x): (&f64, &f64)| (per_unit_nm * x + kd * speed.at(t)) / kp + position.at(t);
        Some(Self {
            rad: torque.time_s.iter().zip(&torque.value).map(rad).collect(),
            time_s: torque.time_s.clone(),
        })
    }

    /// The sample nearest to `t_s`, if there is one within `within_s`.
    fn near(&self, t_s: f64, within_s: f64) -> Option<f64> {
        let k = self.time_s.partition_point(|&t| t < t_s);
        let off = |k: &usize| (self.time_s[*k] - t_s).abs();
        let near = [k.checked_sub(1), (k < self.time_s.len()).then_some(k)];
        let near = near.into_iter().flatten();
        let nearest = near.min_by(|a, b| off(a).total_cmp(&off(b)))?;
        (off(&nearest) <= within_s).then(|| self.rad[nearest])
    }
}

/// What all repeats of a run heard at one joint, at the samples of the first.
struct Together<'a> {
    command: &'a Steps,
    /// Since the run began, s. `[N]`
    since_s: Vec<f64>,
    /// Stamps of the first run, s. `[N]`
    time_s: Vec<f64>,
    /// rad; none where not all have a sample. `[N][runs]`
    heard_rad: Vec<Option<Vec<f64>>>,
}

impl<'a> Together<'a> {
    fn of(replayer: &Replayer, runs: &'a [Trial], a: usize) -> Option<Self> {
        let first = runs.first()?;
        let command = first.commands.get(a)?;
        if command.frame_s <= 0.0 || command.value.len() < 2 {
            return None;
        }
        let heard: Vec<Heard> =
            (runs.iter()).map(|t| Heard::of(replayer, t, a)).collect::<Option<_>>()?;
        let masked = |t: &Trial, at: f64| t.is_left_out(at);
        let all_at = |&t: &f64| {
            let since = t - first.span_s.0;
            let each = runs.iter().zip(&heard).map(|(run, heard)| {
                let at = run.span_s.0 + since;
                let here = heard.near(at, NEAR * command.frame_s);
                here.filter(|_| !masked(run, at))
            });
            each.collect::<Option<Vec<f64>>>()
        };
        let time_s = heard.first()?.time_s.clone();
        Some(Self {
            command,
            since_s: time_s.iter().map(|t| t - first.span_s.0).collect(),
            heard_rad: time_s.iter().map(all_at).collect(),
            time_s,
        })
    }

    /// What was commanded so many rows before sample `k`, rad; none before the run began. Half a row on, so
    /// that stamps that jitter do not matter.
    fn sent(&self, k: usize, rows: usize) -> Option<f64> {
        let before_s = (rows as f64 - 0.5) * self.command.frame_s;
        (self.since_s[k] >= before_s).then(|| self.command.at(self.time_s[k] - before_s))
    }

    /// What the frame of so many rows before sample `k` asked for on top of the one before, rad.
    fn step(&self, k: usize, rows: usize) -> f64 {
        let sent = |rows| self.sent(k, rows);
        (sent(rows).zip(sent(rows + 1))).map_or(0.0, |(now, before)| now - before)
    }

    /// Sum of squares of what was heard on the whole less what was sent so many rows before, and how many
    /// there are.
    fn off(&self, rows: usize) -> (f64, f64) {
        let mut sum = (0.0, 0.0);
        for (k, heard) in self.heard_rad.iter().enumerate() {
            let step = self.step(k, rows).abs();
            if let (Some(heard), Some(sent)) = (heard, self.sent(k, rows))
                // a jump is heard by the row; what is small says nothing
                && (LEAST_STEP_RAD..12.0 * LEAST_STEP_RAD).contains(&step)
            {
                sum.0 += (middle(heard) - sent).powi(2);
                sum.1 += 1.0;
            }
        }
        sum
    }

    /// What repeats differ by where next to nothing is asked for, rad: the quarter where they differ least,
    /// since after a burst they still do.
    fn noise_rad(&self, rows: usize) -> f64 {
        let mut by_step: Vec<(f64, f64)> = Vec::new();
        for (k, heard) in self.heard_rad.iter().enumerate() {
            let Some(heard) = heard else { continue };
            let all = middle(heard);
            let apart = heard.iter().map(|x| (x - all).abs());
            by_step.push((self.step(k, rows).abs(), apart.fold(0.0, f64::max)));
        }
        by_step.sort_by(|a, b| a.0.total_cmp(&b.0));
        by_step.truncate((QUIET_SHARE * by_step.len() as f64) as usize);
        let mut apart: Vec<f64> = by_step.into_iter().map(|x| x.1).collect();
        apart.sort_by(f64::total_cmp);
        apart.get(apart.len() / 4).copied().unwrap_or(f64::INFINITY)
    }

    fn tally(&self, rows: usize, least_rad: f64) -> Tally {
        let mut tally = Tally::default();
        // how far each run was behind at the sample before, where that counted
        let mut before: Option<Vec<f64>> = None;
        for (k, heard) in self.heard_rad.iter().enumerate() {
            let step = self.step(k, rows);
            let Some(heard) = heard.as_ref().filter(|_| step.abs() > least_rad) else {
                before = None;
                continue;
            };
            let along = |x: &f64| x * step.signum();
            let ahead = heard.iter().map(along).fold(f64::NEG_INFINITY, f64::max);
            let behind: Vec<f64> =
                (heard.iter().map(along)).map(|x| (ahead - x) / step.abs()).collect();
            let most = if heard.len() > 2 { middle(&behind) } else { f64::NAN };
            for (run, &now) in behind.iter().enumerate() {
                tally.samples += 1;
                tally.behind_most += usize::from(now - most > BEHIND_FRAMES);
                tally.ahead_of_most += usize::from(most - now > BEHIND_FRAMES);
                if now <= BEHIND_FRAMES {
                    continue;
                }
                tally.behind += 1;
                if before.as_ref().is_some_and(|b| b[run] < ABREAST) {
                    tally.times += 1;
                    tally.at_one_stroke += usize::from(now > ONE_STROKE);
                }
            }
            before = Some(behind);
        }
        tally
    }
}

/// Median.
fn middle(x: &[f64]) -> f64 {
    let mut sorted = x.to_vec();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len();
    0.5 * (sorted[(n - 1) / 2] + sorted[n / 2])
}

/// How often the runs in `groups` are behind their repeats.
pub(super) fn tally(replayer: &Replayer, groups: &[Group]) -> Tally {
    let all: Vec<(Together, f64)> = (groups.iter())
        .filter_map(|g| Some((Together::of(replayer, g.runs, g.joint)?, g.least_rad)))
        .collect();
    let off = |rows: &usize| {
        let sums = all.iter().map(|(t, _)| t.off(*rows));
        let (sum, n) = sums.fold((0.0, 0.0), |s, x| (s.0 + x.0, s.1 + x.1));
        sum / f64::max(n, 1.0)
    };
    // when what was sent is heard
    let rows = (0..=MOST_ROWS).min_by(|a, b| off(a).total_cmp(&off(b)));
    let mut tally = Tally::default();
    for (together, least_rad) in &all {
        tally.add(together.tally(rows.unwrap_or(0), *least_rad));
    }
    tally
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 0.02 rad more with every frame of 10 ms.
    fn ramp() -> Steps {
        Steps {
            time_s: (0..40).map(|k| 0.01 * f64::from(k)).collect(),
            value: (0..40).map(|k| 0.02 * f64::from(k)).collect(),
            frame_s: 0.01,
        }
    }

    /// What three runs heard of the ramp, each `behind` so many frames at each of its rows.
    fn together(command: &Steps, behind: impl Fn(usize, usize) -> f64) -> Together<'_> {
        let heard = |k: usize| {
            let runs = (0..3).map(|run| 0.02 * (k as f64 - behind(k, run)));
            Some(runs.collect())
        };
        Together {
            command,
            since_s: command.time_s.clone(),
            time_s: command.time_s.clone(),
            heard_rad: (0..40).map(heard).collect(),
        }
    }

    #[test]
    fn runs_that_part_from_their_repeats_lose_frames_if_they_fall_behind() {
        // 4 % of the samples are behind in bursts of 4; where one of three parts from the others it is behind
        // them 150 times
        let lossy = Tally {
            samples: 4000,
            behind: 160,
            times: 40,
            at_one_stroke: 30,
            behind_most: 150,
            ahead_of_most: 10,
        };
        assert!(lossy.shows_losses());
        // friction lets go sooner in one run and later in another: ahead as often; √(160·4)·3 = 76 is what
        // chance may give
        assert!(!Tally { behind_most: 100, ahead_of_most: 60, ..lossy }.shows_losses());
        // it does so slowly
        assert!(!Tally { at_one_stroke: 5, ..lossy }.shows_losses());
        // of two repeats nobody knows which one is behind
        assert!(!Tally { behind_most: 0, ahead_of_most: 0, ..lossy }.shows_losses());
        // 40 of 4000 behind are none; of 400 samples a hundredth and a half is six, and fewer than twelve say nothing
        let none = Tally { behind: 40, times: 10, ..lossy };
        assert!(none.shows_none() && !lossy.shows_none());
        assert!(!Tally { samples: 400, behind: 0, ..none }.shows_none());
    }

    #[test]
    fn a_run_that_lost_a_frame_is_behind_by_it() {
        let command = ramp();
        // the second run loses row 20 and row 21, the third row 30
        let lossy = together(&command, |k, run| match (k, run) {
            (20, 1) | (30, 2) => 1.0,
            (21, 1) => 2.0,
            _ => 0.0,
        });
        // before row 1 nothing was sent that could be missed
        let expected = Tally {
            samples: 3 * 39,
            behind: 3,
            times: 2,
            at_one_stroke: 2,
            behind_most: 3,
            ahead_of_most: 0,
        };
        assert_eq!(lossy.tally(0, LEAST_STEP_RAD), expected);
        // what drifts away, a tenth of a frame with every row, passes the half without a stroke
        let drifting = together(&command, |k, run| match run {
            1 => 0.1 * (k as f64 - 10.0).clamp(0.0, 8.0),
            _ => 0.0,
        });
        let tally = drifting.tally(0, LEAST_STEP_RAD);
        assert!(tally.behind > 10, "{tally:?}");
        assert_eq!(tally.times, 0, "{tally:?}");
    }
}
