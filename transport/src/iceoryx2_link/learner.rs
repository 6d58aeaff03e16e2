//! The learner's end over iceoryx2: one thread reads, answers, hands out policies and cleans up after the
//! dead.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;

use super::run_dir::RunDir;
use super::services::{
    DataHead, Ipc, PolicyHeadBytes, Services, WAKE, backend, check_room_for_learner,
};
use crate::learner_core::{Downlink, LearnerCore, RemoteLearner};
use crate::reliable::PolicyHead;
use crate::{Iceoryx2Config, LearnerLink, Limits, TransportConfig, TransportError, identity};

/// How often dead actors' ports are looked for.
const CLEAN_UP_EVERY: Duration = Duration::from_secs(1);

/// The learner's end of `run_id`.
pub(crate) fn learner(
    config: &Iceoryx2Config,
    run_id: &str,
) -> Result<Box<dyn LearnerLink>, TransportError> {
    let limits = &config.limits;
    check_room_for_learner(limits)?;
    let run_dir = RunDir::acquire(config, run_id)?;
    let epoch = identity::fresh();
    let tag = format!("{:08x}", epoch as u32);
    let core = LearnerCore::new(epoch, limits);
    let ports = Ports::new(&run_dir, &tag, limits)?;
    let wake = ports.services.up.notifier_builder().create();
    let wake = wake.map_err(backend)?;
    // Posted before the thread starts: an error here leaves no thread behind. Actors that come at once find
    // the services, and are read from a moment later.
    run_dir.post(&tag, limits)?;
    let body = Arc::clone(&core);
    let thread = core.spawn("caudata-shm", move || ports.run_until_closed(&body))?;
    let downlink = Iceoryx2Downlink { wake, thread: Some(thread), _run_dir: run_dir };
    let actor_config = TransportConfig::Iceoryx2(config.clone());
    Ok(Box::new(RemoteLearner::new(core, downlink, actor_config)))
}

struct Iceoryx2Downlink {
    wake: Notifier<Ipc>,
    thread: Option<JoinHandle<()>>,
    /// Last: the files go when nothing of ours uses them.
    _run_dir: RunDir,
}

impl Downlink for Iceoryx2Downlink {
    fn wake(&self) {
        // A wake-up that fails costs `WAKE`.
        let _ = self.wake.notify();
    }

    fn close(&mut self) {
        self.wake();
        if let Some(thread) = self.thread.take() {
            // A thread that panicked has been reported by the crew.
            let _ = thread.join();
        }
    }
}

struct Ports {
    data: Subscriber<Ipc, [u8], DataHead>,
    status: Publisher<Ipc, [u8], ()>,
    policy: Publisher<Ipc, [u8], PolicyHeadBytes>,
    woken: Listener<Ipc>,
    wake_actors: Notifier<Ipc>,
    services: Services,
}

impl Ports {
    fn new(run_dir: &RunDir, tag: &str, limits: &Limits) -> Result<Self, TransportError> {
        let services = Services::create(&run_dir.paths, tag, limits)?;
        Ok(Self {
            data: services.data.subscriber_builder().create().map_err(backend)?,
            status: services.status_publisher(tag, limits)?,
            policy: services.policy_publisher(tag, limits)?,
            woken: services.up.listener_builder().create().map_err(backend)?,
            wake_actors: services.down.notifier_builder().create().map_err(backend)?,
            services,
        })
    }

    fn run_until_closed(&self, core: &LearnerCore) {
        let heartbeat = core.limits.heartbeat();
        let (mut beat, mut cleaned) = (Instant::now(), Instant::now());
        let mut published = 0;
        while !core.crew.is_closing() {
            let rest = heartbeat.saturating_sub(beat.elapsed()).min(WAKE);
            // Interrupted or not: what counts is what is there now.
            let _ = self.woken.timed_wait(|_| (), rest);
            self.read(core);
            let due = beat.elapsed() >= heartbeat;
            if due {
                beat = Instant::now();
            }
            let news = self.publish(core, &mut published);
            if due || news || core.owes_answers() {
                self.answer(core);
                let _ = self.wake_actors.notify();
            }
            if cleaned.elapsed() >= CLEAN_UP_EVERY {
                cleaned = Instant::now();
                let state = self.services.node.try_cleanup_dead_nodes();
                if state.cleanups + state.failed_cleanups > 0 {
                    tracing::debug!(?state, "cleaned up after dead actors");
                }
            }
        }
    }

    /// Takes over everything that has arrived. A frame is whole once it is here: a writer that dies before
    /// has not handed it over. It is copied before it is looked at, so nothing can change under the check.
    fn read(&self, core: &LearnerCore) {
        loop {
            match self.data.receive() {
                Ok(Some(sample)) => {
                    let head = *sample.user_header();
                    core.on_message(&head, sample.payload().to_vec());
                }
                Ok(None) => return,
                Err(error) => {
                    tracing::debug!(?error, "receiving from shared memory");
                    return;
                }
            }
        }
    }

    /// Hands out the newest policy once, and to late joiners. True when something was handed out.
    fn publish(&self, core: &LearnerCore, published: &mut u64) -> bool {
        let Some((generation, update)) = core.policy.newest() else { return false };
        if generation == *published {
            // Late joiners get the newest from the history when the connections are looked after.
            if let Err(error) = self.policy.update_connections() {
                tracing::debug!(?error, "connecting late actors");
            }
            return false;
        }
        let Ok(mut sample) = self.policy.loan_slice_uninit(update.bytes.len()) else {
            // Stopped actors hold every other sample: again at the next turn.
            return false;
        };
        let head = PolicyHead::of(&update, core.epoch, generation, 0).encode();
        let header = sample.user_header_mut().as_flattened_mut();
        header.copy_from_slice(&head);
        match sample.write_from_slice(&update.bytes).send() {
            Ok(_) => *published = generation,
            Err(error) => tracing::debug!(?error, "publishing a policy"),
        }
        true
    }

    /// Publishes where every actor stands: one table, so that only the newest matters.
    fn answer(&self, core: &LearnerCore) {
        let mut table = Vec::new();
        for status in core.answers(true) {
            table.extend_from_slice(&status.encode());
        }
        let Ok(sample) = self.status.loan_slice_uninit(table.len()) else { return };
        if let Err(error) = sample.write_from_slice(&table).send() {
            tracing::debug!(?error, "answering actors");
        }
    }
}
