//! The actors of an in-process run: threads that the learner starts, saves and stops.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use caudata_actor::{
    ActorError, ActorMetrics, ActorReport, ActorSettings, ActorSnapshot, Retunes, SnapshotPort,
    actor_key, build_env, ledger_path,
};
use caudata_model::RobotModel;
use caudata_telemetry::StopFlag;
use caudata_telemetry::traces::Tracer;
use caudata_transport::InprocHub;

use super::settings::{TrainSettings, ledger_folder};
use crate::LearnerError;
use crate::batch::Accounting;

/// How long an actor between two chunks may take to save itself.
const SNAPSHOT_PATIENCE: Duration = Duration::from_secs(10);

/// The threads. Dropping it asks them to stop and waits for them.
pub(super) struct Fleet {
    actors: Vec<Slot>,
    stop: StopFlag,
}

struct Slot {
    id: u32,
    port: SnapshotPort,
    thread: Option<JoinHandle<Result<ActorReport, ActorError>>>,
}

impl Fleet {
    /// Starts the actors of `config`, each where its snapshot left off if there is one. Every start is a new
    /// incarnation, as `accounting` counts them.
    pub fn start(
        settings: &TrainSettings,
        model: &Arc<RobotModel>,
        hub: &InprocHub,
        accounting: &Accounting,
        snapshots: &[ActorSnapshot],
        tracer: &Tracer,
        retunes: &Retunes,
    ) -> Result<Self, LearnerError> {
        let config = &settings.config;
        let metrics = ActorMetrics::register(&settings.metrics);
        let ledgers = ledger_folder(&settings.run_dir);
        std::fs::create_dir_all(&ledgers).map_err(|error| LearnerError::write(&ledgers, error))?;
        let mut fleet = Self { actors: Vec::new(), stop: StopFlag::new() };
        for id in 0..config.actors.count {
            let incarnation = accounting.next_incarnation(id);
            let mut actor = ActorSettings::from_config(config, &settings.run_id, id, incarnation);
            // A learner in the same process is never gone while its actors live, however slow the machine is.
            actor.policy_timeout = Duration::MAX;
            // Kept here too: a run that is killed and goes on knows what was sent after its last checkpoint.
            actor.traces = tracer.clone();
            actor.retunes = retunes.clone();
            actor.ledger = Some(ledger_path(&ledgers, id, incarnation));
            let saved = snapshots.iter().find(|saved| saved.actor_id == id).cloned();
            let key = saved.as_ref().map_or(actor_key(id, incarnation), |saved| saved.actor_key);
            let failed = |source| LearnerError::Actor { id, source };
            let env = build_env(config, Arc::clone(model), key).map_err(failed)?;
            let link = hub.actor()?;
            let (port, stop, metrics) = (SnapshotPort::new(), fleet.stop.clone(), metrics.clone());
            let own_port = port.clone();
            let thread = std::thread::Builder::new()
                .name(format!("actor-{id}"))
                .spawn(move || {
                    let resume = saved.as_ref();
                    caudata_actor::run(&actor, env, link, &stop, &metrics, Some(&own_port), resume)
                })
                .map_err(LearnerError::Thread)?;
            fleet.actors.push(Slot { id, port, thread: Some(thread) });
        }
        Ok(fleet)
    }

    /// The error of an actor that has ended while the run goes on.
    pub fn check(&mut self) -> Result<(), LearnerError> {
        for slot in &mut self.actors {
            let ended = slot.thread.as_ref().is_some_and(JoinHandle::is_finished);
            if !ended {
                continue;
            }
            let id = slot.id;
            let reason = match slot.thread.take().map(JoinHandle::join) {
                Some(Ok(Err(source))) => return Err(LearnerError::Actor { id, source }),
                Some(Ok(Ok(_))) | None => "has ended before the run",
                Some(Err(_)) => "has died; its message is above",
            };
            let reason = reason.to_owned();
            return Err(LearnerError::ActorLost { id, reason });
        }
        Ok(())
    }

    /// The state of every actor. They belong together when all of them wait for the next policy.
    pub fn snapshots(&self) -> Result<Vec<ActorSnapshot>, LearnerError> {
        let take = |slot: &Slot| {
            let taken = slot.port.take(SNAPSHOT_PATIENCE);
            taken.map_err(|reason| LearnerError::ActorLost {
                id: slot.id,
                reason: format!("cannot be saved: {reason}"),
            })
        };
        self.actors.iter().map(take).collect()
    }

    /// Asks all to stop, for those that have not heard it from the learner.
    pub fn stop(&self) {
        self.stop.request("the run ends");
    }

    /// Whether all have ended.
    pub fn is_gone(&self) -> bool {
        self.actors.iter().all(|slot| slot.thread.as_ref().is_none_or(JoinHandle::is_finished))
    }
}

impl Drop for Fleet {
    fn drop(&mut self) {
        self.stop();
        for slot in &mut self.actors {
            if let Some(thread) = slot.thread.take() {
                // What an actor says at the very end of a run changes nothing any more.
                let _ = thread.join();
            }
        }
    }
}
