//! The actor's end over iceoryx2: one thread joins the learner's services, reads answers and policies, and
//! joins anew when another learner has taken the run over.

use std::sync::Arc;
use std::time::Instant;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use parking_lot::Mutex;

use super::run_dir::{Note, RunPaths, sweep_segments};
use super::services::{
    DataHead, Ipc, PolicyHeadBytes, Services, WAKE, backend, check_room_for_actor,
};
use crate::actor_core::{ActorCore, RemoteActor, Uplink};
use crate::crew::Failures;
use crate::reliable::{PolicyHead, PolicyId, Status, UpHead};
use crate::{ActorLink, Iceoryx2Config, Limits, TransportError, identity};

/// An actor's end of `run_id`.
pub(crate) fn actor(
    config: &Iceoryx2Config,
    run_id: &str,
) -> Result<Box<dyn ActorLink>, TransportError> {
    let paths = RunPaths::new(config, run_id)?;
    // Found now rather than by a thread later: foreign files, and a file system that is too small.
    paths.note()?;
    check_room_for_actor(&config.limits)?;
    let link = identity::fresh();
    let core = ActorCore::new(link, &config.limits);
    let uplink = Arc::new(ShmUplink::default());
    let reader = Reader { core: Arc::clone(&core), uplink: Arc::clone(&uplink), paths, link };
    let thread = core.spawn("caudata-shm", move || reader.run_until_closed())?;
    Ok(Box::new(RemoteActor::start(core, uplink, vec![thread])?))
}

/// The ports of one learner process that this actor has joined.
struct Session {
    tag: String,
    paths: RunPaths,
    data: Publisher<Ipc, [u8], DataHead>,
    status: Subscriber<Ipc, [u8], ()>,
    policy: Subscriber<Ipc, [u8], PolicyHeadBytes>,
    woken: Listener<Ipc>,
    wake_learner: Notifier<Ipc>,
    _services: Services,
    /// Last: sweeps when everything else is gone.
    _sweeper: Sweeper,
}

impl Session {
    fn join(paths: &RunPaths, tag: &str, limits: &Limits) -> Result<Self, TransportError> {
        let sweeper = Sweeper { tag: tag.to_owned(), paths: paths.clone() };
        let services = Services::open(paths, tag)?;
        Ok(Self {
            tag: tag.to_owned(),
            paths: paths.clone(),
            data: services.data_publisher(tag, limits)?,
            status: services.status.subscriber_builder().create().map_err(backend)?,
            policy: services.policy.subscriber_builder().create().map_err(backend)?,
            woken: services.down.listener_builder().create().map_err(backend)?,
            wake_learner: services.up.notifier_builder().create().map_err(backend)?,
            _services: services,
            _sweeper: sweeper,
        })
    }

    /// Whether the learner that made these services is still the one in charge.
    fn is_current(&self) -> bool {
        matches!(self.paths.note(), Ok(Some(note)) if note.tag == self.tag)
    }
}

/// Removes what leaving may have put where the learner has already tidied up.
struct Sweeper {
    tag: String,
    paths: RunPaths,
}

impl Drop for Sweeper {
    fn drop(&mut self) {
        if let Ok(Some(note)) = self.paths.note()
            && note.tag == self.tag
        {
            return;
        }
        let _ = std::fs::remove_dir_all(self.paths.tag_dir(&self.tag));
        if let Err(error) = sweep_segments(&self.tag) {
            tracing::debug!(%error, "sweeping up after a learner that has gone");
        }
    }
}

#[derive(Default)]
struct ShmUplink {
    session: Mutex<Option<Arc<Session>>>,
}

impl Uplink for ShmUplink {
    /// One copy into shared memory. Not handed on when the learner's buffer is full or there is no learner.
    fn transmit(&self, head: &UpHead, frame: &Arc<[u8]>) -> bool {
        let Some(session) = self.session.lock().clone() else { return false };
        let Ok(mut sample) = session.data.loan_slice_uninit(frame.len()) else { return false };
        *sample.user_header_mut() = head.encode();
        let delivered = sample.write_from_slice(frame).send();
        // A wake-up that fails costs `WAKE`.
        let _ = session.wake_learner.notify();
        delivered.is_ok_and(|recipients| recipients > 0)
    }
}

struct Reader {
    core: Arc<ActorCore>,
    uplink: Arc<ShmUplink>,
    paths: RunPaths,
    link: u64,
}

impl Reader {
    fn run_until_closed(&self) {
        let mut failures = Failures::default();
        while !self.core.crew.is_closing() {
            match self.join() {
                Ok(Some(session)) => {
                    failures = Failures::default();
                    *self.uplink.session.lock() = Some(Arc::clone(&session));
                    self.follow(&session);
                    if !self.core.crew.is_closing() {
                        *self.uplink.session.lock() = None;
                    }
                }
                Ok(None) => std::thread::sleep(WAKE),
                // Will not get better by waiting.
                Err(error @ (TransportError::NoSpace { .. } | TransportError::Config(_))) => {
                    self.core.fail(error.to_string());
                    return;
                }
                // The services may be half made, or all ports taken.
                Err(error) => {
                    failures.pause(&self.core.crew, "cannot join the learner's services", &error);
                }
            }
        }
    }

    fn join(&self) -> Result<Option<Arc<Session>>, TransportError> {
        let Some(Note { tag, limits, .. }) = self.paths.note()? else { return Ok(None) };
        let ours = &self.core.limits;
        if limits != *ours {
            return Err(TransportError::Config(format!(
                "this actor's limits {ours:?} differ from the learner's {limits:?}"
            )));
        }
        Ok(Some(Arc::new(Session::join(&self.paths, &tag, ours)?)))
    }

    /// Reads until the link closes or another learner is in charge.
    fn follow(&self, session: &Session) {
        let heartbeat = self.core.limits.heartbeat();
        let mut have = None;
        let mut looked = Instant::now();
        while !self.core.crew.is_closing() {
            // Interrupted or not: what counts is what is there now.
            let _ = session.woken.timed_wait(|_| (), WAKE);
            self.read_answers(session);
            self.read_policies(session, &mut have);
            if looked.elapsed() >= heartbeat {
                looked = Instant::now();
                if !session.is_current() {
                    return;
                }
            }
        }
    }

    fn read_answers(&self, session: &Session) {
        while let Ok(Some(table)) = session.status.receive() {
            let mine = table
                .payload()
                .chunks_exact(Status::LEN)
                .filter_map(Status::decode)
                .find(|status| status.link == self.link);
            if let Some(status) = mine {
                self.core.on_status(&status);
            }
        }
    }

    fn read_policies(&self, session: &Session, have: &mut Option<PolicyId>) {
        while let Ok(Some(sample)) = session.policy.receive() {
            let head = *sample.user_header();
            let bytes = sample.payload().to_vec();
            drop(sample);
            let Some((head, _)) = PolicyHead::decode(head.as_flattened()) else { continue };
            let id = PolicyId { epoch: head.epoch, generation: head.generation };
            if id.is_news_to(*have) && head.total == bytes.len() as u64 {
                *have = Some(id);
                self.core.policy.replace(head.into_update(bytes));
            }
        }
    }
}
