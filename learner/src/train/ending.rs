//! The end of a run: everything is saved, published, stopped and accounted for, and summed up in a last word.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use caudata_telemetry::progress::{Checkpoint, Event, Finished, MeanSe};
use caudata_transport::{Control, PolicyUpdate};

use super::collect::drain;
use super::run::{LoopState, Run};
use super::settings::{ledger_folder, torn_ledger};
use crate::LearnerError;
use crate::checkpoint::CheckpointState;
use crate::report::ReturnSums;

/// How long the last policy may take to reach the policy server.
const PUBLISH_PATIENCE: Duration = Duration::from_secs(10);
/// Iterations below which the first and the last tenth say nothing.
const TENTHS_MIN: usize = 20;

impl Run<'_> {
    /// Writes a checkpoint; its folder.
    pub(super) fn save(&mut self, checkpoint: &CheckpointState) -> Result<PathBuf, LearnerError> {
        let _span = tracing::info_span!("checkpoint").entered();
        let started = Instant::now();
        let files = checkpoint.to_files(self.ppo.net().layout()).map_err(LearnerError::setting)?;
        let folder = self.store.save(checkpoint.saved.iteration, &files)?;
        self.reporter.metrics.checkpoint.observe(started.elapsed().as_secs_f64());
        let (path, iteration) = (folder.display().to_string(), checkpoint.saved.iteration);
        self.reporter.event(&Event::Checkpoint(Checkpoint { path, iteration }));
        self.reporter.pictures(&self.progress.history, self.collector.accounting());
        Ok(folder)
    }

    /// Who asked to stop, or that somebody did.
    pub(super) fn stop_reason(&self) -> String {
        self.stop.reason().unwrap_or_else(|| "stopped".to_owned())
    }

    /// Saves, publishes the last policy, stops the actors, accounts for everything. Does all of it even where
    /// a part fails; answers the first failure. `healthy`: the loop ended as it should.
    pub(super) fn wind_down(
        &mut self,
        state: &mut LoopState,
        healthy: bool,
    ) -> Result<(), LearnerError> {
        let mut first_failure = Ok(());
        let mut note = |result: Result<(), LearnerError>| {
            if let Err(error) = result {
                tracing::error!(%error, "while winding down");
                if first_failure.is_ok() {
                    first_failure = Err(error);
                }
            }
        };
        let iteration = self.progress.iteration;
        if state.saved.as_ref().is_none_or(|(saved, _)| *saved != iteration)
            && iteration > state.first
        {
            // An actor that failed cannot be saved any more; the weights can.
            state.actors_wait &= healthy;
            let saved = self.state(state).and_then(|checkpoint| self.save(&checkpoint));
            note(saved.map(|folder| state.saved = Some((iteration, folder))));
        }
        self.refuse_late_changes();
        self.traces.complete();
        note(self.publish(&state.policy));
        let stop = PolicyUpdate {
            version: state.policy.metadata().version,
            sha256: state.policy.sha256(),
            bytes: state.policy.bytes().clone(),
            control: Control::Stop,
        };
        note(self.link.publish_policy(stop).map_err(LearnerError::from));
        let (link, fleet) = (self.link.as_mut(), self.fleet.as_ref());
        drain(&mut self.collector, link, fleet, &mut self.reporter, &self.traces);
        self.fleet = None;
        if let Some(versions) = &mut self.versions {
            note(versions.at_the_end(state.policy.metadata().version));
        }
        for ledger in caudata_actor::ledgers_in(&ledger_folder(&self.run_dir)) {
            let actor = (ledger.actor_id, ledger.incarnation);
            match ledger.sent {
                Some(sent) => self.collector.accounting_mut().ledger(actor, sent),
                None => self.reporter.warn(torn_ledger(actor)),
            }
        }
        if !self.collector.accounting().holds() {
            self.reporter
                .warn("the accounts of the chunks do not add up; see accounting.json".into());
        }
        self.reporter.pictures(&self.progress.history, self.collector.accounting());
        if self.publisher.as_ref().is_some_and(|publisher| !publisher.finish(PUBLISH_PATIENCE)) {
            self.reporter.warn("the policy server did not take the last policy in time".into());
        }
        self.tell_published(&mut state.seen);
        first_failure
    }

    /// The last word, said and answered.
    pub(super) fn finished(mut self, state: &LoopState, reason: String) -> Finished {
        let progress = &self.progress;
        let tenth = progress.step_rewards.len() / 10;
        let enough = progress.step_rewards.len() >= TENTHS_MIN;
        let rewards = &progress.step_rewards;
        let (early, late) =
            (&progress.returns[..tenth], &progress.returns[progress.returns.len() - tenth..]);
        let finished = Finished {
            reason,
            iteration: progress.iteration,
            steps_total: progress.steps_total,
            wall_s: self.began.elapsed().as_secs_f64(),
            policy_version: state.policy.metadata().version,
            policy_sha256: state.policy.sha256_hex(),
            policy_path: self.policy_path().display().to_string(),
            checkpoint_path: state
                .saved
                .as_ref()
                .map(|(_, folder)| folder.display().to_string())
                .unwrap_or_default(),
            first_tenth: enough.then(|| mean_se(&rewards[..tenth])),
            last_tenth: enough.then(|| mean_se(&rewards[rewards.len() - tenth..])),
            first_tenth_return: ReturnSums::total(early).mean().filter(|_| enough),
            last_tenth_return: ReturnSums::total(late).mean().filter(|_| enough),
            actors_policy: state.seen.best(),
            accounting: self.collector.accounting().summary(),
            actors: self.collector.accounting().per_actor(),
        };
        self.reporter.event(&Event::Finished(Box::new(finished.clone())));
        finished
    }
}

/// Mean and standard error of the mean (sample standard deviation over √n).
fn mean_se(values: &[f64]) -> MeanSe {
    let n = values.len().max(1) as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
    let standard_error = (squares / (n - 1.0).max(1.0) / n).sqrt();
    MeanSe { mean, standard_error, n: values.len() as u64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_standard_error_by_hand() {
        // {1, 2, 6}: mean 3, squares 4 + 1 + 9 = 14, variance 7, standard error √(7/3).
        let found = mean_se(&[1.0, 2.0, 6.0]);
        assert_eq!((found.mean, found.n), (3.0, 3));
        assert!((found.standard_error - (7.0_f64 / 3.0).sqrt()).abs() < 1e-12);
    }
}
