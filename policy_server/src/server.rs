//! Puts the registry, health and reflection services on one port and stops them in order.

use std::net::SocketAddr;
use std::time::Duration;

use caudata_proto::wire::FILE_DESCRIPTOR_SET;
use caudata_proto::wire::registry::policy_registry_server::PolicyRegistryServer;
use caudata_telemetry::incoming;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Server;

use crate::access::GuardLayer;
use crate::metrics::ServerMetrics;
use crate::options::ServeOptions;
use crate::service::RegistryService;
use crate::shared::SharedStore;

/// Requests served at once on one connection; further ones wait.
const STREAMS_PER_CONNECTION: u32 = 32;
/// Largest message accepted; uploads come in pieces of 128 KiB.
const MESSAGE_SIZE_MAX: usize = 256 << 10;
/// Headers of one call at most, bytes.
const HEADERS_MAX: u32 = 8 << 10;
/// Calls that a client may take back before the server has looked at them; beyond that its connection is
/// closed.
const RESETS_MAX: usize = 20;
/// A call that has not begun to be answered by then is given up; streams of answers go on.
const CALL_MAX: Duration = Duration::from_secs(60);

struct AbortOnDrop(tokio::task::JoinHandle<()>);

impl Drop for AbortOnDrop {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// After the stop signal, open requests get this long to finish.
pub const DRAIN_MAX: Duration = Duration::from_secs(10);

/// Why the server ended.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The gRPC server failed.
    #[error("the gRPC server failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The reflection service could not read the descriptors.
    #[error("the service descriptors are not readable: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Binds the address (port 0: any free one).
///
/// # Errors
/// Another process listens there, or the system refuses the address.
pub async fn listen(addr: SocketAddr) -> Result<TcpListener, caudata_telemetry::ServeError> {
    let refused = |source| caudata_telemetry::ServeError::of(addr, source);
    TcpListener::bind(addr).await.map_err(refused)
}

/// Serves until `stop` turns true, then reports NOT_SERVING, refuses new work, and lets open requests finish
/// for [`DRAIN_MAX`].
///
/// # Errors
/// [`ServeError::Transport`], also when the certificates do not work; [`ServeError::Reflection`].
pub async fn serve_with(
    listener: TcpListener,
    store: SharedStore,
    metrics: ServerMetrics,
    stop: watch::Receiver<bool>,
    options: ServeOptions,
) -> Result<(), ServeError> {
    let registry = RegistryService::new(store, stop.clone(), metrics, &options);
    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<PolicyRegistryServer<RegistryService>>().await;
    let reflection = tonic_reflection::server::Builder::configure()
        .register_encoded_file_descriptor_set(FILE_DESCRIPTOR_SET)
        .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
        .build_v1()?;
    let watched = tokio::spawn(watch_over(registry.clone(), health.clone(), options.probe_pause));
    let mut stopped = stop.clone();
    let drained = async move {
        // An error means that the sender is gone, which is a stop as well.
        let _ = stopped.wait_for(|stop| *stop).await;
        health.set_not_serving::<PolicyRegistryServer<RegistryService>>().await;
    };
    let guard = GuardLayer { enforced: options.tls.is_some() };
    let server = Server::builder()
        .layer(guard)
        .concurrency_limit_per_connection(STREAMS_PER_CONNECTION as usize)
        .max_concurrent_streams(STREAMS_PER_CONNECTION)
        .timeout(CALL_MAX)
        .http2_max_header_list_size(HEADERS_MAX)
        .http2_max_pending_accept_reset_streams(Some(RESETS_MAX))
        .http2_keepalive_interval(Some(options.keepalive.interval))
        .http2_keepalive_timeout(Some(options.keepalive.timeout))
        .add_service(health_service)
        .add_service(reflection)
        .add_service(
            PolicyRegistryServer::new(registry)
                .max_decoding_message_size(MESSAGE_SIZE_MAX)
                .max_encoding_message_size(MESSAGE_SIZE_MAX * 4),
        )
        .serve_with_incoming_shutdown(
            ReceiverStream::new(incoming(listener, options.connections, options.tls)),
            drained,
        );
    // Ends with the server, whichever way that ends.
    let _watched = AbortOnDrop(watched);
    let mut stopping = stop;
    tokio::select! {
        ended = server => Ok(ended?),
        () = async {
            let _ = stopping.wait_for(|stop| *stop).await;
            tokio::time::sleep(DRAIN_MAX).await;
        } => {
            tracing::warn!("open requests did not finish in time and were cut off");
            Ok(())
        }
    }
}

/// Says on the health service whether the store takes changes; while it does not, looks again and again
/// whether it does.
async fn watch_over(
    registry: RegistryService,
    health: tonic_health::server::HealthReporter,
    pause: Duration,
) {
    let mut trouble = registry.trouble();
    loop {
        let is_well = trouble.borrow_and_update().is_none();
        match is_well {
            true => {
                health.set_serving::<PolicyRegistryServer<RegistryService>>().await;
                if trouble.changed().await.is_err() {
                    return;
                }
            }
            false => {
                health.set_not_serving::<PolicyRegistryServer<RegistryService>>().await;
                tokio::time::sleep(pause).await;
                registry.recover().await;
            }
        }
    }
}
