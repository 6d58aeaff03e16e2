//! Fault 28, the command link: datagrams that are lost, late and overtaken by others, between `drive` and the robot.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

// Of this the link needs the proxy and the weather only.
#[allow(dead_code)]
#[path = "../../tests/tests/chaos/network.rs"]
mod network;

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use caudata_deploy::command_link::{CommandLink, Commander, LinkKey, UdpLink};
use network::{Weather, World, proxy};

/// How long anything is waited for before the test gives up; nothing is asserted about time.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often the sender speaks.
const EVERY: Duration = Duration::from_millis(5);
/// Commands through bad weather.
const COMMANDS: u32 = 1000;

/// xorshift64*: repeats with its seed.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 32) % n
    }
}

/// The far end of the link, and what it looks at through it.
struct Sender {
    socket: UdpSocket,
    key: LinkKey,
    commander: Commander,
}

impl Sender {
    /// Says what there is to say, and hears what was answered.
    fn speaks(&mut self) {
        let datagram = self.commander.next_message().encode(&self.key);
        let _ = self.socket.send(&datagram);
        let mut answer = [0; 256];
        while let Ok(length) = self.socket.recv(&mut answer) {
            self.commander.hear(&answer[..length], &self.key);
        }
        std::thread::sleep(EVERY);
    }
}

#[test]
fn fault_28_through_loss_delay_and_reordering_no_older_command_counts_and_the_newest_arrives() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("link.key");
    std::fs::write(&path, [7; 32]).unwrap();
    let key = LinkKey::read(&path).unwrap();
    let here = World::ours();
    let localhost = here.socket().local_addr().unwrap().ip();
    let mut link = UdpLink::listen((localhost, 0).into(), key.clone(), false).unwrap();
    let weather = Arc::new(Weather::default());
    let port = proxy(&here, Arc::new(World::ours()), link.address(), &weather);
    let socket = here.socket();
    socket.connect(("localhost", port)).unwrap();
    socket.set_nonblocking(true).unwrap();
    let mut sender = Sender {
        socket,
        key,
        commander: Commander::begin(),
    };
    weather.loss_percent.store(50, Relaxed);
    weather.delay_ms.store(40, Relaxed);
    weather.reorder_percent.store(30, Relaxed);

    // Each command is a little faster than the one before: one that is older shows as slower.
    let (mut fastest, mut steps) = (0.0, 0);
    for number in 1..=COMMANDS {
        sender.commander.command[0] = number as f32 / 1000.0;
        sender.speaks();
        let vx = link.view().command[0];
        assert!(vx >= fastest, "{vx} m/s after {fastest} m/s");
        steps += u32::from(vx > fastest);
        fastest = vx;
    }
    let counted = |counter: &std::sync::atomic::AtomicU64| counter.load(Relaxed);
    let (lost, overtaken) = (counted(&weather.lost), counted(&weather.overtaken));
    assert!(lost > 300 && overtaken > 50, "{lost} {overtaken}");
    // Half of them are lost and some are overtaken; what is left moves the robot.
    assert!(steps > 100, "{steps}");

    // The newest gets through, however bad the weather, and so does the kill button.
    let end = Instant::now() + PATIENCE;
    sender.commander.command[0] = 2.0;
    while link.view().command[0] != 2.0 {
        assert!(Instant::now() < end, "{:?}", link.view());
        sender.speaks();
    }
    sender.commander.kill = true;
    while !link.view().killed {
        assert!(Instant::now() < end, "{:?}", link.view());
        sender.speaks();
    }
    eprintln!(
        "of {COMMANDS} commands {steps} counted; {lost} datagrams were lost, {overtaken} overtaken"
    );
}
