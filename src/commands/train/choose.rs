//! The end of a training: which of its last versions is its policy.

use std::collections::BTreeMap;
use std::sync::Arc;

use caudata_config::Config;
use caudata_evaluation::{Settings, Tried};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_proto::registry::{LabelName, LabelState, Manifest, SetLabel, StreamName};
use caudata_registry_client::RegistryClient;
use caudata_studies::failures::refused;
use caudata_studies::files;
use caudata_telemetry::progress::Event;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use serde::Serialize;

use super::folder::RunFolder;
use super::supervise::Outcome;
use crate::commands::policy::{block_on, hex};
use crate::say;

/// The label of the run's stream that leads to the version that was chosen.
pub const CHOSEN: &str = "chosen";

/// Most episodes of a command that a version is tried in.
const MOST_EPISODES: u32 = 64;

/// The version that was chosen.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Choice {
    /// Its version.
    pub version: u64,
    /// Those that were tried, newest first; empty where the last one was kept untried.
    pub tried: Vec<Tried>,
    /// SHA-256 as the learner made it, hex.
    #[serde(skip)]
    pub learner_sha256: String,
}

impl Choice {
    /// The last version, untried.
    pub fn last(outcome: &Outcome) -> Self {
        Self {
            version: outcome.finished.policy_version,
            tried: Vec::new(),
            learner_sha256: outcome.finished.policy_sha256.clone(),
        }
    }
}

/// Tries the last published versions, newest first, until one does all that it was trained for ([`Tried::of`]);
/// where none does, the newest of those that lack the least is the one. It becomes the run's policy.onnx, and
/// the label [`CHOSEN`] leads to it.
///
/// # Errors
/// When a version cannot be had or tried, the label or the file cannot be written, or `stop` is set.
pub fn choose(
    config: &Config,
    folder: &RunFolder,
    model: &Arc<RobotModel>,
    outcome: &Outcome,
    stop: &StopFlag,
) -> Result<Choice, Failure> {
    let last = files::policy(&folder.policy())?;
    let stream = config.policy_server.stream_of(folder.run_id());
    let stream = StreamName::new(stream).or_exit(ExitCode::BadConfig)?;
    let address = outcome.server_addr.to_string();
    let (versions, led) = candidates(config, folder, outcome, &stream)?;
    let newest = versions.first().map(|manifest| manifest.version);
    if newest != Some(outcome.finished.policy_version) {
        return Ok(Choice::last(outcome));
    }
    // no seed that a person would judge the policy by afterwards
    let settings = Settings {
        episodes: config.evaluation.episodes.min(MOST_EPISODES),
        seed: !config.run.seed,
        ..Settings::default()
    };
    let go_on = || stop.reason().is_none();
    let mut tried: Vec<Tried> = Vec::new();
    let mut best: Option<(f64, PolicyFile)> = None;
    let mut share = say::Share::new("versions at most", versions.len());
    for manifest in &versions {
        let policy = fetched(&address, manifest)?;
        let now = Tried::of(config, model, &policy, &settings, &go_on)
            .map_err(|error| refused(error, stop))?;
        share.one_more();
        if best.as_ref().is_none_or(|(least, _)| now.shortfall < *least) {
            best = Some((now.shortfall, policy));
        }
        let passes = now.passes();
        tried.push(now);
        if passes {
            break;
        }
    }
    let Some((_, policy)) = best else { return Ok(Choice::last(outcome)) };
    let version = policy.metadata().version;
    if version != last.metadata().version {
        // a training that goes on counts on from the last one
        files::write_whole(&folder.last_policy(), last.bytes())?;
        files::write_whole(&folder.policy(), policy.bytes())?;
    }
    label(&address, stream, version, led)?;
    Ok(Choice { version, tried, learner_sha256: policy.sha256_hex() })
}

/// The last published versions of this training, newest first, and where [`CHOSEN`] leads now. Left out is what
/// another training or an abandoned branch of this one published, what was put out of use, and what lies below
/// the label: labels never lead down, since robots do not go down.
fn candidates(
    config: &Config,
    folder: &RunFolder,
    outcome: &Outcome,
    stream: &StreamName,
) -> Result<(Vec<Manifest>, Option<LabelState>), Failure> {
    let address = outcome.server_addr.to_string();
    let below = Some(outcome.finished.policy_version + 1);
    let (page, overview) = block_on(async {
        let mut client = RegistryClient::new(&address)?;
        let page = client.list(Some(stream), config.evaluation.choose_from, below).await?;
        Ok((page, client.overview(Some(stream)).await?))
    })?;
    let led = overview.labels.into_iter().find(|state| state.label.as_str() == CHOSEN);
    let floor = led.as_ref().map_or(0, |state| state.version);
    let published = published(folder)?;
    let of_this_training = |m: &Manifest| {
        let told = published.get(&m.version).is_some_and(|(sha256, _)| *sha256 == hex(&m.sha256));
        let out_of_use = overview.quarantined.iter().any(|q| q.version == m.version);
        told && !out_of_use && m.version >= floor
    };
    Ok((page.manifests.into_iter().filter(of_this_training).collect(), led))
}

/// The versions that the learner told of, those of the branch that this training goes on: SHA-256 and the
/// iteration in which it told.
fn published(folder: &RunFolder) -> Result<BTreeMap<u64, (String, u64)>, Failure> {
    let path = folder.progress();
    let text = std::fs::read(&path)
        .or_exit_with(ExitCode::NoInput, || format!("cannot read {}", path.display()))?;
    let mut all: BTreeMap<u64, (String, u64)> = BTreeMap::new();
    let mut iteration = 0;
    for line in text.split(|byte| *byte == b'\n') {
        match serde_json::from_slice(line) {
            Ok(Event::Started(started)) => {
                iteration = started.iteration;
                all.retain(|_, (_, told)| *told <= iteration);
            }
            Ok(Event::Iteration(done)) => iteration = done.iteration,
            Ok(Event::Published(one)) => {
                all.insert(one.version, (one.sha256, iteration));
            }
            _ => {}
        }
    }
    Ok(all)
}

fn fetched(address: &str, manifest: &Manifest) -> Result<PolicyFile, Failure> {
    let bytes = block_on(async { RegistryClient::new(address)?.fetch(manifest).await })?;
    PolicyFile::parse(bytes.into()).or_exit(ExitCode::BadInput)
}

/// Leads [`CHOSEN`] to `version`, from where it leads now.
fn label(
    address: &str,
    stream: StreamName,
    version: u64,
    led: Option<LabelState>,
) -> Result<(), Failure> {
    let wanted = SetLabel {
        stream,
        label: LabelName::new(CHOSEN).or_exit(ExitCode::Internal)?,
        version,
        expected_generation: led.map_or(0, |state| state.generation),
        override_reason: None,
    };
    block_on(async { RegistryClient::new(address)?.set_label(wanted).await.map(drop) })
}

/// What was tried, as lines for a person.
pub fn print(choice: &Choice) {
    let missed = |tried: &Tried| tried.missed.join(" | ");
    let (version, n) = (choice.version, choice.tried.len());
    let Some(last) = choice.tried.first().filter(|last| !last.passes()) else { return };
    say::line(format!("version {}, the last one, does not pass: {}", last.version, missed(last)));
    let what = match choice.tried.iter().find(|tried| tried.version == version) {
        Some(chosen) if chosen.passes() => "the newest that passes".to_owned(),
        Some(chosen) if version != last.version => {
            format!("none of {n} passes, it misses least: {}", missed(chosen))
        }
        _ => format!("none of {n} passes, none misses less"),
    };
    say::line(format!("version {version} is the policy (label `{CHOSEN}`): {what}"));
}
