//! A verdict in words.

use std::collections::BTreeMap;

use super::alike::wider;
use super::carried::NO_NEARER;
use super::doubt::Doubts;
use super::gates;
use super::levels::{BUILT, CAREFUL_LAB, NOTHING_LEFT};
use super::naming::{Named, Rival};
use super::request::Split;
use super::search::Found;
use super::state::{Context, State};
use crate::check::{ASSUMED, MAYBE_HELD};
use crate::extension::ExtensionEffect;
use crate::replay::Term;
use crate::report::{
    Carried, Cause, DataFault, DoubtKind, Gain, LocalGap, NextExperiment, PositionError,
    Unexplained, Verdict,
};

/// What speaks for a cause.
pub fn evidence(context: &Context, term: &Term, named: &Named) -> Vec<String> {
    let w = &named.worth;
    let mut lines = vec![
        format!(
            "takes {:.0} % off the misfit in cross-validation ({:.2} to {:.2} in units of the floor; 95 % interval of the fall {:.2} to {:.2})",
            100.0 * w.cross / w.of.max(1e-9),
            w.of,
            w.of - w.cross,
            w.interval.0,
            w.interval.1
        ),
        format!("and {:.2} off that of the runs as they are fitted", w.fit),
        format!("its mark: {}", term.effect.signature),
    ];
    let mut tell = |same: bool, as_what: &str| {
        let of = |r: &&Rival| {
            let other = r.state.terms[r.index].effect;
            // a wider law says the same with more sizes
            (other == term.effect) == same && !wider(term.effect, other)
        };
        let Some(rival) = named.rivals.iter().find(of) else {
            return;
        };
        let other = &rival.state.terms[rival.index];
        let label = other.label();
        let does = match rival.short > 0.0 {
            true => format!("{as_what} {label} {} of it", leaves(rival.short)),
            false => format!("{as_what} {label} takes as much off, or more"),
        };
        lines.push(format!("{does} (probability {:.0} %)", 100.0 * rival.probability));
    };
    tell(false, "the next best name");
    tell(true, "the same at another place,");
    if !named.untried.is_empty() {
        lines.push(
            "time ended before its look-alikes were tried: whether they are as good nobody knows"
                .to_owned(),
        );
    }
    if context.fit.noise.repeated {
        lines.push("the floor comes from repeats".to_owned());
    }
    lines
}

/// How much of what a cause explains is left by a rival that falls short of so much of it.
pub fn leaves(short: f64) -> String {
    match short < 1.0 {
        true => format!("leaves {:.0} %", 100.0 * short),
        false => "explains nothing".to_owned(),
    }
}

/// What there is to record so that open names are told apart.
pub fn what_tells(
    verdict: Verdict,
    causes: &[Cause],
    next: Option<&NextExperiment>,
    unfinished: bool,
) -> &'static str {
    let another = causes.iter().any(|c| c.has_open_name() || !c.elsewhere.is_empty());
    match (verdict, next) {
        _ if unfinished => "",
        (Verdict::Ambiguous, _) if !another => {
            " They are one robot by different names: no trial tells them apart."
        }
        (Verdict::Ambiguous, Some(_)) => " The next experiment says which of them it tells apart.",
        (Verdict::Ambiguous, None) => {
            " No trial of the battery that is not in the logs tells them apart."
        }
        (Verdict::InsufficientData, Some(_)) => " See the next experiment.",
        _ => "",
    }
}

/// The verdict in a sentence or two, and what the reader must know besides.
pub fn summary(
    context: &Context,
    (verdict, unfinished): (Verdict, bool),
    (causes, leads, tells): (&[Cause], &[Cause], &str),
    doubts: &Doubts,
    unexplained: &[Unexplained],
    split: Split,
    found: &Found,
) -> String {
    let mut text = headline((verdict, unfinished), causes, doubts, unexplained, found);
    text.push_str(tells);
    let mut assumed: Vec<&str> =
        causes.iter().flat_map(|c| &c.assumed).map(String::as_str).collect();
    assumed.sort_unstable();
    assumed.dedup();
    if !assumed.is_empty() {
        text.push_str(&format!(
            " This answer corrects figures that the robot file assumes ({}): it may be the file that is wrong, and the robot as it should be. Look them up where a data sheet has them.",
            assumed.join(", ")
        ));
    }
    if !leads.is_empty() {
        let which = match leads {
            [_] => "which may make up for what another law lacks: a lead and no finding",
            _ => "which may make up for what another law lacks: leads and no findings",
        };
        text.push_str(&format!(" The model carries {} as well, {which}.", names(leads)));
    }
    if let Some((state, _)) = found.refused.first().filter(|(_, w)| w.why == NO_NEARER) {
        let (before, after) = (found.base.holdout.misfit, state.holdout.misfit);
        text.push_str(&format!(
            " Fitted to the other runs, {} does not bring held-out runs nearer ({before:.2} floors as given, {after:.2} with it): it is no finding, and the robot is taken as given.",
            state.label()
        ));
    }
    if !found.best.terms.is_empty() && gates::silent(context, &found.base, &found.best) {
        text.push_str(
            " No held-out run shows what was found, so it rests on cross-validation of the others: hold out one that shows it (--holdout).",
        );
    }
    for passed in &context.passed {
        text.push_str(&format!(" {} {}.", passed.note.location, passed.note.detail));
    }
    if context.losses.is_some() {
        text.push_str(" Lost frames show in what repeats differ by, not in their mean.");
    }
    let short = matches!(verdict, Verdict::Unexplained | Verdict::PartlyExplained);
    if short && !context.fit.noise.repeated {
        text.push_str(
            " No run has a repeat, so its noise is a guess and may be larger: record one motion twice.",
        );
    }
    match split {
        Split::Given => {}
        Split::SetAside => text.push_str(" No hold-out was given: a third of the trials was set aside."),
        Split::Same => text.push_str(" No hold-out was given and there are too few trials to set any aside: gains are on the very runs that were fitted."),
    }
    text
}

/// What comes before everything else: that time ended, and that a standard model does better than the one that is
/// carried.
pub fn first(
    verdict: Verdict,
    carried: &State,
    errors: &[PositionError],
    unfinished: bool,
) -> String {
    let mut text = String::new();
    if unfinished {
        text.push_str(
            "Unfinished: it ended before everything was tried, and this is the best so far. Give it more time before you record anything. ",
        );
    }
    let [_, standard @ .., extended] = errors else {
        return text;
    };
    let best = (standard.iter()).min_by(|a, b| a.mean_rad.total_cmp(&b.mean_rad));
    let better = |b: &&PositionError| b.mean_rad < BUILT * extended.mean_rad;
    // what is within what careful labs leave cannot be bettered
    if let Some(best) = best.filter(better)
        && carried.holdout.misfit > CAREFUL_LAB
        && verdict != Verdict::NoGap
    {
        text.push_str(&format!(
            "A standard model ({}) fitted to the same runs is better: its angles are {} rad off on held-out runs, those of the extended model {} rad. ",
            best.model,
            rounded(best.mean_rad),
            rounded(extended.mean_rad)
        ));
    }
    text
}

/// Notes on assumed figures that are told; of more, how many there are.
const ASSUMED_TOLD: usize = 2;

/// What the check says stands on an assumed figure of the robot file, where there is a gap, and of a base that may have
/// been held.
pub fn assumed(verdict: Verdict, faults: &[DataFault]) -> String {
    let of = |f: &&DataFault| f.kind == ASSUMED && verdict != Verdict::NoGap;
    let mut told: Vec<String> =
        faults.iter().filter(of).map(|f| format!(" {} {}.", f.location, f.detail)).collect();
    let more = told.len().saturating_sub(ASSUMED_TOLD);
    told.truncate(ASSUMED_TOLD);
    if more > 0 {
        told.push(format!(" So it is with {more} more figure(s)."));
    }
    let base = faults.iter().find(|f| f.kind == MAYBE_HELD);
    told.extend(base.map(|f| format!(" {} {}.", f.location, f.detail)));
    told.concat()
}

/// Times as far off that are told.
const TIMES_AS_FAR: f64 = 1.1;

/// Which channels of held-out runs are farther from the extended model than from the robot as given, beyond doubt.
pub fn farther(gain: &BTreeMap<String, Gain>) -> String {
    let worse = gain.iter().filter(|(_, g)| g.ci_low > 1.0 && g.ratio > TIMES_AS_FAR);
    let told: Vec<String> =
        worse.map(|(kind, g)| format!("{kind} ({:.1} times)", g.ratio)).collect();
    match told.is_empty() {
        true => String::new(),
        false => format!(
            " On held-out runs the extended model is farther off than the robot as given in {}{}.",
            told.join(" and "),
            if told.iter().any(|t| t.starts_with("pos ")) {
                ""
            } else {
                ": it is chosen for its angles"
            }
        ),
    }
}

/// What comes last: `causes` that are not in the model, which is of these `effects`, or that there are none without
/// a gap; effects that are in it without a name, and stretches that are far off.
pub fn last(
    verdict: Verdict,
    causes: &[Cause],
    effects: &[ExtensionEffect],
    model: &[Carried],
    local: &[LocalGap],
) -> String {
    let mut text = left_out(causes, effects);
    if verdict == Verdict::NoGap && effects.is_empty() {
        text.push_str(" The extended robot is the robot as given.");
    }
    let unnamed = model.iter().filter(|c| !c.named).count();
    if unnamed > 0 {
        text.push_str(&format!(
            " The extended model carries {unnamed} effect(s) that the runs support and whose names are no findings."
        ));
    }
    if let Some(worst) = local.first() {
        text.push_str(&format!(
            " In run {} joint {} is {} {} off from {:.1} s to {:.1} s, {:.1} times what runs differ by.",
            worst.run, worst.joint, rounded(worst.rms_rad), worst.unit, worst.from_s, worst.to_s, worst.ratio
        ));
    }
    text
}

/// Which of `causes` the extended file, which has `effects`, does without.
fn left_out(causes: &[Cause], effects: &[ExtensionEffect]) -> String {
    let out = |cause: &&Cause| {
        let same = |e: &ExtensionEffect| e.id == cause.effect && e.location == cause.location;
        !effects.iter().any(same)
    };
    let without: Vec<Cause> = causes.iter().filter(out).cloned().collect();
    match without.is_empty() {
        true => String::new(),
        false => format!(
            " The extended model does without {}: angles of the runs that were fitted are nearer to it.",
            names(&without)
        ),
    }
}

/// To two digits.
pub fn rounded(x: f64) -> String {
    let digits = (1.0 - x.abs().max(1e-9).log10().floor()).clamp(0.0, 6.0) as usize;
    format!("{x:.digits$}")
}

/// Causes with their places.
fn names(causes: &[Cause]) -> String {
    let name = |c: &Cause| match c.location.as_slice() {
        [] => c.effect.clone(),
        places => format!("{} at {}", c.effect, places.join(", ")),
    };
    let names: Vec<String> = causes.iter().map(name).collect();
    names.join(" and ")
}

fn headline(
    (verdict, unfinished): (Verdict, bool),
    causes: &[Cause],
    doubts: &Doubts,
    unexplained: &[Unexplained],
    found: &Found,
) -> String {
    let (base, best) = (&found.base, &found.best);
    let (before, after) = (base.holdout.misfit, best.holdout.misfit);
    let fall = if best.terms.is_empty() {
        format!("held-out misfit is {after:.2} floors, and was {before:.2}")
    } else {
        format!("held-out misfit falls from {before:.2} to {after:.2} floors")
    };
    match verdict {
        Verdict::NoGap => format!(
            "Simulation and measurement agree within what runs differ by (misfit {:.2}); the table of floors says what would have been seen.",
            base.misfit()
        ),
        Verdict::Explained => {
            let explains = if causes.len() == 1 { "explains" } else { "explain" };
            format!("{} {explains} it: {fall}.", names(causes))
        }
        Verdict::Ambiguous => {
            let (open, sure): (Vec<Cause>, Vec<Cause>) =
                causes.iter().cloned().partition(Cause::is_open);
            let open: Vec<String> = open.iter().map(Cause::rivals).collect();
            let what = match sure.is_empty() {
                true => "The gap is real, its name is open".to_owned(),
                false => format!("Explained by {}, and by what has no sure name", names(&sure)),
            };
            format!("{what}: {}; {fall}.", open.join("; "))
        }
        Verdict::PartlyExplained => {
            let left = unexplained
                .first()
                .map_or(String::new(), |u| format!(", most of it at {}", u.location));
            // how much is left is in the figures
            let others = doubts.listed().into_iter();
            let others: String = (others.filter(|d| d.kind != DoubtKind::MuchLeft))
                .map(|d| format!(" {}", d.detail))
                .collect();
            format!(
                "{} explain{} a part: {fall}; {:.0} % is left of that of the runs that were fitted{left}.{others}",
                names(causes),
                if causes.len() == 1 { "s" } else { "" },
                100.0 * best.misfit() / base.misfit().max(1e-9),
            )
        }
        Verdict::Unexplained => {
            let nothing = match unfinished {
                true => "nothing that was tried in the time",
                false => "no effect of the catalogue",
            };
            let misfit = base.misfit().max(base.holdout.misfit);
            match misfit < NOTHING_LEFT {
                true => format!(
                    "There is a gap in a few seconds of a run that {nothing} explains; on average the runs agree."
                ),
                false => {
                    format!("There is a gap (misfit {misfit:.2} floors) that {nothing} explains.")
                }
            }
        }
        Verdict::InsufficientData => {
            let close = found.refused.first().map_or(String::new(), |(s, w)| {
                let name = s.terms.last().map_or(String::new(), |t| t.label());
                format!(" {name} would explain the runs it was fitted to, but: {}.", w.why)
            });
            format!("These runs cannot decide it.{close}")
        }
        Verdict::DataFault => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_that_is_farther_off_beyond_doubt_is_told() {
        let of = |ratio, ci_low| Gain { before: 1.0, after: ratio, ratio, ci_low, ci_high: 9.0 };
        let gain = [("cur", of(5.9, 4.7)), ("pos", of(0.5, 0.4)), ("vel", of(1.3, 0.9))];
        let told = farther(&gain.map(|(kind, g)| (kind.to_owned(), g)).into());
        assert!(
            told.ends_with("as given in cur (5.9 times): it is chosen for its angles."),
            "{told}"
        );
        assert_eq!(farther(&BTreeMap::new()), "");
    }
}
