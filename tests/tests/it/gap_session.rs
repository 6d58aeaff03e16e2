//! `caudata gap session` from end to end, on a servo that swings a weight.

use std::path::Path;

use caudata_tests::{Finished, command, finish, repository_root};
use serde_json::Value;

/// Holds a session in `folder`; `truth` is what is simulated.
fn session(folder: &Path, truth: Option<&Path>) -> (Finished, Value) {
    let robot = repository_root().join("robots/xl330_pendulum.robot.toml");
    let mut args = vec!["gap", "session", "--json", "--threads", "2"];
    args.extend(["--place", "stand", "--robot", robot.to_str().unwrap()]);
    if let Some(truth) = truth {
        args.extend(["--truth", truth.to_str().unwrap()]);
    }
    args.push(folder.to_str().unwrap());
    let done = finish(command("caudata", &args).unwrap()).unwrap();
    let last = done.stdout.lines().last().unwrap_or_default();
    let told = serde_json::from_str(last).unwrap_or_else(|_| panic!("{}", done.stderr));
    (done, told)
}

/// The robot file with another gain than logs say that it has.
fn soft(folder: &Path) -> std::path::PathBuf {
    let robots = repository_root().join("robots");
    let text = std::fs::read_to_string(robots.join("xl330_pendulum.robot.toml")).unwrap();
    let changed = text.replace("kp_nm_per_rad = 0.886", "kp_nm_per_rad = 0.7");
    assert_ne!(text, changed);
    let truth = folder.join("truth.robot.toml");
    std::fs::write(&truth, changed).unwrap();
    let mjcf = "xl330_pendulum.xml";
    std::fs::copy(robots.join(mjcf), folder.join(mjcf)).unwrap();
    truth
}

#[test]
fn a_healthy_servo_is_called_so_within_the_motion_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let robot = repository_root().join("robots/xl330_pendulum.robot.toml");
    let (done, told) = session(&folder.path().join("s"), Some(&robot));
    assert_eq!(done.code, Some(0), "{told:#}");
    assert_eq!((&told["ending"], &told["verdict"]), (&"sure".into(), &"no_gap".into()));
    assert!(told["motion_s"].as_f64().unwrap() <= 120.0, "{told:#}");
}

#[test]
fn a_soft_servo_is_named_and_the_session_goes_on_from_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let truth = soft(folder.path());
    let simulated = folder.path().join("simulated");
    let (done, told) = session(&simulated, Some(&truth));
    assert_eq!(done.code, Some(0), "{told:#}");
    assert_eq!(told["ending"], "sure", "{told:#}");
    // a servo without a damping term: a gain that was never taken over is the same
    let cause = &told["causes"][0];
    let size = ["scale", "ratio"].map(|name| &cause["parameters"][name]["value"]);
    assert!(cause["effect"] == "kp_error" || cause["effect"] == "stale_gains", "{told:#}");
    let size = size.iter().find_map(|v| v.as_f64()).unwrap();
    assert!((size - 0.7 / 0.886).abs() < 0.02, "{size}");
    assert!(told["motion_s"].as_f64().unwrap() <= 60.0, "{told:#}");
    let last =
        simulated.join("rounds").join(format!("{:02}", told["rounds"].as_array().unwrap().len()));
    assert!(last.join("extended.robot.toml").is_file() && last.join("report.html").is_file());
    // the same command has nothing more to do
    let (_, again) = session(&simulated, Some(&truth));
    assert_eq!(told["rounds"], again["rounds"]);

    // the same robot as a real one: it asks, and goes on once the log lies there
    let real = folder.path().join("real");
    let (done, asks) = session(&real, None);
    assert_eq!((done.code, &asks["ending"]), (Some(83), &"waiting".into()), "{asks:#}");
    assert!(Path::new(asks["next"]["commands"].as_str().unwrap()).is_file());
    assert_eq!(asks["next"]["trial"], told["rounds"][0]["trial"]);
    let trial = asks["next"]["trial"].as_str().unwrap();
    let log = Path::new(asks["next"]["log"].as_str().unwrap());
    std::fs::create_dir_all(log).unwrap();
    for name in ["log.csv", "log.toml"] {
        let recorded = simulated.join("logs").join(format!("01_{trial}")).join(name);
        std::fs::copy(recorded, log.join(name)).unwrap();
    }
    let (_, goes_on) = session(&real, None);
    let first = &goes_on["rounds"][0];
    assert_eq!(first, &told["rounds"][0]);
    assert!(first["verdict"].is_null(), "three trials come before the first diagnosis");
    assert_eq!(goes_on["next"]["trial"], told["rounds"][1]["trial"]);
}
