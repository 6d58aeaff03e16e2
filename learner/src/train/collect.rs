//! Waiting for a batch: the clock and the link around the [`Collector`].

use std::time::{Duration, Instant};

use caudata_config::LearnerConfig;
use caudata_proto::RolloutChunk;
use caudata_telemetry::StopFlag;
use caudata_telemetry::now_ns;
use caudata_telemetry::progress::{Event, Warning};
use caudata_telemetry::spans::{Laps, Part};
use caudata_transport::{Frame, LearnerLink};

use super::fleet::Fleet;
use super::report::Reporter;
use super::traces::Traces;
use crate::LearnerError;
use crate::batch::{Collector, Outcome};

/// Longest single wait on the link; between two the clock and the stop flag are looked at.
const SLICE: Duration = Duration::from_millis(50);
/// How long an iteration may still take once the run is asked to stop.
const STOP_PATIENCE: Duration = Duration::from_secs(15);
/// How long actors have to say goodbye.
const BYE_PATIENCE: Duration = Duration::from_secs(10);

/// How waiting for a batch ended.
pub(super) enum Collected {
    Batch(Vec<RolloutChunk>),
    /// Asked to stop, and no batch came in time.
    Stopped,
}

/// Waits for a full batch, or what there is of it after the time-out.
pub(super) fn collect(
    collector: &mut Collector,
    link: &mut dyn LearnerLink,
    mut fleet: Option<&mut Fleet>,
    config: &LearnerConfig,
    stop: &StopFlag,
    reporter: &mut Reporter,
    traces: &Traces,
) -> Result<Collected, LearnerError> {
    let started = Instant::now();
    let timeout = Duration::from_secs_f64(config.batch_timeout_s);
    let starved = Duration::from_secs_f64(config.starve_timeout_s);
    let mut stopping: Option<Instant> = None;
    loop {
        reporter.pulse.beat();
        if collector.is_ready() {
            return Ok(Collected::Batch(collector.take()));
        }
        if started.elapsed() >= timeout && collector.has_enough() {
            tracing::warn!(chunks = collector.waiting(), "going on with part of a batch");
            return Ok(Collected::Batch(collector.take()));
        }
        if started.elapsed() >= starved {
            let (waited_s, chunks) = (started.elapsed().as_secs_f64(), collector.waiting());
            return Err(LearnerError::Starved { waited_s, chunks });
        }
        if stop.is_set() && stopping.get_or_insert_with(Instant::now).elapsed() >= STOP_PATIENCE {
            return Ok(Collected::Stopped);
        }
        if let Some(frame) = link.recv(SLICE)? {
            take_in(collector, frame, traces, reporter);
        } else if let Some(fleet) = fleet.as_deref_mut() {
            // Only when nothing is left to read: an actor's last frames come before its end.
            fleet.check()?;
        }
        reporter.metrics.waiting.set(collector.waiting() as i64);
        reporter.metrics.actors.set(collector.present() as i64);
    }
}

/// A frame of bytes, or a chunk of an actor in this process as it is.
fn take_in(collector: &mut Collector, frame: Frame, traces: &Traces, reporter: &mut Reporter) {
    let (began_ns, mut laps) = (now_ns(), Laps::new());
    let bytes = frame.bytes.len() + frame.value.as_ref().map_or(0, |value| value.bytes);
    let value = frame.value.map(|value| value.content.downcast::<RolloutChunk>());
    let (identity, outcome) = match value {
        Some(Ok(chunk)) => (Some(chunk.identity()), collector.offer_value(*chunk)),
        // What is no chunk is no frame either, and is refused as one without content.
        Some(Err(_)) => (None, collector.offer(&[])),
        None => (traces.identity(&frame.bytes), collector.offer(&frame.bytes)),
    };
    laps.lap(Part::Encoding);
    traces.received(identity, bytes, began_ns, word(&outcome));
    tell(&outcome, reporter);
}

/// Takes what still comes after the stop, until every actor has said goodbye or the time is up.
pub(super) fn drain(
    collector: &mut Collector,
    link: &mut dyn LearnerLink,
    fleet: Option<&Fleet>,
    reporter: &mut Reporter,
    traces: &Traces,
) {
    let deadline = Instant::now() + BYE_PATIENCE;
    collector.close();
    while Instant::now() < deadline {
        reporter.pulse.beat();
        match link.recv(SLICE) {
            Ok(Some(frame)) => take_in(collector, frame, traces, reporter),
            // Nothing waits: done when nobody is left to send.
            Ok(None) if collector.all_gone() || fleet.is_some_and(Fleet::is_gone) => return,
            Ok(None) => {}
            Err(error) => {
                tracing::warn!(%error, "the link failed while the actors left");
                return;
            }
        }
    }
    tracing::warn!(actors = collector.present(), "some actors did not say goodbye in time");
}

/// What became of a frame, in one word.
fn word(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Hello(_) => "hello",
        Outcome::Bye(_) => "bye",
        Outcome::Waiting(_) => "waiting",
        Outcome::Duplicate(_) => "duplicate",
        Outcome::Dropped(_, reason) => reason.name(),
        Outcome::Rejected(_, reason, _) => reason,
    }
}

fn tell(outcome: &Outcome, reporter: &mut Reporter) {
    match outcome {
        Outcome::Hello((actor, incarnation)) => {
            tracing::info!(actor, incarnation, "an actor is here");
            reporter.metrics.frame(word(outcome));
        }
        Outcome::Bye((actor, incarnation)) => {
            tracing::info!(actor, incarnation, "an actor left");
            reporter.metrics.frame(word(outcome));
        }
        Outcome::Waiting(_) => {
            reporter.metrics.frame(word(outcome));
        }
        Outcome::Duplicate((actor, incarnation)) => {
            let count = reporter.metrics.frame(word(outcome));
            if count.is_power_of_two() {
                tracing::warn!(
                    actor,
                    incarnation,
                    count,
                    "a chunk came again; it is not used twice"
                );
            }
        }
        Outcome::Dropped((actor, incarnation), reason) => {
            tracing::debug!(actor, incarnation, reason = reason.name(), "a chunk is not used");
            reporter.metrics.frame(word(outcome));
        }
        Outcome::Rejected(actor, reason, message) => {
            let count = reporter.metrics.frame(reason);
            // The 1st, 2nd, 4th, 8th, …: whoever floods the learner shall not flood its log.
            if count.is_power_of_two() {
                let from = match actor {
                    Some((actor, incarnation)) => {
                        format!("of actor {actor} (incarnation {incarnation})")
                    }
                    None => "of an unknown sender".to_owned(),
                };
                tracing::warn!(?actor, reason, count, message, "a frame is refused");
                let message =
                    format!("a frame {from} is refused ({reason}, {count} so far): {message}");
                reporter.event(&Event::Warning(Warning { message }));
            }
        }
    }
}
