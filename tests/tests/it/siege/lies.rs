//! Servers and files that are not what they say.

use anyhow::{Result, ensure};
use caudata_chaos_proxy::Wire;
use caudata_tests::{command, finish};

use super::lab::{ARCHIVED, Lab, RELEASED, ROBOT, ended_with, files, shell};

/// A server that holds another genuinely signed stream of this robot, and answers with that.
pub fn another_stream(lab: &Lab, times: usize) -> Result<String> {
    let server = lab.serve(&lab.data()?, &[])?;
    let wire = Wire::to(server.address);
    for _ in 0..times {
        wire.mend();
        wire.put_for(b"", b"");
        let state = lab.fresh()?.join("state");
        ended_with(&[0], &finish(lab.pull(wire.address, &state)?)?)?;
        let before = std::fs::read(state.join("state.json")).unwrap_or_default();
        wire.put_for(RELEASED.as_bytes(), ARCHIVED.as_bytes());
        let robot = finish(lab.pull(wire.address, &state)?)?;
        ended_with(&[76], &robot)?;
        ensure!(robot.stderr.contains("another question"), "{}", robot.stderr);
        let after = std::fs::read(state.join("state.json")).unwrap_or_default();
        ensure!(before == after, "the robot's state changed");
        let address = wire.address.to_string();
        let out = lab.fresh()?.join("p.onnx").display().to_string();
        let asked = ["policy", "pull", "--server", &address, "--stream", RELEASED, "--out", &out];
        ended_with(&[76], &finish(command("caudata", &asked)?)?)?;
        let key = lab.text("release.key");
        let sign = ["--to", "release/copy", "--key", &key, "--key-id", "lab-1"];
        let asked = ["policy", "release", "--server", &address, "--stream", RELEASED];
        ended_with(&[76], &finish(command("caudata", &[&asked[..], &sign].concat())?)?)?;
    }
    Ok("refused by robot, `policy pull` and `policy release` (76); nothing was signed".to_owned())
}

/// A policy is changed on the server's disk while it runs.
pub fn other_bytes(lab: &Lab, times: usize) -> Result<String> {
    for number in 0..times {
        let data = lab.data()?;
        let server = lab.serve(&data, &[])?;
        for blob in files(&data.join("blobs"))? {
            let mut bytes = std::fs::read(&blob)?;
            let at = (number * 7919) % bytes.len();
            bytes[at] ^= 1;
            std::fs::write(&blob, bytes)?;
        }
        let state = lab.fresh()?.join("state");
        ended_with(&[65, 66, 69, 74, 76, 77], &finish(lab.pull(server.address, &state)?)?)?;
        ensure!(!state.join("blobs").exists() || files(&state.join("blobs"))?.is_empty());
    }
    Ok("not handed out, nothing kept".to_owned())
}

/// A device instead of a file, in an address space of 3 GiB.
pub fn endless_inputs(lab: &Lab, _: usize) -> Result<String> {
    let state = lab.fresh()?.join("state").display().to_string();
    let key = lab.fresh()?.join("key").display().to_string();
    let robot = ["--robot", ROBOT, "--stream", "s", "--state", &state];
    let bus = ["--bus", "sim:127.0.0.1:1"];
    let zero = "/dev/zero";
    let run = |flag: &'static str| {
        let args = [&["run"][..], &robot, &bus, &[flag, zero]].concat();
        ("caudata-robot", args)
    };
    let named: Vec<(&str, Vec<&str>)> = vec![
        ("caudata", vec!["config", "check", "--config", zero]),
        ("caudata", vec!["robot", "check", zero]),
        ("caudata", vec!["gap", "check", "--robot", zero, "--log", "."]),
        ("caudata", vec!["eval", "--policy", zero]),
        ("caudata", vec!["policy", "show", zero]),
        (
            "caudata",
            [
                &["policy", "keygen", "--fresh", "--key-id", "k", "--out", &key],
                &["--trust", zero][..],
            ]
            .concat(),
        ),
        ("caudata-robot", vec!["limp", "--wiring", zero]),
        run("--trust"),
        run("--factory"),
        run("--commands"),
    ];
    let count = named.len();
    for (program, args) in named {
        // What is wrong with the input, never with the machine.
        let done = finish(shell("ulimit -v 3145728", program, &args)?)?;
        ended_with(&[64, 65, 66], &done)?;
        ensure!(!done.stderr.contains("out of memory"), "{args:?}: {}", done.stderr);
    }
    Ok(format!("{count} flags: refused as too large"))
}
