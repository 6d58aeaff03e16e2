//! What a diagnosis leaves open, and which trial it asks for itself.

use caudata_gap::effects;
use caudata_gap::prospects::{Prospects, Weights};
use caudata_gap::report::{Cause, NextExperiment, Report, Verdict};
use caudata_model::RobotModel;

/// A name of at least this confidence is one: what the benchmark calls confident.
const SURE: f64 = 0.7;
/// A joint is under suspicion whose error is at least this share of the worst one's.
const SUSPECT: f64 = 0.5;

/// Whether nothing is open: every cause is named with confidence, at one place, and runs that nothing was
/// fitted to agree. Several names of one robot are one; that nobody knows how to tell two robots apart does not
/// make them one.
pub(super) fn is_sure(report: &Report) -> bool {
    let one = |c: &Cause| !c.has_open_name() && c.elsewhere.is_empty() && c.confidence >= SURE;
    matches!(report.verdict, Verdict::Explained | Verdict::Ambiguous)
        && report.causes.iter().all(one)
        && report.runs.iter().any(|r| r.role == "holdout")
}

/// The trial by which a diagnosis would tell names apart, which it chose with their sizes.
pub(super) fn asked_for(report: &Report) -> Option<&NextExperiment> {
    let open = report.causes.iter().any(Cause::has_open_name);
    let next = report.next_experiment.as_ref();
    next.filter(|_| report.verdict == Verdict::Ambiguous && open)
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
            for look_alike in effects::find(&cause.effect).iter().flat_map(|e| e.look_alikes()) {
                ids.push(look_alike);
            }
            let places = cause.location.iter().chain(cause.elsewhere.iter().flatten());
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use caudata_gap::report::Compute;

    use super::*;

    /// A report of one cause with these alternatives and synonyms.
    fn report(verdict: &str, alternatives: &[&str], synonyms: &[&str]) -> Report {
        let cause = serde_json::json!({
            "effect": "kp_error", "layer": "actuation", "where": ["swing"], "parameters": {},
            "confidence": 0.9, "alternatives": alternatives, "synonyms": synonyms, "evidence": [],
            "rejected": [],
        });
        let run = serde_json::json!({
            "name": "holds", "role": "holdout", "duration_s": 9.0, "sha256": "",
        });
        serde_json::from_value(serde_json::json!({
            "verdict": verdict, "summary": "", "divergence": [], "causes": [cause], "gain": {},
            "unexplained": [], "next_experiment": null, "detection_floor": {}, "data_faults": [],
            "runs": [run], "compute": Compute::default(),
        }))
        .unwrap()
    }

    #[test]
    fn names_of_two_robots_are_no_sure_answer_although_no_trial_is_asked_for() {
        assert!(is_sure(&report("explained", &[], &[])));
        assert!(!is_sure(&report("ambiguous", &["winding_resistance"], &[])));
        let one = &["stale_gains"];
        assert!(is_sure(&report("ambiguous", one, one)));
        assert!(!is_sure(&report("ambiguous", &["stale_gains", "link_mass"], one)));
        assert!(!is_sure(&report("partly_explained", &[], &[])));
    }

    #[test]
    fn what_is_sure_has_one_place_a_confident_name_and_a_run_that_was_held_out() {
        let with = |change: &dyn Fn(&mut Report)| {
            let mut report = report("ambiguous", &[], &[]);
            change(&mut report);
            is_sure(&report)
        };
        assert!(with(&|_| ()));
        assert!(!with(&|r| r.causes[0].elsewhere = vec![vec!["knee".to_owned()]]));
        assert!(!with(&|r| r.causes[0].confidence = 0.6));
        assert!(!with(&|r| r.runs[0].role = "fit".to_owned()));
    }
}
