//! What the learner tells its supervisor while it trains: one JSON object per line on its standard output.
//!
//! The command line shows these as a progress line, as plain lines, or passes them on (`--json`), and keeps
//! them in `progress.jsonl` of the run folder. Field names are stable; fields are only added.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};

/// One line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// The learner listens and is about to train.
    Started(Started),
    /// One iteration is done.
    Iteration(Box<Iteration>),
    /// A checkpoint is on disk.
    Checkpoint(Checkpoint),
    /// A policy was published to the policy server.
    Published(Published),
    /// Settings changed while the run goes on.
    Changed(Changed),
    /// Something a person should know; training goes on.
    Warning(Warning),
    /// The learner is done; this is its last line.
    Finished(Box<Finished>),
}

/// The learner listens and is about to train.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Started {
    /// Identifier of the run, in every rollout.
    pub run_id: String,
    /// Endpoint that actors connect to (`inproc`, an iceoryx2 service root, `tcp/127.0.0.1:port`).
    pub transport: String,
    /// Bound address of `/metrics`, if it is served.
    pub metrics: Option<String>,
    /// First iteration that will be done (0 for a fresh run).
    pub iteration: u64,
    /// Iterations at which the run ends.
    pub iterations: u64,
    /// Checkpoint that the run goes on from.
    pub resumed_from: Option<String>,
    /// `cpu` or `cuda:0`.
    pub device: String,
    /// By actor: the first incarnation that the learner has not heard of. Older ones are not listened to.
    #[serde(default)]
    pub next_incarnations: Vec<u64>,
}

/// One iteration: what was collected and what was learnt from it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Iteration {
    /// Number of this iteration, counted from 1 over the whole run.
    pub iteration: u64,
    /// Iterations at which the run ends.
    pub iterations: u64,
    /// Version of the policy that comes out of this iteration.
    pub policy_version: u64,
    /// Environment steps used since the run began.
    pub steps_total: u64,
    /// Environment steps per second of this iteration, all included.
    pub steps_per_s: f64,
    /// Mean return of a whole episode over those that ended lately; absent before the first one. One that was
    /// cut short at the start of the run counts as the part that it lasted.
    pub mean_return: Option<f64>,
    /// Mean length of those episodes likewise, steps.
    pub mean_episode_length: Option<f64>,
    /// Mean reward per step of this batch, which needs no ended episode.
    pub mean_step_reward: f64,
    /// Per reward term: mean sum over a whole episode. Ordered by name.
    pub reward_terms: std::collections::BTreeMap<String, f64>,
    /// Policy versions between collection and use, mean over the batch.
    pub lag_mean: f64,
    /// The largest of them.
    pub lag_max: u64,
    /// Effective sample size of the importance weights, as a share of the batch; 1 where all data is fresh.
    #[serde(default)]
    pub effective_share: f64,
    /// Mean KL divergence of the update, nats.
    pub kl: f64,
    /// Losses: clipped surrogate, value, entropy of the policy (nats).
    pub surrogate_loss: f64,
    /// Value loss.
    pub value_loss: f64,
    /// Entropy of the policy, nats.
    pub entropy: f64,
    /// Learning rate after this iteration.
    pub learning_rate: f64,
    /// Mean standard deviation of the action noise.
    pub mean_std: f64,
    /// Share of samples whose ratio was clipped, 0–1.
    pub clip_fraction: f64,
    /// Seconds spent waiting for rollouts.
    pub collection_s: f64,
    /// Seconds spent learning.
    pub learning_s: f64,
    /// Seconds of all threads of the learner's process in this iteration, by part of the work
    /// ([`crate::spans::Part`]).
    #[serde(default)]
    pub spans_s: std::collections::BTreeMap<String, f64>,
    /// Seconds that the rest of the run will take at the present speed.
    pub eta_s: f64,
    /// What has become of the chunks so far.
    pub accounting: Accounting,
}

/// A checkpoint is on disk.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Checkpoint {
    /// Folder or file.
    pub path: String,
    /// Iterations done in it.
    pub iteration: u64,
}

/// A policy was published.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Published {
    /// Its version.
    pub version: u64,
    /// SHA-256 of the ONNX bytes, hex.
    pub sha256: String,
    /// Size of the ONNX bytes.
    pub bytes: u64,
}

/// Settings changed while the run goes on.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Changed {
    /// Iterations that were done before.
    pub iteration: u64,
    /// `key=value` each.
    pub set: Vec<String>,
}

/// Something a person should know.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Warning {
    /// One line.
    pub message: String,
}

/// The learner is done.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Finished {
    /// `completed`, or why it ended early (`SIGTERM`, …).
    pub reason: String,
    /// Iterations done over the whole run.
    pub iteration: u64,
    /// Environment steps used.
    pub steps_total: u64,
    /// Seconds since this process began to train.
    pub wall_s: f64,
    /// Version of the last policy.
    pub policy_version: u64,
    /// SHA-256 of its ONNX bytes, hex.
    pub policy_sha256: String,
    /// Where its file lies.
    pub policy_path: String,
    /// The last checkpoint.
    pub checkpoint_path: String,
    /// Mean step reward over the first tenth of the iterations of the run, with its standard error.
    pub first_tenth: Option<MeanSe>,
    /// The same over the last tenth.
    pub last_tenth: Option<MeanSe>,
    /// Mean return of a whole episode, over those that ended in the first tenth; `n` episodes.
    #[serde(default)]
    pub first_tenth_return: Option<MeanSe>,
    /// The same over the last tenth.
    #[serde(default)]
    pub last_tenth_return: Option<MeanSe>,
    /// The newest policy that actors ran, best one that was also published.
    #[serde(default)]
    pub actors_policy: Option<ActorsPolicy>,
    /// What became of every chunk.
    pub accounting: Accounting,
    /// The same per actor, ordered by id.
    pub actors: Vec<ActorAccount>,
}

/// A policy that actors ran, as their chunks name it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ActorsPolicy {
    /// Its version.
    pub version: u64,
    /// SHA-256 of the ONNX bytes that the actors loaded, hex.
    pub sha256: String,
    /// SHA-256 of the ONNX bytes that the learner made as that version, hex.
    pub learner_sha256: String,
    /// Whether the policy server has it too.
    pub published: bool,
}

/// A mean and its standard error over `n` values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MeanSe {
    /// Mean.
    pub mean: f64,
    /// Standard error of the mean.
    pub standard_error: f64,
    /// Values.
    pub n: u64,
}

/// Chunks by what became of them. `received = accepted + rejected + dropped` and those that wait for a batch;
/// what actors sent on top of that was lost with a process or a link.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Accounting {
    /// Chunks that reached the learner, or were rolled back when the run went on from a checkpoint.
    pub received: u64,
    /// Used for learning.
    pub accepted: u64,
    /// Refused as invalid, duplicate or not ours.
    pub rejected: u64,
    /// Valid but not used: too old, or left over at the end.
    pub dropped: u64,
    /// Reasons of the rejected and dropped ones. Ordered by name.
    pub reasons: std::collections::BTreeMap<String, u64>,
}

/// The account of one incarnation of one actor.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ActorAccount {
    /// Actor.
    pub actor_id: u32,
    /// How many times it was started, from 0.
    pub incarnation: u64,
    /// What it said it had sent when it left; absent when it died without a word.
    pub sent: Option<u64>,
    /// Chunks of it that reached the learner, or were rolled back when the run went on from a checkpoint.
    pub received: u64,
    /// Used.
    pub accepted: u64,
    /// Refused.
    pub rejected: u64,
    /// Not used.
    pub dropped: u64,
}

/// Writes events as lines and flushes each, so that a reader sees it at once.
#[derive(Debug)]
pub struct EventWriter<W: Write> {
    out: W,
}

impl<W: Write> EventWriter<W> {
    /// Writes to `out`.
    pub fn new(out: W) -> Self {
        Self { out }
    }

    /// One line.
    ///
    /// # Errors
    /// When `out` refuses it, for instance because the reader is gone.
    pub fn write(&mut self, event: &Event) -> io::Result<()> {
        // In one piece: another thread may write lines of its own.
        let mut line = serde_json::to_vec(event)?;
        line.push(b'\n');
        self.out.write_all(&line)?;
        self.out.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_which_event_it_is_and_comes_back_equal() {
        let event = Event::Checkpoint(Checkpoint { path: "a/b".into(), iteration: 7 });
        let mut line = Vec::new();
        EventWriter::new(&mut line).write(&event).unwrap();
        let text = String::from_utf8(line).unwrap();
        assert_eq!(text, "{\"event\":\"checkpoint\",\"path\":\"a/b\",\"iteration\":7}\n");
        assert_eq!(serde_json::from_str::<Event>(&text).unwrap(), event);
        let event = Event::Iteration(Box::default());
        let text = serde_json::to_string(&event).unwrap();
        assert_eq!(serde_json::from_str::<Event>(&text).unwrap(), event);
    }

    /// All keys of objects inside `value`.
    fn keys(value: &serde_json::Value, out: &mut Vec<String>) {
        match value {
            serde_json::Value::Object(map) => {
                for (key, value) in map {
                    out.push(key.clone());
                    keys(value, out);
                }
            }
            serde_json::Value::Array(items) => items.iter().for_each(|item| keys(item, out)),
            _ => {}
        }
    }

    #[test]
    fn the_documentation_names_every_event_and_key() {
        let page = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/reference/json.md");
        let page = std::fs::read_to_string(page).unwrap();
        let finished = Finished {
            first_tenth: Some(MeanSe::default()),
            actors_policy: Some(ActorsPolicy::default()),
            actors: vec![ActorAccount::default()],
            ..Finished::default()
        };
        let events = [
            Event::Started(Started::default()),
            Event::Iteration(Box::default()),
            Event::Checkpoint(Checkpoint::default()),
            Event::Published(Published::default()),
            Event::Changed(Changed::default()),
            Event::Warning(Warning::default()),
            Event::Finished(Box::new(finished)),
        ];
        for event in events {
            let value = serde_json::to_value(&event).unwrap();
            let mut names = vec![value["event"].as_str().unwrap().to_owned()];
            keys(&value, &mut names);
            for name in names {
                assert!(
                    page.contains(&format!("`{name}`")),
                    "docs/reference/json.md does not name `{name}`"
                );
            }
        }
    }
}
