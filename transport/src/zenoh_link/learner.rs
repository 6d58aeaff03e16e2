//! The learner's end over zenoh: arrivals on zenoh's threads, one thread for answers, one for policy pieces.

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use parking_lot::{Condvar, Mutex};
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, Query, QueryTarget, Queryable};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::keys::{PIECE_BYTES, PieceRequest, down_key, policy_key, up_key};
use super::session;
use crate::learner_core::{Downlink, LearnerCore, RemoteLearner};
use crate::reliable::{PolicyHead, Status};
use crate::{LearnerLink, TransportConfig, TransportError, ZenohConfig, identity};

/// How long another learner of the run may take to answer behind a router. One that was killed answers
/// nothing until the router has noticed.
const ANSWER_WAIT: Duration = Duration::from_secs(3);
/// How often the learner that stays asks whether one that started in the same moment has given way.
const GIVE_WAY_TRIES: u32 = 10;
/// Pause between two of these questions.
const GIVE_WAY_PAUSE: Duration = Duration::from_millis(100);
/// How often the policy thread looks whether the link is closing.
const POLICY_TICK: Duration = Duration::from_millis(50);

/// The learner's end of `run_id`.
pub(crate) fn learner(
    config: &ZenohConfig,
    run_id: &str,
) -> Result<Box<dyn LearnerLink>, TransportError> {
    session::aside(|| open(config, run_id))?
}

fn open(config: &ZenohConfig, run_id: &str) -> Result<Box<dyn LearnerLink>, TransportError> {
    let (session, connect) = session::open_learner(config)?;
    let core = LearnerCore::new(identity::fresh(), &config.limits);
    let mut downlink =
        ZenohDownlink { owed: Arc::default(), threads: Vec::new(), session: Some(session.clone()) };
    let routed = !config.connect.is_empty();
    if let Err(error) = downlink.start(&session, &core, run_id, routed) {
        // Whatever has started already ends.
        core.crew.close();
        downlink.close();
        return Err(error);
    }
    let actor_config = TransportConfig::Zenoh(ZenohConfig {
        limits: config.limits.clone(),
        listen: Vec::new(),
        connect,
        // An actor shows a certificate of its own.
        tls: None,
    });
    Ok(Box::new(RemoteLearner::new(core, downlink, actor_config)))
}

fn backend(error: zenoh::Error) -> TransportError {
    TransportError::Backend(error.to_string())
}

fn already_running(run_id: &str) -> TransportError {
    TransportError::AlreadyRunning {
        run_id: run_id.to_owned(),
        detail: "it answers through the router".to_owned(),
    }
}

/// After this learner has declared itself: no other one has done so in the same moment, or the others give
/// way.
///
/// The router takes the messages of a connection in their order. With the end of the answers to a question it
/// has therefore also the declaration that was sent before: of two learners at least one sees the other, and
/// a learner that starts from now on finds this one. Of two that see each other the one with the higher
/// number gives way.
fn stay_alone(session: &Session, run_id: &str, epoch: u64) -> Result<(), TransportError> {
    for _ in 0..GIVE_WAY_TRIES {
        let others = others(session, run_id, epoch)?;
        match others.iter().min() {
            None => return Ok(()),
            Some(&lowest) if lowest < epoch => break,
            Some(_) => std::thread::sleep(GIVE_WAY_PAUSE),
        }
    }
    Err(already_running(run_id))
}

/// The numbers of other learners of the run that answer behind the router.
fn others(session: &Session, run_id: &str, epoch: u64) -> Result<Vec<u64>, TransportError> {
    let request = PieceRequest { generation: 0, offset: 0 };
    let replies = session
        .get(policy_key(run_id))
        .payload(request.encode())
        .target(QueryTarget::All)
        // All answers have one key.
        .consolidation(ConsolidationMode::None)
        .timeout(ANSWER_WAIT)
        .wait()
        .map_err(backend)?;
    let mut epochs = Vec::new();
    while let Ok(reply) = replies.recv() {
        // A time-out is an error among the replies.
        let Ok(sample) = reply.into_result() else { continue };
        let head = PolicyHead::decode(&sample.payload().to_bytes()).map(|(head, _)| head.epoch);
        epochs.extend(head.filter(|&other| other != epoch));
    }
    Ok(epochs)
}

/// Wakes the answering thread.
#[derive(Default)]
struct Owed {
    flag: Mutex<bool>,
    raised: Condvar,
}

impl Owed {
    fn raise(&self) {
        *self.flag.lock() = true;
        self.raised.notify_one();
    }

    fn wait(&self, time: Duration) {
        let mut flag = self.flag.lock();
        self.raised.wait_while_for(&mut flag, |raised| !*raised, time);
        *flag = false;
    }
}

struct ZenohDownlink {
    owed: Arc<Owed>,
    threads: Vec<JoinHandle<()>>,
    /// Empty once closed.
    session: Option<Session>,
}

impl ZenohDownlink {
    fn start(
        &mut self,
        session: &Session,
        core: &Arc<LearnerCore>,
        run_id: &str,
        routed: bool,
    ) -> Result<(), TransportError> {
        // Without a router the port itself tells that there is no other learner.
        if routed && !others(session, run_id, core.epoch)?.is_empty() {
            return Err(already_running(run_id));
        }
        // Each actor asks one piece at a time; what does not fit is dropped and asked again.
        let queryable = session
            .declare_queryable(policy_key(run_id))
            .complete(true)
            .with(RingChannel::new(2 * core.limits.max_actors))
            .wait()
            .map_err(backend)?;
        let pieces = Arc::clone(core);
        let server = move || serve_pieces_until_closed(&pieces, &queryable);
        self.threads.push(core.spawn("caudata-policy", server)?);
        if routed {
            stay_alone(session, run_id, core.epoch)?;
        }
        let (arrivals, owed) = (Arc::clone(core), Arc::clone(&self.owed));
        let on_message = move |sample: Sample| {
            let head = sample.attachment().map(|head| head.to_bytes());
            let frame = sample.payload().to_bytes().into_owned();
            arrivals.on_message(&head.unwrap_or_default(), frame);
            owed.raise();
        };
        session
            .declare_subscriber(up_key(run_id, "*"))
            .callback(on_message)
            .background()
            .wait()
            .map_err(backend)?;
        let answers = Arc::clone(core);
        let (owed, session) = (Arc::clone(&self.owed), session.clone());
        let run_id = run_id.to_owned();
        let answerer = move || answer_until_closed(&answers, &owed, &session, &run_id);
        self.threads.push(core.spawn("caudata-answer", answerer)?);
        Ok(())
    }
}

impl Downlink for ZenohDownlink {
    fn wake(&self) {
        self.owed.raise();
    }

    fn close(&mut self) {
        self.owed.raise();
        for thread in self.threads.drain(..) {
            // A thread that panicked has been reported by the crew.
            let _ = thread.join();
        }
        if let Some(session) = self.session.take() {
            session::close(session);
        }
    }
}

fn answer_until_closed(core: &LearnerCore, owed: &Owed, session: &Session, run_id: &str) {
    let heartbeat = core.limits.heartbeat();
    let mut beat = Instant::now();
    while !core.crew.is_closing() {
        owed.wait(heartbeat.saturating_sub(beat.elapsed()));
        let everyone = beat.elapsed() >= heartbeat;
        if everyone {
            beat = Instant::now();
        }
        for status in core.answers(everyone) {
            answer(session, run_id, &status);
        }
    }
}

/// Never waits for a congested actor: what is dropped is said again at the next heartbeat.
fn answer(session: &Session, run_id: &str, status: &Status) {
    let put = session
        .put(down_key(run_id, status.link), status.encode())
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::InteractiveHigh)
        .express(true)
        .wait();
    if let Err(error) = put {
        tracing::debug!(%error, link = status.link, "answering an actor");
    }
}

fn serve_pieces_until_closed(core: &LearnerCore, queryable: &Queryable<RingChannelHandler<Query>>) {
    while !core.crew.is_closing() {
        let Ok(Some(query)) = queryable.recv_timeout(POLICY_TICK) else { continue };
        let piece = piece(core, &query);
        if let Some(piece) = piece
            && let Err(error) = query.reply(query.key_expr(), piece).wait()
        {
            tracing::debug!(%error, "sending a piece of the policy");
        }
    }
}

/// The piece asked for, or the first piece of the newest policy when something older was asked for. A learner
/// that has no policy yet still answers, with an empty head, so that another one finds it.
fn piece(core: &LearnerCore, query: &Query) -> Option<Vec<u8>> {
    let request = PieceRequest::decode(&query.payload()?.to_bytes())?;
    let (generation, update) = core.policy.newest().unwrap_or_else(|| (0, nothing_yet()));
    let offset =
        if request.generation == generation { usize::try_from(request.offset).ok()? } else { 0 };
    let bytes = update.bytes.get(offset..)?;
    let bytes = &bytes[..bytes.len().min(PIECE_BYTES)];
    let head = PolicyHead::of(&update, core.epoch, generation, offset);
    Some([&head.encode()[..], bytes].concat())
}

fn nothing_yet() -> crate::PolicyUpdate {
    crate::PolicyUpdate {
        version: 0,
        sha256: [0; 32],
        bytes: Arc::default(),
        control: crate::Control::Run,
    }
}
