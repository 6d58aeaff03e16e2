//! Follows a stream while the robot walks: newer policies are fetched and verified here, and staged for the
//! loop.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use caudata_proto::registry::{LabelName, StreamName, WatchChange};
use caudata_registry_client::{RegistryClient, Watch, jittered};
use caudata_telemetry::Joined;
use tokio::sync::watch;

use crate::DeployError;
use crate::keeper::Keeper;
use crate::metrics::AgentMetrics;
use crate::server;
use crate::stage::Stage;
use crate::state::PolicyRef;
use crate::verify::Refusal;

/// First pause before a server that went away is tried again; doubles up to [`RETRY_MAX`].
pub const RETRY_FIRST: Duration = Duration::from_millis(500);
/// Longest pause between tries.
pub const RETRY_MAX: Duration = Duration::from_secs(30);
/// How often the server is asked where the label leads, also where it tells of no change: one that was made
/// to forget shows then.
pub const PROOF_EVERY: Duration = Duration::from_secs(60);
/// Without an answer that counts for this long, an alarm is raised; what runs goes on.
pub const STALE_AFTER: Duration = Duration::from_secs(600);

/// What to follow, and where.
#[derive(Clone, Debug)]
pub struct Follow {
    /// Address of the policy server.
    pub address: String,
    /// Certificates, where the address is an encrypted one.
    pub tls_dir: Option<PathBuf>,
    /// Stream.
    pub stream: StreamName,
    /// Label.
    pub label: LabelName,
}

/// A thread that follows one stream; dropped, it ends.
#[derive(Debug)]
pub struct Follower {
    _stop: watch::Sender<()>,
    _thread: Joined,
}

impl Follower {
    /// Starts following. `running` is the policy that runs already.
    ///
    /// # Errors
    /// [`DeployError::System`], [`DeployError::Server`] for a wrong address.
    pub fn start(
        keeper: Keeper,
        follow: Follow,
        running: PolicyRef,
        stage: Stage,
        metrics: AgentMetrics,
    ) -> Result<Self, DeployError> {
        let (runtime, client) = server::connect(&follow.address, follow.tls_dir.as_deref())?;
        let (_stop, stopped) = watch::channel(());
        let mut following = Following {
            keeper,
            client,
            follow,
            offered: running,
            stage,
            metrics,
            proved_at: Instant::now(),
            refused_for: None,
        };
        let follow = move || runtime.block_on(following.until(stopped));
        let _thread = Joined::spawn("follower", follow).map_err(DeployError::system("a thread"))?;
        Ok(Self { _stop, _thread })
    }
}

struct Following {
    keeper: Keeper,
    client: RegistryClient,
    follow: Follow,
    /// What was handed over, or refused, last.
    offered: PolicyRef,
    stage: Stage,
    metrics: AgentMetrics,
    /// When the server last said where the label leads, and it counted.
    proved_at: Instant,
    /// Why the newest version was refused; `None`: it was not.
    refused_for: Option<String>,
}

impl Following {
    async fn until(&mut self, mut stopped: watch::Receiver<()>) {
        tokio::select! {
            // The sender is gone.
            _ = stopped.changed() => {}
            () = self.run() => {}
        }
    }

    async fn run(&mut self) {
        let mut pause = RETRY_FIRST;
        loop {
            match self.watch(&mut pause).await {
                Ok(()) => tracing::info!("policy server closed the watch; asking again"),
                Err(error) => {
                    tracing::warn!(%error, ?pause, "cannot follow; the policy at hand goes on");
                }
            }
            self.raise_alarm(Instant::now());
            tokio::time::sleep(jittered(pause)).await;
            pause = (pause * 2).min(RETRY_MAX);
        }
    }

    /// One watch from its snapshot to its end.
    async fn watch(&mut self, pause: &mut Duration) -> Result<(), DeployError> {
        let stream = self.follow.stream.clone();
        let mut events = self.client.watch(Some(&stream), 0).await?;
        self.heed_quarantine().await?;
        while self.next_change(&mut events).await? {
            *pause = RETRY_FIRST;
            self.consider().await;
            self.raise_alarm(Instant::now());
        }
        Ok(())
    }

    /// Waits until there is something to ask for; false when the server closed the watch in order.
    async fn next_change(&mut self, events: &mut Watch) -> Result<bool, DeployError> {
        let asked = tokio::time::Instant::now();
        loop {
            let event = tokio::select! {
                event = events.next() => event?,
                () = tokio::time::sleep_until(asked + PROOF_EVERY) => return Ok(true),
            };
            let Some(event) = event else { return Ok(false) };
            match event.change {
                WatchChange::Progress => {}
                WatchChange::Quarantined(state) => {
                    if state.version == self.offered.version {
                        self.withdraw(&state.reason).await;
                    }
                    return Ok(true);
                }
                WatchChange::Snapshot(_)
                | WatchChange::Published(_)
                | WatchChange::LabelMoved(_) => return Ok(true),
            }
        }
    }

    /// While this robot was not listening, what it runs may have been taken out of use.
    async fn heed_quarantine(&mut self) -> Result<(), DeployError> {
        let stream = self.follow.stream.clone();
        let overview = self.client.overview(Some(&stream)).await?;
        let ours = |q: &&caudata_proto::registry::QuarantineState| {
            q.stream == stream && q.version == self.offered.version
        };
        if let Some(state) = overview.quarantined.iter().find(ours) {
            let reason = state.reason.clone();
            self.withdraw(&reason).await;
        }
        Ok(())
    }

    /// What runs is out of use: the last good one takes over, unless the label leads to something better in a
    /// moment.
    async fn withdraw(&mut self, reason: &str) {
        let policy = self.offered.clone();
        if policy.stream != self.follow.stream.as_str() {
            return;
        }
        self.keeper.withdraw(&policy, reason);
        match self.keeper.best() {
            Ok(Some(policy)) => self.offer(policy),
            Ok(None) => {
                tracing::error!(%policy, "nothing else is on this robot; it goes on until something comes")
            }
            Err(error) => tracing::error!(%error, "nothing else can run"),
        }
    }

    /// Asks where the label leads, and gets that ready where it is something else than what was offered last.
    async fn consider(&mut self) {
        let Follow { stream, label, .. } = self.follow.clone();
        let manifest = match self.keeper.announced(&mut self.client, &stream, &label).await {
            Ok(manifest) => manifest,
            Err(error) => {
                tracing::warn!(%error, "the policy at hand goes on");
                return;
            }
        };
        self.proved_at = Instant::now();
        let policy = PolicyRef::from(&manifest);
        if policy == self.offered {
            return;
        }
        match self.keeper.take(&mut self.client, &manifest).await {
            Ok(verified) => {
                if self.refused_for.take().is_some() {
                    tracing::info!(policy = %verified.policy, "a version that may run on this robot is there again");
                }
                self.offer(verified.policy);
            }
            Err(DeployError::Refused { refusal, .. }) => {
                self.offered = policy.clone();
                self.refused(&policy, *refusal);
            }
            Err(error) => tracing::error!(%error, "the policy at hand goes on"),
        }
    }

    /// Tells of a refusal once, however many versions come that must be refused for the same: what follows
    /// would only hide it. Each of them is reported to the server.
    fn refused(&mut self, policy: &PolicyRef, refusal: Refusal) {
        let reason = match refusal {
            Refusal::Before(reason) => reason,
            other => other.to_string(),
        };
        if self.refused_for.as_ref() == Some(&reason) {
            tracing::debug!(%policy, reason, "refused for the same");
            return;
        }
        tracing::error!(
            %policy,
            reason,
            "the newest version may not run on this robot; the policy at hand goes on, and versions with the same fault are not told of again"
        );
        self.refused_for = Some(reason);
    }

    fn offer(&mut self, policy: PolicyRef) {
        self.offered = policy.clone();
        if let Err(error) = self.stage.offer(policy) {
            tracing::error!(%error, "the policy at hand goes on");
        }
    }

    /// Says so, once, where no answer has counted for too long at `now`; and takes it back where one has.
    fn raise_alarm(&self, now: Instant) {
        let since = now.saturating_duration_since(self.proved_at);
        let stale = since > STALE_AFTER;
        if stale && self.metrics.stale.get() == 0 {
            let since_s = since.as_secs();
            tracing::error!(since_s, "no policy server says what is newest; what runs goes on");
        }
        self.metrics.stale.set(i64::from(stale));
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
    use std::path::Path;
    use std::sync::Arc;

    use caudata_policy::PolicyFile;
    use caudata_policy_server::{
        ServeOptions, ServerMetrics, SharedStore, Store, StoreLimits, listen, serve_with,
    };
    use caudata_registry_client::manifest_of;
    use caudata_signing::{ReleaseKey, Trust};

    use super::*;
    use crate::boundary::RunFolder;
    use crate::store::PolicyStore;
    use crate::testing::{model, standing};

    fn stream() -> StreamName {
        StreamName::new("s").unwrap()
    }

    fn release() -> ReleaseKey {
        ReleaseKey::from_seed("release", &[7; 32])
    }

    fn server_key() -> ReleaseKey {
        ReleaseKey::from_seed("server", &[9; 32])
    }

    /// A server with version 1 that proves freshness with `key`.
    async fn server(folder: &Path, key: ReleaseKey) -> (SocketAddr, watch::Sender<bool>) {
        let store = Store::open(folder, StoreLimits::default()).unwrap();
        let listener = listen("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let address = listener.local_addr().unwrap();
        let metrics = ServerMetrics::register(&caudata_telemetry::Metrics::new());
        let (stop, stopped) = watch::channel(false);
        let options = ServeOptions { fresh_key: Some(Arc::new(key)), ..ServeOptions::default() };
        tokio::spawn(serve_with(listener, SharedStore::new(store), metrics, stopped, options));
        let mut client = RegistryClient::new(&address.to_string()).unwrap();
        let file = PolicyFile::parse(standing(1).into()).unwrap();
        let mut manifest = manifest_of(stream(), &file, 5).unwrap();
        release().sign(&mut manifest);
        client.publish(manifest, file.bytes()).await.unwrap();
        (address, stop)
    }

    /// Somebody who follows the server at `address`, since `proved_at`.
    fn following(folder: &Path, address: &str, proved_at: Instant) -> Following {
        let text = release().trust_file() + &server_key().trust_lines("fresh_key");
        let metrics = AgentMetrics::register(&caudata_telemetry::Metrics::new());
        let store = PolicyStore::open(&folder.join("state")).unwrap();
        let mut keeper = Keeper::new(store, model(), metrics.clone());
        keeper.trust = Some(Arc::new(Trust::parse(&text).unwrap()));
        let run = RunFolder::open(&folder.join("run")).unwrap();
        Following {
            stage: Stage::open(keeper.clone(), run),
            keeper,
            client: RegistryClient::new(address).unwrap(),
            follow: Follow {
                address: address.to_owned(),
                tls_dir: None,
                stream: stream(),
                label: LabelName::latest(),
            },
            offered: PolicyRef {
                stream: "s".to_owned(),
                version: 0,
                sha256: crate::state::Sha256Digest([0; 32]),
                reverts_to: None,
            },
            metrics,
            proved_at,
            refused_for: None,
        }
    }

    #[test]
    fn fault_17_ten_minutes_without_an_answer_that_counts_raise_an_alarm() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let folder = tempfile::tempdir().unwrap();
            let begun = Instant::now();
            // One that is nobody's, one that signs with a key which this robot does not know, one that signs
            // as it should.
            let stranger = ReleaseKey::from_seed("server", &[8; 32]);
            let (forged, stop) = server(&folder.path().join("forged"), stranger).await;
            let (good, stop_good) = server(&folder.path().join("good"), server_key()).await;
            let nobody = "127.0.0.1:1".parse().unwrap();
            let robots = [nobody, forged, good].map(|address: SocketAddr| {
                let folder = folder.path().join(address.port().to_string());
                std::fs::create_dir(&folder).unwrap();
                following(&folder, &address.to_string(), begun)
            });
            for (mut robot, counts) in robots.into_iter().zip([false, false, true]) {
                let alarm = robot.metrics.stale.clone();
                robot.consider().await;
                // The ten minutes begin anew with an answer that counts, and with no other.
                let asked = robot.follow.address.clone();
                assert_eq!(robot.proved_at > begun, counts, "{asked}");
                let proved_at = robot.proved_at;
                let at = |s| proved_at + Duration::from_secs(s);
                robot.raise_alarm(at(600));
                assert_eq!(alarm.get(), 0, "ten minutes are not more than ten minutes");
                robot.raise_alarm(at(601));
                assert_eq!(alarm.get(), 1, "{asked}");
                // What runs goes on: nothing was withdrawn, nothing refused for good.
                assert!(robot.refused_for.is_none());
                // An answer that counts ends it.
                let later = at(700);
                robot.proved_at = later;
                robot.raise_alarm(later);
                assert_eq!(alarm.get(), 0, "{asked}");
            }
            stop.send(true).unwrap();
            stop_good.send(true).unwrap();
        });
    }
}
