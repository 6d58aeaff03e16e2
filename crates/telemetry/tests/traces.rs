//! The exporter against a collector of a few lines, and without one.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use caudata_proto::TraceContext;
use caudata_proto::wire::otlp as wire;
use caudata_proto::wire::otlp::trace_service_server::{TraceService, TraceServiceServer};
use caudata_telemetry::Metrics;
use caudata_telemetry::traces::{Kind, QUEUE_MAX, Span, TraceError, TraceSettings, Tracer};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status};

/// Keeps what it is sent.
#[derive(Clone, Default)]
struct Collector {
    requests: Arc<Mutex<Vec<wire::ExportTraceServiceRequest>>>,
}

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<wire::ExportTraceServiceRequest>,
    ) -> Result<Response<wire::ExportTraceServiceResponse>, Status> {
        self.requests.lock().unwrap().push(request.into_inner());
        Ok(Response::new(wire::ExportTraceServiceResponse::default()))
    }
}

impl Collector {
    /// Serves until the test process ends.
    fn start(&self) -> SocketAddr {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let address = listener.local_addr().unwrap();
        let service = TraceServiceServer::new(self.clone());
        std::thread::spawn(move || {
            let runtime =
                tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                let listener = tokio::net::TcpListener::from_std(listener).unwrap();
                tonic::transport::Server::builder()
                    .add_service(service)
                    .serve_with_incoming(TcpListenerStream::new(listener))
                    .await
                    .unwrap();
            });
        });
        address
    }
}

fn settings(endpoint: String) -> TraceSettings {
    TraceSettings {
        endpoint,
        every: 2,
        tls_dir: None,
        service: "caudata-test",
        instance: "test 1".into(),
        run_id: "run".into(),
    }
}

fn root() -> TraceContext {
    TraceContext::of_policy(&std::array::from_fn(|i| i as u8))
}

fn span(tracer: &Tracer) -> Span {
    Span {
        name: "something",
        kind: Kind::Producer,
        context: tracer.child_of(root()),
        parent: Some(root().span),
        time_ns: [1, 2],
        attributes: vec![("chunk.bytes", 3_u64.into()), ("chunk.age_s", 0.5.into())],
        links: vec![root()],
    }
}

fn counter(metrics: &Metrics, name: &str) -> u64 {
    let page = metrics.encode();
    let line = page.lines().find_map(|line| line.strip_prefix(name));
    line.unwrap().trim().parse().unwrap()
}

const EXPORTED: &str = "caudata_trace_spans_exported_total ";
const DROPPED: &str = "caudata_trace_spans_dropped_total ";

#[test]
fn what_is_recorded_arrives_whole_even_at_the_end() {
    let collector = Collector::default();
    let endpoint = format!("http://{}", collector.start());
    let metrics = Metrics::new();
    let tracer = Tracer::start(&settings(endpoint), &metrics).unwrap();
    let sent: Vec<Span> = (0..700).map(|_| span(&tracer)).collect();
    sent.iter().cloned().for_each(|span| tracer.record(span));
    // The last handle goes: what waits is still exported.
    drop(tracer);
    assert_eq!([counter(&metrics, EXPORTED), counter(&metrics, DROPPED)], [700, 0]);
    let requests = collector.requests.lock().unwrap();
    let resource = requests[0].resource_spans[0].resource.clone().unwrap();
    let named = |key: &str| {
        let found = resource.attributes.iter().find(|pair| pair.key == key);
        found.unwrap().value.clone().unwrap().value.unwrap()
    };
    use wire::any_value::Value;
    assert_eq!(named("service.name"), Value::StringValue("caudata-test".into()));
    let got: Vec<wire::Span> = requests
        .iter()
        .flat_map(|request| request.resource_spans[0].scope_spans[0].spans.clone())
        .collect();
    assert_eq!(got.len(), 700);
    for (got, sent) in got.iter().zip(&sent) {
        // The trace is the first 16 bytes of the hash, its root the next 8.
        assert_eq!(got.trace_id, (0..16).collect::<Vec<u8>>());
        assert_eq!(got.parent_span_id, (16..24).collect::<Vec<u8>>());
        assert_eq!(got.span_id, sent.context.span);
        assert_eq!((got.start_time_unix_nano, got.end_time_unix_nano), (1, 2));
        assert_eq!(got.links[0].span_id, root().span);
    }
    let mut ids: Vec<_> = got.iter().map(|span| span.span_id.clone()).collect();
    ids.sort();
    ids.dedup();
    assert_eq!(ids.len(), 700, "each span has an identifier of its own");
}

/// Nobody listens: recording costs nothing and never waits, memory is bounded, everything is counted.
#[test]
fn without_a_collector_everything_is_dropped_and_counted() {
    let nobody = {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.local_addr().unwrap()
    };
    let metrics = Metrics::new();
    let tracer = Tracer::start(&settings(format!("http://{nobody}")), &metrics).unwrap();
    let count = 3 * QUEUE_MAX as u64;
    for _ in 0..count {
        tracer.record(span(&tracer));
    }
    assert!(counter(&metrics, DROPPED) >= count - QUEUE_MAX as u64 - 1024);
    drop(tracer);
    assert_eq!([counter(&metrics, EXPORTED), counter(&metrics, DROPPED)], [0, count]);
}

/// A collector that accepts the connection and says nothing holds up neither recording nor, for longer than
/// one request, the end.
#[test]
fn a_collector_that_hangs_holds_nobody_up() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("http://{}", silent.local_addr().unwrap());
    let metrics = Metrics::new();
    let tracer = Tracer::start(&settings(endpoint), &metrics).unwrap();
    let began = Instant::now();
    (0..100).for_each(|_| tracer.record(span(&tracer)));
    let recorded = began.elapsed();
    drop(tracer);
    assert_eq!(counter(&metrics, DROPPED), 100);
    // Recording did not wait for the request, which took its time-out.
    assert!(began.elapsed() > Duration::from_secs(1) && recorded < began.elapsed() / 2);
}

#[test]
fn only_some_versions_are_traced_and_none_without_an_endpoint() {
    let metrics = Metrics::new();
    let tracer = Tracer::start(&settings("http://127.0.0.1:1".into()), &metrics).unwrap();
    assert_eq!([0, 1, 2, 3].map(|v| tracer.is_traced(v)), [true, false, true, false]);
    assert!(!Tracer::off().is_traced(0));
    for bad in ["127.0.0.1:4317", "ftp://127.0.0.1:1", "http://a b"] {
        let error = Tracer::start(&settings(bad.into()), &Metrics::new()).unwrap_err();
        assert!(matches!(error, TraceError::Endpoint { .. }), "{bad}: {error}");
    }
    let error = Tracer::start(&settings("https://h:1".into()), &Metrics::new()).unwrap_err();
    assert!(error.to_string().contains("cluster.tls_dir"), "{error}");
}
