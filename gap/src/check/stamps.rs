//! Time itself: rate, gaps, bunched rows.

use caudata_runlog::Signal;

use super::channels::Channels;
use super::finding::{Finding, Run};
use super::holes::{Hole, holes};
use super::series::{busiest, median_step_s, unit_of_steps};

/// The median rate may be off the one that the log claims by this share; a loop never keeps its rate
/// exactly.
const RATE_TOLERANCE: f64 = 0.2;
/// A step longer than so many median steps, and than [`GAP_S`], is a gap.
const GAP_STEPS: f64 = 10.0;
/// See [`GAP_STEPS`], s.
const GAP_S: f64 = 0.2;
/// Steps shorter than this share of the median are bunched rows: stamps taken from a buffer, not when the
/// sample was.
const BUNCHED: f64 = 0.2;
/// So large a share of bunched rows is said.
const BUNCHED_SHARE: f64 = 0.02;

/// A step is a whole number of rows to this …
const EVEN: f64 = 0.2;
/// … where so many of the longer ones are, rows are missing; else they just come unevenly.
const EVEN_SHARE: f64 = 0.8;
/// Shares of rows that are missing from which on it is said, and is a fault.
const LOST_SHARE: (f64, f64) = (0.02, 0.1);

/// Time over which a speed is taken beside a gap, s.
const BESIDE_S: f64 = 0.05;
/// A gap says whether rows are missing only where the motion would have gone so far in it, rad.
const TELLING_RAD: f64 = 0.03;
/// Over a longer gap no motion is steady enough to say, s.
const LONGEST_JUMP_S: f64 = 0.5;

pub(super) fn faults(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let time_s = &busiest(&run.log.table)[..];
    let median = median_step_s(time_s);
    if median <= 0.0 {
        return;
    }
    let unit = unit_of_steps(median);
    if unit != "s" {
        let detail = format!(
            "rows come {median:.1} s apart; is `t` in {unit}? Of an imported log correct `unit` in [time] of its map"
        );
        out.push(Finding::fatal("unit", "t", detail));
        return;
    }
    let claimed = run.log.meta.rate_hz;
    let ratio = 1.0 / (median * claimed);
    if (ratio - 1.0).abs() > RATE_TOLERANCE {
        let hint = match ratio {
            r if (0.000_9..0.001_1).contains(&r) => "; is `t` in milliseconds?",
            r if (9e-7..1.1e-6).contains(&r) => "; is `t` in microseconds?",
            _ => "; correct `t` or `rate_hz`",
        };
        let kind = if hint.contains("seconds?") { "unit" } else { "stamps" };
        let detail = format!(
            "rows come at {:.4} Hz where {} says {claimed:.4} Hz{hint}",
            1.0 / median,
            run.log.meta_name
        );
        out.push(Finding::fatal(kind, "t", detail));
    }
    let steps = || time_s.windows(2).map(|w| (w[0], w[1] - w[0]));
    let is_gap = |step: f64| step > GAP_STEPS * median && step > GAP_S;
    let gaps: Vec<(f64, f64)> = steps().filter(|&(_, step)| is_gap(step)).collect();
    if let Some(&(at, step)) = gaps.iter().max_by(|a, b| a.1.total_cmp(&b.1)) {
        let short = gaps.iter().filter(|g| g.1 <= LONGEST_JUMP_S);
        if let Some((at, step, channels)) = short.into_iter().find_map(|&(at, step)| {
            let channels = clock_jumped(run, joints, at, step);
            (channels > 0).then_some((at, step, channels))
        }) {
            let detail = format!(
                "jump ahead by {step:.2} s after t = {at:.2} s while {channels} channel(s) go on as if {:.0} ms had passed: the clock was set, no row is missing",
                1e3 * median
            );
            out.push(Finding::fatal("stamps", "t", detail));
            return;
        }
        let lost: f64 = gaps.iter().map(|g| g.1).sum();
        let share = lost / (time_s[time_s.len() - 1] - time_s[0]);
        let said = if share > 0.5 { Finding::fatal } else { Finding::note };
        out.push(said(
"gap",
"t".to_owned(),
format!(
                "{} gap(s), the longest of {step:.2} s after t = {at:.2} s ({:.0} % of the run is missing)",
                gaps.len(),
                100.0 * share
            ),
));
    }
    lost(time_s, median, out);
    out.extend(in_a_row(&holes(&run.log.table)));
    let bunched = steps().filter(|&(_, step)| step < BUNCHED * median).count();
    if bunched as f64 > BUNCHED_SHARE * time_s.len() as f64 {
        let detail = format!(
            "{bunched} of {} rows come less than {:.2} ms after the one before (median {:.2} ms): stamp rows when they are sampled, not when they are written",
            time_s.len(),
            1e3 * BUNCHED * median,
            1e3 * median
        );
        out.push(Finding::fatal("stamps", "t", detail));
    }
}

/// What to say of holes.
fn in_a_row(holes: &[Hole]) -> Option<Finding> {
    let longest = holes.iter().max_by_key(|h| h.rows)?;
    let all = match holes.len() {
        1 => String::new(),
        n => format!(", the longest of {n} such holes"),
    };
    let detail = format!(
        "{} rows in a row are missing after t = {:.2} s{all}: what was commanded in them is not known, and a diagnosis leaves out the time until {:.1} s after",
        longest.rows,
        longest.from_s,
        longest.until_s - longest.to_s
    );
    Some(Finding::note("gap", "t".to_owned(), detail))
}

/// Rows that are missing one by one, or a few at a time: where rows come evenly, longer steps are whole
/// numbers of them. What was commanded in these rows is not known.
fn lost(time_s: &[f64], median_s: f64, out: &mut Vec<Finding>) {
    let steps = || time_s.windows(2).map(|w| (w[1] - w[0]) / median_s);
    let longer: Vec<f64> =
        steps().filter(|n| *n > 1.5 && !(*n > GAP_STEPS && n * median_s > GAP_S)).collect();
    let even = longer.iter().filter(|n| (*n - n.round()).abs() < EVEN);
    if (even.count() as f64) < EVEN_SHARE * longer.len() as f64 {
        return;
    }
    let missing: f64 = longer.iter().map(|n| n.round() - 1.0).sum();
    let share = missing / (time_s.len() as f64 + missing);
    if share < LOST_SHARE.0 {
        return;
    }
    let said = if share < LOST_SHARE.1 { Finding::note } else { Finding::fatal };
    let detail = format!(
        "{missing:.0} rows are missing ({:.0} %), in {} places: what was commanded in them is not known; log every command",
        100.0 * share,
        longer.len()
    );
    out.push(said("gap", "t", detail));
}

/// How many channels go on across the gap of `step_s` after `at_s` as if no time had passed; 0 where any
/// shows that time did pass.
fn clock_jumped(run: &Run<'_>, joints: &[Channels], at_s: f64, step_s: f64) -> usize {
    let table = &run.log.table;
    let signals = joints.iter().flat_map(|j| {
        let both = [Signal::Command(j.name.clone()), Signal::Position(j.name.clone())];
        both.map(|signal| (signal, j.per_radian))
    });
    let mut jumped = 0;
    for (signal, per_radian) in signals {
        let Some(column) = table.column(&signal) else { continue };
        let known = || table.time_s().iter().zip(column).filter_map(|(&t, x)| Some((t, (*x)?)));
        let before: Vec<(f64, f64)> =
            known().filter(|(t, _)| (at_s - BESIDE_S..=at_s).contains(t)).collect();
        let end_s = at_s + step_s;
        let after: Vec<(f64, f64)> =
            known().filter(|(t, _)| (end_s..=end_s + BESIDE_S).contains(t)).collect();
        let (Some(v0), Some(v1)) = (speed(&before), speed(&after)) else { continue };
        // a steady motion on both sides, far enough to tell
        let mean = 0.5 * (v0 + v1);
        if (v0 - v1).abs() > 0.5 * mean.abs() || mean.abs() * step_s < TELLING_RAD * per_radian {
            continue;
        }
        let share = (after[0].1 - before[before.len() - 1].1) / (mean * step_s);
        if share < 0.3 {
            jumped += 1;
        } else {
            return 0;
        }
    }
    jumped
}

/// Mean speed from the first to the last of some samples.
fn speed(samples: &[(f64, f64)]) -> Option<f64> {
    let (first, last) = (samples.first()?, samples.last()?);
    (samples.len() >= 3).then(|| (last.1 - first.1) / (last.0 - first.0))
}
