//! `/metrics` and `/healthz` over HTTP, on a thread of its own.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::routing::get;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};

use crate::{Metrics, Pulse, StopFlag};

/// Connections served at once; further ones wait in the listen queue of the system.
const CONNECTIONS_MAX: usize = 16;

const TEXT_FORMAT: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Serves the metrics of a process until dropped.
#[derive(Debug)]
pub struct MetricsServer {
    addr: SocketAddr,
    shutdown: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

/// Why the endpoint could not be opened.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Another process listens there.
    #[error("metrics address {0} is in use")]
    InUse(SocketAddr),
    /// The system refuses the address or the thread.
    #[error("cannot serve metrics on {addr}: {source}")]
    Io {
        /// The address asked for.
        addr: SocketAddr,
        /// What the system said.
        source: io::Error,
    },
}

impl MetricsServer {
    /// Binds `addr` (port 0: any free port) and serves `metrics`. `/healthz` answers 200 until `stop` is
    /// raised, then 503, so that a load balancer sees a draining process.
    ///
    /// # Errors
    /// [`ServeError::InUse`] when the port is taken, [`ServeError::Io`] otherwise.
    pub fn start(addr: SocketAddr, metrics: Metrics, stop: StopFlag) -> Result<Self, ServeError> {
        Self::serve(addr, metrics, stop, None)
    }

    /// As [`MetricsServer::start`]; `/healthz` also answers 503 while `pulse` has been silent for longer than `limit`, so that
    /// whoever watches this process sees a loop that hangs, not only one that has ended.
    ///
    /// # Errors
    /// As [`MetricsServer::start`].
    pub fn start_with_pulse(
        addr: SocketAddr,
        metrics: Metrics,
        stop: StopFlag,
        pulse: Pulse,
        limit: Duration,
    ) -> Result<Self, ServeError> {
        Self::serve(addr, metrics, stop, Some((pulse, limit)))
    }

    fn serve(
        addr: SocketAddr,
        metrics: Metrics,
        stop: StopFlag,
        pulse: Option<(Pulse, Duration)>,
    ) -> Result<Self, ServeError> {
        let failed = |source: io::Error| match source.kind() {
            io::ErrorKind::AddrInUse => ServeError::InUse(addr),
            _ => ServeError::Io { addr, source },
        };
        let listener = std::net::TcpListener::bind(addr).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let bound = listener.local_addr().map_err(failed)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(failed)?;
        let (shutdown, ended) = oneshot::channel::<()>();
        let thread = std::thread::Builder::new()
            .name("metrics".into())
            .spawn(move || {
                let served = runtime.block_on(serve(listener, router(metrics, stop, pulse), ended));
                if let Err(error) = served {
                    tracing::warn!(%error, "the metrics endpoint ended");
                }
            })
            .map_err(failed)?;
        tracing::info!(addr = %bound, "metrics at http://{bound}/metrics");
        Ok(Self {
            addr: bound,
            shutdown: Some(shutdown),
            thread: Some(thread),
        })
    }

    /// The bound address.
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        drop(self.shutdown.take());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn router(metrics: Metrics, stop: StopFlag, pulse: Option<(Pulse, Duration)>) -> Router {
    let page = move || {
        let text = metrics.encode();
        async move { ([(CONTENT_TYPE, TEXT_FORMAT)], text) }
    };
    let health = move || {
        let draining = stop.is_set();
        let hangs = pulse
            .as_ref()
            .is_some_and(|(pulse, limit)| pulse.silent_for() > *limit);
        async move {
            if draining {
                (StatusCode::SERVICE_UNAVAILABLE, "stopping\n")
            } else if hangs {
                (StatusCode::SERVICE_UNAVAILABLE, "hangs\n")
            } else {
                (StatusCode::OK, "ok\n")
            }
        }
    };
    Router::new()
        .route("/metrics", get(page))
        .route("/healthz", get(health))
}

async fn serve(
    listener: std::net::TcpListener,
    router: Router,
    ended: oneshot::Receiver<()>,
) -> io::Result<()> {
    let listener = BoundedListener {
        listener: TcpListener::from_std(listener)?,
        permits: Arc::new(Semaphore::new(CONNECTIONS_MAX)),
    };
    tokio::select! {
        result = async { axum::serve(listener, router).await } => result,
        // A page in flight may be cut off: the process is ending.
        _ = ended => Ok(()),
    }
}

/// A listener that holds at most [`CONNECTIONS_MAX`] connections open.
struct BoundedListener {
    listener: TcpListener,
    permits: Arc<Semaphore>,
}

/// A connection and its place among the permitted ones.
struct Connection {
    stream: TcpStream,
    _permit: Option<OwnedSemaphorePermit>,
}

impl axum::serve::Listener for BoundedListener {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        // The semaphore is never closed, so that the permit is always there.
        let permit = Arc::clone(&self.permits).acquire_owned().await.ok();
        let (stream, addr) = axum::serve::Listener::accept(&mut self.listener).await;
        (
            Connection {
                stream,
                _permit: permit,
            },
            addr,
        )
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        self.listener.local_addr()
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Connection {
    fn poll_write(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.get_mut().stream).poll_write(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_flush(cx)
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.get_mut().stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ExitCode, Failure};
    use std::io::{Read, Write};

    fn http_get(addr: SocketAddr, path: &str) -> String {
        let mut stream = std::net::TcpStream::connect(addr).unwrap();
        write!(
            stream,
            "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
        )
        .unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn serves_the_page_and_turns_unhealthy_while_stopping() {
        let metrics = Metrics::new();
        metrics
            .counter("caudata_test_steps_total", "Steps")
            .inc_by(7);
        let stop = StopFlag::new();
        let any = "127.0.0.1:0".parse().unwrap();
        let server = MetricsServer::start(any, metrics, stop.clone()).unwrap();
        assert!(http_get(server.addr(), "/metrics").contains("caudata_test_steps_total 7"));
        assert!(http_get(server.addr(), "/healthz").starts_with("HTTP/1.1 200"));
        stop.request("test");
        assert!(http_get(server.addr(), "/healthz").starts_with("HTTP/1.1 503"));
        assert!(http_get(server.addr(), "/other").starts_with("HTTP/1.1 404"));
    }

    #[test]
    fn a_port_in_use_is_its_own_error_with_exit_code_71() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let addr = taken.local_addr().unwrap();
        let error = MetricsServer::start(addr, Metrics::new(), StopFlag::new()).unwrap_err();
        assert!(matches!(error, ServeError::InUse(a) if a == addr));
        let failure = Failure::from(error);
        assert_eq!(failure.code(), ExitCode::OsResource);
        assert!(failure.hint_text().is_some());
    }
}
