//! HTTP for probes and people: one request a connection, each part of it with a time limit, and places that
//! silent connections cannot hold.

use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio_rustls::TlsAcceptor;

/// Connections served at once. One more ends the oldest of the host that has the most: whoever asks is
/// answered at once, and nobody waits behind connections that say nothing.
const CONNECTIONS_MAX: usize = 32;
/// Connections of one host at once; one more ends its oldest.
const PEER_CONNECTIONS_MAX: usize = 8;
/// A handshake is over, and after it a request's headers are there, within this time.
const HEADERS_MAX: Duration = Duration::from_secs(5);
/// A connection is over within this time, its answer included, unless [`Connection::keep`] says otherwise.
const CONNECTION_MAX: Duration = Duration::from_secs(20);
/// Pause after the system refused a connection, for instance because the process has no file handle left.
pub const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

/// The connection that a request came by: an extension of every request.
#[derive(Clone, Debug, Default)]
pub struct Connection(Arc<Limit>);

#[derive(Debug, Default)]
struct Limit {
    kept: AtomicBool,
    cut: Notify,
}

impl Connection {
    /// The answer is a stream without end, and has no time limit. Whoever writes it ends connections whose
    /// reader does not keep up.
    pub fn keep(&self) {
        self.0.kept.store(true, Ordering::Relaxed);
    }

    /// Ends it at once, whatever it is about to write.
    pub fn cut(&self) {
        self.0.cut.notify_one();
    }

    /// Until its time is up, or it is cut.
    async fn over(&self) {
        tokio::select! {
            () = self.0.cut.notified() => return,
            () = tokio::time::sleep(CONNECTION_MAX) => {}
        }
        if self.0.kept.load(Ordering::Relaxed) {
            self.0.cut.notified().await;
        }
    }
}

/// Connections at present, the oldest first.
#[derive(Default)]
struct Places(VecDeque<(IpAddr, AbortHandle)>);

impl Places {
    /// Makes room for one more of `peer`.
    fn free_one(&mut self, peer: IpAddr) {
        self.0.retain(|(_, task)| !task.is_finished());
        let of = |host: &IpAddr| self.0.iter().filter(|(other, _)| other == host).count();
        let crowded = match of(&peer) {
            many if many >= PEER_CONNECTIONS_MAX => Some(peer),
            _ if self.0.len() < CONNECTIONS_MAX => None,
            _ => self.0.iter().map(|(host, _)| *host).max_by_key(of),
        };
        let oldest = crowded.and_then(|host| self.0.iter().position(|(other, _)| *other == host));
        if let Some((_, task)) = oldest.and_then(|at| self.0.remove(at)) {
            task.abort();
        }
    }
}

/// Answers requests to `router` until `ended`, within TLS where there is an acceptor.
///
/// # Errors
/// What the system says of the listener.
pub async fn serve_http(
    listener: TcpListener,
    router: Router,
    tls: Option<TlsAcceptor>,
    ended: impl Future<Output = ()>,
) -> io::Result<()> {
    let mut places = Places::default();
    tokio::pin!(ended);
    loop {
        let accepted = tokio::select! {
            // An answer in flight may be cut off: the process is ending.
            () = &mut ended => break,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok((stream, peer)) => {
                places.free_one(peer.ip());
                let task = tokio::spawn(shake_hands(stream, peer, router.clone(), tls.clone()));
                places.0.push_back((peer.ip(), task.abort_handle()));
            }
            Err(error) => {
                tracing::warn!(%error, "no connection can be taken");
                tokio::time::sleep(ACCEPT_PAUSE).await;
            }
        }
    }
    places.0.iter().for_each(|(_, task)| task.abort());
    Ok(())
}

async fn shake_hands(
    stream: TcpStream,
    peer: SocketAddr,
    router: Router,
    tls: Option<TlsAcceptor>,
) {
    let Some(tls) = tls else {
        return answer(Box::new(stream), peer, router).await;
    };
    match tokio::time::timeout(HEADERS_MAX, tls.accept(stream)).await {
        Ok(Ok(stream)) => answer(Box::new(stream), peer, router).await,
        Ok(Err(error)) => tracing::debug!(%peer, %error, "no handshake"),
        Err(_) => tracing::debug!(%peer, "a handshake took too long"),
    }
}

/// Bytes both ways. Behind a pointer, so that there is one HTTP server in a program and not two.
trait Bytes: AsyncRead + AsyncWrite + Unpin + Send {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send> Bytes for T {}

async fn answer(stream: Box<dyn Bytes>, peer: SocketAddr, router: Router) {
    let connection = Connection::default();
    let router = router.layer(Extension(connection.clone()));
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS_MAX)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    tokio::select! {
        answered = served => {
            if let Err(error) = answered {
                tracing::debug!(%peer, %error, "a request was not answered");
            }
        }
        () = connection.over() => tracing::debug!(%peer, "a connection took too long"),
    }
}
