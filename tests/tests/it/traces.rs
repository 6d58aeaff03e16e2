//! One trace from a simulator step to the next policy version, across real processes, as a collector sees it.

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpListener};
use std::sync::{Arc, Mutex};

use caudata_proto::wire::otlp as wire;
use caudata_proto::wire::otlp::trace_service_server::{TraceService, TraceServiceServer};
use caudata_tests::{finish, train};
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status};

const ITERATIONS: u64 = 6;

/// A span, and the program that it is from.
type Seen = (String, wire::Span);

/// Keeps what it is sent.
#[derive(Clone, Default)]
struct Collector {
    spans: Arc<Mutex<Vec<Seen>>>,
}

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<wire::ExportTraceServiceRequest>,
    ) -> Result<Response<wire::ExportTraceServiceResponse>, Status> {
        let mut spans = self.spans.lock().unwrap();
        for of_process in request.into_inner().resource_spans {
            let service = text(&of_process.resource.unwrap().attributes, "service.name");
            for scope in of_process.scope_spans {
                spans.extend(scope.spans.into_iter().map(|span| (service.clone(), span)));
            }
        }
        Ok(Response::new(wire::ExportTraceServiceResponse::default()))
    }
}

/// Serves until the test process ends.
fn serve(collector: &Collector) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    listener.set_nonblocking(true).unwrap();
    let address = listener.local_addr().unwrap();
    let service = TraceServiceServer::new(collector.clone());
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
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

fn value(attributes: &[wire::KeyValue], key: &str) -> wire::any_value::Value {
    let found = attributes.iter().find(|pair| pair.key == key);
    let pair = found.unwrap_or_else(|| panic!("no {key} among {attributes:?}"));
    pair.value.clone().unwrap().value.unwrap()
}

fn text(attributes: &[wire::KeyValue], key: &str) -> String {
    match value(attributes, key) {
        wire::any_value::Value::StringValue(text) => text,
        other => panic!("{key}: {other:?}"),
    }
}

fn count(attributes: &[wire::KeyValue], key: &str) -> i64 {
    match value(attributes, key) {
        wire::any_value::Value::IntValue(count) => count,
        other => panic!("{key}: {other:?}"),
    }
}

/// The spans of one policy version's trace.
struct Trace(Vec<Seen>);

impl Trace {
    fn all(&self, name: &str) -> Vec<&Seen> {
        self.0.iter().filter(|(_, span)| span.name == name).collect()
    }

    fn one(&self, name: &str) -> &wire::Span {
        match self.all(name).as_slice() {
            [(_, span)] => span,
            several => panic!("{} spans {name}", several.len()),
        }
    }
}

#[test]
fn one_trace_leads_from_a_simulator_step_to_the_next_policy_version() {
    let collector = Collector::default();
    let endpoint = format!("telemetry.otlp_endpoint=http://{}", serve(&collector));
    let dir = tempfile::tempdir().unwrap();
    let iterations = ITERATIONS.to_string();
    let run = train(
        &dir.path().join("run"),
        &["--transport", "zenoh", "--iterations", &iterations, "--set", &endpoint],
    );
    let finished = finish(run.unwrap()).unwrap();
    assert_eq!(finished.code, Some(0), "{}", finished.stderr);

    let mut traces: BTreeMap<Vec<u8>, Vec<Seen>> = BTreeMap::new();
    for seen in collector.spans.lock().unwrap().drain(..) {
        let trace = seen.1.trace_id.clone();
        traces.entry(trace).or_default().push(seen);
    }
    let by_version: BTreeMap<i64, Trace> = traces
        .into_values()
        .map(Trace)
        .map(|trace| {
            let root = trace.one("policy version");
            (count(&root.attributes, "caudata.policy_version"), trace)
        })
        .collect();
    assert!(by_version.len() as u64 >= ITERATIONS, "{}", by_version.len());
    // The last version is handed to nobody.
    for version in 0..ITERATIONS as i64 - 1 {
        let (trace, next) = (&by_version[&version], &by_version[&(version + 1)]);
        let root = trace.one("policy version");
        assert!(root.parent_span_id.is_empty());
        // Connected: every span hangs below another one of this trace.
        for (_, span) in trace.0.iter().filter(|(_, span)| span.name != root.name) {
            let parent = trace.0.iter().find(|(_, other)| other.span_id == span.parent_span_id);
            assert!(parent.is_some(), "{} of version {version}", span.name);
            assert!(span.start_time_unix_nano <= span.end_time_unix_nano);
        }
        // Two actors, a chunk each: simulator and policy in it, sent by the actor and received by the
        // learner.
        let chunks = trace.all("collect chunk");
        assert_eq!(chunks.len(), 2);
        for (service, chunk) in chunks {
            assert_eq!(service, "caudata-actor");
            assert_eq!(chunk.parent_span_id, root.span_id);
            let part = |name: &str| {
                let parts = trace.all(name);
                let mut of_chunk =
                    parts.into_iter().filter(|(_, span)| span.parent_span_id == chunk.span_id);
                let (service, part) = of_chunk.next().expect(name);
                assert!(of_chunk.next().is_none(), "{name}");
                (service.as_str(), part)
            };
            let (_, step) = part("simulator step");
            assert!(step.start_time_unix_nano >= chunk.start_time_unix_nano);
            assert!(step.end_time_unix_nano <= chunk.end_time_unix_nano);
            assert_eq!(part("policy inference").0, "caudata-actor");
            assert_eq!(part("send chunk").0, "caudata-actor");
            let (service, received) = part("receive chunk");
            assert_eq!(service, "caudata-learner");
            assert!(received.end_time_unix_nano >= chunk.end_time_unix_nano);
            assert_eq!(text(&received.attributes, "caudata.outcome"), "waiting");
            // The batch was learnt from it.
            let batch = trace.one("batch");
            assert!(batch.links.iter().any(|link| link.span_id == chunk.span_id));
        }
        // The batch, what was done with it, and the version that came of it, whose trace follows from that.
        let batch = trace.one("batch");
        assert_eq!(batch.parent_span_id, root.span_id);
        for name in ["update", "export policy", "hand out policy"] {
            assert_eq!(trace.one(name).parent_span_id, batch.span_id, "{name}");
        }
        let handed_out = trace.one("hand out policy");
        let next_root = next.one("policy version");
        assert_eq!(count(&handed_out.attributes, "caudata.policy_version"), version + 1);
        let sha256 = text(&handed_out.attributes, "caudata.policy_sha256");
        let trace_of_it: String =
            next_root.trace_id.iter().map(|byte| format!("{byte:02x}")).collect();
        assert!(sha256.starts_with(&trace_of_it));
        assert_eq!(next_root.links[0].span_id, batch.span_id);
    }
}
