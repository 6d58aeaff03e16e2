//! A TCP proxy that cuts connections in mid-byte.

use std::io;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// Forwards every connection to one address until it is told to cut.
pub struct Proxy {
    address: SocketAddr,
    open: Arc<Mutex<Vec<TcpStream>>>,
}

impl Proxy {
    /// The accepting thread ends with the test process.
    pub fn to(target: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let open = Arc::<Mutex<Vec<TcpStream>>>::default();
        let streams = Arc::clone(&open);
        std::thread::spawn(move || {
            for near in listener.incoming() {
                let (near, far) = (near.unwrap(), TcpStream::connect(target));
                // Nobody there: the caller sees its connection close.
                let Ok(far) = far else { continue };
                let mut streams = streams.lock().unwrap();
                for (from, to) in [(&near, &far), (&far, &near)] {
                    streams.push(from.try_clone().unwrap());
                    forward(from.try_clone().unwrap(), to.try_clone().unwrap());
                }
            }
        });
        Self { address, open }
    }

    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Cuts every connection wherever it is. Returns whether there was one.
    pub fn cut(&self) -> bool {
        let streams = std::mem::take(&mut *self.open.lock().unwrap());
        // Closed by the other side already is as good.
        let cut = |stream: &TcpStream| stream.shutdown(Shutdown::Both).is_ok();
        streams.iter().filter(|stream| cut(stream)).count() > 0
    }
}

fn forward(mut from: TcpStream, mut to: TcpStream) {
    std::thread::spawn(move || {
        // Ends with either side.
        let _ = io::copy(&mut from, &mut to);
        let _ = to.shutdown(Shutdown::Both);
    });
}
