//! The actor's half of the protocol: what to transmit next, and when a frame may be taken.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::message::{Status, UpHead, UpKind};
use crate::{Limits, SendError};

/// While no learner answers, probes go out this many times per heartbeat.
const EAGER_PROBES: u32 = 4;

/// Frames taken but not acknowledged, and what is known of the learner.
#[derive(Default)]
pub(crate) struct Outbox {
    link: u64,
    heartbeat: Duration,
    peer_timeout: Duration,
    /// Ours, or the learner's where that is smaller.
    max_frame_bytes: usize,
    /// Number of the first frame in `frames`; everything below is acknowledged.
    base: u64,
    frames: VecDeque<Arc<[u8]>>,
    /// Highest number transmitted and not taken back by a rewind; at least `base - 1`.
    sent: u64,
    /// Highest number ever transmitted.
    sent_ever: u64,
    granted: u64,
    epoch: Option<u64>,
    heard: Option<Instant>,
    probes: u64,
    probed: Option<Instant>,
    /// The oldest probe not answered yet, and `sent` at that time: the answer shows what is missing.
    mark: Option<(u64, u64)>,
    generation: u64,
    stop: bool,
    pub(crate) retransmits: u64,
}

/// A policy of one learner process: its epoch, and which of its policies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PolicyId {
    pub epoch: u64,
    pub generation: u64,
}

impl PolicyId {
    /// Whether this one comes after what is there. Another learner's is news whatever its number.
    pub(crate) fn is_news_to(self, have: Option<Self>) -> bool {
        have.is_none_or(|have| have.epoch != self.epoch || have.generation < self.generation)
    }
}

/// What the transmitting thread does next.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// Transmit this; the frame is empty unless the head says data. Report a failure with [`Outbox::failed`].
    Transmit(UpHead, Arc<[u8]>),
    /// Nothing to do for so long, unless something changes.
    Wait(Duration),
}

impl Outbox {
    pub(crate) fn new(link: u64, limits: &Limits) -> Self {
        Self {
            link,
            heartbeat: limits.heartbeat(),
            peer_timeout: limits.peer_timeout(),
            max_frame_bytes: limits.max_frame_bytes,
            base: 1,
            ..Self::default()
        }
    }

    /// Whether a learner has answered within the peer time-out.
    pub(crate) fn is_connected(&self, now: Instant) -> bool {
        self.heard.is_some_and(|heard| now.duration_since(heard) < self.peer_timeout)
    }

    /// When a learner answered last.
    pub(crate) fn last_heard(&self) -> Option<Instant> {
        self.heard
    }

    /// Frames taken and not acknowledged.
    pub(crate) fn depth(&self) -> usize {
        self.frames.len()
    }

    pub(crate) fn stop(&self) -> bool {
        self.stop
    }

    /// The newest policy the learner has spoken of; `None` before there is one.
    pub(crate) fn newest_policy(&self) -> Option<PolicyId> {
        let id = PolicyId { epoch: self.epoch?, generation: self.generation };
        (id.generation > 0).then_some(id)
    }

    /// Takes the frame if the learner is there and has granted its number. `Full` and `Disconnected` pass
    /// with time.
    pub(crate) fn take(&mut self, frame: &[u8], now: Instant) -> Result<(), SendError> {
        if frame.len() > self.max_frame_bytes {
            return Err(SendError::TooLarge { size: frame.len(), max: self.max_frame_bytes });
        }
        let unacknowledged = self.frames.len();
        if !self.is_connected(now) {
            return Err(SendError::Disconnected { unacknowledged });
        }
        if self.next_number() > self.granted {
            return Err(SendError::Full { unacknowledged });
        }
        self.frames.push_back(frame.into());
        Ok(())
    }

    /// Ok once everything taken is acknowledged.
    pub(crate) fn flushed(&self, now: Instant) -> Result<(), SendError> {
        let unacknowledged = self.frames.len();
        if unacknowledged == 0 {
            Ok(())
        } else if self.is_connected(now) {
            Err(SendError::Full { unacknowledged })
        } else {
            Err(SendError::Disconnected { unacknowledged })
        }
    }

    /// The next thing to transmit, counted as transmitted.
    pub(crate) fn step(&mut self, now: Instant) -> Step {
        let connected = self.is_connected(now);
        let interval = if connected { self.heartbeat } else { self.heartbeat / EAGER_PROBES };
        let since = self.probed.map(|at| now.duration_since(at));
        if since.is_none_or(|since| since >= interval) {
            return self.probe(now);
        }
        // Without a learner frames wait: only probes go into the void.
        let next = self.sent + 1;
        if connected && next < self.next_number() {
            self.sent = next;
            self.retransmits += u64::from(next <= self.sent_ever);
            self.sent_ever = self.sent_ever.max(next);
            let frame = &self.frames[(next - self.base) as usize];
            return Step::Transmit(self.head(UpKind::Data, next), Arc::clone(frame));
        }
        Step::Wait(interval - since.unwrap_or_default())
    }

    /// The message just returned by [`step`](Self::step) could not be handed on: it will be tried again.
    pub(crate) fn failed(&mut self, head: &UpHead) {
        match head.kind {
            UpKind::Data => self.sent = self.sent.min(head.number - 1).max(self.base - 1),
            UpKind::Probe if self.mark.is_some_and(|(probe, _)| probe == head.number) => {
                self.mark = None;
            }
            UpKind::Probe | UpKind::Bye => {}
        }
    }

    /// Learns from an answer. True when something a caller may wait for has changed.
    pub(crate) fn on_status(&mut self, status: &Status, now: Instant) -> bool {
        if status.link != self.link || status.received > self.sent_ever {
            return false;
        }
        let was = (self.is_connected(now), self.base, self.granted, self.sent);
        let policy_was = (self.newest_policy(), self.stop);
        self.heard = Some(now);
        if self.epoch != Some(status.epoch) {
            self.start_over(status.epoch);
        }
        self.granted = self.granted.max(status.granted);
        if let Ok(theirs) = usize::try_from(status.max_frame_bytes) {
            self.max_frame_bytes = self.max_frame_bytes.min(theirs);
        }
        self.generation = self.generation.max(status.generation);
        self.stop |= status.stop;
        while self.base <= status.received && self.frames.pop_front().is_some() {
            self.base += 1;
        }
        self.sent = self.sent.max(self.base - 1);
        if let Some((probe, sent_before)) = self.mark
            && status.probe >= probe
        {
            self.mark = None;
            if status.received < sent_before {
                self.sent = self.sent.min(status.received).max(self.base - 1);
            }
        }
        was != (true, self.base, self.granted, self.sent)
            || policy_was != (self.newest_policy(), self.stop)
    }

    /// The head of the farewell.
    pub(crate) fn bye(&self) -> UpHead {
        self.head(UpKind::Bye, 0)
    }

    /// Another learner: nothing granted, nothing received, everything unacknowledged goes out again.
    fn start_over(&mut self, epoch: u64) {
        self.epoch = Some(epoch);
        self.granted = 0;
        self.sent = self.base - 1;
        self.mark = None;
        self.generation = 0;
        self.stop = false;
    }

    fn probe(&mut self, now: Instant) -> Step {
        self.probes += 1;
        self.probed = Some(now);
        if self.mark.is_none() {
            self.mark = Some((self.probes, self.sent));
        }
        Step::Transmit(self.head(UpKind::Probe, self.probes), Arc::default())
    }

    fn next_number(&self) -> u64 {
        self.base + self.frames.len() as u64
    }

    fn head(&self, kind: UpKind, number: u64) -> UpHead {
        UpHead { kind, link: self.link, number, base: self.base }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limits() -> Limits {
        Limits { max_frame_bytes: 8, heartbeat_ms: 100, peer_timeout_ms: 300, ..Limits::default() }
    }

    fn status(received: u64, granted: u64, probe: u64) -> Status {
        Status {
            epoch: 1,
            link: 7,
            received,
            granted,
            probe,
            generation: 0,
            max_frame_bytes: 8,
            stop: false,
        }
    }

    fn number(step: &Step) -> (UpKind, u64) {
        match step {
            Step::Transmit(head, _) => (head.kind, head.number),
            Step::Wait(_) => panic!("nothing to transmit"),
        }
    }

    #[test]
    fn frames_are_taken_only_within_the_grant_of_a_live_learner() {
        let start = Instant::now();
        let mut outbox = Outbox::new(7, &limits());
        assert_eq!(outbox.take(b"a", start), Err(SendError::Disconnected { unacknowledged: 0 }));
        assert_eq!(number(&outbox.step(start)), (UpKind::Probe, 1));
        assert!(outbox.on_status(&status(0, 2, 1), start));
        outbox.take(b"a", start).unwrap();
        outbox.take(b"b", start).unwrap();
        assert_eq!(outbox.take(b"c", start), Err(SendError::Full { unacknowledged: 2 }));
        assert_eq!(outbox.take(b"123456789", start), Err(SendError::TooLarge { size: 9, max: 8 }));
        assert_eq!(number(&outbox.step(start)), (UpKind::Data, 1));
        assert_eq!(number(&outbox.step(start)), (UpKind::Data, 2));
        // 60 ms later: the next probe is due 40 ms on.
        let later = start + Duration::from_millis(60);
        assert_eq!(outbox.step(later), Step::Wait(Duration::from_millis(40)));
        // Both received, one read: room for one more; the flush is complete.
        outbox.on_status(&status(2, 3, 1), later);
        outbox.flushed(later).unwrap();
        outbox.take(b"c", later).unwrap();
        // Silence for the peer time-out.
        let silent = later + Duration::from_millis(300);
        assert!(!outbox.is_connected(silent));
        assert_eq!(outbox.flushed(silent), Err(SendError::Disconnected { unacknowledged: 1 }));
    }

    #[test]
    fn what_a_probe_shows_to_be_missing_is_sent_again_once() {
        let start = Instant::now();
        let mut outbox = Outbox::new(7, &limits());
        outbox.step(start);
        outbox.on_status(&status(0, 4, 1), start);
        for frame in [b"a", b"b", b"c"] {
            outbox.take(frame, start).unwrap();
            outbox.step(start);
        }
        let later = start + Duration::from_millis(100);
        assert_eq!(number(&outbox.step(later)), (UpKind::Probe, 2));
        // An answer to an older probe proves nothing about frames sent after it.
        outbox.on_status(&status(1, 4, 1), later);
        assert!(matches!(outbox.step(later), Step::Wait(_)));
        // The answer to probe 2 does: 2 and 3 are missing. The same answer again changes nothing.
        outbox.on_status(&status(1, 4, 2), later);
        assert_eq!(number(&outbox.step(later)), (UpKind::Data, 2));
        outbox.on_status(&status(1, 4, 2), later);
        assert_eq!(number(&outbox.step(later)), (UpKind::Data, 3));
        assert_eq!(outbox.retransmits, 2);
    }

    #[test]
    fn a_new_learner_gets_everything_unacknowledged() {
        let start = Instant::now();
        let mut outbox = Outbox::new(7, &limits());
        outbox.step(start);
        outbox.on_status(&status(0, 4, 1), start);
        for frame in [b"a", b"b"] {
            outbox.take(frame, start).unwrap();
            outbox.step(start);
        }
        outbox.on_status(&status(1, 4, 1), start);
        let restarted = Status { epoch: 2, ..status(1, 5, 1) };
        assert!(outbox.on_status(&restarted, start));
        assert_eq!(number(&outbox.step(start)), (UpKind::Data, 2));
    }

    #[test]
    fn the_smaller_frame_limit_counts() {
        let start = Instant::now();
        let mut outbox = Outbox::new(7, &limits());
        let strict = Status { max_frame_bytes: 3, ..status(0, 4, 0) };
        outbox.on_status(&strict, start);
        assert_eq!(outbox.take(b"1234", start), Err(SendError::TooLarge { size: 4, max: 3 }));
    }

    #[test]
    fn answers_for_others_and_impossible_ones_are_ignored() {
        let start = Instant::now();
        let mut outbox = Outbox::new(7, &limits());
        let foreign = Status { link: 8, ..status(0, 4, 0) };
        assert!(!outbox.on_status(&foreign, start));
        assert!(!outbox.on_status(&status(1, 4, 0), start));
        assert!(!outbox.is_connected(start));
    }
}
