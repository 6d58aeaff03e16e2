//! Hosts, and a proxy for datagrams with weather between them.

use std::collections::HashMap;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, unshare};

use crate::Dice;

/// Datagrams that may be on their way through the proxy; more are lost, as in a full router.
const DATAGRAMS_MAX: usize = 4096;

type Job = Box<dyn FnOnce() + Send>;

/// A host's network: this machine's own, or a network namespace with nothing in it but a loopback interface.
/// Sockets that are made and processes that are started in it stay in it.
pub struct World {
    /// To the thread that is in the namespace; none for this machine's own network.
    jobs: Option<SyncSender<Job>>,
}

impl World {
    /// This machine's own network.
    #[must_use]
    pub fn ours() -> Self {
        Self { jobs: None }
    }

    /// A namespace of its own. It has no name, so that nothing is left of it when its last process ends.
    ///
    /// # Errors
    /// What this machine refuses: it takes root and the program `ip`.
    pub fn apart() -> Result<Self, String> {
        let (jobs, to_do) = sync_channel::<Job>(1);
        let (tell, told) = sync_channel(1);
        std::thread::spawn(move || {
            // The network of this thread alone.
            let entered = unshare(CloneFlags::CLONE_NEWNET)
                .map_err(|error| format!("no network namespace: {error}"))
                .and_then(|()| link("up"));
            let failed = entered.is_err();
            tell.send(entered).unwrap();
            if !failed {
                to_do.into_iter().for_each(|job| job());
            }
        });
        told.recv().unwrap()?;
        Ok(Self { jobs: Some(jobs) })
    }

    /// Does something there.
    pub fn run<T: Send + 'static>(&self, what: impl FnOnce() -> T + Send + 'static) -> T {
        let Some(jobs) = &self.jobs else {
            return what();
        };
        let (tell, told) = sync_channel(1);
        let job = move || tell.send(what()).unwrap();
        jobs.send(Box::new(job)).unwrap();
        told.recv().unwrap()
    }

    /// Whether it is a namespace of its own.
    #[must_use]
    pub fn is_apart(&self) -> bool {
        self.jobs.is_some()
    }

    /// Takes its only interface down, or up again: what is sent meanwhile is an error, not a silence.
    pub fn set_link(&self, state: &'static str) {
        self.run(move || link(state)).unwrap();
    }

    /// A socket on a free port of `localhost`.
    #[must_use]
    pub fn socket(&self) -> UdpSocket {
        self.run(|| {
            let any = "localhost:0".to_socket_addrs().unwrap().next().unwrap();
            UdpSocket::bind(any).unwrap()
        })
    }
}

fn link(state: &str) -> Result<(), String> {
    let output = Command::new("ip")
        .args(["link", "set", "lo", state])
        .output()
        .map_err(|error| format!("ip: {error}"))?;
    match output.status.success() {
        true => Ok(()),
        false => Err(String::from_utf8_lossy(&output.stderr).into_owned()),
    }
}

/// What the proxy does to datagrams.
#[derive(Default)]
pub struct Weather {
    /// Nothing passes.
    pub cut: AtomicBool,
    /// How many of a hundred are lost.
    pub loss_percent: AtomicU64,
    /// One way, ms.
    pub delay_ms: AtomicU64,
    /// How many of a hundred are overtaken by the next one.
    pub reorder_percent: AtomicU64,
    /// Datagrams that were taken.
    pub passed: AtomicU64,
    /// Datagrams that were not.
    pub lost: AtomicU64,
    /// Datagrams that came after the one that was sent after them.
    pub overtaken: AtomicU64,
}

impl Weather {
    /// From now on nothing is done to datagrams.
    pub fn fair(&self) {
        self.cut.store(false, Ordering::Relaxed);
        self.loss_percent.store(0, Ordering::Relaxed);
        self.delay_ms.store(0, Ordering::Relaxed);
        self.reorder_percent.store(0, Ordering::Relaxed);
    }
}

/// A way for datagrams in one direction: those that survive the weather go out later, in order but for those
/// that the next one overtakes.
fn way(
    weather: Arc<Weather>,
    seed: u64,
    send: impl Fn(&[u8]) + Send + 'static,
) -> impl FnMut(&[u8]) {
    let (sender, due) = sync_channel::<(Instant, Vec<u8>)>(DATAGRAMS_MAX);
    let mut dice = Dice::new(seed);
    let mut order = Dice::new(!seed);
    let sky = Arc::clone(&weather);
    std::thread::spawn(move || {
        let mut held: Option<Vec<u8>> = None;
        for (at, datagram) in due {
            std::thread::sleep(at.saturating_duration_since(Instant::now()));
            let reorder = sky.reorder_percent.load(Ordering::Relaxed);
            if held.is_none() && reorder > 0 && order.below(100) < reorder {
                held = Some(datagram);
                continue;
            }
            send(&datagram);
            if let Some(late) = held.take() {
                sky.overtaken.fetch_add(1, Ordering::Relaxed);
                send(&late);
            }
        }
    });
    move |datagram| {
        let loss = weather.loss_percent.load(Ordering::Relaxed);
        let lost = weather.cut.load(Ordering::Relaxed) || dice.below(100) < loss;
        let delay = Duration::from_millis(weather.delay_ms.load(Ordering::Relaxed));
        let taken = !lost && sender.try_send((Instant::now() + delay, datagram.to_vec())).is_ok();
        let counter = if taken { &weather.passed } else { &weather.lost };
        counter.fetch_add(1, Ordering::Relaxed);
    }
}

/// Hands a datagram of one client on.
type Way = Box<dyn FnMut(&[u8])>;

/// Starts the proxy from a port of `here` to `target` in `there`; its threads end with the test process.
/// Returns its port.
pub fn proxy(here: &World, there: Arc<World>, target: SocketAddr, weather: &Arc<Weather>) -> u16 {
    let near = Arc::new(here.socket());
    let port = near.local_addr().unwrap().port();
    let weather = Arc::clone(weather);
    std::thread::spawn(move || {
        let mut ways: HashMap<SocketAddr, Way> = HashMap::new();
        let mut datagram = vec![0; 1 << 16];
        loop {
            // A datagram for a socket that is gone makes the next call fail.
            let Ok((bytes, from)) = near.recv_from(&mut datagram) else {
                continue;
            };
            let count = ways.len() as u64;
            let way_in = ways.entry(from).or_insert_with(|| {
                let far = Arc::new(there.socket());
                far.connect(target).unwrap();
                let (back, forth, home) = (Arc::clone(&far), Arc::clone(&far), Arc::clone(&near));
                let mut way_out = way(Arc::clone(&weather), 2 * count + 1, move |bytes| {
                    let _ = home.send_to(bytes, from);
                });
                std::thread::spawn(move || {
                    let mut datagram = vec![0; 1 << 16];
                    loop {
                        match back.recv(&mut datagram) {
                            Ok(bytes) => way_out(&datagram[..bytes]),
                            // Nobody listens there just now.
                            Err(_) => std::thread::sleep(Duration::from_millis(1)),
                        }
                    }
                });
                Box::new(way(Arc::clone(&weather), 2 * count + 2, move |bytes| {
                    let _ = forth.send(bytes);
                }))
            });
            way_in(&datagram[..bytes]);
        }
    });
    port
}
