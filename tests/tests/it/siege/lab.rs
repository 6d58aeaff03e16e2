//! What attacks are made on: a training's policies, a server that holds some of them signed, a robot's files.

use std::io::BufReader;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, bail, ensure};
use caudata_tests::{Finished, binary, command, finish, repository_root, train};

pub const ROBOT: &str = "robots/polymander.robot.toml";
/// Streams with names of one length: one may stand for the other in a message.
pub const RELEASED: &str = "release/flat";
pub const ARCHIVED: &str = "archive/flat";

/// Flags of the training whose policies are released.
pub const TRAINED: &[&str] =
    &["--set", "learner.publish_every=1", "--set", "policy_server.stream=lab"];

/// Folders of one siege.
pub struct Lab {
    folder: tempfile::TempDir,
}

/// A program that is ended with this value.
pub struct Running {
    pub child: Child,
    pub address: SocketAddr,
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Lab {
    /// A short training, whose first and last versions are released: one to robots, one into the archive.
    pub fn open() -> Result<Self> {
        let lab = Self { folder: tempfile::tempdir()? };
        let flags = [TRAINED, &["--iterations", "6"]].concat();
        let trained = finish(train(&lab.at("run"), &flags)?)?;
        ensure!(trained.code == Some(0), "{}", trained.stderr);
        for (id, file, flags) in
            [("lab-1", "release.key", &[][..]), ("fresh-1", "fresh.key", &["--fresh"][..])]
        {
            let (out, trust) = (lab.text(file), lab.text("trust.toml"));
            let key = ["policy", "keygen", "--key-id", id, "--out", &out, "--trust", &trust];
            lab.caudata(&[&key[..], flags].concat())?;
        }
        let server = lab.serve(&lab.at("run/registry"), &[])?;
        lab.release(&server, "1", RELEASED)?;
        lab.release(&server, "6", ARCHIVED)?;
        Ok(lab)
    }

    pub fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn text(&self, name: &str) -> String {
        self.at(name).display().to_string()
    }

    /// A folder of its own for one try.
    pub fn fresh(&self) -> Result<PathBuf> {
        Ok(tempfile::tempdir_in(self.folder.path())?.keep())
    }

    /// A copy of the server's data.
    pub fn data(&self) -> Result<PathBuf> {
        let data = self.fresh()?.join("data");
        copy(&self.at("run/registry"), &data)?;
        Ok(data)
    }

    /// Runs `caudata` to its end, which must be a good one.
    pub fn caudata(&self, args: &[&str]) -> Result<Finished> {
        let done = finish(command("caudata", args)?)?;
        ensure!(done.code == Some(0), "caudata {}: {}", args.join(" "), done.stderr);
        Ok(done)
    }

    /// A policy server that proves freshness over `data`.
    pub fn serve(&self, data: &Path, extra: &[&str]) -> Result<Running> {
        let key = self.text("fresh.key");
        let data = data.display().to_string();
        let mut args = vec!["--data", &data, "--addr", "127.0.0.1:0"];
        args.extend(["--fresh-key", &key, "--fresh-key-id", "fresh-1"]);
        args.extend(extra);
        started("caudata-policy-server", "policy_server", &args)
    }

    pub fn release(&self, server: &Running, version: &str, to: &str) -> Result<Finished> {
        let (address, key) = (server.address.to_string(), self.text("release.key"));
        let from = ["policy", "release", "--server", &address, "--stream", "lab"];
        let what = ["--version", version, "--to", to, "--key", &key, "--key-id", "lab-1"];
        self.caudata(&[&from[..], &what].concat())
    }

    /// `caudata-robot pull` of what is released.
    pub fn pull(&self, server: SocketAddr, state: &Path) -> Result<Command> {
        pull(server, state, &self.at("trust.toml"))
    }
}

/// As [`Lab::pull`], with a trust file.
pub fn pull(server: SocketAddr, state: &Path, trust: &Path) -> Result<Command> {
    let args = ["pull", "--robot", ROBOT, "--stream", RELEASED, "--json"];
    let mut pull = command("caudata-robot", &args)?;
    pull.args(["--policy-server", &server.to_string(), "--state"]).arg(state);
    pull.arg("--trust").arg(trust);
    Ok(pull)
}

/// Starts a program that announces where it listens.
pub fn started(name: &str, service: &str, args: &[&str]) -> Result<Running> {
    let started = command(name, args)?;
    listening(started, service)
}

/// As [`started`], of a command.
pub fn listening(mut command: Command, service: &str) -> Result<Running> {
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
    let out = child.stdout.take().context("it has a standard output")?;
    let mut out = BufReader::new(out);
    let Some(address) = caudata_telemetry::read_announcement(service, &mut out) else {
        let _ = child.kill();
        bail!("{service} does not start: {}", child.wait()?);
    };
    // Whatever it says later finds a reader.
    std::thread::spawn(move || std::io::copy(&mut out, &mut std::io::sink()));
    Ok(Running { child, address })
}

/// Ended with one of these codes, and in its own words.
pub fn ended_with(codes: &[i32], done: &Finished) -> Result<()> {
    ensure!(
        done.code.is_some_and(|code| codes.contains(&code)),
        "ended with {:?}, not one of {codes:?}: {}",
        done.code,
        done.stderr.lines().last().unwrap_or_default()
    );
    ensure!(!done.stderr.contains("panicked"), "{}", done.stderr);
    Ok(())
}

/// `line` for the shell, with the path of one of our programs in front of the arguments.
pub fn shell(before: &str, program: &str, args: &[&str]) -> Result<Command> {
    let mut shell = Command::new("sh");
    shell
        .arg("-c")
        .arg(format!("{before}; exec \"$0\" \"$@\""))
        .arg(binary(program)?)
        .args(args)
        .current_dir(repository_root());
    Ok(shell)
}

/// Copies a folder.
pub fn copy(from: &Path, to: &Path) -> Result<()> {
    std::fs::create_dir_all(to)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        match entry.file_type()?.is_dir() {
            true => copy(&entry.path(), &target)?,
            false => std::fs::copy(entry.path(), target).map(drop)?,
        }
    }
    Ok(())
}

/// Every file below a folder.
pub fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        match entry.file_type()?.is_dir() {
            true => found.extend(files(&entry.path())?),
            false => found.push(entry.path()),
        }
    }
    found.sort();
    Ok(found)
}
