//! Programs that are killed at any moment. What a power cut at each single step leaves is shown where the steps
//! are known: on the rehearsed disk (`policy_server/tests/it/crash.rs`, `deploy/src/store/tests.rs`).

use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use caudata_chaos_proxy::Dice;
use caudata_tests::{command, finish};

use super::lab::{Lab, RELEASED, ended_with};

/// Killed while somebody publishes; what it then lists is whole, and its record is unbroken.
pub fn server(lab: &Lab, times: usize) -> Result<String> {
    let data = lab.data()?;
    let mut dice = Dice::new(5);
    let mut versions = 0;
    for number in 0..2 * times {
        let mut server = lab.serve(&data, &[])?;
        let (address, key) = (server.address.to_string(), lab.text("release.key"));
        let publisher = std::thread::spawn({
            let to: Vec<String> = (0..20).map(|n| format!("release/death-{number}-{n}")).collect();
            move || -> Result<()> {
                for to in to {
                    let args = [
                        "policy",
                        "release",
                        "--server",
                        &address,
                        "--stream",
                        "lab",
                        "--version",
                        "6",
                        "--to",
                        &to,
                        "--key",
                        &key,
                        "--key-id",
                        "lab-1",
                    ];
                    if finish(command("caudata", &args)?)?.code != Some(0) {
                        break;
                    }
                }
                Ok(())
            }
        });
        std::thread::sleep(Duration::from_millis(dice.below(300)));
        server.child.kill()?;
        server.child.wait()?;
        publisher.join().ok().context("the publisher panicked")??;
        let server = lab.serve(&data, &[])?;
        let address = server.address.to_string();
        lab.caudata(&["policy", "audit", "--server", &address])?;
        let listed =
            lab.caudata(&["policy", "list", "--server", &address, "--json"])?.last_json()?;
        let listed = listed.as_array().or_else(|| listed["policies"].as_array());
        let listed = listed.context("`policy list --json` lists")?;
        versions = listed.len();
        for policy in listed {
            let (stream, version) = (&policy["stream"], &policy["version"]);
            let (stream, version) = (stream.as_str().context("a stream")?, version.to_string());
            let out = lab.fresh()?.join("p.onnx").display().to_string();
            let pull = [
                "policy",
                "pull",
                "--server",
                &address,
                "--stream",
                stream,
                "--version",
                &version,
                "--out",
                &out,
            ];
            lab.caudata(&pull)?;
        }
    }
    Ok(format!("{versions} versions listed in the end, all whole; the record unbroken"))
}

/// Killed while it fetches and stores; the next try finds a state that it can go on from.
pub fn robot(lab: &Lab, times: usize) -> Result<String> {
    let server = lab.serve(&lab.data()?, &[])?;
    let mut dice = Dice::new(6);
    let mut killed = 0;
    for _ in 0..5 * times {
        let state = lab.fresh()?.join("state");
        let mut pull = lab.pull(server.address, &state)?;
        let mut child = pull.stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
        std::thread::sleep(Duration::from_millis(dice.below(30)));
        child.kill()?;
        killed += usize::from(!child.wait()?.success());
        let again = finish(lab.pull(server.address, &state)?)?;
        ended_with(&[0], &again)?;
        let status = ["status", "--state", &state.display().to_string(), "--json"];
        let status = finish(command("caudata-robot", &status)?)?.last_json()?;
        ensure!(status["active"]["stream"] == RELEASED, "{status}");
    }
    Ok(format!("{killed} of {} killed in time; each next one complete", 5 * times))
}
