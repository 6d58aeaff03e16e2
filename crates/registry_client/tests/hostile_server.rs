//! Faults 25, 26 and 27: a server that cuts, sends too much, drips, or says nothing. What comes out of a
//! fetch is the file that was asked for, or an error in time; never anything else.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use caudata_proto::registry::{
    Freshness, LabelName, LabelState, Manifest, Overview, QuarantineState, SetLabel, Signature,
    SignedFreshness, StreamName,
};
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::fetch_info::Status as Follows;
use caudata_proto::wire::registry::fetch_response::Part;
use caudata_proto::wire::registry::policy_registry_server::{PolicyRegistry, PolicyRegistryServer};
use caudata_registry_client::{ClientError, Patience, RegistryClient};
use sha2::{Digest, Sha256};
use tokio::runtime::Runtime;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status, Streaming};

/// How the server answers a fetch.
#[derive(Clone, Copy, Debug)]
enum Manner {
    /// The whole rest, in pieces of this many bytes.
    Honest { piece: usize },
    /// The first time, it breaks off before this byte, with an error or (`quietly`) as if that were all.
    Cuts { at: usize, quietly: bool },
    /// So many bytes more than it announced.
    TooMuch { more: usize },
    /// One byte after the other, with a pause.
    Drips { pause: Duration },
    /// It announces the file, and nothing follows.
    Silent,
}

struct Hostile {
    file: Vec<u8>,
    manner: Mutex<Manner>,
    /// Offsets that were asked for.
    asked: Mutex<Vec<u64>>,
    /// Bytes that a client took, or that wait for one.
    sent: Arc<AtomicUsize>,
}

type Answer<T> = Result<Response<T>, Status>;
type Pieces = Pin<Box<dyn Stream<Item = Result<wire::FetchResponse, Status>> + Send>>;

/// Calls that this server does not know.
macro_rules! unknown {
    ($($name:ident: $request:ty => $answer:ty),* $(,)?) => {
        #[tonic::async_trait]
        impl PolicyRegistry for Bridge {
            type FetchStream = Pieces;
            type WatchStream = Pin<Box<dyn Stream<Item = Result<wire::WatchEvent, Status>> + Send>>;

            async fn fetch(&self, request: Request<wire::FetchRequest>) -> Answer<Pieces> {
                Ok(Response::new(self.0.answer(request.into_inner().offset)))
            }
            // Whatever is asked, this server speaks of the stream that it likes best.
            async fn watch(&self, _: Request<wire::WatchRequest>) -> Answer<Self::WatchStream> {
                let event = Some(wire::watch_event::Event::Published(other().into()));
                let event = wire::WatchEvent { generation: 1, event };
                Ok(Response::new(Box::pin(tokio_stream::once(Ok(event)))))
            }
            async fn get_manifest(
                &self,
                _: Request<wire::GetManifestRequest>,
            ) -> Answer<wire::GetManifestResponse> {
                let manifest = Some(other().into());
                Ok(Response::new(wire::GetManifestResponse { manifest, generation: 1 }))
            }
            async fn list(&self, _: Request<wire::ListRequest>) -> Answer<wire::ListResponse> {
                let manifests = vec![other().into()];
                Ok(Response::new(wire::ListResponse { manifests, generation: 1, more: false }))
            }
            async fn set_label(&self, _: Request<wire::SetLabelRequest>) -> Answer<wire::LabelState> {
                Ok(Response::new(label().into()))
            }
            async fn quarantine(
                &self,
                _: Request<wire::QuarantineRequest>,
            ) -> Answer<wire::QuarantineState> {
                Ok(Response::new(quarantined().into()))
            }
            async fn overview(
                &self,
                _: Request<wire::OverviewRequest>,
            ) -> Answer<wire::OverviewResponse> {
                let overview = Overview {
                    labels: vec![label()],
                    quarantined: Vec::new(),
                    reports: Vec::new(),
                    generation: 1,
                    read_only: None,
                };
                Ok(Response::new(overview.into()))
            }
            async fn freshness(
                &self,
                request: Request<wire::FreshnessRequest>,
            ) -> Answer<wire::FreshnessResponse> {
                let other = other();
                let said = Freshness {
                    nonce: request.into_inner().nonce.try_into().unwrap(),
                    stream: other.stream,
                    label: LabelName::latest(),
                    version: other.version,
                    sha256: other.sha256,
                };
                let signature = Signature { key_id: "k".into(), signature: vec![7; 64] };
                let answer = SignedFreshness { said, signature };
                Ok(Response::new(answer.into()))
            }
            $(async fn $name(&self, _: Request<$request>) -> Answer<$answer> {
                Err(Status::unimplemented("not of this server"))
            })*
        }
    };
}

struct Bridge(Arc<Hostile>);

unknown! {
    publish: Streaming<wire::PublishRequest> => wire::PublishResponse,
    revert: wire::RevertRequest => wire::PublishResponse,
    ack: wire::RobotReport => wire::ReportResponse,
    nack: wire::RobotReport => wire::ReportResponse,
    audit: wire::AuditRequest => wire::AuditResponse,
}

fn manifest(stream: &str, version: u64, file: &[u8]) -> Manifest {
    Manifest {
        stream: StreamName::new(stream).unwrap(),
        version,
        sha256: Sha256::digest(file).into(),
        size: file.len() as u64,
        created_unix_ms: 5,
        run_id: "run".into(),
        contract_hash: [2; 32],
        robot_name: "polymander".into(),
        robot_hash: [3; 32],
        env_steps: 9,
        training_commit: String::new(),
        config_hash: String::new(),
        evaluation_json: None,
        reverts_to: None,
        signatures: Vec::new(),
    }
}

fn other() -> Manifest {
    manifest("experimental/rough", 3510, b"rough")
}

fn label() -> LabelState {
    LabelState {
        stream: other().stream,
        label: LabelName::new("canary").unwrap(),
        version: 3510,
        generation: 1,
        by: "somebody".into(),
        override_reason: None,
        unix_ms: 5,
    }
}

fn quarantined() -> QuarantineState {
    QuarantineState {
        stream: other().stream,
        version: 3510,
        reason: "falls".into(),
        by: "somebody".into(),
        generation: 1,
        unix_ms: 5,
    }
}

/// What is sent for one question.
fn script(manner: Manner, rest: &[u8], first: bool) -> Vec<Result<Vec<u8>, Status>> {
    let pieces = |bytes: &[u8], piece: usize| -> Vec<Result<Vec<u8>, Status>> {
        bytes.chunks(piece).map(|p| Ok(p.to_vec())).collect()
    };
    match manner {
        Manner::Honest { piece } => pieces(rest, piece),
        Manner::Cuts { at, quietly } if first => {
            let mut all = pieces(&rest[..at], 1000);
            if !quietly {
                all.push(Err(Status::unavailable("cut")));
            }
            all
        }
        Manner::Cuts { .. } => pieces(rest, 1000),
        Manner::TooMuch { more } => {
            let mut long = rest.to_vec();
            long.resize(rest.len() + more, 7);
            pieces(&long, 1000)
        }
        Manner::Drips { .. } => pieces(rest, 1),
        Manner::Silent => Vec::new(),
    }
}

impl Hostile {
    fn answer(&self, offset: u64) -> Pieces {
        let mut asked = self.asked.lock().unwrap();
        let first = asked.is_empty();
        asked.push(offset);
        drop(asked);
        let manner = *self.manner.lock().unwrap();
        let info = wire::FetchInfo {
            status: Follows::ContentFollows.into(),
            sha256: Sha256::digest(&self.file).to_vec(),
            size: self.file.len() as u64,
            offset,
        };
        let script = script(manner, &self.file[offset as usize..], first);
        let (to, answers) = tokio::sync::mpsc::channel(1);
        let sent = Arc::clone(&self.sent);
        tokio::spawn(async move {
            let part = |part| wire::FetchResponse { part: Some(part) };
            if to.send(Ok(part(Part::Info(info)))).await.is_err() {
                return;
            }
            for piece in script {
                if let Manner::Drips { pause } = manner {
                    tokio::time::sleep(pause).await;
                }
                let length = piece.as_ref().map_or(0, Vec::len);
                if to.send(piece.map(|p| part(Part::Data(p.into())))).await.is_err() {
                    return;
                }
                sent.fetch_add(length, Ordering::SeqCst);
            }
            if matches!(manner, Manner::Silent) {
                to.closed().await;
            }
        });
        Box::pin(ReceiverStream::new(answers))
    }
}

struct Bench {
    runtime: Runtime,
    server: Arc<Hostile>,
    client: RegistryClient,
    manifest: Manifest,
}

impl Bench {
    fn new(patience: Patience) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        // Bytes that differ from their neighbours: one that is missing, doubled or moved shows in the hash.
        let file: Vec<u8> = (0..10_000_u32).map(|i| (i * i / 7 + i) as u8).collect();
        let server = Arc::new(Hostile {
            file: file.clone(),
            manner: Mutex::new(Manner::Silent),
            asked: Mutex::default(),
            sent: Arc::default(),
        });
        let service = PolicyRegistryServer::new(Bridge(Arc::clone(&server)));
        let mut client = runtime.block_on(async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let address = listener.local_addr().unwrap();
            let serving = tonic::transport::Server::builder().add_service(service);
            // Small pieces leave at once: hundreds of fetches would otherwise wait for late acknowledgements.
            let incoming = TcpListenerStream::new(listener).map(|stream| {
                let stream = stream?;
                stream.set_nodelay(true)?;
                Ok::<_, std::io::Error>(stream)
            });
            tokio::spawn(serving.serve_with_incoming(incoming));
            RegistryClient::new(&address.to_string()).unwrap()
        });
        let manifest = manifest("s", 1, &file);
        client.patience = patience;
        Self { runtime, server, client, manifest }
    }

    /// What a fetch comes to, and the offsets that were asked for.
    fn fetch(&mut self, manner: Manner) -> (Result<Vec<u8>, ClientError>, Vec<u64>) {
        *self.server.manner.lock().unwrap() = manner;
        self.server.asked.lock().unwrap().clear();
        self.server.sent.store(0, Ordering::SeqCst);
        let fetched = self.runtime.block_on(self.client.fetch(&self.manifest));
        (fetched, self.server.asked.lock().unwrap().clone())
    }
}

/// Retries at once; otherwise as robots have it.
fn quick() -> Patience {
    Patience { retry_pause: Duration::from_millis(1), ..Patience::default() }
}

#[test]
fn fault_25_a_fetch_that_is_cut_anywhere_goes_on_there_and_is_whole() {
    let mut bench = Bench::new(quick());
    let whole = bench.server.file.clone();
    let (fetched, asked) = bench.fetch(Manner::Honest { piece: 333 });
    assert_eq!((fetched.unwrap(), asked), (whole.clone(), vec![0]));
    // Every boundary of a piece, and a thousand bytes of the file at random, the same ones each time
    // (xorshift64).
    let boundaries = (0..10).map(|piece| 1000 * piece);
    let mut dice = 20_261_122_u64;
    let random = std::iter::repeat_with(|| {
        dice ^= dice << 13;
        dice ^= dice >> 7;
        dice ^= dice << 17;
        (dice % 10_000) as usize
    });
    for at in boundaries.chain(random.take(1000)) {
        for quietly in [false, true] {
            let (fetched, asked) = bench.fetch(Manner::Cuts { at, quietly });
            assert_eq!(fetched.unwrap(), whole, "cut at {at}");
            assert_eq!(asked, [0, at as u64], "it goes on where it was cut");
        }
    }
}

#[test]
fn fault_26_a_server_that_sends_more_than_it_announced_is_stopped() {
    let mut bench = Bench::new(quick());
    for more in [1, 1000, 20_000_000] {
        let (fetched, asked) = bench.fetch(Manner::TooMuch { more });
        let error = fetched.unwrap_err();
        assert!(matches!(error, ClientError::WrongBytes { .. }), "{error}");
        assert!(!error.is_transient());
        assert_eq!(asked, [0], "it is not asked again");
        // Of the 20 MB no more than what sockets hold ever left.
        let sent = bench.server.sent.load(Ordering::SeqCst);
        assert!(sent <= 4 << 20, "{sent} bytes were sent");
    }
}

#[test]
fn fault_27_a_server_that_drips_holds_nobody() {
    let mut bench = Bench::new(Patience { rate_window: Duration::from_millis(300), ..quick() });
    // 10,000 bytes at a hundred a second would take it 100 s.
    let pause = Duration::from_millis(10);
    let (fetched, _) = bench.fetch(Manner::Drips { pause });
    let error = fetched.unwrap_err();
    assert!(matches!(error, ClientError::TooSlow), "{error}");
    let sent = bench.server.sent.load(Ordering::SeqCst);
    assert!(sent < 5000, "{sent} bytes came before it was enough");
}

#[test]
fn fault_27_a_server_that_says_nothing_or_takes_for_ever_holds_nobody() {
    let mut silent = Bench::new(Patience { idle_max: Duration::from_millis(50), ..quick() });
    let (fetched, asked) = silent.fetch(Manner::Silent);
    let error = fetched.unwrap_err();
    assert!(matches!(error, ClientError::TimedOut { .. }), "{error}");
    // Tried again, a bounded number of times.
    assert_eq!(asked.len(), 6, "{asked:?}");
    // Fast enough by the second, and too slow altogether.
    let mut long = Bench::new(Patience { whole_max: Duration::from_millis(200), ..quick() });
    let pause = Duration::from_millis(1);
    let (fetched, _) = long.fetch(Manner::Drips { pause });
    let error = fetched.unwrap_err();
    assert!(matches!(error, ClientError::TimedOut { .. }), "{error}");
}

/// Its answers are whole and well-formed, and might be signed; they are about something else than was asked.
#[test]
fn a_server_that_answers_another_question_is_told_from_one_that_answers() {
    let mut bench = Bench::new(quick());
    let client = &mut bench.client;
    let stream = StreamName::new("release/flat").unwrap();
    let there = other();
    let (label, latest) = (LabelName::new("canary").unwrap(), LabelName::latest());
    let wanted = |stream: &StreamName, version| SetLabel {
        stream: stream.clone(),
        label: label.clone(),
        version,
        expected_generation: 0,
        override_reason: None,
    };
    bench.runtime.block_on(async {
        let refused = [
            client.manifest(&stream, Some(3500)).await.err(),
            client.manifest(&stream, None).await.err(),
            client.manifest(&there.stream, Some(3500)).await.err(),
            client.labelled(&stream, &latest).await.err(),
            client.list(Some(&stream), 1, None).await.err(),
            client.overview(Some(&stream)).await.err(),
            client.set_label(wanted(&stream, 3510)).await.err(),
            client.set_label(wanted(&there.stream, 3500)).await.err(),
            client.quarantine(&stream, 3510, "falls").await.err(),
            client.quarantine(&there.stream, 3500, "falls").await.err(),
            client.freshness([1; 32], &stream, &latest).await.err(),
            client.freshness([1; 32], &there.stream, &label).await.err(),
            client.watch(Some(&stream), 0).await.unwrap().next().await.err(),
        ];
        for (index, error) in refused.into_iter().enumerate() {
            let error = error.unwrap_or_else(|| panic!("answer {index} was taken"));
            assert!(matches!(error, ClientError::OtherQuestion(_)), "{index}: {error}");
            assert!(!error.is_transient(), "{index}");
        }
        // To the question that they answer they are good answers.
        assert!(client.manifest(&there.stream, Some(3510)).await.is_ok());
        assert!(client.list(None, 1, None).await.is_ok());
        assert!(client.overview(None).await.is_ok());
        assert!(client.watch(None, 0).await.unwrap().next().await.is_ok());
    });
}
