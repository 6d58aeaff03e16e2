//! The learner's half of the protocol: which arrivals are new, and what to answer.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use super::message::{Status, UpHead, UpKind};
use crate::Limits;

/// Links whose counters are remembered, those that are gone included, so that a link that comes back after
/// a long silence is not taken for a new one. The one silent longest is forgotten first.
const MAX_KNOWN_LINKS: usize = 4096;

/// Frames received and not yet read, and the position of every link.
#[derive(Default)]
pub(crate) struct Inbox {
    epoch: u64,
    window: u64,
    max_frame_bytes: usize,
    max_actors: usize,
    /// Frames per second and link; `None`: no limit.
    rate: Option<f64>,
    peer_timeout: Duration,
    links: BTreeMap<u64, Link>,
    queue: VecDeque<(u64, Vec<u8>)>,
    generation: u64,
    stop: bool,
    pub(crate) refused: u64,
    pub(crate) duplicates: u64,
}

struct Link {
    received: u64,
    /// How many of the received are still in the queue.
    waiting: u64,
    /// The highest number that it has been told it may send; never goes back.
    granted: u64,
    /// Frames that the rate allows now, at most the window, and when they were counted.
    allowance: f64,
    counted: Instant,
    probe: u64,
    heard: Instant,
    gone: bool,
    /// Something has changed since the last answer.
    answer: bool,
}

impl Inbox {
    pub(crate) fn new(epoch: u64, limits: &Limits) -> Self {
        Self {
            epoch,
            window: limits.window_frames as u64,
            max_frame_bytes: limits.max_frame_bytes,
            max_actors: limits.max_actors,
            rate: Some(limits.max_frames_per_s).filter(|&r| r > 0).map(f64::from),
            peer_timeout: limits.peer_timeout(),
            ..Self::default()
        }
    }

    /// One message of an actor. True when a frame was queued.
    pub(crate) fn on_message(&mut self, head: &UpHead, frame: Vec<u8>, now: Instant) -> bool {
        if !self.is_seated(head.link, now) && !self.admit(head, now) {
            return false;
        }
        let Some(link) = self.links.get_mut(&head.link) else { return false };
        link.heard = now;
        link.gone = head.kind == UpKind::Bye;
        link.answer = !link.gone;
        match head.kind {
            UpKind::Probe => link.probe = link.probe.max(head.number),
            UpKind::Data if head.number <= link.received => self.duplicates += 1,
            // A gap: something before it was lost. The next probe shows the actor what.
            UpKind::Data if head.number > link.received + 1 => {}
            UpKind::Data
                if frame.len() > self.max_frame_bytes
                    || link.waiting >= self.window
                    || (self.rate.is_some() && head.number > link.granted) =>
            {
                self.refused += 1;
            }
            UpKind::Data => {
                link.received = head.number;
                link.waiting += 1;
                link.allowance = (link.allowance - 1.0).max(0.0);
                self.queue.push_back((head.link, frame));
                return true;
            }
            UpKind::Bye => {}
        }
        false
    }

    /// The oldest unread frame; its link may send one more.
    pub(crate) fn pop(&mut self) -> Option<Vec<u8>> {
        let (link, frame) = self.queue.pop_front()?;
        if let Some(link) = self.links.get_mut(&link) {
            link.waiting -= 1;
            link.answer = true;
        }
        Some(frame)
    }

    /// Announces a policy to every link.
    pub(crate) fn announce(&mut self, generation: u64, stop: bool) {
        self.generation = generation;
        self.stop = stop;
        for link in self.links.values_mut() {
            link.answer = true;
        }
    }

    /// Whether some answer is owed before the next heartbeat.
    pub(crate) fn owes_answers(&self) -> bool {
        self.links.values().any(|link| link.answer && !link.gone)
    }

    /// The answers owed, or one for every link that is there.
    pub(crate) fn answers(&mut self, everyone: bool, now: Instant) -> Vec<Status> {
        let mut answers = Vec::new();
        for (&id, link) in &mut self.links {
            if link.is_there(now, self.peer_timeout) && (everyone || link.answer) {
                link.grant(self.window, self.rate, now);
                answers.push(Status {
                    epoch: self.epoch,
                    link: id,
                    received: link.received,
                    granted: link.granted,
                    probe: link.probe,
                    generation: self.generation,
                    max_frame_bytes: self.max_frame_bytes as u64,
                    stop: self.stop,
                });
            }
            link.answer = false;
        }
        answers
    }

    /// Links heard within the peer time-out that have not said goodbye.
    pub(crate) fn peers(&self, now: Instant) -> usize {
        let there = |link: &&Link| link.is_there(now, self.peer_timeout);
        self.links.values().filter(there).count()
    }

    pub(crate) fn depth(&self) -> usize {
        self.queue.len()
    }

    /// Whether the link has one of the `max_actors` seats: it is there, or what it sent is still unread. So
    /// there are never more than `max_actors * window_frames` unread frames, however often actors are
    /// replaced.
    fn is_seated(&self, link: u64, now: Instant) -> bool {
        self.links
            .get(&link)
            .is_some_and(|link| link.waiting > 0 || link.is_there(now, self.peer_timeout))
    }

    /// Seats a link that is new or has been away; false when it is one actor too many.
    fn admit(&mut self, head: &UpHead, now: Instant) -> bool {
        if head.kind == UpKind::Bye {
            return false;
        }
        let seated = self.links.keys().filter(|&&link| self.is_seated(link, now)).count();
        let known = self.links.contains_key(&head.link);
        if seated >= self.max_actors || (!known && !self.forget_one_of_too_many()) {
            self.refused += 1;
            return false;
        }
        self.links.entry(head.link).or_insert(Link {
            received: head.base - 1,
            waiting: 0,
            // What it sent before it heard of this learner, it sent within the window.
            granted: head.base - 1 + self.window,
            allowance: self.window as f64,
            counted: now,
            probe: 0,
            heard: now,
            gone: false,
            answer: true,
        });
        true
    }

    /// Keeps the number of remembered links bounded; false when none can be forgotten.
    fn forget_one_of_too_many(&mut self) -> bool {
        if self.links.len() < MAX_KNOWN_LINKS {
            return true;
        }
        let forgettable = self.links.iter().filter(|(_, link)| link.waiting == 0);
        let oldest = forgettable.min_by_key(|(_, link)| link.heard);
        let Some((&oldest, _)) = oldest else { return false };
        self.links.remove(&oldest);
        true
    }
}

impl Link {
    /// Raises what it may send: the window beyond what has been read, and no more than the rate allows beyond
    /// what has come.
    fn grant(&mut self, window: u64, rate: Option<f64>, now: Instant) {
        let by_window = self.received - self.waiting + window;
        let Some(rate) = rate else {
            self.granted = by_window;
            return;
        };
        let since_s = now.saturating_duration_since(self.counted).as_secs_f64();
        self.counted = now;
        self.allowance = (self.allowance + since_s * rate).min(window as f64);
        // Granted and not yet come is part of the allowance.
        let by_rate = self.received + self.allowance as u64;
        self.granted = self.granted.max(by_window.min(by_rate));
    }

    fn is_there(&self, now: Instant, peer_timeout: Duration) -> bool {
        !self.gone && now.duration_since(self.heard) < peer_timeout
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inbox() -> Inbox {
        let limits = Limits {
            max_frame_bytes: 4,
            window_frames: 2,
            max_actors: 2,
            heartbeat_ms: 100,
            peer_timeout_ms: 300,
            ..Limits::default()
        };
        Inbox::new(9, &limits)
    }

    fn data(link: u64, number: u64) -> UpHead {
        UpHead { kind: UpKind::Data, link, number, base: 1 }
    }

    fn probe(link: u64, number: u64) -> UpHead {
        UpHead { kind: UpKind::Probe, ..data(link, number) }
    }

    #[test]
    fn each_frame_is_queued_once_and_in_order() {
        let now = Instant::now();
        let mut inbox = inbox();
        assert!(inbox.on_message(&data(1, 1), b"a".to_vec(), now));
        assert!(!inbox.on_message(&data(1, 1), b"a".to_vec(), now));
        assert!(!inbox.on_message(&data(1, 3), b"c".to_vec(), now));
        assert!(inbox.on_message(&data(1, 2), b"b".to_vec(), now));
        // The window of two is full: an actor that keeps to its grant does not send this.
        assert!(!inbox.on_message(&data(1, 3), b"c".to_vec(), now));
        assert_eq!((inbox.duplicates, inbox.refused), (1, 1));
        assert_eq!(inbox.pop().as_deref(), Some(&b"a"[..]));
        // Received 2, read 1, window 2: numbers up to 3 are granted.
        let answers = inbox.answers(false, now);
        assert_eq!((answers[0].received, answers[0].granted, answers[0].epoch), (2, 3, 9));
        assert!(inbox.answers(false, now).is_empty());
        assert_eq!(inbox.answers(true, now).len(), 1);
        assert!(inbox.on_message(&data(1, 3), b"c".to_vec(), now));
    }

    #[test]
    fn an_unknown_link_begins_at_its_base() {
        let now = Instant::now();
        let mut inbox = inbox();
        let head = UpHead { number: 5, base: 4, ..data(1, 5) };
        assert!(!inbox.on_message(&head, b"e".to_vec(), now));
        let head = UpHead { number: 4, ..head };
        assert!(inbox.on_message(&head, b"d".to_vec(), now));
    }

    #[test]
    fn actors_beyond_the_limit_wait_until_one_has_gone_or_fallen_silent() {
        let now = Instant::now();
        let mut inbox = inbox();
        inbox.on_message(&probe(1, 1), Vec::new(), now);
        inbox.on_message(&probe(2, 1), Vec::new(), now);
        inbox.on_message(&probe(3, 1), Vec::new(), now);
        assert_eq!((inbox.peers(now), inbox.refused), (2, 1));
        let bye = UpHead { kind: UpKind::Bye, ..data(1, 0) };
        inbox.on_message(&bye, Vec::new(), now);
        assert_eq!(inbox.peers(now), 1);
        inbox.on_message(&probe(3, 2), Vec::new(), now);
        assert_eq!(inbox.peers(now), 2);
        // 300 ms of silence and both count as gone; what they sent is remembered.
        let later = now + Duration::from_millis(300);
        assert_eq!(inbox.peers(later), 0);
        inbox.on_message(&data(2, 1), b"x".to_vec(), later);
        assert_eq!(inbox.answers(false, later).len(), 1);
    }

    /// Ten frames a second, windows of two: after the first two one more every 100 ms, however fast they are
    /// read.
    #[test]
    fn a_rate_holds_back_grants_and_refuses_what_was_not_granted() {
        let start = Instant::now();
        let limits = Limits {
            max_frame_bytes: 4,
            window_frames: 2,
            max_frames_per_s: 10,
            ..Limits::default()
        };
        let mut inbox = Inbox::new(9, &limits);
        let granted = |inbox: &mut Inbox, ms| {
            inbox.answers(true, start + Duration::from_millis(ms))[0].granted
        };
        for number in [1, 2] {
            assert!(inbox.on_message(&data(1, number), b"a".to_vec(), start));
            inbox.pop();
        }
        assert_eq!(granted(&mut inbox, 0), 2);
        assert_eq!(granted(&mut inbox, 50), 2);
        // Not granted: refused, although the window has room.
        assert!(!inbox.on_message(&data(1, 3), b"a".to_vec(), start));
        assert_eq!(inbox.refused, 1);
        assert_eq!(granted(&mut inbox, 150), 3);
        assert!(inbox.on_message(&data(1, 3), b"a".to_vec(), start));
        inbox.pop();
        assert_eq!(granted(&mut inbox, 190), 3);
        // A long pause saves up no more than the window.
        assert_eq!(granted(&mut inbox, 2_900), 5);
    }

    /// Two seats, windows of two: a killed actor's unread frames keep its seat, so no more than four are ever
    /// unread.
    #[test]
    fn unread_frames_keep_the_seat_of_an_actor_that_has_gone() {
        let now = Instant::now();
        let mut inbox = inbox();
        for link in [1, 2] {
            inbox.on_message(&data(link, 1), b"a".to_vec(), now);
            inbox.on_message(&data(link, 2), b"b".to_vec(), now);
        }
        let later = now + Duration::from_millis(300);
        assert_eq!(inbox.peers(later), 0);
        assert!(!inbox.on_message(&data(3, 1), b"c".to_vec(), later));
        assert_eq!((inbox.depth(), inbox.refused), (4, 1));
        // Both frames of link 1 read: its seat is free.
        inbox.pop();
        assert!(!inbox.on_message(&data(3, 1), b"c".to_vec(), later));
        inbox.pop();
        assert!(inbox.on_message(&data(3, 1), b"c".to_vec(), later));
        // Link 1 comes back and finds both seats taken: 2 has unread frames, 3 is there.
        assert!(!inbox.on_message(&data(1, 3), b"d".to_vec(), later));
    }

    #[test]
    fn frames_over_the_limit_are_refused_and_links_remembered_are_bounded() {
        let now = Instant::now();
        let mut inbox = inbox();
        assert!(!inbox.on_message(&data(1, 1), b"12345".to_vec(), now));
        assert_eq!(inbox.refused, 1);
        for link in 2..MAX_KNOWN_LINKS as u64 + 10 {
            let at = now + Duration::from_secs(link);
            inbox.on_message(&probe(link, 1), Vec::new(), at);
        }
        assert_eq!(inbox.links.len(), MAX_KNOWN_LINKS);
    }
}
