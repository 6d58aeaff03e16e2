//! What only a network has: cut connections, routers, addresses.

use caudata_transport::{
    Control, SendError, TransportConfig, TransportError, ZenohConfig, actor_link, learner_link,
};

use crate::support::frames::{Ledger, PATIENCE, flush, frame, recv, send, wait_until};
use crate::support::policies::{assert_nothing_more, label, next_policy, policy, read};
use crate::support::proxy::Proxy;
use crate::support::rig::{Kind, Rig, limits, remote};

/// The connection is cut in the middle of a stream of large frames, five times: every frame arrives once and in order, and
/// the policy gets through.
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

/// zenoh panics when asked to wait on a thread of a single-threaded tokio runtime; the links do not ask it to.
#[test]
fn links_work_inside_a_single_threaded_runtime() {
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
fn works_through_a_router() {
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
        tls: None,
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
fn names_an_address_that_is_taken() {
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
