//! Where runs are cut into stretches.

use crate::trial::{Kind, Trial};

/// Stretches of a free robot, s: it diverges from its simulation, so it is put back to what was measured.
const FREE_SEGMENT_S: f64 = 0.8;
/// The same of a swimming one, s: no foot that lands a little earlier sends it elsewhere, and what the water
/// does to its speed takes a second or two to show.
const SWIMMING_SEGMENT_S: f64 = 2.0;
/// Time before each that is simulated and does not count, s: where play hangs, how friction is wound up and
/// how hard each foot presses is not measured, and comes about in it. At its end the robot is put to what was
/// measured once more.
const FREE_LEAD_S: f64 = 0.3;
/// Stretches in which a servo of a held robot is let go, s: nothing brings such a joint back to its command,
/// so that errors of its swing add up.
const LOOSE_SEGMENT_S: f64 = 0.8;
/// Time over which speeds at a start are taken, s, to each side.
pub(super) const SPEED_WINDOW_S: f64 = 0.03;

/// How runs are cut.
#[derive(Debug, Clone, Copy)]
pub struct SegmentOptions {
    /// Length of a stretch of a held robot, s; infinite: the whole run.
    pub fixed_s: f64,
    /// Length of a stretch of a free robot, s.
    pub free_s: f64,
    /// Length of a stretch of a swimming robot, s.
    pub swimming_s: f64,
    /// Length of a stretch in which a servo of a held robot is let go, s; infinite: no such stretches, what
    /// was let go swings on to the end of the run.
    pub loose_s: f64,
    /// Time before a stretch of a held robot that is simulated and does not count, s: what a joint that rests
    /// remembers of how it came there.
    pub lead_s: f64,
}

impl Default for SegmentOptions {
    fn default() -> Self {
        Self {
            fixed_s: f64::INFINITY,
            free_s: FREE_SEGMENT_S,
            swimming_s: SWIMMING_SEGMENT_S,
            loose_s: LOOSE_SEGMENT_S,
            lead_s: 0.0,
        }
    }
}

/// Where a run is cut, s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Cut {
    /// From when on it is simulated.
    pub start_s: f64,
    /// From when on it counts.
    pub from_s: f64,
    /// Until when.
    pub end_s: f64,
    /// What servos do there.
    pub servos: Servos,
}

/// What servos do where a stretch begins: it decides how much of what was measured nearby tells how fast
/// joints are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Servos {
    /// Every one holds its joint, as it did before.
    Hold,
    /// One was let go, or caught its joint in a swing, at this time of the run.
    Switched {
        /// s.
        at_s: f64,
    },
    /// One was let go before the run began.
    WereLoose,
}

impl Servos {
    /// Whether one was switched so shortly before `t_s` that a line through samples around `t_s` has
    /// something else on its two sides.
    pub(super) fn just_switched(self, t_s: f64) -> bool {
        match self {
            Self::Switched { at_s } => t_s - at_s < SPEED_WINDOW_S,
            Self::Hold | Self::WereLoose => false,
        }
    }
}

/// Parts of `length_s` or a little more, s.
fn parts((first, last): (f64, f64), length_s: f64) -> impl Iterator<Item = (f64, f64)> {
    let count = ((last - first) / length_s).floor().max(1.0);
    let each = (last - first) / count;
    let at = move |k: usize| first + k as f64 * each;
    (0..count as usize).map(move |k| (at(k), at(k + 1)))
}

/// A run on a stand: whole, or in parts of `fixed_s`; while a servo is let go, in parts of `loose_s`.
pub(super) fn held_cuts(trial: &Trial, options: SegmentOptions) -> Vec<Cut> {
    let mut cuts = Vec::new();
    let first_s = replay_span(trial).0;
    let mut before = false;
    for (span, loose) in held_spans(trial, options.loose_s) {
        let caught = std::mem::replace(&mut before, loose);
        let swings = match span.0 > first_s {
            true => Servos::Switched { at_s: span.0 },
            false => Servos::WereLoose,
        };
        let length_s = if loose { options.loose_s } else { options.fixed_s };
        cuts.extend(parts(span, length_s).map(|(from_s, end_s)| {
            // what was let go remembers nothing that matters
            let lead_s = if loose { 0.0 } else { options.lead_s };
            let start_s = from_s - lead_s.min(from_s - span.0);
            let just_caught = caught && start_s == span.0;
            Cut {
                start_s,
                from_s,
                end_s,
                servos: if loose || just_caught { swings } else { Servos::Hold },
            }
        }));
    }
    cuts
}

/// Spans in which every servo is on, and those of at least `least_s` in which one is let go: from, to (s),
/// whether one is let go.
pub(super) fn held_spans(trial: &Trial, least_s: f64) -> Vec<((f64, f64), bool)> {
    let (first, last) = replay_span(trial);
    let switches = || trial.enabled.iter().flatten();
    let mut times: Vec<f64> = (switches().flat_map(|s| &s.time_s).copied())
        .filter(|t| (first..last).contains(t))
        .collect();
    times.push(first);
    times.sort_by(f64::total_cmp);
    times.dedup();
    let mut loose: Vec<(f64, f64)> = Vec::new();
    for (k, &from) in times.iter().enumerate() {
        if switches().all(|s| s.at(from) > 0.5) {
            continue;
        }
        let to = times.get(k + 1).copied().unwrap_or(last);
        match loose.last_mut() {
            Some(before) if before.1 == from => before.1 = to,
            _ => loose.push((from, to)),
        }
    }
    loose.retain(|(from, to)| to - from >= least_s);
    let mut spans = Vec::new();
    let mut at = first;
    for (from, to) in loose {
        if from > at {
            spans.push(((at, from), false));
        }
        spans.push(((from, to), true));
        at = to;
    }
    if last > at {
        spans.push(((at, last), false));
    }
    spans
}

/// A run of a free robot, in stretches of `length_s`.
pub(super) fn free_cuts(trial: &Trial, length_s: f64) -> Vec<Cut> {
    let span = replay_span(trial);
    parts(span, length_s)
        .map(|(from_s, end_s)| {
            // at a stamp: between two of them a step of the simulation would straddle a command
            let from_s = stamp_near(trial, from_s);
            Cut {
                start_s: from_s - FREE_LEAD_S,
                from_s,
                end_s: stamp_near(trial, end_s).min(span.1),
                servos: Servos::Hold,
            }
        })
        .collect()
}

/// From when every joint's position and a command are known.
pub(super) fn replay_span(trial: &Trial) -> (f64, f64) {
    let (mut first, mut last) = trial.span_s;
    for c in trial.channels.iter().filter(|c| c.kind == Kind::Position) {
        first = first.max(c.time_s[0]);
        last = last.min(c.time_s[c.time_s.len() - 1] + 1e-6);
    }
    (first, last.max(first + 1e-3))
}

/// The stamp of a position that is nearest to `t_s`.
fn stamp_near(trial: &Trial, t_s: f64) -> f64 {
    let Some(c) = trial.channels.iter().find(|c| c.kind == Kind::Position) else { return t_s };
    let after = c.time_s.partition_point(|&t| t < t_s);
    let near = [after.saturating_sub(1), after]
        .into_iter()
        .filter_map(|k| c.time_s.get(k).copied())
        .min_by(|a, b| (a - t_s).abs().total_cmp(&(b - t_s).abs()));
    near.unwrap_or(t_s)
}
