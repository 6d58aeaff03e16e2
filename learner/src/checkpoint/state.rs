//! What a checkpoint holds, and its form as files.
//!
//! `state.safetensors`: parameters, both moments of Adam, the normaliser and the learning rate, under the
//! names that a PyTorch user expects. `meta.json`: everything else that decides how the run goes on.
//! `history.json`: the curves. `actor_000.state`: one saved actor each, in-process runs only.

use std::collections::VecDeque;

use caudata_actor::ActorSnapshot;
use caudata_random::Stream;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};

use super::store::{FORMAT, Files};
use crate::batch::Accounting;
use crate::network::Layout;
use crate::normaliser::Moments;
use crate::report::{History, ReturnSums};

const STATE: &str = "state.safetensors";
const META: &str = "meta.json";
const HISTORY: &str = "history.json";
const ACTOR_PREFIX: &str = "actor_";
const ACTOR_SUFFIX: &str = ".state";
/// Episodes that the mean return is taken over (as rsl_rl has it).
const EPISODES: usize = 100;

/// The whole state of a run between two iterations.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckpointState {
    /// Counters, streams, accounts.
    pub saved: Saved,
    /// All parameters, in the order of the flat vector, padding included.
    pub parameters: Vec<f32>,
    /// First moments of Adam, likewise.
    pub adam_m: Vec<f32>,
    /// Second moments of Adam, likewise.
    pub adam_v: Vec<f32>,
    /// Learning rate of the next update.
    pub learning_rate: f64,
    /// Statistics of the observations.
    pub moments: Moments,
    /// Mean step reward of every iteration so far.
    pub step_rewards: Vec<f64>,
    /// The episodes that ended in each of them.
    pub returns: Vec<ReturnSums>,
    /// The curves.
    pub history: History,
    /// The actors of an in-process run; empty otherwise.
    pub actors: Vec<ActorSnapshot>,
}

/// `meta.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Saved {
    /// Version of the meaning of these files.
    pub format: u32,
    /// The run.
    pub run_id: String,
    /// Iterations done.
    pub iteration: u64,
    /// Version of the current policy, less the iterations done: not 0 in a run that went on from a checkpoint
    /// after it had published later versions.
    #[serde(default)]
    pub version_offset: u64,
    /// What the policies of the run say was checked out when it began.
    #[serde(default)]
    pub training_commit: String,
    /// Environment steps used.
    pub steps_total: u64,
    /// Seconds of training, over all processes.
    pub wall_s: f64,
    /// Hash of the configuration.
    pub config_hash: String,
    /// Hash of the policy contract.
    pub contract_hash: String,
    /// SHA-256 of the current policy's file.
    pub policy_sha256: String,
    /// Steps of the optimiser.
    pub adam_steps: u64,
    /// Decides which samples meet in a minibatch.
    pub minibatch_order: Stream,
    /// The last episodes.
    pub episodes: EpisodeWindow,
    /// What became of every chunk.
    pub accounting: Accounting,
}

/// The last episodes that ended, for means that do not jump.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EpisodeWindow {
    episodes: VecDeque<Episode>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Episode {
    return_sum: f32,
    steps: u32,
    terms: Vec<f32>,
    #[serde(default = "whole")]
    share: f64,
}

fn whole() -> f64 {
    1.0
}

impl EpisodeWindow {
    /// Adds an episode that ended and counts as `share` of a whole one; the oldest one beyond 100 leaves.
    pub fn push(&mut self, episode: &caudata_proto::EpisodeSummary, share: f64) {
        self.episodes.push_back(Episode {
            return_sum: episode.return_sum,
            steps: episode.steps,
            terms: episode.terms.clone(),
            share,
        });
        if self.episodes.len() > EPISODES {
            self.episodes.pop_front();
        }
    }

    /// Mean return of a whole episode; `None` before the first one has ended.
    pub fn mean_return(&self) -> Option<f64> {
        self.mean(|episode| f64::from(episode.return_sum))
    }

    /// Mean length likewise, control steps.
    pub fn mean_steps(&self) -> Option<f64> {
        self.mean(|episode| f64::from(episode.steps))
    }

    /// Mean sum of reward term `index` likewise.
    pub fn mean_term(&self, index: usize) -> Option<f64> {
        self.mean(|episode| f64::from(episode.terms.get(index).copied().unwrap_or(0.0)))
    }

    fn mean(&self, value: impl Fn(&Episode) -> f64) -> Option<f64> {
        let whole: f64 = self.episodes.iter().map(|episode| episode.share).sum();
        (whole > 0.0).then(|| self.episodes.iter().map(value).sum::<f64>() / whole)
    }
}

impl CheckpointState {
    /// As the files of a checkpoint, for a network laid out as `layout`.
    ///
    /// # Errors
    /// One line when a part has no form as a file.
    pub fn to_files(&self, layout: &Layout) -> Result<Files, String> {
        let text = |error: serde_json::Error| error.to_string();
        let mut files = Files::new();
        files.insert(STATE.into(), self.tensors(layout)?);
        files.insert(META.into(), serde_json::to_vec_pretty(&self.saved).map_err(text)?);
        files.insert(HISTORY.into(), serde_json::to_vec(&self.history).map_err(text)?);
        for actor in &self.actors {
            let name = format!("{ACTOR_PREFIX}{:03}{ACTOR_SUFFIX}", actor.actor_id);
            files.insert(name, actor.to_bytes());
        }
        Ok(files)
    }

    /// The opposite of [`CheckpointState::to_files`].
    ///
    /// # Errors
    /// One line that says which file is not what it should be, and how.
    pub fn from_files(files: &Files, layout: &Layout) -> Result<Self, String> {
        let file = |name: &str| files.get(name).ok_or_else(|| format!("{name} is missing"));
        let saved: Saved =
            serde_json::from_slice(file(META)?).map_err(|error| format!("{META}: {error}"))?;
        if saved.format != FORMAT {
            return Err(format!("format {}, this program reads {FORMAT}", saved.format));
        }
        let history = serde_json::from_slice(file(HISTORY)?)
            .map_err(|error| format!("{HISTORY}: {error}"))?;
        let bytes = file(STATE)?;
        let tensors =
            SafeTensors::deserialize(bytes).map_err(|error| format!("{STATE}: {error}"))?;
        let reader = Reader { tensors };
        let (count, _) = reader.bytes("normaliser.count", Dtype::U64)?;
        let count = count.first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
        let (mean, m2) = (reader.f64s("normaliser.mean")?, reader.f64s("normaliser.m2")?);
        if mean.len() != m2.len() {
            return Err(format!("{STATE}: mean and m2 of the normaliser differ in length"));
        }
        let learning_rate = reader.f64s("learning_rate")?;
        let step_rewards = reader.f64s("mean_step_reward")?;
        // Checkpoints of before have none.
        let mut returns = ReturnSums::from_rows(&reader.f64s("returns").unwrap_or_default());
        returns.resize(step_rewards.len(), ReturnSums::default());
        Ok(Self {
            saved,
            parameters: reader.flat("", layout)?,
            adam_m: reader.flat("adam.m.", layout)?,
            adam_v: reader.flat("adam.v.", layout)?,
            learning_rate: *learning_rate.first().ok_or("learning_rate is empty")?,
            moments: Moments { count, mean, m2 },
            step_rewards,
            returns,
            history,
            actors: actors(files)?,
        })
    }

    fn tensors(&self, layout: &Layout) -> Result<Vec<u8>, String> {
        let mut tensors: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
        let groups = [("", &self.parameters), ("adam.m.", &self.adam_m), ("adam.v.", &self.adam_v)];
        for (prefix, flat) in groups {
            if flat.len() != layout.len() {
                return Err(format!(
                    "{} parameters for a network with {}",
                    flat.len(),
                    layout.len()
                ));
            }
            for parameter in layout.parameters() {
                let values = &flat[parameter.offset..][..parameter.numel()];
                let shape = parameter.shape.iter().map(|&n| n as usize).collect();
                let data = values.iter().flat_map(|x| x.to_le_bytes()).collect();
                let name = format!("{prefix}{}", parameter.name);
                tensors.push((name, Dtype::F32, shape, data));
            }
        }
        let mut add = |name: &str, values: &[f64]| {
            let data = values.iter().flat_map(|x| x.to_le_bytes()).collect();
            tensors.push((name.into(), Dtype::F64, vec![values.len()], data));
        };
        add("normaliser.mean", &self.moments.mean);
        add("normaliser.m2", &self.moments.m2);
        add("learning_rate", &[self.learning_rate]);
        add("mean_step_reward", &self.step_rewards);
        add("returns", &ReturnSums::to_rows(&self.returns));
        let data = self.moments.count.to_le_bytes().to_vec();
        tensors.push(("normaliser.count".into(), Dtype::U64, vec![1], data));
        let views = tensors.iter().map(|(name, dtype, shape, data)| {
            let view = TensorView::new(*dtype, shape.clone(), data);
            Ok((name.as_str(), view.map_err(|error| error.to_string())?))
        });
        let views = views.collect::<Result<Vec<_>, String>>()?;
        serialize(views, None).map_err(|error| error.to_string())
    }
}

/// The saved actors, by number.
fn actors(files: &Files) -> Result<Vec<ActorSnapshot>, String> {
    let is_actor = |name: &&String| name.starts_with(ACTOR_PREFIX) && name.ends_with(ACTOR_SUFFIX);
    let mut actors = Vec::new();
    for name in files.keys().filter(is_actor) {
        let actor = ActorSnapshot::from_bytes(&files[name]);
        actors.push(actor.ok_or_else(|| format!("{name} is no saved actor"))?);
    }
    actors.sort_by_key(|actor| actor.actor_id);
    Ok(actors)
}

struct Reader<'a> {
    tensors: SafeTensors<'a>,
}

impl Reader<'_> {
    fn bytes(&self, name: &str, dtype: Dtype) -> Result<(&[u8], Vec<i64>), String> {
        let tensor =
            self.tensors.tensor(name).map_err(|error| format!("{STATE}: {name}: {error}"))?;
        if tensor.dtype() != dtype {
            return Err(format!("{STATE}: {name} has type {:?}, not {dtype:?}", tensor.dtype()));
        }
        Ok((tensor.data(), tensor.shape().iter().map(|&n| n as i64).collect()))
    }

    /// All parameters whose names begin with `prefix`, in the order of the flat vector.
    fn flat(&self, prefix: &str, layout: &Layout) -> Result<Vec<f32>, String> {
        let mut flat = vec![0.0; layout.len()];
        for parameter in layout.parameters() {
            let name = format!("{prefix}{}", parameter.name);
            let (bytes, shape) = self.bytes(&name, Dtype::F32)?;
            if shape != parameter.shape {
                let expected = &parameter.shape;
                return Err(format!("{STATE}: {name} is {shape:?}, the network has {expected:?}"));
            }
            for (x, bytes) in flat[parameter.offset..].iter_mut().zip(bytes.as_chunks().0) {
                *x = f32::from_le_bytes(*bytes);
            }
        }
        match flat.iter().all(|x| x.is_finite()) {
            true => Ok(flat),
            false => Err(format!("{STATE}: {prefix}* holds a value that is not finite")),
        }
    }

    fn f64s(&self, name: &str) -> Result<Vec<f64>, String> {
        let chunks = self.bytes(name, Dtype::F64)?.0.as_chunks().0.iter();
        Ok(chunks.map(|bytes| f64::from_le_bytes(*bytes)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    fn layout() -> Layout {
        let mut layout = Layout::default();
        layout.push("policy.0.weight".into(), &[2, 3]);
        layout.push("raw_log_std".into(), &[2]);
        layout
    }

    fn state() -> CheckpointState {
        let mut minibatch_order =
            Stream::new(Key { seed: 1, actor: 0, env: 0, episode: 0 }, Purpose::Minibatch);
        minibatch_order.next_u32();
        let mut episodes = EpisodeWindow::default();
        let episode = caudata_proto::EpisodeSummary {
            lane: 0,
            steps: 10,
            return_sum: 0.1,
            terms: vec![1.0, -0.3],
            terminated: false,
            reason: 0,
            mean_speed_mps: 0.2,
        };
        episodes.push(&episode, 0.1);
        let mut returns = ReturnSums::default();
        returns.add(0.1, 1.0 / 3.0);
        // Padding is zero, as in a network.
        let flat = |scale: f32| {
            let mut flat = vec![0.0; 32];
            (0..6).chain(16..18).for_each(|i| flat[i] = scale / (1.0 + i as f32));
            flat
        };
        CheckpointState {
            saved: Saved {
                format: FORMAT,
                run_id: "run".into(),
                iteration: 12,
                version_offset: 3,
                training_commit: "abc".into(),
                steps_total: 3456,
                wall_s: 0.1 + 0.2,
                config_hash: "c".into(),
                contract_hash: "k".into(),
                policy_sha256: "p".into(),
                adam_steps: 99,
                minibatch_order,
                episodes,
                accounting: Accounting::default(),
            },
            parameters: flat(1.0),
            adam_m: flat(-1e-30),
            adam_v: flat(1e-38),
            learning_rate: 1e-3 / 1.5,
            moments: Moments { count: 7, mean: vec![0.1, 1.0 / 3.0], m2: vec![1e-300, 5.0] },
            step_rewards: vec![0.1, -0.7],
            returns: vec![returns, ReturnSums::default()],
            history: History::default(),
            actors: vec![ActorSnapshot {
                actor_id: 1,
                actor_key: 1,
                policy_version: Some(11),
                credits: 0,
                env: vec![1, 2, 3],
            }],
        }
    }

    #[test]
    fn every_bit_comes_back() {
        let files = state().to_files(&layout()).unwrap();
        assert_eq!(
            files.keys().collect::<Vec<_>>(),
            ["actor_001.state", "history.json", "meta.json", "state.safetensors"]
        );
        assert_eq!(CheckpointState::from_files(&files, &layout()).unwrap(), state());
    }

    #[test]
    fn a_state_of_another_network_or_with_holes_is_refused_by_name() {
        let files = state().to_files(&layout()).unwrap();
        let refused = |files: &Files, layout: &Layout| {
            CheckpointState::from_files(files, layout).unwrap_err()
        };
        let mut wider = Layout::default();
        wider.push("policy.0.weight".into(), &[2, 4]);
        assert!(refused(&files, &wider).contains("policy.0.weight is [2, 3]"));
        wider.push("policy.1.weight".into(), &[1, 1]);
        for (name, found) in [
            ("meta.json", "meta.json is missing"),
            ("state.safetensors", "state.safetensors is missing"),
        ] {
            let mut less = files.clone();
            less.remove(name);
            assert!(refused(&less, &layout()).contains(found));
        }
        for name in ["meta.json", "state.safetensors", "actor_001.state", "history.json"] {
            let mut cut = files.clone();
            cut.get_mut(name).unwrap().pop();
            assert!(CheckpointState::from_files(&cut, &layout()).is_err(), "{name} cut off");
        }
    }

    #[test]
    fn the_window_forgets_the_oldest() {
        let mut window = EpisodeWindow::default();
        assert_eq!(window.mean_return(), None);
        for i in 0..150_u8 {
            let episode = caudata_proto::EpisodeSummary {
                lane: 0,
                steps: 1,
                return_sum: f32::from(i),
                terms: vec![f32::from(i) * 2.0],
                terminated: false,
                reason: 0,
                mean_speed_mps: 0.0,
            };
            window.push(&episode, 1.0);
        }
        // The last hundred are 50 to 149.
        assert_eq!(window.mean_return(), Some(99.5));
        assert_eq!((window.mean_term(0), window.mean_term(9)), (Some(199.0), Some(0.0)));
        assert_eq!(window.mean_steps(), Some(1.0));
    }
}
