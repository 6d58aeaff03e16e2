//! What speaks against a model although each of its causes passed every gate: something is missing, and what was found may stand in for it.

use super::gates;
use super::lawful::{Lawful, lawful};
use super::state::{Context, State};
use crate::effects::{Domain, Place};
use crate::replay::Term;

/// Misfit that an explained gap may leave in any case (of many joints: [`gates::quiet`]), …
const LEFT: f64 = 0.5;
/// … and, where it is more, its product with its share of the misfit before: 1.2 floors of ten, half a floor of 1.7. Of the benchmark's causes the right ones
/// leave less (their laws are not quite nature's), wrong ones more.
const LEFT_OF_SHARE: f64 = 0.15;
/// Share of what is left of a joint's current that a law may foretell, where more is left of it than careful labs have ([`gates::quiet`]): right names of the
/// benchmark (bench rigs) have up to 0.10, the drag of a sail that is called viscous friction 0.34 and 0.63, a spring that hardens and is called a spring and
/// ripple 0.91; but a cable that rubs and is called friction 0.19.
const LAWFUL_SHARE: f64 = 0.2;

/// Doubts about a model.
pub struct Doubts<'a> {
    /// Much is left.
    pub much: bool,
    /// Effects that would have to be larger than they can plausibly be.
    pub outgrown: Vec<&'a Term>,
    /// Joints where what is left obeys a law.
    pub lawful: Vec<Lawful>,
}

impl<'a> Doubts<'a> {
    /// About `best`.
    pub fn about(context: &Context, base: &State, best: &'a State) -> Self {
        let quiet = gates::quiet(context);
        let a_law = |l: &Lawful| l.share > LAWFUL_SHARE && l.left > quiet;
        // what the runs that were fitted say of themselves is no foretelling
        let nothing_to_ask = best.terms.is_empty() || context.same_runs;
        Self {
            much: much_is_left(context, base, best),
            outgrown: best.terms.iter().filter(|t| outgrown(context, t)).collect(),
            lawful: if nothing_to_ask {
                Vec::new()
            } else {
                lawful(context, best).into_iter().filter(a_law).collect()
            },
        }
    }

    /// Whether there are any.
    pub fn any(&self) -> bool {
        self.much || !self.outgrown.is_empty() || !self.lawful.is_empty()
    }

    /// Each in a sentence of its own, with a space before it, but for what is much: that is a figure of the summary.
    pub fn in_words(&self, context: &Context) -> String {
        let beyond: Vec<String> = (self.outgrown.iter())
            .map(|t| t.place.label(t.effect.id))
            .collect();
        let mut words = match beyond.as_slice() {
            [] => String::new(),
            [one] => format!(
                " As large as it would have to be, {one} is not plausible: something that is not in the catalogue may be behind it."
            ),
            more => format!(
                " As large as they would have to be, {} are not plausible: something that is not in the catalogue may be behind them.",
                more.join(" and ")
            ),
        };
        let names = context.replayer.model().actuated_names();
        for l in &self.lawful {
            words.push_str(&format!(
                " What is left of the current of {} obeys a law that no cause here has: functions of angle, speed and error that were fitted to it foretell {:.0} % of it in held-out runs.",
                names[l.joint],
                100.0 * l.share
            ));
        }
        words
    }

    /// Whether they are about a cause at `place`: what is missing elsewhere does not make it less sure.
    pub fn concern(&self, place: &Place) -> bool {
        self.much
            || self.outgrown.iter().any(|t| meet(&t.place, place))
            || self.lawful.iter().any(|l| acts_on(place, l.joint))
    }
}

/// Whether a model leaves more than is known of the floor, of the runs that it was fitted to or of held-out ones, where it is most.
pub fn much_is_left(context: &Context, base: &State, best: &State) -> bool {
    let allowed = LEFT.max(gates::quiet(context));
    let parts = [
        (&context.fit, &base.fit, &best.fit),
        (&context.holdout, &base.holdout, &best.holdout),
    ];
    parts.into_iter().any(|(judge, before, after)| {
        let of = |on| gates::worst_of(context, &[(judge, on)]);
        let (before, after) = (of(before), of(after));
        after > allowed && after * after / f64::max(before, 1e-9) > LEFT_OF_SHARE
    })
}

/// Whether a term's size (its first parameter) wants to be larger than it can plausibly be: it stands in for something else, and what acts at the same place
/// makes up for where it differs.
fn outgrown(context: &Context, term: &Term) -> bool {
    let model = context.replayer.model();
    (term.effect).at_bound(model, &term.place, 0, term.values[0])
}

/// Whether two effects act at one joint (link, foot, hinge), or on what cannot be told apart so: a link and a joint, the whole robot and a part of it.
fn meet(one: &Place, other: &Place) -> bool {
    let whole = |p: &Place| p.items.is_empty();
    one.domain != other.domain
        || whole(one)
        || whole(other)
        || one.items.iter().any(|i| other.items.contains(i))
}

/// Whether an effect at `place` may act on a joint.
fn acts_on(place: &Place, joint: usize) -> bool {
    place.domain != Domain::Joints || place.items.is_empty() || place.items.contains(&joint)
}
