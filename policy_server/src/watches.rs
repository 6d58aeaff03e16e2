//! Watches: what a stream holds, then each change, and a sign of life in between.

use std::sync::Arc;
use std::time::Duration;

use caudata_proto::registry::{StreamName, WatchRequest};
use caudata_proto::wire::registry as wire;
use tokio::sync::{broadcast, watch};
use tonic::Status;

use crate::labels::Change;
use crate::record::Record;
use crate::replies::Replies;
use crate::store::Store;

/// Pause between progress messages of a watch.
pub const WATCH_PROGRESS: Duration = Duration::from_secs(10);

/// What a new watcher gets first, and the generation it has then seen.
///
/// # Errors
/// `OUT_OF_RANGE` for a generation that is not known any more.
pub fn first_events(
    store: &Store,
    request: &WatchRequest,
) -> Result<(Vec<wire::WatchEvent>, u64), Status> {
    let now = store.generation();
    if request.since_generation == 0 {
        return Ok((vec![snapshot(store, request.stream.as_ref())], now));
    }
    let mut missed: Vec<Change> =
        store.changes().filter(|change| change.generation() > request.since_generation).collect();
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

/// One watch: sends what came before, then each change, and progress in between.
pub struct Watcher {
    pub stream: Option<StreamName>,
    pub seen: u64,
    pub changes: broadcast::Receiver<Arc<Change>>,
    pub draining: watch::Receiver<bool>,
    pub replies: Replies<wire::WatchEvent>,
}

impl Watcher {
    /// Ends when the client goes, when it reads nothing for too long, when it falls too far behind, or when
    /// the server drains.
    pub async fn run(mut self, first: Vec<wire::WatchEvent>) {
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
                None => {
                    Err(Status::unavailable("the server is shutting down; watch again in a moment"))
                }
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
        event: Some(wire::watch_event::Event::Snapshot(wire::Snapshot { manifests })),
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
    wire::WatchEvent { generation: change.generation(), event: Some(event) }
}
