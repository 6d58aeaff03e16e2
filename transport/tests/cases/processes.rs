//! What holds between processes: deaths, restarts, standstills. They happen to real processes.

use std::sync::atomic::{AtomicBool, Ordering};

use caudata_transport::{
    Control, Limits, SendError, TransportConfig, ZenohConfig, actor_link, clean_up, learner_link,
};

use crate::support::frames::{ATTEMPT, Ledger, check, flush, frame, recv, send, wait_until};
use crate::support::policies::{assert_nothing_more, label, next_policy, policy};
use crate::support::process::{Helper, start_learner};
use crate::support::rig::{Kind, Residue, Rig, for_actors, fresh_run_id, limits, remote};

/// One actor more than the limit is kept out, not the others; when one leaves it comes in.
pub fn one_actor_too_many_waits_for_its_turn(kind: Kind) {
    let mut rig = Rig::new(kind, Limits { max_actors: 2, ..limits() });
    let (mut first, second) = (rig.actor(0), rig.actor(1));
    wait_until("two actors", || rig.learner.stats().peers == 2);
    let mut third = rig.actor(2);
    let kept_out = third.send(b"x", ATTEMPT);
    assert!(matches!(kept_out, Err(SendError::Disconnected { .. })), "{kept_out:?}");
    send(&mut *first, b"y");
    assert_eq!(recv(&mut *rig.learner).bytes, b"y");
    drop(second);
    send(&mut *third, b"z");
    assert_eq!(recv(&mut *rig.learner).bytes, b"z");
    drop((first, third));
    rig.finish();
}

/// One of three actors is killed in mid-stream, again and again: no torn frame, the others lose nothing, and
/// each new incarnation works.
pub fn a_killed_actor_harms_nobody(kind: Kind) {
    // More of them than shared memory has ports: those of the killed must be reclaimed.
    killing(kind, 16, 300);
}

pub fn killing(kind: Kind, kills: u64, others: u64) {
    let large = Limits { max_frame_bytes: 256 << 10, ..limits() };
    let mut rig = Rig::new(kind, large);
    let start = |sender, incarnation, frames| {
        Helper::actor(&rig.run_id, &rig.config, sender, incarnation, frames, 100_000)
    };
    let steady = [start(1, 1, others), start(2, 1, others)];
    let mut ledger = Ledger::default();
    for incarnation in 1..=kills {
        let victim = start(0, incarnation, 0);
        while ledger.count(0, incarnation) < 3 + incarnation % 4 {
            ledger.take(&recv(&mut *rig.learner));
        }
        victim.kill();
    }
    while ledger.count(1, 1) < others || ledger.count(2, 1) < others {
        ledger.take(&recv(&mut *rig.learner));
    }
    for helper in steady {
        helper.join();
    }
    // What the killed had on the way still arrives whole, and then nothing.
    while let Some(rest) = rig.learner.recv(ATTEMPT).unwrap() {
        assert_eq!(ledger.take(&rest).sender, 0);
    }
    wait_until("the killed to be missed", || rig.learner.stats().peers == 0);
    rig.finish();
}

/// An actor that stands still in mid-stream, longer than the peer time-out, holds up neither the others'
/// frames nor their policies; when it goes on it loses nothing.
pub fn an_actor_that_stands_still_holds_up_nobody(kind: Kind) {
    const FRAMES: u64 = 400;
    let mut rig = Rig::new(kind, limits());
    let still = Helper::actor(&rig.run_id, &rig.config, 0, 1, FRAMES, 20_000);
    let mut ledger = Ledger::default();
    while ledger.count(0, 1) < 10 {
        ledger.take(&recv(&mut *rig.learner));
    }
    still.stop();
    let mut actor = rig.actor(1);
    for number in 1..=FRAMES {
        send(&mut *actor, &frame(label(1, number), 20_000));
        if number % 100 == 0 {
            let update = policy(number, 50_000, Control::Run);
            rig.learner.publish_policy(update.clone()).unwrap();
            assert_eq!(next_policy(&mut *actor), update);
        }
        while ledger.count(1, 1) < number {
            ledger.take(&recv(&mut *rig.learner));
        }
    }
    wait_until("the silence to be seen", || rig.learner.stats().peers == 1);
    still.go_on();
    while ledger.count(0, 1) < FRAMES {
        ledger.take(&recv(&mut *rig.learner));
    }
    still.join();
    drop(actor);
    rig.finish();
}

/// The learner is killed and another takes the run over: the actor is told, reconnects by itself, and
/// everything the first one did not acknowledge goes to the second, in order. Nothing of the first is left.
pub fn actors_find_a_restarted_learner(kind: Kind) {
    let config = remote(kind, limits());
    let run_id = fresh_run_id();
    let (mut first, actor_config) = start_learner(&run_id, &config);
    let mut residue = Residue::of(&config);
    let mut actor = actor_link(&actor_config, &run_id, 0).unwrap();
    for number in 1..=20 {
        send(&mut *actor, &frame(label(0, number), 1_000));
    }
    while first.line("frame ") != "10" {}
    first.kill();
    wait_until("the loss to be seen", || !actor.is_connected());
    let alone = actor.send(&frame(label(0, 21), 1_000), ATTEMPT);
    assert!(matches!(alone, Err(SendError::Disconnected { .. })), "{alone:?}");
    // The second learner is this process. zenoh: at the same address, which is all that the actor knows.
    let mut second = learner_link(&same_address(&config, &actor_config), &run_id).unwrap();
    if let Some(residue) = &mut residue {
        residue.note();
    }
    second.publish_policy(policy(7, 1_000, Control::Run)).unwrap();
    assert_eq!(next_policy(&mut *actor).version, 7);
    std::thread::scope(|scope| {
        scope.spawn(move || {
            for number in 21..=60 {
                send(&mut *actor, &frame(label(0, number), 1_000));
            }
            flush(&mut *actor);
        });
        // It begins with what the first did not acknowledge, and leaves nothing out after that.
        let mut number = check(&recv(&mut *second).bytes).number;
        assert!((1..=21).contains(&number));
        while number < 60 {
            number += 1;
            assert_eq!(check(&recv(&mut *second).bytes).number, number);
        }
    });
    assert_nothing_more(&mut *second);
    drop(second);
    if let Some(residue) = residue {
        residue.assert_none();
    }
}

/// The learner is killed while three actors send as fast as they can, and another is there at once, before
/// anyone has missed it: three times over every actor finds the next one, and each frame that is read follows
/// the one before.
pub fn actors_find_a_learner_that_is_killed_under_load_and_back_at_once(kind: Kind) {
    const ACTORS: u64 = 3;
    let config = remote(kind, limits());
    let run_id = fresh_run_id();
    let (mut learner, actor_config) = start_learner(&run_id, &config);
    let again = same_address(&config, &actor_config);
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for sender in 0..ACTORS {
            let mut actor = actor_link(&actor_config, &run_id, sender as u32).unwrap();
            let stop = &stop;
            scope.spawn(move || {
                let mut number = 1;
                while !stop.load(Ordering::Relaxed) {
                    match actor.send(&frame(label(sender, number), 60_000), ATTEMPT) {
                        Ok(()) => number += 1,
                        Err(SendError::Full { .. } | SendError::Disconnected { .. }) => {}
                        Err(error) => panic!("send: {error}"),
                    }
                }
            });
        }
        for _ in 0..3 {
            // The helper prints numbers only; so many in a row are of more than one actor.
            for _ in 0..100 {
                learner.line("frame ");
            }
            learner.kill();
            learner = start_learner(&run_id, &again).0;
        }
        learner.kill();
        let mut last = learner_link(&again, &run_id).unwrap();
        let mut ledger = Ledger::default();
        wait_until("every actor", || {
            let label = check(&recv(&mut *last).bytes);
            ledger.follows(label);
            (0..ACTORS).all(|sender| ledger.count(sender, 1) > 0)
        });
        stop.store(true, Ordering::Relaxed);
        // Whoever waits for room may go on.
        while last.recv(ATTEMPT).unwrap().is_some() {}
    });
    clean_up(&config, &run_id).unwrap();
}

pub fn same_address(config: &TransportConfig, actor_config: &TransportConfig) -> TransportConfig {
    match (actor_config, config) {
        (TransportConfig::Zenoh(actor), TransportConfig::Zenoh(own)) => {
            TransportConfig::Zenoh(ZenohConfig {
                limits: actor.limits.clone(),
                listen: actor.connect.clone(),
                connect: Vec::new(),
                tls: own.tls.clone(),
            })
        }
        _ => config.clone(),
    }
}

/// The learner stands still for longer than the peer time-out: the actor's sends come back at their deadline,
/// and when it goes on every frame arrives once.
pub fn a_learner_that_stands_still_loses_nothing(kind: Kind) {
    let config = remote(kind, limits());
    let run_id = fresh_run_id();
    let (mut learner, actor_config) = start_learner(&run_id, &config);
    let mut actor = actor_link(&actor_config, &run_id, 0).unwrap();
    send(&mut *actor, &frame(label(0, 1), 1_000));
    assert_eq!(learner.line("frame "), "1");
    learner.stop();
    let mut number = 2;
    loop {
        match actor.send(&frame(label(0, number), 1_000), ATTEMPT) {
            Ok(()) => number += 1,
            Err(SendError::Full { .. }) => {}
            Err(SendError::Disconnected { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    assert!(number <= 2 + limits().window_frames as u64);
    learner.go_on();
    for number in number..=40 {
        send(&mut *actor, &frame(label(0, number), 1_000));
    }
    flush(&mut *actor);
    for number in 2..=40 {
        assert_eq!(learner.line("frame "), number.to_string());
    }
    drop(actor);
    learner.kill();
    clean_up(&config, &run_id).unwrap();
}

/// Actors may start first: they wait for the learner without an error.
pub fn an_actor_may_come_before_its_learner(kind: Kind) {
    let config = remote(kind, limits());
    let run_id = fresh_run_id();
    // zenoh: an address is settled beforehand by a learner that has left again.
    let settled = learner_link(&config, &run_id).unwrap().actor_config();
    let settled = for_actors(settled, &config);
    let mut actor = actor_link(&settled, &run_id, 0).unwrap();
    let early = actor.send(b"x", ATTEMPT);
    assert!(matches!(early, Err(SendError::Disconnected { .. })), "{early:?}");
    let mut learner = learner_link(&same_address(&config, &settled), &run_id).unwrap();
    send(&mut *actor, b"y");
    assert_eq!(recv(&mut *learner).bytes, b"y");
}
