//! One case judged: what was said against what was true.

use caudata_gap::report::{Cause, Report, Verdict};
use serde::Serialize;

use crate::case::{Answer, Block, TrueEffect, TrueValue};

/// A name with less confidence than this is not a confident one.
pub const CONFIDENT: f64 = 0.7;

/// What a diagnosis gave for a case.
#[derive(Clone, Debug)]
pub struct Given {
    /// The report; `None` where it failed.
    pub report: Option<Report>,
    /// Why it failed; the line that it ended with.
    pub failure: String,
    /// Wall time, s.
    pub seconds: f64,
}

/// One true effect, judged.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Judged {
    /// Effect.
    pub effect: String,
    /// Layer.
    pub layer: String,
    /// d.
    pub d: f64,
    /// Whether the first cause has its name (or that of an exact equivalent).
    pub first: bool,
    /// Whether any cause has.
    pub named: bool,
    /// Whether it is among the first three names, alternatives included.
    pub in_three: bool,
    /// Whether the layer of the first cause is right.
    pub layer_right: bool,
    /// Whether the joint of the cause with its name is right.
    pub joint_right: Option<bool>,
    /// Whether the answer set around it holds the very id.
    pub in_set: bool,
    /// |estimate − truth| / |truth − nominal|.
    pub parameter_error: Option<f64>,
    /// |estimate − truth|, in the parameter's unit.
    pub absolute_error: Option<f64>,
    /// Whether the 95 % interval holds the truth.
    pub interval_holds: Option<bool>,
    /// Half of that interval over |truth − nominal|.
    pub interval_half: Option<f64>,
}

/// One case, judged.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Folder.
    pub case: String,
    /// Block.
    pub block: Block,
    /// Rig.
    pub rig: String,
    /// What a decoy was.
    pub decoy: String,
    /// Verdict given; empty where the diagnosis failed.
    pub verdict: String,
    /// Names given with confidence, strongest first.
    pub given: Vec<(String, String, f64)>,
    /// Whether a gap was seen at all.
    pub detected: bool,
    /// Size of all true effects together, d.
    pub together_d: f64,
    /// True effects.
    pub truth: Vec<Judged>,
    /// Wrong names.
    pub wrong: usize,
    /// Leads that are true, and that are not.
    pub leads: (usize, usize),
    /// Highest confidence of a wrong name.
    pub wrong_confidence: f64,
    /// (confidence, right) of every name.
    pub confidences: Vec<(f64, bool)>,
    /// Size of the first answer set.
    pub set_size: usize,
    /// Whether the case is answered as it should be, by the rule of its block.
    pub right: bool,
    /// Error on held-out runs after, over before (geometric mean over signals); `None` without a gain.
    pub gain_ratio: Option<f64>,
    /// Whether the next experiment separates the truth from something.
    pub next_helps: Option<bool>,
    /// Wall time, s.
    pub seconds: f64,
    /// Why it failed.
    pub failure: String,
}

/// Judges a case. `joint_links`: for each joint name, the link that it carries.
pub fn judge(answer: &Answer, given: &Given, joint_links: &[(String, String)]) -> Outcome {
    let empty = Vec::new();
    let causes = given.report.as_ref().map_or(&empty, |r| &r.causes);
    let verdict = given.report.as_ref().map(|r| r.verdict);
    let truth: Vec<Judged> =
        answer.effects.iter().map(|t| judged(t, causes, joint_links)).collect();
    let is_true = |c: &Cause| is_true(answer, c, causes);
    let leads = given.report.as_ref().map_or(&empty, |r| &r.leads);
    let wrong: Vec<&Cause> = causes.iter().filter(|c| !is_true(c)).collect();
    let detected = matches!(
        verdict,
        Some(
            Verdict::Explained
                | Verdict::Ambiguous
                | Verdict::PartlyExplained
                | Verdict::Unexplained
        )
    );
    let wrong_confidence = wrong.iter().map(|c| c.confidence_of_kind).fold(0.0, f64::max);
    let next = given.report.as_ref().and_then(|r| r.next_experiment.as_ref());
    // which place it is, a trial alone does not say
    let open_name = causes.iter().any(Cause::has_open_name);
    let next_helps = ((verdict == Some(Verdict::Ambiguous) && open_name)
        || verdict == Some(Verdict::InsufficientData))
    .then(|| {
        next.is_some_and(|n| answer.effects.iter().any(|t| n.separates.iter().any(|s| same(t, s))))
    });
    Outcome {
        case: answer.case.clone(),
        block: answer.block,
        rig: answer.rig.clone(),
        decoy: answer.decoy.clone(),
        verdict: verdict.map_or(String::new(), |v| {
            serde_json::to_value(v)
                .ok()
                .and_then(|v| v.as_str().map(str::to_owned))
                .unwrap_or_default()
        }),
        given: causes
            .iter()
            .map(|c| (c.effect.clone(), c.location.join(" "), c.confidence_of_kind))
            .collect(),
        detected,
        together_d: answer.together_d,
        wrong: wrong.len(),
        leads: (
            leads.iter().filter(|c| is_true(c)).count(),
            leads.iter().filter(|c| !is_true(c)).count(),
        ),
        wrong_confidence,
        confidences: causes.iter().map(|c| (c.confidence_of_kind, is_true(c))).collect(),
        set_size: (causes.first()).map_or(0, |c| 1 + c.alternatives.len() + c.elsewhere.len()),
        right: right(answer, given, &truth, detected),
        gain_ratio: given.report.as_ref().and_then(gain),
        next_helps,
        truth,
        seconds: given.seconds,
        failure: given.failure.clone(),
    }
}

/// Whether the name of `cause` is right beside those in `causes`.
pub fn is_true(answer: &Answer, cause: &Cause, causes: &[Cause]) -> bool {
    let mut truth = answer.effects.iter();
    truth.any(|t| same_among(t, &cause.effect, causes))
}

/// Whether the case is answered as it should be, by the rule of its block.
fn right(answer: &Answer, given: &Given, truth: &[Judged], detected: bool) -> bool {
    let verdict = given.report.as_ref().map(|r| r.verdict);
    let unnamed = given.report.as_ref().is_none_or(|r| r.causes.is_empty());
    match answer.block {
        Block::Null => {
            verdict == Some(Verdict::NoGap) || (verdict.is_some() && unnamed && !detected)
        }
        Block::Single | Block::Ground | Block::Water => truth.iter().all(|t| t.first),
        Block::Pair => truth.iter().all(|t| t.named) && !truth.is_empty(),
        Block::Decoy if answer.fault => {
            verdict == Some(Verdict::DataFault) || names_fault(answer, given)
        }
        Block::Decoy => verdict.is_some() && unnamed,
        Block::Outside => matches!(verdict, Some(Verdict::Unexplained | Verdict::PartlyExplained)),
        Block::Starved => {
            // an open question must hold the truth
            verdict == Some(Verdict::InsufficientData)
                || (verdict == Some(Verdict::Ambiguous) && truth.iter().any(|t| t.in_set))
                || truth.iter().all(|t| t.first && t.in_set)
        }
        Block::HoldoutChange => unnamed,
    }
}

/// Whether `name` is the true effect or one that these data cannot tell from it by any means.
fn same(t: &TrueEffect, name: &str) -> bool {
    t.effect == name || t.equivalent.iter().any(|e| e == name)
}

/// The same beside the other names in `causes`.
fn same_among(t: &TrueEffect, name: &str, causes: &[Cause]) -> bool {
    let named = |id: &str| causes.iter().any(|c| c.effect == id);
    let mut beside = t.equivalent_beside.iter();
    same(t, name) || beside.any(|(id, other)| id == name && named(other))
}

fn names_fault(answer: &Answer, given: &Given) -> bool {
    let faults = given.report.iter().flat_map(|r| &r.data_faults);
    let mut kinds = faults.map(|f| f.kind.as_str());
    kinds.any(|k| answer.fault_kinds.iter().any(|w| k.contains(w.as_str())))
}

fn judged(t: &TrueEffect, causes: &[Cause], joint_links: &[(String, String)]) -> Judged {
    let cause = (causes.iter()).find(|c| same_among(t, &c.effect, causes));
    let mut names: Vec<&str> = Vec::new();
    for c in causes {
        names.push(&c.effect);
        names.extend(c.alternatives.iter().map(String::as_str));
    }
    let mut three: Vec<&str> = Vec::new();
    for n in names {
        if !three.contains(&n) && three.len() < 3 {
            three.push(n);
        }
    }
    let in_set = causes.iter().any(|c| c.effect == t.effect || c.alternatives.contains(&t.effect));
    let value = cause.and_then(|c| compare(t, c));
    Judged {
        effect: t.effect.clone(),
        layer: t.layer.clone(),
        d: t.d,
        first: (causes.first()).is_some_and(|c| same_among(t, &c.effect, causes)),
        named: cause.is_some(),
        in_three: three.iter().any(|n| same(t, n)),
        layer_right: causes.first().is_some_and(|c| c.layer == t.layer),
        joint_right: cause.map(|c| place_right(t, c, joint_links)),
        in_set,
        parameter_error: value.map(|v| v.relative),
        absolute_error: value.map(|v| v.absolute),
        interval_holds: value.map(|v| v.holds),
        interval_half: value.map(|v| v.half),
    }
}

fn place_right(t: &TrueEffect, c: &Cause, joint_links: &[(String, String)]) -> bool {
    let only_one = joint_links.len() == 1;
    if t.joint.is_empty() || only_one {
        return only_one || c.location.is_empty() || c.location.len() == joint_links.len();
    }
    let link = joint_links.iter().find(|(j, _)| *j == t.joint).map(|(_, l)| l);
    c.location.len() == 1 && (c.location[0] == t.joint || Some(&c.location[0]) == link)
}

/// An estimate beside the truth.
#[derive(Clone, Copy)]
struct Compared {
    /// |estimate − truth| / |truth − nominal|.
    relative: f64,
    /// |estimate − truth|.
    absolute: f64,
    /// Whether the interval holds the truth.
    holds: bool,
    /// Half of the interval over |truth − nominal|.
    half: f64,
}

/// Estimate and interval of a cause beside the truth.
fn compare(t: &TrueEffect, c: &Cause) -> Option<Compared> {
    if t.effect != c.effect {
        return None;
    }
    // The name decides; a parameter that stands alone needs none.
    let by_name = t.parameters.iter().find_map(|v| {
        let found = v
            .names
            .iter()
            .find_map(|w| c.parameters.iter().find(|(n, _)| n.contains(w.as_str())))?;
        Some((v, found))
    });
    let (v, (name, p)) =
        by_name.or_else(|| match (t.parameters.as_slice(), c.parameters.iter().next()) {
            ([v], Some(p)) if c.parameters.len() == 1 => Some((v, p)),
            _ => None,
        })?;
    let (truth, nominal) = as_reported(v, name)?;
    let size = (truth - nominal).abs();
    let slack = 1e-9 + 1e-6 * truth.abs();
    let off = (p.value - truth).abs();
    let holds = p.ci_low - slack <= truth && truth <= p.ci_high + slack;
    Some(Compared {
        relative: off / size.max(1e-12),
        absolute: off,
        holds,
        half: 0.5 * (p.ci_high - p.ci_low) / size.max(1e-12),
    })
}

/// Truth and nominal in the form that a parameter's name says: a scale, an extra on top, or the value itself.
fn as_reported(v: &TrueValue, name: &str) -> Option<(f64, f64)> {
    let has = |words: &[&str]| words.iter().any(|w| name.contains(w));
    if has(&["scale", "ratio"]) && v.nominal != 0.0 {
        return Some((v.value / v.nominal, 1.0));
    }
    if has(&["extra", "added", "change"]) {
        return Some((v.value - v.nominal, 0.0));
    }
    Some((v.value, v.nominal))
}

/// Geometric mean over joint signals of the error on held-out runs, after over before.
fn gain(report: &Report) -> Option<f64> {
    let ratios: Vec<f64> =
        report.gain.values().map(|g| g.ratio).filter(|r| *r > 0.0 && r.is_finite()).collect();
    if ratios.is_empty() {
        return None;
    }
    Some((ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp())
}
