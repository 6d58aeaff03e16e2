//! FAULTS.md, 62: one peer sends all that it can, or opens connections and says nothing.

use std::net::{SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use caudata_transport::{Control, SendError, TransportConfig};

use crate::support::frames::{Ledger, frame, recv, send, wait_until};
use crate::support::policies::{label, next_policy, policy, read};
use crate::support::rig::{Kind, Rig, limits};

/// However much one actor sends, it has no more than its window waiting at the learner: of two full windows the learner reads the
/// polite actor's whole one.
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
            wait_until("two full windows", || {
                rig.learner.stats().depth as u64 == 2 * window
            });
            for _ in 0..2 * window {
                ledger.take(&recv(&mut *rig.learner));
            }
            let counts = [ledger.count(0, 1), ledger.count(1, 1)];
            assert_eq!(counts, [round * window; 2]);
        }
        done.store(true, Ordering::Relaxed);
    });
}

/// Connections that say nothing take neither memory nor places for ever: who is connected works on meanwhile, and an actor that
/// comes later gets in when they have been given up.
#[test]
fn fault_62_silent_connections_lock_nobody_out() {
    const CONNECTIONS: usize = 400;
    let mut rig = Rig::new(Kind::Zenoh, limits());
    let TransportConfig::Zenoh(config) = &rig.config else {
        panic!("another transport");
    };
    let address: SocketAddr = config.connect[0]
        .strip_prefix("tcp/")
        .unwrap()
        .parse()
        .unwrap();
    let mut early = rig.actor(0);
    rig.learner
        .publish_policy(policy(1, 10_000, Control::Run))
        .unwrap();
    assert_eq!(next_policy(&mut *early).version, 1);
    let silent: Vec<TcpStream> = (0..CONNECTIONS)
        .filter_map(|_| TcpStream::connect(address).ok())
        .collect();
    assert!(silent.len() > CONNECTIONS / 2, "{}", silent.len());
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
