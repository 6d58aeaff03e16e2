//! Tells the policy server what became of versions on this robot, from a thread of its own: nobody waits for
//! it, and a server that is away gets the news later.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use caudata_proto::registry::{RobotReport, RobotState, StreamName};
use caudata_registry_client::{ClientError, RegistryClient, jittered};
use caudata_telemetry::Joined;
use crossbeam_channel::{Receiver, Sender, bounded};

use crate::DeployError;
use crate::server;
use crate::state::PolicyRef;

/// Reports that wait; with more, the newest is dropped with a line in the log.
const REPORTS_WAITING_MAX: usize = 64;
/// How long the last reports of a run may take.
const FLUSH_MAX: Duration = Duration::from_secs(2);
/// First pause before a server that is away is tried again; doubles.
const RETRY_FIRST: Duration = Duration::from_millis(500);
/// Longest pause.
const RETRY_MAX: Duration = Duration::from_secs(30);

/// What is told of a version besides its name.
#[derive(Clone, Debug, Default)]
pub struct News {
    /// Why it did not go well.
    pub reason: String,
    /// How long it drove the robot, s.
    pub walked_s: f64,
    /// Falls in its trial.
    pub falls: u32,
    /// How often it was begun with.
    pub attempts: u32,
}

/// The thread. Dropped, it sends what waits for at most two seconds and ends.
#[derive(Debug)]
pub struct Reporter {
    robot: String,
    queue: Sender<RobotReport>,
    over: Arc<AtomicBool>,
    _thread: Joined,
}

impl Reporter {
    /// Starts it.
    ///
    /// # Errors
    /// [`DeployError::System`], [`DeployError::Server`] for a wrong address or certificates.
    pub fn start(
        address: &str,
        tls_dir: Option<&Path>,
        robot: String,
    ) -> Result<Arc<Self>, DeployError> {
        let (runtime, client) = server::connect(address, tls_dir)?;
        let (queue, reports) = bounded(REPORTS_WAITING_MAX);
        let over = Arc::new(AtomicBool::new(false));
        let seen = over.clone();
        let report = move || runtime.block_on(send(client, reports, seen));
        let _thread = Joined::spawn("reporter", report).map_err(DeployError::system("a thread"))?;
        Ok(Arc::new(Self { robot, queue, over, _thread }))
    }

    /// Tells what became of `policy`. Never waits.
    pub fn tell(&self, policy: &PolicyRef, state: RobotState, news: News) {
        let Ok(stream) = StreamName::new(&policy.stream) else { return };
        let mut reason: String = news.reason.chars().filter(|c| !c.is_control()).collect();
        while reason.len() > caudata_proto::registry::MAX_REASON {
            reason.pop();
        }
        let report = RobotReport {
            robot: self.robot.clone(),
            stream,
            version: policy.version,
            sha256: policy.sha256.0,
            state,
            reason,
            walked_s: news.walked_s,
            falls: news.falls,
            attempts: news.attempts,
            unix_ms: 0,
        };
        if self.queue.try_send(report).is_err() {
            tracing::warn!(%policy, "a report to the policy server is dropped: too many wait");
        }
    }
}

impl Drop for Reporter {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

/// Sends until the queue is closed, and then what is left for a short while.
async fn send(mut client: RegistryClient, reports: Receiver<RobotReport>, over: Arc<AtomicBool>) {
    let mut last_chance: Option<Instant> = None;
    for report in reports {
        let mut pause = RETRY_FIRST;
        loop {
            let error = match tokio::time::timeout(FLUSH_MAX, client.report(report.clone())).await {
                Ok(Ok(())) => break,
                Ok(Err(error)) => error,
                Err(_) => ClientError::TimedOut { what: "report" },
            };
            if !error.is_transient() {
                tracing::warn!(%error, version = report.version, "the policy server does not take the report");
                break;
            }
            if over.load(Ordering::Relaxed)
                && last_chance.get_or_insert_with(Instant::now).elapsed() > FLUSH_MAX
            {
                tracing::warn!(%error, "the last reports did not reach the policy server");
                return;
            }
            pause_until(jittered(pause), &over).await;
            pause = (pause * 2).min(RETRY_MAX);
        }
    }
}

/// Waits, but not long after the run is over.
async fn pause_until(pause: Duration, over: &AtomicBool) {
    let end = Instant::now() + pause;
    while Instant::now() < end {
        tokio::time::sleep(Duration::from_millis(100).min(pause)).await;
        if over.load(Ordering::Relaxed) {
            return;
        }
    }
}
