//! What a diagnosis leaves open, and which trial it asks for itself.

use caudata_gap::effects;
use caudata_gap::prospects::{Prospects, Weights};
use caudata_gap::report::{Report, Verdict};
use caudata_model::RobotModel;

/// A name of at least this confidence is one: what the benchmark calls confident.
const SURE: f64 = 0.7;
/// A joint is under suspicion whose error is at least this share of the worst one's.
const SUSPECT: f64 = 0.5;

/// Whether nothing is open: every cause is named with confidence, at one place, and runs that nothing was
/// fitted to agree. Names that no trial of the battery tells apart are one on this robot.
pub(super) fn is_sure(report: &Report) -> bool {
    let settled = match report.verdict {
        Verdict::Explained => true,
        Verdict::Ambiguous => {
            asked_for(report).is_none() && report.causes.iter().all(|c| c.elsewhere.is_empty())
        }
        _ => false,
    };
    settled
        && report.causes.iter().all(|c| c.confidence >= SURE)
        && report.runs.iter().any(|r| r.role == "holdout")
}

/// The trial by which a diagnosis would tell names apart, which it chose with their sizes.
pub(super) fn asked_for(report: &Report) -> Option<(&str, String)> {
    let open = report.causes.iter().any(|c| !c.alternatives.is_empty());
    let next = report.next_experiment.as_ref();
    let next = next.filter(|_| report.verdict == Verdict::Ambiguous && open)?;
    Some((&next.trial, next.reason.clone()))
}

/// What is possible after a diagnosis, and how probable.
pub(super) fn weights(
    report: &Report,
    prospects: &Prospects,
    lab: &RobotModel,
    recorded: &[&str],
) -> Weights {
    if report.verdict == Verdict::NoGap {
        return prospects.unseen(recorded);
    }
    let names = lab.actuated_names();
    let place = |name: &str| {
        let of_link = |&j: &usize| {
            let link = lab.joints()[j].child_link;
            lab.links()[link].name == name
        };
        let joint = names.iter().position(|n| *n == name);
        joint.or_else(|| lab.actuated().iter().position(of_link))
    };
    let (mut ids, mut joints): (Vec<&str>, Vec<usize>) = (Vec::new(), Vec::new());
    if matches!(report.verdict, Verdict::Ambiguous | Verdict::Explained) {
        for cause in &report.causes {
            ids.push(cause.effect.as_str());
            ids.extend(cause.alternatives.iter().map(String::as_str));
            // what else it might be
            for look_alike in effects::find(&cause.effect)
                .iter()
                .flat_map(|e| e.look_alikes())
            {
                ids.push(look_alike);
            }
            let places = cause
                .location
                .iter()
                .chain(cause.elsewhere.iter().flatten());
            joints.extend(places.filter_map(|n| place(n)));
        }
    } else {
        // anything, where it is worst
        let cells = match report.divergence_after.is_empty() {
            true => &report.divergence,
            false => &report.divergence_after,
        };
        let worst = cells.iter().map(|c| c.ratio).fold(0.0, f64::max);
        let suspect = cells.iter().filter(|c| c.ratio >= SUSPECT * worst);
        joints.extend(suspect.filter_map(|c| place(&c.joint)));
    }
    prospects.among(&ids, &joints)
}
