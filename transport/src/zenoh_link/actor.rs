//! The actor's end over zenoh: one thread opens the session, opens another beside it when nobody answers, and
//! pulls policies.

use std::sync::Arc;
use std::time::{Duration, Instant};

use parking_lot::Mutex;
use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::keys::{PieceRequest, down_key, policy_key, up_key};
use super::reconnect::Reconnect;
use super::{access, session};
use crate::actor_core::{ActorCore, RemoteActor, Uplink};
use crate::crew::Failures;
use crate::reliable::{PolicyHead, PolicyId, Status, UpHead};
use crate::{ActorLink, PolicyUpdate, TransportError, ZenohConfig, identity};

/// Pause after a piece that did not come.
const PIECE_RETRY: Duration = Duration::from_millis(100);
/// Sessions that may be closing at once. Each takes zenoh some seconds at most; more of them than this means
/// that it does not let go.
const CLOSING_MAX: usize = 16;

/// An actor's end of `run_id`.
pub(crate) fn actor(
    config: &ZenohConfig,
    run_id: &str,
) -> Result<Box<dyn ActorLink>, TransportError> {
    let endpoints = session::actor_endpoints(config)?;
    // Now: what is wrong with the settings would otherwise look like a learner that is not there yet.
    access::check_endpoints(&endpoints, config.tls.as_ref())?;
    let link = identity::fresh();
    let core = ActorCore::new(link, &config.limits);
    let uplink = Arc::new(ZenohUplink {
        key: up_key(run_id, &format!("{link:x}")),
        session: Mutex::default(),
    });
    let puller = Puller {
        core: Arc::clone(&core),
        uplink: Arc::clone(&uplink),
        down_key: down_key(run_id, link),
        policy_key: policy_key(run_id),
        config: config.clone(),
        link,
    };
    let thread = core.spawn("caudata-pull", move || puller.run(&endpoints))?;
    Ok(Box::new(RemoteActor::start(core, uplink, vec![thread])?))
}

struct ZenohUplink {
    key: String,
    /// Empty until somebody has answered for the first time.
    session: Mutex<Option<Session>>,
}

impl Uplink for ZenohUplink {
    /// Blocks while the connection is congested, which holds up this link's transmitting thread only.
    fn transmit(&self, head: &UpHead, frame: &Arc<[u8]>) -> bool {
        let Some(session) = self.session.lock().clone() else { return false };
        let put = session
            .put(&self.key, &frame[..])
            .attachment(head.encode())
            .congestion_control(CongestionControl::Block)
            .wait();
        put.is_ok()
    }
}

impl Drop for ZenohUplink {
    fn drop(&mut self) {
        if let Some(session) = self.session.get_mut().take() {
            session::close(session);
        }
    }
}

/// Opens the session, then follows the policy that the learner speaks of.
struct Puller {
    core: Arc<ActorCore>,
    uplink: Arc<ZenohUplink>,
    down_key: String,
    policy_key: String,
    config: ZenohConfig,
    /// Number of this link.
    link: u64,
}

impl Puller {
    fn run(&self, endpoints: &[String]) {
        let Some(mut session) = self.open_until_closed(endpoints) else { return };
        *self.uplink.session.lock() = Some(session.clone());
        let closing = Arc::new(());
        let mut reconnect = Reconnect::new(&self.core.limits, self.link, Instant::now());
        let mut have = None;
        while !self.core.crew.is_closing() {
            reconnect.heard(self.core.outbox.lock().last_heard());
            if reconnect.is_due(Instant::now()) {
                if Arc::strong_count(&closing) > CLOSING_MAX {
                    self.core.fail("zenoh does not let go of its connections".to_owned());
                    return;
                }
                if let Some(anew) = self.open_beside(endpoints) {
                    let before = std::mem::replace(&mut session, anew);
                    *self.uplink.session.lock() = Some(session.clone());
                    session::close_in_background(before, Arc::clone(&closing));
                }
                reconnect.tried(Instant::now());
            }
            let heartbeat = self.core.limits.heartbeat();
            let Some(news) = self.core.wait_for_policy_news(have, heartbeat) else { continue };
            match self.pull(&session, news) {
                Ok(Some((got, update))) => {
                    have = Some(got);
                    self.core.policy.replace(update);
                }
                Ok(None) => std::thread::sleep(PIECE_RETRY),
                Err(failure) => self.core.fail(failure),
            }
        }
    }

    fn open_until_closed(&self, endpoints: &[String]) -> Option<Session> {
        let mut failures = Failures::default();
        while !self.core.crew.is_closing() {
            match self.open(endpoints) {
                Ok(session) => return Some(session),
                Err(error) => failures.pause(&self.core.crew, "no learner or router yet", &error),
            }
        }
        None
    }

    /// Another session beside the one that nobody answers on. zenoh reconnects by itself, but over QUIC only
    /// after the lease, and it has open faults there (eclipse-zenoh/zenoh#1876, #1886). The old session stays
    /// until this one is open: a learner that merely stands still answers on it when it goes on.
    fn open_beside(&self, endpoints: &[String]) -> Option<Session> {
        match self.open(endpoints) {
            Ok(session) => {
                tracing::info!("nobody answered; connected anew");
                Some(session)
            }
            Err(error) => {
                tracing::debug!(%error, "nobody answers, on a new connection neither");
                None
            }
        }
    }

    fn open(&self, endpoints: &[String]) -> Result<Session, TransportError> {
        let session = session::open("client", &[], endpoints, &self.config)?;
        let core = Arc::clone(&self.core);
        let on_answer = move |sample: Sample| {
            if let Some(status) = Status::decode(&sample.payload().to_bytes()) {
                core.on_status(&status);
            }
        };
        session
            .declare_subscriber(&self.down_key)
            .callback(on_answer)
            .background()
            .wait()
            .map_err(|e| TransportError::Backend(e.to_string()))?;
        Ok(session)
    }

    /// Pulls the wanted policy, or a newer one of the same learner. `None` when a piece does not
    /// come or another learner answers: try again. An error is for good.
    fn pull(
        &self,
        session: &Session,
        mut wanted: PolicyId,
    ) -> Result<Option<(PolicyId, PolicyUpdate)>, String> {
        let mut bytes = Vec::new();
        while !self.core.crew.is_closing() {
            let offset = bytes.len() as u64;
            let generation = wanted.generation;
            let Some((head, piece)) = self.ask(session, &PieceRequest { generation, offset })
            else {
                return Ok(None);
            };
            if head.epoch != wanted.epoch || head.generation < generation {
                return Ok(None);
            }
            let max = self.core.limits.max_policy_bytes;
            if head.total > max as u64 {
                let size = head.total;
                return Err(format!(
                    "the learner's policy of {size} bytes is over this actor's limit of {max} bytes"
                ));
            }
            if head.generation != generation {
                // A newer one has taken its place: begin again with that.
                wanted.generation = head.generation;
                bytes.clear();
            }
            if head.offset != bytes.len() as u64 || (piece.is_empty() && head.offset < head.total) {
                return Ok(None);
            }
            bytes.extend_from_slice(&piece);
            if bytes.len() as u64 == head.total {
                return Ok(Some((wanted, head.into_update(bytes))));
            }
        }
        Ok(None)
    }

    /// A piece of the policy; `None` when it does not come within the peer time-out, or the learner has
    /// fallen silent.
    fn ask(&self, session: &Session, request: &PieceRequest) -> Option<(PolicyHead, Vec<u8>)> {
        let limits = &self.core.limits;
        let replies = session
            .get(&self.policy_key)
            .payload(request.encode())
            .timeout(limits.peer_timeout())
            .with(FifoChannel::new(1))
            .wait()
            .ok()?;
        let reply = loop {
            match replies.recv_timeout(limits.heartbeat()).ok()? {
                Some(reply) => break reply.into_result().ok()?,
                None if super::reconnect::is_silent(
                    limits,
                    self.core.outbox.lock().last_heard(),
                ) =>
                {
                    return None;
                }
                None => {}
            }
        };
        let message = reply.payload().to_bytes();
        let (head, piece) = PolicyHead::decode(&message)?;
        Some((head, piece.to_vec()))
    }
}
