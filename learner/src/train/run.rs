//! The loop: collect, learn, export, publish, report, save; and the end of it.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use caudata_config::Config;
use caudata_policy::PolicyFile;
use caudata_proto::RolloutChunk;
use caudata_random::Stream;
use caudata_telemetry::StopFlag;
use caudata_telemetry::now_ns;
use caudata_telemetry::progress::{Event, Finished};
use caudata_telemetry::spans::{Laps, Part};
use caudata_transport::{Control, LearnerLink, PolicyUpdate};

use super::collect::{Collected, collect};
use super::fleet::Fleet;
use super::report::{IterationReport, Reporter};
use super::seen::PoliciesSeen;
use super::traces::Traces;
use super::tuning::Tuning;
use super::versions::Versions;
use crate::LearnerError;
use crate::batch::{Batch, Collector, side_by_side};
use crate::checkpoint::{CheckpointState, CheckpointStore, EpisodeWindow, FORMAT, Saved};
use crate::export::{PolicyIdentity, export, write_policy};
use crate::normaliser::{Moments, Scaling};
use crate::ppo::{Ppo, UpdateStats};
use crate::publish::{Notice, Publisher};
use crate::report::{History, ReturnSums, share_of_whole};

/// Iterations in a row without any finite update after which the run ends.
const NOT_FINITE_MAX: u32 = 10;

/// What changes from iteration to iteration besides the network and the accounts.
pub(super) struct Progress {
    pub iteration: u64,
    /// Versions of policies are this far ahead of iterations.
    pub version_offset: u64,
    pub steps_total: u64,
    /// Seconds of training in earlier processes.
    pub wall_s: f64,
    pub moments: Moments,
    pub order: Stream,
    pub episodes: EpisodeWindow,
    pub step_rewards: Vec<f64>,
    /// The episodes that ended in each iteration.
    pub returns: Vec<ReturnSums>,
    pub history: History,
}

impl Progress {
    /// Version of the current policy.
    pub fn version(&self) -> u64 {
        self.iteration + self.version_offset
    }
}

/// A run with everything in its hands.
pub(super) struct Run<'a> {
    pub config: &'a Config,
    /// Names of the reward terms.
    pub term_names: Vec<String>,
    pub run_dir: PathBuf,
    pub stop: &'a StopFlag,
    pub identity: PolicyIdentity,
    pub store: CheckpointStore,
    pub ppo: Ppo,
    pub collector: Collector,
    pub link: Box<dyn LearnerLink>,
    pub fleet: Option<Fleet>,
    pub publisher: Option<Publisher>,
    pub reporter: Reporter,
    pub progress: Progress,
    pub traces: Traces,
    /// Where actors outlive this process.
    pub versions: Option<Versions>,
    pub tuning: Tuning,
    pub began: Instant,
}

/// What the end needs to know about the loop.
pub(super) struct LoopState {
    pub policy: PolicyFile,
    pub scaling: Scaling,
    /// Iteration and folder of the newest checkpoint.
    pub saved: Option<(u64, PathBuf)>,
    /// Whether every actor waits for the policy of the current iteration, so that their states belong
    /// together.
    pub actors_wait: bool,
    pub not_finite: u32,
    /// The first iteration of this process.
    pub first: u64,
    /// What actors ran.
    pub seen: PoliciesSeen,
}

impl Run<'_> {
    /// Trains to the end, or until stopped or unable; then winds everything down.
    pub fn train(mut self) -> Result<Finished, LearnerError> {
        let scaling = self.scaling();
        let policy = self.first_policy(&scaling)?;
        let mut state = LoopState {
            policy,
            scaling,
            saved: None,
            actors_wait: false,
            not_finite: 0,
            first: self.progress.iteration,
            seen: PoliciesSeen::default(),
        };
        let result = self.iterate(&mut state);
        if let Err(error) = &result {
            tracing::error!(%error, "training ends early");
        }
        let wound_down = self.wind_down(&mut state, result.is_ok());
        let reason = result?;
        wound_down?;
        Ok(self.finished(&state, reason))
    }

    fn iterate(&mut self, state: &mut LoopState) -> Result<String, LearnerError> {
        self.retune()?;
        self.announce(state)?;
        // In lockstep a policy goes out when everything that older ones were to collect is there.
        let holds_back = self.config.actors.lockstep && self.config.actors.max_lead > 0;
        let mut held_back = false;
        while self.progress.iteration < self.config.run.iterations {
            let (started, waiting_ns) = (Instant::now(), now_ns());
            let chunks = {
                let _span = tracing::info_span!("collect").entered();
                let (link, fleet) = (self.link.as_mut(), self.fleet.as_mut());
                let (learner, told) = (&self.config.learner, &mut self.reporter);
                collect(&mut self.collector, link, fleet, learner, self.stop, told, &self.traces)?
            };
            let Collected::Batch(chunks) = chunks else { return Ok(self.stop_reason()) };
            let collection_s = started.elapsed().as_secs_f64();
            state.actors_wait = true;
            if std::mem::take(&mut held_back) {
                self.announce(state)?;
            }
            self.traces.batch(&chunks, waiting_ns);
            self.learn(chunks, state, started, collection_s)?;
            self.tell_published(&mut state.seen);
            if self.stop.is_set() {
                return Ok(self.stop_reason());
            }
            if self.progress.iteration < self.config.run.iterations {
                self.retune()?;
                self.hand_out(state, holds_back)?;
                held_back = holds_back;
            }
        }
        Ok("completed".to_owned())
    }

    /// One iteration from its chunks on, up to the next policy.
    fn learn(
        &mut self,
        chunks: Vec<RolloutChunk>,
        state: &mut LoopState,
        started: Instant,
        collection_s: f64,
    ) -> Result<(), LearnerError> {
        let version = self.progress.version();
        let mut laps = Laps::new();
        let mut returns = ReturnSums::default();
        for chunk in &chunks {
            state.seen.ran(chunk.policy_version, &chunk.policy_sha256);
            for episode in &chunk.episodes {
                let share = share_of_whole(episode, self.config.task.episode_steps);
                self.progress.episodes.push(episode, share);
                returns.add(f64::from(episode.return_sum), share);
            }
        }
        let batch = Arc::new(Batch::new(match self.config.actors.lockstep {
            true => side_by_side(chunks),
            false => chunks,
        }));
        // The first iterations after a warm start only teach the critic of a policy that was trained before.
        let warm = &self.config.learner.warm_start;
        let critic_first = match warm.policy.as_os_str().is_empty() {
            true => None,
            false => Some(warm.value_only_iterations),
        };
        let value_only = critic_first.is_some_and(|first| self.progress.iteration < first);
        if critic_first == Some(self.progress.iteration) {
            self.ppo.begin_policy();
        }
        self.ppo.set_progress(self.progress.steps_total);
        laps.lap(Part::Returns);
        let (learning, learning_ns) = (Instant::now(), now_ns());
        let stats = {
            let _span = tracing::info_span!("learn", samples = batch.rows).entered();
            self.ppo.update(
                &batch,
                &state.scaling,
                version,
                &mut self.progress.order,
                value_only,
            )?
        };
        let learning_s = learning.elapsed().as_secs_f64();
        laps.waited();
        let samples = vec![("caudata.samples", batch.rows.into())];
        self.traces.done("update", learning_ns, samples);
        self.watch_finite(&stats, state)?;
        // The policy that acted saw the old normaliser; the next one sees this batch as well.
        batch.moments.iter().for_each(|moments| self.progress.moments.merge(moments));
        self.progress.iteration += 1;
        self.progress.steps_total += batch.rows as u64;
        self.progress.step_rewards.push(batch.mean_reward());
        self.progress.returns.push(returns);
        state.scaling = self.scaling();
        laps.lap(Part::Returns);
        let exporting_ns = now_ns();
        state.policy = {
            let _span = tracing::info_span!("export").entered();
            self.export(&state.scaling)?
        };
        self.traces.done("export policy", exporting_ns, Vec::new());
        laps.lap(Part::Export);
        self.report(
            &batch,
            &stats,
            version,
            state.first,
            [started.elapsed().as_secs_f64(), collection_s, learning_s],
        );
        laps.lap(Part::Publishing);
        Ok(())
    }

    /// Gives the actors the new policy unless it is `held_back`, and saves and publishes where it is time to.
    fn hand_out(&mut self, state: &mut LoopState, held_back: bool) -> Result<(), LearnerError> {
        let learner = &self.config.learner;
        let mut laps = Laps::new();
        let iteration = self.progress.iteration;
        let save = iteration.is_multiple_of(learner.checkpoint_every);
        // Before the actors go on; the file is written while they are at work.
        let checkpoint = if save { Some(self.state(state)?) } else { None };
        if !held_back {
            self.announce(state)?;
            state.actors_wait = false;
        }
        if iteration.is_multiple_of(learner.publish_every) {
            self.publish(&state.policy)?;
        }
        if let Some(checkpoint) = checkpoint {
            state.saved = Some((iteration, self.save(&checkpoint)?));
        }
        laps.lap(Part::Publishing);
        Ok(())
    }

    fn watch_finite(
        &mut self,
        stats: &UpdateStats,
        state: &mut LoopState,
    ) -> Result<(), LearnerError> {
        if stats.skipped > 0 {
            let (skipped, iteration) = (stats.skipped, self.progress.iteration + 1);
            self.reporter.warn(format!(
                "iteration {iteration}: {skipped} minibatches left out because something was not finite"
            ));
        }
        if stats.effective_share < self.config.learner.staleness.min_effective_share {
            let share = stats.effective_share;
            self.reporter.warn(format!(
                "the data is stale: effective sample share {share:.2}; the learning rate was halved for this batch"
            ));
        }
        state.not_finite = if stats.updates == 0 { state.not_finite + 1 } else { 0 };
        match state.not_finite {
            NOT_FINITE_MAX => Err(LearnerError::NotFinite { iterations: NOT_FINITE_MAX }),
            _ => Ok(()),
        }
    }

    fn report(
        &mut self,
        batch: &Batch,
        stats: &UpdateStats,
        version: u64,
        first: u64,
        [total_s, collection_s, learning_s]: [f64; 3],
    ) {
        let lags: Vec<u64> = batch.segments.iter().map(|s| version - s.policy_version).collect();
        let progress = &mut self.progress;
        let here_s = self.began.elapsed().as_secs_f64();
        let per_iteration = here_s / (progress.iteration - first).max(1) as f64;
        let left = self.config.run.iterations.saturating_sub(progress.iteration);
        let report = IterationReport {
            iteration: progress.iteration,
            iterations: self.config.run.iterations,
            policy_version: progress.version(),
            steps_total: progress.steps_total,
            term_names: &self.term_names,
            batch_steps: batch.rows,
            mean_step_reward: batch.mean_reward(),
            lag_mean: lags.iter().sum::<u64>() as f64 / lags.len().max(1) as f64,
            lag_max: lags.iter().copied().max().unwrap_or(0),
            lag_allowed: match self.config.actors.max_lead {
                0 => 0,
                _ => self.config.learner.staleness.max_lag,
            },
            stats,
            episodes: &progress.episodes,
            accounting: self.collector.accounting(),
            collection_s,
            learning_s,
            total_s,
            wall_s: progress.wall_s + here_s,
            eta_s: per_iteration * left as f64,
        };
        self.reporter.iteration(&report, &mut progress.history);
    }

    fn scaling(&self) -> Scaling {
        let network = &self.config.learner.network;
        let clip = network.observation_clip as f32;
        match network.normalise_observations {
            true => match self.ppo.net().spec().seen_mirror() {
                Some(mirror) => self.progress.moments.with_image(&mirror).scaling(clip),
                None => self.progress.moments.scaling(clip),
            },
            false => Scaling::identity(self.progress.moments.mean.len(), clip),
        }
    }

    fn export(&self, scaling: &Scaling) -> Result<PolicyFile, LearnerError> {
        let (version, steps) = (self.progress.version(), self.progress.steps_total);
        export(self.ppo.net(), scaling, &self.identity, version, steps)
    }

    /// The policy to begin with. Bytes under a version never change: where the run folder holds a later
    /// version than the checkpoint that the run goes on from, or other bytes of the same one, numbers go on
    /// behind it.
    fn first_policy(&mut self, scaling: &Scaling) -> Result<PolicyFile, LearnerError> {
        let policy = self.export(scaling)?;
        // policy.onnx is an older one where a training chose it; the last one lies beside it then
        let files = [self.policy_path(), self.run_dir.join("last_policy.onnx")];
        let before = files
            .iter()
            .filter_map(|path| PolicyFile::parse(Arc::from(std::fs::read(path).ok()?)).ok())
            .filter(|before| before.metadata().run_id == self.identity.run_id)
            .max_by_key(|before| before.metadata().version);
        let now = policy.metadata().version;
        let in_folder = before.as_ref().map(|before| before.metadata().version);
        let noted = self.versions.as_ref().and_then(Versions::highest);
        let Some(then) = in_folder.max(noted).filter(|then| *then >= now) else {
            return Ok(policy);
        };
        let same = before.is_some_and(|before| before.sha256() == policy.sha256());
        if then == now && same {
            return Ok(policy);
        }
        self.progress.version_offset += then + 1 - now;
        self.reporter.warn(format!(
            "policy versions up to {then} were handed out before; this run goes on from iteration {} with version {}",
            self.progress.iteration,
            then + 1
        ));
        self.export(scaling)
    }

    /// Makes the current policy the one that actors use.
    fn announce(&mut self, state: &mut LoopState) -> Result<(), LearnerError> {
        let (began_ns, policy) = (now_ns(), &state.policy);
        let (version, sha256) = (policy.metadata().version, policy.sha256());
        if let Some(versions) = &mut self.versions {
            versions.before(version)?;
        }
        self.collector.policy_published(version, sha256);
        let bytes = policy.bytes().clone();
        self.link.publish_policy(PolicyUpdate { version, sha256, bytes, control: Control::Run })?;
        self.traces.handed_out(version, sha256, began_ns);
        state.seen.made(policy);
        Ok(())
    }

    /// To the run folder and, in the background, to the policy server.
    pub(super) fn publish(&self, policy: &PolicyFile) -> Result<(), LearnerError> {
        write_policy(&self.policy_path(), policy)?;
        if let Some(publisher) = &self.publisher {
            publisher.publish(policy.clone());
        }
        Ok(())
    }

    pub(super) fn policy_path(&self) -> PathBuf {
        self.run_dir.join("policy.onnx")
    }

    /// Passes on what the background task has said.
    pub(super) fn tell_published(&mut self, seen: &mut PoliciesSeen) {
        let notices = self.publisher.as_ref().map(Publisher::notices).unwrap_or_default();
        for notice in notices {
            match notice {
                Notice::Published(published) => {
                    seen.published(published.version);
                    self.reporter.event(&Event::Published(published));
                }
                Notice::Failed { version, reason, again } => {
                    self.reporter.metrics.publish_failures.inc();
                    let then = if again { "it is tried again" } else { "it is not tried again" };
                    self.reporter
                        .warn(format!("version {version} is not published ({then}): {reason}"));
                }
            }
        }
    }

    /// The whole state between two iterations. The actors' states go in where they belong together: in one
    /// process, in turns.
    pub(super) fn state(&self, state: &LoopState) -> Result<CheckpointState, LearnerError> {
        let in_turns = self.config.actors.max_lead == 0 && state.actors_wait;
        let actors = match self.fleet.as_ref().filter(|_| in_turns) {
            Some(fleet) => fleet.snapshots()?,
            None => Vec::new(),
        };
        let (adam_m, adam_v, adam_steps) = self.ppo.adam().state();
        let progress = &self.progress;
        Ok(CheckpointState {
            saved: Saved {
                format: FORMAT,
                run_id: self.identity.run_id.clone(),
                iteration: progress.iteration,
                version_offset: progress.version_offset,
                training_commit: self.identity.training_commit.clone(),
                steps_total: progress.steps_total,
                wall_s: progress.wall_s + self.began.elapsed().as_secs_f64(),
                config_hash: self.identity.config_hash.clone(),
                contract_hash: self.identity.contract.hash_hex(),
                policy_sha256: state.policy.sha256_hex(),
                adam_steps,
                minibatch_order: progress.order.clone(),
                episodes: progress.episodes.clone(),
                accounting: self.collector.accounting().clone(),
            },
            parameters: self.ppo.net().to_vec()?,
            adam_m,
            adam_v,
            learning_rate: self.ppo.learning_rate,
            moments: progress.moments.clone(),
            step_rewards: progress.step_rewards.clone(),
            returns: progress.returns.clone(),
            history: progress.history.clone(),
            actors,
        })
    }
}
