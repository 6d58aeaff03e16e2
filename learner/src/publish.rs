//! Policies to the policy server, in the background: a server that is slow or gone never holds training up.

use std::path::Path;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use caudata_policy::PolicyFile;
use caudata_proto::registry::StreamName;
use caudata_registry_client::{ClientError, RegistryClient, manifest_of};
use caudata_telemetry::{progress, unix_ms};
use crossbeam_channel::{Receiver, Sender, bounded};

use crate::LearnerError;

/// First pause before a failed publication is tried again; doubles up to [`RETRY_PAUSE_MAX`].
const RETRY_PAUSE: Duration = Duration::from_millis(250);
/// Longest pause between two tries.
const RETRY_PAUSE_MAX: Duration = Duration::from_secs(10);
/// What may wait to be told to the training loop; further notices are only logged.
const NOTICES_MAX: usize = 64;

/// What happened in the background.
#[derive(Clone, Debug, PartialEq)]
pub enum Notice {
    /// A policy is on the server.
    Published(progress::Published),
    /// A try failed; it goes on if it can help.
    Failed {
        /// Version that was to be published.
        version: u64,
        /// Why not, in one line.
        reason: String,
        /// Whether it is tried again.
        again: bool,
    },
}

/// The background task. Latest wins: a policy that waits is replaced by the next one. Ends when dropped, at
/// once unless [`Publisher::finish`] was called before.
#[derive(Debug)]
pub struct Publisher {
    shared: Arc<Shared>,
    notices: Receiver<Notice>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    waiting: Option<PolicyFile>,
    /// A publication is under way.
    busy: bool,
    closed: bool,
}

impl Publisher {
    /// Publishes to the server at `address` (`host:port`, or `https://` with the certificates in `tls_dir`)
    /// as `stream`. Nothing is sent yet, and the server need not be there.
    ///
    /// # Errors
    /// An address or stream name that is none, certificates that do not work, or the system refuses the
    /// thread.
    pub fn start(
        address: &str,
        stream: &str,
        tls_dir: Option<&Path>,
    ) -> Result<Self, LearnerError> {
        let stream = StreamName::new(stream)
            .map_err(|error| LearnerError::setting(format!("policy_server.stream: {error}")))?;
        // With a thread of its own: between two publications the connection still answers the server's
        // questions whether it is alive.
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("publish-io")
            .enable_all()
            .build()
            .map_err(LearnerError::Thread)?;
        let client = {
            let _context = runtime.enter();
            RegistryClient::with_tls(address, tls_dir)?
        };
        let shared = Arc::new(Shared::default());
        let (sender, notices) = bounded(NOTICES_MAX);
        let worker =
            Worker { shared: Arc::clone(&shared), client, stream, runtime, notices: sender };
        let thread = std::thread::Builder::new()
            .name("publish".into())
            .spawn(move || worker.run())
            .map_err(LearnerError::Thread)?;
        Ok(Self { shared, notices, thread: Some(thread) })
    }

    /// Hands a policy over; one that still waits is given up for it.
    pub fn publish(&self, policy: PolicyFile) {
        self.shared.lock().waiting = Some(policy);
        self.shared.changed.notify_all();
    }

    /// What has happened since the last call.
    pub fn notices(&self) -> Vec<Notice> {
        self.notices.try_iter().collect()
    }

    /// Waits until nothing is left to publish, at most `patience`; false when something is.
    pub fn finish(&self, patience: Duration) -> bool {
        let deadline = Instant::now() + patience;
        let mut state = self.shared.lock();
        while state.busy || state.waiting.is_some() {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            state = self.shared.wait(state, left);
        }
        true
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>, timeout: Duration) -> MutexGuard<'a, State> {
        self.changed.wait_timeout(state, timeout).unwrap_or_else(PoisonError::into_inner).0
    }
}

struct Worker {
    shared: Arc<Shared>,
    client: RegistryClient,
    stream: StreamName,
    runtime: tokio::runtime::Runtime,
    notices: Sender<Notice>,
}

impl Worker {
    fn run(mut self) {
        while let Some(policy) = self.next() {
            self.deliver(&policy);
            self.shared.lock().busy = false;
            self.shared.changed.notify_all();
        }
    }

    /// Waits for a policy; `None` once closed.
    fn next(&self) -> Option<PolicyFile> {
        let mut state = self.shared.lock();
        loop {
            if state.closed {
                return None;
            }
            if let Some(policy) = state.waiting.take() {
                state.busy = true;
                return Some(policy);
            }
            state = self.shared.wait(state, RETRY_PAUSE_MAX);
        }
    }

    /// Tries until it succeeds, cannot, is replaced by a newer policy, or is told to stop.
    fn deliver(&mut self, policy: &PolicyFile) {
        let version = policy.metadata().version;
        let mut pause = RETRY_PAUSE;
        loop {
            let Err((reason, again)) = self.attempt(policy) else {
                return self.tell(Notice::Published(progress::Published {
                    version,
                    sha256: policy.sha256_hex(),
                    bytes: policy.bytes().len() as u64,
                }));
            };
            self.tell(Notice::Failed { version, reason, again });
            if !again || self.is_over_after(pause) {
                return;
            }
            pause = (pause * 2).min(RETRY_PAUSE_MAX);
        }
    }

    /// One try; on failure one line and whether trying again can help. Ends early when the publisher is
    /// closed.
    fn attempt(&mut self, policy: &PolicyFile) -> Result<(), (String, bool)> {
        let manifest = manifest_of(self.stream.clone(), policy, unix_ms())
            .map_err(|error| (error.to_string(), false))?;
        let shared = Arc::clone(&self.shared);
        let Self { client, runtime, .. } = self;
        runtime.block_on(async {
            let call = client.publish(manifest, policy.bytes());
            let closed = async {
                while !shared.lock().closed {
                    tokio::time::sleep(RETRY_PAUSE).await;
                }
            };
            tokio::select! {
                answer = call => match answer {
                    Ok(_) => Ok(()),
                    Err(error) => Err((error.to_string(), may_pass(&error))),
                },
                () = closed => Err(("given up at the end of the run".to_owned(), false)),
            }
        })
    }

    /// Waits; true when this policy need not be tried again.
    fn is_over_after(&self, pause: Duration) -> bool {
        let deadline = Instant::now() + pause;
        let mut state = self.shared.lock();
        loop {
            if state.closed || state.waiting.is_some() {
                return true;
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            state = self.shared.wait(state, left);
        }
    }

    fn tell(&self, notice: Notice) {
        match &notice {
            Notice::Published(done) => {
                tracing::info!(version = done.version, sha256 = done.sha256, "published");
            }
            Notice::Failed { version, reason, again } => {
                tracing::warn!(version, reason, again, "publishing failed");
            }
        }
        let _ = self.notices.try_send(notice);
    }
}

/// A full server may have room later; everything else that is not about the network stays as it is.
fn may_pass(error: &ClientError) -> bool {
    let full = matches!(
        error,
        ClientError::Refused { code, .. } if *code == tonic::Code::ResourceExhausted
    );
    error.is_transient() || full
}
