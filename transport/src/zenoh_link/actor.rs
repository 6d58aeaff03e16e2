//! The actor's end over zenoh: one thread opens the session, then pulls policies.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use zenoh::handlers::FifoChannel;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::{PieceRequest, access, down_key, policy_key, session, up_key};
use crate::actor_core::{ActorCore, RemoteActor, Uplink};
use crate::reliable::{PolicyHead, PolicyId, Status, UpHead};
use crate::{ActorLink, PolicyUpdate, TransportError, ZenohConfig, identity};

/// Pause between attempts to open the session while nobody answers, and after a piece that did not come.
const RETRY: Duration = Duration::from_millis(100);

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
        session: OnceLock::new(),
    });
    let puller = Puller {
        core: Arc::clone(&core),
        uplink: Arc::clone(&uplink),
        down_key: down_key(run_id, link),
        policy_key: policy_key(run_id),
        config: config.clone(),
    };
    let thread = core.spawn("caudata-pull", move || puller.run(&endpoints))?;
    Ok(Box::new(RemoteActor::start(core, uplink, vec![thread])?))
}

struct ZenohUplink {
    key: String,
    /// Empty until somebody has answered for the first time.
    session: OnceLock<Session>,
}

impl Uplink for ZenohUplink {
    /// Blocks while the connection is congested, which holds up this link's transmitting thread only.
    fn transmit(&self, head: &UpHead, frame: &Arc<[u8]>) -> bool {
        let Some(session) = self.session.get() else {
            return false;
        };
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
        if let Some(session) = self.session.take() {
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
}

impl Puller {
    fn run(&self, endpoints: &[String]) {
        let Some(session) = self.open_until_closed(endpoints) else {
            return;
        };
        let session = self.uplink.session.get_or_init(|| session);
        let mut have = None;
        while !self.core.crew.is_closing() {
            let heartbeat = self.core.limits.heartbeat();
            let Some(news) = self.core.wait_for_policy_news(have, heartbeat) else {
                continue;
            };
            match self.pull(session, news) {
                Ok(Some((got, update))) => {
                    have = Some(got);
                    self.core.policy.replace(update);
                }
                Ok(None) => std::thread::sleep(RETRY),
                Err(failure) => self.core.fail(failure),
            }
        }
    }

    fn open_until_closed(&self, endpoints: &[String]) -> Option<Session> {
        while !self.core.crew.is_closing() {
            match self.open(endpoints) {
                Ok(session) => return Some(session),
                Err(error) => tracing::debug!(%error, "no learner or router yet"),
            }
            std::thread::sleep(RETRY);
        }
        None
    }

    fn open(&self, endpoints: &[String]) -> Result<Session, TransportError> {
        let session = session::open_actor(endpoints, &self.config)?;
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

    fn ask(&self, session: &Session, request: &PieceRequest) -> Option<(PolicyHead, Vec<u8>)> {
        let replies = session
            .get(&self.policy_key)
            .payload(request.encode())
            .timeout(self.core.limits.peer_timeout())
            .with(FifoChannel::new(1))
            .wait()
            .ok()?;
        let reply = replies.recv().ok()?.into_result().ok()?;
        let message = reply.payload().to_bytes();
        let (head, piece) = PolicyHead::decode(&message)?;
        Some((head, piece.to_vec()))
    }
}
