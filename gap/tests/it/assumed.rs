//! What a check says of figures that nobody looked up.

use std::fs;
use std::path::Path;

use caudata_gap::check::check;
use caudata_gap::excite;
use caudata_model::RobotModel;
use caudata_runlog::RunLog;

use crate::common::{record, simulate};

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
