//! `caudata status`: a run at a glance, out of the learner's metrics.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::time::Duration;

use caudata_config::{Config, Source};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::{Value, json};

use crate::commands::cluster::up::run_dir;
use crate::commands::train::folder::{PROGRESS, newest};
use crate::say;

/// How long the learner may take to answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// Largest page that is read.
const PAGE_BYTES_MAX: u64 = 4 << 20;

/// What the figures are.
const FIGURES: &str = "\
chunks_waiting: rollouts that wait for the learner. lag: how many versions the policy that made the last ones was
older than the learner's. effective_sample_share: how much importance weights leave of them, 1 where nothing is
old. frames: messages by what became of them. advice: more actors where the learner waits, fewer where rollouts do.";

#[derive(Debug, Args)]
#[command(after_help = FIGURES)]
pub struct StatusArgs {
    /// Folder of the run [default: the one that the configuration names, else the newest one]
    #[arg(value_name = "RUN")]
    run: Option<PathBuf>,
    /// Metrics of the learner, host:port; otherwise as the configuration or the run's folder says
    #[arg(long, value_name = "ADDR")]
    metrics: Option<String>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// The configuration of a cluster's run
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Set one of its keys; may be given several times
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

pub fn run(args: &StatusArgs) -> Result<(), Failure> {
    let (file, overrides) = (args.config.clone(), args.overrides.clone());
    let source = Source { preset: None, file, overrides };
    let config = Config::load(&source).or_exit(ExitCode::BadConfig)?;
    let configured = config.telemetry.metrics_addr;
    let (address, folder) = match &args.metrics {
        Some(address) => (address.clone(), None),
        None if args.run.is_some() => announced(&config, args.run.clone())?,
        None if configured.port() != 0 && configured.ip().is_unspecified() => {
            (format!("127.0.0.1:{}", configured.port()), None)
        }
        None if configured.port() != 0 => (configured.to_string(), None),
        None => announced(&config, None)?,
    };
    let silent = || format!("the learner's metrics at {address} do not answer");
    let page = fetch(&address).or_exit_with(ExitCode::Unavailable, silent).map_err(|failure| {
        failure.hint_if(folder.as_deref().map(|folder: &Path| {
            let folder = folder.display();
            format!("the run did not say that it ended: if it was killed, go on with caudata train --resume --out {folder}, or with caudata up as before")
        }))
    })?;
    let status = Status::of(&page);
    say::either(args.json, &status.json(&address), |status| {
        say::fields(
            status,
            "metrics iteration policy_version episode_return actors chunks_waiting lag effective_sample_share steps frames advice",
        );
    })
}

/// The address that a run has announced, and its folder: this one, else the configuration's, else the newest one.
fn announced(config: &Config, run: Option<PathBuf>) -> Result<(String, Option<PathBuf>), Failure> {
    let mut hint = "give its folder, --metrics HOST:PORT, or --config with telemetry.metrics_addr";
    let folders: Vec<PathBuf> = match run {
        Some(run) => files::run_folder(&run).map(|()| vec![run])?,
        None => [run_dir(config)].into_iter().chain(newest(&config.run.out_dir)).collect(),
    };
    let folder = folders.into_iter().find(|folder| folder.join(PROGRESS).is_file());
    let Some(folder) = folder else {
        let message = format!("there is no run below {}", config.run.out_dir.display());
        return Err(Failure::message(ExitCode::NoInput, message).hint(hint));
    };
    let text = files::read(&folder.join(PROGRESS))?;
    let text = String::from_utf8_lossy(&text);
    let events = text.lines().rev();
    let mut events = events.filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let last = events.find(|event| event["event"] == "started" || event["event"] == "finished");
    let last = last.unwrap_or_default();
    let (code, message) = match (last["event"].as_str(), last["metrics"].as_str()) {
        (Some("started"), Some(address)) => return Ok((address.to_owned(), Some(folder))),
        (Some("finished"), _) => {
            hint = "`caudata runs list` has its figures";
            let folder = folder.display();
            let reason = last["reason"].as_str().unwrap_or("unknown");
            let at = &last["iteration"];
            let message = format!("the run in {folder} has ended after iteration {at} ({reason})");
            (ExitCode::Unavailable, message)
        }
        _ => (
            ExitCode::NoInput,
            format!("the run in {} does not say where its metrics are", folder.display()),
        ),
    };
    Err(Failure::message(code, message).hint(hint))
}

/// The page at `http://address/metrics`.
fn fetch(address: &str) -> std::io::Result<String> {
    let mut addresses = address.to_socket_addrs()?;
    let address = addresses.next().ok_or_else(|| std::io::Error::other("no such host"))?;
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    write!(stream, "GET /metrics HTTP/1.0\r\nHost: caudata\r\nConnection: close\r\n\r\n")?;
    let mut answer = String::new();
    stream.take(PAGE_BYTES_MAX).read_to_string(&mut answer)?;
    let (head, body) = answer
        .split_once("\r\n\r\n")
        .ok_or_else(|| std::io::Error::other("not an answer in HTTP"))?;
    if !head.starts_with("HTTP/1.1 200") && !head.starts_with("HTTP/1.0 200") {
        return Err(std::io::Error::other(head.lines().next().unwrap_or_default().to_owned()));
    }
    Ok(body.to_owned())
}

/// The samples of a page, by name with labels.
struct Status {
    samples: BTreeMap<String, f64>,
}

impl Status {
    fn of(page: &str) -> Self {
        let samples = page
            .lines()
            .filter(|line| !line.starts_with('#'))
            .filter_map(|line| {
                let (name, value) = line.rsplit_once(' ')?;
                Some((name.to_owned(), value.parse().ok()?))
            })
            .collect();
        Self { samples }
    }

    fn get(&self, name: &str) -> Option<f64> {
        self.samples.get(name).copied()
    }

    fn count(&self, name: &str) -> Option<u64> {
        self.get(name).map(|count| count as u64)
    }

    /// Frames by what became of them.
    fn frames(&self) -> BTreeMap<String, u64> {
        let label = |name: &str| {
            let rest = name.strip_prefix("caudata_learner_frames_total{outcome=\"")?;
            rest.strip_suffix("\"}").map(str::to_owned)
        };
        self.samples
            .iter()
            .filter_map(|(name, value)| Some((label(name)?, *value as u64)))
            .collect()
    }

    fn advice(&self) -> &'static str {
        match self.get("caudata_learner_scale_advice") {
            Some(advice) if advice > 0.0 => "more actors",
            Some(advice) if advice < 0.0 => "fewer actors",
            Some(_) => "as it is",
            None => "unknown",
        }
    }

    fn json(&self, address: &str) -> serde_json::Value {
        json!({
            "metrics": address,
            "iteration": self.count("caudata_learner_iterations_total"),
            "policy_version": self.count("caudata_learner_policy_version"),
            "actors": self.count("caudata_learner_actors"),
            "chunks_waiting": self.count("caudata_learner_chunks_waiting"),
            "lag": self.get("caudata_policy_staleness_versions"),
            "effective_sample_share": self.get("caudata_learner_effective_sample_share"),
            "episode_return": self.get("caudata_learner_episode_return"),
            "steps": self.count("caudata_learner_steps_total"),
            "frames": self.frames(),
            "advice": self.advice(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "\
# HELP caudata_learner_frames Frames.
# TYPE caudata_learner_frames counter
caudata_learner_frames_total{outcome=\"waiting\"} 12
caudata_learner_frames_total{outcome=\"stale\"} 3
caudata_learner_actors 4
caudata_learner_scale_advice -1
caudata_policy_staleness_versions 0.25
# EOF
";

    #[test]
    fn a_page_of_metrics_becomes_a_glance() {
        let status = Status::of(PAGE).json("h:1");
        assert_eq!(status["actors"], 4);
        assert_eq!(status["lag"], 0.25);
        assert_eq!(status["frames"], json!({"waiting": 12, "stale": 3}));
        assert_eq!(status["advice"], "fewer actors");
        assert!(status["iteration"].is_null(), "what is absent is not made up");
    }

    #[test]
    fn the_newest_learner_says_where_its_metrics_are() {
        let dir = tempfile::tempdir().unwrap();
        let mut config = Config::load(&Source::default()).unwrap();
        config.run.out_dir = dir.path().to_owned();
        let refused = |config: &Config| announced(config, None).unwrap_err().to_string();
        assert!(refused(&config).contains("there is no run"));
        let run = |name: &str, events: &str| {
            let folder = dir.path().join(name);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("run_id.txt"), name).unwrap();
            std::fs::write(folder.join(PROGRESS), events).unwrap();
        };
        let started = |addr: &str| format!("{{\"event\":\"started\",\"metrics\":{addr}}}\n");
        // The run that learnt last counts.
        run("20260101-000000_quick", &started("\"127.0.0.1:1\""));
        let last =
            started("\"127.0.0.1:2\"") + &started("\"127.0.0.1:3\"") + "{\"event\":\"warning\"}\n";
        run("20260102-000000_quick", &last);
        assert_eq!(announced(&config, None).unwrap().0, "127.0.0.1:3");
        let end = "{\"event\":\"finished\",\"iteration\":7,\"reason\":\"completed\"}\n";
        run("20260102-000000_quick", &(last + end));
        assert!(refused(&config).contains("has ended after iteration 7 (completed)"));
        // The run that the configuration names comes first.
        run(&config.run.name, &started("\"127.0.0.1:4\""));
        assert_eq!(announced(&config, None).unwrap().0, "127.0.0.1:4");
        // and one that is named before that
        let named = dir.path().join("20260101-000000_quick");
        std::fs::write(named.join("config.toml"), "").unwrap();
        let (address, folder) = announced(&config, Some(named.clone())).unwrap();
        assert_eq!((address.as_str(), folder), ("127.0.0.1:1", Some(named)));
    }
}
