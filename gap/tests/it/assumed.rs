//! What a check says of figures that nobody looked up, and of notes that are missing or cannot be.

use std::fs;
use std::path::Path;

use caudata_gap::check::check;
use caudata_gap::excite;
use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, Payload, RunLog, Signal};

use crate::common::{changed, record, simulate};

/// The rig whose gain is assumed; the log says which one was in force, or not.
#[test]
fn an_assumed_gain_is_told_where_no_log_says_which_was_in_force() {
    let file = |name: &str| {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
        fs::read_to_string(folder.join(name)).unwrap()
    };
    let text = file("xl330_pendulum.robot.toml").replacen(
        "format = \"caudata.robot.v1\"",
        "format = \"caudata.robot.v1\"\nassumed = [\"control.kp_nm_per_rad\"]",
        1,
    );
    let mjcf = file("xl330_pendulum.xml");
    let robot = RobotModel::from_bytes("xl330_pendulum", text.as_bytes(), mjcf.as_bytes()).unwrap();
    let trial = excite::trial(&robot, "steps_medium", None, 100.0).unwrap();
    let runs = simulate(&robot, &trial, &[1], None);
    let mut log = record(&robot, &trial, &runs[0], 1);
    let told = |log: &RunLog| {
        let faults = check(&[("run", log)], &robot).faults;
        faults.iter().any(|f| f.location == "control.kp_nm_per_rad" && !f.fatal)
    };
    log.meta.kp = None;
    assert!(told(&log));
    log.meta.kp = Some(robot.kp_nm_per_rad(0));
    assert!(!told(&log));
}

/// Four motions, twice each; of one a run hangs lower under a weight that its notes do not have.
#[test]
fn a_weight_that_is_not_noted_shows_between_repeats() {
    let robot = crate::common::robot("xl330_pendulum");
    let mut logs = Vec::new();
    for name in ["holds", "steps_medium", "chirp_medium", "triangle_medium"] {
        let trial = excite::trial(&robot, name, None, 100.0).unwrap();
        let seeds = [21, 22];
        let runs = simulate(&robot, &trial, &seeds, None);
        logs.extend(runs.iter().zip(seeds).map(|(run, seed)| record(&robot, &trial, run, seed)));
    }
    let told = |logs: &[RunLog]| -> Vec<String> {
        let names: Vec<String> = (0..logs.len()).map(|k| format!("run_{k}")).collect();
        let named: Vec<(&str, &RunLog)> = names.iter().map(String::as_str).zip(logs).collect();
        let faults = check(&named, &robot).faults;
        faults.into_iter().filter(|f| f.kind == "repeats").map(|f| f.location).collect()
    };
    assert!(told(&logs).is_empty(), "{:?}", told(&logs));
    let lower = |q: f64| q - 0.1 * q.sin();
    logs[3] = changed(&logs[3], |signal, _, _, q| match signal {
        Signal::Position(_) => q.map(lower),
        _ => q,
    });
    let found = told(&logs);
    assert!(found.len() == 1 && found[0].ends_with("swing"), "{found:?}");
    assert!(found[0].starts_with("run_2") || found[0].starts_with("run_3"), "{found:?}");
}

/// What a run notes must be of the robot: a joint that it lacks, a base that goes nowhere.
#[test]
fn notes_that_cannot_be_of_the_robot_are_faults() {
    let robot = crate::common::robot("xl330_pendulum");
    let trial = excite::trial(&robot, "holds", None, 100.0).unwrap();
    let runs = simulate(&robot, &trial, &[1], None);
    let log = record(&robot, &trial, &runs[0], 1);
    let fatal = |log: &RunLog| -> Vec<String> {
        let faults = check(&[("run", log)], &robot).faults;
        faults.into_iter().filter(|f| f.fatal).map(|f| f.detail).collect()
    };
    assert!(fatal(&log).is_empty(), "{:?}", fatal(&log));
    let mut other = log.clone();
    other.meta.joint.entry("swing_2".to_owned()).or_default().kp = Some(1.0);
    assert!(fatal(&other).iter().any(|f| f.contains("no actuated joint `swing_2`")));
    let mut grams = log.clone();
    let link = robot.links()[0].name.clone();
    grams.meta.payload.push(Payload { link, mass_kg: 300.0, at_m: [0.0; 3] });
    assert!(fatal(&grams).iter().any(|f| f.contains("write it in kg")));
    let mut millivolts = log.clone();
    millivolts.meta.supply_v = Some(12_000.0);
    assert!(fatal(&millivolts).iter().any(|f| f.contains("write it in V")));
    let mut free = log.clone();
    free.meta.base = BaseHold::Free;
    assert!(fatal(&free).iter().any(|f| f.contains("the base of the robot file is fixed")));
}
