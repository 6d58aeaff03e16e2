//! What speaks against a model although each of its causes passed every gate: something is missing, and what
//! was found may stand in for it.

use super::constancy::{self, Scatter};
use super::gates;
use super::judge::Judge;
use super::levels::MANY_JOINTS;
use super::product::dot;
use super::state::{Context, Derivatives, On, State};
use crate::effects::{Effect, Place};
use crate::error::GapError;
use crate::replay::{Term, Variant};
use crate::report::{Doubt, DoubtKind, Grounds};

/// Two effects that together do less than this share of what either does alone take each other back.
const TAKEN_BACK: f64 = 0.5;

/// What a model leaves, where it is most, floors.
pub struct Left {
    /// Whether these are held-out runs, and not those that it was fitted to.
    held_out: bool,
    before: f64,
    after: f64,
}

impl Left {
    fn grounds(&self, context: &Context) -> Grounds {
        Grounds {
            left: self.after,
            left_share: self.after / self.before.max(1e-9),
            little_left: self.after <= gates::quiet(context),
            ..Grounds::default()
        }
    }
}

/// What is doubtful about a model.
pub struct Doubts {
    /// What is left, of held-out runs first.
    left: Vec<Left>,
    /// Which of that is much.
    much: Option<usize>,
    /// Effects that would have to be larger, or otherwise, than they can plausibly be.
    outgrown: Vec<Term>,
    /// Every two effects of which each takes back nearly all that the other does.
    cancelling: Vec<[Term; 2]>,
    /// By how much the size of each name differs between parts of the data.
    scatter: Vec<(Scatter, Term)>,
    /// From what on it has no size.
    inconstant: f64,
}

impl Doubts {
    /// About `best`, of which `findings`, with their derivatives, is what is told: a size is asked for where no lead
    /// makes up for what its law lacks.
    ///
    /// # Errors
    /// As [`crate::replay::Replayer::predict`].
    pub fn about(
        context: &Context,
        base: &State,
        best: &State,
        (findings, derivatives): (&State, &Derivatives),
    ) -> Result<Self, GapError> {
        let thresholds = &context.calibration.map.doubts;
        let left = left(context, base, best);
        let much = |l: &Left| thresholds.much(&l.grounds(context));
        let all: Vec<usize> = (0..findings.terms.len()).collect();
        let scatter = constancy::scatter(context, findings, derivatives, &all);
        let too_large = |t: &&Term| outgrown(context, t);
        let with_term = |s: Scatter| {
            let term = findings.terms[s.term].clone();
            (s, term)
        };
        Ok(Self {
            much: left.iter().position(much),
            left,
            outgrown: findings.terms.iter().filter(too_large).cloned().collect(),
            cancelling: cancelling(context, findings)?,
            scatter: scatter.into_iter().map(with_term).collect(),
            inconstant: thresholds.scatter,
        })
    }

    /// Whether there are any.
    pub fn any(&self) -> bool {
        self.much.is_some()
            || !self.outgrown.is_empty()
            || !self.cancelling.is_empty()
            || self.inconstant().next().is_some()
    }

    /// Whether another effect takes back what `term` does.
    pub fn is_taken_back(&self, term: &Term) -> bool {
        self.cancelling.iter().flatten().any(|t| t.same(term))
    }

    fn inconstant(&self) -> impl Iterator<Item = &(Scatter, Term)> {
        (self.scatter.iter()).filter(|(s, _)| s.share > self.inconstant)
    }

    /// What of it concerns a cause at `place`.
    pub fn grounds(&self, context: &Context, place: &Place) -> Grounds {
        let near =
            |(s, t): &(Scatter, Term)| one_place(context, &t.place, place).then_some(s.share);
        // where much is left, that part of the runs; else the one with most
        let worst = self.much.and_then(|k| self.left.get(k));
        let worst = worst.or_else(|| self.left.iter().max_by(|a, b| a.after.total_cmp(&b.after)));
        Grounds {
            scatter: self.scatter.iter().filter_map(near).fold(0.0, f64::max),
            at_bound: self.outgrown.iter().any(|t| meet(&t.place, place)),
            ..worst.map_or_else(Grounds::default, |l| l.grounds(context))
        }
    }

    /// Each for the report.
    pub fn listed(&self) -> Vec<Doubt> {
        let much = self.much.and_then(|k| self.left.get(k));
        let much = much.into_iter().map(|l| Doubt {
            kind: DoubtKind::MuchLeft,
            location: String::new(),
            detail: format!(
                "Of {} {:.2} floors are left at the worst joint; before, the worst had {:.2}.",
                if l.held_out { "held-out runs" } else { "the runs that were fitted" },
                l.after,
                l.before
            ),
        });
        let outgrown = self.outgrown.iter().map(|t| {
            let label = t.label();
            Doubt {
                kind: DoubtKind::ImplausibleSize,
                detail: format!("What {label} would have to be lies at the end of what is plausible: something that is not in the catalogue may be behind it."),
                location: label,
            }
        });
        let cancelling = self.cancelling.iter().map(|pair| {
            let [one, other] = pair.each_ref().map(Term::label);
            Doubt {
                kind: DoubtKind::Cancelling,
                detail: format!("{one} and {other} take back nearly all that either does: a law that is not in the catalogue may be behind both."),
                location: format!("{one} + {other}"),
            }
        });
        let inconstant = self.inconstant().map(|(s, t)| {
            let label = t.label();
            let least = s.sizes.iter().copied().fold(f64::INFINITY, f64::min);
            let most = s.sizes.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            Doubt {
                kind: DoubtKind::InconstantSize,
                detail: format!(
                    "{} the data ask for {least:.2} to {most:.2} times as much of {label} as was found: a law that is not in the catalogue may be behind it.",
                    capitalised(s.along.name()),
                ),
                location: label,
            }
        });
        much.chain(outgrown).chain(cancelling).chain(inconstant).collect()
    }
}

/// With a capital.
fn capitalised(words: &str) -> String {
    let mut letters = words.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}

/// What `best` leaves, and `base` has, of held-out runs and of those that were fitted, where it is most.
fn left(context: &Context, base: &State, best: &State) -> Vec<Left> {
    let parts = [
        (true, &context.holdout, &base.holdout, &best.holdout),
        (false, &context.fit, &base.fit, &best.fit),
    ];
    // without a hold-out they are the same runs
    let parts = &parts[usize::from(context.same_runs)..];
    let of = |&(held_out, judge, before, after): &(bool, &Judge, &On, &On)| {
        let of = |on| gates::worst_of(context, &[(judge, on)]);
        Left { held_out, before: of(before), after: of(after) }
    };
    parts.iter().map(of).collect()
}

/// Every two terms of `state` at one place that together do far less than either of them ([`TAKEN_BACK`]). Causes that
/// are there by chance seldom do: a spring and a lighter link that cancel to first order are what is left of a law
/// of higher order, a spring that hardens.
fn cancelling(context: &Context, state: &State) -> Result<Vec<[Term; 2]>, GapError> {
    let terms = &state.terms;
    let near = |&(i, j): &(usize, usize)| one_place(context, &terms[i].place, &terms[j].place);
    let pairs = (0..terms.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let pairs: Vec<(usize, usize)> = pairs.filter(near).collect();
    let without = |gone: &[usize]| -> Variant {
        let kept = terms.iter().enumerate().filter(|(k, _)| !gone.contains(k));
        kept.map(|(_, t)| t.clone()).collect()
    };
    let mut variants: Vec<Variant> = (0..terms.len()).map(|k| without(&[k])).collect();
    variants.extend(pairs.iter().map(|&(i, j)| without(&[i, j])));
    let does = |prediction: &Vec<f32>| {
        let change = context.fit.change(&state.fit.prediction, prediction);
        dot(&change, &change)
    };
    let predictions = context.replayer.predict(&context.fit.data, &variants)?;
    let squares: Vec<f64> = predictions.iter().map(does).collect();
    let (alone, together) = squares.split_at(terms.len());
    let taken_back = |&(&(i, j), both): &(&(usize, usize), &f64)| {
        *both < TAKEN_BACK.powi(2) * alone[i].min(alone[j])
    };
    let found = pairs.iter().zip(together).filter(taken_back);
    Ok(found.map(|(&(i, j), _)| [terms[i].clone(), terms[j].clone()]).collect())
}

/// Whether a term's size wants to be larger than it can plausibly be: it stands in for something else, and
/// what acts at the same place makes up for where it differs. The same goes for what else its law counts, a
/// speed at which friction bends, a number of ripples in a turn.
pub fn outgrown(context: &Context, term: &Term) -> bool {
    (0..term.values.len()).any(|p| term.at_bound(context.replayer.model(), p))
}

/// Parameters of an effect that say how large it is: the first, and those of the same unit (a centre of mass
/// has three).
pub fn sizes(effect: &Effect) -> impl Iterator<Item = usize> + '_ {
    let unit = |p: usize| effect.parameters[p].unit;
    (0..effect.parameters.len())
        .filter(move |&p| p == 0 || (!unit(0).is_empty() && unit(p) == unit(0)))
}

/// Whether two effects act at one joint (link, foot, hinge), or on what cannot be told apart so: a link and a
/// joint, the whole robot and a part of it.
pub fn meet(one: &Place, other: &Place) -> bool {
    let whole = |p: &Place| p.items.is_empty();
    one.domain != other.domain
        || whole(one)
        || whole(other)
        || one.items.iter().any(|i| other.items.contains(i))
}

/// Whether what is wrong with an effect at one place may be made up for by one at the other: of many joints a
/// link's mass and another joint's gain have nothing to do with each other.
pub fn one_place(context: &Context, one: &Place, other: &Place) -> bool {
    (few_joints(context) || one.domain == other.domain) && meet(one, other)
}

fn few_joints(context: &Context) -> bool {
    context.replayer.model().actuated().len() < MANY_JOINTS
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::effects::{self, Domain};

    fn at(domain: Domain, items: &[usize]) -> Place {
        Place { domain, items: items.to_vec(), names: items.iter().map(usize::to_string).collect() }
    }

    #[test]
    fn what_is_missing_elsewhere_does_not_make_a_cause_less_sure() {
        let knee = at(Domain::Joints, &[3]);
        assert!(!meet(&knee, &at(Domain::Joints, &[4])));
        assert!(meet(&knee, &at(Domain::Joints, &[2, 3])));
        // all joints, the whole robot, a link that the joint may carry
        assert!(meet(&knee, &at(Domain::Joints, &[0, 1, 2, 3])));
        assert!(meet(&at(Domain::Robot, &[]), &knee));
        assert!(meet(&at(Domain::Links, &[7]), &knee));
        assert!(!meet(&at(Domain::Links, &[7]), &at(Domain::Links, &[8])));
    }

    #[test]
    fn what_says_how_large_an_effect_is_has_the_unit_of_its_first_parameter() {
        let of = |id: &str| sizes(effects::find(id).unwrap()).collect::<Vec<_>>();
        assert_eq!(of("link_com"), [0, 1, 2]);
        // two amplitudes, and how many there are in a turn
        assert_eq!(of("cogging"), [0, 1]);
        // two changes, and a time
        assert_eq!(of("friction_drift"), [0, 1]);
        // a mass, and where it is
        assert_eq!(of("payload"), [0]);
        // of shares without a unit only the first
        assert_eq!(of("drive_asymmetry"), [0]);
    }
}
