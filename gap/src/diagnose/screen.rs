//! Screening: what would each effect at each place explain of what is left, by its traces at a grid of sizes.
//!
//! One trace per size serves for all places of a joint effect at once: all joints get it together, and each
//! joint's channels are judged on their own. (Joints of a held robot hardly move each other; whoever passes
//! is fitted in earnest afterwards.) Gears do: behind a soft shoulder an arm falls about, and nothing is seen of its
//! elbow. So of a held robot's joints every few along a branch have one together. So do links of different branches
//! of a held robot, and a trace serves for all models that are compared.

use std::collections::BTreeMap;
use std::ops::Range;

use caudata_model::RobotModel;
use caudata_runlog::BaseHold;

use super::judge::Judge;
use super::product::dot;
use super::state::{Context, On, State, builds_up};
use super::tracking::{scale_up, scaling};
use crate::effects::{Domain, Effect, Place};
use crate::error::GapError;
use crate::replay::{Term, Variant};

/// Predictions kept in memory at once, bytes.
const MEMORY_BYTES: usize = 256 * 1024 * 1024;
/// Starts that are kept per candidate.
const STARTS: usize = 3;

/// A candidate that was screened.
#[derive(Debug, Clone)]
pub struct Screened {
    /// Which effect.
    pub effect: &'static Effect,
    /// Where.
    pub place: Place,
    /// Fall of the misfit that its best size promises.
    pub gain: f64,
    /// Share of the samples that show it: of an effect of one joint those of its channels.
    pub shown: f64,
    /// Values to start a fit from, best first. SI.
    pub starts: Vec<Vec<f64>>,
    /// Mean square of its trace per grid point, largest sensitivity: misfit per (size of grid point)².
    pub traces: Vec<(Vec<f64>, f64)>,
}

/// Declared look-alikes of `term`, each at its place if it can be there, else where it does best.
pub fn look_alikes<'a>(term: &Term, screened: &'a [Screened]) -> Vec<&'a Screened> {
    let of = |id: &str| {
        let mut own = screened.iter().filter(|s| s.effect.id == id);
        let here = own.clone().find(|s| s.place == term.place);
        here.or_else(|| own.next())
    };
    term.effect.look_alikes().filter_map(of).collect()
}

/// What is simulated once for several places.
struct Tried {
    effect: &'static Effect,
    /// The places that its trace speaks for.
    judged: Vec<Place>,
    /// Which of the effect's sizes.
    k: usize,
    variant: Variant,
}

/// Screens every effect that the context allows, at every place, on top of each of `parents`. What it does is
/// simulated once for all of them, on top of `around`, which they come of: they explain about the same motions.
///
/// # Errors
/// As [`crate::replay::Replayer::predict`].
pub fn screen(
    context: &Context,
    around: &State,
    parents: &[&State],
) -> Result<Vec<Vec<Screened>>, GapError> {
    let mut out: Vec<Vec<Screened>> = vec![Vec::new(); parents.len()];
    let (slow, quick): (Vec<_>, Vec<_>) = plan(context, around)
        .into_iter()
        .partition(|t| context.scout.is_some() && builds_up(t.effect));
    type Where = fn(&State) -> &On;
    let dilution = context.scout.as_ref().map_or(1.0, |s| s.dilution);
    // what takes long to build up shows in whole runs only (what other parameters can do there is not known,
    // and not asked)
    let first = (context.first_look(), quick, State::on_scout as Where);
    let whole = (&context.fit, slow, (|s| &s.fit) as Where);
    for ((judge, plan, on), asks, dilution) in [(first, true, dilution), (whole, false, 1.0)] {
        let look = |state: &&'_ State| Look {
            judge,
            residual: on(state).residual.clone(),
            basis: if asks { state.basis.clone() } else { Vec::new() },
            dilution,
        };
        let looks: Vec<Look<'_>> = parents.iter().map(look).collect();
        let at_once = (MEMORY_BYTES / (8 * judge.data.len().max(1))).max(16);
        for batch in plan.chunks(at_once) {
            let variants: Vec<Variant> = batch.iter().map(|t| t.variant.clone()).collect();
            let predictions = context.replayer.predict(&judge.data, &variants)?;
            for (tried, prediction) in batch.iter().zip(&predictions) {
                if !Judge::sound(prediction) {
                    continue;
                }
                let change = judge.change(prediction, &on(around).prediction);
                let judged = tried.judged.iter().filter(|p| open(context, around, tried.effect, p));
                for place in judged {
                    let sizes = sizes(context, tried.effect, place, tried.k);
                    for (look, out) in looks.iter().zip(&mut out) {
                        weigh(context, look, tried.effect, sizes.clone(), place, &change, out);
                    }
                }
            }
        }
    }
    for screened in &mut out {
        for s in screened.iter_mut() {
            s.traces.sort_by(|a, b| a.1.total_cmp(&b.1));
        }
        screened.sort_by(|a, b| b.gain.total_cmp(&a.gain));
    }
    Ok(out)
}

/// Most sets of joints of one branch that are simulated apart: each joint of an arm of six, and a fifth more work for
/// sixteen in a row.
const SETS: usize = 6;

/// What is simulated together, and the places that it is judged by.
type Together = (Vec<Place>, Vec<Place>);

/// What to simulate of the places `all` of an effect: all joints at once, and links of different branches, or gears,
/// apart.
fn together(context: &Context, around: &State, effect: &Effect, all: &[Place]) -> Vec<Together> {
    let joints = context.replayer.model().actuated().len();
    let wanted = |p: &&Place| open(context, around, effect, p);
    let apart = |places: Vec<Place>, most: usize| {
        let branches = places.iter().filter(wanted).map(|p| (p, branch(context, p)));
        let sets = side_by_side(branches, most);
        sets.into_iter().map(|set| (set.clone(), set)).collect::<Vec<_>>()
    };
    let (one, more): (Vec<Place>, Vec<Place>) =
        all.iter().cloned().partition(|p| p.items.len() == 1);
    match effect.domain {
        Domain::Joints => {
            // of hinges and slides each has sizes of its own, and they have no place together
            let widest = all.first().filter(|p| p.items.len() == joints);
            let at_once = widest.map_or_else(|| one.clone(), |widest| vec![widest.clone()]);
            if effect.apart && joints > 1 && held(context) {
                std::iter::once((at_once, more)).chain(apart(one, SETS)).collect()
            } else {
                vec![(at_once, all.to_vec())]
            }
        }
        Domain::Links => apart(all.to_vec(), usize::MAX),
        _ => all.iter().map(|p| (vec![p.clone()], vec![p.clone()])).collect(),
    }
}

/// What to simulate.
fn plan(context: &Context, around: &State) -> Vec<Tried> {
    let model = context.replayer.model();
    let mut plan = Vec::new();
    for &effect in &context.effects {
        let wanted = |p: &Place| open(context, around, effect, p);
        let together = together(context, around, effect, &effect.places(model));
        let some = |(at, judged): &Together| at.iter().any(wanted) && !judged.is_empty();
        for (at, judged) in together.into_iter().filter(some) {
            for k in 0..effect.grid.len() {
                let terms = at.iter().map(|place| Term {
                    effect,
                    place: place.clone(),
                    values: effect.sizes(model, place, k),
                });
                plan.push(Tried {
                    effect,
                    variant: around.terms.iter().cloned().chain(terms).collect(),
                    judged: judged.clone(),
                    k,
                });
            }
        }
        let came_to = |p: &Place| matches!(p.items[..], [a] if range(context, a).is_some());
        let places = effect.places(model).into_iter();
        let own: Vec<Place> = places.filter(|p| effect.ends && came_to(p) && wanted(p)).collect();
        for k in (effect.grid.len()..effect.grid.len() + 2).filter(|_| !own.is_empty()) {
            let terms = own.iter().map(|place| Term {
                effect,
                place: place.clone(),
                values: sizes(context, effect, place, k),
            });
            let variant = around.terms.iter().cloned().chain(terms).collect();
            plan.push(Tried { effect, variant, judged: own.clone(), k });
        }
    }
    plan
}

/// Grid point `k` of an effect at a place; beyond them the lowest and the highest position that the joint came to: a
/// stop is where it went no farther.
fn sizes(context: &Context, effect: &Effect, place: &Place, k: usize) -> Vec<f64> {
    let model = context.replayer.model();
    let Some(end) = k.checked_sub(effect.grid.len()) else {
        return effect.sizes(model, place, k);
    };
    let mut values = effect.neutral(model, place);
    if let Some(range) = place.items.first().and_then(|a| range(context, *a)) {
        let (low, high) = effect.bounds(model, place, end);
        values[end] = range[end].clamp(low, high);
    }
    values
}

/// Lowest and highest position that a joint came to.
fn range(context: &Context, joint: usize) -> Option<[f64; 2]> {
    let (low, high) = context.excitation.joints.get(joint)?.range_rad;
    (low < high).then_some([low, high])
}

/// Places with their branches in sets whose members do not move each other, or little: each in another branch of a held robot, or
/// `most` places further along the same.
fn side_by_side<'a>(
    places: impl Iterator<Item = (&'a Place, Option<usize>)>,
    most: usize,
) -> Vec<Vec<Place>> {
    let (mut sets, mut alone) = (Vec::<Vec<Place>>::new(), Vec::new());
    let mut of_branch: BTreeMap<usize, usize> = BTreeMap::new();
    for (place, branch) in places {
        let Some(branch) = branch else {
            alone.push(vec![place.clone()]);
            continue;
        };
        let next = of_branch.entry(branch).or_default();
        match sets.get_mut(*next) {
            Some(set) => set.push(place.clone()),
            None => sets.push(vec![place.clone()]),
        }
        *next = (*next + 1) % most;
    }
    sets.append(&mut alone);
    sets
}

/// The link with which the branch of a held robot begins that a link or joint is in; none of a link where more than
/// joints show what it does.
fn branch(context: &Context, place: &Place) -> Option<usize> {
    let model = context.replayer.model();
    let link = match (place.domain, &place.items[..]) {
        (Domain::Links, [link]) if context.fit.data.pieces().all(|p| p.kind.of_joint()) => *link,
        // its own channels show it
        (Domain::Joints, [joint]) => model.joints()[model.actuated()[*joint]].child_link,
        _ => return None,
    };
    if !held(context) {
        return None;
    }
    begins(model, link)
}

/// Whether the base is held in all runs.
fn held(context: &Context) -> bool {
    context.fit.data.trials.iter().all(|t| t.base == BaseHold::Fixed)
}

/// The link of its branch that the base carries, or that moves about the world; none for a base that does not move.
fn begins(model: &RobotModel, link: usize) -> Option<usize> {
    let links = model.links();
    let moves = |l: &usize| links[*l].parent.is_some() || !links[*l].joints.is_empty();
    std::iter::successors(Some(link), |l| links[*l].parent).filter(moves).last()
}

/// Joints whose channels alone show what an effect at a place does; none: all channels.
fn shown_at(context: &Context, place: &Place) -> Option<Vec<usize>> {
    let model = context.replayer.model();
    if place.domain == Domain::Joints {
        let some = !place.names.is_empty() && model.actuated().len() > 1;
        return some.then(|| place.items.clone());
    }
    let own = branch(context, place)?;
    let joints = model.actuated().iter().enumerate();
    let here = joints.filter(|(_, j)| begins(model, model.joints()[**j].child_link) == Some(own));
    Some(here.map(|(a, _)| a).collect())
}

/// Whether the runs can show an effect at a place, and the model does not have it.
fn open(context: &Context, state: &State, effect: &Effect, place: &Place) -> bool {
    let has = || state.terms.iter().any(|t| t.effect == effect && t.place == *place);
    (effect.unseen)(&context.excitation, place).is_none() && !has()
}

/// Where candidates are looked at: runs, how a model does on them, and what its parameters can do there.
struct Look<'a> {
    judge: &'a Judge,
    residual: Vec<f32>,
    basis: Vec<Vec<f32>>,
    /// What a sample of all runs shows over what one of these shows.
    dilution: f64,
}

/// Σ x·y over `ranges`.
fn dot_in(ranges: &[Range<usize>], x: &[f32], y: &[f32]) -> f64 {
    let own = ranges.iter().cloned();
    own.map(|r| dot(&x[r.clone()], &y[r])).sum()
}

impl Screened {
    /// Takes a start that promises `gain`: the best stays first.
    fn take(&mut self, gain: f64, start: Vec<f64>) {
        let place = if gain > self.gain {
            self.gain = gain;
            0
        } else {
            1.min(self.starts.len())
        };
        self.starts.insert(place, start);
        // a smooth effect of one parameter has one way down
        self.starts.truncate(match self.effect.hinge {
            true => STARTS,
            false => self.effect.parameters.len().min(2),
        });
    }
}

/// Shares of `sizes` that a smooth effect may have instead: up to three times as much either way, as far as its
/// bounds go. One that is nothing at its bound has one way.
fn shares(
    effect: &Effect,
    model: &RobotModel,
    place: &Place,
    sizes: &[f64],
    neutral: &[f64],
) -> (f64, f64) {
    let back = |i: usize| {
        let (low, high) = effect.bounds(model, place, i);
        match sizes[i] - neutral[i] {
            up if up > 0.0 => (low - neutral[i]) / up,
            down if down < 0.0 => (high - neutral[i]) / down,
            _ => f64::NEG_INFINITY,
        }
    };
    let low = scaling(effect).map(back).fold(-3.0, f64::max);
    (if low < 0.0 { low } else { 0.05 }, 3.0)
}

/// What an effect of these `sizes` at a place promises to explain of what a model leaves.
fn weigh(
    context: &Context,
    look: &Look<'_>,
    effect: &'static Effect,
    sizes: Vec<f64>,
    place: &Place,
    trace: &[f32],
    out: &mut Vec<Screened>,
) {
    let model = context.replayer.model();
    let n = trace.len().max(1) as f64;
    let ranges = shown_at(context, place).map(|joints| -> Vec<Range<usize>> {
        (look.judge.data.pieces())
            .filter(|p| p.kind.of_joint() && joints.contains(&p.index))
            .map(|p| p.range.clone())
            .collect()
    });
    let on_trace = |x: &[f32]| match &ranges {
        Some(ranges) => dot_in(ranges, x, trace),
        None => dot(x, trace),
    };
    let residual = &look.residual;
    let (rd, dd) = (on_trace(residual), on_trace(trace));
    if dd < 1e-6 * n {
        return;
    }
    // less what parameters that are free already can do
    let (mut prd, mut pdd) = (rd, dd);
    for q in &look.basis {
        let (qd, qr) = (on_trace(q), dot(q, residual));
        prd -= qd * qr;
        pdd -= qd * qd;
    }
    let pdd = pdd.max(0.01 * dd);
    let neutral = effect.neutral(model, place);
    let (low, high) = match effect.hinge {
        true => (0.4, 1.6),
        false => shares(effect, model, place, &sizes, &neutral),
    };
    let share = (prd / pdd).clamp(low, high);
    let gain = (2.0 * share * prd - share * share * pdd) / n;
    let mut start = Term { effect, place: place.clone(), values: sizes.clone() };
    scale_up(model, &mut start, share);
    let known = out.iter().position(|s| s.effect == effect && s.place == *place);
    let known = known.unwrap_or_else(|| {
        out.push(Screened {
            effect,
            place: place.clone(),
            gain: f64::NEG_INFINITY,
            shown: ranges
                .as_ref()
                .map_or(1.0, |r| r.iter().map(Range::len).sum::<usize>() as f64 / n),
            starts: Vec::new(),
            traces: Vec::new(),
        });
        out.len() - 1
    });
    out[known].traces.push((sizes, look.dilution * dd / n));
    out[known].take(gain, start.values);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn a_branch_begins_with_what_the_base_carries_or_what_moves_about_the_world() {
        let model = |name: &str| {
            let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
            RobotModel::load(format!("{folder}/{name}.robot.toml").as_ref()).unwrap()
        };
        assert_eq!(begins(&model("xl330_pendulum"), 0), Some(0));
        let quadruped = model("quadruped");
        assert_eq!(begins(&quadruped, 0), None);
        for foot in quadruped.feet() {
            let first = begins(&quadruped, foot.link).unwrap();
            assert_eq!(quadruped.links()[first].parent, Some(0));
        }
    }

    /// Three of a branch that has two sets: the third is in the first again. What has no branch is alone.
    #[test]
    fn sets_have_one_of_each_branch() {
        let place = |i: usize| Place { domain: Domain::Joints, items: vec![i], names: vec![] };
        let places: Vec<Place> = (0..5).map(place).collect();
        let branches = [Some(1), Some(1), None, Some(2), Some(1)];
        let sets = side_by_side(places.iter().zip(branches), 2);
        let items = |set: &Vec<Place>| set.iter().map(|p| p.items[0]).collect::<Vec<_>>();
        let items: Vec<Vec<usize>> = sets.iter().map(items).collect();
        assert_eq!(items, [vec![0, 3, 4], vec![1], vec![2]]);
    }
}
