//! The loop's process beside the loop: a thread that loads what the agent stages, checks it again, and writes
//! down what the loop tells. It may wait for the disk; the loop does not wait for it.

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use caudata_model::RobotModel;
use caudata_signing::Trust;
use caudata_task::layout::Part;
use caudata_telemetry::{Metrics, StopFlag};
use crossbeam_channel::{Receiver, RecvTimeoutError};

use crate::DeployError;
use crate::boundary::{Answer, FACTORY, RunFolder, Staged, Teller};
use crate::keeper::read_factory;
use crate::state::PolicyRef;
use crate::store::read_policy;
use crate::updates::{PolicyEvent, Slot};
use crate::verify::{Refusal, Verified, verify};

/// How often it looks whether something is staged.
const COURIER_LOOK: Duration = Duration::from_millis(100);
/// How often the page of metrics is written.
const METRICS_EVERY: Duration = Duration::from_secs(1);
/// How long the first policy is waited for.
pub const ANSWER_MAX: Duration = Duration::from_secs(60);

/// Loads what is staged: every check that the agent made is made here again, on the bytes that will run.
#[derive(Clone, Debug)]
pub struct Loader {
    /// The robot.
    pub model: Arc<RobotModel>,
    /// The state folder.
    pub state: PathBuf,
    /// Whose signatures count; `None`: nobody needs to have signed.
    pub trust: Option<Arc<Trust>>,
    /// The policy that came with the program.
    pub factory: Option<PathBuf>,
    /// Whether the robot has a sensor for water.
    pub tells_water: bool,
}

impl Loader {
    /// `policy`; `proved`: it went through its trial on this robot before.
    ///
    /// # Errors
    /// [`DeployError::Refused`] where it must not run, else what the disk says.
    pub fn load(&self, policy: &PolicyRef, proved: bool) -> Result<Verified, DeployError> {
        let mut verified = match &self.factory {
            // The file that this process was started with, whatever the agent may say.
            Some(file) if policy.stream == FACTORY => read_factory(file, &self.model)?,
            _ => {
                let bytes = read_policy(&self.state, policy, self.trust.as_deref())?;
                let verified = verify(bytes, policy, &self.model);
                verified.map_err(|error| DeployError::unverified(policy, error))?
            }
        };
        let observed = &verified.file.metadata().contract.observation;
        if !self.tells_water && !observed.range(Part::Medium).is_empty() {
            return Err(DeployError::refused(policy, Refusal::CannotTell));
        }
        verified.proved = proved;
        Ok(verified)
    }
}

/// What the courier carries.
#[derive(Debug)]
pub struct Courier {
    folder: RunFolder,
    teller: Teller,
    loader: Loader,
    /// This start of the loop.
    run: u64,
    /// Number of the newest staged policy that was looked at.
    seen: u64,
    /// Loaded last.
    loaded: Option<PolicyRef>,
    metrics: Option<(Metrics, PathBuf)>,
}

impl Courier {
    /// `run` is a number that no start of the loop had before. `metrics`: a page that is kept in a file.
    pub fn new(
        folder: RunFolder,
        teller: Teller,
        loader: Loader,
        run: u64,
        metrics: Option<(Metrics, PathBuf)>,
    ) -> Self {
        Staged::clear(&folder);
        // Figures of a loop that is gone are no figures of this one.
        if let Some((_, file)) = &metrics {
            let _ = std::fs::remove_file(file);
        }
        Self { folder, teller, loader, run, seen: 0, loaded: None, metrics }
    }

    /// Says that the robot is there, and waits for the first policy; `None` when asked to stop before.
    ///
    /// # Errors
    /// [`DeployError::NoAgent`]; [`DeployError::NothingFits`]; what the disk says.
    pub fn first(&mut self, stop: &StopFlag) -> Result<Option<Verified>, DeployError> {
        self.teller.tell(&PolicyEvent::Ready { run: self.run })?;
        let end = Instant::now() + ANSWER_MAX;
        while !stop.is_set() {
            match self.look() {
                Some(Ok(verified)) => return Ok(Some(verified)),
                // The agent was told, and finds another one.
                Some(Err(DeployError::Refused { .. })) => {}
                Some(Err(error)) => return Err(error),
                None if Instant::now() > end => {
                    let waited_s = ANSWER_MAX.as_secs();
                    return Err(DeployError::NoAgent { waited_s });
                }
                None => {
                    stop.wait(COURIER_LOOK / 4);
                }
            }
        }
        Ok(None)
    }

    /// Carries until the loop is gone: `events` is closed then, and everything told is on the disk.
    ///
    /// # Errors
    /// [`DeployError::System`].
    pub fn start(
        mut self,
        events: Receiver<PolicyEvent>,
        slot: Slot,
    ) -> Result<JoinHandle<()>, DeployError> {
        let work = move || {
            let mut written = Instant::now();
            let mut looked = Instant::now();
            loop {
                match events.recv_timeout(COURIER_LOOK) {
                    // Taking it apart takes longer than the loop has.
                    Ok(PolicyEvent::Replaced(runner)) => drop(runner),
                    Ok(event) => {
                        if let Err(error) = self.teller.tell(&event) {
                            tracing::error!(%error, ?event, "an event is lost");
                        }
                    }
                    Err(RecvTimeoutError::Timeout) => {}
                    Err(RecvTimeoutError::Disconnected) => {
                        if let Some((_, file)) = &self.metrics {
                            let _ = std::fs::remove_file(file);
                        }
                        return;
                    }
                }
                if looked.elapsed() >= COURIER_LOOK {
                    looked = Instant::now();
                    match self.look() {
                        Some(Ok(verified)) => slot.put(verified),
                        Some(Err(error)) => tracing::error!(%error, "the policy at hand goes on"),
                        None => {}
                    }
                }
                if written.elapsed() >= METRICS_EVERY {
                    written = Instant::now();
                    self.write_metrics();
                }
            }
        };
        std::thread::Builder::new()
            .name("courier".into())
            .spawn(work)
            .map_err(DeployError::system("a thread"))
    }

    /// What is staged for this start and was not looked at yet.
    fn look(&mut self) -> Option<Result<Verified, DeployError>> {
        let staged = Staged::read(&self.folder)?;
        if staged.run != self.run || staged.number <= self.seen {
            return None;
        }
        self.seen = staged.number;
        let (policy, proved) = match staged.answer {
            Answer::Policy { policy, proved } => (policy, proved),
            Answer::Nothing { reason } => return Some(Err(DeployError::NothingFits { reason })),
        };
        if self.loaded.as_ref() == Some(&policy) {
            return None;
        }
        let loaded = self.loader.load(&policy, proved);
        if let Err(DeployError::Refused { refusal, .. }) = &loaded {
            // As it was staged: what lies there now may be something else, which nobody staged.
            let unfit = PolicyEvent::Unfit { policy: policy.clone(), reason: refusal.to_string() };
            if let Err(error) = self.teller.tell(&unfit) {
                tracing::error!(%error, "a refusal is lost");
            }
        }
        self.loaded = loaded.is_ok().then_some(policy);
        Some(loaded)
    }

    fn write_metrics(&self) {
        if let Some((metrics, file)) = &self.metrics
            && let Err(error) = metrics.write_page(file)
        {
            tracing::debug!(%error, "the page of metrics is not written");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{model, policy_file};
    use caudata_task::{PolicyContract, TaskConfig};

    #[test]
    fn a_policy_that_observes_water_is_refused_where_nothing_tells() {
        let task = TaskConfig { observe_medium: true, ..TaskConfig::default() };
        let bytes = policy_file(1, |spec, metadata| {
            metadata.contract = PolicyContract::new(&model(), &task).unwrap();
            spec.obs_mean.push(0.0);
            spec.obs_std.push(1.0);
            spec.layers[0].input = 98;
            spec.layers[0].weight.resize(98 * 16, 0.0);
        });
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("swims.onnx");
        std::fs::write(&file, &bytes).unwrap();
        let policy = read_factory(&file, &model()).unwrap().policy;
        let loader = |tells_water| Loader {
            model: model(),
            state: folder.path().to_owned(),
            trust: None,
            factory: Some(file.clone()),
            tells_water,
        };
        loader(true).load(&policy, false).unwrap();
        let error = loader(false).load(&policy, false).unwrap_err().to_string();
        assert!(error.contains("[water] file"), "{error}");
    }
}
