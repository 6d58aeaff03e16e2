//! What only a network has: cut connections, routers, addresses.

use caudata_transport::{
    Control, LearnerLink, SendError, TransportConfig, TransportError, ZenohConfig, actor_link,
    learner_link,
};

use crate::support::frames::{Ledger, PATIENCE, flush, frame, recv, send, wait_until};
use crate::support::policies::{assert_nothing_more, label, next_policy, policy, read};
use crate::support::proxy::Proxy;
use crate::support::rig::{Kind, Rig, limits, remote};

/// The connection is cut in the middle of a stream of large frames, five times: every frame arrives once and
/// in order, and the policy gets through.
#[test]
fn a_cut_connection_loses_nothing() {
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
            rig.learner.publish_policy(policy(cut, 60_000, Control::Run)).unwrap();
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

/// The smaller of the two frame limits counts: a frame that the learner would not take is refused at the
/// source.
#[test]
fn keeps_to_the_learners_frame_limit() {
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

/// zenoh panics when asked to wait on a thread of a single-threaded tokio runtime; the links do not ask it
/// to.
#[test]
fn links_work_inside_a_single_threaded_runtime() {
    let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
    runtime.block_on(async {
        let mut rig = Rig::new(Kind::Zenoh, limits());
        let mut actor = rig.actor(0);
        send(&mut *actor, b"x");
        assert_eq!(recv(&mut *rig.learner).bytes, b"x");
        drop(actor);
        rig.finish();
    });
}

/// A router on loopback, and what learners and actors that meet there are told.
fn router() -> (zenoh::Session, TransportConfig) {
    use zenoh::Wait;
    let endpoint = format!("tcp/{}", caudata_chaos_proxy::own_address());
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
        tls: None,
    });
    (router, config)
}

fn is_second(result: &Result<Box<dyn LearnerLink>, TransportError>) -> bool {
    matches!(result, Err(TransportError::AlreadyRunning { .. }))
}

/// However soon the second learner of a run comes, and also when both come at the same moment, there is one.
#[test]
fn a_run_behind_a_router_has_one_learner() {
    const ROUNDS: u32 = 20;
    let (router, config) = router();
    for round in 0..ROUNDS {
        let run_id = format!("soon-{round}");
        let first = learner_link(&config, &run_id).unwrap();
        let second = learner_link(&config, &run_id);
        assert!(is_second(&second), "{:?}", second.err());
        drop(first);

        let run_id = format!("together-{round}");
        let start = std::sync::Barrier::new(2);
        let open = || {
            start.wait();
            learner_link(&config, &run_id)
        };
        let both = std::thread::scope(|scope| {
            [scope.spawn(open), scope.spawn(open)].map(|opened| opened.join().unwrap())
        });
        let refused = both.iter().filter(|link| is_second(link)).count();
        assert_eq!(refused, 1, "{:?}", both.map(Result::err));
    }
    zenoh::Wait::wait(router.close()).unwrap();
}

/// Nobody is there who speaks zenoh: the actor tries again, but ever more rarely.
#[test]
fn an_actor_that_reaches_nobody_does_not_hurry() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let config = TransportConfig::Zenoh(ZenohConfig {
        limits: limits(),
        listen: Vec::new(),
        connect: vec![format!("tcp/{}", listener.local_addr().unwrap())],
        tls: None,
    });
    let actor = actor_link(&config, "nobody", 0).unwrap();
    listener.set_nonblocking(true).unwrap();
    let until = std::time::Instant::now() + std::time::Duration::from_secs(3);
    let mut attempts = 0;
    while std::time::Instant::now() < until {
        // Closed at once.
        attempts += u32::from(listener.accept().is_ok());
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    // After 0, 50, 150, 350, 750, 1,550 ms; on a busy machine fewer.
    assert!((1..=7).contains(&attempts), "{attempts}");
    drop(actor);
}

/// Learner and actors meet at a router: neither listens.
#[test]
fn works_through_a_router() {
    let (router, config) = router();
    let mut learner = learner_link(&config, "routed").unwrap();
    let second = learner_link(&config, "routed");
    assert!(is_second(&second), "{:?}", second.err());
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
    zenoh::Wait::wait(router.close()).unwrap();
}

/// An address that cannot be listened on is an error that names it.
#[test]
fn names_an_address_that_is_taken() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp/{}", taken.local_addr().unwrap());
    let config = TransportConfig::Zenoh(ZenohConfig {
        listen: vec![endpoint.clone()],
        ..ZenohConfig::default()
    });
    match learner_link(&config, "taken").err().unwrap() {
        TransportError::Endpoint { endpoint: named, .. } => assert_eq!(named, endpoint),
        other => panic!("{other}"),
    }
}
