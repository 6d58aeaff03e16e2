//! Frames of the command that did not arrive, told by what repeats differ by.
//!
//! Every run loses other frames, so that the mean of repeats shows next to nothing of it, and what repeats
//! differ by is what noise is told by: a third of all frames may be lost, and simulation and measurement
//! agree within what runs differ by. But current, angle and speed of a servo together say which command it
//! acts on, whatever load it carries: its own law, solved for the command. Where that of one run falls behind
//! that of its repeats at one stroke, by just what the last frame asked for, that frame did not arrive. Of
//! three repeats two say which one is behind; what else they differ by puts a run ahead as often. How many
//! did not, and how many in a row, is what the simulation must lose to fall behind as often and for as long.

use std::collections::BTreeMap;

use caudata_random::{Key, Purpose, Stream};

use super::heard::{Group, Tally, tally, watched};
use crate::effects::{DROPPED_FRAMES, Domain, Place};
use crate::error::GapError;
use crate::replay::{Data, Replayer, SegmentOptions, Term};
use crate::report::{Cause, Parameter, Rejected};
use crate::trial::{Steps, Trial};

/// Shares and mean lengths of bursts that are simulated.
const SHARES: [f64; 8] = [0.005, 0.015, 0.03, 0.06, 0.12, 0.2, 0.3, 0.45];
const BURSTS: [f64; 6] = [1.0, 2.0, 3.0, 5.0, 8.0, 16.0];
/// How often each is.
const TIMES_SIMULATED: usize = 3;
/// Runs that are simulated for that, s of joints: the first groups of repeats, and one at least.
const MOST_SIMULATED_S: f64 = 200.0;

/// Frames that are lost.
#[derive(Debug, Clone)]
pub struct Losses {
    /// As an effect.
    pub term: Term,
    /// Whether bursts are longer than any that was simulated.
    at_bound: bool,
    /// In the runs that are fitted.
    fit: Tally,
}

/// What repeats say of lost frames.
pub enum Repeats {
    /// Some are lost.
    Lose(Losses),
    /// None are.
    LoseNone,
    /// Nothing: repeats, speeds or currents are missing, or the robot file says already that it loses some.
    SayNothing,
}

/// Looks for frames that were lost in the runs `fit` of a robot on a stand.
///
/// # Errors
/// As [`Replayer::predict`].
pub fn find(replayer: &Replayer, fit: &[Trial]) -> Result<Repeats, GapError> {
    if replayer.gives(&DROPPED_FRAMES) {
        return Ok(Repeats::SayNothing);
    }
    let mut groups = watched(replayer, fit);
    let fit = tally(replayer, &groups);
    if fit.shows_none() {
        return Ok(Repeats::LoseNone);
    }
    if !fit.shows_losses() {
        return Ok(Repeats::SayNothing);
    }
    let mut spent_s = 0.0;
    groups.retain(|g| {
        let first = spent_s == 0.0;
        spent_s += g.seconds();
        first || spent_s <= MOST_SIMULATED_S
    });
    let measured = tally(replayer, &groups);
    let place = Place { domain: Domain::Robot, items: Vec::new(), names: Vec::new() };
    let like = like(replayer, &groups, &measured)?;
    Ok(like.map_or(Repeats::SayNothing, |(share, burst)| {
        Repeats::Lose(Losses {
            term: Term { effect: &DROPPED_FRAMES, place, values: vec![share, burst] },
            at_bound: burst >= BURSTS[BURSTS.len() - 1],
            fit,
        })
    }))
}

impl Losses {
    /// As a cause that one is `confidence` sure of.
    pub fn cause(&self, confidence: f64) -> Cause {
        let n = self.fit.times as f64;
        let [share, burst] = [self.term.values[0], self.term.values[1]];
        // n bursts whose lengths are those of a coin that is tossed: a length varies by 1 − 1/burst of itself
        // squared, their number by chance
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
            (of_share.name.to_owned(), parameter(share, half_share, of_share.low, of_share.high)),
            (of_burst.name.to_owned(), parameter(burst, half_burst, of_burst.low, of_burst.high)),
        ]);
        let evidence = vec![
            format!(
                "one run falls behind its repeats {} times, {} of them at one stroke by what the last frame asked for; {:.1} % of {} samples are behind (a lab that loses a frame in a thousand has 0.3 % at most)",
                self.fit.times,
                self.fit.at_one_stroke,
                100.0 * self.fit.share_behind(),
                self.fit.samples
            ),
            format!("its mark: {}", self.term.effect.signature),
            "it is measured by what repeats differ by, and takes next to nothing off the misfit of their mean"
                .to_owned(),
        ];
        Cause {
            effect: self.term.effect.id.to_owned(),
            layer: self.term.effect.layer.name().to_owned(),
            parameters,
            confidence,
            confidence_of_kind: confidence,
            evidence,
            rejected: vec![Rejected {
                effect: "command_delay".to_owned(),
                reason: "shifts every frame of every run alike: repeats would not differ by it"
                    .to_owned(),
            }],
            ..Cause::default()
        }
    }
}

/// The share of frames, and their mean number in a row, that the simulation must lose to be behind as often
/// as `measured` and for as long; none where it never is.
fn like(
    replayer: &Replayer,
    groups: &[Group],
    measured: &Tally,
) -> Result<Option<(f64, f64)>, GapError> {
    // for each length of bursts: the share at which the simulation is behind as often, and for how long it is
    // then
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

/// On the line through `points` (x, y) where it passes `x` first; at an end where it does not. None without
/// points.
fn between(points: &[(f64, f64)], x: f64) -> Option<f64> {
    let passes = |w: &&[(f64, f64)]| (w[0].0..=w[1].0).contains(&x);
    if let Some(w) = points.windows(2).find(passes) {
        let share = (x - w[0].0) / (w[1].0 - w[0].0).max(1e-12);
        return Some(w[0].1 + share * (w[1].1 - w[0].1));
    }
    let off = |p: &&(f64, f64)| (p.0 - x).abs();
    points.iter().min_by(|a, b| off(a).total_cmp(&off(b))).map(|p| p.1)
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
            let lost = drawn((run.duration_s() / frame_s) as usize + 2, share, burst, &mut stream);
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
        for (segment, piece) in data.parts() {
            let channel = &mut heard[segment.trial].channels[piece.channel];
            channel.time_s.extend(&data.time_s[piece.range.clone()]);
            channel.value.extend(predicted[piece.range.clone()].iter().map(|x| f64::from(*x)));
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
        tally.add(super::heard::tally(replayer, &of_group));
    }
    Ok(Some(tally))
}

/// Which of so many frames are lost, by a bus with two states. `share` is at most that of single frames
/// between such that arrive, one half, if `burst` is 1.
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

/// `sent` as it is heard where the frames that `lost` says, counted from `from_s`, do not arrive: what holds
/// is sent again with the next one.
fn lose(sent: &Steps, from_s: f64, lost: &[bool]) -> Steps {
    let mut heard = Steps { frame_s: sent.frame_s, ..Steps::default() };
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
