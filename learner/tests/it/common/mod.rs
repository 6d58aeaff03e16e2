//! A run small enough for tests: the real robot and engine, two actors of two environments, tiny networks.

use std::io::Write;
use std::path::Path;
use std::sync::{Arc, Mutex};

use caudata_config::{Config, Source};
use caudata_learner::LearnerError;
use caudata_learner::train::{Resume, TrainSettings, train};
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::{Metrics, Pulse, StopFlag};

#[path = "tiny.rs"]
pub mod tiny;
use tiny::TINY;

/// The quick preset with [`TINY`] and `more`.
pub fn config(iterations: u64, more: &[&str]) -> Config {
    let mut overrides: Vec<String> = TINY.iter().map(|&text| text.to_owned()).collect();
    overrides.push(format!("run.iterations={iterations}"));
    overrides.extend(more.iter().map(|&text| text.to_owned()));
    let mut config =
        Config::load(&Source { preset: Some("quick".into()), file: None, overrides }).unwrap();
    let robots = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.robot.toml");
    config.robot = robots.into();
    config
}

/// Collects progress events, and asks to stop when `stop_at` iterations are done.
#[derive(Clone, Default)]
pub struct Listener {
    pub lines: Arc<Mutex<Vec<u8>>>,
    pub stop: StopFlag,
    pub stop_at: Option<u64>,
}

impl Listener {
    /// Everything heard so far.
    pub fn events(&self) -> Vec<Event> {
        let bytes = self.lines.lock().unwrap().clone();
        let text = String::from_utf8(bytes).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}

impl Write for Listener {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.lines.lock().unwrap().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        if let (Some(at), Some(Event::Iteration(last))) = (self.stop_at, self.events().last())
            && last.iteration >= at
        {
            self.stop.request("test");
        }
        Ok(())
    }
}

/// Trains in `folder`, in one process.
pub fn run(
    folder: &Path,
    config: Config,
    resume: Resume,
    listener: &Listener,
    policy_server: Option<&str>,
) -> Result<Finished, LearnerError> {
    let settings = TrainSettings {
        config,
        run_dir: folder.to_owned(),
        run_id: "test".into(),
        resume,
        policy_server: policy_server.map(str::to_owned),
        transport: None,
        metrics: Metrics::new(),
        metrics_addr: None,
        events: Box::new(listener.clone()),
        pulse: Pulse::new(),
    };
    train(settings, &listener.stop)
}
