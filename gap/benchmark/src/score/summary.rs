//! All cases of a run: the table of the protocol (GAP.md 4.3).

use std::fmt::Display;

use caudata_gap::check::series::median;
use serde::Serialize;

use super::outcome::{CONFIDENT, Judged, Outcome};
use super::wilson::Rate;
use crate::case::Block;

/// The steps of size, d.
pub const LADDER: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 8.0];
/// Id of play at the girdles, and how well it must be found: half a degree, rad.
const PLAY: &str = "girdle_play";
const PLAY_WITHIN_RAD: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// Pairs that make up for each other down to less than this, d, need not be seen.
const VISIBLE: f64 = 2.0;
/// Bins of the reliability diagram.
const BINS: usize = 5;

/// One bin of the reliability diagram.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Bin {
    /// Names in it.
    pub names: usize,
    /// Their mean confidence.
    pub confidence: f64,
    /// Share of them that are right.
    pub right: f64,
}

/// One step of the ladder.
#[derive(Clone, Debug, Serialize)]
pub struct AtSize {
    /// d.
    pub d: f64,
    /// Seen that something is off.
    pub detected: Rate,
    /// First name right.
    pub first: Rate,
}

/// What a set of cases shows.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Cases.
    pub cases: usize,
    /// Diagnoses that ended with an error.
    pub failed: usize,
    /// Nulls with any name, or any gap.
    pub false_alarms: Rate,
    /// Nulls on which a gap was reported without a name.
    pub null_gaps: Rate,
    /// Decoys in which physics was named.
    pub decoys_named: Rate,
    /// Faults of the data that were called by their kind of verdict.
    pub faults_found: Rate,
    /// Singles by size.
    pub by_size: Vec<AtSize>,
    /// First name right at d ≥ 4 (down to 3: sizes are met within a third).
    pub first_large: Rate,
    /// Among the first three at d ≥ 2.
    pub in_three: Rate,
    /// Layer right at d ≥ 2, of those where something was named.
    pub layer: Rate,
    /// Joint right at d ≥ 2, of those named right.
    pub joint: Rate,
    /// Answer set holds the truth, of singles in which something was named.
    pub coverage: Rate,
    /// Mean size of the first answer set.
    pub set_size: f64,
    /// Median and ninetieth percentile of the parameter's relative error at d ≥ 4.
    pub parameter_error: (f64, f64),
    /// Intervals that hold the truth.
    pub interval: Rate,
    /// Pairs with both named.
    pub pairs_both: Rate,
    /// Pairs with at least one.
    pub pairs_one: Rate,
    /// The same of pairs that are at least [`VISIBLE`] together.
    pub pairs_one_visible: Rate,
    /// Wrong names per case (nulls, singles, pairs).
    pub wrong_per_case: f64,
    /// Leads, which are no findings, that were true, and that were not, in the same cases.
    pub leads: (usize, usize),
    /// Wrong names per single.
    pub wrong_per_single: f64,
    /// Laws outside the catalogue that were flagged.
    pub outside_flagged: Rate,
    /// … that got a wrong name with confidence.
    pub outside_wrong: Rate,
    /// Starved cases answered as ambiguous or insufficient (or right).
    pub starved: Rate,
    /// Changes of the robot before the hold-out that were not sold as a cause.
    pub holdout_change: Rate,
    /// Salamander on the ground: first name right.
    pub ground: Rate,
    /// Salamander in water: first name right.
    pub water: Rate,
    /// Play at a girdle: found at the right hinge within half a degree.
    pub play: Rate,
    /// Expected calibration error of confidences.
    pub calibration_error: f64,
    /// Reliability diagram.
    pub reliability: Vec<Bin>,
    /// Next experiments that separate the truth from a rival.
    pub next_helps: Rate,
    /// Mean wall time, s, and the longest.
    pub seconds: (f64, f64),
}

impl Summary {
    /// Summarises all outcomes.
    pub fn of(all: &[Outcome]) -> Self {
        let block = |b: Block| move |o: &Outcome| o.block == b;
        let named = |o: &Outcome| !o.given.is_empty();
        let fault = |o: &Outcome| {
            o.block == Block::Decoy
                && crate::decoy::Decoy::ALL.iter().any(|x| x.name() == o.decoy && x.is_fault())
        };
        let true_names: Vec<&Judged> = all
            .iter()
            .filter(|o| single(o) || o.block == Block::Pair)
            .flat_map(|o| &o.truth)
            .collect();
        let intervals: Vec<bool> = true_names.iter().filter_map(|t| t.interval_holds).collect();
        let counted = |o: &&Outcome| matches!(o.block, Block::Null | Block::Single | Block::Pair);
        let counted: Vec<&Outcome> = all.iter().filter(counted).collect();
        let of = |which: &dyn Fn(&Outcome) -> bool, x: &dyn Fn(&Outcome) -> f64| {
            let mine = all.iter().filter(|o| which(o));
            mean(&mine.map(x).collect::<Vec<_>>())
        };
        let (calibration_error, reliability) = calibration(all);
        let seconds: Vec<f64> = all.iter().map(|o| o.seconds).collect();
        Self {
            cases: all.len(),
            failed: all.iter().filter(|o| o.verdict.is_empty()).count(),
            false_alarms: Rate::count(all, block(Block::Null), named),
            null_gaps: Rate::count(all, block(Block::Null), |o| o.detected && !named(o)),
            decoys_named: Rate::count(all, |o| o.block == Block::Decoy, named),
            faults_found: Rate::count(all, fault, |o| o.right),
            by_size: LADDER.map(|step| at_size(all, step)).to_vec(),
            first_large: Rate::count(all, |o| single(o) && d(o) >= 3.0, first),
            in_three: Rate::count(all, |o| single(o) && d(o) >= 1.5, |o| o.truth[0].in_three),
            layer: Rate::count(
                all,
                |o| single(o) && d(o) >= 1.5 && named(o),
                |o| o.truth[0].layer_right,
            ),
            joint: Rate::count(
                all,
                |o| single(o) && d(o) >= 1.5 && o.truth[0].joint_right.is_some(),
                |o| o.truth[0].joint_right == Some(true),
            ),
            coverage: Rate::count(all, |o| single(o) && named(o), |o| o.truth[0].in_set),
            set_size: of(&|o| single(o) && named(o), &|o| o.set_size as f64),
            parameter_error: parameter_error(&true_names),
            interval: Rate::new(intervals.iter().filter(|x| **x).count(), intervals.len()),
            pairs_both: Rate::count(all, block(Block::Pair), |o| o.truth.iter().all(|t| t.named)),
            pairs_one: Rate::count(all, block(Block::Pair), |o| o.truth.iter().any(|t| t.named)),
            pairs_one_visible: Rate::count(
                all,
                |o| o.block == Block::Pair && o.together_d >= VISIBLE,
                |o| o.truth.iter().any(|t| t.named),
            ),
            wrong_per_case: mean(&counted.iter().map(|o| o.wrong as f64).collect::<Vec<_>>()),
            leads: counted
                .iter()
                .fold((0, 0), |(right, wrong), o| (right + o.leads.0, wrong + o.leads.1)),
            wrong_per_single: of(&single, &|o| o.wrong as f64),
            outside_flagged: Rate::count(all, block(Block::Outside), |o| o.right),
            outside_wrong: Rate::count(all, block(Block::Outside), |o| {
                o.wrong_confidence >= CONFIDENT
            }),
            starved: Rate::count(all, block(Block::Starved), |o| o.right),
            holdout_change: Rate::count(all, block(Block::HoldoutChange), |o| o.right),
            ground: Rate::count(all, block(Block::Ground), first),
            water: Rate::count(all, block(Block::Water), first),
            play: play(all),
            calibration_error,
            reliability,
            next_helps: Rate::count(
                all,
                |o| o.next_helps.is_some(),
                |o| o.next_helps == Some(true),
            ),
            seconds: (mean(&seconds), seconds.iter().copied().fold(0.0, f64::max)),
        }
    }

    /// Rows for people: measure, what it came to, what is owed.
    pub fn rows(&self) -> Vec<Row> {
        let percent = |x: f64| format!("{:.1} %", 100.0 * x);
        let mut rows = vec![
            row("false alarms on nulls (any name)", &self.false_alarms, "<= 5 %, upper bound"),
            row("nulls with a gap but no name", &self.null_gaps, ""),
            row("decoys named as physics", &self.decoys_named, "<= 5 %"),
            row("data faults called so", &self.faults_found, ""),
        ];
        for step in &self.by_size {
            let owed = match step.d {
                1.0 => "40 %",
                2.0 => "85 %; name 65 %",
                4.0 => "98 %; name 85 %",
                _ => "",
            };
            rows.push(row(&format!("seen at d = {}", step.d), &step.detected, owed));
            rows.push(row(&format!("first name right at d = {}", step.d), &step.first, ""));
        }
        let (median, ninety) = self.parameter_error;
        let errors = format!("{}, {}", percent(median), percent(ninety));
        rows.extend([
            row("first name right, d >= 4", &self.first_large, "85 %"),
            row("among the first three, d >= 2", &self.in_three, "90 %"),
            row("layer right, d >= 2", &self.layer, "93 %"),
            row("joint right, d >= 2", &self.joint, "90 %"),
            row("answer set holds the truth", &self.coverage, "92-98 %"),
            row("size of the answer set, mean", &format!("{:.2}", self.set_size), "<= 2"),
            row("parameter error, median and 90 %, d >= 4", &errors, "10 %, 30 %"),
            row("95 % intervals that hold the truth", &self.interval, "88-98 %"),
            row("pairs: both named", &self.pairs_both, "70 %"),
            row("pairs: at least one", &self.pairs_one, "97 %"),
            row("the same, pairs of d >= 2 together", &self.pairs_one_visible, ""),
            row("wrong names per case", &format!("{:.3}", self.wrong_per_case), "<= 0.10"),
        ]);
        rows.extend(self.rows_of_blocks());
        rows
    }

    /// Those of single blocks, and of all cases together.
    fn rows_of_blocks(&self) -> Vec<Row> {
        let leads = format!("{}, {}", self.leads.0, self.leads.1);
        let seconds = format!("{:.1}, {:.1}", self.seconds.0, self.seconds.1);
        vec![
            row("leads in the same cases: true, not true", &leads, ""),
            row("outside the catalogue: flagged", &self.outside_flagged, "80 %"),
            row("outside the catalogue: confident wrong name", &self.outside_wrong, "<= 10 %"),
            row("starved: ambiguous, insufficient or right", &self.starved, ""),
            row("change before the hold-out not sold as a cause", &self.holdout_change, ""),
            row("on the ground: first name right", &self.ground, ""),
            row("in water: first name right", &self.water, ""),
            row("girdle play: right hinge, within 0.5 deg", &self.play, "found"),
            row("expected calibration error", &format!("{:.3}", self.calibration_error), "<= 0.07"),
            row("next experiment separates the truth", &self.next_helps, "70 %"),
            row("seconds per case, mean and longest", &seconds, ""),
            row("diagnoses that failed", &self.failed, "0"),
        ]
    }
}

/// Median error on held-out runs after over before, singles of d ≥ 3; a diagnosis that changes nothing counts
/// as 1.
pub fn median_gain(all: &[Outcome]) -> f64 {
    let large =
        |o: &&Outcome| o.block == Block::Single && o.truth.first().is_some_and(|t| t.d >= 3.0);
    let ratios: Vec<f64> = all.iter().filter(large).map(|o| o.gain_ratio.unwrap_or(1.0)).collect();
    median(ratios).unwrap_or(f64::NAN)
}

/// Measure, what it came to, what is owed.
type Row = (String, String, &'static str);

fn row(what: &str, value: &dyn Display, owed: &'static str) -> Row {
    (what.to_owned(), value.to_string(), owed)
}

fn single(o: &Outcome) -> bool {
    o.block == Block::Single
}

/// Whether the first name is right.
fn first(o: &Outcome) -> bool {
    o.truth.first().is_some_and(|t| t.first)
}

/// Size of what is hidden first.
fn d(o: &Outcome) -> f64 {
    o.truth.first().map_or(0.0, |t| t.d)
}

/// Singles of about this size.
fn at_size(all: &[Outcome], step: f64) -> AtSize {
    let here = |o: &Outcome| single(o) && (d(o) / step).ln().abs() < 0.347;
    AtSize {
        d: step,
        detected: Rate::count(all, here, |o| o.detected),
        first: Rate::count(all, here, first),
    }
}

/// Median and ninetieth percentile at d ≥ 4 (down to 3).
fn parameter_error(names: &[&Judged]) -> (f64, f64) {
    let large = names.iter().filter(|t| t.d >= 3.0);
    let mut errors: Vec<f64> = large.filter_map(|t| t.parameter_error).collect();
    errors.sort_by(f64::total_cmp);
    let at = |q: f64| {
        let k = ((errors.len() as f64 * q) as usize).min(errors.len().saturating_sub(1));
        errors.get(k).copied().unwrap_or(f64::NAN)
    };
    (at(0.5), at(0.9))
}

/// Play that was found at the right hinge and nearly right.
fn play(all: &[Outcome]) -> Rate {
    let has = |o: &Outcome| o.block == Block::Ground && o.truth.iter().any(|t| t.effect == PLAY);
    let right = |t: &Judged| {
        t.effect == PLAY
            && t.joint_right == Some(true)
            && t.absolute_error.is_some_and(|e| e <= PLAY_WITHIN_RAD)
    };
    Rate::count(all, has, |o| o.truth.iter().any(right))
}

fn mean(x: &[f64]) -> f64 {
    if x.is_empty() { 0.0 } else { x.iter().sum::<f64>() / x.len() as f64 }
}

/// Expected calibration error and the bins behind it, over every name that was given.
fn calibration(all: &[Outcome]) -> (f64, Vec<Bin>) {
    let mut bins = [(0usize, 0.0, 0.0); BINS];
    let mut total = 0.0;
    for &(confidence, right) in
        all.iter().filter(|o| o.block != Block::HoldoutChange).flat_map(|o| &o.confidences)
    {
        let b = ((confidence * BINS as f64) as usize).min(BINS - 1);
        bins[b].0 += 1;
        bins[b].1 += confidence;
        bins[b].2 += f64::from(u8::from(right));
        total += 1.0;
    }
    let mut error = 0.0;
    let bins: Vec<Bin> = bins
        .iter()
        .map(|&(n, c, r)| {
            let per = 1.0 / f64::max(n as f64, 1.0);
            error += n as f64 / f64::max(total, 1.0) * (c * per - r * per).abs();
            Bin { names: n, confidence: c * per, right: r * per }
        })
        .collect();
    (error, bins)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(block: Block, given: &[&str], truth: Vec<Judged>) -> Outcome {
        Outcome {
            case: "c".into(),
            block,
            rig: "pendulum".into(),
            decoy: String::new(),
            verdict: "explained".into(),
            given: given.iter().map(|g| ((*g).to_owned(), String::new(), 0.9)).collect(),
            detected: !given.is_empty(),
            together_d: 0.0,
            wrong: given.len() - truth.iter().filter(|t| t.named).count(),
            leads: (0, 0),
            wrong_confidence: 0.0,
            confidences: given
                .iter()
                .enumerate()
                .map(|(i, _)| (0.9, truth.get(i).is_some_and(|t| t.named)))
                .collect(),
            set_size: 1,
            right: false,
            gain_ratio: None,
            next_helps: None,
            truth,
            seconds: 1.0,
            failure: String::new(),
        }
    }

    #[test]
    fn counts_what_it_says() {
        let hit = Judged {
            d: 4.2,
            first: true,
            named: true,
            in_three: true,
            in_set: true,
            ..Judged::default()
        };
        let miss = Judged { d: 3.8, ..Judged::default() };
        let all = [
            outcome(Block::Null, &[], vec![]),
            outcome(Block::Null, &["kp_error"], vec![]),
            outcome(Block::Single, &["armature"], vec![hit]),
            outcome(Block::Single, &[], vec![miss]),
        ];
        let s = Summary::of(&all);
        assert_eq!((s.false_alarms.hits, s.false_alarms.of), (1, 2));
        assert_eq!((s.first_large.hits, s.first_large.of), (1, 2));
        assert_eq!((s.by_size[3].detected.hits, s.by_size[3].detected.of), (1, 2));
        assert_eq!(s.by_size[2].detected.of, 0);
        // one wrong name in four cases
        assert!((s.wrong_per_case - 0.25).abs() < 1e-12);
        // two names at 0.9, one right: |0.9 − 0.5|
        assert!((s.calibration_error - 0.4).abs() < 1e-12);
    }
}
