//! zenoh's settings, every one that matters written out: no scouting, no defaults without a bound.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, ToSocketAddrs, UdpSocket};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use zenoh::{Config, Session, Wait};

use super::access;
use super::keys::PIECE_BYTES;
use crate::{Limits, TlsFiles, TransportError, ZenohConfig};

/// Connections that may exist besides one per actor: actors that are being replaced.
const SPARE_SESSIONS: usize = 16;
/// First and longest pause between attempts to reach the other side again, ms.
const RETRY_MS: (u32, u32) = (100, 1_000);
/// Shortest lease, ms: a host that is merely busy is not taken for dead.
const MIN_LEASE_MS: u64 = 3_000;
/// Longest wait for a session to close.
const CLOSE_WAIT: Duration = Duration::from_secs(2);
/// Ports tried when another process takes the one that the system had offered.
const PORT_ATTEMPTS: usize = 8;

/// Does something that waits for zenoh on a thread of its own: zenoh panics when asked to wait on a thread
/// that drives a single-threaded tokio runtime, and a caller may be one.
pub(super) fn aside<T: Send>(body: impl FnOnce() -> T + Send) -> Result<T, TransportError> {
    let result = std::thread::scope(|scope| scope.spawn(body).join());
    result.map_err(|_| TransportError::Backend("zenoh panicked".to_owned()))
}

/// Closes a session, waiting for at most [`CLOSE_WAIT`]; zenoh itself would wait 10 s for another side that
/// stands still. Takes the session, because dropping the last handle waits as well.
pub(super) fn close(session: Session) {
    let (done, closed) = mpsc::sync_channel(1);
    let body = move || {
        let result = session.close().wait().map_err(|error| error.to_string());
        drop(session);
        // Nobody listens any more when it took too long.
        let _ = done.send(result);
    };
    if !spawn_closing(body) {
        return;
    }
    match closed.recv_timeout(CLOSE_WAIT) {
        Ok(Ok(())) => {}
        other => tracing::debug!(?other, "closing the zenoh session"),
    }
}

/// Closes a session that another one has taken the place of, without waiting. `count` is held until it is
/// closed.
pub(super) fn close_in_background(session: Session, count: Arc<()>) {
    let body = move || {
        if let Err(error) = session.close().wait() {
            tracing::debug!(%error, "closing a zenoh session that nobody answered on");
        }
        drop(session);
        drop(count);
    };
    spawn_closing(body);
}

fn spawn_closing(body: impl FnOnce() + Send + 'static) -> bool {
    let thread = std::thread::Builder::new().name("caudata-close".to_owned());
    match thread.spawn(body) {
        Ok(_) => true,
        Err(error) => {
            tracing::debug!(%error, "no thread to close the zenoh session on");
            false
        }
    }
}

/// Opens the learner's session. Returns it with the endpoints that actors connect to.
pub(super) fn open_learner(config: &ZenohConfig) -> Result<(Session, Vec<String>), TransportError> {
    if config.listen.is_empty() {
        if config.connect.is_empty() {
            return Err(TransportError::Config(
                "zenoh.listen and zenoh.connect are both empty".to_owned(),
            ));
        }
        let session = open("client", &[], &config.connect, config)?;
        return Ok((session, config.connect.clone()));
    }
    let mut attempt = 1;
    loop {
        let listen = with_ports(&config.listen)?;
        match open("peer", &listen, &config.connect, config) {
            Ok(session) if config.connect.is_empty() => return Ok((session, reachable(&listen))),
            Ok(session) => return Ok((session, config.connect.clone())),
            // Somebody else took the port between our asking for one and zenoh's binding it.
            Err(_) if listen != config.listen && attempt < PORT_ATTEMPTS => attempt += 1,
            Err(error) => return Err(error),
        }
    }
}

/// Where an actor with this configuration connects: `connect`, else what a learner with it listens on.
pub(super) fn actor_endpoints(config: &ZenohConfig) -> Result<Vec<String>, TransportError> {
    if !config.connect.is_empty() {
        return Ok(config.connect.clone());
    }
    if config.listen.is_empty() || config.listen.iter().any(|e| e.ends_with(":0")) {
        return Err(TransportError::Config(
            "an actor needs zenoh.connect: the learner's or a router's address".to_owned(),
        ));
    }
    Ok(reachable(&config.listen))
}

/// Opens a session; a client fails when nobody answers. Once open it reconnects by itself.
pub(super) fn open(
    mode: &str,
    listen: &[String],
    connect: &[String],
    config: &ZenohConfig,
) -> Result<Session, TransportError> {
    let tls = config.tls.as_ref();
    access::check_endpoints(listen, tls)?;
    access::check_endpoints(connect, tls)?;
    let endpoints = || [listen, connect].concat().join(", ");
    let failed = |error: zenoh::Error| TransportError::Endpoint {
        endpoint: endpoints(),
        reason: error.to_string(),
    };
    let config = settings(mode, listen, connect, &config.limits, tls).map_err(failed)?;
    zenoh::open(config).wait().map_err(failed)
}

fn settings(
    mode: &str,
    listen: &[String],
    connect: &[String],
    limits: &Limits,
    tls: Option<&TlsFiles>,
) -> Result<Config, zenoh::Error> {
    let list = |endpoints: &[String]| {
        let endpoints: Vec<String> = endpoints.iter().map(|e| single_stream(e)).collect();
        format!("{endpoints:?}")
    };
    let lease_ms = limits.peer_timeout_ms.max(MIN_LEASE_MS);
    let (retry_first_ms, retry_longest_ms) = RETRY_MS;
    // A client opens at once or fails, so that the caller can report it and try again; a learner that listens
    // and connects to a router keeps trying in the background.
    let connect_timeout_ms = if mode == "client" { 0 } else { -1 };
    // Head, key and zenoh's own fields are far below the slack.
    let message = limits.max_frame_bytes.max(PIECE_BYTES) + (64 << 10);
    let settings = [
        ("mode", format!("{mode:?}")),
        ("listen/endpoints", list(listen)),
        ("listen/timeout_ms", "0".to_owned()),
        ("listen/exit_on_failure", "true".to_owned()),
        ("connect/endpoints", list(connect)),
        ("connect/timeout_ms", connect_timeout_ms.to_string()),
        ("connect/exit_on_failure", (mode == "client").to_string()),
        (
            "connect/retry",
            format!(
                "{{ period_init_ms: {retry_first_ms}, period_max_ms: {retry_longest_ms}, period_increase_factor: 2 }}"
            ),
        ),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        ("adminspace/enabled", "false".to_owned()),
        ("transport/unicast/max_sessions", (limits.max_actors + SPARE_SESSIONS).to_string()),
        ("transport/unicast/open_timeout", limits.peer_timeout_ms.to_string()),
        ("transport/unicast/accept_timeout", limits.peer_timeout_ms.to_string()),
        ("transport/link/tx/lease", lease_ms.to_string()),
        (
            "transport/link/tx/queue/congestion_control/block/wait_before_close",
            (limits.peer_timeout_ms * 1_000).to_string(),
        ),
        ("transport/link/rx/max_message_size", message.to_string()),
    ];
    let mut config = Config::default();
    for (key, value) in settings {
        config.insert_json5(key, &value)?;
    }
    if let Some(tls) = tls {
        access::insert(&mut config, tls)?;
    }
    Ok(config)
}

/// A QUIC endpoint with one stream for everything. With zenoh's default of one per priority a message can
/// overtake the declaration of its key, and is then lost.
fn single_stream(endpoint: &str) -> String {
    match endpoint.starts_with("quic/") && !endpoint.contains('?') {
        true => format!("{endpoint}?multistream=0"),
        false => endpoint.to_owned(),
    }
}

/// The endpoints with every port 0 replaced by a free port, so that it is known before anyone connects.
fn with_ports(endpoints: &[String]) -> Result<Vec<String>, TransportError> {
    endpoints.iter().map(|e| with_port(e)).collect()
}

fn with_port(endpoint: &str) -> Result<String, TransportError> {
    let Some((scheme, address)) = endpoint.split_once('/') else { return Ok(endpoint.to_owned()) };
    if !address.ends_with(":0") {
        return Ok(endpoint.to_owned());
    }
    let failed = |error: std::io::Error| TransportError::Endpoint {
        endpoint: endpoint.to_owned(),
        reason: error.to_string(),
    };
    let mut addresses = address.to_socket_addrs().map_err(failed)?;
    let first = addresses.next().ok_or_else(|| failed(std::io::Error::other("no address")))?;
    let bound = match scheme {
        "quic" => UdpSocket::bind(first).and_then(|socket| socket.local_addr()),
        _ => TcpListener::bind(first).and_then(|listener| listener.local_addr()),
    };
    // The port alone: a certificate is for a name, not for the address behind it.
    let port = bound.map_err(failed)?.port();
    let host = address.strip_suffix(":0").unwrap_or(address);
    Ok(format!("{scheme}/{host}:{port}"))
}

/// The endpoints as this host can connect to them: "any address" becomes the loopback address, or with
/// certificates the name `localhost`, which the certificate then has to have.
fn reachable(endpoints: &[String]) -> Vec<String> {
    endpoints
        .iter()
        .map(|endpoint| {
            let (scheme, address) = endpoint.split_once('/').unwrap_or_default();
            match address.parse::<SocketAddr>().ok() {
                Some(address) if address.ip().is_unspecified() && scheme == "quic" => {
                    format!("quic/localhost:{}", address.port())
                }
                Some(address) if address.ip().is_unspecified() => {
                    let ip = if address.is_ipv4() {
                        Ipv4Addr::LOCALHOST.into()
                    } else {
                        Ipv6Addr::LOCALHOST.into()
                    };
                    format!("tcp/{}", SocketAddr::new(ip, address.port()))
                }
                _ => endpoint.clone(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn port_zero_becomes_a_port_and_other_endpoints_stay() {
        let listen = ["tcp/127.0.0.1:0", "tcp/192.0.2.1:7447"].map(str::to_owned);
        let chosen = with_ports(&listen).unwrap();
        assert_ne!(chosen[0], listen[0]);
        assert!(chosen[0].starts_with("tcp/127.0.0.1:"));
        assert_eq!(chosen[1], listen[1]);
    }

    #[test]
    fn quic_has_one_stream_and_other_endpoints_stay() {
        let one = single_stream("quic/learner:7447");
        assert_eq!(one, "quic/learner:7447?multistream=0");
        assert_eq!(single_stream(&one), one);
        assert_eq!(single_stream("tcp/127.0.0.1:7447"), "tcp/127.0.0.1:7447");
    }

    #[test]
    fn actors_reach_any_address_by_loopback() {
        let listen = ["tcp/0.0.0.0:7447", "tcp/[::]:7448", "quic/node7:7449", "quic/0.0.0.0:1"];
        let reached =
            ["tcp/127.0.0.1:7447", "tcp/[::1]:7448", "quic/node7:7449", "quic/localhost:1"];
        assert_eq!(reachable(&listen.map(str::to_owned)), reached);
    }

    #[test]
    fn an_actor_needs_to_know_where_to_connect() {
        let mut config = ZenohConfig::default();
        assert!(actor_endpoints(&config).is_err());
        config.listen = vec!["tcp/0.0.0.0:7447".to_owned()];
        assert_eq!(actor_endpoints(&config).unwrap(), ["tcp/127.0.0.1:7447"]);
        config.connect = vec!["tcp/router:7447".to_owned()];
        assert_eq!(actor_endpoints(&config).unwrap(), ["tcp/router:7447"]);
    }

    #[test]
    fn every_setting_is_one_that_zenoh_knows() {
        for mode in ["peer", "client"] {
            let listen = ["tcp/127.0.0.1:7447".to_owned()];
            let tls = TlsFiles::in_folder(std::path::Path::new("/etc/caudata/tls"));
            for tls in [None, Some(&tls)] {
                settings(mode, &listen, &listen, &Limits::default(), tls).unwrap();
            }
        }
    }
}
