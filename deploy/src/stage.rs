//! The agent's end of staging: which policy the loop is to run, counted on the disk before the loop may load it.

use std::sync::{Arc, Mutex, PoisonError};

use crate::DeployError;
use crate::boundary::{RunFolder, STAGED_FORMAT, Staged};
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
    /// Of the newest `staged.json`.
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
            chosen: alive.map(|staged| staged.policy.clone()),
        };
        Self {
            keeper,
            folder,
            inner: Arc::new(Mutex::new(inner)),
        }
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
            PolicyEvent::Unfit { policy, .. } => (self.lock().run, Some(policy.clone())),
            _ => (None, None),
        };
        if let Err(error) = self.keeper.note(event) {
            tracing::error!(%error, "cannot write down what was learnt about a policy");
        }
        if let Some(run) = asks {
            self.answer(run, unfit.as_ref());
        }
    }

    /// A loop asks: it gets what was chosen, or the next best that may run.
    fn answer(&self, run: u64, unfit: Option<&PolicyRef>) {
        let mut inner = self.lock();
        inner.run = Some(run);
        let mut next = inner.chosen.clone().filter(|chosen| Some(chosen) != unfit);
        for _ in 0..TRIES_MAX {
            let policy = match next
                .take()
                .map_or_else(|| self.keeper.best(), |p| Ok(Some(p)))
            {
                Ok(Some(policy)) if Some(&policy) != unfit => policy,
                Ok(_) => break,
                Err(error) => return tracing::error!(%error, "nothing can run"),
            };
            match self.write(&mut inner, run, policy.clone()) {
                Ok(()) => {
                    inner.chosen = Some(policy);
                    return;
                }
                Err(error @ DeployError::Refused { .. }) => {
                    tracing::error!(%error, "the next best")
                }
                Err(error) => return tracing::error!(%error, "nothing can be staged"),
            }
        }
        tracing::error!("no policy is left that may run");
    }

    fn write(&self, inner: &mut Inner, run: u64, policy: PolicyRef) -> Result<(), DeployError> {
        let proved = self.keeper.begin(&policy)?;
        let staged = Staged {
            format: STAGED_FORMAT.to_owned(),
            number: inner.number + 1,
            run,
            policy,
            proved,
        };
        staged.write(&self.folder)?;
        inner.number = staged.number;
        Ok(())
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
