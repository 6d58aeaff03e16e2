//! FAULTS.md, 62: one peer sends all that it can, or opens connections and says nothing.

use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use caudata_transport::{Control, SendError, TransportConfig};
use nix::sys::resource::{Resource, getrlimit, setrlimit};

use crate::support::frames::{Ledger, flush, frame, recv, send, wait_until};
use crate::support::policies::{label, next_policy, policy, read};
use crate::support::rig::{Kind, Rig, limits};

/// However much one actor sends, it has no more than its window waiting at the learner: of two full windows
/// the learner reads the polite actor's whole one.
pub fn fault_62_a_flood_of_one_actor_holds_up_nobody(kind: Kind) {
    const ROUNDS: u64 = 20;
    let mut rig = Rig::new(kind, limits());
    let window = limits().window_frames as u64;
    let links = [rig.actor(0), rig.actor(1)];
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for (sender, mut link) in (0..).zip(links) {
            let done = &done;
            scope.spawn(move || {
                let mut number = 1;
                while !done.load(Ordering::Relaxed) {
                    // The flood offers its frame again and again instead of waiting for room.
                    let patience = Duration::from_millis(if sender == 0 { 50 } else { 0 });
                    match link.send(&frame(label(sender, number), 20_000), patience) {
                        Ok(()) => number += 1,
                        Err(SendError::Full { .. } | SendError::Disconnected { .. }) => {}
                        Err(error) => panic!("{error}"),
                    }
                }
            });
        }
        let mut ledger = Ledger::default();
        for round in 1..=ROUNDS {
            wait_until("two full windows", || rig.learner.stats().depth as u64 == 2 * window);
            for _ in 0..2 * window {
                ledger.take(&recv(&mut *rig.learner));
            }
            let counts = [ledger.count(0, 1), ledger.count(1, 1)];
            assert_eq!(counts, [round * window; 2]);
        }
        done.store(true, Ordering::Relaxed);
    });
}

/// How long a polite actor waits until its frame is known to be with the learner, while another floods,
/// beside the same wait at rest. Printed; the bound is far above both and below any time-out.
pub fn fault_62_latency_under_a_flood(kind: Kind) {
    const FRAMES: u64 = 200;
    let mut rig = Rig::new(kind, limits());
    let (mut flood, mut polite) = (rig.actor(0), rig.actor(1));
    let (floods, done) = (AtomicBool::new(false), AtomicBool::new(false));
    let learner = &mut rig.learner;
    let waits = std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut number = 1;
            while !done.load(Ordering::Relaxed) {
                if !floods.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_millis(1));
                    continue;
                }
                match flood.send(&frame(label(0, number), 60_000), Duration::ZERO) {
                    Ok(()) => number += 1,
                    Err(SendError::Full { .. } | SendError::Disconnected { .. }) => {}
                    Err(error) => panic!("{error}"),
                }
            }
        });
        let reader = scope.spawn(|| {
            let mut ledger = Ledger::default();
            while !done.load(Ordering::Relaxed) {
                if let Some(frame) = learner.recv(Duration::from_millis(20)).unwrap() {
                    ledger.take(&frame);
                }
            }
            ledger.count(0, 1)
        });
        let mut number = 0;
        let mut measure = || {
            let mut waits: Vec<Duration> = (0..FRAMES)
                .map(|_| {
                    std::thread::sleep(Duration::from_millis(5));
                    number += 1;
                    let began = Instant::now();
                    send(&mut *polite, &frame(label(1, number), 20_000));
                    flush(&mut *polite);
                    began.elapsed()
                })
                .collect();
            waits.sort();
            [FRAMES / 2, FRAMES * 99 / 100].map(|at| waits[at as usize])
        };
        let at_rest = measure();
        floods.store(true, Ordering::Relaxed);
        let flooded = measure();
        done.store(true, Ordering::Relaxed);
        let flood_frames = reader.join().unwrap();
        // The comparison is worth nothing unless the other really floods.
        assert!(flood_frames > FRAMES, "{flood_frames}");
        println!(
            "{kind:?}: acknowledged at rest p50 {:?} p99 {:?}, under a flood of {flood_frames} frames p50 {:?} p99 {:?}",
            at_rest[0], at_rest[1], flooded[0], flooded[1]
        );
        flooded
    });
    assert!(waits[0] < Duration::from_millis(limits().peer_timeout_ms), "{waits:?}");
    drop((flood, polite));
    rig.finish();
}

/// Connections that say nothing take neither memory nor places for ever: who is connected works on meanwhile,
/// and an actor that comes later gets in when they have been given up.
#[test]
fn fault_62_silent_connections_lock_nobody_out() {
    silent_connections(400);
}

/// The same with ten thousand, as many as this process may have open files for.
#[test]
#[ignore = "long: ten thousand connections"]
fn fault_62_ten_thousand_silent_connections_lock_nobody_out() {
    // Both ends of each count against this process's limit.
    let (soft, hard) = getrlimit(Resource::RLIMIT_NOFILE).unwrap();
    let most = (hard.saturating_sub(500) / 2).min(10_000);
    setrlimit(Resource::RLIMIT_NOFILE, hard, hard).unwrap();
    println!("{most} connections (open files: {soft}, at most {hard})");
    silent_connections(usize::try_from(most).unwrap());
}

fn silent_connections(connections: usize) {
    let mut rig = Rig::new(Kind::Zenoh, limits());
    let TransportConfig::Zenoh(config) = &rig.config else {
        panic!("another transport");
    };
    let address: SocketAddr = config.connect[0].strip_prefix("tcp/").unwrap().parse().unwrap();
    let mut early = rig.actor(0);
    rig.learner.publish_policy(policy(1, 10_000, Control::Run)).unwrap();
    assert_eq!(next_policy(&mut *early).version, 1);
    let silent: Vec<TcpStream> =
        (0..connections).filter_map(|_| TcpStream::connect(address).ok()).collect();
    assert!(silent.len() > connections / 2, "{}", silent.len());
    let mut ledger = Ledger::default();
    for number in 1..=50 {
        send(&mut *early, &frame(label(0, number), 20_000));
        read(&mut *rig.learner, &mut ledger, number);
    }
    let mut late = rig.actor(1);
    assert_eq!(next_policy(&mut *late).version, 1);
    send(&mut *late, &frame(label(1, 1), 20_000));
    read(&mut *rig.learner, &mut ledger, 51);
    drop((silent, early, late));
}
