//! Follows a stream while the robot walks: newer policies are fetched and verified here and wait in a slot for the loop.

use std::thread::JoinHandle;
use std::time::Duration;

use caudata_proto::registry::{Manifest, StreamName, WatchChange};
use caudata_registry_client::{ClientError, RegistryClient};
use tokio::sync::watch;

use crate::DeployError;
use crate::keeper::{Keeper, reference};
use crate::state::{PolicyRef, Sha256Digest};
use crate::updates::Slot;

/// First pause before a server that went away is tried again; doubles up to [`RETRY_MAX`].
pub const RETRY_FIRST: Duration = Duration::from_millis(500);
/// Longest pause between tries.
pub const RETRY_MAX: Duration = Duration::from_secs(30);

/// A thread that follows one stream; dropped, it ends.
#[derive(Debug)]
pub struct Follower {
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Follower {
    /// Starts following. `running` is the policy that runs already.
    ///
    /// # Errors
    /// [`DeployError::System`], [`DeployError::Server`] for a wrong address.
    pub fn start(
        keeper: Keeper,
        address: &str,
        stream: StreamName,
        running: PolicyRef,
        slot: Slot,
    ) -> Result<Self, DeployError> {
        let refused = |what| move |source| DeployError::System { what, source };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .map_err(refused("a network runtime"))?;
        let client = {
            let _context = runtime.enter();
            RegistryClient::new(address)?
        };
        let (stop, stopped) = watch::channel(false);
        let mut following = Following {
            keeper,
            client,
            stream,
            offered: running.sha256,
            slot,
        };
        let thread = std::thread::Builder::new()
            .name("follower".into())
            .spawn(move || runtime.block_on(following.until(stopped)))
            .map_err(refused("a thread"))?;
        Ok(Self {
            stop,
            thread: Some(thread),
        })
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Following {
    keeper: Keeper,
    client: RegistryClient,
    stream: StreamName,
    /// What was handed over, or refused, last.
    offered: Sha256Digest,
    slot: Slot,
}

impl Following {
    async fn until(&mut self, mut stopped: watch::Receiver<bool>) {
        tokio::select! {
            _ = stopped.changed() => {}
            () = self.follow() => {}
        }
    }

    async fn follow(&mut self) {
        let mut pause = RETRY_FIRST;
        loop {
            match self.watch(&mut pause).await {
                Ok(()) => tracing::info!("policy server closed the watch; asking again"),
                Err(error) => {
                    tracing::warn!(%error, ?pause, "cannot follow; the policy at hand goes on")
                }
            }
            tokio::time::sleep(pause).await;
            pause = (pause * 2).min(RETRY_MAX);
        }
    }

    /// One watch from its snapshot to its end.
    async fn watch(&mut self, pause: &mut Duration) -> Result<(), ClientError> {
        let mut events = self.client.watch(Some(&self.stream), 0).await?;
        while let Some(event) = events.next().await? {
            *pause = RETRY_FIRST;
            match event.change {
                WatchChange::Snapshot(manifests) => {
                    if let Some(newest) = manifests.iter().find(|m| m.stream == self.stream) {
                        self.consider(newest).await;
                    }
                }
                WatchChange::Published(manifest) => self.consider(&manifest).await,
                WatchChange::Progress => {}
            }
        }
        Ok(())
    }

    async fn consider(&mut self, manifest: &Manifest) {
        let policy = reference(manifest);
        if policy.sha256 == self.offered {
            return;
        }
        match self.keeper.take(&mut self.client, manifest).await {
            Ok(verified) => {
                self.offered = policy.sha256;
                self.slot.put(verified);
            }
            Err(error) => {
                if matches!(error, DeployError::Refused { .. }) {
                    self.offered = policy.sha256;
                }
                tracing::error!(%error, "the policy at hand goes on");
            }
        }
    }
}
