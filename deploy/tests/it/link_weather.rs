//! Fault 28, the command link: datagrams that are lost, late and overtaken by others, between `drive` and the
//! robot.

use std::net::UdpSocket;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

use caudata_chaos_proxy::{Weather, World, proxy};
use caudata_deploy::command_link::{CommandLink, Commander, LinkKey, UdpLink};

/// How long anything is waited for before the test gives up; nothing is asserted about time.
const PATIENCE: Duration = Duration::from_secs(120);
/// How often the sender speaks.
const EVERY: Duration = Duration::from_millis(5);
/// Most commands through bad weather.
const COMMANDS_MAX: u32 = 19_000;
/// Each is so much faster than the one before, m/s; the last of all is slower than [`FASTEST_MPS`].
const STEP_MPS: f32 = 1e-4;
const FASTEST_MPS: f32 = 2.0;

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
    let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&path, private).unwrap();
    let key = LinkKey::read(&path).unwrap();
    let here = World::ours();
    let localhost = here.socket().local_addr().unwrap().ip();
    let mut link = UdpLink::listen((localhost, 0).into(), key.clone(), false).unwrap();
    let weather = Arc::new(Weather::default());
    let port = proxy(&here, Arc::new(World::ours()), link.address(), &weather);
    let socket = here.socket();
    socket.connect(("localhost", port)).unwrap();
    socket.set_nonblocking(true).unwrap();
    let mut sender = Sender { socket, key, commander: Commander::begin() };
    weather.loss_percent.store(50, Relaxed);
    weather.delay_ms.store(40, Relaxed);
    weather.reorder_percent.store(30, Relaxed);

    // Each command is a little faster than the one before: one that is older shows as slower. On until the
    // weather has done what it can do to datagrams, and what was left moved the robot, however slow this
    // machine is.
    let end = Instant::now() + PATIENCE;
    let (mut fastest, mut steps, mut number) = (0.0, 0, 0);
    let happened = || (weather.lost.load(Relaxed), weather.overtaken.load(Relaxed));
    while happened().0 <= 300 || happened().1 <= 50 || steps <= 100 {
        number += 1;
        let so_far = (happened(), steps, number);
        assert!(number < COMMANDS_MAX && Instant::now() < end, "{so_far:?}");
        sender.commander.command[0] = number as f32 * STEP_MPS;
        sender.speaks();
        let vx = link.view().command[0];
        assert!(vx >= fastest, "{vx} m/s after {fastest} m/s");
        steps += u32::from(vx > fastest);
        fastest = vx;
    }
    let (lost, overtaken) = happened();

    // The newest gets through, however bad the weather, and so does the kill button.
    let end = Instant::now() + PATIENCE;
    sender.commander.command[0] = FASTEST_MPS;
    while link.view().command[0] != FASTEST_MPS {
        assert!(Instant::now() < end, "{:?}", link.view());
        sender.speaks();
    }
    sender.commander.kill = true;
    while !link.view().killed {
        assert!(Instant::now() < end, "{:?}", link.view());
        sender.speaks();
    }
    eprintln!(
        "of {number} commands {steps} counted; {lost} datagrams were lost, {overtaken} overtaken"
    );
}
