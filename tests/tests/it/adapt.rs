//! `caudata adapt` from end to end: a simulated robot with a soft knee is recorded, the knee is named, a
//! policy is trained in the extended model, and both policies are evaluated, on the robot that was recorded
//! as well. Stopped, it goes on.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;

use caudata_tests::{
    FEW_SAMPLES, Finished, at_work, command, finish, json_file, repository_root, signal,
};
use nix::sys::signal::Signal;
use serde_json::Value;

/// Factor on the position gain of the knee.
const SOFT: f64 = 0.5;
const KNEE: &str = "FL_knee";

fn succeeds(args: &[&str]) -> Finished {
    let done = finish(command("caudata", args).unwrap()).unwrap();
    assert_eq!(done.code, Some(0), "{args:?}\n{}\n{}", done.stdout, done.stderr);
    done
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Records `trial` of the battery on a stand, by `engine`, with the knee's gain at `kp` N·m/rad.
fn record(robot: &Path, folder: &Path, trial: &str, engine: &str, kp: f64) -> PathBuf {
    let battery = folder.join("battery");
    succeeds(&["gap", "excite", "--robot", text(robot), "--out", text(&battery), "--trial", trial]);
    let log = folder.join(trial);
    std::fs::create_dir_all(&log).unwrap();
    let commands = battery.join(format!("{trial}.csv"));
    let out = log.join("log.csv");
    let soft = format!("lane.kp_nm_per_rad.{KNEE}={kp}");
    succeeds(&[
        "sim",
        "rollout",
        "--robot",
        text(robot),
        "--commands",
        text(&commands),
        "--out",
        text(&out),
        "--engine",
        engine,
        "--base",
        "fixed",
        "--rate-hz",
        "100",
        "--set",
        &soft,
    ]);
    assert!(log.join("log.toml").is_file());
    log
}

/// A robot file whose robot has a soft knee, beside the MJCF.
fn soft_robot(robot: &Path, folder: &Path, kp: f64) -> PathBuf {
    let mjcf = robot.with_file_name("polymander.xml");
    std::fs::copy(mjcf, folder.join("polymander.xml")).unwrap();
    let nominal = std::fs::read_to_string(robot).unwrap();
    let path = folder.join("soft.robot.toml");
    let extension = format!(
        "\n[extension]\nbase = \"\"\n\n[extension.lane]\n\"kp_nm_per_rad.{KNEE}\" = {kp}\n"
    );
    std::fs::write(&path, nominal + &extension).unwrap();
    path
}

fn scenarios(evaluation: &Value) -> Vec<&str> {
    let all = evaluation["scenarios"].as_array().unwrap();
    for scenario in all {
        assert_eq!(scenario["episodes"], 2, "{scenario}");
        let falls = scenario["fall_share"]["mean"].as_f64().unwrap();
        assert!((0.0..=1.0).contains(&falls), "{scenario}");
        assert!(scenario["rmse_of_strides"][0].as_f64().unwrap().is_finite(), "{scenario}");
    }
    all.iter().map(|s| s["name"].as_str().unwrap()).collect()
}

/// The knee's position gain, N·m/rad, where `robot` has its own everywhere.
fn soft_kp(robot: &Path) -> f64 {
    let about = succeeds(&["robot", "check", text(robot), "--json"]).last_json().unwrap();
    SOFT * about["kp_nm_per_rad"][0].as_f64().unwrap()
}

#[test]
fn a_soft_knee_is_found_trained_for_and_evaluated() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let root = repository_root();
    let robot = root.join("robots/polymander.robot.toml");
    let kp = soft_kp(&robot);
    let fit: Vec<PathBuf> = ["chirp_medium", "steps_medium", "holds"]
        .map(|t| record(&robot, folder, t, "rapier", kp))
        .to_vec();
    let holdout = record(&robot, folder, "triangle_fast", "rapier", kp);
    let truth = soft_robot(&robot, folder, kp);
    let policy = root.join("policies/flat.onnx");
    let out = folder.join("adapted");

    let mut args = vec![
        "adapt",
        "--policy",
        text(&policy),
        "--out",
        text(&out),
        "--truth",
        text(&truth),
        "--json",
    ];
    for log in &fit {
        args.extend(["--log", text(log)]);
    }
    args.extend(["--holdout", text(&holdout)]);
    for id in ["kp_error", "kd_error", "coulomb_friction", "viscous_friction", "link_mass"] {
        args.extend(["--only", id]);
    }
    args.extend(["--iterations", "2", "--suite", "flat", "--episodes", "2"]);
    args.extend(["--preset", "flat"]);
    args.extend(FEW_SAMPLES);
    let report = succeeds(&args).last_json().unwrap();

    let causes = report["causes"].as_array().unwrap();
    let knee =
        causes.iter().find(|c| c["effect"] == "kp_error").unwrap_or_else(|| panic!("{report}"));
    assert_eq!(knee["where"], serde_json::json!([KNEE]), "{report}");
    let scale = knee["parameters"]["scale"]["value"].as_f64().unwrap();
    assert!((scale - SOFT).abs() < 0.1 * SOFT, "{report}");

    // The extended file is what was trained in, and the new policy began as the old one and is another.
    assert_eq!(report["trained"], true, "{report}");
    let new = PathBuf::from(report["policy"].as_str().unwrap());
    assert_ne!(std::fs::read(&new).unwrap(), std::fs::read(&policy).unwrap());
    let config = std::fs::read_to_string(out.join("run/config.toml")).unwrap();
    assert!(config.contains("extended.robot.toml"), "{config}");
    assert!(config.contains("flat.onnx"), "{config}");

    let names: Vec<Vec<&str>> = [
        "before_in_nominal",
        "before_in_extended",
        "after_in_extended",
        "before_in_truth",
        "after_in_truth",
    ]
    .iter()
    .map(|key| scenarios(&report[*key]))
    .collect();
    assert!(!names[0].is_empty() && names.iter().all(|n| *n == names[0]), "{names:?}");
    // Same policy, same seed: a soft knee changes what it does.
    let speed = |key: &str| report[key]["scenarios"][0]["vx_mps"]["mean"].as_f64().unwrap();
    assert_ne!(speed("before_in_nominal"), speed("before_in_extended"), "{report}");
    assert_eq!(steps(&report).len(), 7, "{report}");
    assert_eq!(json_file(&out.join("adapt.json")).unwrap(), report);

    // What is there is not done again, what is not is, and the same comes out.
    let bare = |report: &Value| {
        let mut bare = report.clone();
        bare.as_object_mut().unwrap().remove("seconds").unwrap();
        bare
    };
    let again = succeeds(&args).last_json().unwrap();
    assert_eq!((bare(&again), steps(&again)), (bare(&report), vec![]));
    std::fs::remove_file(out.join("after_in_truth.json")).unwrap();
    let again = succeeds(&args).last_json().unwrap();
    assert_eq!((bare(&again), steps(&again)), (bare(&report), vec!["after_in_truth"]));
    // With something else it would be another diagnosis.
    let elsewhere = args.iter().copied();
    let elsewhere: Vec<&str> = elsewhere.chain(["--without", "link_mass"]).collect();
    let refused = finish(command("caudata", &elsewhere).unwrap()).unwrap();
    assert_eq!(refused.code, Some(73), "{}", refused.stderr);
    let about = "--without was none and is link_mass";
    assert!(refused.errors()[0].contains(about), "{}", refused.stderr);
    assert_eq!(json_file(&out.join("adapt.json")).unwrap(), again);
}

/// Names of the steps that were done.
fn steps(report: &Value) -> Vec<&str> {
    let steps = report["seconds"].as_array().unwrap().iter();
    steps.map(|s| s[0].as_str().unwrap()).collect()
}

#[test]
fn nothing_is_trained_for_a_robot_that_is_as_its_file_says() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let root = repository_root();
    let robot = root.join("robots/polymander.robot.toml");
    let about = succeeds(&["robot", "check", text(&robot), "--json"]).last_json().unwrap();
    let kp = about["kp_nm_per_rad"][0].as_f64().unwrap();
    let logs = folder.join("logs");
    for trial in ["chirp_medium", "steps_medium", "triangle_fast"] {
        // by the engine that diagnoses: what another engine does otherwise is a gap, and no concern of this
        // test
        let log = record(&robot, folder, trial, "batch", kp);
        std::fs::create_dir_all(&logs).unwrap();
        std::fs::rename(log, logs.join(trial)).unwrap();
    }
    let policy = root.join("policies/flat.onnx");
    let out = folder.join("adapted");
    let args = [
        "adapt",
        "--policy",
        text(&policy),
        "--out",
        text(&out),
        "--log",
        text(&logs),
        "--json",
        "--only",
        "kp_error",
        "--only",
        "coulomb_friction",
    ];
    let report = succeeds(&args).last_json().unwrap();
    assert_eq!(report["verdict"], "no_gap", "{report}");
    assert_eq!(report["trained"], false, "{report}");
    assert!(!out.join("run").exists());
}

/// Starts a command, asks it to stop as soon as it says `word`, and waits for its end: exit code and standard
/// error.
fn stopped_at(word: &str, args: &[&str]) -> (Option<i32>, String) {
    let mut command = command("caudata", args).unwrap();
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let says = lines.any(|line| line.unwrap().contains(word));
    assert!(says, "{args:?} never says {word}");
    signal(&child, Signal::SIGTERM).unwrap();
    // Read on, so that it never waits for a reader.
    lines.for_each(drop);
    let ended = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    (ended.status.code(), said)
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_diagnosis_that_is_stopped_leaves_nothing_half() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let root = repository_root();
    let robot = root.join("robots/polymander.robot.toml");
    let kp = soft_kp(&robot);
    let log = record(&robot, folder, "chirp_medium", "batch", kp);

    let alone = folder.join("alone");
    let diagnose =
        ["gap", "diagnose", "--robot", text(&robot), "--log", text(&log), "--out", text(&alone)];
    let (code, said) = stopped_at("screening", &diagnose);
    // Stopped, it writes what it has, whole, and says that it is unfinished; or, before it has anything, nothing.
    if code == Some(75) {
        assert!(said.contains("error: stopped by SIGTERM"), "{said}");
        assert_eq!(names(&alone), [""; 0]);
    } else {
        let report = std::fs::read_to_string(alone.join("report.json")).unwrap();
        let report: Value = serde_json::from_str(&report).unwrap();
        assert_eq!(report["unfinished"], true, "{said}");
    }

    let policy = root.join("policies/flat.onnx");
    let out = folder.join("adapted");
    let adapt = ["adapt", "--policy", text(&policy), "--log", text(&log), "--out", text(&out)];
    let (code, said) = stopped_at("screening", &adapt);
    assert_eq!(code, Some(75), "{said}");
    assert!(said.contains("error: stopped by SIGTERM"), "{said}");
    assert!(said.contains("the same command goes on"), "{said}");
    assert_eq!(at_work(&out).unwrap(), [0; 0]);
    assert_eq!(names(&out), ["asked.json", "diagnosis", "lock"]);
    // A diagnosis counts once its report is there: pictures of half of it are written over.
    let written = names(&out.join("diagnosis"));
    assert!(!written.contains(&"report.json".to_owned()), "{written:?}");
}
