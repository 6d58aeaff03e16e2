//! HTTP for probes and people: one request a connection, each part of it with a time limit, and places that
//! silent connections cannot hold.

use std::collections::VecDeque;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use axum::Router;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::AbortHandle;

/// Connections served at once. One more ends the oldest of the host that has the most: whoever asks is
/// answered at once, and nobody waits behind connections that say nothing.
const CONNECTIONS_MAX: usize = 32;
/// Connections of one host at once; one more ends its oldest.
const PEER_CONNECTIONS_MAX: usize = 8;
/// A request's headers must be there within this time.
const HEADERS_MAX: Duration = Duration::from_secs(5);
/// A connection is over within this time, its answer included.
const CONNECTION_MAX: Duration = Duration::from_secs(20);
/// Pause after the system refused a connection, for instance because the process has no file handle left.
pub const ACCEPT_PAUSE: Duration = Duration::from_millis(200);

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

/// Answers requests to `router` until `ended`.
///
/// # Errors
/// What the system says of the listener.
pub async fn serve_http(
    listener: TcpListener,
    router: Router,
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
                let task = tokio::spawn(answer(stream, peer, router.clone()));
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

async fn answer(stream: TcpStream, peer: SocketAddr, router: Router) {
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS_MAX)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(router));
    match tokio::time::timeout(CONNECTION_MAX, served).await {
        Ok(Ok(())) => {}
        Ok(Err(error)) => tracing::debug!(%peer, %error, "a request was not answered"),
        Err(_) => tracing::debug!(%peer, "a request took too long"),
    }
}
