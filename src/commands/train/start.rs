//! The processes of a run: how each is started, and what its end means.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use caudata_config::Config;
use caudata_telemetry::{ExitCode, Failure, Listening, Pulse};
use crossbeam_channel::{RecvTimeoutError, Sender, bounded};

use super::children::{self, LineSink, Process, Programs};
use super::folder::RunFolder;

/// How long the policy server may take to start.
const SERVER_START_MAX: Duration = Duration::from_secs(15);
/// How long a process that announced nothing may take to end once its standard output is closed.
const END_MAX: Duration = Duration::from_secs(5);

/// Whether a run starts anew or goes on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Resume {
    /// From the start.
    No,
    /// From the newest checkpoint.
    Latest,
    /// From the checkpoint with this name.
    Named(String),
}

/// Exit codes that starting again does not cure.
pub fn is_permanent(code: ExitCode) -> bool {
    matches!(
        code,
        ExitCode::BadConfig
            | ExitCode::BadInput
            | ExitCode::NoInput
            | ExitCode::Protocol
            | ExitCode::PolicyRefused
            | ExitCode::CannotCreate
            | ExitCode::InUse
    )
}

/// Exit codes that refuse what was asked for: the error line says all, and there is nothing in a log to be read.
pub fn is_refusal(code: ExitCode) -> bool {
    matches!(
        code,
        ExitCode::BadConfig | ExitCode::BadInput | ExitCode::NoInput | ExitCode::PolicyRefused
    )
}

/// A run that was refused before it began leaves no folder; one that did not go on is as it was.
pub fn clear_if_refused(folder: &RunFolder, failure: &Failure) {
    if !folder.put_back() && is_refusal(failure.code()) {
        folder.disown_unused();
    }
}

/// The failure that a child's end amounts to: its own error line and hint; without them, `how` it ended and
/// its log.
pub fn failed_child(child: &Process, code: ExitCode, how: &str) -> Failure {
    let log = format!("its log is {}", child.log().display());
    match child.last_error() {
        Some(words) => {
            let failure = Failure::message(code, format!("{}: {}", child.name(), words.error));
            match words.hint {
                Some(hint) => failure.hint(hint),
                None if is_refusal(code) => failure,
                None => failure.hint(log),
            }
        }
        None => Failure::message(code, format!("{} {how}", child.name())).hint(log),
    }
}

/// Starts a process that says on standard output where it listens as `service`, and waits for that at most
/// `patience`.
pub fn start_service(
    name: &str,
    service: &'static str,
    command: Command,
    log: &Path,
    patience: Duration,
) -> Result<(Process, SocketAddr), Failure> {
    let (sender, announced) = bounded(1);
    let sink: LineSink = Box::new(move |line| {
        if let Ok(listening) = serde_json::from_str::<Listening>(&line)
            && listening.listening == service
        {
            let _ = sender.try_send(listening.address);
        }
    });
    let mut process = Process::start(name, command, log, Some(sink))?;
    let ended = match announced.recv_timeout(patience) {
        Ok(address) => return Ok((process, address)),
        Err(RecvTimeoutError::Disconnected) => process.finish(END_MAX),
        Err(RecvTimeoutError::Timeout) => process.finish(Duration::ZERO),
    };
    Err(match ended.filter(|status| status.code().is_some()) {
        Some(status) => {
            let how = children::describe(status);
            failed_child(&process, children::exit_code(status), &how)
        }
        None => failed_child(&process, ExitCode::TempFail, "did not start in time"),
    })
}

pub fn start_server(
    programs: &Programs,
    config: &Config,
    folder: &RunFolder,
    addr: SocketAddr,
) -> Result<(Process, SocketAddr), Failure> {
    let mut command = Command::new(programs.find("caudata-policy-server")?);
    command.arg("--data").arg(folder.root().join(&config.policy_server.dir));
    command.args(["--addr", &addr.to_string()]);
    command.args(["--keep", &config.policy_server.keep_versions.to_string()]);
    if let Some(certificates) = server_certificates(config) {
        command.arg("--tls-dir").arg(certificates);
    }
    add_telemetry(&mut command, config, true);
    let log = folder.logs().join("policy_server.log");
    start_service("the policy server", "policy_server", command, &log, SERVER_START_MAX)
}

/// The certificates of a policy server that others than this host reach.
fn server_certificates(config: &Config) -> Option<PathBuf> {
    let open = !config.policy_server.addr.ip().is_loopback();
    config.cluster.certificates("server").filter(|_| open)
}

/// Starts the learner; its events go to `lines`, and `pulse` beats when it says that it is alive.
pub fn start_learner(
    programs: &Programs,
    config: &Config,
    folder: &RunFolder,
    server: SocketAddr,
    resume: &Resume,
    lines: Sender<String>,
    pulse: Pulse,
) -> Result<Process, Failure> {
    let mut command = Command::new(programs.find("caudata-learner")?);
    command.arg("--config").arg(folder.config());
    command.arg("--run-dir").arg(folder.root());
    command.args(["--run-id", folder.run_id()]);
    let server = match server_certificates(config) {
        // Its certificate is for a name, not for "any address".
        Some(_) if config.cluster.policy_server.is_empty() => {
            format!("https://localhost:{}", server.port())
        }
        Some(_) => config.cluster.policy_server.clone(),
        None => server.to_string(),
    };
    command.args(["--policy-server", &server]);
    match resume {
        Resume::No => {}
        Resume::Latest => {
            command.arg("--resume");
        }
        Resume::Named(name) => {
            command.args(["--resume-from", name]);
        }
    }
    add_telemetry(&mut command, config, false);
    command.arg("--heartbeat");
    pulse.beat();
    let sink: LineSink = Box::new(move |line| {
        pulse.beat();
        if line != caudata_actor::ALIVE {
            // Blocks while the queue is full; nobody reads any more when the supervisor ends.
            let _ = lines.send(line);
        }
    });
    Process::start("the learner", command, &folder.logs().join("learner.log"), Some(sink))
}

/// Log flags, and with `own_metrics` a metrics endpoint on any free port of the configured address.
pub fn add_telemetry(command: &mut Command, config: &Config, own_metrics: bool) {
    let telemetry = &config.telemetry;
    command.args(["--log-format", telemetry.log_format.name(), "--log-filter", &telemetry.log]);
    if own_metrics && telemetry.metrics {
        let any_port = SocketAddr::new(telemetry.metrics_addr.ip(), 0);
        command.args(["--metrics-addr", &any_port.to_string()]);
    }
}
