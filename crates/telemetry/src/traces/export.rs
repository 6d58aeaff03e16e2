//! The queue of spans and the thread that empties it towards the collector.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use caudata_proto::wire::otlp as wire;
use caudata_proto::wire::otlp::trace_service_client::TraceServiceClient;
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};

use super::span::{self, Span, Value};
use crate::metrics::{Counter, Metrics};
use crate::thread::Joined;

/// Spans that may wait. One is about half a kilobyte.
pub const QUEUE_MAX: usize = 4096;
/// Spans of one request.
const REQUEST_MAX: usize = 512;
/// How long the first span of a request waits for others.
const GATHER: Duration = Duration::from_millis(200);
/// How often a pause looks whether the queue is closed.
const SLICE: Duration = Duration::from_millis(50);
/// Longest time for one request, connecting included.
const EXPORT_MAX: Duration = Duration::from_secs(3);
/// Pause after a request that failed; doubles up to [`PAUSE_MAX`].
const PAUSE: Duration = Duration::from_millis(500);
/// Longest pause.
const PAUSE_MAX: Duration = Duration::from_secs(10);

/// What a process needs to know to trace.
#[derive(Clone, Debug)]
pub struct TraceSettings {
    /// `http://host:port` or `https://host:port` of the collector's OTLP/gRPC port.
    pub endpoint: String,
    /// Every so many policy versions one is traced. At least 1.
    pub every: u64,
    /// Folder with `ca.crt`, `tls.crt` and `tls.key`, for `https://`.
    pub tls_dir: Option<PathBuf>,
    /// The program: `caudata-actor`.
    pub service: &'static str,
    /// Which one of them: `actor 3, incarnation 0`.
    pub instance: String,
    /// The training run.
    pub run_id: String,
}

/// Why traces cannot be exported.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum TraceError {
    /// The address is not one.
    #[error("telemetry.otlp_endpoint: `{endpoint}` is not an address like http://127.0.0.1:4317")]
    Endpoint { endpoint: String },
    /// The certificates are not there, or do not work.
    #[error("telemetry.otlp_endpoint: certificates: {0}")]
    Certificates(String),
    /// The system refuses the thread.
    #[error("no thread to export traces on: {0}")]
    Thread(std::io::Error),
}

/// What a process counts about its traces.
#[derive(Clone, Debug)]
struct Counters {
    exported: Counter,
    dropped: Counter,
}

/// The near end of the queue. Dropped, it waits for the thread, which then gives up at the first failure.
#[derive(Debug)]
pub(crate) struct Exporter {
    queue: Sender<Span>,
    counters: Counters,
    /// Ends after at most one request that fails.
    _thread: Joined,
}

impl Exporter {
    pub fn start(settings: &TraceSettings, metrics: &Metrics) -> Result<Self, TraceError> {
        let counters = Counters {
            exported: metrics
                .make("caudata_trace_spans_exported_total", "Spans that the collector took"),
            dropped: metrics.make(
                "caudata_trace_spans_dropped_total",
                "Spans given up because the collector is away, slow, or refuses them",
            ),
        };
        let endpoint = endpoint(settings)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(TraceError::Thread)?;
        let (queue, waiting) = channel(QUEUE_MAX);
        let worker = Worker {
            resource: resource(settings),
            waiting,
            counters: counters.clone(),
            away: false,
        };
        let export = move || {
            runtime.block_on(async {
                // Connects with the first request, and again whenever the connection is lost.
                let client = TraceServiceClient::new(endpoint.connect_lazy());
                worker.run(client).await;
            });
        };
        let _thread = Joined::spawn("traces", export).map_err(TraceError::Thread)?;
        Ok(Self { queue, counters, _thread })
    }

    pub fn offer(&self, span: Span) {
        if self.queue.try_send(span).is_err() {
            self.counters.dropped.inc();
        }
    }
}

struct Worker {
    resource: wire::Resource,
    waiting: Receiver<Span>,
    counters: Counters,
    /// Whether the last request failed.
    away: bool,
}

impl Worker {
    /// Exports until the queue is closed and empty, or closed and the collector away.
    async fn run(mut self, mut client: TraceServiceClient<Channel>) {
        let mut pause = PAUSE;
        let mut spans = Vec::new();
        loop {
            if self.waiting.recv_many(&mut spans, REQUEST_MAX).await == 0 {
                return;
            }
            if spans.len() < REQUEST_MAX {
                self.rest(GATHER).await;
                let room = REQUEST_MAX - spans.len();
                for _ in 0..room {
                    let Ok(span) = self.waiting.try_recv() else { break };
                    spans.push(span);
                }
            }
            if self.export(&mut client, std::mem::take(&mut spans)).await {
                pause = PAUSE;
                continue;
            }
            if self.waiting.is_closed() {
                self.counters.dropped.inc_by(self.waiting.len() as u64);
                return;
            }
            self.rest(pause).await;
            pause = (2 * pause).min(PAUSE_MAX);
        }
    }

    /// Waits, but not once the queue is closed.
    async fn rest(&self, time: Duration) {
        let until = Instant::now() + time;
        while Instant::now() < until && !self.waiting.is_closed() {
            tokio::time::sleep(SLICE).await;
        }
    }

    /// False when the collector did not answer in time, or refused.
    async fn export(&mut self, client: &mut TraceServiceClient<Channel>, spans: Vec<Span>) -> bool {
        let count = spans.len() as u64;
        let request = wire::ExportTraceServiceRequest {
            resource_spans: vec![wire::ResourceSpans {
                resource: Some(self.resource.clone()),
                scope_spans: vec![wire::ScopeSpans {
                    scope: Some(wire::InstrumentationScope {
                        name: "caudata".to_owned(),
                        version: env!("CARGO_PKG_VERSION").to_owned(),
                    }),
                    spans: spans.into_iter().map(span::to_wire).collect(),
                }],
            }],
        };
        let answer = tokio::time::timeout(EXPORT_MAX, client.export(request)).await;
        let problem = match answer {
            Ok(Ok(answer)) => {
                let partial = answer.into_inner().partial_success.unwrap_or_default();
                let rejected = u64::try_from(partial.rejected_spans).unwrap_or(0).min(count);
                self.counters.exported.inc_by(count - rejected);
                self.counters.dropped.inc_by(rejected);
                self.away = false;
                return true;
            }
            Ok(Err(status)) => format!("{:?}: {}", status.code(), status.message()),
            Err(_) => "no answer in time".to_owned(),
        };
        self.counters.dropped.inc_by(count);
        // Once per absence: a collector that is away shall not fill the log.
        if !std::mem::replace(&mut self.away, true) {
            tracing::warn!(problem, "the collector of traces does not take them; they are dropped");
        }
        false
    }
}

fn resource(settings: &TraceSettings) -> wire::Resource {
    wire::Resource {
        attributes: span::attributes([
            ("service.name", Value::from(settings.service)),
            ("service.version", env!("CARGO_PKG_VERSION").into()),
            ("service.instance.id", settings.instance.as_str().into()),
            ("caudata.run_id", settings.run_id.as_str().into()),
        ]),
    }
}

fn endpoint(settings: &TraceSettings) -> Result<Endpoint, TraceError> {
    let bad = || TraceError::Endpoint { endpoint: settings.endpoint.clone() };
    let encrypted = settings.endpoint.starts_with("https://");
    if !encrypted && !settings.endpoint.starts_with("http://") {
        return Err(bad());
    }
    let endpoint = Endpoint::from_shared(settings.endpoint.clone())
        .map_err(|_| bad())?
        .connect_timeout(EXPORT_MAX);
    if !encrypted {
        return Ok(endpoint);
    }
    let folder = settings.tls_dir.as_deref().ok_or_else(|| {
        TraceError::Certificates("https needs a folder of them (cluster.tls_dir)".to_owned())
    })?;
    endpoint
        .tls_config(certificates(folder)?)
        .map_err(|error| TraceError::Certificates(format!("{}: {error}", folder.display())))
}

/// Ours, and the authority that the collector's must be of.
fn certificates(folder: &Path) -> Result<ClientTlsConfig, TraceError> {
    let read = |name: &str| {
        let path = folder.join(name);
        std::fs::read(&path)
            .map_err(|error| TraceError::Certificates(format!("{}: {error}", path.display())))
    };
    Ok(ClientTlsConfig::new()
        .ca_certificate(Certificate::from_pem(read("ca.crt")?))
        .identity(Identity::from_pem(read("tls.crt")?, read("tls.key")?)))
}
