//! How many connections are served at once, altogether and from one host. Further ones are closed at once: whoever waits in a queue
//! holds a place there too.

use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio_stream::Stream;
use tonic::transport::server::{Connected, TcpConnectInfo};

/// Connections altogether, unless told otherwise. Each costs some tens of kilobytes and a file handle.
pub const CONNECTIONS_MAX: usize = 2048;
/// Connections from one other host, unless told otherwise. Too small: actors of a cluster node behind one address are shut out; too
/// large: one host can take all places.
pub const PEER_CONNECTIONS_MAX: usize = 256;

/// See [`CONNECTIONS_MAX`] and [`PEER_CONNECTIONS_MAX`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Altogether.
    pub total: usize,
    /// From one host; this host itself is not counted.
    pub per_peer: usize,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self {
            total: CONNECTIONS_MAX,
            per_peer: PEER_CONNECTIONS_MAX,
        }
    }
}

#[derive(Debug, Default)]
struct Counts {
    total: usize,
    peers: BTreeMap<IpAddr, usize>,
}

/// A place among the connections; given back when dropped.
#[derive(Debug)]
struct Place {
    counts: Arc<Mutex<Counts>>,
    peer: IpAddr,
}

impl Place {
    fn take(counts: &Arc<Mutex<Counts>>, peer: IpAddr, limits: ConnectionLimits) -> Option<Self> {
        let mut held = counts.lock().unwrap_or_else(PoisonError::into_inner);
        let of_peer = held.peers.get(&peer).copied().unwrap_or(0);
        if held.total >= limits.total || (!peer.is_loopback() && of_peer >= limits.per_peer) {
            return None;
        }
        held.total += 1;
        held.peers.insert(peer, of_peer + 1);
        drop(held);
        let counts = Arc::clone(counts);
        Some(Self { counts, peer })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut held = self.counts.lock().unwrap_or_else(PoisonError::into_inner);
        held.total -= 1;
        let left = held.peers.get(&self.peer).copied().unwrap_or(1) - 1;
        match left {
            0 => held.peers.remove(&self.peer),
            left => held.peers.insert(self.peer, left),
        };
    }
}

/// The connections that come in and have a place.
#[derive(Debug)]
pub struct Incoming {
    listener: TcpListener,
    limits: ConnectionLimits,
    counts: Arc<Mutex<Counts>>,
}

impl Incoming {
    pub fn new(listener: TcpListener, limits: ConnectionLimits) -> Self {
        Self {
            listener,
            limits,
            counts: Arc::default(),
        }
    }
}

impl Stream for Incoming {
    type Item = io::Result<Connection>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        loop {
            let (stream, peer) = match self.listener.poll_accept(context) {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Err(error)) => return Poll::Ready(Some(Err(error))),
                Poll::Ready(Ok(accepted)) => accepted,
            };
            match Place::take(&self.counts, peer.ip(), self.limits) {
                Some(place) => {
                    // Small messages that somebody waits for.
                    let _ = stream.set_nodelay(true);
                    return Poll::Ready(Some(Ok(Connection {
                        stream,
                        _place: place,
                    })));
                }
                None => tracing::warn!(%peer, "too many connections, closed"),
            }
        }
    }
}

/// A connection and its place.
#[derive(Debug)]
pub struct Connection {
    stream: TcpStream,
    _place: Place,
}

impl Connected for Connection {
    type ConnectInfo = TcpConnectInfo;

    fn connect_info(&self) -> TcpConnectInfo {
        self.stream.connect_info()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.get_mut().stream).poll_write(context, bytes)
    }

    fn poll_flush(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(context)
    }

    fn poll_shutdown(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_counted_per_host_and_given_back() {
        let counts = Arc::default();
        let limits = ConnectionLimits {
            total: 3,
            per_peer: 2,
        };
        let host = |last| IpAddr::from([10, 0, 0, last]);
        let take = |peer| Place::take(&counts, peer, limits);
        let (a, b) = (take(host(1)).unwrap(), take(host(1)).unwrap());
        assert!(take(host(1)).is_none(), "two per host");
        let c = take(host(2)).unwrap();
        assert!(take(host(3)).is_none(), "three altogether");
        drop(a);
        assert!(take(host(3)).is_some());
        drop((b, c));
        let here = IpAddr::from([127, 0, 0, 1]);
        let mine = [take(here), take(here), take(here)];
        assert!(
            mine.iter().all(Option::is_some),
            "only the total counts here"
        );
        drop(mine);
        assert_eq!(counts.lock().unwrap().total, 0);
        assert!(counts.lock().unwrap().peers.is_empty());
    }
}
