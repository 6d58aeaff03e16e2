//! The wall clock of every process of a training goes forward and back by hours while it runs.

use std::process::Command;

use anyhow::{Result, ensure};
use caudata_tests::{finish, json_file, repository_root, train};

use super::lab::{Lab, ended_with};

/// Three hours, by turns, every second.
const SWING_S: &str = "10800";

pub fn swinging(lab: &Lab, times: usize) -> Result<String> {
    let library = lab.fresh()?.join("moved_clock.so");
    let compiler = std::env::var("CXX").unwrap_or_else(|_| "c++".to_owned());
    let compiled = Command::new(compiler)
        .args(["-x", "c", "-shared", "-fPIC", "-o"])
        .arg(&library)
        .arg(repository_root().join("deploy/tests/moved_clock.c"))
        .arg("-ldl")
        .status()?;
    ensure!(compiled.success(), "the moved clock does not compile");
    for transport in ["zenoh", "iceoryx2"].into_iter().cycle().take(times) {
        let out = lab.fresh()?.join("run");
        let flags = ["--transport", transport, "--iterations", "150"];
        let mut run = train(&out, &flags)?;
        run.env("LD_PRELOAD", &library).env("CAUDATA_TEST_CLOCK_SWING", SWING_S);
        ended_with(&[0], &finish(run)?)?;
        let books = json_file(&out.join("accounting.json"))?;
        ensure!(books["holds"] == true && books["sent"] == books["accepted"], "{books}");
    }
    Ok("trainings of 150 iterations end, books hold, no chunk lost".to_owned())
}
