//! A robot on a stand in which nothing is hidden: another engine, currents, a day's friction, noise. Nothing may be found.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::Path;
use std::sync::Arc;

use caudata_gap::report::Verdict;
use caudata_gap::{Options, Request, Role, Run, diagnose};
use caudata_hidden_effects::stand;
use caudata_model::RobotModel;
use caudata_runlog::RunLog;
use caudata_sim::LaneParams;

#[test]
fn a_healthy_salamander_has_no_gap() {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let file = robots.join("polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&file).unwrap());
    let lane = LaneParams::nominal(&model);
    let folder = tempfile::tempdir().unwrap();
    let trials = [
        ("chirp_medium", Role::Fit),
        ("steps_medium", Role::Fit),
        ("triangle_fast", Role::Holdout),
    ];
    let runs = trials.iter().enumerate().map(|(i, &(trial, role))| {
        let dir = folder.path().join(trial);
        stand::record(&model, &lane, trial, 7, i as u64, &dir).unwrap();
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
            only: ["kp_error", "command_delay", "torque_constant"]
                .map(str::to_owned)
                .to_vec(),
            ..Options::default()
        },
    };
    let report = diagnose(&request, &mut |_| ()).unwrap().report;
    assert_eq!(
        report.verdict,
        Verdict::NoGap,
        "{}\n{:?}",
        report.summary,
        report.divergence.iter().take(8).collect::<Vec<_>>()
    );
}
