//! Bad input, one small program per fault: one clear line, its own exit code, and nothing that was saved is
//! lost.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use caudata_tests::{Finished, binary, command, finish, repository_root, skipped, train};

/// It ended with `code` and exactly one error line, which holds each of `words`.
fn refused(finished: &Finished, code: i32, words: &[&str]) {
    let errors = finished.errors();
    assert_eq!(finished.code, Some(code), "{}\n{}", finished.stdout, finished.stderr);
    assert_eq!(errors.len(), 1, "one line says it: {}", finished.stderr);
    for word in words {
        assert!(errors[0].contains(word), "`{word}` is not in: {}", errors[0]);
    }
    assert!(!finished.stderr.contains("panicked"), "{}", finished.stderr);
}

#[test]
fn an_unknown_configuration_key_names_the_one_that_was_meant() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.toml");
    fs::write(&file, "[learner.ppo]\ngama = 0.98\n").unwrap();
    let out = folder.path().join("run");
    let run = train(&out, &["--config", file.to_str().unwrap()]).unwrap();
    refused(&finish(run).unwrap(), 64, &["gama", "gamma"]);
    assert!(!out.exists(), "a refused configuration leaves no run folder");
}

#[test]
fn a_full_disk_behind_standard_output_is_told() {
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let mut run = Command::new(binary("caudata").unwrap());
    let done = run.args(["config", "show"]).stdout(full).output().unwrap();
    let told = String::from_utf8_lossy(&done.stderr);
    assert!(done.status.code() == Some(74) && told.contains("standard output"), "{told}");
}

#[test]
fn a_value_out_of_range_is_refused_before_anything_starts() {
    let folder = tempfile::tempdir().unwrap();
    let run = train(&folder.path().join("run"), &["--set", "learner.ppo.gamma=1.5"]).unwrap();
    refused(&finish(run).unwrap(), 64, &["gamma"]);
}

#[test]
fn a_wrong_robot_file_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let robots = repository_root().join("robots");
    let text = fs::read_to_string(robots.join("polymander.robot.toml")).unwrap();
    let wrong = folder.path().join("wrong.robot.toml");
    fs::write(&wrong, text.replacen("spine_1", "spine_9", 1)).unwrap();
    fs::copy(robots.join("polymander.xml"), folder.path().join("polymander.xml")).unwrap();
    let robot = format!("robot={:?}", wrong.to_str().unwrap());
    let run = train(&folder.path().join("run"), &["--set", &robot]).unwrap();
    refused(&finish(run).unwrap(), 65, &["spine_9"]);

    let robot = format!("robot={:?}", folder.path().join("none.robot.toml").to_str().unwrap());
    let run = train(&folder.path().join("run"), &["--set", &robot]).unwrap();
    refused(&finish(run).unwrap(), 66, &["none.robot.toml"]);
}

#[test]
fn an_extension_of_an_earlier_version_is_refused_with_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let robots = repository_root().join("robots");
    let text = fs::read_to_string(robots.join("polymander.robot.toml")).unwrap();
    let extended = folder.path().join("extended.robot.toml");
    // a parameter that was a lag once, and is a delay now
    let lane =
        "\n[extension]\nbase = \"\"\n\n[extension.lane]\n\"joints.spine_1.loop_lag_s\" = 0.01\n";
    fs::write(&extended, text + lane).unwrap();
    fs::copy(robots.join("polymander.xml"), folder.path().join("polymander.xml")).unwrap();
    let args = ["robot", "check", extended.to_str().unwrap()];
    let check = command("caudata", &args).unwrap();
    let words = ["extended.robot.toml", "loop_lag_s", "diagnose its logs again"];
    refused(&finish(check).unwrap(), 65, &words);
}

#[test]
fn a_port_in_use_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let addr = format!("policy_server.addr={address:?}");
    let run = train(&folder.path().join("run"), &["--iterations", "1", "--set", &addr]).unwrap();
    let taken_port = finish(run).unwrap();
    refused(&taken_port, 71, &[&address]);
    assert!(!taken_port.stderr.contains("killed"), "{}", taken_port.stderr);
    // The refused run took no name away.
    let again = ["--iterations", "1", "--set", "policy_server.addr=\"127.0.0.1:0\""];
    let again = finish(train(&folder.path().join("run"), &again).unwrap()).unwrap();
    assert_eq!(again.code, Some(0), "{}", again.stderr);
}

/// A finished tiny run to do damage to.
fn trained(folder: &Path) -> PathBuf {
    let out = folder.join("run");
    let done = finish(train(&out, &["--iterations", "2"]).unwrap()).unwrap();
    assert_eq!(done.code, Some(0), "{}", done.stderr);
    out
}

#[test]
fn a_truncated_checkpoint_is_refused_and_left_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let out = trained(folder.path());
    let mut states = Vec::new();
    for entry in fs::read_dir(out.join("checkpoints")).unwrap().flatten() {
        let state = entry.path().join("state.safetensors");
        if state.is_file() {
            let bytes = fs::read(&state).unwrap();
            fs::write(&state, &bytes[..bytes.len() / 2]).unwrap();
            states.push((state, bytes.len() / 2));
        }
    }
    assert!(!states.is_empty());
    let run = train(&out, &["--iterations", "3", "--resume"]).unwrap();
    let damaged = finish(run).unwrap();
    refused(&damaged, 78, &["checkpoint"]);
    assert!(damaged.stderr.contains("hint: "), "{}", damaged.stderr);
    for (state, length) in states {
        assert_eq!(fs::metadata(state).unwrap().len(), length as u64, "nothing was overwritten");
    }
    assert!(out.join("policy.onnx").is_file());
}

#[test]
fn the_hint_for_a_damaged_checkpoint_works_as_it_stands() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let every = ["--set", "learner.checkpoint_every=1"];
    let run = |flags: &[&str]| finish(train(&out, &[&every[..], flags].concat()).unwrap()).unwrap();
    assert_eq!(run(&["--iterations", "3"]).code, Some(0));
    let state = out.join("checkpoints/iter_000003/state.safetensors");
    let bytes = fs::read(&state).unwrap();
    fs::write(&state, &bytes[..bytes.len() / 2]).unwrap();
    let damaged = run(&["--iterations", "4", "--resume"]);
    refused(&damaged, 78, &["iter_000003"]);
    let hint = damaged.stderr.split_once("resume with ").unwrap().1;
    let flags: Vec<&str> = hint.split_once(';').unwrap().0.split(' ').collect();
    assert_eq!(flags, ["--resume-from", "iter_000002"]);
    let resumed = run(&[&["--iterations", "4"], &flags[..]].concat());
    assert_eq!(resumed.code, Some(0), "{}", resumed.stderr);
}

#[test]
fn a_run_that_cannot_go_on_as_asked_says_which_key_is_to_blame() {
    let folder = tempfile::tempdir().unwrap();
    let out = trained(folder.path());
    let gamma = ["--resume", "--set", "learner.ppo.gamma=0.9"];
    let run = train(&out, &gamma).unwrap();
    refused(&finish(run).unwrap(), 64, &["learner.ppo.gamma was 0.97 and is 0.9"]);
    fs::remove_file(out.join("config.toml")).unwrap();
    let run = train(&out, &["--resume"]).unwrap();
    refused(&finish(run).unwrap(), 66, &["config.toml"]);
}

/// The policy of a finished run with two joints of its contract exchanged, in both places that name them.
fn with_joints_exchanged(policy: &Path) -> Vec<u8> {
    let mut bytes = fs::read(policy).unwrap();
    // Names of equal length, so that every length in the file stays right.
    for (a, b) in [(&b"spine_1"[..], &b"spine_2"[..])] {
        let mut at = 0;
        while at + a.len() <= bytes.len() {
            if &bytes[at..at + a.len()] == a {
                bytes[at..at + a.len()].copy_from_slice(b);
                at += a.len();
            } else if &bytes[at..at + b.len()] == b {
                bytes[at..at + b.len()].copy_from_slice(a);
                at += b.len();
            } else {
                at += 1;
            }
        }
    }
    bytes
}

#[test]
fn a_policy_with_another_joint_order_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let out = trained(folder.path());
    let wrong = out.join("wrong.onnx");
    fs::write(&wrong, with_joints_exchanged(&out.join("policy.onnx"))).unwrap();
    let arguments = ["eval", "--episodes", "1", "--policy", wrong.to_str().unwrap()];
    refused(&finish(command("caudata", &arguments).unwrap()).unwrap(), 77, &["spine_1", "spine_2"]);
}

#[test]
fn bytes_that_are_no_policy_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let out = trained(folder.path());
    let bytes = fs::read(out.join("policy.onnx")).unwrap();
    let torn = folder.path().join("torn.onnx");
    fs::write(&torn, &bytes[..bytes.len() - 100]).unwrap();
    let arguments = ["policy", "show", torn.to_str().unwrap()];
    refused(&finish(command("caudata", &arguments).unwrap()).unwrap(), 65, &["torn.onnx"]);
}

#[test]
fn a_robot_without_server_and_without_policy_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    // Port 1 is reserved and closed.
    let arguments =
        ["pull", "--robot", "robots/polymander.robot.toml", "--policy-server", "127.0.0.1:1"];
    let mut pull = command("caudata-robot", &arguments).unwrap();
    pull.args(["--stream", "walk", "--state"]).arg(&state);
    refused(&finish(pull).unwrap(), 69, &["127.0.0.1:1"]);
}

/// A small file system of its own, unmounted when dropped. `None` where this user may not mount.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(at: &Path, size: &str) -> Option<Self> {
        fs::create_dir_all(at).unwrap();
        let options = format!("size={size}");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "caudata-test"])
            .arg(at)
            .output()
            .ok()?;
        mounted.status.success().then(|| Self(at.to_path_buf()))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[test]
fn a_full_disk_ends_the_run_and_keeps_what_was_saved() {
    let folder = tempfile::tempdir().unwrap();
    let disk = folder.path().join("disk");
    let Some(_mounted) = SmallDisk::mount(&disk, "6m") else {
        skipped("mounting a small disk needs root");
        return;
    };
    let out = disk.join("run");
    let done = finish(train(&out, &["--iterations", "2"]).unwrap()).unwrap();
    assert_eq!(done.code, Some(0), "{}", done.stderr);
    let policy = fs::read(out.join("policy.onnx")).unwrap();
    let checkpoints = fs::read_dir(out.join("checkpoints")).unwrap().count();

    // Fill the disk to the last block.
    let ballast = disk.join("ballast");
    let filled = fs::write(&ballast, vec![1u8; 16 << 20]);
    assert!(filled.is_err(), "the disk is full");
    let run = finish(train(&out, &["--iterations", "4", "--resume"]).unwrap()).unwrap();
    refused(&run, 74, &["disk full"]);
    assert_eq!(fs::read(out.join("policy.onnx")).unwrap(), policy, "the old policy stands");

    // With space again, the run goes on from what was saved.
    fs::remove_file(&ballast).unwrap();
    assert!(fs::read_dir(out.join("checkpoints")).unwrap().count() >= checkpoints);
    let run = finish(train(&out, &["--iterations", "4", "--resume"]).unwrap()).unwrap();
    assert_eq!(run.code, Some(0), "{}", run.stderr);
}

#[test]
fn a_folder_in_the_place_of_what_is_in_it_is_refused_with_where_that_is() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    fs::create_dir(&run).unwrap();
    fs::write(run.join("run_id.txt"), "a").unwrap();
    let (run, out) = (run.to_str().unwrap(), folder.path().join("o.csv"));
    for (args, words, hint) in [
        (vec!["explain", run], "no run folder", None),
        (vec!["eval", "--policy", run], "is a folder", Some("policy.onnx")),
        (
            vec!["log", "convert", run, "--out", out.to_str().unwrap()],
            "a training",
            Some("run/robot"),
        ),
    ] {
        let done = finish(command("caudata", &args).unwrap()).unwrap();
        refused(&done, 66, &[words]);
        if let Some(hint) = hint {
            assert!(done.stderr.contains(hint), "{}", done.stderr);
        }
    }
}

#[test]
fn a_log_is_not_written_in_a_form_that_is_not_known() {
    let folder = tempfile::tempdir().unwrap();
    let (log, out) = (folder.path().join("log.csv"), folder.path().join("out.foo"));
    fs::write(&log, "t,cmd.a\n0.0,0.0\n0.1,0.1\n").unwrap();
    let args = ["log", "convert", log.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let done = finish(command("caudata", &args).unwrap()).unwrap();
    refused(&done, 64, &[".foo"]);
    assert!(done.stderr.contains(".parquet"), "{}", done.stderr);
    assert!(!out.exists());
}

#[test]
fn an_evaluation_takes_no_ground_but_a_suites() {
    let args = ["eval", "policies/flat.onnx", "--set", "terrain.kind=rough"];
    let done = finish(command("caudata", &args).unwrap()).unwrap();
    refused(&done, 64, &["terrain.kind=rough", "grounds of their own"]);
    assert!(done.stderr.contains("--suite"), "{}", done.stderr);
}

#[test]
fn an_evaluation_that_could_not_write_its_page_does_not_begin() {
    let args = ["eval", "--policy", "policies/flat.onnx", "--report", "/proc/none/page.html"];
    let done = finish(command("caudata", &args).unwrap()).unwrap();
    refused(&done, 73, &["/proc/none/page.html"]);
    assert_eq!(done.stdout, "");
}

#[test]
fn what_config_check_calls_good_a_training_takes() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mine.toml");
    fs::write(&file, "[task.observation]\nterm = [{ name = \"gravity\" }]\n").unwrap();
    let check = |more: &[&str]| {
        let mut args = vec!["config", "check", "--preset", "quick", "--config"];
        args.push(file.to_str().unwrap());
        args.extend(more);
        finish(command("caudata", &args).unwrap()).unwrap()
    };
    refused(&check(&[]), 64, &["learner.network.symmetric = false"]);
    let good = check(&["--set", "learner.network.symmetric=false"]);
    assert_eq!(good.code, Some(0), "{}", good.stderr);
}

/// With the same words and code, and before there is a folder.
#[test]
fn what_a_training_refuses_config_check_refuses() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    for (set, code, words) in [
        ("robot=nix.robot.toml", 66, "nix.robot.toml"),
        ("learner.warm_start.policy=nix.onnx", 66, "nix.onnx"),
        ("learner.warm_start.policy=policies/quadruped.onnx", 77, "other joints"),
        ("engine.kind=mujoco", 64, "checkpoint"),
        ("policy_server.addr=0.0.0.0:0", 64, "needs certificates"),
    ] {
        let check = ["config", "check", "--preset", "quick", "--set", set];
        refused(&finish(command("caudata", &check).unwrap()).unwrap(), code, &[words]);
        let train = ["train", "--preset", "quick", "--set", set, "--out"];
        let train = [&train[..], &[out.to_str().unwrap()]].concat();
        refused(&finish(command("caudata", &train).unwrap()).unwrap(), code, &[words]);
        assert!(!out.exists(), "{set}");
    }
    // What only the learner can refuse.
    let layers = "learner.network.policy_hidden=[7]";
    let begin = "learner.warm_start.policy=policies/flat.onnx";
    let train = ["train", "--preset", "flat", "--set", layers, "--set", begin, "--out"];
    let train = [&train[..], &[out.to_str().unwrap()]].concat();
    refused(&finish(command("caudata", &train).unwrap()).unwrap(), 77, &["its layers are"]);
    assert!(!out.exists());
}

/// A Python without libraries, and none: no fault of the recording.
#[test]
fn a_recording_whose_python_is_not_there_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    let bare = at("bare");
    fs::write(&bare, "#!/bin/sh\nexec python3 -I -S \"$@\"\n").unwrap();
    fs::set_permissions(&bare, fs::Permissions::from_mode(0o755)).unwrap();
    let (table, bag) = (at("log.parquet"), at("bag.db3"));
    for file in [&table, &bag] {
        fs::write(file, "neither of them").unwrap();
    }
    let read = |python: &str, file: &str| {
        let mut run = command("caudata", &["log", "convert", file, "--out"]).unwrap();
        run.arg(at("out")).env("CAUDATA_PYTHON", python);
        finish(run).unwrap()
    };
    refused(&read(&bare, &table), 69, &["log.parquet", "pyarrow", "CAUDATA_PYTHON"]);
    refused(&read("/nowhere", &table), 69, &["/nowhere", "CAUDATA_PYTHON"]);
    let robot = "robots/polymander.robot.toml";
    let draft = |python: &str, map: &str| {
        let mut run = command("caudata", &["gap", "import", &bag, "--robot", robot]).unwrap();
        run.args(["--draft-map", &at(map)]).env("CAUDATA_PYTHON", python);
        finish(run).unwrap()
    };
    refused(&draft("/nowhere", "map.toml"), 69, &["CAUDATA_PYTHON"]);
    refused(&draft("python3", "map.toml"), 65, &["bag.db3"]);
    refused(&draft("python3", "log.parquet"), 73, &["log.parquet is there already"]);
}

#[test]
fn the_robots_program_finds_the_robots_that_came_with_it_from_anywhere() {
    let folder = tempfile::tempdir().unwrap();
    let mut doctor = command("caudata-robot", &["doctor", "--servo-port", "/dev/none"]).unwrap();
    doctor.current_dir(folder.path());
    let done = finish(doctor).unwrap();
    assert!(done.stderr.contains("/dev/none"), "{}", done.stderr);
    assert!(!done.stderr.contains("robot.toml"), "{}", done.stderr);
}

#[test]
fn every_binary_explains_itself_and_refuses_unknown_flags() {
    for name in
        ["caudata", "caudata-actor", "caudata-learner", "caudata-policy-server", "caudata-robot"]
    {
        assert!(binary(name).is_ok(), "{name}");
        let help = finish(command(name, &["--help"]).unwrap()).unwrap();
        assert_eq!(help.code, Some(0), "{name}");
        assert!(help.stdout.contains("Usage"), "{name}");
        let unknown = finish(command(name, &["--no-such-flag"]).unwrap()).unwrap();
        assert_eq!(unknown.code, Some(64), "{name}: {}", unknown.stderr);
    }
}
