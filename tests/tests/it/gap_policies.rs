//! `caudata gap policies` from end to end: policies are trained in a model as given, in an extended one and
//! with wide randomisation, and run on a third robot; what the report adds up is added up here once more.

use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::time::Duration;

use caudata_tests::{
    FEW_SAMPLES, Finished, at_work, command, finish, json_file, repository_root, signal,
};
use nix::sys::signal::Signal;
use serde_json::Value;

fn run(args: &[&str]) -> Finished {
    finish(command("caudata", args).unwrap()).unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A robot file of stiff girdles whose servos have `torque` of their torque.
fn robot(folder: &Path, name: &str, torque: f64) -> PathBuf {
    let robots = repository_root().join("robots");
    std::fs::copy(robots.join("polymander.xml"), folder.join("polymander.xml")).unwrap();
    let nominal = std::fs::read_to_string(robots.join("polymander.robot.toml")).unwrap();
    let stiff = |line: &str| match line.starts_with("half_width_rad") {
        true => "half_width_rad = 0.0\n".to_owned(),
        false => format!("{line}\n"),
    };
    let mut file: String = nominal.lines().map(stiff).collect();
    if torque < 1.0 {
        file += "\n[extension]\nbase = \"\"\n\n[extension.lane]\n";
        for leg in ["FL", "FR", "HL", "HR"] {
            file += &format!(
                "\"torque_scale.{leg}_hip\" = {torque}\n\"torque_scale.{leg}_knee\" = {torque}\n"
            );
        }
    }
    let path = folder.join(name);
    std::fs::write(&path, file).unwrap();
    path
}

/// Mean over scenarios of one figure of an evaluation.
fn power(evaluation: &Value) -> f64 {
    let scenarios = evaluation["scenarios"].as_array().unwrap();
    let sum: f64 = scenarios.iter().map(|s| s["power_w"]["mean"].as_f64().unwrap()).sum();
    sum / scenarios.len() as f64
}

#[test]
fn three_ways_to_train_are_compared_on_the_robot() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let given = robot(folder, "given.robot.toml", 1.0);
    let extended = robot(folder, "extended.robot.toml", 0.12);
    let truth = robot(folder, "truth.robot.toml", 0.1);
    let out = folder.join("out");
    let effort = ["--iterations", "1", "--episodes", "2"];
    let mut args = flags([&given, &extended, &truth], &out, &effort);
    args.extend(["--json", "--seeds", "2"].map(str::to_owned));
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let done = run(&args);
    assert_eq!(done.code, Some(0), "{}\n{}", done.stdout, done.stderr);
    let report = done.last_json().unwrap();
    assert_eq!(json_file(&out.join("policies.json")).unwrap(), report);

    let ways = report["ways"].as_array().unwrap();
    let names: Vec<&str> = ways.iter().map(|w| w["way"].as_str().unwrap()).collect();
    assert_eq!(names, ["as_given", "extended", "wide"]);
    let mut seen = Vec::new();
    let mut powers = Vec::new();
    for (way, robot) in ways.iter().zip([&given, &extended, &given]) {
        let policies = way["policies"].as_array().unwrap();
        assert_eq!(policies.len(), 2);
        for (policy, seed) in policies.iter().zip([1, 2]) {
            assert_eq!(policy["seed"], seed);
            let path = PathBuf::from(policy["policy"].as_str().unwrap());
            seen.push(std::fs::read(&path).unwrap());
            let config = std::fs::read_to_string(path.with_file_name("config.toml")).unwrap();
            assert!(config.contains(text(robot)), "{config}");
            // A wide range is there where it was asked for, and the preset's elsewhere.
            let wide = config.contains("command_delay_s = [0.0, 0.05]");
            assert_eq!(wide, way["way"] == "wide", "{config}");
            // Servos of a tenth of their torque show.
            assert_ne!(power(&policy["at_home"]), power(&policy["in_truth"]));
            assert_eq!(policy["in_rapier"]["episodes"], 1);
        }
        powers.push([0, 1].map(|k| power(&policies[k]["in_truth"])));
    }
    // Every training is another: by seed, by model, by randomisation.
    for (i, policy) in seen.iter().enumerate() {
        assert!(!seen[..i].contains(policy), "policy {i} is there twice");
    }
    // Means and gains once more, by hand: two trainings, t = 12.706.
    let mean = |x: [f64; 2]| 0.5 * (x[0] + x[1]);
    let near = |got: &Value, want: f64| {
        let got = got.as_f64().unwrap();
        assert!((got - want).abs() < 1e-9, "{got} is not {want}");
    };
    for (way, own) in ways.iter().zip(&powers) {
        near(&way["in_truth"]["power_w"]["mean"], mean(*own));
        let gain = &way["gain"];
        if way["way"] == "as_given" {
            assert!(gain.is_null());
            continue;
        }
        let less = [0, 1].map(|k| powers[0][k] - own[k]);
        near(&gain["power_w"]["mean"], mean(less));
        let half = 12.706 * 0.5 * (less[0] - less[1]).abs();
        near(&gain["power_w"]["ci_high"], mean(less) + half);
    }
    let speed = &ways[0]["speed"];
    let count = |key: &str| speed[key].as_array().unwrap().len();
    assert!(count("time_s") > 100 && count("mean_mps") == count("time_s"));
    let page = std::fs::read_to_string(out.join("policies.html")).unwrap();
    assert!(page.contains("as given, wide randomisation"), "{page}");
}

#[test]
fn what_cannot_be_read_is_said_before_anything_is_trained() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let given = robot(folder, "given.robot.toml", 1.0);
    let missing = folder.join("missing.robot.toml");
    let out = folder.join("out");
    let mut args = vec!["gap", "policies"];
    for (flag, path) in
        [("--robot", &given), ("--extended", &missing), ("--truth", &given), ("--out", &out)]
    {
        args.extend([flag, text(path)]);
    }
    let done = run(&args);
    assert_eq!(done.code, Some(66), "{}", done.stderr);
    assert_eq!(done.errors().len(), 1, "{}", done.stderr);
    assert!(done.errors()[0].contains("missing.robot.toml"));
    assert!(!out.exists());
}

/// Flags of a comparison of trainings that take seconds: in a robot as given and in an extended one, run on a
/// true one.
fn flags([given, extended, truth]: [&PathBuf; 3], out: &PathBuf, extra: &[&str]) -> Vec<String> {
    let mut args = vec!["gap", "policies", "--preset", "quick"];
    for (flag, path) in
        [("--robot", given), ("--extended", extended), ("--truth", truth), ("--out", out)]
    {
        args.extend([flag, text(path)]);
    }
    args.extend(["--suite", "flat", "--referee-episodes", "1"]);
    args.extend(FEW_SAMPLES);
    args.extend(extra);
    args.into_iter().map(str::to_owned).collect()
}

/// The same of one seed and without an extension.
fn tiny(folder: &Path, extra: &[&str]) -> Vec<String> {
    let given = robot(folder, "given.robot.toml", 1.0);
    let truth = robot(folder, "truth.robot.toml", 0.5);
    let out = folder.join("out");
    let mut args = flags([&given, &given, &truth], &out, extra);
    args.extend(["--seeds", "1"].map(str::to_owned));
    args
}

/// Starts it, and waits until `file` is there.
fn started(args: &[String], file: &Path) -> Child {
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let mut command = command("caudata", &args).unwrap();
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    while !file.exists() {
        assert_eq!(child.try_wait().unwrap(), None, "no {}", file.display());
        std::thread::sleep(Duration::from_millis(10));
    }
    child
}

#[test]
fn what_was_stopped_goes_on_and_nothing_is_done_twice() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let out = folder.join("out");
    let effort = ["--iterations", "1", "--episodes", "2"];
    let args = tiny(folder, &effort);
    let first = out.join("as_given_1");
    let child = started(&args, &first.join("report.json"));
    signal(&child, Signal::SIGTERM).unwrap();
    let stopped = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&stopped.stderr);
    assert_eq!(stopped.status.code(), Some(75), "{said}");
    assert!(said.contains("error: stopped by SIGTERM"), "{said}");
    assert_eq!(at_work(&out).unwrap(), [0; 0]);
    assert!(!out.join("policies.json").exists());

    let kept: Vec<PathBuf> = ["policy.onnx", "report.json", "run_id.txt", "../as_given_1.log"]
        .map(|name| first.join(name))
        .to_vec();
    let read = || -> Vec<Vec<u8>> { kept.iter().map(|p| std::fs::read(p).unwrap()).collect() };
    let before = read();
    assert!(!before[3].is_empty());
    let again = |args: &[String]| run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    // With other flags it would be another experiment.
    let refused = again(&tiny(folder, &["--iterations", "1", "--episodes", "3"]));
    assert_eq!(refused.code, Some(73), "{}", refused.stderr);
    assert_eq!(refused.errors().len(), 1, "{}", refused.stderr);
    assert!(refused.errors()[0].contains("--episodes was 2 and is 3"));
    assert_eq!(read(), before);

    let done = again(&args);
    assert_eq!(done.code, Some(0), "{}\n{}", done.stdout, done.stderr);
    assert_eq!(read(), before);
    let report = json_file(&out.join("policies.json")).unwrap();
    let steps = |report: &Value| -> Vec<String> {
        let steps = report["seconds"].as_array().unwrap().iter();
        steps.map(|s| s[0].as_str().unwrap().to_owned()).collect()
    };
    let took = steps(&report);
    assert!(!took.iter().any(|s| s == "train as_given_1"), "{took:?}");
    for step in ["train wide_1", "evaluate wide_1_in_rapier"] {
        assert!(took.iter().any(|s| s == step), "{took:?}");
    }
    assert!(out.join("policies.html").is_file());

    // Everything is there: the same comes out, and nothing is done.
    let done = again(&args);
    assert_eq!(done.code, Some(0), "{}\n{}", done.stdout, done.stderr);
    let same = json_file(&out.join("policies.json")).unwrap();
    assert_eq!(same["ways"], report["ways"]);
    assert_eq!(steps(&same), [""; 0]);
}

#[test]
fn no_training_outlives_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let args = tiny(folder.path(), &["--iterations", "1000000"]);
    let mut child = started(&args, &out.join("as_given_1/policy.onnx"));
    assert!(at_work(&out).unwrap().len() > 1);
    // Two at once would write over each other's runs.
    let second = run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    assert_eq!(second.code, Some(73), "{}", second.stderr);
    assert_eq!(second.errors().len(), 1, "{}", second.stderr);
    assert!(second.errors()[0].contains("another process is at work"));
    assert_eq!(child.try_wait().unwrap(), None);
    signal(&child, Signal::SIGKILL).unwrap();
    child.wait().unwrap();
    // A million iterations would keep it for days; ending takes as long as saving.
    while !at_work(&out).unwrap().is_empty() {
        std::thread::sleep(Duration::from_millis(50));
    }
    let first = out.join("as_given_1");
    assert!(!first.join("report.json").exists());
    assert!(first.join("checkpoints/latest").exists());
}

#[test]
fn what_cannot_be_used_is_said_before_anything_is_made() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let out = folder.join("out");
    let refused = |args: &[String], code: i32, about: &str| {
        let done = run(&args.iter().map(String::as_str).collect::<Vec<_>>());
        assert_eq!(done.code, Some(code), "{}", done.stderr);
        assert!(done.stderr.contains(about), "{}", done.stderr);
        assert!(!out.exists(), "{args:?}");
    };
    let with = |extra: &[&str]| tiny(folder, extra);
    let paper = |extra: &[&str]| {
        let mut args = vec!["gap", "paper", "--out", text(&out)];
        args.extend(extra);
        args.into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    refused(&with(&["--set", "task.nothing=1"]), 64, "task.nothing");
    refused(&paper(&["--suite", "omnibus"]), 64, "omnibus");
    refused(&paper(&["--preset", "flatter"]), 64, "flatter");
    refused(&paper(&["--policy", "no/policy.onnx"]), 66, "no/policy.onnx");

    // Another robot.
    let args = with(&[]);
    let truth = folder.join("truth.robot.toml");
    let file = std::fs::read_to_string(&truth).unwrap();
    let name = file.lines().find(|l| l.starts_with("name = ")).unwrap();
    std::fs::write(&truth, file.replace(name, "name = \"newt\"")).unwrap();
    refused(&args, 77, "truth.robot.toml: another robot");
}
