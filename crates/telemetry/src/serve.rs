//! HTTP on a thread of its own: `/metrics` and `/healthz`, and what else a process shows people.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::http::StatusCode;
use axum::http::header::CONTENT_TYPE;
use axum::routing::get;
use tokio::net::TcpListener;
use tokio::sync::oneshot;
use tokio_rustls::TlsAcceptor;

use crate::error::ServeError;
use crate::http::serve_http;
use crate::metrics::Metrics;
use crate::pulse::Pulse;
use crate::stop::StopFlag;
use crate::thread::Joined;

const TEXT_FORMAT: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Answers HTTP requests on a thread of its own until dropped.
#[derive(Debug)]
pub struct HttpServer {
    addr: SocketAddr,
    _shutdown: oneshot::Sender<()>,
    _thread: Joined,
}

impl HttpServer {
    /// Binds `addr` (port 0: any free port) and answers with `router`, within TLS where `tls` is there. `name` is
    /// the thread's.
    ///
    /// # Errors
    /// [`ServeError::InUse`] when the port is taken, [`ServeError::Io`] otherwise.
    pub fn start(
        addr: SocketAddr,
        name: &'static str,
        router: Router,
        tls: Option<TlsAcceptor>,
    ) -> Result<Self, ServeError> {
        let failed = |source| ServeError::of(addr, source);
        let listener = std::net::TcpListener::bind(addr).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let bound = listener.local_addr().map_err(failed)?;
        let runtime =
            tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
        let (_shutdown, ended) = oneshot::channel::<()>();
        let serve = move || {
            let served = runtime.block_on(async {
                let ended = async { _ = ended.await };
                serve_http(TcpListener::from_std(listener)?, router, tls, ended).await
            });
            if let Err(error) = served {
                tracing::warn!(%error, "the endpoint for {name} ended");
            }
        };
        let _thread = Joined::spawn(name, serve).map_err(failed)?;
        Ok(Self { addr: bound, _shutdown, _thread })
    }

    /// The bound address.
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }
}

/// Serves the metrics of a process until dropped.
#[derive(Debug)]
pub struct MetricsServer(HttpServer);

impl MetricsServer {
    /// Binds `addr` (port 0: any free port) and serves `metrics`. `/healthz` answers 200 until `stop` is
    /// raised, then 503, so that a load balancer sees a draining process; `/livez` answers 200 as long as
    /// anything does.
    ///
    /// # Errors
    /// [`ServeError::InUse`] when the port is taken, [`ServeError::Io`] otherwise.
    pub fn start(addr: SocketAddr, metrics: Metrics, stop: StopFlag) -> Result<Self, ServeError> {
        Self::start_with_check(addr, metrics, stop, || None)
    }

    /// As [`MetricsServer::start`]; `/healthz` also answers 503 while `pulse` has been silent for longer than
    /// `limit`, so that whoever watches this process sees a loop that hangs, not only one that has ended.
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
        let hangs = move || (pulse.silent_for() > limit).then(|| "hangs".to_owned());
        Self::start_with_check(addr, metrics, stop, hangs)
    }

    /// As [`MetricsServer::start`]; `/healthz` also answers 503 while `check` says in a line what is wrong.
    ///
    /// # Errors
    /// As [`MetricsServer::start`].
    pub fn start_with_check(
        addr: SocketAddr,
        metrics: Metrics,
        stop: StopFlag,
        check: impl Fn() -> Option<String> + Send + Sync + 'static,
    ) -> Result<Self, ServeError> {
        let router = router(metrics, stop, Arc::new(check));
        let server = HttpServer::start(addr, "metrics", router, None)?;
        tracing::info!(addr = %server.addr(), "metrics at http://{}/metrics", server.addr());
        Ok(Self(server))
    }

    /// The bound address.
    pub fn addr(&self) -> SocketAddr {
        self.0.addr()
    }
}

/// Says what is wrong with a process, in one line; `None`: nothing.
type Check = Arc<dyn Fn() -> Option<String> + Send + Sync>;

fn router(metrics: Metrics, stop: StopFlag, check: Check) -> Router {
    let page = move || {
        let text = metrics.encode();
        async move { ([(CONTENT_TYPE, TEXT_FORMAT)], text) }
    };
    let health = move || {
        let wrong = if stop.is_set() { Some("stopping".to_owned()) } else { check() };
        async move {
            match wrong {
                Some(wrong) => (StatusCode::SERVICE_UNAVAILABLE, format!("{wrong}\n")),
                None => (StatusCode::OK, "ok\n".to_owned()),
            }
        }
    };
    Router::new()
        .route("/metrics", get(page))
        .route("/healthz", get(health))
        .route("/livez", get(|| async { "ok\n" }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ExitCode, Failure};
    use std::io::{Read, Write};

    fn http_get(addr: SocketAddr, path: &str) -> String {
        let mut stream = std::net::TcpStream::connect(addr).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn serves_the_page_and_turns_unhealthy_while_stopping() {
        let metrics = Metrics::new();
        let steps: crate::Counter = metrics.make("caudata_test_steps_total", "Steps");
        steps.inc_by(7);
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
    fn silent_connections_keep_nobody_from_asking() {
        let any = "127.0.0.1:0".parse().unwrap();
        let wrong = || Some("the disk is full".to_owned());
        let stop = StopFlag::new();
        let server = MetricsServer::start_with_check(any, Metrics::new(), stop, wrong).unwrap();
        // More than there are places, some of them in the middle of a header.
        let silent: Vec<_> = (0..64)
            .map(|number| {
                let mut stream = std::net::TcpStream::connect(server.addr()).unwrap();
                if number % 2 == 0 {
                    write!(stream, "GET /healthz HTTP/1.1\r\nHo").unwrap();
                }
                stream
            })
            .collect();
        let begun = std::time::Instant::now();
        let answer = http_get(server.addr(), "/healthz");
        assert!(answer.starts_with("HTTP/1.1 503"), "{answer}");
        assert!(answer.ends_with("the disk is full\n"), "{answer}");
        assert!(http_get(server.addr(), "/livez").starts_with("HTTP/1.1 200"));
        assert!(begun.elapsed() < Duration::from_secs(60));
        // The oldest was ended for it.
        let mut first = silent.into_iter().next().unwrap();
        let mut rest = Vec::new();
        let _ = first.read_to_end(&mut rest);
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
