//! A robot in a pool: another engine, water that stirs a little, motion capture. Where nothing is hidden
//! nothing may be found; what is hidden must be.

use caudata_gap::Options;
use caudata_gap::report::{Report, Verdict};
use caudata_gap_benchmark::examinee;
use caudata_gap_benchmark::salamander::{self, Hides, LabFile, SalamanderPlan};
use caudata_gap_benchmark::truth::free::Channels;
use caudata_runlog::BaseHold;

/// Diagnosis of a robot in which `hidden` was hidden, with the candidates that a pool suggests.
fn report_of(hidden: Hides) -> Report {
    let folder = tempfile::tempdir().unwrap();
    let plan = SalamanderPlan {
        name: "pool".to_owned(),
        file: LabFile::Stiff,
        place: BaseHold::Water,
        hidden,
        channels: Channels { imu: true, mocap: true },
        seed: 5,
        repeats: 2,
    };
    salamander::make(&plan, folder.path(), &|| true).unwrap();
    let options = Options {
        only: ["quadratic_drag", "water_current", "buoyancy", "kp_error"]
            .map(str::to_owned)
            .to_vec(),
        ..Options::default()
    };
    examinee::diagnose(&folder.path().join("pool"), options).unwrap()
}

#[test]
fn a_healthy_swimmer_has_no_gap() {
    let report = report_of(Hides::Nothing);
    let worst: Vec<_> = report.divergence.iter().take(8).collect();
    assert_eq!(report.verdict, Verdict::NoGap, "{}\n{worst:?}", report.summary);
}

#[test]
fn a_current_is_found() {
    // a joint log alone shows next to nothing of it: the robot is carried along, and bends as it did
    let report = report_of(Hides::Current(0.12));
    let causes = &report.causes;
    assert_eq!(causes.len(), 1, "{}", report.summary);
    assert_eq!(causes[0].effect, "water_current");
    let along = &causes[0].parameters["x_mps"];
    assert!(
        along.ci_low <= 0.12 && 0.12 <= along.ci_high && (along.value - 0.12).abs() < 0.03,
        "{along:?}"
    );
}
