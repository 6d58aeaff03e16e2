//! Outbox and inbox joined by a channel that breaks: random runs, no clock, no threads.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use proptest::prelude::*;

use super::{Inbox, Outbox, Status, Step, UpHead};
use crate::Limits;

const TICK: Duration = Duration::from_millis(20);
const ACTORS: usize = 3;

/// One event of a run. Indices are taken modulo the number of actors.
#[derive(Debug, Clone)]
enum Event {
    Send(usize),
    Transmit(usize),
    Deliver(usize),
    Answer,
    Read,
    /// The connection of one actor breaks: everything in flight is lost, both ways.
    Break(usize),
    /// Time passes.
    Tick(u8),
}

fn events() -> impl Strategy<Value = Vec<Event>> {
    let actor = 0..ACTORS;
    let event = prop_oneof![
        4 => actor.clone().prop_map(Event::Send),
        6 => actor.clone().prop_map(Event::Transmit),
        6 => actor.clone().prop_map(Event::Deliver),
        3 => Just(Event::Answer),
        3 => Just(Event::Read),
        1 => actor.prop_map(Event::Break),
        1 => (1..20_u8).prop_map(Event::Tick),
    ];
    prop::collection::vec(event, 1..400)
}

struct Actor {
    outbox: Outbox,
    up: VecDeque<(UpHead, Vec<u8>)>,
    down: VecDeque<Status>,
    taken: u64,
}

struct World {
    now: Instant,
    actors: Vec<Actor>,
    inbox: Inbox,
    read: Vec<u64>,
}

impl World {
    fn new() -> Self {
        let limits = Limits {
            window_frames: 3,
            heartbeat_ms: 100,
            peer_timeout_ms: 300,
            ..Limits::default()
        };
        let actor = |link| Actor {
            outbox: Outbox::new(link, &limits),
            up: VecDeque::new(),
            down: VecDeque::new(),
            taken: 0,
        };
        Self {
            now: Instant::now(),
            actors: (0..ACTORS as u64).map(actor).collect(),
            inbox: Inbox::new(1, &limits),
            read: vec![0; ACTORS],
        }
    }

    fn run(&mut self, event: &Event) {
        match *event {
            Event::Send(i) => {
                // The frame says who and which: 8 bytes actor, 8 bytes count.
                let actor = &mut self.actors[i];
                let frame = [(i as u64).to_le_bytes(), (actor.taken + 1).to_le_bytes()].concat();
                if actor.outbox.take(&frame, self.now).is_ok() {
                    actor.taken += 1;
                }
            }
            Event::Transmit(i) => {
                let actor = &mut self.actors[i];
                if let Step::Transmit(head, frame) = actor.outbox.step(self.now) {
                    actor.up.push_back((head, frame.to_vec()));
                }
            }
            Event::Deliver(i) => {
                let actor = &mut self.actors[i];
                if let Some((head, frame)) = actor.up.pop_front() {
                    self.inbox.on_message(&head, frame, self.now);
                }
                if let Some(status) = actor.down.pop_front() {
                    actor.outbox.on_status(&status, self.now);
                }
            }
            Event::Answer => {
                for status in self.inbox.answers(false, self.now) {
                    self.actors[status.link as usize].down.push_back(status);
                }
            }
            Event::Read => self.read(),
            Event::Break(i) => {
                self.actors[i].up.clear();
                self.actors[i].down.clear();
            }
            Event::Tick(n) => self.now += TICK * u32::from(n),
        }
    }

    fn read(&mut self) {
        let Some(frame) = self.inbox.pop() else { return };
        let field = |at: usize| u64::from_le_bytes(frame[at..at + 8].try_into().unwrap());
        let (actor, count) = (field(0) as usize, field(8));
        self.read[actor] += 1;
        // In order, none twice, none left out.
        assert_eq!(count, self.read[actor], "actor {actor}");
        // No frame arrives that was not taken.
        assert!(count <= self.actors[actor].taken);
    }
}

proptest! {
    #[test]
    fn every_taken_frame_is_read_once_and_in_order_whatever_breaks(events in events()) {
        let mut world = World::new();
        for event in &events {
            world.run(event);
            // Bounded: three unread frames per link, three more on the way.
            prop_assert!(world.inbox.depth() <= 3 * ACTORS);
            prop_assert!(world.actors.iter().all(|actor| actor.outbox.depth() <= 3));
        }
        // The connections hold from now on: everything taken gets through within a few heartbeats.
        for _ in 0..60 {
            for i in 0..ACTORS {
                for _ in 0..4 {
                    world.run(&Event::Transmit(i));
                    world.run(&Event::Deliver(i));
                }
            }
            world.run(&Event::Answer);
            world.run(&Event::Read);
            world.run(&Event::Tick(1));
        }
        for (actor, read) in world.actors.iter().zip(&world.read) {
            prop_assert_eq!(actor.taken, *read);
            prop_assert_eq!(actor.outbox.depth(), 0);
        }
    }
}
