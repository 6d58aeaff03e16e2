//! The gRPC service: checks what comes in, asks the store, and answers with the status codes that clients act on.
//!
//! | case | status |
//! |---|---|
//! | malformed request, hash or header mismatch | `INVALID_ARGUMENT` |
//! | version taken by other bytes | `ALREADY_EXISTS` |
//! | contract other than the stream's; a label or revert that must not be | `FAILED_PRECONDITION` |
//! | somebody else moved the label | `ABORTED` |
//! | too large, too many streams or labels, disk full, watcher too slow | `RESOURCE_EXHAUSTED` |
//! | unknown stream, version, label, blob | `NOT_FOUND` |
//! | generation no longer known | `OUT_OF_RANGE` |
//! | stored bytes damaged | `DATA_LOSS` |
//! | shutting down, read-only after a failed sync | `UNAVAILABLE` |
//! | a robot's report under another name than its certificate's | `PERMISSION_DENIED` |
//! | no key to sign freshness with | `UNIMPLEMENTED` |

use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use caudata_pki::Role;
use caudata_policy::PolicyFile;
use caudata_proto::registry::{
    FETCH_CHUNK_BYTES, FetchRequest, Freshness, LabelName, ListRequest, Manifest, ManifestRequest,
    NONCE_BYTES, Overview, QuarantineState, RegistryError, RobotReport, SetLabel, StreamName,
    WatchRequest,
};
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::policy_registry_server::PolicyRegistry;
use tokio::sync::{broadcast, watch};
use tokio_stream::Stream;
use tonic::{Code, Request, Response, Status, Streaming};

use crate::access::Caller;
use crate::audit::{ENTRIES_KEPT, Origin};
use crate::error::StoreError;
use crate::labels::Change;
use crate::metrics::ServerMetrics;
use crate::record::Record;
use crate::replies::{Replies, replies};
use crate::store::{Published, Store, hex};
use caudata_signing::ReleaseKey;

/// A publisher must send its next piece within this time.
pub const UPLOAD_IDLE_MAX: Duration = Duration::from_secs(30);
/// Manifests in one list answer at most.
pub const LIST_MAX: usize = 500;
/// Pause between progress messages of a watch.
pub const WATCH_PROGRESS: Duration = Duration::from_secs(10);
/// Changes that a slow watcher may lag behind before it is cut off.
const WATCH_BACKLOG: usize = 64;
/// A client must take a piece of an answer that waits for it (a watch, a fetch) within this time.
pub const REPLY_IDLE_MAX: Duration = Duration::from_secs(60);

/// Reports in one answer at most, the newest first.
const REPORTS_MAX: usize = 1000;
/// Audit entries in one answer at most.
const AUDIT_MAX: usize = 500;

/// The store, as the service and the page share it.
#[derive(Clone, Debug)]
pub struct SharedStore(Arc<Mutex<Store>>);

impl SharedStore {
    /// Shares `store`.
    #[must_use]
    pub fn new(store: Store) -> Self {
        Self(Arc::new(Mutex::new(store)))
    }

    /// Waits for it.
    pub fn lock(&self) -> MutexGuard<'_, Store> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The service over one store.
#[derive(Clone)]
pub struct RegistryService {
    store: SharedStore,
    changes: broadcast::Sender<Arc<Change>>,
    draining: watch::Receiver<bool>,
    metrics: ServerMetrics,
    fresh_key: Option<Arc<ReleaseKey>>,
    upload_idle: Duration,
    reply_idle: Duration,
    /// Turns true for good when the store can no longer be changed.
    read_only: Arc<watch::Sender<bool>>,
}

type ReplyStream<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

impl RegistryService {
    /// A service over `store` that refuses new work once `draining` turns true.
    pub fn new(
        store: SharedStore,
        draining: watch::Receiver<bool>,
        metrics: ServerMetrics,
        fresh_key: Option<Arc<ReleaseKey>>,
    ) -> Self {
        let (changes, _) = broadcast::channel(WATCH_BACKLOG);
        let service = Self {
            store,
            changes,
            draining,
            metrics,
            fresh_key,
            upload_idle: UPLOAD_IDLE_MAX,
            reply_idle: REPLY_IDLE_MAX,
            read_only: Arc::new(watch::Sender::new(false)),
        };
        service.update_gauges();
        service
    }

    /// A publisher must send its next piece within `limit`.
    #[must_use]
    pub fn with_upload_idle(mut self, limit: Duration) -> Self {
        self.upload_idle = limit;
        self
    }

    /// A client must take a piece of an answer that waits for it within `limit`.
    #[must_use]
    pub fn with_reply_idle(mut self, limit: Duration) -> Self {
        self.reply_idle = limit;
        self
    }

    /// Turns true for good when the store can no longer be changed.
    #[must_use]
    pub fn read_only(&self) -> watch::Receiver<bool> {
        self.read_only.subscribe()
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        self.store.lock()
    }

    /// Changes the store away from the network threads, and tells whoever watches for health where that ended it.
    async fn change<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, Status> {
        let (result, broken) = self
            .on_disk(move |store| (work(store), store.read_only().is_some()))
            .await?;
        if broken {
            self.metrics.read_only.set(1);
            self.read_only.send_replace(true);
        }
        result.map_err(|error| status_of(&error))
    }

    fn tell(&self, change: Change) {
        // No watcher listening is fine.
        let _ = self.changes.send(Arc::new(change));
    }

    fn update_gauges(&self) {
        let store = self.store();
        self.metrics
            .versions
            .set(i64::try_from(store.records(None).count()).unwrap_or(i64::MAX));
        self.metrics
            .streams
            .set(i64::try_from(store.stream_names().count()).unwrap_or(i64::MAX));
    }

    fn refuse_when_draining(&self) -> Result<(), Status> {
        if *self.draining.borrow() {
            return Err(Status::unavailable(
                "the server is shutting down; try again in a moment",
            ));
        }
        Ok(())
    }

    /// Runs disk work away from the network threads.
    async fn on_disk<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Result<T, Status> {
        let service = self.clone();
        tokio::task::spawn_blocking(move || work(&mut service.store()))
            .await
            .map_err(|error| Status::internal(format!("store task failed: {error}")))
    }

    async fn publish_file(
        &self,
        origin: Origin,
        manifest: Manifest,
        bytes: Vec<u8>,
    ) -> Result<Published, Status> {
        if manifest.reverts_to.is_some() {
            return Err(Status::invalid_argument(
                "an older version comes back by Revert, which needs no bytes",
            ));
        }
        let (manifest, bytes) = tokio::task::spawn_blocking(move || {
            check_against_file(&manifest, &bytes).map(|()| (manifest, bytes))
        })
        .await
        .map_err(|error| Status::internal(format!("check failed: {error}")))??;
        let published = self
            .change(move |store| store.publish_by(&origin, "publish", "", manifest, &bytes))
            .await?;
        self.count(&published);
        Ok(published)
    }

    fn count(&self, published: &Published) {
        if published.already_present {
            self.metrics.repeated.inc();
        } else {
            self.metrics.published.inc();
            self.update_gauges();
            self.tell(Change::Published(published.record.clone()));
        }
    }

    async fn take_report(
        &self,
        request: Request<wire::RobotReport>,
        well: bool,
    ) -> Result<Response<wire::ReportResponse>, Status> {
        self.refuse_when_draining()?;
        let (caller, origin) = (caller(&request), origin_of(&request));
        let report = checked::<_, RobotReport>(request)?;
        if let Some(caller) = caller.filter(|c| c.role == Role::Robot && c.name != report.robot) {
            let name = caller.name;
            let other = report.robot;
            return Err(Status::permission_denied(format!(
                "robot `{name}` cannot speak for `{other}`"
            )));
        }
        if report.state.went_well() != well {
            let word = report.state.word();
            return Err(Status::invalid_argument(format!(
                "`{word}` is not for this call: what went well is an Ack, what did not a Nack"
            )));
        }
        let (robot, version, state) = (report.robot.clone(), report.version, report.state.word());
        let news = self
            .change(move |store| store.report(&origin, report))
            .await?;
        if news {
            tracing::info!(robot, version, state, "a robot says");
            self.metrics.reports.inc();
        }
        Ok(Response::new(wire::ReportResponse {}))
    }
}

fn caller<T>(request: &Request<T>) -> Option<Caller> {
    request.extensions().get::<Caller>().cloned()
}

/// Who is written down for a request.
fn origin_of<T>(request: &Request<T>) -> Origin {
    match caller(request) {
        Some(caller) => Origin::of(&format!("{}:{}", caller.role, caller.name)),
        None => Origin::local(),
    }
}

fn publish_response(published: &Published) -> wire::PublishResponse {
    wire::PublishResponse {
        manifest: Some(published.record.manifest.clone().into()),
        generation: published.record.generation,
        already_present: published.already_present,
    }
}

#[tonic::async_trait]
impl PolicyRegistry for RegistryService {
    async fn publish(
        &self,
        request: Request<Streaming<wire::PublishRequest>>,
    ) -> Result<Response<wire::PublishResponse>, Status> {
        self.refuse_when_draining()?;
        let (caller, origin) = (caller(&request), origin_of(&request));
        let (manifest, bytes) = receive_upload(request.into_inner(), self.upload_idle)
            .await
            .inspect_err(|_| {
                self.metrics.refused.inc();
            })?;
        if caller.is_some_and(|c| c.role == Role::Operator) && manifest.signatures.is_empty() {
            return Err(Status::permission_denied(
                "an operator publishes signed policies only: `caudata policy release`",
            ));
        }
        let stream = manifest.stream.to_string();
        let version = manifest.version;
        let published = self.publish_file(origin, manifest, bytes).await.inspect_err(|status| {
            self.metrics.refused.inc();
            tracing::warn!(stream, version, code = ?status.code(), "publication refused: {}", status.message());
        })?;
        let record = &published.record;
        tracing::info!(
            stream,
            version,
            generation = record.generation,
            sha256 = hex(&record.manifest.sha256),
            already_present = published.already_present,
            "published"
        );
        Ok(Response::new(publish_response(&published)))
    }

    async fn list(
        &self,
        request: Request<wire::ListRequest>,
    ) -> Result<Response<wire::ListResponse>, Status> {
        let request = checked::<_, ListRequest>(request)?;
        let limit = match usize::try_from(request.limit).unwrap_or(LIST_MAX) {
            0 => LIST_MAX,
            asked => asked.min(LIST_MAX),
        };
        let below = request.below_version.unwrap_or(u64::MAX);
        let store = self.store();
        let mut manifests: Vec<wire::Manifest> = store
            .records(request.stream.as_ref())
            .filter(|record| record.manifest.version < below)
            .take(limit + 1)
            .map(|record| record.manifest.clone().into())
            .collect();
        let more = manifests.len() > limit;
        manifests.truncate(limit);
        Ok(Response::new(wire::ListResponse {
            manifests,
            generation: store.generation(),
            more,
        }))
    }

    async fn get_manifest(
        &self,
        request: Request<wire::GetManifestRequest>,
    ) -> Result<Response<wire::GetManifestResponse>, Status> {
        let request = checked::<_, ManifestRequest>(request)?;
        let store = self.store();
        let found = match &request.label {
            Some(label) => store.labelled(&request.stream, label),
            None => store.manifest(&request.stream, request.version),
        };
        let record = found.map_err(|error| status_of(&error))?;
        Ok(Response::new(wire::GetManifestResponse {
            manifest: Some(record.manifest.clone().into()),
            generation: record.generation,
        }))
    }

    type FetchStream = ReplyStream<wire::FetchResponse>;

    async fn fetch(
        &self,
        request: Request<wire::FetchRequest>,
    ) -> Result<Response<Self::FetchStream>, Status> {
        self.refuse_when_draining()?;
        let FetchRequest {
            sha256,
            offset,
            if_none_match,
        } = checked(request)?;
        let bytes = self
            .on_disk(move |store| store.read_blob(&sha256))
            .await?
            .map_err(|error| status_of(&error))?;
        let size = bytes.len() as u64;
        if offset > size {
            return Err(Status::invalid_argument(format!(
                "offset {offset} lies beyond the file's {size} bytes"
            )));
        }
        let not_modified = if_none_match == Some(sha256);
        let info = wire::FetchInfo {
            status: match not_modified {
                true => wire::fetch_info::Status::NotModified,
                false => wire::fetch_info::Status::ContentFollows,
            }
            .into(),
            sha256: sha256.to_vec(),
            size,
            offset,
        };
        self.metrics.fetched.inc();
        let from = if not_modified { size } else { offset };
        let rest = bytes
            .get(usize::try_from(from).unwrap_or(usize::MAX)..)
            .unwrap_or_default()
            .to_vec();
        Ok(Response::new(send_file(info, rest, self.reply_idle)))
    }

    type WatchStream = ReplyStream<wire::WatchEvent>;

    async fn watch(
        &self,
        request: Request<wire::WatchRequest>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        self.refuse_when_draining()?;
        let request = checked::<_, WatchRequest>(request)?;
        // Subscribe before reading the store, so that no change falls between the two.
        let changes = self.changes.subscribe();
        let (first, seen) = self.first_events(&request)?;
        let (replies, answer) = replies(self.reply_idle, Code::ResourceExhausted);
        let watcher = Watcher {
            stream: request.stream,
            seen,
            changes,
            draining: self.draining.clone(),
            replies,
        };
        self.metrics.watchers.inc();
        let gauge = self.metrics.watchers.clone();
        tokio::spawn(async move {
            watcher.run(first).await;
            gauge.dec();
        });
        Ok(Response::new(Box::pin(answer)))
    }

    async fn set_label(
        &self,
        request: Request<wire::SetLabelRequest>,
    ) -> Result<Response<wire::LabelState>, Status> {
        self.refuse_when_draining()?;
        let origin = origin_of(&request);
        let wanted = checked::<_, SetLabel>(request)?;
        let state = self
            .change(move |store| store.set_label(&origin, wanted))
            .await?;
        let (label, version) = (&state.label, state.version);
        tracing::info!(stream = %state.stream, %label, version, by = state.by, overridden = state.override_reason, "label moved");
        self.tell(Change::Label(state.clone()));
        Ok(Response::new(state.into()))
    }

    async fn revert(
        &self,
        request: Request<wire::RevertRequest>,
    ) -> Result<Response<wire::PublishResponse>, Status> {
        self.refuse_when_draining()?;
        let origin = origin_of(&request);
        let (manifest, reason) = checked::<_, (Manifest, String)>(request)?;
        let published = self
            .change(move |store| store.revert(&origin, manifest, &reason))
            .await?;
        self.count(&published);
        let manifest = &published.record.manifest;
        tracing::info!(stream = %manifest.stream, version = manifest.version, reverts_to = manifest.reverts_to, "reverted");
        Ok(Response::new(publish_response(&published)))
    }

    async fn quarantine(
        &self,
        request: Request<wire::QuarantineRequest>,
    ) -> Result<Response<wire::QuarantineState>, Status> {
        self.refuse_when_draining()?;
        let origin = origin_of(&request);
        let state = checked::<_, QuarantineState>(request)?;
        let state = self
            .change(move |store| store.quarantine(&origin, state))
            .await?;
        tracing::warn!(stream = %state.stream, version = state.version, reason = state.reason, by = state.by, "quarantined");
        self.tell(Change::Quarantined(state.clone()));
        Ok(Response::new(state.into()))
    }

    async fn ack(
        &self,
        request: Request<wire::RobotReport>,
    ) -> Result<Response<wire::ReportResponse>, Status> {
        self.take_report(request, true).await
    }

    async fn nack(
        &self,
        request: Request<wire::RobotReport>,
    ) -> Result<Response<wire::ReportResponse>, Status> {
        self.take_report(request, false).await
    }

    async fn freshness(
        &self,
        request: Request<wire::FreshnessRequest>,
    ) -> Result<Response<wire::FreshnessResponse>, Status> {
        let (nonce, stream, label) =
            checked::<_, ([u8; NONCE_BYTES], StreamName, LabelName)>(request)?;
        let Some(key) = &self.fresh_key else {
            return Err(Status::unimplemented(
                "this server has no key to say so with (--fresh-key)",
            ));
        };
        let said = {
            let store = self.store();
            let record = store
                .labelled(&stream, &label)
                .map_err(|error| status_of(&error))?;
            Freshness {
                nonce,
                version: record.manifest.version,
                sha256: record.manifest.sha256,
                stream,
                label,
            }
        };
        Ok(Response::new(key.vouch(said).into()))
    }

    async fn overview(
        &self,
        request: Request<wire::OverviewRequest>,
    ) -> Result<Response<wire::OverviewResponse>, Status> {
        let stream = checked::<_, Option<StreamName>>(request)?;
        Ok(Response::new(
            overview(&self.store(), stream.as_ref()).into(),
        ))
    }

    async fn audit(
        &self,
        request: Request<wire::AuditRequest>,
    ) -> Result<Response<wire::AuditResponse>, Status> {
        let wire::AuditRequest { limit, before } = request.into_inner();
        let limit = match usize::try_from(limit).unwrap_or(AUDIT_MAX) {
            0 => AUDIT_MAX,
            asked => asked.min(AUDIT_MAX).min(ENTRIES_KEPT),
        };
        let store = self.store();
        let entries = store.audit().newest(before).take(limit);
        Ok(Response::new(wire::AuditResponse {
            entries: entries.cloned().map(Into::into).collect(),
        }))
    }
}

/// Labels, quarantine and reports of `stream` (`None`: of all), the newest reports first.
pub fn overview(store: &Store, stream: Option<&StreamName>) -> Overview {
    let wanted = |name: &StreamName| stream.is_none_or(|s| s == name);
    let mut reports: Vec<RobotReport> = store
        .reports
        .values()
        .flat_map(|reports| reports.0.values())
        .filter(|report| wanted(&report.stream))
        .cloned()
        .collect();
    reports.sort_by_key(|report| std::cmp::Reverse(report.unix_ms));
    reports.truncate(REPORTS_MAX);
    Overview {
        labels: store.labels(stream),
        quarantined: store
            .quarantined
            .values()
            .filter(|state| wanted(&state.stream))
            .cloned()
            .collect(),
        reports,
        generation: store.generation(),
        read_only: store.read_only().map(|r| r.chars().take(300).collect()),
    }
}

impl RegistryService {
    /// What a new watcher gets first, and the generation it has then seen.
    fn first_events(&self, request: &WatchRequest) -> Result<(Vec<wire::WatchEvent>, u64), Status> {
        let store = self.store();
        let now = store.generation();
        if request.since_generation == 0 {
            return Ok((vec![snapshot(&store, request.stream.as_ref())], now));
        }
        let mut missed: Vec<Change> = store
            .changes()
            .filter(|change| change.generation() > request.since_generation)
            .collect();
        // Generations count changes one by one: fewer than that means that some do not show any more.
        let expected = now.checked_sub(request.since_generation);
        if expected != Some(missed.len() as u64) {
            return Err(Status::out_of_range(format!(
                "generation {} is not known any more; watch again from 0",
                request.since_generation
            )));
        }
        missed.sort_by_key(Change::generation);
        let events = missed
            .iter()
            .filter(|change| follows(request.stream.as_ref(), change))
            .map(change_event)
            .collect();
        Ok((events, now))
    }
}

/// One watch: sends what came before, then each change, and progress in between.
struct Watcher {
    stream: Option<StreamName>,
    seen: u64,
    changes: broadcast::Receiver<Arc<Change>>,
    draining: watch::Receiver<bool>,
    replies: Replies<wire::WatchEvent>,
}

impl Watcher {
    /// Ends when the client goes, when it reads nothing for too long, when it falls too far behind, or when the server drains.
    async fn run(mut self, first: Vec<wire::WatchEvent>) {
        for event in first {
            if !self.replies.send(event).await {
                return;
            }
        }
        let mut progress = tokio::time::interval(WATCH_PROGRESS);
        progress.tick().await;
        loop {
            let change = tokio::select! {
                () = self.replies.gone() => return,
                _ = self.draining.wait_for(|draining| *draining) => None,
                change = self.changes.recv() => Some(Some(change)),
                _ = progress.tick() => Some(None),
            };
            let event = match change {
                None => Err(Status::unavailable(
                    "the server is shutting down; watch again in a moment",
                )),
                Some(None) => Ok(Some(self.progress())),
                Some(Some(change)) => self.next_event(change),
            };
            let event = match event {
                Ok(Some(event)) => event,
                Ok(None) => continue,
                // A watcher that lags is told when it reads on.
                Err(status) => return self.replies.end(status).await,
            };
            if !self.replies.send(event).await {
                return;
            }
        }
    }

    fn progress(&self) -> wire::WatchEvent {
        wire::WatchEvent {
            generation: self.seen,
            event: Some(wire::watch_event::Event::Progress(wire::Progress {})),
        }
    }

    fn next_event(
        &mut self,
        change: Result<Arc<Change>, broadcast::error::RecvError>,
    ) -> Result<Option<wire::WatchEvent>, Status> {
        match change {
            Ok(change) if change.generation() <= self.seen => Ok(None),
            Ok(change) => {
                self.seen = change.generation();
                Ok(follows(self.stream.as_ref(), &change).then(|| change_event(&change)))
            }
            Err(broadcast::error::RecvError::Lagged(missed)) => {
                Err(Status::resource_exhausted(format!(
                    "this watcher missed {missed} changes; watch again from generation {}",
                    self.seen
                )))
            }
            Err(broadcast::error::RecvError::Closed) => {
                Err(Status::unavailable("the server is shutting down"))
            }
        }
    }
}

fn follows(stream: Option<&StreamName>, change: &Change) -> bool {
    stream.is_none_or(|wanted| change.stream() == wanted)
}

fn snapshot(store: &Store, stream: Option<&StreamName>) -> wire::WatchEvent {
    let manifests = store
        .stream_names()
        .filter(|name| stream.is_none_or(|wanted| *name == wanted))
        .filter_map(|name| store.newest_usable(name))
        .map(|record: &Record| record.manifest.clone().into())
        .collect();
    wire::WatchEvent {
        generation: store.generation(),
        event: Some(wire::watch_event::Event::Snapshot(wire::Snapshot {
            manifests,
        })),
    }
}

fn change_event(change: &Change) -> wire::WatchEvent {
    let event = match change {
        Change::Published(record) => {
            wire::watch_event::Event::Published(record.manifest.clone().into())
        }
        Change::Label(state) => wire::watch_event::Event::LabelMoved(state.clone().into()),
        Change::Quarantined(state) => wire::watch_event::Event::Quarantined(state.clone().into()),
    };
    wire::WatchEvent {
        generation: change.generation(),
        event: Some(event),
    }
}

/// Reads a whole upload: a checked header, then exactly the announced number of bytes.
async fn receive_upload(
    mut upload: Streaming<wire::PublishRequest>,
    idle: Duration,
) -> Result<(Manifest, Vec<u8>), Status> {
    let header = match next_part(&mut upload, idle).await? {
        Some(wire::publish_request::Part::Header(header)) => header,
        _ => {
            return Err(Status::invalid_argument(
                "the first message must be the header",
            ));
        }
    };
    let manifest = Manifest::try_from(header).map_err(|error| refusal(&error))?;
    let mut bytes = Vec::with_capacity(usize::try_from(manifest.size).unwrap_or(0));
    while let Some(part) = next_part(&mut upload, idle).await? {
        let wire::publish_request::Part::Data(piece) = part else {
            return Err(Status::invalid_argument(
                "a second header came in the middle of the file",
            ));
        };
        if (bytes.len() + piece.len()) as u64 > manifest.size {
            return Err(Status::invalid_argument(format!(
                "more bytes came than the announced {}",
                manifest.size
            )));
        }
        bytes.extend_from_slice(&piece);
    }
    if bytes.len() as u64 != manifest.size {
        return Err(Status::invalid_argument(format!(
            "upload ended after {} of {} bytes; send the file again",
            bytes.len(),
            manifest.size
        )));
    }
    Ok((manifest, bytes))
}

async fn next_part(
    upload: &mut Streaming<wire::PublishRequest>,
    idle: Duration,
) -> Result<Option<wire::publish_request::Part>, Status> {
    let message = tokio::time::timeout(idle, upload.message())
        .await
        .map_err(|_| Status::deadline_exceeded("the upload stalled; send the file again"))??;
    match message {
        None => Ok(None),
        Some(wire::PublishRequest { part: Some(part) }) => Ok(Some(part)),
        Some(_) => Err(Status::invalid_argument("an upload message is empty")),
    }
}

/// The server stores only files that the strict checker accepts and whose metadata say what the header says.
fn check_against_file(manifest: &Manifest, bytes: &[u8]) -> Result<(), Status> {
    let file = PolicyFile::parse(bytes.into())
        .map_err(|error| Status::invalid_argument(format!("not a caudata policy: {error}")))?;
    let metadata = file.metadata();
    let fields = [
        (
            "contract hash",
            hex(&manifest.contract_hash),
            hex(&metadata.contract.hash()),
        ),
        (
            "robot hash",
            hex(&manifest.robot_hash),
            metadata.contract.robot_hash.to_string(),
        ),
        ("run id", manifest.run_id.clone(), metadata.run_id.clone()),
        (
            "version",
            manifest.version.to_string(),
            metadata.version.to_string(),
        ),
    ];
    for (field, header, file) in fields {
        if header != file {
            let error = StoreError::HeaderMismatch {
                field,
                header,
                file,
            };
            return Err(status_of(&error));
        }
    }
    Ok(())
}

fn send_file(
    info: wire::FetchInfo,
    bytes: Vec<u8>,
    idle: Duration,
) -> ReplyStream<wire::FetchResponse> {
    // As for an upload that stalls: it may go on where it stopped.
    let (replies, answer) = replies(idle, Code::DeadlineExceeded);
    tokio::spawn(async move {
        let first = wire::FetchResponse {
            part: Some(wire::fetch_response::Part::Info(info)),
        };
        if !replies.send(first).await {
            return;
        }
        for piece in bytes.chunks(FETCH_CHUNK_BYTES) {
            let data = wire::FetchResponse {
                part: Some(wire::fetch_response::Part::Data(piece.to_vec())),
            };
            if !replies.send(data).await {
                return;
            }
        }
        drop(bytes);
        replies.finish().await;
    });
    Box::pin(answer)
}

/// The checked form of a request.
fn checked<W, D: TryFrom<W, Error = RegistryError>>(request: Request<W>) -> Result<D, Status> {
    D::try_from(request.into_inner()).map_err(|error| refusal(&error))
}

fn refusal(error: &RegistryError) -> Status {
    match error {
        RegistryError::Range { field: "size", .. } => Status::resource_exhausted(error.to_string()),
        _ => Status::invalid_argument(error.to_string()),
    }
}

fn status_of(error: &StoreError) -> Status {
    let message = error.to_string();
    match error {
        StoreError::VersionTaken { .. } => Status::already_exists(message),
        StoreError::HashMismatch { .. } | StoreError::HeaderMismatch { .. } => {
            Status::invalid_argument(message)
        }
        StoreError::ContractMismatch { .. } | StoreError::NotAllowed { .. } => {
            Status::failed_precondition(message)
        }
        StoreError::LabelMoved { .. } => Status::aborted(message),
        StoreError::ReadOnly { .. } => Status::unavailable(message),
        StoreError::NotFound { .. } => Status::not_found(message),
        StoreError::Damaged { .. } => Status::data_loss(message),
        StoreError::TooManyStreams { .. } | StoreError::TooManyLabels { .. } => {
            Status::resource_exhausted(message)
        }
        StoreError::Durable(durable) if durable.is_disk_full() => {
            Status::resource_exhausted(message)
        }
        StoreError::Durable(_) | StoreError::Unusable { .. } => Status::internal(message),
    }
}
