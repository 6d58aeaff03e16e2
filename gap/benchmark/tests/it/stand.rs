//! A robot on a stand: another engine, currents, a day's friction, noise. Where nothing is hidden nothing may
//! be found; what is hidden must be.

use std::path::Path;
use std::sync::Arc;

use caudata_gap::report::{Report, Verdict};
use caudata_gap::{Options, Request, Role, Run, diagnose, excite};
use caudata_gap_benchmark::simulated::{self, Robot};
use caudata_model::RobotModel;
use caudata_runlog::RunLog;
use caudata_sim::LaneParams;

/// Diagnosis of a robot to which `fault` was done, recorded on the day of `seed`.
fn report_of(seed: u64, fault: impl Fn(&RobotModel, &mut LaneParams)) -> Report {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let file = robots.join("polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&file).unwrap());
    let mut lane = LaneParams::nominal(&model);
    fault(&model, &mut lane);
    let folder = tempfile::tempdir().unwrap();
    let trials = [
        ("chirp_medium", Role::Fit),
        ("steps_medium", Role::Fit),
        ("triangle_fast", Role::Holdout),
    ];
    let runs = trials.iter().enumerate().map(|(i, &(trial, role))| {
        let dir = folder.path().join(trial);
        let made = excite::trial(&model, trial, None, excite::DEFAULT_RATE_HZ).unwrap();
        let robot = Robot { lab: &model, model: &model, lane: &lane, seed, payload: &[] };
        simulated::record(&robot, &made, i as u64, &dir).unwrap();
        Run {
            log: RunLog::read(&dir).unwrap(),
            name: trial.to_owned(),
            role,
            sha256: String::new(),
        }
    });
    let request = Request {
        robot_toml: std::fs::read(&file).unwrap(),
        mjcf: std::fs::read(robots.join("polymander.xml")).unwrap(),
        label: "polymander".to_owned(),
        runs: runs.collect(),
        data_faults: Vec::new(),
        options: Options {
            only: ["kp_error", "command_delay", "torque_constant"].map(str::to_owned).to_vec(),
            ..Options::default()
        },
    };
    diagnose(&request, &mut |_| ()).unwrap().report
}

fn no_gap(seed: u64) {
    let report = report_of(seed, |_, _| ());
    let worst: Vec<_> = report.divergence.iter().take(8).collect();
    assert_eq!(report.verdict, Verdict::NoGap, "{}\n{worst:?}", report.summary);
}

/// A robot whose `joint` has `share` of its gain: that alone is found, and the share to within `error`.
fn soft_joint_is_found(seed: u64, joint: &str, share: f64, error: f64) {
    let report = report_of(seed, |model, lane| {
        let names = model.actuated_names();
        let at = names.iter().position(|n| *n == joint).unwrap();
        lane.kp_nm_per_rad[at] *= share as f32;
    });
    let causes = &report.causes;
    assert_eq!(causes.len(), 1, "{}", report.summary);
    assert_eq!(causes[0].effect, "kp_error");
    assert_eq!(causes[0].location, [joint]);
    let scale = &causes[0].parameters["scale"];
    assert!(
        scale.ci_low <= share && share <= scale.ci_high && (scale.value - share).abs() < error,
        "{scale:?}"
    );
}

#[test]
fn a_healthy_salamander_has_no_gap() {
    no_gap(7);
}

#[test]
fn a_second_healthy_day_has_no_gap() {
    no_gap(8);
}

#[test]
fn a_soft_knee_is_found() {
    soft_joint_is_found(7, "FL_knee", 0.7, 0.1);
}

#[test]
fn a_slightly_soft_knee_is_found() {
    soft_joint_is_found(8, "FL_knee", 0.8, 0.1);
}

#[test]
fn commands_that_are_late_by_four_milliseconds_are_found() {
    let report = report_of(7, |_, lane| lane.command_delay_s = 0.004);
    let causes = &report.causes;
    assert_eq!(causes.len(), 1, "{}", report.summary);
    assert_eq!(causes[0].effect, "command_delay");
    let delay = &causes[0].parameters["delay_s"];
    assert!(
        delay.ci_low <= 0.004 && 0.004 <= delay.ci_high && (delay.value - 0.004).abs() < 0.001,
        "{delay:?}"
    );
}
