//! Following changes on a server.

use caudata_proto::registry::{StreamName, WatchChange, WatchEvent};
use caudata_proto::wire::registry as wire;

use crate::call::{all_of, within};
use crate::error::ClientError;
use crate::limits::WATCH_IDLE_MAX;

/// An open watch.
#[derive(Debug)]
pub struct Watch {
    pub(crate) address: String,
    /// What it was asked for; `None`: all.
    pub(crate) stream: Option<StreamName>,
    pub(crate) events: tonic::Streaming<wire::WatchEvent>,
}

impl Watch {
    /// The next event; `None` when the server closed the watch in order.
    ///
    /// # Errors
    /// See [`ClientError`]; [`ClientError::TimedOut`] after [`WATCH_IDLE_MAX`] of silence.
    pub async fn next(&mut self) -> Result<Option<WatchEvent>, ClientError> {
        let message = within("watch", WATCH_IDLE_MAX, &self.address, self.events.message()).await?;
        let event = message.map(WatchEvent::try_from).transpose()?;
        let stream = self.stream.as_ref();
        match event.as_ref().map(|event| &event.change) {
            Some(WatchChange::Snapshot(manifests)) => all_of(stream, manifests)?,
            Some(WatchChange::Published(manifest)) => all_of(stream, [&**manifest])?,
            Some(WatchChange::LabelMoved(state)) => all_of(stream, [&**state])?,
            Some(WatchChange::Quarantined(state)) => all_of(stream, [&**state])?,
            Some(WatchChange::Progress) | None => {}
        }
        Ok(event)
    }
}
