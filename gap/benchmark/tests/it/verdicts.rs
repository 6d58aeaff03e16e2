//! What a diagnosis may claim, one hidden law at a time: sure where it knows, unsure where a name stands in
//! for another law.

use caudata_gap::Options;
use caudata_gap::report::{Carried, Cause, Doubt, DoubtKind, Report, Verdict};
use caudata_gap_benchmark::battery::Amount;
use caudata_gap_benchmark::case::{Answer, Block};
use caudata_gap_benchmark::examinee;
use caudata_gap_benchmark::generate;
use caudata_gap_benchmark::hidden::find;
use caudata_gap_benchmark::score::outcome::{self, CONFIDENT, Given};
use caudata_gap_benchmark::sets::Plan;

/// Seed of what differs from run to run.
const SEED: u64 = 5;

/// The pendulum with `effect`, recorded in `folder`.
fn recorded(effect: &str, block: Block, folder: &std::path::Path) -> Answer {
    recorded_on("pendulum", &[effect], block, folder)
}

/// A rig with `effects` at its first joint, each four null discrepancies large, recorded in `folder`.
fn recorded_on(
    rig: &'static str,
    effects: &[&str],
    block: Block,
    folder: &std::path::Path,
) -> Answer {
    let effects = effects.iter().map(|e| (find(e).unwrap(), 0, 4.0)).collect();
    let plan = Plan { effects, ..Plan::new(block, rig, SEED, Amount::Full) };
    generate::make("case", &plan, folder).unwrap()
}

/// Diagnosis with the whole catalogue. Whatever has a name is in the extended model, or the summary says that it is
/// not; frames that are lost are measured beside it.
fn diagnosed(case: &std::path::Path) -> Report {
    let report = examinee::diagnose(case, Options::default()).unwrap();
    let carried = |c: &Cause| {
        let same = |m: &Carried| m.effect == c.effect && m.location == c.location;
        c.effect == "dropped_frames" || report.model.iter().any(same)
    };
    assert!(
        report.causes.iter().all(carried) || report.summary.contains("does without"),
        "{}: {:?}",
        report.summary,
        report.model
    );
    report
}

fn in_words(causes: &[Cause]) -> String {
    let each = causes.iter().map(|c| format!("{} {:.2}", c.effect, c.confidence));
    each.collect::<Vec<_>>().join(", ")
}

/// What stands for a law outside the catalogue is a partial explanation without a sure name.
fn is_unsure(report: &Report) {
    assert_eq!(report.verdict, Verdict::PartlyExplained, "{}", report.summary);
    assert!(report.causes.iter().all(|c| c.confidence < CONFIDENT), "{}", in_words(&report.causes));
}

#[test]
fn the_drag_of_a_sail_is_no_sure_viscous_friction() {
    let root = tempfile::tempdir().unwrap();
    recorded("air_drag_of_a_sail", Block::Outside, root.path());
    let report = diagnosed(&root.path().join("case"));
    // a drag with the square of the speed is much like one with the speed; slow and fast motions ask for other
    // sizes of that
    is_unsure(&report);
    let inconstant = |d: &Doubt| d.kind == DoubtKind::InconstantSize;
    assert!(report.doubts.iter().any(inconstant), "{:?}", report.doubts);
}

#[test]
fn a_gain_that_grows_with_the_error_is_no_sure_gain() {
    let root = tempfile::tempdir().unwrap();
    recorded("gain_grows_with_error", Block::Outside, root.path());
    let report = diagnosed(&root.path().join("case"));
    is_unsure(&report);
    // one gain explains most of it; but small errors, and slow motions with them, ask for less of it than
    // large ones
    let inconstant = |d: &Doubt| {
        d.kind == DoubtKind::InconstantSize
            && d.location == "kp_error@swing"
            && ["From slow to fast", "From small errors"].iter().any(|w| d.detail.starts_with(w))
    };
    assert!(report.doubts.iter().any(inconstant), "{:?}", report.doubts);
}

#[test]
fn a_report_says_that_nothing_was_held_out() {
    let root = tempfile::tempdir().unwrap();
    recorded("coulomb_friction", Block::Single, root.path());
    let case = root.path().join("case");
    // one trial, and no other
    for entry in std::fs::read_dir(&case).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if path.is_dir() && !name.starts_with("fit_triangles") {
            std::fs::remove_dir_all(&path).unwrap();
        }
    }
    let summary = diagnosed(&case).summary;
    assert!(summary.contains("No hold-out was given"), "{summary}");
}

#[test]
fn an_integral_part_is_named_although_held_out_runs_hardly_ask_for_it() {
    let root = tempfile::tempdir().unwrap();
    let answer = recorded("integral_action", Block::Single, root.path());
    let truth = answer.effects[0].parameters[0].value;
    let report = diagnosed(&root.path().join("case"));
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!(cause.effect, "integral_action");
    let ki = &cause.parameters["ki_nm_per_rad_s"];
    assert!((ki.value - truth).abs() < 0.15 * truth, "{} of {truth}", ki.value);
}

#[test]
fn the_delay_of_a_loop_is_no_delay_of_a_measurement() {
    let root = tempfile::tempdir().unwrap();
    let answer = recorded("servo_loop_delay", Block::Single, root.path());
    let truth_s = answer.effects[0].parameters[0].value;
    let report = diagnosed(&root.path().join("case"));
    let first = &report.causes[0];
    assert_eq!(first.effect, "servo_loop_delay", "{}", report.summary);
    let delay_s = first.parameters["delay_s"].value;
    assert!((delay_s - truth_s).abs() < 0.2 * truth_s, "{delay_s} of {truth_s}");
}

#[test]
fn two_gains_that_look_alike_are_both_named() {
    let root = tempfile::tempdir().unwrap();
    let hidden = ["kp_error", "kd_error"];
    let answer = recorded_on("pendulum", &hidden, Block::Pair, root.path());
    let report = diagnosed(&root.path().join("case"));
    assert_eq!(report.causes.len(), 2, "{}", in_words(&report.causes));
    let given = Given { report: Some(report), failure: String::new(), seconds: 0.0 };
    let links = [("swing".to_owned(), "arm".to_owned())];
    for effect in outcome::judge(&answer, &given, &links).truth {
        let right = effect.named && effect.interval_holds == Some(true);
        assert!(right, "{effect:?}");
    }
}

#[test]
fn two_that_are_one_robot_with_another_two_are_in_its_answer_set() {
    let root = tempfile::tempdir().unwrap();
    let hidden = ["armature", "link_com"];
    let answer = recorded_on("pendulum", &hidden, Block::Pair, root.path());
    let report = diagnosed(&root.path().join("case"));
    // of a link on one hinge its moment of gravity and its inertia show, whatever makes them
    assert_eq!(report.verdict, Verdict::Ambiguous, "{}", report.summary);
    let given = Given { report: Some(report), failure: String::new(), seconds: 0.0 };
    let links = [("swing".to_owned(), "arm".to_owned())];
    for effect in outcome::judge(&answer, &given, &links).truth {
        assert!(effect.named && effect.in_set, "{effect:?}");
    }
}

#[test]
fn beside_play_a_displaced_centre_is_in_an_answer_set() {
    let root = tempfile::tempdir().unwrap();
    // teeth that bounce leave it open whether the centre is displaced or a mass hangs there, with less friction
    const SEED: u64 = 12_952_229_155_965_646_331;
    let effects = ["link_com", "gear_backlash"].map(|id| (find(id).unwrap(), 0, 4.0)).to_vec();
    let plan = Plan { effects, ..Plan::new(Block::Pair, "pendulum", SEED, Amount::Full) };
    generate::make("case", &plan, root.path()).unwrap();
    let report = diagnosed(&root.path().join("case"));
    let (play, others): (Vec<&Cause>, Vec<&Cause>) =
        report.causes.iter().partition(|c| c.effect == "gear_backlash");
    let sure = |c: &&Cause| c.confidence > CONFIDENT && c.alternatives.is_empty();
    assert!(play.iter().any(sure), "{}", report.summary);
    assert!(!others.iter().any(sure), "{}", report.summary);
    let has_centre =
        |c: &&Cause| c.effect == "link_com" || c.alternatives.iter().any(|a| a == "link_com");
    assert!(others.iter().any(has_centre), "{}", report.summary);
}

#[test]
fn a_supply_that_nobody_logs_is_named_before_two_limits_that_are_alike_by_chance() {
    let root = tempfile::tempdir().unwrap();
    recorded_on("arm", &["supply_level"], Block::Single, root.path());
    let report = diagnosed(&root.path().join("case"));
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!(cause.effect, "supply_level");
    // the same in all joints at once: nothing tells them apart
    assert_eq!(cause.alternatives, ["voltage_limit"]);
    assert_eq!(report.verdict, Verdict::Ambiguous);
}

#[test]
fn a_motor_that_is_limited_as_it_drives_may_brake_as_before() {
    let root = tempfile::tempdir().unwrap();
    let answer = recorded_on("arm", &["torque_limit"], Block::Single, root.path());
    let truth_nm = answer.effects[0].parameters[0].value;
    let report = diagnosed(&root.path().join("case"));
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!((cause.effect.as_str(), report.verdict), ("torque_limit", Verdict::Explained));
    let limit_nm = cause.parameters["limit_nm"].value;
    assert!((limit_nm - truth_nm).abs() < 0.1 * truth_nm, "{limit_nm} of {truth_nm}");
    // with a limit that holds both ways its fall under gravity is braked far too little; how much more is
    // allowed than was asked for nobody can tell
    assert!(cause.parameters["braking_freed"].value > 0.1);
}

#[test]
fn outside_its_band_a_controller_may_act_on_the_whole_error() {
    let root = tempfile::tempdir().unwrap();
    let answer = recorded("controller_dead_band", Block::Single, root.path());
    let truth_rad = answer.effects[0].parameters[0].value;
    let report = diagnosed(&root.path().join("case"));
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!(cause.effect, "controller_dead_band");
    // the edge of a jump has no slope to follow: what a fit begins with stays within a tenth of what it
    // should be, and the interval knows
    let width = &cause.parameters["half_width_rad"];
    assert!((width.ci_low..=width.ci_high).contains(&truth_rad), "{width:?} of {truth_rad}");
    assert!((width.value - truth_rad).abs() < 0.15 * truth_rad, "{width:?} of {truth_rad}");
    assert!(cause.parameters["jump"].value > 0.7);
}

#[test]
fn what_stands_beside_a_drift_is_no_finding() {
    let root = tempfile::tempdir().unwrap();
    recorded("friction_drift", Block::Single, root.path());
    let report = diagnosed(&root.path().join("case"));
    // the true friction bends by as much as before it slides, however much it grows; the catalogue's grows
    // stiffer with it
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!(cause.effect, "friction_drift");
    // how much of it there is hangs on the speed, which says nothing of the drift
    assert!(cause.confidence > 0.7, "{}: {}", report.summary, in_words(&report.causes));
    // whether anything makes up for the bend hangs on which of its chirps are taken for repeats: it is a lead, or
    // without a name, and the summary says so
    let beside: Vec<_> = report.model.iter().filter(|m| m.effect != "friction_drift").collect();
    let is_lead = |m: &Carried| report.leads.iter().any(|lead| lead.effect == m.effect);
    assert!(beside.iter().all(|m| m.named == is_lead(m)), "{} {beside:?}", report.summary);
    let said = report.summary.contains("no finding");
    assert_eq!(said, !beside.is_empty(), "{} {beside:?}", report.summary);
    let errors = &report.position_errors;
    let of = |model: &str| errors.iter().find(|e| e.model == model).unwrap().mean_rad;
    assert!(of("extended") < 0.6 * of("as given"), "{errors:?}");
}

#[test]
fn frames_that_every_run_loses_elsewhere_are_measured_by_what_repeats_differ_by() {
    let root = tempfile::tempdir().unwrap();
    let answer = recorded("dropped_frames", Block::Single, root.path());
    let report = diagnosed(&root.path().join("case"));
    let [cause] = report.causes.as_slice() else {
        panic!("{}: {}", report.summary, in_words(&report.causes));
    };
    assert_eq!(cause.effect, "dropped_frames");
    assert!(cause.confidence > CONFIDENT);
    let truth = answer.effects[0].parameters[0].value;
    let share = &cause.parameters["share"];
    assert!(
        (share.ci_low..=share.ci_high).contains(&truth) && (share.value / truth - 1.0).abs() < 0.4,
        "{share:?} of {truth}"
    );
    // bursts of three
    let burst = &cause.parameters["burst"];
    assert!((1.5..5.0).contains(&burst.value), "{burst:?}");
    // the mean of repeats says next to nothing of it
    assert!(report.summary.contains("what repeats differ by"), "{}", report.summary);
    // where it is not in the catalogue it is not named
    let without = Options { without: vec!["dropped_frames".to_owned()], ..Options::default() };
    let report = examinee::diagnose(&root.path().join("case"), without).unwrap();
    assert!(report.causes.is_empty(), "{}", in_words(&report.causes));
}

#[test]
fn a_law_that_bends_where_it_is_hardly_plausible_is_no_sure_name() {
    let root = tempfile::tempdir().unwrap();
    recorded("coulomb_friction", Block::Outside, root.path());
    let without = ["coulomb_friction", "friction_drift"].map(str::to_owned);
    let options = Options { without: without.to_vec(), ..Options::default() };
    // friction that is more at rest, with a speed beyond which it is less that the joint hardly reaches, is
    // friction without such a speed
    let report = examinee::diagnose(&root.path().join("case"), options).unwrap();
    is_unsure(&report);
}
