//! What holds on every transport.

use std::time::Duration;

use caudata_transport::{Control, Limits, SendError, TransportError};

use crate::support::frames::{
    ATTEMPT, Ledger, PATIENCE, check, flush, frame, recv, send, wait_until,
};
use crate::support::policies::{assert_nothing_more, label, next_policy, policy, read};
use crate::support::rig::{Kind, Rig, limits};

/// 10,000 frames of many sizes from 4 senders: in order per sender, none lost, none twice, none torn.
pub fn ten_thousand_frames_arrive_once_and_in_order(kind: Kind) {
    const SENDERS: u64 = 4;
    const EACH: u64 = 2_500;
    let mut rig = Rig::new(kind, limits());
    let mut ledger = Ledger::default();
    std::thread::scope(|scope| {
        for sender in 0..SENDERS {
            let mut actor = rig.actor(sender as u32);
            scope.spawn(move || {
                for number in 1..=EACH {
                    let bytes = 32 + (number * number % 2_000) as usize;
                    send(&mut *actor, &frame(label(sender, number), bytes));
                }
                flush(&mut *actor);
                assert_eq!((actor.stats().frames, actor.stats().depth), (EACH, 0));
            });
        }
        read(&mut *rig.learner, &mut ledger, SENDERS * EACH);
    });
    assert_nothing_more(&mut *rig.learner);
    let stats = rig.learner.stats();
    assert_eq!((stats.frames, stats.depth, stats.refused), (SENDERS * EACH, 0, 0));
    rig.finish();
}

/// A learner that does not read: the window fills, `Full` comes back, nothing grows; the frame tried again
/// arrives once.
pub fn a_slow_learner_pushes_back_and_nothing_is_lost(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let window = limits().window_frames;
    let mut actor = rig.actor(0);
    let mut taken = 0;
    let refused = loop {
        match actor.send(&frame(label(0, taken + 1), 1_000), ATTEMPT) {
            Ok(()) => taken += 1,
            Err(SendError::Disconnected { .. }) => {}
            Err(SendError::Full { .. }) => break taken + 1,
            Err(error) => panic!("{error}"),
        }
    };
    assert_eq!(taken, window as u64);
    // However often it is tried: not taken, and the learner holds no more than the window.
    for _ in 0..3 {
        let again = actor.send(&frame(label(0, refused), 1_000), Duration::ZERO);
        assert!(matches!(again, Err(SendError::Full { .. })), "{again:?}");
    }
    wait_until("the window to fill", || rig.learner.stats().depth == window);
    assert!(actor.stats().refused >= 4);
    flush(&mut *actor);
    let mut ledger = Ledger::default();
    ledger.take(&recv(&mut *rig.learner));
    send(&mut *actor, &frame(label(0, refused), 1_000));
    read(&mut *rig.learner, &mut ledger, refused);
    assert_nothing_more(&mut *rig.learner);
    drop(actor);
    rig.finish();
}

/// A 1 MB rollout and a 4 MB policy pass whole; one byte over the limit is refused with both sizes in the
/// text.
pub fn large_messages_pass_and_larger_ones_are_refused(kind: Kind) {
    const FRAME: usize = 1 << 20;
    const POLICY: usize = 4 << 20;
    let large =
        Limits { max_frame_bytes: FRAME, max_policy_bytes: POLICY, window_frames: 2, ..limits() };
    let mut rig = Rig::new(kind, large);
    let mut actor = rig.actor(0);
    for number in 1..=3 {
        send(&mut *actor, &frame(label(0, number), FRAME));
        let got = recv(&mut *rig.learner);
        assert_eq!(got.bytes.len(), FRAME);
        assert_eq!(check(&got.bytes).number, number);
    }
    let refused = actor.send(&vec![0; FRAME + 1], PATIENCE).unwrap_err();
    assert_eq!(refused, SendError::TooLarge { size: FRAME + 1, max: FRAME });
    assert!(refused.to_string().contains("1048577") && refused.to_string().contains("1048576"));
    let update = policy(1, POLICY, Control::Run);
    rig.learner.publish_policy(update.clone()).unwrap();
    assert_eq!(next_policy(&mut *actor), update);
    let refused = rig.learner.publish_policy(policy(2, POLICY + 1, Control::Run)).unwrap_err();
    assert_eq!(refused, TransportError::PolicyTooLarge { size: POLICY + 1, max: POLICY });
    assert!(refused.to_string().contains("4194305") && refused.to_string().contains("4194304"));
    drop(actor);
    rig.finish();
}

/// An empty frame is a frame.
pub fn an_empty_frame_passes(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let mut actor = rig.actor(0);
    send(&mut *actor, b"");
    send(&mut *actor, b"x");
    assert_eq!(recv(&mut *rig.learner).bytes, b"");
    assert_eq!(recv(&mut *rig.learner).bytes, b"x");
    drop(actor);
    rig.finish();
}

/// Actors that look rarely see the newest policy and never an older one after it; each is whole.
pub fn only_the_newest_policy_counts(kind: Kind) {
    const LAST: u64 = 200;
    let mut rig = Rig::new(kind, limits());
    let mut actors = [rig.actor(0), rig.actor(1)];
    for version in 1..=LAST {
        rig.learner.publish_policy(policy(version, 10_000, Control::Run)).unwrap();
    }
    let goes_back = rig.learner.publish_policy(policy(LAST - 1, 10, Control::Run));
    assert!(matches!(goes_back, Err(TransportError::VersionWentBack { .. })));
    for actor in &mut actors {
        let mut seen = 0;
        while seen < LAST {
            let update = next_policy(&mut **actor);
            assert!(update.version > seen, "{} after {seen}", update.version);
            seen = update.version;
            assert_eq!(update, policy(seen, 10_000, Control::Run));
        }
        assert_eq!(actor.next_policy(ATTEMPT).unwrap(), None);
    }
    // The same version again is news: the learner may say it once more.
    rig.learner.publish_policy(policy(LAST, 10_000, Control::Run)).unwrap();
    for actor in &mut actors {
        assert_eq!(next_policy(&mut **actor).version, LAST);
    }
    drop(actors);
    rig.finish();
}

/// An actor that joins late gets the newest policy without another being published.
pub fn a_late_joiner_gets_the_newest_policy(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let mut early = rig.actor(0);
    for version in 1..=3 {
        rig.learner.publish_policy(policy(version, 5_000, Control::Run)).unwrap();
    }
    while next_policy(&mut *early).version < 3 {}
    let mut late = rig.actor(1);
    assert_eq!(next_policy(&mut *late), policy(3, 5_000, Control::Run));
    drop((early, late));
    rig.finish();
}

/// The stop signal reaches an idle actor, one that is stuck behind a full window, and one that comes later;
/// it is final.
pub fn stop_reaches_every_actor(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let mut idle = rig.actor(0);
    let mut stuck = rig.actor(1);
    rig.learner.publish_policy(policy(1, 100, Control::Run)).unwrap();
    assert_eq!(next_policy(&mut *idle).control, Control::Run);
    assert!(!idle.stop_requested());
    let mut number = 1;
    while !matches!(stuck.send(&frame(label(1, number), 100), ATTEMPT), Err(SendError::Full { .. }))
    {
        number += 1;
    }
    rig.learner.publish_policy(policy(1, 0, Control::Stop)).unwrap();
    let mut late = rig.actor(2);
    for actor in [&mut idle, &mut stuck, &mut late] {
        while next_policy(&mut **actor).control != Control::Stop {}
        wait_until("the stop signal", || actor.stop_requested());
    }
    let after = rig.learner.publish_policy(policy(2, 100, Control::Run));
    assert_eq!(after, Err(TransportError::Stopped));
    drop((idle, stuck, late));
    rig.finish();
}

/// The learner sees actors come and go.
pub fn the_learner_counts_its_actors(kind: Kind) {
    let rig = Rig::new(kind, limits());
    assert_eq!(rig.learner.stats().peers, 0);
    let (first, second) = (rig.actor(0), rig.actor(1));
    wait_until("two actors", || rig.learner.stats().peers == 2);
    wait_until("the learner", || first.is_connected() && second.is_connected());
    drop(first);
    wait_until("one actor", || rig.learner.stats().peers == 1);
    drop(second);
    rig.finish();
}
