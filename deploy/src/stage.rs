//! The agent's end of staging: which policy the loop is to run, counted on the disk before the loop may load
//! it.

use std::sync::{Arc, Mutex, PoisonError};

use crate::DeployError;
use crate::boundary::{Answer, RunFolder, STAGED_FORMAT, Staged};
use crate::keeper::Keeper;
use crate::state::PolicyRef;
use crate::updates::PolicyEvent;

/// Policies that may turn out not to run, one after the other, before a loop that asks gets none.
const TRIES_MAX: u32 = 4;

/// What is staged. Cloning shares it.
#[derive(Clone, Debug)]
pub struct Stage {
    keeper: Keeper,
    folder: RunFolder,
    inner: Arc<Mutex<Inner>>,
}

#[derive(Debug)]
struct Inner {
    /// Number of the newest `staged.json`.
    number: u64,
    /// The start of the loop that asked last.
    run: Option<u64>,
    /// What it gets.
    chosen: Option<PolicyRef>,
}

impl Stage {
    /// Goes on after what another agent has staged for a loop that is still there.
    pub fn open(keeper: Keeper, folder: RunFolder) -> Self {
        let old = Staged::read(&folder);
        let alive = old.as_ref().filter(|_| folder.has_loop());
        let inner = Inner {
            number: old.as_ref().map_or(0, |staged| staged.number),
            run: alive.map(|staged| staged.run),
            chosen: alive.and_then(|staged| match &staged.answer {
                Answer::Policy { policy, .. } => Some(policy.clone()),
                Answer::Nothing { .. } => None,
            }),
        };
        Self { keeper, folder, inner: Arc::new(Mutex::new(inner)) }
    }

    /// What a loop runs already.
    pub fn running(&self) -> Option<PolicyRef> {
        self.lock().chosen.clone()
    }

    /// What the next loop that asks gets.
    pub fn choose(&self, policy: PolicyRef) {
        self.lock().chosen = Some(policy);
    }

    /// Stages `policy` for the loop that is there; where there is none, for the next one.
    ///
    /// # Errors
    /// [`DeployError::Refused`] where it was begun with too often; what the disk says.
    pub fn offer(&self, policy: PolicyRef) -> Result<(), DeployError> {
        let mut inner = self.lock();
        if let Some(run) = inner.run.filter(|_| self.folder.has_loop()) {
            self.write(&mut inner, run, policy.clone())?;
        }
        inner.chosen = Some(policy);
        Ok(())
    }

    /// Deals with one event of the loop.
    pub fn hear(&self, event: PolicyEvent) {
        let (asks, unfit) = match &event {
            PolicyEvent::Ready { run } => (Some(*run), None),
            PolicyEvent::Unfit { policy, reason } => {
                (self.lock().run, Some((policy.clone(), reason.clone())))
            }
            _ => (None, None),
        };
        if let Err(error) = self.keeper.note(event) {
            tracing::error!(%error, "cannot write down what was learnt about a policy");
        }
        if let Some(run) = asks {
            self.answer(run, unfit.as_ref());
        }
    }

    /// A loop asks: it gets what was chosen, or the next best that may run; where there is none, it is told
    /// that, so that it does not wait and does not ask again.
    fn answer(&self, run: u64, unfit: Option<&(PolicyRef, String)>) {
        let mut inner = self.lock();
        inner.run = Some(run);
        let is_unfit = |policy: &PolicyRef| unfit.is_some_and(|(found, _)| found == policy);
        let mut why = match unfit {
            Some((policy, reason)) => format!("{policy}: {reason}"),
            None => "there is none, on this robot or on the server".to_owned(),
        };
        let mut next = inner.chosen.clone().filter(|chosen| !is_unfit(chosen));
        for _ in 0..TRIES_MAX {
            let found = next.take().map_or_else(|| self.keeper.best(), |policy| Ok(Some(policy)));
            let policy = match found {
                Ok(Some(policy)) if !is_unfit(&policy) => policy,
                Ok(_) => break,
                Err(error) => {
                    why = error.to_string();
                    break;
                }
            };
            match self.write(&mut inner, run, policy.clone()) {
                Ok(()) => {
                    inner.chosen = Some(policy);
                    return;
                }
                Err(error @ DeployError::Refused { .. }) => {
                    tracing::error!(%error, "the next best");
                    why = error.to_string();
                }
                // A disk that takes no count of attempts lets only those run that need none.
                Err(error) => {
                    tracing::error!(%error, %policy, "cannot be staged");
                    why = error.to_string();
                    next = self.keeper.proved().filter(|proved| *proved != policy);
                    if next.is_none() {
                        break;
                    }
                }
            }
        }
        tracing::error!(why, "no policy may run on this robot");
        inner.chosen = None;
        let nothing = Answer::Nothing { reason: why };
        if let Err(error) = self.put(&mut inner, run, nothing) {
            tracing::error!(%error, "nothing can be staged");
        }
    }

    fn write(&self, inner: &mut Inner, run: u64, policy: PolicyRef) -> Result<(), DeployError> {
        let proved = self.keeper.begin(&policy)?;
        self.put(inner, run, Answer::Policy { policy, proved })
    }

    fn put(&self, inner: &mut Inner, run: u64, answer: Answer) -> Result<(), DeployError> {
        let staged =
            Staged { format: STAGED_FORMAT.to_owned(), number: inner.number + 1, run, answer };
        staged.write(&self.folder)?;
        inner.number = staged.number;
        Ok(())
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use caudata_policy::PolicyFile;
    use caudata_proto::registry::StreamName;
    use caudata_registry_client::{RegistryClient, manifest_of};
    use caudata_rehearsal::Rehearsal;
    use sha2::{Digest, Sha256};

    use super::*;
    use crate::metrics::AgentMetrics;
    use crate::state::Sha256Digest;
    use crate::store::PolicyStore;
    use crate::testing::{model, standing};

    /// No space left; a read-only file system.
    const REFUSALS: [i32; 2] = [28, 30];

    fn policy(version: u64) -> PolicyRef {
        PolicyRef {
            stream: "s".to_owned(),
            version,
            sha256: Sha256Digest(Sha256::digest(standing(version)).into()),
            reverts_to: None,
        }
    }

    /// A keeper of a robot on which version 1 ran well and version 2 is active, over a disk that can fail.
    fn keeper(folder: &Path) -> (Keeper, Arc<Rehearsal>) {
        let mut store = PolicyStore::open(folder).unwrap();
        for version in [1, 2] {
            store.put(&policy(version), &standing(version)).unwrap();
            store.update(|s| s.adopt(policy(version))).unwrap();
            if version == 1 {
                store.update(|s| s.confirm(policy(1).sha256)).unwrap();
            }
        }
        drop(store);
        let disk = Arc::new(Rehearsal::new(folder).unwrap());
        let store = PolicyStore::open_on(disk.clone(), folder).unwrap();
        let metrics = AgentMetrics::register(&caudata_telemetry::Metrics::new());
        (Keeper::new(store, model(), metrics), disk)
    }

    fn staged(run: &RunFolder) -> Answer {
        Staged::read(run).unwrap().answer
    }

    #[test]
    fn fault_30_on_a_card_that_takes_nothing_the_last_good_policy_runs() {
        for error in REFUSALS {
            let folder = tempfile::tempdir().unwrap();
            let run = RunFolder::open(&folder.path().join("run")).unwrap();
            let (keeper, disk) = keeper(&folder.path().join("state"));
            let stage = Stage::open(keeper, run.clone());
            stage.choose(policy(2));
            disk.fail_writes_at(disk.steps(), error);
            // Version 2 is on trial: without a count of its attempts it might take the program down for ever.
            stage.hear(PolicyEvent::Ready { run: 7 });
            let answer = Answer::Policy { policy: policy(1), proved: true };
            assert_eq!(staged(&run), answer);
            // With space again version 2 has its turn.
            disk.heal();
            stage.choose(policy(2));
            stage.hear(PolicyEvent::Ready { run: 8 });
            let answer = Answer::Policy { policy: policy(2), proved: false };
            assert_eq!(staged(&run), answer);
        }
    }

    #[test]
    fn fault_30_a_card_that_takes_nothing_is_not_fetched_for_again_and_again() {
        let folder = tempfile::tempdir().unwrap();
        let (keeper, disk) = keeper(&folder.path().join("state"));
        let file = PolicyFile::parse(standing(3).into()).unwrap();
        let manifest = manifest_of(StreamName::new("s").unwrap(), &file, 5).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            // Nobody is there: whoever asks the network finds that out.
            let mut client = RegistryClient::new("127.0.0.1:1").unwrap();
            let asked = keeper.take(&mut client, &manifest).await.unwrap_err();
            assert!(matches!(asked, DeployError::Server(_)), "{asked}");
            disk.fail_writes_at(disk.steps(), REFUSALS[1]);
            let refused = keeper.take(&mut client, &manifest).await.unwrap_err();
            assert!(matches!(refused, DeployError::Durable(_)), "{refused}");
        });
    }

    #[test]
    fn a_loop_is_told_where_nothing_may_run() {
        let folder = tempfile::tempdir().unwrap();
        let run = RunFolder::open(&folder.path().join("run")).unwrap();
        let store = PolicyStore::open(&folder.path().join("state")).unwrap();
        let metrics = AgentMetrics::register(&caudata_telemetry::Metrics::new());
        let stage = Stage::open(Keeper::new(store, model(), metrics), run.clone());
        stage.hear(PolicyEvent::Ready { run: 7 });
        assert!(matches!(staged(&run), Answer::Nothing { .. }));
        // The loop's own refusal of what was staged is the reason that it hears.
        stage.choose(policy(5));
        stage.hear(PolicyEvent::Unfit { policy: policy(5), reason: "joint 2 differs".to_owned() });
        let Answer::Nothing { reason } = staged(&run) else {
            panic!("something is staged");
        };
        assert_eq!(reason, "s version 5: joint 2 differs");
    }
}
