//! Whether what is left obeys a law: a model that has the right causes leaves what differs from run to run;
//! one in which a cause stands in for another leaves the difference of two laws, and that comes again in
//! every run.
//!
//! Motor currents say it, because they show forces where they act; what is left of angles has gone through
//! the servo's loop, and comes again for right models too. Generic terms in angle, speed and error, which
//! name nothing, are fitted to the whitened currents that are left of the runs that were fitted. What they
//! foretell of held-out runs is lawful.

use nalgebra::DVector;

use super::judge::Judge;
use super::motion::Motion;
use super::product::{dot, gram, stiffen};
use super::state::{Context, On, State};
use crate::trial::Kind;

/// Angles at which a law may bend, over the joint's range.
const KNOTS: usize = 8;
/// Weight of small weights, relative to what the terms show.
const RIDGE: f64 = 1e-3;
/// Speed over which the direction turns round, rad/s.
const TURN_RADPS: f64 = 0.05;

/// What is lawful of what is left at one joint.
#[derive(Debug, Clone, Copy)]
pub struct Lawful {
    /// Which joint.
    pub joint: usize,
    /// What is left of the currents of held-out runs, mean square in floors.
    pub left: f64,
    /// Share of that which is foretold; below 0: the law of the runs that were fitted makes it worse.
    pub share: f64,
}

/// For each joint whose current is logged.
#[must_use]
pub fn lawful(context: &Context, state: &State) -> Vec<Lawful> {
    let joints = context.replayer.model().actuated().len();
    let of = |joint| of_joint(context, state, joint);
    (0..joints).filter_map(of).collect()
}

fn of_joint(context: &Context, state: &State, joint: usize) -> Option<Lawful> {
    let (low, high) = range(&context.fit, joint)?;
    let fitted = Rows::new(&context.fit, &state.fit, joint, (low, high));
    let held = Rows::new(&context.holdout, &state.holdout, joint, (low, high));
    if fitted.left.is_empty() || held.left.is_empty() {
        return None;
    }
    Some(Lawful {
        joint,
        left: dot(&held.left, &held.left) / held.left.len() as f64,
        share: foretold(&fitted, &held)?,
    })
}

/// Share of what is left in `held` that the terms foretell with weights fitted to what is left in `fitted`;
/// none where they have no weights.
fn foretold(fitted: &Rows, held: &Rows) -> Option<f64> {
    let mut gram = gram(&fitted.terms);
    stiffen(&mut gram, RIDGE);
    let right = fitted.terms.iter().map(|t| dot(t, &fitted.left));
    let right = DVector::from_iterator(fitted.terms.len(), right);
    let weights = gram.cholesky()?.solve(&right);
    let mut after = held.left.clone();
    for (w, term) in weights.iter().zip(&held.terms) {
        for (x, t) in after.iter_mut().zip(term) {
            *x -= *w as f32 * t;
        }
    }
    let before = dot(&held.left, &held.left);
    Some(1.0 - dot(&after, &after) / before.max(1e-12))
}

/// Least and greatest angle of a joint where its current counts, rad.
fn range(judge: &Judge, joint: usize) -> Option<(f64, f64)> {
    let mut range = (f64::INFINITY, f64::NEG_INFINITY);
    for_each(judge, joint, |_, at| {
        range = (range.0.min(at.q_rad), range.1.max(at.q_rad));
    });
    (range.0 < range.1).then_some(range)
}

/// Calls `f` with the place of every sample of the joint's current.
fn for_each(judge: &Judge, joint: usize, mut f: impl FnMut(usize, &Motion)) {
    let data = &judge.data;
    for segment in &data.segments {
        let trial = &data.trials[segment.trial];
        let Some(position) = trial.channel(Kind::Position, joint) else {
            continue;
        };
        let command = trial.commands.get(joint);
        let own = |p: &&crate::replay::Piece| p.kind == Kind::Current && p.index == joint;
        for piece in segment.pieces.iter().filter(own) {
            for k in piece.range.clone() {
                f(k, &Motion::at(position, command, data.time_s[k]));
            }
        }
    }
}

/// The currents of a joint: what is left of them, and the terms of a law, whitened alike.
struct Rows {
    left: Vec<f32>,
    terms: Vec<Vec<f32>>,
}

impl Rows {
    fn new(judge: &Judge, on: &On, joint: usize, range: (f64, f64)) -> Self {
        let mut places = Vec::new();
        let mut values: Vec<Vec<f64>> = Vec::new();
        for_each(judge, joint, |k, at| {
            places.push(k);
            values.push(terms(at, range));
        });
        let count = values.first().map_or(0, Vec::len);
        let of = |whole: &[f32]| places.iter().map(|&k| whole[k]).collect();
        Self {
            left: of(&on.residual),
            terms: (0..count)
                .map(|i| {
                    let mut term = vec![0.0_f32; judge.data.len()];
                    for (&k, v) in places.iter().zip(&values) {
                        term[k] = v[i] as f32;
                    }
                    of(&judge.whitened(term))
                })
                .collect(),
        }
    }
}

/// The terms at one sample, A each.
fn terms(at: &Motion, (low, high): (f64, f64)) -> Vec<f64> {
    let direction = (at.qd_radps / TURN_RADPS).clamp(-1.0, 1.0);
    let place = ((at.q_rad - low) / (high - low)).clamp(0.0, 1.0) * (KNOTS - 1) as f64;
    let hat = |k: usize| (1.0 - (place - k as f64).abs()).max(0.0);
    let mut out: Vec<f64> = (0..KNOTS).map(hat).collect();
    out.extend((0..KNOTS).map(|k| hat(k) * direction));
    out.extend([
        at.qd_radps,
        at.qd_radps * at.qd_radps.abs(),
        at.error_rad,
        at.error_rad * at.error_rad.abs(),
        at.error_rad.abs() * direction,
    ]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(left: &[f32], term: &[f32]) -> Rows {
        Rows {
            left: left.to_vec(),
            terms: vec![term.to_vec()],
        }
    }

    #[test]
    fn what_comes_again_is_foretold_and_what_differs_is_made_worse() {
        let fitted = rows(&[2.0, -2.0, 4.0], &[1.0, -1.0, 2.0]);
        // twice the term in both: all of it, but for the ridge's part in a thousand of the weight, squared
        let again = foretold(&fitted, &rows(&[6.0, 2.0], &[3.0, 1.0])).unwrap();
        assert!((again - 1.0).abs() < 1e-5, "{again}");
        // the same way by half as much: (1 − (2 − 1)²/1²) = 0; the other way: 1 − (−1 − 2)²/1² = −8
        let half = foretold(&fitted, &rows(&[3.0, 1.0], &[3.0, 1.0])).unwrap();
        assert!(half.abs() < 5e-3, "{half}");
        let turned = foretold(&fitted, &rows(&[-3.0, -1.0], &[3.0, 1.0])).unwrap();
        assert!((turned + 8.0).abs() < 2e-2, "{turned}");
    }

    #[test]
    fn a_spring_a_drag_and_a_rub_are_among_the_terms() {
        // a joint that goes from −1 to 1 rad: at 0.2 rad, 7 knots' widths of 2/7 rad, place (0.2 + 1)/2·7 =
        // 4.2, so 0.8 of knot 4 and 0.2 of knot 5
        let at = Motion {
            q_rad: 0.2,
            qd_radps: -3.0,
            error_rad: 0.5,
        };
        let t = terms(&at, (-1.0, 1.0));
        assert_eq!(t.len(), 2 * KNOTS + 5);
        assert!((t[4] - 0.8).abs() < 1e-12 && (t[5] - 0.2).abs() < 1e-12);
        // backwards: the same with the other sign
        assert!((t[KNOTS + 4] + 0.8).abs() < 1e-12 && (t[KNOTS + 5] + 0.2).abs() < 1e-12);
        assert_eq!(t[2 * KNOTS..], [-3.0, -9.0, 0.5, 0.25, -0.5]);
    }
}
