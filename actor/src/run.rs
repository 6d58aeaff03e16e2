//! The loop of one actor.

use std::time::{Duration, Instant};

use caudata_env::VecEnv;
use caudata_proto::{ActorBye, ActorHello, Envelope, RolloutChunk, encode};
use caudata_telemetry::StopFlag;
use caudata_telemetry::spans::{self, Laps, Part};
use caudata_transport::{ActorLink, Control, SendError, Value};

use crate::policy::LoadedPolicy;
use crate::quota::Quota;
use crate::trace::SentChunk;
use crate::{ActorError, ActorMetrics, ActorSettings, ActorSnapshot, Ledger, SnapshotPort, chunk};

/// Longest single wait on the link. Between two waits the actor looks whether it shall stop or save itself.
const WAIT_SLICE: Duration = Duration::from_millis(20);

/// What an actor did.
#[derive(Clone, Debug)]
pub struct ActorReport {
    /// Chunks that the link took.
    pub sent: u64,
    /// Environment steps in them.
    pub steps: u64,
    /// Why it ended.
    pub reason: String,
}

/// Runs one actor until the learner says stop ([`Control::Stop`]), `stop` is raised, or something fails.
///
/// However it ends, it says goodbye with its count of chunks and waits, at most `flush_timeout`, until the
/// learner has everything. `snapshots` lets a learner in the same process save the actor; `resume` goes on
/// from such a state, with an `env` that was made with its `actor_key`.
///
/// # Errors
/// [`ActorError`]; the learner has been told before it is returned, if it could be.
pub fn run(
    settings: &ActorSettings,
    env: VecEnv,
    link: Box<dyn ActorLink>,
    stop: &StopFlag,
    metrics: &ActorMetrics,
    snapshots: Option<&SnapshotPort>,
    resume: Option<&ActorSnapshot>,
) -> Result<ActorReport, ActorError> {
    let span =
        tracing::info_span!("actor", id = settings.actor_id, incarnation = settings.incarnation);
    let _in_span = span.enter();
    let ledger = settings.ledger.as_deref().map(Ledger::create).transpose();
    let ledger = ledger.map_err(|source| ledger_error(settings, source))?;
    let quota = Quota::new(settings.chunks_per_version, settings.max_lead);
    let mut actor = Actor {
        settings,
        env,
        link,
        stop,
        metrics,
        snapshots,
        ledger,
        quota,
        actor_key: crate::actor_key(settings.actor_id, settings.incarnation),
        policy: None,
        spare: RolloutChunk::default(),
        sent: 0,
        greeted: false,
    };
    if let Some(task) = settings.retunes.under(0) {
        actor.env.retune(&task);
    }
    let result = match resume {
        None => actor.env.reset_all().map_err(ActorError::from),
        Some(saved) => actor.restore(saved),
    };
    let result = result.and_then(|()| actor.collect_until_stopped());
    if let Some(port) = snapshots {
        port.close();
    }
    let reason = match &result {
        Ok(reason) => reason.clone(),
        Err(error) => error.to_string(),
    };
    actor.say_goodbye(&reason);
    let steps = actor.sent * (settings.chunk_steps * actor.env.lanes()) as u64;
    tracing::info!(sent = actor.sent, steps, reason, "the actor ends");
    result.map(|reason| ActorReport { sent: actor.sent, steps, reason })
}

struct Actor<'a> {
    settings: &'a ActorSettings,
    env: VecEnv,
    link: Box<dyn ActorLink>,
    stop: &'a StopFlag,
    metrics: &'a ActorMetrics,
    snapshots: Option<&'a SnapshotPort>,
    ledger: Option<Ledger>,
    quota: Quota,
    actor_key: u64,
    policy: Option<LoadedPolicy>,
    spare: RolloutChunk,
    /// Chunks that the link took; also the sequence number of the next one.
    sent: u64,
    /// Whether the learner that is there now has had our hello.
    greeted: bool,
}

/// A chunk on its way to the learner.
enum Packed {
    /// To another process.
    Frame(Vec<u8>),
    /// Within this one; `None` once it has been taken.
    Value(Option<Value>),
}

impl Packed {
    fn bytes(&self) -> usize {
        match self {
            Self::Frame(frame) => frame.len(),
            Self::Value(value) => value.as_ref().map_or(0, |value| value.bytes),
        }
    }

    fn send(&mut self, link: &mut dyn ActorLink) -> Result<(), SendError> {
        match self {
            Self::Frame(frame) => link.send(frame, WAIT_SLICE),
            Self::Value(chunk) => match chunk.take() {
                None => Ok(()),
                Some(value) => link.send_value(value, WAIT_SLICE).map_err(|(error, value)| {
                    *chunk = Some(value);
                    error
                }),
            },
        }
    }
}

/// How an attempt to hand something over ended.
enum Handed {
    Taken,
    Stopping,
}

impl Actor<'_> {
    /// Collects and sends; returns why it stopped.
    fn collect_until_stopped(&mut self) -> Result<String, ActorError> {
        // Greeting early lets the learner know whom to expect; without a learner it is made up for later.
        let _ = self.greet(WAIT_SLICE);
        loop {
            if let Some(reason) = self.stop_reason() {
                return Ok(reason);
            }
            // In lockstep a newer policy waits until the quotas of the older one are collected.
            if !self.settings.lockstep {
                self.take_policy(Duration::ZERO)?;
            }
            if !self.quota.may_collect() {
                self.wait_for_policy()?;
                continue;
            }
            let Some(policy) = &mut self.policy else { continue };
            let (link, stop) = (&self.link, self.stop);
            let collected = chunk::collect(
                self.settings,
                &mut self.env,
                policy,
                self.sent,
                &mut self.spare,
                self.metrics,
                &|| stop.is_set() || link.stop_requested(),
            )?;
            let Some((chunk, trace)) = collected else { continue };
            self.quota.chunk_collected();
            let (sequence, policy_version) = (chunk.sequence, chunk.policy_version);
            let bytes = self.send_chunk(chunk)?;
            if let Some(trace) = trace.filter(|_| self.sent > sequence) {
                let chunk = SentChunk {
                    actor_id: self.settings.actor_id,
                    incarnation: self.settings.incarnation,
                    sequence,
                    policy_version,
                    steps: self.settings.chunk_steps,
                    lanes: self.env.lanes(),
                    bytes,
                };
                trace.sent(&self.settings.traces, &chunk);
            }
        }
    }

    fn stop_reason(&self) -> Option<String> {
        if self.link.stop_requested() {
            return Some("the learner said stop".into());
        }
        self.stop.reason()
    }

    /// Takes the newest policy if one comes within `timeout`.
    fn take_policy(&mut self, timeout: Duration) -> Result<bool, ActorError> {
        let Some(update) = self.link.next_policy(timeout)? else { return Ok(false) };
        if update.control == Control::Stop {
            return Ok(true);
        }
        let started = Instant::now();
        let (contract, mirror) = (self.env.contract(), self.env.mirror());
        let policy = LoadedPolicy::load(&update, contract, mirror, self.policy.take())?;
        let took = started.elapsed();
        spans::add(Part::Loading, took);
        self.metrics.policy_seconds.inc_by(took.as_secs_f64());
        self.quota.policy_arrived(policy.version);
        // Whatever grows with training follows the policy, so that it depends on nothing else.
        self.env.set_progress(policy.env_steps);
        if let Some(task) = self.settings.retunes.under(policy.version) {
            self.env.retune(&task);
        }
        self.metrics.policy_version.set(i64::try_from(policy.version).unwrap_or(i64::MAX));
        tracing::debug!(version = policy.version, "policy");
        self.policy = Some(policy);
        Ok(true)
    }

    fn wait_for_policy(&mut self) -> Result<(), ActorError> {
        let started = Instant::now();
        let result = self.wait_for_policy_since(started);
        self.metrics.wait_seconds.inc_by(started.elapsed().as_secs_f64());
        result
    }

    fn wait_for_policy_since(&mut self, started: Instant) -> Result<(), ActorError> {
        loop {
            self.answer_snapshot();
            if self.stop_reason().is_some() || self.take_policy(WAIT_SLICE)? {
                return Ok(());
            }
            self.still_patient("no new policy", started)?;
        }
    }

    fn still_patient(&self, what: &'static str, started: Instant) -> Result<(), ActorError> {
        let waited = started.elapsed();
        if waited > self.settings.policy_timeout {
            return Err(ActorError::Starved { what, waited_s: waited.as_secs_f64() });
        }
        Ok(())
    }

    /// Hands a chunk over, however long the learner is behind, until asked to stop; answers its size.
    fn send_chunk(&mut self, chunk: RolloutChunk) -> Result<usize, ActorError> {
        let started = Instant::now();
        let chunk = self.packed(chunk);
        let bytes = chunk.bytes();
        // Written before: a process killed in between has counted one chunk too many, which shows as lost.
        self.write_ledger(self.sent + 1)?;
        let result = self.hand_over(chunk, started);
        self.metrics.send_seconds.inc_by(started.elapsed().as_secs_f64());
        match result? {
            Handed::Taken => {
                self.sent += 1;
                self.metrics.chunks.inc();
                self.metrics.bytes.inc_by(bytes as u64);
            }
            Handed::Stopping => self.write_ledger(self.sent)?,
        }
        Ok(bytes)
    }

    /// As the link takes it.
    fn packed(&mut self, chunk: RolloutChunk) -> Packed {
        if self.link.takes_values() {
            let bytes = chunk.memory_bytes();
            let content = Box::new(chunk);
            return Packed::Value(Some(Value { content, bytes }));
        }
        let mut laps = Laps::new();
        let envelope = Envelope::Chunk(Box::new(chunk));
        let frame = encode(&envelope);
        if let Envelope::Chunk(chunk) = envelope {
            self.spare = *chunk;
        }
        laps.lap(Part::Encoding);
        Packed::Frame(frame)
    }

    fn hand_over(&mut self, mut chunk: Packed, started: Instant) -> Result<Handed, ActorError> {
        loop {
            let attempt = match self.greeted {
                true => chunk.send(&mut *self.link).map(|()| true),
                false => self.greet(WAIT_SLICE).map(|()| false),
            };
            match attempt {
                Ok(true) => return Ok(Handed::Taken),
                Ok(false) => continue,
                Err(SendError::Full { .. }) => {}
                // It may be another learner that comes back, one that has not had our hello.
                Err(SendError::Disconnected { .. }) => self.greeted = false,
                Err(error) => return Err(ActorError::Send(error)),
            }
            self.metrics.retries.inc();
            if self.stop_reason().is_some() {
                return Ok(Handed::Stopping);
            }
            if !self.link.is_connected() {
                self.still_patient("no learner", started)?;
            }
        }
    }

    fn greet(&mut self, timeout: Duration) -> Result<(), SendError> {
        let hello = ActorHello {
            run_id: self.settings.run_id.clone(),
            actor_id: self.settings.actor_id,
            incarnation: self.settings.incarnation,
            lanes: self.env.lanes(),
            contract_hash: self.settings.world.seal(self.env.contract().hash()),
            build: self.settings.build.clone(),
        };
        self.link.send(&encode(&Envelope::Hello(hello)), timeout)?;
        self.greeted = true;
        Ok(())
    }

    /// The last frame, and the wait until everything is with the learner. Failure changes nothing: the
    /// learner counts what it has, and the ledger says what was sent.
    fn say_goodbye(&mut self, reason: &str) {
        let deadline = Instant::now() + self.settings.flush_timeout;
        let bye = ActorBye {
            run_id: self.settings.run_id.clone(),
            actor_id: self.settings.actor_id,
            incarnation: self.settings.incarnation,
            sent: self.sent,
            reason: one_line(reason),
        };
        let frame = encode(&Envelope::Bye(bye));
        let left = || deadline.saturating_duration_since(Instant::now());
        let farewell = self.link.send(&frame, left()).and_then(|()| self.link.flush(left()));
        if let Err(error) = farewell {
            tracing::warn!(%error, "the learner may not have had the goodbye");
        }
    }

    fn answer_snapshot(&self) {
        let Some(port) = self.snapshots else { return };
        port.answer(|| {
            Ok(ActorSnapshot {
                actor_id: self.settings.actor_id,
                actor_key: self.actor_key,
                policy_version: self.quota.newest(),
                credits: self.quota.credits,
                env: self.env.snapshot().map_err(|error| error.to_string())?,
            })
        });
    }

    fn restore(&mut self, saved: &ActorSnapshot) -> Result<(), ActorError> {
        if saved.actor_id != self.settings.actor_id {
            return Err(ActorError::Snapshot(format!(
                "it is of actor {}, this is actor {}",
                saved.actor_id, self.settings.actor_id
            )));
        }
        self.env.restore(&saved.env)?;
        self.actor_key = saved.actor_key;
        self.quota = self.quota.restored(saved.credits, saved.policy_version);
        Ok(())
    }

    fn write_ledger(&self, count: u64) -> Result<(), ActorError> {
        match &self.ledger {
            None => Ok(()),
            Some(ledger) => {
                ledger.write(count).map_err(|source| ledger_error(self.settings, source))
            }
        }
    }
}

fn ledger_error(settings: &ActorSettings, source: std::io::Error) -> ActorError {
    let path = settings.ledger.as_deref().map(|path| path.display().to_string());
    ActorError::Ledger { path: path.unwrap_or_default(), source }
}

/// At most 256 bytes without line breaks, as the wire format has it.
fn one_line(text: &str) -> String {
    const BYTES_MAX: usize = 256;
    let mut line: String = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let end = (0..=BYTES_MAX.min(line.len())).rev().find(|&at| line.is_char_boundary(at));
    line.truncate(end.unwrap_or(0));
    line
}

#[cfg(test)]
mod tests {
    use super::one_line;

    #[test]
    fn a_reason_becomes_one_short_line() {
        assert_eq!(one_line("a\nb"), "a b");
        // 'é' takes two bytes: 255 + 2 > 256, so it is left out whole.
        let long = format!("{}é", "x".repeat(255));
        assert_eq!(one_line(&long).len(), 255);
    }
}
