//! Frames of the command that did not arrive, told by what repeats differ by.
//!
//! Every run loses other frames, so that the mean of repeats shows next to nothing of it, and what repeats differ by is what noise is told by: a third of all frames
//! may be lost, and simulation and measurement agree within what runs differ by. But current, angle and speed of a servo together say which command it acts on,
//! whatever load it carries: its own law, solved for the command. Where that of one run falls behind that of its repeats at one stroke, by just what the last frame
//! asked for, that frame did not arrive. Of three repeats two say which one is behind; what else they differ by puts a run ahead as
//! often. How many did not, and how many in a row, is what the simulation must lose to fall behind as often and for as long.

use std::collections::BTreeMap;

use caudata_random::{Key, Purpose, Stream};
use caudata_runlog::BaseHold;

use crate::effects::{DROPPED_FRAMES, Domain, Place};
use crate::error::GapError;
use crate::replay::{Data, Replayer, SegmentOptions, Term};
use crate::report::{Cause, Parameter, Rejected};
use crate::trial::{Kind, Steps, Trial};

/// Frames that ask for less are too small to be missed, rad …
const LEAST_STEP_RAD: f64 = 0.008;
/// … and those that ask for less than so many times what repeats differ by where next to nothing is asked for.
const TIMES_NOISE: f64 = 8.0;
/// Of the samples those with the smallest frames, which noise is told by.
const QUIET_SHARE: f64 = 0.25;
/// A run is behind from this share of the last frame on, …
const BEHIND_FRAMES: f64 = 0.5;
/// … it was not before below this one, …
const ABREAST: f64 = 0.3;
/// … and it fell behind at one stroke if it is this far behind at once: what two runs drift apart by goes past the first one slowly.
const ONE_STROKE: f64 = 0.75;
/// Of the times that a run falls behind at least this share are at one stroke where frames are lost: on bench rigs 0.58 to 0.76 of them, 0.5 where gears have play, 0.1
/// where all commands are late by nearly a row, so that jitter of stamps decides which one is heard.
const LEAST_AT_ONE_STROKE: f64 = 0.4;
/// Of the samples at which one run parts from the others, it is behind them at this share: 0.64 (a third of all frames lost) to 0.95 on bench rigs, and 0.2 to 0.57
/// of those without losses (203 cases of seeds 101 to 113) …
const LEAST_BEHIND_MOST: f64 = 0.6;
/// … and more often than ahead by so many standard deviations of chance.
const BEYOND_CHANCE: f64 = 3.0;
/// Share of samples that are behind where frames are lost; a lab that loses one frame in a thousand has 0.001 to 0.003, play up to 0.014.
const LEAST_BEHIND: f64 = 0.015;
/// The same in held-out runs.
const LEAST_BEHIND_HELD_OUT: f64 = 0.008;
/// A run must fall behind so often in the runs that are fitted, …
const LEAST_TIMES: usize = 12;
/// … and in held-out ones so often.
const LEAST_TIMES_HELD_OUT: usize = 4;
/// Rows by which what is measured may come after its command.
const MOST_ROWS: usize = 4;
/// Samples of two runs that are compared lie no farther apart than this share of a frame.
const NEAR: f64 = 0.45;
/// Shares and mean lengths of bursts that are simulated.
const SHARES: [f64; 8] = [0.005, 0.015, 0.03, 0.06, 0.12, 0.2, 0.3, 0.45];
const BURSTS: [f64; 6] = [1.0, 2.0, 3.0, 5.0, 8.0, 16.0];
/// How often each is.
const TIMES_SIMULATED: usize = 3;
/// Runs that are simulated for that, s of joints: the first groups of repeats, and one at least.
const MOST_SIMULATED_S: f64 = 200.0;

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
    fn add(&mut self, other: Self) {
        self.samples += other.samples;
        self.behind += other.behind;
        self.times += other.times;
        self.at_one_stroke += other.at_one_stroke;
        self.behind_most += other.behind_most;
        self.ahead_of_most += other.ahead_of_most;
    }

    fn share_behind(&self) -> f64 {
        self.behind as f64 / self.samples.max(1) as f64
    }

    /// Samples for which a run stays behind, on average.
    fn length(&self) -> f64 {
        self.behind as f64 / self.times.max(1) as f64
    }

    /// Whether a run that parts from its repeats is behind them and not as often ahead: what friction, play and supply make of repeats has no direction.
    fn lags(&self) -> bool {
        let (behind, ahead) = (self.behind_most as f64, self.ahead_of_most as f64);
        // samples of one burst are one
        let by_chance = ((behind + ahead) * self.length()).sqrt();
        behind > LEAST_BEHIND_MOST * (behind + ahead) && behind - ahead > BEYOND_CHANCE * by_chance
    }

    fn shows_losses(&self, least_times: usize, least_behind: f64) -> bool {
        self.times >= least_times
            && self.share_behind() >= least_behind
            && self.at_one_stroke as f64 >= LEAST_AT_ONE_STROKE * self.times as f64
    }
}

/// Frames that are lost.
#[derive(Debug, Clone)]
pub struct Losses {
    /// As an effect.
    pub term: Term,
    /// Whether bursts are longer than any that was simulated.
    at_bound: bool,
    /// In the runs that are fitted.
    fit: Tally,
    /// In held-out runs; none where those are the same.
    held_out: Option<Tally>,
}

/// Looks for frames that were lost in the runs `fit` and `held_out` (none: the same runs) of a robot on a stand. None where none are, where repeats, speeds or
/// currents are missing, or where the robot file says already that it loses some.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn find(
    replayer: &Replayer,
    fit: &[Trial],
    held_out: Option<&[Trial]>,
) -> Result<Option<Losses>, GapError> {
    if replayer.gives(&DROPPED_FRAMES) {
        return Ok(None);
    }
    let mut groups = watched(replayer, fit);
    let fit = tally(replayer, &groups);
    let held_out = held_out.map(|trials| tally(replayer, &watched(replayer, trials)));
    if !shown(&fit, held_out.as_ref()) {
        return Ok(None);
    }
    let mut spent_s = 0.0;
    groups.retain(|g| {
        let first = spent_s == 0.0;
        spent_s += g.seconds();
        first || spent_s <= MOST_SIMULATED_S
    });
    let measured = tally(replayer, &groups);
    let place = Place {
        domain: Domain::Robot,
        items: Vec::new(),
        names: Vec::new(),
    };
    Ok(
        like(replayer, &groups, &measured)?.map(|(share, burst)| Losses {
            term: Term {
                effect: &DROPPED_FRAMES,
                place,
                values: vec![share, burst],
            },
            at_bound: burst >= BURSTS[BURSTS.len() - 1],
            fit,
            held_out,
        }),
    )
}

/// Whether frames are lost in the runs that are fitted and in held-out ones.
fn shown(fit: &Tally, held_out: Option<&Tally>) -> bool {
    let mut all = *fit;
    all.add(held_out.copied().unwrap_or_default());
    fit.shows_losses(LEAST_TIMES, LEAST_BEHIND)
        && held_out.is_none_or(|t| t.shows_losses(LEAST_TIMES_HELD_OUT, LEAST_BEHIND_HELD_OUT))
        && all.lags()
}

impl Losses {
    /// As a cause that one is `confidence` sure of.
    #[must_use]
    pub fn cause(&self, confidence: f64) -> Cause {
        let n = self.fit.times as f64;
        let [share, burst] = [self.term.values[0], self.term.values[1]];
        // n bursts whose lengths are those of a coin that is tossed: a length varies by 1 − 1/burst of itself squared, their number by chance
        let of_lengths = (1.0 - 1.0 / burst) / n;
        let half_share = 1.96 * share * (1.0 / n + of_lengths).sqrt();
        let half_burst = 1.96 * burst * of_lengths.sqrt();
        let parameter = |value: f64, half: f64, low: f64, high: f64| Parameter {
            value,
            unit: String::new(),
            ci_low: (value - half).max(low),
            ci_high: (value + half).min(high),
            at_bound: self.at_bound,
        };
        let [of_share, of_burst] = [0, 1].map(|p| &self.term.effect.parameters[p]);
        let parameters = BTreeMap::from([
            (
                of_share.name.to_owned(),
                parameter(share, half_share, of_share.low, of_share.high),
            ),
            (
                of_burst.name.to_owned(),
                parameter(burst, half_burst, of_burst.low, of_burst.high),
            ),
        ]);
        let in_words = |t: &Tally, runs: &str| {
            format!(
                "in {runs} one run falls behind its repeats {} times, {} of them at one stroke by what the last frame asked for; {:.1} % of {} samples are behind (a lab that \
                 loses a frame in a thousand has 0.3 % at most)",
                t.times,
                t.at_one_stroke,
                100.0 * t.share_behind(),
                t.samples
            )
        };
        let mut evidence = vec![in_words(&self.fit, "the runs that were fitted")];
        evidence.extend((self.held_out.iter()).map(|t| in_words(t, "held-out runs")));
        evidence.push(format!("its mark: {}", self.term.effect.signature));
        evidence.push(
            "it is measured by what repeats differ by, and takes next to nothing off the misfit of their mean"
                .to_owned(),
        );
        Cause {
            effect: self.term.effect.id.to_owned(),
            layer: self.term.effect.layer.name().to_owned(),
            location: Vec::new(),
            parameters,
            confidence,
            alternatives: Vec::new(),
            elsewhere: Vec::new(),
            evidence,
            rejected: vec![Rejected {
                effect: "command_delay".to_owned(),
                reason: "shifts every frame of every run alike: repeats would not differ by it"
                    .to_owned(),
            }],
        }
    }
}

/// Runs that repeat each other, and the joint that tells most: the bus loses a frame of all joints at once, so that more of them would say the same again.
#[derive(Debug, Clone, Copy)]
struct Group<'a> {
    runs: &'a [Trial],
    joint: usize,
    /// Frames that ask for less do not count, rad.
    least_rad: f64,
}

impl Group<'_> {
    /// What simulating it comes to, s of joints.
    fn seconds(&self) -> f64 {
        let joints = self.runs.first().map_or(0, |r| r.commands.len());
        let each = self.runs.iter().map(Trial::duration_s);
        each.sum::<f64>() * joints as f64
    }
}

/// The groups of repeats among `trials` on a stand in which a joint is asked for anything.
fn watched<'a>(replayer: &Replayer, trials: &'a [Trial]) -> Vec<Group<'a>> {
    let joints = replayer.model().actuated().len();
    let groups = trials.iter().filter(|t| t.base == BaseHold::Fixed);
    let groups = groups.map(|t| &t.members[..]).filter(|m| m.len() > 1);
    let most = |runs: &'a [Trial]| {
        let each = (0..joints).filter_map(|joint| {
            let together = Together::of(replayer, runs, joint)?;
            let least_rad = LEAST_STEP_RAD.max(TIMES_NOISE * together.noise_rad(1));
            let large =
                (0..together.time_s.len()).filter(|k| together.step(*k, 1).abs() > least_rad);
            Some((
                large.count(),
                Group {
                    runs,
                    joint,
                    least_rad,
                },
            ))
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
        let heard: Vec<Heard> = (runs.iter())
            .map(|t| Heard::of(replayer, t, a))
            .collect::<Option<_>>()?;
        let masked = |t: &Trial, at: f64| t.masked_s.iter().any(|(a, b)| (*a..=*b).contains(&at));
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

    /// What was commanded so many rows before sample `k`, rad; none before the run began. Half a row on, so that stamps that jitter do not matter.
    fn sent(&self, k: usize, rows: usize) -> Option<f64> {
        let before_s = (rows as f64 - 0.5) * self.command.frame_s;
        (self.since_s[k] >= before_s).then(|| self.command.at(self.time_s[k] - before_s))
    }

    /// What the frame of so many rows before sample `k` asked for on top of the one before, rad.
    fn step(&self, k: usize, rows: usize) -> f64 {
        let sent = |rows| self.sent(k, rows);
        (sent(rows).zip(sent(rows + 1))).map_or(0.0, |(now, before)| now - before)
    }

    /// Sum of squares of what was heard on the whole less what was sent so many rows before, and how many there are.
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

    /// What repeats differ by where next to nothing is asked for, rad: the quarter where they differ least, since after a burst they still do.
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
            let behind: Vec<f64> = (heard.iter().map(along))
                .map(|x| (ahead - x) / step.abs())
                .collect();
            let most = if heard.len() > 2 {
                middle(&behind)
            } else {
                f64::NAN
            };
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
fn tally(replayer: &Replayer, groups: &[Group]) -> Tally {
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

/// The share of frames, and their mean number in a row, that the simulation must lose to be behind as often as `measured` and for as long; none where it never is.
fn like(
    replayer: &Replayer,
    groups: &[Group],
    measured: &Tally,
) -> Result<Option<(f64, f64)>, GapError> {
    // for each length of bursts: the share at which the simulation is behind as often, and for how long it is then
    let mut rows: Vec<(f64, f64, f64)> = Vec::new();
    for burst in BURSTS {
        let mut often = Vec::new();
        let mut long = Vec::new();
        for share in SHARES {
            let Some(tally) = simulated(replayer, groups, share, burst)? else {
                return Ok(None);
            };
            often.push((tally.share_behind(), share));
            long.push((share, tally.length()));
        }
        let share = measured.share_behind();
        let within = often.iter().any(|p| p.0 <= share) && often.iter().any(|p| p.0 >= share);
        if let Some(share) = between(&often, share).filter(|_| within) {
            rows.extend(between(&long, share).map(|length| (length, burst, share)));
        }
    }
    let lengths: Vec<(f64, f64)> = rows.iter().map(|r| (r.0, r.1)).collect();
    let burst = between(&lengths, measured.length());
    let shares: Vec<(f64, f64)> = rows.iter().map(|r| (r.1, r.2)).collect();
    Ok(burst.and_then(|burst| Some((between(&shares, burst)?, burst))))
}

/// On the line through `points` (x, y) where it passes `x` first; at an end where it does not. None without points.
fn between(points: &[(f64, f64)], x: f64) -> Option<f64> {
    let passes = |w: &&[(f64, f64)]| (w[0].0..=w[1].0).contains(&x);
    if let Some(w) = points.windows(2).find(passes) {
        let share = (x - w[0].0) / (w[1].0 - w[0].0).max(1e-12);
        return Some(w[0].1 + share * (w[1].1 - w[0].1));
    }
    let off = |p: &&(f64, f64)| (p.0 - x).abs();
    points
        .iter()
        .min_by(|a, b| off(a).total_cmp(&off(b)))
        .map(|p| p.1)
}

/// The same runs by the simulation, losing frames; none where it breaks down.
fn simulated(
    replayer: &Replayer,
    groups: &[Group],
    share: f64,
    burst: f64,
) -> Result<Option<Tally>, GapError> {
    let mut tally = Tally::default();
    for time in 0..TIMES_SIMULATED {
        let mut stream = Stream::new(Key::for_run(time as u64), Purpose::CommandLoss);
        let mut lossy: Vec<Trial> = Vec::new();
        for run in groups.iter().flat_map(|g| g.runs) {
            let mut run = run.clone();
            run.masked_s.clear();
            let frame_s = run.commands.first().map_or(0.0, |c| c.frame_s).max(1e-3);
            let lost = drawn(
                (run.duration_s() / frame_s) as usize + 2,
                share,
                burst,
                &mut stream,
            );
            for command in &mut run.commands {
                *command = lose(command, run.span_s.0, &lost);
            }
            lossy.push(run);
        }
        let data = Data::new(replayer.model(), lossy, SegmentOptions::default());
        let predicted = replayer.predict(&data, &[Vec::new()])?.swap_remove(0);
        if predicted.iter().any(|x| !x.is_finite()) {
            return Ok(None);
        }
        let mut heard: Vec<Trial> = data.trials.clone();
        for trial in &mut heard {
            for channel in &mut trial.channels {
                channel.time_s.clear();
                channel.value.clear();
            }
        }
        for segment in &data.segments {
            for piece in &segment.pieces {
                let channel = &mut heard[segment.trial].channels[piece.channel];
                channel.time_s.extend(&data.time_s[piece.range.clone()]);
                let values = predicted[piece.range.clone()].iter();
                channel.value.extend(values.map(|x| f64::from(*x)));
            }
        }
        // what was asked for is what was sent
        let sent = groups.iter().flat_map(|g| g.runs);
        for (heard, sent) in heard.iter_mut().zip(sent) {
            heard.channels.retain(|c| !c.value.is_empty());
            heard.commands.clone_from(&sent.commands);
        }
        let mut rest = &heard[..];
        let mut of_group = Vec::new();
        for group in groups {
            let (runs, after) = rest.split_at(group.runs.len().min(rest.len()));
            of_group.push(Group { runs, ..*group });
            rest = after;
        }
        tally.add(self::tally(replayer, &of_group));
    }
    Ok(Some(tally))
}

/// Which of so many frames are lost, by a bus with two states. `share` is at most that of single frames between such that arrive, one half, if `burst` is 1.
fn drawn(frames: usize, share: f64, burst: f64, stream: &mut Stream) -> Vec<bool> {
    let mut lost = false;
    (0..frames)
        .map(|_| {
            let chance = match lost {
                true => 1.0 - 1.0 / burst,
                false => (share / (burst * (1.0 - share))).min(1.0),
            };
            lost = f64::from(stream.uniform(0.0, 1.0)) < chance;
            lost
        })
        .collect()
}

/// `sent` as it is heard where the frames that `lost` says, counted from `from_s`, do not arrive: what holds is sent again with the next one.
fn lose(sent: &Steps, from_s: f64, lost: &[bool]) -> Steps {
    let mut heard = Steps {
        frame_s: sent.frame_s,
        ..Steps::default()
    };
    for (k, (&t, &value)) in sent.time_s.iter().zip(&sent.value).enumerate() {
        let end_s = sent.time_s.get(k + 1).copied().unwrap_or(f64::INFINITY);
        let frame = ((t - from_s) / sent.frame_s).round().max(0.0) as usize;
        let rest = lost.get(frame..).unwrap_or_default();
        let late = rest.iter().take_while(|l| **l).count() as f64;
        let at_s = t + late * sent.frame_s;
        // before the first one there is nothing to fall back on
        if k == 0 {
            heard.time_s.push(t);
            heard.value.push(value);
        } else if at_s < end_s - 0.5 * sent.frame_s {
            heard.time_s.push(at_s);
            heard.value.push(value);
        }
    }
    heard
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

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

    #[test]
    fn runs_that_part_from_their_repeats_lose_frames_if_they_fall_behind() {
        // 4 % of the samples are behind in bursts of 4; where one of three parts from the others it is behind them 150 times
        let lossy = Tally {
            samples: 4000,
            behind: 160,
            times: 40,
            at_one_stroke: 30,
            behind_most: 150,
            ahead_of_most: 10,
        };
        assert!(shown(&lossy, None));
        // friction lets go sooner in one run and later in another: ahead as often; √(160·4)·3 = 76 is what chance may give
        let either_way = Tally {
            behind_most: 100,
            ahead_of_most: 60,
            ..lossy
        };
        assert!(!shown(&either_way, None));
        // it does so slowly
        let slow = Tally {
            at_one_stroke: 5,
            ..lossy
        };
        assert!(!shown(&slow, None));
        // of two repeats nobody knows which one is behind
        let two = Tally {
            behind_most: 0,
            ahead_of_most: 0,
            ..lossy
        };
        assert!(!shown(&two, None));
        // but two are enough in held-out runs, where it must happen again
        let held_out = Tally {
            samples: 1000,
            behind: 40,
            times: 8,
            at_one_stroke: 6,
            ..two
        };
        assert!(shown(&lossy, Some(&held_out)));
        assert!(!shown(
            &lossy,
            Some(&Tally {
                times: 3,
                ..held_out
            })
        ));
        assert!(!shown(&lossy, Some(&Tally::default())));
    }

    #[test]
    fn what_is_lost_is_heard_with_the_next_frame_that_arrives() {
        let sent = Steps {
            time_s: vec![0.0, 1.0, 2.0, 5.0],
            value: vec![0.0, 1.0, 2.0, 3.0],
            frame_s: 1.0,
        };
        // frames 1 (which frame 2 makes up for, with another value), 5 and 6
        let lost = [false, true, false, false, false, true, true, false];
        let heard = lose(&sent, 0.0, &lost);
        assert_eq!(heard.value, [0.0, 2.0, 3.0]);
        assert_eq!(heard.time_s, [0.0, 2.0, 7.0]);
    }

    #[test]
    fn a_bus_loses_as_many_frames_as_it_is_asked_to() {
        let mut stream = Stream::new(Key::for_run(1), Purpose::CommandLoss);
        let lost = drawn(100_000, 0.2, 4.0, &mut stream);
        let share = lost.iter().filter(|l| **l).count() as f64 / 1e5;
        let begins = lost.windows(2).filter(|w| !w[0] && w[1]).count() as f64;
        // 5,000 bursts of four: √5,000·4·√1.75 frames either way, 0.4 % of all
        assert!((share - 0.2).abs() < 0.012, "{share}");
        assert!((share * 1e5 / begins - 4.0).abs() < 0.2);
    }

    #[test]
    fn between_points_lies_the_line() {
        let points = [(0.0, 1.0), (2.0, 5.0), (3.0, 4.0)];
        assert_eq!(between(&points, 1.5), Some(4.0));
        assert_eq!(between(&points, 2.5), Some(4.5));
        // beyond them the last one
        assert_eq!(between(&points, 9.0), Some(4.0));
        assert_eq!(between(&[], 1.0), None);
    }
}
