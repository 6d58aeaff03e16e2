//! One suite, every transport: what `ActorLink` and `LearnerLink` promise.
//!
//! Cases are generic functions; the macro at the end makes a test of each for each transport. Deaths and restarts
//! happen to real processes. No case asserts a time; all wait for conditions.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use std::time::Duration;

use caudata_transport::{
    ActorLink, Control, LearnerLink, Limits, PolicyUpdate, SendError, TransportConfig,
    TransportError, ZenohConfig, actor_link, clean_up, learner_link,
};
use support::frames::{
    ATTEMPT, Label, Ledger, PATIENCE, check, flush, frame, recv, send, wait_until,
};
use support::process::{Helper, run_order, start_learner};
use support::proxy::Proxy;
use support::rig::{Kind, Residue, Rig, fresh_run_id, limits, remote};

fn label(sender: u64, number: u64) -> Label {
    Label {
        sender,
        incarnation: 1,
        number,
    }
}

fn policy(version: u64, bytes: usize, control: Control) -> PolicyUpdate {
    let body: Vec<u8> = (0..bytes).map(|i| (i as u64 * 7 + version) as u8).collect();
    PolicyUpdate {
        version,
        sha256: [version as u8; 32],
        bytes: body.into(),
        control,
    }
}

fn next_policy(actor: &mut dyn ActorLink) -> PolicyUpdate {
    actor
        .next_policy(PATIENCE)
        .unwrap()
        .expect("a policy within the patience of the test")
}

/// Reads until the learner has `total` frames.
fn read(learner: &mut dyn LearnerLink, ledger: &mut Ledger, total: u64) {
    while ledger.total() < total {
        ledger.take(&recv(learner));
    }
}

/// Nothing more comes, given a few heartbeats.
fn assert_nothing_more(learner: &mut dyn LearnerLink) {
    assert_eq!(learner.recv(Duration::from_millis(100)).unwrap(), None);
}

// ---- every transport ----

/// 10,000 frames of many sizes from 4 senders: in order per sender, none lost, none twice, none torn.
fn ten_thousand_frames_arrive_once_and_in_order(kind: Kind) {
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
    assert_eq!(
        (stats.frames, stats.depth, stats.refused),
        (SENDERS * EACH, 0, 0)
    );
    rig.finish();
}

/// A learner that does not read: the window fills, `Full` comes back, nothing grows; the frame tried again arrives once.
fn a_slow_learner_pushes_back_and_nothing_is_lost(kind: Kind) {
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

/// A 1 MB rollout and a 4 MB policy pass whole; one byte over the limit is refused with both sizes in the text.
fn large_messages_pass_and_larger_ones_are_refused(kind: Kind) {
    const FRAME: usize = 1 << 20;
    const POLICY: usize = 4 << 20;
    let large = Limits {
        max_frame_bytes: FRAME,
        max_policy_bytes: POLICY,
        window_frames: 2,
        ..limits()
    };
    let mut rig = Rig::new(kind, large);
    let mut actor = rig.actor(0);
    for number in 1..=3 {
        send(&mut *actor, &frame(label(0, number), FRAME));
        let got = recv(&mut *rig.learner);
        assert_eq!(got.bytes.len(), FRAME);
        assert_eq!(check(&got.bytes).number, number);
    }
    let refused = actor.send(&vec![0; FRAME + 1], PATIENCE).unwrap_err();
    assert_eq!(
        refused,
        SendError::TooLarge {
            size: FRAME + 1,
            max: FRAME
        }
    );
    assert!(refused.to_string().contains("1048577") && refused.to_string().contains("1048576"));
    let update = policy(1, POLICY, Control::Run);
    rig.learner.publish_policy(update.clone()).unwrap();
    assert_eq!(next_policy(&mut *actor), update);
    let refused = rig
        .learner
        .publish_policy(policy(2, POLICY + 1, Control::Run))
        .unwrap_err();
    assert_eq!(
        refused,
        TransportError::PolicyTooLarge {
            size: POLICY + 1,
            max: POLICY
        }
    );
    assert!(refused.to_string().contains("4194305") && refused.to_string().contains("4194304"));
    drop(actor);
    rig.finish();
}

/// An empty frame is a frame.
fn an_empty_frame_passes(kind: Kind) {
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
fn only_the_newest_policy_counts(kind: Kind) {
    const LAST: u64 = 200;
    let mut rig = Rig::new(kind, limits());
    let mut actors = [rig.actor(0), rig.actor(1)];
    for version in 1..=LAST {
        rig.learner
            .publish_policy(policy(version, 10_000, Control::Run))
            .unwrap();
    }
    let goes_back = rig
        .learner
        .publish_policy(policy(LAST - 1, 10, Control::Run));
    assert!(matches!(
        goes_back,
        Err(TransportError::VersionWentBack { .. })
    ));
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
    rig.learner
        .publish_policy(policy(LAST, 10_000, Control::Run))
        .unwrap();
    for actor in &mut actors {
        assert_eq!(next_policy(&mut **actor).version, LAST);
    }
    drop(actors);
    rig.finish();
}

/// An actor that joins late gets the newest policy without another being published.
fn a_late_joiner_gets_the_newest_policy(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let mut early = rig.actor(0);
    for version in 1..=3 {
        rig.learner
            .publish_policy(policy(version, 5_000, Control::Run))
            .unwrap();
    }
    while next_policy(&mut *early).version < 3 {}
    let mut late = rig.actor(1);
    assert_eq!(next_policy(&mut *late), policy(3, 5_000, Control::Run));
    drop((early, late));
    rig.finish();
}

/// The stop signal reaches an idle actor, one that is stuck behind a full window, and one that comes later; it is final.
fn stop_reaches_every_actor(kind: Kind) {
    let mut rig = Rig::new(kind, limits());
    let mut idle = rig.actor(0);
    let mut stuck = rig.actor(1);
    rig.learner
        .publish_policy(policy(1, 100, Control::Run))
        .unwrap();
    assert_eq!(next_policy(&mut *idle).control, Control::Run);
    assert!(!idle.stop_requested());
    let mut number = 1;
    while !matches!(
        stuck.send(&frame(label(1, number), 100), ATTEMPT),
        Err(SendError::Full { .. })
    ) {
        number += 1;
    }
    rig.learner
        .publish_policy(policy(1, 0, Control::Stop))
        .unwrap();
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
fn the_learner_counts_its_actors(kind: Kind) {
    let rig = Rig::new(kind, limits());
    assert_eq!(rig.learner.stats().peers, 0);
    let (first, second) = (rig.actor(0), rig.actor(1));
    wait_until("two actors", || rig.learner.stats().peers == 2);
    wait_until("the learner", || {
        first.is_connected() && second.is_connected()
    });
    drop(first);
    wait_until("one actor", || rig.learner.stats().peers == 1);
    drop(second);
    rig.finish();
}

// ---- between processes ----

/// One actor more than the limit is kept out, not the others; when one leaves it comes in.
fn one_actor_too_many_waits_for_its_turn(kind: Kind) {
    let mut rig = Rig::new(
        kind,
        Limits {
            max_actors: 2,
            ..limits()
        },
    );
    let (mut first, second) = (rig.actor(0), rig.actor(1));
    wait_until("two actors", || rig.learner.stats().peers == 2);
    let mut third = rig.actor(2);
    let kept_out = third.send(b"x", ATTEMPT);
    assert!(
        matches!(kept_out, Err(SendError::Disconnected { .. })),
        "{kept_out:?}"
    );
    send(&mut *first, b"y");
    assert_eq!(recv(&mut *rig.learner).bytes, b"y");
    drop(second);
    send(&mut *third, b"z");
    assert_eq!(recv(&mut *rig.learner).bytes, b"z");
    drop((first, third));
    rig.finish();
}

/// Of three actors one is killed in mid-stream, again and again: no torn frame, the others lose nothing, and each new
/// incarnation works.
fn a_killed_actor_harms_nobody(kind: Kind) {
    // More of them than shared memory has ports: those of the killed must be reclaimed.
    killing(kind, 16, 300);
}

fn killing(kind: Kind, kills: u64, others: u64) {
    let large = Limits {
        max_frame_bytes: 256 << 10,
        ..limits()
    };
    let mut rig = Rig::new(kind, large);
    let start = |sender, incarnation, frames| {
        Helper::actor(
            &rig.run_id,
            &rig.config,
            sender,
            incarnation,
            frames,
            100_000,
        )
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

/// An actor that stands still in mid-stream, longer than the peer time-out, holds up neither the others' frames nor their
/// policies; when it goes on it loses nothing.
fn an_actor_that_stands_still_holds_up_nobody(kind: Kind) {
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

/// The learner is killed and another takes the run over: the actor is told, reconnects by itself, and everything the
/// first one did not acknowledge goes to the second, in order. Nothing of the first is left.
fn actors_find_a_restarted_learner(kind: Kind) {
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
    assert!(
        matches!(alone, Err(SendError::Disconnected { .. })),
        "{alone:?}"
    );
    // The second learner is this process. zenoh: at the same address, which is all that the actor knows.
    let mut second = learner_link(&same_address(&config, &actor_config), &run_id).unwrap();
    if let Some(residue) = &mut residue {
        residue.note();
    }
    second
        .publish_policy(policy(7, 1_000, Control::Run))
        .unwrap();
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

fn same_address(config: &TransportConfig, actor_config: &TransportConfig) -> TransportConfig {
    match actor_config {
        TransportConfig::Zenoh(actor) => TransportConfig::Zenoh(ZenohConfig {
            limits: actor.limits.clone(),
            listen: actor.connect.clone(),
            connect: Vec::new(),
        }),
        _ => config.clone(),
    }
}

/// The learner stands still for longer than the peer time-out: the actor's sends come back at their deadline, and when it
/// goes on every frame arrives once.
fn a_learner_that_stands_still_loses_nothing(kind: Kind) {
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
fn an_actor_may_come_before_its_learner(kind: Kind) {
    let config = remote(kind, limits());
    let run_id = fresh_run_id();
    // zenoh: an address is settled beforehand by a learner that has left again.
    let settled = learner_link(&config, &run_id).unwrap().actor_config();
    let mut actor = actor_link(&settled, &run_id, 0).unwrap();
    let early = actor.send(b"x", ATTEMPT);
    assert!(
        matches!(early, Err(SendError::Disconnected { .. })),
        "{early:?}"
    );
    let mut learner = learner_link(&same_address(&config, &settled), &run_id).unwrap();
    send(&mut *actor, b"y");
    assert_eq!(recv(&mut *learner).bytes, b"y");
}

// ---- one transport only ----

/// Signal 9 leaves files in shared memory; a supervisor, or the next learner of the run, removes them.
#[test]
fn iceoryx2_what_a_killed_learner_leaves_can_be_removed() {
    let config = remote(Kind::Iceoryx2, limits());
    let run_id = fresh_run_id();
    let (learner, _) = start_learner(&run_id, &config);
    let residue = Residue::of(&config).unwrap();
    let alive = clean_up(&config, &run_id);
    assert!(
        matches!(alive, Err(TransportError::AlreadyRunning { .. })),
        "{alive:?}"
    );
    learner.kill();
    clean_up(&config, &run_id).unwrap();
    residue.assert_none();
}

#[test]
fn iceoryx2_refuses_a_second_learner_of_the_run() {
    let config = remote(Kind::Iceoryx2, limits());
    let first = learner_link(&config, "twice").unwrap();
    let second = learner_link(&config, "twice").err().unwrap();
    assert!(
        matches!(second, TransportError::AlreadyRunning { .. }),
        "{second}"
    );
    let other_run = learner_link(&config, "once").unwrap();
    drop((first, other_run));
}

/// No room is an error at the start that names the file system, not a bus error at the first write.
#[test]
fn iceoryx2_refuses_to_start_without_room() {
    let shm = nix::sys::statvfs::statvfs("/dev/shm").unwrap();
    let room = shm.blocks_available() * shm.fragment_size();
    let huge = Limits {
        max_frame_bytes: Limits::MAX_BYTES,
        window_frames: Limits::MAX_COUNT,
        ..limits()
    };
    if room > (huge.max_frame_bytes * huge.window_frames) as u64 {
        return;
    }
    let config = remote(Kind::Iceoryx2, huge);
    match actor_link(&config, "huge", 0).err().unwrap() {
        TransportError::NoSpace {
            path,
            needed,
            available,
        } => {
            assert_eq!(path.to_str(), Some("/dev/shm"));
            assert!(needed > available);
        }
        other => panic!("{other}"),
    }
}

/// Limits decide the layout of shared memory: an actor with others says so instead of misreading.
#[test]
fn iceoryx2_reports_limits_that_differ() {
    let config = remote(Kind::Iceoryx2, limits());
    let learner = learner_link(&config, "limits").unwrap();
    let TransportConfig::Iceoryx2(mut other) = config else {
        panic!("another transport");
    };
    other.limits.window_frames += 1;
    let mut actor = actor_link(&TransportConfig::Iceoryx2(other), "limits", 0).unwrap();
    let mut result = Ok(());
    wait_until("the report", || {
        result = actor.send(b"x", Duration::ZERO);
        matches!(result, Err(SendError::Backend(_)))
    });
    assert!(
        result
            .unwrap_err()
            .to_string()
            .contains("differ from the learner's")
    );
    assert!(matches!(
        actor.next_policy(ATTEMPT),
        Err(TransportError::Backend(_))
    ));
    drop((actor, learner));
}

/// The connection is cut in the middle of a stream of large frames, five times: every frame arrives once and in order, and
/// the policy gets through.
#[test]
fn zenoh_a_cut_connection_loses_nothing() {
    const CUTS: u64 = 5;
    const BETWEEN: u64 = 60;
    let mut rig = Rig::new(Kind::Zenoh, limits());
    let TransportConfig::Zenoh(config) = &mut rig.config else {
        panic!("another transport");
    };
    let learner = config.connect[0].strip_prefix("tcp/").unwrap();
    let proxy = Proxy::to(learner.parse().unwrap());
    config.connect = vec![format!("tcp/{}", proxy.address())];
    let mut actor = rig.actor(0);
    let total = CUTS * BETWEEN;
    std::thread::scope(|scope| {
        let sender = scope.spawn(move || {
            for number in 1..=total {
                send(&mut *actor, &frame(label(0, number), 60_000));
            }
            flush(&mut *actor);
            while next_policy(&mut *actor).version < CUTS {}
            actor.stats()
        });
        let mut ledger = Ledger::default();
        for cut in 1..=CUTS {
            rig.learner
                .publish_policy(policy(cut, 60_000, Control::Run))
                .unwrap();
            read(&mut *rig.learner, &mut ledger, cut * BETWEEN - BETWEEN / 2);
            wait_until("a connection to cut", || proxy.cut());
            read(&mut *rig.learner, &mut ledger, cut * BETWEEN);
        }
        assert_nothing_more(&mut *rig.learner);
        let stats = sender.join().unwrap();
        assert_eq!((stats.frames, stats.depth), (total, 0));
    });
    rig.finish();
}

/// The smaller of the two frame limits counts: a frame that the learner would not take is refused at the source.
#[test]
fn zenoh_keeps_to_the_learners_frame_limit() {
    let learner = learner_link(&remote(Kind::Zenoh, limits()), "limits").unwrap();
    let TransportConfig::Zenoh(mut config) = learner.actor_config() else {
        panic!("another transport");
    };
    let max = config.limits.max_frame_bytes;
    config.limits.max_frame_bytes = 2 * max;
    let mut actor = actor_link(&TransportConfig::Zenoh(config), "limits", 0).unwrap();
    wait_until("the learner", || actor.is_connected());
    let refused = actor.send(&vec![0; max + 1], PATIENCE);
    assert_eq!(refused, Err(SendError::TooLarge { size: max + 1, max }));
    drop((actor, learner));
}

/// zenoh panics when asked to wait on a thread of a single-threaded tokio runtime; the links do not ask it to.
#[test]
fn zenoh_links_work_inside_a_single_threaded_runtime() {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .build()
        .unwrap();
    runtime.block_on(async {
        let mut rig = Rig::new(Kind::Zenoh, limits());
        let mut actor = rig.actor(0);
        send(&mut *actor, b"x");
        assert_eq!(recv(&mut *rig.learner).bytes, b"x");
        drop(actor);
        rig.finish();
    });
}

/// Learner and actors meet at a router: neither listens.
#[test]
fn zenoh_works_through_a_router() {
    use zenoh::Wait;
    let port = {
        let probe = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        probe.local_addr().unwrap().port()
    };
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let mut settings = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"router\"".to_owned()),
        ("listen/endpoints", format!("[{endpoint:?}]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        settings.insert_json5(key, &value).unwrap();
    }
    let router = zenoh::open(settings).wait().unwrap();
    let config = TransportConfig::Zenoh(ZenohConfig {
        limits: limits(),
        listen: Vec::new(),
        connect: vec![endpoint],
    });
    let mut learner = learner_link(&config, "routed").unwrap();
    let second = learner_link(&config, "routed").err().unwrap();
    assert!(
        matches!(second, TransportError::AlreadyRunning { .. }),
        "{second}"
    );
    let mut actor = actor_link(&learner.actor_config(), "routed", 0).unwrap();
    let update = policy(1, 60_000, Control::Run);
    learner.publish_policy(update.clone()).unwrap();
    assert_eq!(next_policy(&mut *actor), update);
    let mut ledger = Ledger::default();
    for number in 1..=100 {
        send(&mut *actor, &frame(label(0, number), 60_000));
        ledger.take(&recv(&mut *learner));
    }
    flush(&mut *actor);
    drop((actor, learner));
    router.close().wait().unwrap();
}

/// An address that cannot be listened on is an error that names it.
#[test]
fn zenoh_names_an_address_that_is_taken() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", taken.local_addr().unwrap());
    let config = TransportConfig::Zenoh(ZenohConfig {
        listen: vec![endpoint.clone()],
        ..ZenohConfig::default()
    });
    match learner_link(&config, "taken").err().unwrap() {
        TransportError::Endpoint {
            endpoint: named, ..
        } => assert_eq!(named, endpoint),
        other => panic!("{other}"),
    }
}

#[test]
fn bad_run_ids_and_limits_are_refused() {
    let config = remote(Kind::Zenoh, limits());
    for run_id in ["", "a/b", ".hidden", "späť", &"x".repeat(65)] {
        let refused = learner_link(&config, run_id).err().unwrap();
        assert!(matches!(refused, TransportError::Config(_)), "{refused}");
    }
    let config = remote(
        Kind::Zenoh,
        Limits {
            window_frames: 0,
            ..limits()
        },
    );
    let refused = actor_link(&config, "run", 0).err().unwrap();
    assert!(refused.to_string().contains("window_frames"), "{refused}");
}

/// The configuration survives the way to an actor process as text, and an unknown key is an error.
#[test]
fn configurations_round_trip_as_toml() {
    for kind in [Kind::Iceoryx2, Kind::Zenoh] {
        let config = remote(kind, limits());
        let text = toml::to_string(&config).unwrap();
        assert_eq!(toml::from_str::<TransportConfig>(&text).unwrap(), config);
    }
    let unknown = toml::from_str::<TransportConfig>("kind = \"zenoh\"\nport = 1\n");
    assert!(unknown.is_err());
}

/// The body of helper processes; does nothing in the test process itself.
#[test]
#[ignore = "run by other tests in a process of its own"]
fn helper_process() {
    run_order();
}

macro_rules! on {
    ($($kind:ident in $module:ident: $($case:ident)*;)*) => {$(
        mod $module {
            $(#[test] fn $case() { super::$case(super::Kind::$kind); })*
        }
    )*};
}

on! {
    Inproc in inproc:
        ten_thousand_frames_arrive_once_and_in_order
        a_slow_learner_pushes_back_and_nothing_is_lost
        large_messages_pass_and_larger_ones_are_refused
        an_empty_frame_passes
        only_the_newest_policy_counts
        a_late_joiner_gets_the_newest_policy
        stop_reaches_every_actor
        the_learner_counts_its_actors;
    Iceoryx2 in iceoryx2:
        ten_thousand_frames_arrive_once_and_in_order
        a_slow_learner_pushes_back_and_nothing_is_lost
        large_messages_pass_and_larger_ones_are_refused
        an_empty_frame_passes
        only_the_newest_policy_counts
        a_late_joiner_gets_the_newest_policy
        stop_reaches_every_actor
        the_learner_counts_its_actors
        one_actor_too_many_waits_for_its_turn
        a_killed_actor_harms_nobody
        an_actor_that_stands_still_holds_up_nobody
        actors_find_a_restarted_learner
        a_learner_that_stands_still_loses_nothing
        an_actor_may_come_before_its_learner;
    Zenoh in zenoh_tcp:
        ten_thousand_frames_arrive_once_and_in_order
        a_slow_learner_pushes_back_and_nothing_is_lost
        large_messages_pass_and_larger_ones_are_refused
        an_empty_frame_passes
        only_the_newest_policy_counts
        a_late_joiner_gets_the_newest_policy
        stop_reaches_every_actor
        the_learner_counts_its_actors
        one_actor_too_many_waits_for_its_turn
        a_killed_actor_harms_nobody
        an_actor_that_stands_still_holds_up_nobody
        actors_find_a_restarted_learner
        a_learner_that_stands_still_loses_nothing
        an_actor_may_come_before_its_learner;
}

/// The long fault suite: a thousand actors killed in mid-write.
#[test]
#[ignore = "long: a thousand processes"]
fn fault_a_thousand_killed_actors_iceoryx2() {
    killing(Kind::Iceoryx2, 1_000, 20_000);
}

/// The same over the network, a tenth of it.
#[test]
#[ignore = "long: a hundred processes"]
fn fault_a_hundred_killed_actors_zenoh() {
    killing(Kind::Zenoh, 100, 5_000);
}
