//! Two programs where one belongs, and files of others where a program writes or trusts.

use std::fs::{Permissions, create_dir, set_permissions};
use std::os::unix::fs::{PermissionsExt, chown, lchown, symlink};
use std::process::{Child, Stdio};
use std::time::Duration;

use anyhow::{Result, ensure};
use caudata_tests::{command, finish, train};
use nix::sys::signal::Signal;

use super::lab::{Lab, RELEASED, ROBOT, ended_with, started};

pub fn two_servers(lab: &Lab, times: usize) -> Result<String> {
    let data = lab.data()?;
    for _ in 0..times {
        let first = lab.serve(&data, &[])?;
        let folder = data.display().to_string();
        let args = ["--data", &folder, "--addr", "127.0.0.1:0"];
        let second = finish(command("caudata-policy-server", &args)?)?;
        ended_with(&[65, 71, 73, 74, 87], &second)?;
        ensure!(second.stderr.contains("lock"), "{}", second.stderr);
        ended_with(&[0], &finish(lab.pull(first.address, &lab.fresh()?.join("state"))?)?)?;
    }
    Ok("the second is refused, the first serves on".to_owned())
}

/// A supervisor that is killed leaves its learner at work; the next one must not work beside it.
pub fn two_trainings(lab: &Lab, times: usize) -> Result<String> {
    let transports = ["inproc", "zenoh", "iceoryx2"].into_iter().cycle();
    for transport in transports.take(times.max(3)) {
        let out = lab.fresh()?.join("run");
        let flags = ["--transport", transport, "--iterations", "1000000"];
        let flags = [&flags[..], &["--set", "learner.checkpoint_every=5"]].concat();
        let start = |more: &[&str]| -> Result<Child> {
            let mut run = train(&out, &[&flags[..], more].concat())?;
            Ok(run.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?)
        };
        // The learner that holds the folder, and how far it got.
        let learner = || std::fs::read_to_string(out.join("learner.lock")).unwrap_or_default();
        let saved = || {
            let newest = std::fs::read_to_string(out.join("checkpoints/latest")).ok()?;
            newest.trim().trim_start_matches("iter_").parse::<u64>().ok()
        };
        let wait = |run: &mut Child, come: &dyn Fn() -> bool| -> Result<()> {
            while !come() {
                ensure!(run.try_wait()?.is_none(), "{transport}: a training ended");
                std::thread::sleep(Duration::from_millis(20));
            }
            Ok(())
        };
        let mut first = start(&[])?;
        wait(&mut first, &|| saved().is_some())?;
        ended_with(&[87], &finish(train(&out, &[&flags[..], &["--resume"]].concat())?)?)?;
        let orphan = learner();
        first.kill()?;
        first.wait()?;
        // It waits until the first learner has saved, and goes on from there.
        let mut second = start(&["--resume"])?;
        wait(&mut second, &|| learner() != orphan && !learner().is_empty())?;
        let then = saved();
        wait(&mut second, &|| saved() > then)?;
        caudata_tests::signal(&second, Signal::SIGTERM)?;
        ensure!(second.wait()?.success(), "{transport}: the second training failed");
        let books = caudata_tests::json_file(&out.join("accounting.json"))?;
        ensure!(books["holds"] == true, "{transport}: {books}");
    }
    Ok("refused beside it (87); after its death the next one goes on, books hold".to_owned())
}

pub fn two_robots(lab: &Lab, times: usize) -> Result<String> {
    let server = lab.serve(&lab.data()?, &[])?;
    let simulated = started("caudata", "robot_link", &["sim", "robot", "--addr", "127.0.0.1:0"])?;
    for _ in 0..times {
        let state = lab.fresh()?.join("state");
        let run = || -> Result<_> {
            let (server, bus) = (server.address.to_string(), format!("sim:{}", simulated.address));
            let mut run =
                command("caudata-robot", &["run", "--robot", ROBOT, "--stream", RELEASED])?;
            run.args(["--policy-server", &server, "--bus", &bus, "--hang-ms", "60000"]);
            run.args(["--seconds", "600", "--state"]).arg(&state);
            Ok(run)
        };
        let mut first = run()?.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
        while !state.join("state.json").exists() {
            ensure!(first.try_wait()?.is_none(), "the first robot ended");
            std::thread::sleep(Duration::from_millis(20));
        }
        let second = finish(run()?)?;
        caudata_tests::signal(&first, Signal::SIGTERM)?;
        let first = first.wait()?;
        ended_with(&[65, 69, 71, 73], &second)?;
        ensure!(first.success(), "the first one ended with {first}");
    }
    Ok("the second is refused, the first walks on".to_owned())
}

/// What another user put where a program is about to write.
pub fn links(lab: &Lab, times: usize) -> Result<String> {
    if !nix::unistd::geteuid().is_root() {
        return Ok("not tried: it takes root to be another user".to_owned());
    }
    for number in 0..times {
        let victim = lab.fresh()?;
        let run = format!("siege-{}-{number}", std::process::id());
        let place = std::env::temp_dir().join(format!("caudata-actors-{run}"));
        let args = ["actors", "--connect", "tcp/127.0.0.1:1", "--count", "1", "--run-id", &run];
        symlink(&victim, &place)?;
        lchown(&place, Some(12_345), Some(12_345))?;
        let through_link = finish(command("caudata", &args)?);
        std::fs::remove_file(&place)?;
        ended_with(&[73], &through_link?)?;
        create_dir(&place)?;
        chown(&place, Some(12_345), None)?;
        let into_foreign = finish(command("caudata", &args)?);
        std::fs::remove_dir_all(&place)?;
        ended_with(&[73], &into_foreign?)?;
        ensure!(std::fs::read_dir(&victim)?.next().is_none(), "it wrote through a link");

        // The folder in which the robot's two processes meet.
        let place = lab.fresh()?.join("run");
        create_dir(&place)?;
        set_permissions(&place, Permissions::from_mode(0o777))?;
        let state = lab.fresh()?.join("state").display().to_string();
        let args = [
            "run",
            "--robot",
            ROBOT,
            "--stream",
            "s",
            "--state",
            &state,
            "--bus",
            "sim:127.0.0.1:1",
        ];
        let mut robot = command("caudata-robot", &args)?;
        robot.arg("--run-dir").arg(&place);
        ended_with(&[65, 71, 73], &finish(robot)?)?;
    }
    Ok("refused (73 and the like), nothing written through".to_owned())
}

/// Each secret with a mode by which others may read it.
pub fn open_secrets(lab: &Lab, _: usize) -> Result<String> {
    let exposed = |name: &str| -> Result<String> {
        let path = lab.fresh()?.join(name);
        std::fs::copy(lab.at("release.key"), &path)?;
        set_permissions(&path, Permissions::from_mode(0o644))?;
        Ok(path.display().to_string())
    };
    let (release, fresh, link) = (exposed("r.key")?, exposed("f.key")?, exposed("l.key")?);
    let data = lab.data()?.display().to_string();
    let folder = lab.fresh()?;
    std::fs::copy(&link, folder.join("tls.key"))?;
    set_permissions(folder.join("tls.key"), Permissions::from_mode(0o644))?;
    let tls = folder.display().to_string();
    let state = lab.fresh()?.join("state").display().to_string();
    let tries: [(&str, Vec<&str>); 4] = [
        (
            "caudata",
            vec![
                "policy", "release", "--stream", "lab", "--to", "x", "--key", &release, "--key-id",
                "a",
            ],
        ),
        (
            "caudata-policy-server",
            vec![
                "--data",
                &data,
                "--addr",
                "127.0.0.1:0",
                "--fresh-key",
                &fresh,
                "--fresh-key-id",
                "a",
            ],
        ),
        ("caudata-robot", vec!["drive", "127.0.0.1:1", "--link-key", &link]),
        (
            "caudata-robot",
            vec![
                "pull",
                "--robot",
                ROBOT,
                "--stream",
                "s",
                "--state",
                &state,
                "--tls-dir",
                &tls,
                "--policy-server",
                "https://127.0.0.1:1",
            ],
        ),
    ];
    for (program, args) in &tries {
        let done = finish(command(program, args)?)?;
        ended_with(&[65, 66], &done)?;
        ensure!(done.stderr.contains("others may use"), "{args:?}: {}", done.stderr);
    }
    Ok(format!("{} kinds, refused", tries.len()))
}
