//! A connection between a robot and its server that can be cut, that takes its time, and that lies.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Pieces on their way in one direction; a sender that is faster waits.
const PIECES_MAX: usize = 64;

/// Bytes on their way to the server, and what arrives instead.
type Lie = Arc<Mutex<(Vec<u8>, Vec<u8>)>>;

/// Carries bytes to a server, late, unless it is cut.
pub struct Wire {
    /// Where to connect to instead of to the server.
    pub address: SocketAddr,
    cut: Arc<AtomicBool>,
    delay_ms: Arc<AtomicU64>,
    lie: Lie,
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Wire {
    /// A wire to the server at `to`; its threads end with the test process.
    #[must_use]
    pub fn to(to: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let wire = Self {
            address: listener.local_addr().unwrap(),
            cut: Arc::default(),
            delay_ms: Arc::default(),
            lie: Arc::default(),
            open: Arc::default(),
        };
        let (cut, delay_ms, open) = (wire.cut.clone(), wire.delay_ms.clone(), wire.open.clone());
        let lie = wire.lie.clone();
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                if cut.load(Ordering::SeqCst) {
                    continue;
                }
                let Ok(server) = TcpStream::connect(to) else {
                    continue;
                };
                let twin = |stream: &TcpStream| stream.try_clone().unwrap();
                carry(twin(&client), twin(&server), delay_ms.clone(), lie.clone());
                carry(twin(&server), twin(&client), delay_ms.clone(), Lie::default());
                open.lock().unwrap().extend([client, server]);
            }
        });
        wire
    }

    /// Ends every connection, and takes no other until it is mended.
    pub fn cut(&self) {
        self.cut.store(true, Ordering::SeqCst);
        for stream in self.open.lock().unwrap().drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Takes connections again.
    pub fn mend(&self) {
        self.cut.store(false, Ordering::SeqCst);
    }

    /// From now on these bytes arrive at the server in place of those, which are as many.
    pub fn put_for(&self, those: &[u8], these: &[u8]) {
        assert_eq!(those.len(), these.len(), "lengths are part of a message");
        *self.lie.lock().unwrap() = (those.to_vec(), these.to_vec());
    }

    /// From now on bytes take so long, each way.
    pub fn set_delay_ms(&self, delay_ms: u64) {
        self.delay_ms.store(delay_ms, Ordering::SeqCst);
    }
}

/// Carries what comes from `from` to `into` until either hangs up.
fn carry(mut from: TcpStream, mut into: TcpStream, delay_ms: Arc<AtomicU64>, lie: Lie) {
    let (sender, due) = sync_channel::<(Instant, Vec<u8>)>(PIECES_MAX);
    std::thread::spawn(move || {
        for (at, bytes) in due {
            std::thread::sleep(at.saturating_duration_since(Instant::now()));
            if into.write_all(&bytes).is_err() {
                break;
            }
        }
        let _ = into.shutdown(Shutdown::Both);
    });
    std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        while let Ok(n @ 1..) = from.read(&mut bytes) {
            let (those, these) = lie.lock().unwrap().clone();
            // What is cut in two by the end of a piece gets through: messages of calls are small.
            let found = (0..n).filter(|at| !those.is_empty() && bytes[*at..n].starts_with(&those));
            for at in found.collect::<Vec<_>>() {
                bytes[at..at + these.len()].copy_from_slice(&these);
            }
            let delay = Duration::from_millis(delay_ms.load(Ordering::SeqCst));
            if sender.send((Instant::now() + delay, bytes[..n].to_vec())).is_err() {
                break;
            }
        }
    });
}
