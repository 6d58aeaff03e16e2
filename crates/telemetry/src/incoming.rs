//! How many connections are served at once, altogether and from one host, and how they come in.
//!
//! Where no place is left, the host that holds most without having made a call gives up its oldest: whoever only
//! holds connections keeps nobody out. Where all of them made calls, the new one is closed at once: whoever waits
//! in a queue holds a place there too.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use caudata_declare::settings;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, oneshot};
use tokio_rustls::TlsAcceptor;
use tonic::transport::server::Connected;

/// Connections altogether, unless told otherwise. Each costs some tens of kilobytes and a file handle.
pub const CONNECTIONS_MAX: usize = 2048;
/// Connections from one other host, unless told otherwise. Too small: actors of a cluster node behind one
/// address are shut out; too large: one host can take all places.
pub const PEER_CONNECTIONS_MAX: usize = 256;
/// File handles that connections leave free, for the store's files and whatever else.
const FILES_RESERVED: u64 = 64;
/// A connection that has not finished its handshake by then is closed.
const HANDSHAKE_MAX: Duration = Duration::from_secs(5);
/// Connections that are ready and wait to be served.
const READY_MAX: usize = 16;
/// Pause after the system refused a connection, for instance because the process has no file handle left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(200);
/// Refused connections are told of once in this time.
const TELL_PAUSE: Duration = Duration::from_secs(1);

settings! {
    /// See [`CONNECTIONS_MAX`] and [`PEER_CONNECTIONS_MAX`].
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub struct ConnectionLimits {
        /// Altogether.
        pub total: usize = CONNECTIONS_MAX,
        /// From one host; this host itself is not counted.
        pub per_peer: usize = PEER_CONNECTIONS_MAX,
    }
}

impl ConnectionLimits {
    /// No more than a process with so many file handles can hold beside its own files.
    pub fn within(self, files: u64) -> Self {
        let room = usize::try_from(files.saturating_sub(FILES_RESERVED)).unwrap_or(usize::MAX);
        let total = self.total.min(room.max(1));
        if total < self.total {
            let wanted = self.total;
            tracing::warn!(
                files,
                wanted,
                total,
                "fewer connections than asked for: raise the limit of open files"
            );
        }
        Self { total, ..self }
    }

    /// Whether one host may have no more.
    pub fn is_full(&self, peer: IpAddr, of_peer: usize) -> bool {
        !peer.is_loopback() && of_peer >= self.per_peer
    }
}

fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Who is at the other end of a connection.
#[derive(Clone, Debug)]
pub struct Peer {
    /// Its host.
    pub host: IpAddr,
    /// The certificate that it showed; none on a plain connection.
    pub certificate: Option<Arc<[u8]>>,
    /// It made a call.
    pub called: Arc<AtomicBool>,
}

/// One place: whose it is, and how to take it away.
#[derive(Debug)]
struct Held {
    peer: Peer,
    _cut: oneshot::Sender<()>,
}

/// The places by age.
#[derive(Debug)]
struct Places {
    limits: ConnectionLimits,
    held: Mutex<(u64, BTreeMap<u64, Held>)>,
}

/// A place among the connections; given back when dropped.
#[derive(Debug)]
pub(crate) struct Place {
    places: Arc<Places>,
    number: u64,
}

impl Places {
    /// A place, and what ends when it is taken away again.
    fn take(self: &Arc<Self>, peer: &Peer) -> Option<(Place, oneshot::Receiver<()>)> {
        let mut held = locked(&self.held);
        let (next, places) = &mut *held;
        let of_peer = places.values().filter(|h| h.peer.host == peer.host).count();
        let peer_is_full = self.limits.is_full(peer.host, of_peer);
        if peer_is_full || places.len() >= self.limits.total {
            let gives_up = |held: &Held| {
                !held.peer.called.load(Ordering::Relaxed)
                    && (!peer_is_full || held.peer.host == peer.host)
            };
            let silent = || places.iter().filter(|(_, held)| gives_up(held));
            let mut of_host: BTreeMap<IpAddr, usize> = BTreeMap::new();
            for (_, held) in silent() {
                *of_host.entry(held.peer.host).or_default() += 1;
            }
            let oldest = silent().min_by_key(|(_, held)| Reverse(of_host[&held.peer.host]));
            let oldest = oldest.map(|(number, _)| *number)?;
            places.remove(&oldest);
        }
        *next += 1;
        let (cut, is_cut) = oneshot::channel();
        let peer = peer.clone();
        places.insert(*next, Held { peer, _cut: cut });
        let place = Place { places: Arc::clone(self), number: *next };
        Some((place, is_cut))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        locked(&self.places.held).1.remove(&self.number);
    }
}

/// The connections that come in, have a place, and finished their handshake where there is one. The listener
/// is closed when the receiver is dropped.
pub fn incoming(
    listener: TcpListener,
    limits: ConnectionLimits,
    tls: Option<TlsAcceptor>,
) -> mpsc::Receiver<io::Result<Incoming>> {
    let (ready, connections) = mpsc::channel(READY_MAX);
    let held = Mutex::default();
    let places = Arc::new(Places { limits, held });
    tokio::spawn(accept(listener, places, tls, ready));
    connections
}

async fn accept(
    listener: TcpListener,
    places: Arc<Places>,
    tls: Option<TlsAcceptor>,
    ready: mpsc::Sender<io::Result<Incoming>>,
) {
    let mut told: Option<Instant> = None;
    loop {
        let accepted = tokio::select! {
            () = ready.closed() => return,
            accepted = listener.accept() => accepted,
        };
        let (stream, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!(%error, "no connection can be taken");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let peer = Peer { host: address.ip(), certificate: None, called: Arc::default() };
        match places.take(&peer) {
            Some((place, cut)) => {
                let (tls, ready) = (tls.clone(), ready.clone());
                tokio::spawn(async move {
                    if let Some(connection) = shake_hands(stream, tls, peer, place, cut).await {
                        let _ = ready.send(Ok(connection)).await;
                    }
                });
            }
            None if told.is_none_or(|then| then.elapsed() > TELL_PAUSE) => {
                tracing::warn!(peer = %address, "too many connections, closed");
                told = Some(Instant::now());
            }
            None => {}
        }
    }
}

async fn shake_hands(
    stream: TcpStream,
    tls: Option<TlsAcceptor>,
    mut peer: Peer,
    place: Place,
    mut cut: oneshot::Receiver<()>,
) -> Option<Incoming> {
    // Small messages that somebody waits for.
    let _ = stream.set_nodelay(true);
    let stream: Box<dyn ByteStream> = match tls {
        None => Box::new(stream),
        Some(tls) => {
            let shaken = tokio::select! {
                _ = &mut cut => return None,
                shaken = tokio::time::timeout(HANDSHAKE_MAX, tls.accept(stream)) => shaken,
            };
            let stream = match shaken {
                Ok(Ok(stream)) => stream,
                Ok(Err(error)) => {
                    tracing::debug!(peer = %peer.host, %error, "no handshake");
                    return None;
                }
                Err(_) => return None,
            };
            let chain = stream.get_ref().1.peer_certificates();
            peer.certificate = chain.and_then(|c| c.first()).map(|own| own.as_ref().into());
            Box::new(stream)
        }
    };
    Some(Incoming { stream, peer, cut: Some(cut), place })
}

/// Bytes both ways. Behind a pointer, so that there is one HTTP server in a program and not two.
pub(crate) trait ByteStream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<T: AsyncRead + AsyncWrite + Send + Unpin> ByteStream for T {}

/// A connection and its place.
pub struct Incoming {
    pub(crate) stream: Box<dyn ByteStream>,
    pub(crate) peer: Peer,
    /// None once the place was taken away.
    pub(crate) cut: Option<oneshot::Receiver<()>>,
    pub(crate) place: Place,
}

impl Incoming {
    /// An error once its place was taken away.
    fn check_place(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if let Some(cut) = &mut self.cut
            && Pin::new(cut).poll(context).is_pending()
        {
            return Ok(());
        }
        self.cut = None;
        Err(io::ErrorKind::ConnectionAborted.into())
    }
}

impl Connected for Incoming {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        self.peer.clone()
    }
}

impl AsyncRead for Incoming {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.check_place(context)?;
        Pin::new(&mut self.stream).poll_read(context, buffer)
    }
}

impl AsyncWrite for Incoming {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(context, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    fn peer(host: IpAddr, called: bool) -> Peer {
        Peer { host, certificate: None, called: Arc::new(called.into()) }
    }

    const LIMITS: ConnectionLimits = ConnectionLimits { total: 3, per_peer: 2 };

    #[test]
    fn places_are_counted_per_host_and_given_back() {
        let held = Mutex::default();
        let places = Arc::new(Places { limits: LIMITS, held });
        let take = |host| places.take(&peer(host, true));
        let (a, b) = (take(host(1)).unwrap(), take(host(1)).unwrap());
        assert!(take(host(1)).is_none(), "two per host");
        let c = take(host(2)).unwrap();
        assert!(take(host(3)).is_none(), "three altogether");
        drop(a);
        assert!(take(host(3)).is_some());
        drop((b, c));
        let here = IpAddr::from([127, 0, 0, 1]);
        let mine = [take(here), take(here), take(here)];
        assert!(mine.iter().all(Option::is_some), "only the total counts here");
        drop(mine);
        assert_eq!(locked(&places.held).1.len(), 0);
    }

    #[test]
    fn who_made_no_call_gives_up_its_place_and_who_did_keeps_it() {
        let held = Mutex::default();
        let places = Arc::new(Places { limits: LIMITS, held });
        let (_busy, mut busy_cut) = places.take(&peer(host(1), true)).unwrap();
        let (_first, mut first_cut) = places.take(&peer(host(1), false)).unwrap();
        let (_other, mut other_cut) = places.take(&peer(host(2), false)).unwrap();
        let _new = places.take(&peer(host(1), true)).unwrap();
        assert!(first_cut.try_recv().is_err_and(|e| e == oneshot::error::TryRecvError::Closed));
        let open = oneshot::error::TryRecvError::Empty;
        assert_eq!(busy_cut.try_recv(), Err(open.clone()));
        assert_eq!(other_cut.try_recv(), Err(open), "not the one of another host");
        assert!(places.take(&peer(host(1), true)).is_none());
        let _third = places.take(&peer(host(3), true)).unwrap();
        assert!(places.take(&peer(host(4), true)).is_none());
    }

    #[test]
    fn the_host_that_has_most_gives_up_its_oldest_and_files_bound_the_places() {
        let limits = ConnectionLimits { total: 4, per_peer: 3 };
        let places = Arc::new(Places { limits, held: Mutex::default() });
        let take = |last| places.take(&peer(host(last), false)).unwrap();
        let (mut alone, mut first) = (take(1), take(2));
        let (_second, _third, _new) = (take(2), take(2), take(3));
        assert!(first.1.try_recv().is_err_and(|e| e == oneshot::error::TryRecvError::Closed));
        assert_eq!(alone.1.try_recv(), Err(oneshot::error::TryRecvError::Empty));
        let limits = ConnectionLimits::default();
        assert_eq!(limits.within(1024).total, 960);
        assert_eq!(limits.within(1 << 16), limits);
        assert_eq!(limits.within(3).total, 1);
    }
}
