//! `caudata status`: a run at a glance, out of the learner's metrics.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use caudata_config::ConfigArgs;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use serde_json::json;

use crate::commands::cluster::up::run_dir;
use crate::say;

/// How long the learner may take to answer.
const PATIENCE: Duration = Duration::from_secs(5);
/// Largest page that is read.
const PAGE_BYTES_MAX: u64 = 4 << 20;

#[derive(Debug, Args)]
pub struct StatusArgs {
    /// Metrics of the learner, host:port; otherwise as the configuration or the run's folder says
    #[arg(long, value_name = "ADDR")]
    metrics: Option<String>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    config: ConfigArgs,
}

pub fn run(args: &StatusArgs) -> Result<(), Failure> {
    let config = args.config.load().or_exit(ExitCode::BadConfig)?;
    let configured = config.telemetry.metrics_addr;
    let address = match &args.metrics {
        Some(address) => address.clone(),
        None if configured.port() != 0 && configured.ip().is_unspecified() => {
            format!("127.0.0.1:{}", configured.port())
        }
        None if configured.port() != 0 => configured.to_string(),
        None => announced(&run_dir(&config).join("progress.jsonl")).ok_or_else(|| {
            Failure::message(
                ExitCode::NoInput,
                "no run says where its metrics are".to_owned(),
            )
            .hint("give --metrics HOST:PORT, or --config with telemetry.metrics_addr")
        })?,
    };
    let page = fetch(&address).or_exit_with(ExitCode::Unavailable, || {
        format!("the learner's metrics at {address} do not answer")
    })?;
    let status = Status::of(&page);
    say::either(args.json, &status.json(&address), |status| {
        say::fields(
            status,
            "metrics iteration policy_version episode_return actors chunks_waiting lag effective_sample_share steps frames advice",
        );
    })
}

/// The address in the newest `started` event of a run.
fn announced(progress: &std::path::Path) -> Option<String> {
    let text = std::fs::read_to_string(progress).ok()?;
    text.lines().rev().find_map(|line| {
        let event: serde_json::Value = serde_json::from_str(line).ok()?;
        (event["event"] == "started").then(|| event["metrics"].as_str().map(str::to_owned))?
    })
}

/// The page at `http://address/metrics`.
fn fetch(address: &str) -> std::io::Result<String> {
    let mut addresses = address.to_socket_addrs()?;
    let address = addresses
        .next()
        .ok_or_else(|| std::io::Error::other("no such host"))?;
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    write!(
        stream,
        "GET /metrics HTTP/1.0\r\nHost: caudata\r\nConnection: close\r\n\r\n"
    )?;
    let mut answer = String::new();
    stream.take(PAGE_BYTES_MAX).read_to_string(&mut answer)?;
    let (head, body) = answer
        .split_once("\r\n\r\n")
        .ok_or_else(|| std::io::Error::other("not an answer in HTTP"))?;
    if !head.starts_with("HTTP/1.1 200") && !head.starts_with("HTTP/1.0 200") {
        return Err(std::io::Error::other(
            head.lines().next().unwrap_or_default().to_owned(),
        ));
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
            "iteration": self.get("caudata_learner_iterations_total"),
            "policy_version": self.get("caudata_learner_policy_version"),
            "actors": self.get("caudata_learner_actors"),
            "chunks_waiting": self.get("caudata_learner_chunks_waiting"),
            "lag": self.get("caudata_policy_staleness_versions"),
            "effective_sample_share": self.get("caudata_learner_effective_sample_share"),
            "episode_return": self.get("caudata_learner_episode_return"),
            "steps": self.get("caudata_learner_steps_total"),
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
        assert_eq!(status["actors"], 4.0);
        assert_eq!(status["lag"], 0.25);
        assert_eq!(status["frames"], json!({"waiting": 12, "stale": 3}));
        assert_eq!(status["advice"], "fewer actors");
        assert!(
            status["iteration"].is_null(),
            "what is absent is not made up"
        );
    }

    #[test]
    fn the_newest_learner_says_where_its_metrics_are() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("progress.jsonl");
        let started = |addr: &str| format!("{{\"event\":\"started\",\"metrics\":{addr}}}\n");
        let text =
            started("\"127.0.0.1:1\"") + &started("\"127.0.0.1:2\"") + "{\"event\":\"warning\"}\n";
        std::fs::write(&path, text).unwrap();
        assert_eq!(announced(&path).as_deref(), Some("127.0.0.1:2"));
        assert_eq!(announced(&dir.path().join("none")), None);
    }
}
