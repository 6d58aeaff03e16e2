//! The gRPC service: checks what comes in, asks the store, and answers with the status codes that clients act
//! on.
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

use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::Duration;

use caudata_proto::hex::hex;
use caudata_proto::registry::{
    FetchRequest, Freshness, LabelName, ListRequest, Manifest, ManifestRequest, NONCE_BYTES,
    QuarantineState, RobotReport, SetLabel, StreamName, WatchRequest,
};
use caudata_proto::wire::registry as wire;
use caudata_proto::wire::registry::policy_registry_server::PolicyRegistry;
use caudata_signing::ReleaseKey;
use caudata_signing::pki::Role;
use caudata_telemetry::Peer;
use tokio::sync::{broadcast, watch};
use tonic::{Code, Request, Response, Status, Streaming};

use crate::access::Caller;
use crate::audit::{ENTRIES_KEPT, Origin};
use crate::error::StoreError;
use crate::fetches::{ReplyStream, send_file};
use crate::labels::Change;
use crate::limits::{FETCHES_MAX, Shares};
use crate::metrics::ServerMetrics;
use crate::options::ServeOptions;
use crate::replies::replies;
use crate::shared::SharedStore;
use crate::store::{Published, Store};
use crate::uploads::{check_against_file, checked, receive_upload};
use crate::watches::{Watcher, first_events};

/// Manifests in one list answer at most.
pub const LIST_MAX: usize = 500;
/// Changes that a slow watcher may lag behind before it is cut off.
const WATCH_BACKLOG: usize = 64;
/// Audit entries in one answer at most.
const AUDIT_MAX: usize = 500;

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
    fetches: Arc<Shares>,
}

impl RegistryService {
    /// A service over `store` that refuses new work once `draining` turns true.
    pub fn new(
        store: SharedStore,
        draining: watch::Receiver<bool>,
        metrics: ServerMetrics,
        options: &ServeOptions,
    ) -> Self {
        let (changes, _) = broadcast::channel(WATCH_BACKLOG);
        metrics.show(&store.lock());
        Self {
            store,
            changes,
            draining,
            metrics,
            fresh_key: options.fresh_key.clone(),
            upload_idle: options.upload_idle,
            reply_idle: options.reply_idle,
            fetches: Arc::new(Shares::new(FETCHES_MAX)),
        }
    }

    /// Why the store cannot be changed; `None`: it can.
    pub fn trouble(&self) -> watch::Receiver<Option<String>> {
        self.store.trouble()
    }

    /// Looks whether a store that could not be changed can be again ([`Store::recover`]), and tells watchers
    /// what shows then.
    pub async fn recover(&self) {
        match self.change(Store::recover).await {
            Ok(changes) => changes.into_iter().for_each(|change| self.tell(change)),
            Err(status) => tracing::debug!("still no changes: {}", status.message()),
        }
    }

    /// Changes the store away from the network threads.
    async fn change<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> Result<T, StoreError> + Send + 'static,
    ) -> Result<T, Status> {
        let metrics = self.metrics.clone();
        let changed = move |store: &mut Store| {
            let result = work(store);
            metrics.show(store);
            result
        };
        self.on_disk(changed).await?.map_err(|error| Status::from(&error))
    }

    fn tell(&self, change: Change) {
        // No watcher listening is fine.
        let _ = self.changes.send(Arc::new(change));
    }

    fn refuse_when_draining(&self) -> Result<(), Status> {
        if *self.draining.borrow() {
            return Err(Status::unavailable("the server is shutting down; try again in a moment"));
        }
        Ok(())
    }

    /// Runs disk work away from the network threads.
    async fn on_disk<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Store) -> T + Send + 'static,
    ) -> Result<T, Status> {
        let service = self.clone();
        tokio::task::spawn_blocking(move || service.store.with(work))
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
            self.tell(Change::Published(published.record.clone()));
        }
    }

    async fn take_report(
        &self,
        request: Request<wire::RobotReport>,
        well: bool,
    ) -> Result<Response<wire::ReportResponse>, Status> {
        self.refuse_when_draining()?;
        let (caller, origin) = (Caller::of(&request), Caller::origin(&request));
        let report = checked::<_, RobotReport>(request)?;
        if let Some(caller) = caller.filter(|c| c.role == Role::Robot && c.name != report.robot) {
            let name = caller.name;
            let other = report.robot;
            return Err(Status::permission_denied(format!(
                "robot `{name}` cannot speak for `{other}`"
            )));
        }
        if report.state.went_well() != well {
            let word = report.state.name();
            return Err(Status::invalid_argument(format!(
                "`{word}` is not for this call: what went well is an Ack, what did not a Nack"
            )));
        }
        let (robot, version, state) = (report.robot.clone(), report.version, report.state.name());
        let news = self.change(move |store| store.report(&origin, report)).await?;
        if news {
            tracing::info!(robot, version, state, "a robot says");
            self.metrics.reports.inc();
        }
        Ok(Response::new(wire::ReportResponse {}))
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
        let (caller, origin) = (Caller::of(&request), Caller::origin(&request));
        let may = |manifest: &Manifest| {
            let signed = !manifest.signatures.is_empty();
            caller.map_or(Ok(()), |caller| caller.check_publication(&manifest.stream, signed))
        };
        let (manifest, bytes) = receive_upload(request.into_inner(), self.upload_idle, may)
            .await
            .inspect_err(|_| {
            self.metrics.refused.inc();
        })?;
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
        let store = self.store.lock();
        let mut manifests: Vec<wire::Manifest> = store
            .records(request.stream.as_ref())
            .filter(|record| record.manifest.version < below)
            .take(limit + 1)
            .map(|record| record.manifest.clone().into())
            .collect();
        let more = manifests.len() > limit;
        manifests.truncate(limit);
        Ok(Response::new(wire::ListResponse { manifests, generation: store.generation(), more }))
    }

    async fn get_manifest(
        &self,
        request: Request<wire::GetManifestRequest>,
    ) -> Result<Response<wire::GetManifestResponse>, Status> {
        let request = checked::<_, ManifestRequest>(request)?;
        let store = self.store.lock();
        let found = match &request.label {
            Some(label) => store.labelled(&request.stream, label),
            None => store.manifest(&request.stream, request.version),
        };
        let record = found.map_err(|error| Status::from(&error))?;
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
        let peer = request.extensions().get::<Peer>().map(|peer| peer.host);
        let host = peer.unwrap_or(IpAddr::V4(Ipv4Addr::LOCALHOST));
        let share = self.fetches.take(host).ok_or_else(|| {
            Status::unavailable("too many fetches at once; try again in a moment")
        })?;
        let FetchRequest { sha256, offset, if_none_match } = checked(request)?;
        let bytes = self
            .on_disk(move |store| store.read_blob(&sha256))
            .await?
            .map_err(|error| Status::from(&error))?;
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
        let answer = send_file(info, bytes, from, self.reply_idle, share);
        Ok(Response::new(answer))
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
        let (first, seen) = first_events(&self.store.lock(), &request)?;
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
        let origin = Caller::origin(&request);
        let wanted = checked::<_, SetLabel>(request)?;
        let state = self.change(move |store| store.set_label(&origin, wanted)).await?;
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
        let origin = Caller::origin(&request);
        let (manifest, reason) = checked::<_, (Manifest, String)>(request)?;
        let published = self.change(move |store| store.revert(&origin, manifest, &reason)).await?;
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
        let origin = Caller::origin(&request);
        let state = checked::<_, QuarantineState>(request)?;
        let state = self.change(move |store| store.quarantine(&origin, state)).await?;
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
            let store = self.store.lock();
            let record = store.labelled(&stream, &label).map_err(|error| Status::from(&error))?;
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
        Ok(Response::new(self.store.lock().overview(stream.as_ref()).into()))
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
        let store = self.store.lock();
        let entries = store.audit.newest(before).take(limit);
        Ok(Response::new(wire::AuditResponse {
            entries: entries.cloned().map(Into::into).collect(),
        }))
    }
}
