//! The map from evidence to probability, by the greatest likelihood with a prior on each weight.

use caudata_gap::calibration::{
    Calibration, FEATURE_COUNT, FEATURES, Map, Thresholds, VERSION, Weights, features,
};
use caudata_gap::report::Grounds;
use serde::Serialize;

use super::{Case, Name};
use crate::case::Block;

/// Weights are normal about what rules by hand said, with one of these precisions: with that of the best score on
/// cases that were left out.
const PRECISIONS: [f64; 5] = [0.1, 0.3, 1.0, 3.0, 10.0];
/// A limit moves where cases say so by a likelihood ratio that chance gives once in twenty, nats.
const CERTAINLY: f64 = 1.92;
/// Sweeps over all weights; they are convex steps that end far earlier.
const SWEEPS: usize = 1000;
/// Parts that are left out in turn.
const PARTS: usize = 5;
/// Probabilities are scored as if no nearer to 0 or 1 than this.
const FINEST_SCORED: f64 = 0.01;
/// Bins of the calibration error.
const SCORE_BINS: usize = 10;

/// How well probabilities fit what was right.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Score {
    /// Names.
    pub names: usize,
    /// Mean −ln of the probability of what was true, nats.
    pub log_score: f64,
    /// Mean square of probability less truth.
    pub brier: f64,
    /// Mean over names of |mean probability − share right| of their bin.
    pub calibration_error: f64,
    /// Names of 0.7 or more that were wrong, and all of these.
    pub confident: (usize, usize),
}

/// Scores (probability, right).
#[must_use]
pub fn score(of: &[(f64, bool)]) -> Score {
    let n = of.len().max(1) as f64;
    let truth = |right: bool| if right { 1.0 } else { 0.0 };
    let log = |&(p, right): &(f64, bool)| {
        let p = p.clamp(FINEST_SCORED, 1.0 - FINEST_SCORED);
        if right { -p.ln() } else { -(1.0 - p).ln() }
    };
    let mut bins = [0.0; SCORE_BINS];
    for &(p, right) in of {
        bins[((p * SCORE_BINS as f64) as usize).min(SCORE_BINS - 1)] += p - truth(right);
    }
    let confident = of.iter().filter(|x| x.0 >= crate::score::outcome::CONFIDENT);
    Score {
        names: of.len(),
        log_score: of.iter().map(log).sum::<f64>() / n,
        brier: of.iter().map(|x| (x.0 - truth(x.1)).powi(2)).sum::<f64>() / n,
        calibration_error: bins.iter().map(|b| b.abs()).sum::<f64>() / n,
        confident: (confident.clone().filter(|x| !x.1).count(), confident.count()),
    }
}

/// Names whose grounds are known: what is measured for itself (lost frames) has none.
fn names(cases: &[Case]) -> impl Iterator<Item = (usize, &Name)> {
    let of = |c: &'_ Case| c.number;
    cases.iter().flat_map(move |c| {
        let grounds = |n: &&Name| n.grounds != Grounds::default();
        c.names.iter().filter(grounds).map(move |n| (of(c), n))
    })
}

/// How what the program said fits what was right.
#[must_use]
pub fn as_given(cases: &[Case]) -> Score {
    let of = names(cases).map(|(_, n)| (n.confidence, n.right));
    score(&of.collect::<Vec<_>>())
}

/// The same of `map`.
#[must_use]
pub fn as_mapped(cases: &[Case], map: &Calibration) -> Score {
    let of = names(cases).map(|(_, n)| (map.confidence(&n.grounds), n.right));
    score(&of.collect::<Vec<_>>())
}

/// Cases without one part in turn, and that part. Ten kinds of cases follow one another: whole rounds of them
/// stay together.
fn parts(cases: &[Case]) -> impl Iterator<Item = (Vec<Case>, Vec<Case>)> + '_ {
    let out = |c: &Case, part| (c.number / 10) % PARTS == part;
    (0..PARTS).map(move |part| cases.iter().cloned().partition(|c| !out(c, part)))
}

/// How maps of all parts but one fit what was right in that one.
#[must_use]
pub fn left_out(cases: &[Case], by_hand: Map) -> Score {
    let mut of = Vec::new();
    for (seen, unseen) in parts(cases) {
        let map = fit(&seen, by_hand, String::new(), 0);
        of.extend(names(&unseen).map(|(_, n)| (map.confidence(&n.grounds), n.right)));
    }
    score(&of)
}

/// Features of names, and whether they are right.
type Rows = Vec<([f64; FEATURE_COUNT], bool)>;

fn rows(cases: &[Case], doubts: &Thresholds) -> Rows {
    let of = names(cases).map(|(_, n)| (features(&n.grounds, doubts), n.right));
    of.collect()
}

/// The precision of weights with which parts that are left out are foretold best.
fn precision(cases: &[Case], by_hand: &Weights, doubts: &Thresholds) -> f64 {
    let of = |(a, b): (Vec<Case>, Vec<Case>)| (rows(&a, doubts), rows(&b, doubts));
    let parts: Vec<(Rows, Rows)> = parts(cases).map(of).collect();
    let log = |precision: f64| {
        let of = |(seen, unseen): &(Rows, Rows)| -> Vec<(f64, bool)> {
            let map = weights(seen, by_hand, precision);
            let told = unseen.iter().map(|(x, right)| (map.probability(x), *right));
            told.collect()
        };
        score(&parts.iter().flat_map(of).collect::<Vec<_>>()).log_score
    };
    let scored = PRECISIONS.map(|p| (p, log(p)));
    let best = scored.into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
    best.map_or(PRECISIONS[0], |b| b.0)
}

/// The map by `cases` of `seed`, which `command` made.
#[must_use]
pub fn fit(cases: &[Case], by_hand: Map, command: String, seed: u64) -> Calibration {
    let doubts = Thresholds {
        left: rounded(cut(left(cases).collect(), by_hand.doubts.left)),
        scatter: rounded(cut(scatter(cases).collect(), by_hand.doubts.scatter)),
    };
    let rows = rows(cases, &doubts);
    let precision = precision(cases, &by_hand.log_odds, &doubts);
    let log_odds = weights(&rows, &by_hand.log_odds, precision);
    let told = rows.iter().map(|(x, right)| (log_odds.probability(x), *right));
    let mut by_odds: Vec<(f64, bool)> = told.collect();
    by_odds.sort_by(|a, b| b.0.total_cmp(&a.0));
    let top = &by_odds[..by_odds.len().div_ceil(3)];
    let right = |of: &[(f64, bool)]| of.iter().filter(|x| x.1).count();
    Calibration {
        version: VERSION,
        command,
        seed,
        cases: cases.iter().filter(|c| c.verdict.is_some()).count() as u64,
        names: rows.len() as u64,
        right: right(&by_odds) as u64,
        surest: rounded((right(top) + 1) as f64 / (top.len() + 2) as f64),
        map: Map { log_odds, doubts },
        by_hand,
    }
}

/// What a model with names leaves, and whether they are all that was hidden.
fn left(cases: &[Case]) -> impl Iterator<Item = (f64, bool)> + '_ {
    cases.iter().filter_map(|c| {
        let first = names(std::slice::from_ref(c)).next()?.1.grounds;
        let right = c.names.iter().filter(|n| n.right).count();
        let only = right == c.names.len() && right >= c.hidden.len();
        let whole = c.block != Block::Outside && only;
        Some((first.left * first.left_share, whole))
    })
}

/// How the size of each name scatters, and whether it is right.
fn scatter(cases: &[Case]) -> impl Iterator<Item = (f64, bool)> + '_ {
    names(cases).map(|(_, n)| (n.grounds.scatter, n.right))
}

/// The constant and weights of the greatest probability, each weight of its sign.
fn weights(rows: &Rows, by_hand: &Weights, precision: f64) -> Weights {
    let (mut constant, mut w) = (by_hand.constant, by_hand.each);
    let prior = w;
    let sum =
        |row: &([f64; FEATURE_COUNT], bool)| w.iter().zip(row.0).map(|(w, x)| w * x).sum::<f64>();
    let mut odds: Vec<f64> = rows.iter().map(|r| constant + sum(r)).collect();
    let wrong_by = |odds: &[f64], k: usize| {
        1.0 / (1.0 + f64::exp(-odds[k])) - if rows[k].1 { 1.0 } else { 0.0 }
    };
    for _ in 0..SWEEPS {
        // the curvature of a log likelihood is at most a fourth of the feature's square: no step overshoots
        let slope: f64 = (0..rows.len()).map(|k| wrong_by(&odds, k)).sum();
        let step = -slope / (0.25 * rows.len() as f64).max(f64::MIN_POSITIVE);
        constant += step;
        odds.iter_mut().for_each(|o| *o += step);
        for j in 0..FEATURE_COUNT {
            let slope: f64 = (0..rows.len()).map(|k| wrong_by(&odds, k) * rows[k].0[j]).sum();
            let curvature = 0.25 * rows.iter().map(|r| r.0[j].powi(2)).sum::<f64>();
            let to = w[j] - (slope + precision * (w[j] - prior[j])) / (curvature + precision);
            let to = if to * FEATURES[j].1 > 0.0 { to } else { 0.0 };
            for (o, row) in odds.iter_mut().zip(rows) {
                *o += (to - w[j]) * row.0[j];
            }
            w[j] = to;
        }
    }
    Weights { constant: rounded(constant), each: w.map(rounded) }
}

/// From what on of (number, good) fewer are good: where to part them so that two shares, each by the rule of
/// succession, tell them best, if that certainly says more than `by_hand`.
fn cut(mut of: Vec<(f64, bool)>, by_hand: f64) -> f64 {
    of.sort_by(|a, b| a.0.total_cmp(&b.0));
    let log = |part: &[(f64, bool)]| {
        let (n, good) = (part.len() as f64, part.iter().filter(|x| x.1).count() as f64);
        let p = (good + 1.0) / (n + 2.0);
        (p, good * p.ln() + (n - good) * (1.0 - p).ln())
    };
    let at = |limit: f64| {
        let (below, above) = of.split_at(of.partition_point(|x| x.0 <= limit));
        let ((below, a), (above, b)) = (log(below), log(above));
        (below > above).then_some(a + b)
    };
    let mut best = (by_hand, at(by_hand).unwrap_or(log(&of).1) + CERTAINLY);
    for pair in of.windows(2).filter(|p| p[0].0 < p[1].0) {
        let limit = 0.5 * (pair[0].0 + pair[1].0);
        if let Some(says) = at(limit).filter(|says| *says > best.1) {
            best = (limit, says);
        }
    }
    best.0
}

/// To four decimals: nobody knows more.
fn rounded(x: f64) -> f64 {
    (1e4 * x).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(among: f64, scatter: f64, right: bool) -> Name {
        Name {
            effect: "kp_error".to_owned(),
            grounds: Grounds { among_look_alikes: among, left: 0.3, scatter, ..Grounds::default() },
            confidence: among,
            right,
        }
    }

    fn case(number: usize, block: Block, names: Vec<Name>) -> Case {
        Case {
            number,
            block,
            rig: "pendulum".to_owned(),
            hidden: vec!["kp_error 4".to_owned()],
            verdict: Some(caudata_gap::report::Verdict::Explained),
            names,
            seconds: 0.0,
            failure: String::new(),
        }
    }

    #[test]
    fn a_map_learns_what_parts_right_from_wrong_and_no_other_sign() {
        // right names do not scatter, whatever their probability among look-alikes; the sure are wrong more often
        let cases: Vec<Case> = (0..100)
            .map(|k| {
                let right = k % 4 != 0;
                let among = if right { 0.5 } else { 0.8 };
                let scatter = if right { 0.02 } else { 0.3 };
                case(k, Block::Single, vec![name(among, scatter, right)])
            })
            .collect();
        let by_hand = Map { doubts: Thresholds { left: 0.15, scatter: 0.1 }, ..Map::default() };
        let map = fit(&cases, by_hand, String::new(), 1);
        assert_eq!((map.names, map.right), (100, 75));
        assert_eq!(map.map.log_odds.each[0], 0.0);
        assert!(map.map.log_odds.each[4] < -1.0, "{map:?}");
        // wherever between 0.02 and 0.3 they are parted, it says the same
        assert_eq!(map.map.doubts.scatter, 0.1);
        assert!(map.confidence(&cases[1].names[0].grounds) > 0.9);
        assert!(map.confidence(&cases[0].names[0].grounds) < 0.4);
        let (mapped, given) = (as_mapped(&cases, &map), as_given(&cases));
        assert!(mapped.log_score < given.log_score);
        assert!(left_out(&cases, by_hand).log_score < given.log_score);
    }

    #[test]
    fn the_map_that_ships_is_what_the_kept_cases_give() {
        let shipped = Calibration::shipped().unwrap();
        let kept = include_str!("../../calibration/71011.jsonl").lines();
        let cases: Vec<Case> = kept.map(|line| serde_json::from_str(line).unwrap()).collect();
        let again = fit(&cases, shipped.by_hand, shipped.command.clone(), shipped.seed);
        assert_eq!(again, shipped);
    }

    #[test]
    fn a_probability_is_scored_by_what_was_true() {
        let sure_and_wrong = score(&[(0.9, false), (0.9, true)]);
        assert_eq!(sure_and_wrong.confident, (1, 2));
        assert!((sure_and_wrong.calibration_error - 0.4).abs() < 1e-12);
        assert!((sure_and_wrong.brier - 0.41).abs() < 1e-12);
        let log = -0.5 * (0.1_f64.ln() + 0.9_f64.ln());
        assert!((sure_and_wrong.log_score - log).abs() < 1e-12);
    }

    #[test]
    fn a_limit_stays_where_it_was_unless_cases_say_more() {
        assert_eq!(cut(vec![(0.1, true), (0.2, true)], 0.15), 0.15);
        let mut apart = vec![(0.1, true), (0.2, true), (0.4, false), (0.6, false)];
        assert_eq!(cut(apart.clone(), 0.3), 0.3);
        apart.extend([(0.2, true); 20]);
        apart.extend([(0.4, false); 20]);
        assert!((cut(apart, 0.15) - 0.3).abs() < 1e-12);
    }
}
