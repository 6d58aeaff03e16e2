//! One flipped bit in a file, of every kind that our programs write or read.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, ensure};
use caudata_chaos_proxy::Dice;
use caudata_tests::{command, finish, repository_root, train};

use super::lab::{ARCHIVED, Lab, TRAINED, copy, ended_with, files, pull};

/// A copy of what has the file, where it is in it, what reads it, and how that may end.
struct Kind {
    name: &'static str,
    make: fn(&Lab, &Path) -> Result<()>,
    /// Files with this in their path.
    file: &'static str,
    read: fn(&Lab, &Path) -> Result<Command>,
    codes: &'static [i32],
}

/// Bad input or state of one's own kind, or no harm done: a comment, white space, a copy that is whole.
const SAID: &[i32] = &[0, 64, 65, 66, 76, 77, 78, 83, 84];
const KINDS: &[Kind] = &[
    Kind {
        name: "policy file",
        make: |lab, into| one(&lab.at("run/policy.onnx"), into),
        file: "policy.onnx",
        read: |_, at| command("caudata", &["policy", "show", &text(&at.join("policy.onnx"))]),
        codes: SAID,
    },
    Kind {
        name: "configuration",
        make: |lab, into| one(&lab.at("run/config.toml"), into),
        file: "config.toml",
        read: |_, at| {
            command("caudata", &["config", "check", "--config", &text(&at.join("config.toml"))])
        },
        codes: SAID,
    },
    Kind {
        name: "robot file",
        make: robot_files,
        file: "polymander.robot.toml",
        read: |_, at| {
            command("caudata", &["robot", "check", &text(&at.join("polymander.robot.toml"))])
        },
        codes: SAID,
    },
    Kind {
        name: "MJCF",
        make: robot_files,
        file: "polymander.xml",
        read: |_, at| {
            command("caudata", &["robot", "check", &text(&at.join("polymander.robot.toml"))])
        },
        codes: SAID,
    },
    Kind {
        name: "wiring",
        make: robot_files,
        file: "polymander.wiring.toml",
        read: |_, at| {
            let wiring = text(&at.join("polymander.wiring.toml"));
            let port = text(&at.join("no port"));
            command("caudata-robot", &["limp", "--wiring", &wiring, "--servo-port", &port])
        },
        // A good one leads to a port that is not there.
        codes: &[65, 66, 69, 71, 86],
    },
    Kind {
        name: "trust file",
        make: |lab, into| one(&lab.at("trust.toml"), into),
        file: "trust.toml",
        read: |lab, at| {
            let state = lab.fresh()?.join("state");
            pull("127.0.0.1:1".parse()?, &state, &at.join("trust.toml"))
        },
        // A good one leads to a server that is not there.
        codes: &[65, 69],
    },
    Kind {
        name: "robot's state, one of two copies",
        make: robot_state,
        file: "state.json",
        read: |_, at| command("caudata-robot", &["status", "--state", &text(at)]),
        codes: &[0],
    },
    Kind {
        name: "checkpoint",
        make: run_folder,
        file: "checkpoints/iter",
        read: resumed,
        codes: SAID,
    },
    Kind {
        name: "pointer to the newest checkpoint",
        make: run_folder,
        file: "checkpoints/latest",
        read: resumed,
        codes: SAID,
    },
    Kind {
        name: "ledger of an actor",
        make: run_folder,
        file: "ledgers/",
        read: resumed,
        codes: SAID,
    },
    Kind {
        name: "account of a run",
        make: run_folder,
        file: "accounting.json",
        read: resumed,
        codes: SAID,
    },
];

/// Each kind read with flipped bits, and each kind of file of a policy server served with them.
pub fn every_kind(lab: &Lab, times: usize) -> Result<String> {
    let mut dice = Dice::new(20_261_124);
    let mut noticed = 0;
    for kind in KINDS {
        for _ in 0..times {
            let folder = lab.fresh()?;
            (kind.make)(lab, &folder)?;
            let flipped = flip(&folder, kind.file, &mut dice).context(kind.name)?;
            let done = finish((kind.read)(lab, &folder)?)?;
            ended_with(kind.codes, &done).with_context(|| format!("{}: {flipped}", kind.name))?;
            noticed += usize::from(done.code != Some(0));
        }
    }
    let mut set_aside = 0;
    for part in ["blobs/", "streams/", "labels/", "quarantine/", "used_up/", "audit.jsonl"] {
        for _ in 0..times {
            set_aside +=
                usize::from(served(lab, part, &mut dice).with_context(|| part.to_owned())?);
        }
    }
    let kinds = KINDS.len() + 6;
    Ok(format!("{kinds} kinds: {noticed} noticed, of a server's {set_aside} set aside or refused"))
}

/// A server whose folder has one flipped bit: it says no, or what it hands out is what was published.
fn served(lab: &Lab, part: &str, dice: &mut Dice) -> Result<bool> {
    let data = lab.data()?;
    {
        let server = lab.serve(&data, &[])?;
        let address = server.address.to_string();
        let at = ["--server", &address, "--stream", "lab"];
        let label = ["policy", "label", "--label", "canary", "--version", "6"];
        lab.caudata(&[&label[..], &at].concat())?;
        let out = ["policy", "quarantine", "--version", "1", "--reason", "siege"];
        lab.caudata(&[&out[..], &at].concat())?;
    }
    if part == "used_up/" && !data.join("used_up").read_dir()?.any(|e| e.is_ok()) {
        return Ok(false);
    }
    flip(&data, part, dice)?;
    let Ok(server) = lab.serve(&data, &[]) else {
        return Ok(true);
    };
    let state = lab.fresh()?.join("state");
    let pulled = finish(lab.pull(server.address, &state)?)?;
    ended_with(&[0, 65, 66, 69, 74, 76, 77], &pulled)?;
    if pulled.code == Some(0) {
        let want = lab.at("run/registry/blobs");
        let kept = files(&state.join("blobs"))?.into_iter();
        for blob in kept.filter(|path| path.extension().is_some_and(|x| x == "onnx")) {
            let name = blob.file_name().context("a file has a name")?;
            let there = std::fs::read(want.join(name))?;
            ensure!(std::fs::read(&blob)? == there, "other bytes were handed out");
        }
    }
    let address = server.address.to_string();
    let out = lab.fresh()?.join("p.onnx").display().to_string();
    let quarantined = [
        "policy",
        "label",
        "--server",
        &address,
        "--stream",
        "lab",
        "--label",
        "stable",
        "--version",
        "1",
        "--override",
        "siege",
    ];
    ended_with(&[65, 66, 69, 76, 77], &finish(command("caudata", &quarantined)?)?)
        .context("what is out of use came back")?;
    let archived = ["policy", "pull", "--server", &address, "--stream", ARCHIVED, "--out", &out];
    let other = finish(command("caudata", &archived)?)?;
    Ok(pulled.code != Some(0) || other.code != Some(0))
}

/// Flips one bit of one file below `folder` whose path holds `part`.
fn flip(folder: &Path, part: &str, dice: &mut Dice) -> Result<String> {
    let found: Vec<PathBuf> = files(folder)?
        .into_iter()
        .filter(|path| path.strip_prefix(folder).is_ok_and(|p| text(p).contains(part)))
        .filter(|path| std::fs::metadata(path).is_ok_and(|m| m.len() > 0))
        .collect();
    ensure!(!found.is_empty(), "nothing with {part} in its path");
    let path = &found[dice.below(found.len() as u64) as usize];
    let mut bytes = std::fs::read(path)?;
    let bit = dice.below(8 * bytes.len() as u64) as usize;
    bytes[bit / 8] ^= 1 << (bit % 8);
    std::fs::write(path, bytes)?;
    Ok(format!("bit {bit} of {}", path.display()))
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

fn one(file: &Path, into: &Path) -> Result<()> {
    let name = file.file_name().context("a file has a name")?;
    std::fs::copy(file, into.join(name))?;
    Ok(())
}

fn robot_files(_: &Lab, into: &Path) -> Result<()> {
    for name in ["polymander.robot.toml", "polymander.xml", "polymander.wiring.toml"] {
        one(&repository_root().join("robots").join(name), into)?;
    }
    Ok(())
}

fn robot_state(lab: &Lab, into: &Path) -> Result<()> {
    let server = lab.serve(&lab.data()?, &[])?;
    ended_with(&[0], &finish(lab.pull(server.address, into)?)?)
}

fn run_folder(lab: &Lab, into: &Path) -> Result<()> {
    copy(&lab.at("run"), into)
}

fn resumed(_: &Lab, at: &Path) -> Result<Command> {
    train(at, &[TRAINED, &["--resume", "--iterations", "8"]].concat())
}
