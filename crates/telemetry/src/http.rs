//! HTTP for probes and people: one request a connection, each part of it with a time limit, and places that
//! silent connections cannot hold.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpListener;
use tokio::sync::Notify;
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;

use crate::incoming::{ConnectionLimits, Incoming, incoming};

/// Connections served at once.
const PLACES: ConnectionLimits = ConnectionLimits { total: 32, per_peer: 8 };
/// A request's headers are there within this time.
const HEADERS_MAX: Duration = Duration::from_secs(5);
/// A connection is over within this time, its answer included, unless [`Connection::keep`] says otherwise.
const CONNECTION_MAX: Duration = Duration::from_secs(20);
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
    let mut connections = incoming(listener, PLACES, tls);
    // Aborted when dropped: an answer in flight may be cut off, since the process is ending.
    let mut answers = JoinSet::new();
    tokio::pin!(ended);
    loop {
        let connection = tokio::select! {
            () = &mut ended => return Ok(()),
            connection = connections.recv() => connection,
        };
        let Some(connection) = connection.transpose()? else { return Ok(()) };
        while answers.try_join_next().is_some() {}
        answers.spawn(answer(connection, router.clone()));
    }
}

async fn answer(incoming: Incoming, router: Router) {
    let Incoming { stream, peer, cut, place } = incoming;
    let peer = peer.host;
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
        () = async { if let Some(cut) = cut { _ = cut.await } } => {
            tracing::debug!(%peer, "a connection gave up its place");
        }
    }
    drop(place);
}
