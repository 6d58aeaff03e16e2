//! Getting policies: from the server, checked and stored; from the disk when there is no server.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use caudata_model::RobotModel;
use caudata_proto::registry::{Manifest, StreamName};
use caudata_registry_client::RegistryClient;
use caudata_signing::Trust;

use crate::DeployError;
use crate::metrics::RobotMetrics;
use crate::probe::{ProbeProgram, Probed};
use crate::state::{Blame, Decision, PolicyRef, Sha256Digest};
use crate::store::PolicyStore;
use crate::updates::PolicyEvent;
use crate::verify::{Refusal, Verified, VerifyError, check_manifest, verify};

/// Decides which policy runs; shared by the start of a run, the follower and the housekeeping thread.
#[derive(Clone, Debug)]
pub struct Keeper {
    store: Arc<Mutex<PolicyStore>>,
    model: Arc<RobotModel>,
    trust: Option<Arc<Trust>>,
    probe: Option<Arc<ProbeProgram>>,
    metrics: RobotMetrics,
}

impl Keeper {
    /// A keeper over an open store.
    pub fn new(store: PolicyStore, model: Arc<RobotModel>, metrics: RobotMetrics) -> Self {
        Self {
            store: Arc::new(Mutex::new(store)),
            model,
            trust: None,
            probe: None,
            metrics,
        }
    }

    /// Takes only what keys of `trust` signed.
    #[must_use]
    pub fn trusting(mut self, trust: Trust) -> Self {
        self.trust = Some(Arc::new(trust));
        self
    }

    /// Lets a child process try candidates first.
    #[must_use]
    pub fn probing(mut self, probe: ProbeProgram) -> Self {
        self.probe = Some(Arc::new(probe));
        self
    }

    /// The newest policy of `stream`: fetched and verified, or read back where this robot has it.
    ///
    /// # Errors
    /// [`DeployError::Refused`] with the reason, which is also recorded; [`DeployError::Server`], [`DeployError::NoPolicy`];
    /// what the disk says.
    pub async fn pull(
        &self,
        client: &mut RegistryClient,
        stream: &StreamName,
    ) -> Result<Verified, DeployError> {
        let manifest = client.manifest(stream, None).await.map_err(|e| {
            if e.is_not_found() {
                return DeployError::NoPolicy {
                    stream: stream.to_string(),
                };
            }
            e.into()
        })?;
        self.take(client, &manifest).await
    }

    /// The policy of `manifest`, likewise.
    ///
    /// # Errors
    /// As [`Keeper::pull`].
    pub async fn take(
        &self,
        client: &mut RegistryClient,
        manifest: &Manifest,
    ) -> Result<Verified, DeployError> {
        let policy = reference(manifest);
        // Its own statement: the store must not stay locked while the decision is carried out.
        let decision = self.store().state().decide(&policy, self.robot());
        match decision {
            Decision::Refused { reason } => {
                return Err(self.refused(policy, Refusal::Before(reason)));
            }
            Decision::Older { have } => return Err(self.refused(policy, Refusal::Older { have })),
            Decision::HaveIt => match self.read_back(&policy) {
                Err(
                    error @ (DeployError::BlobDamaged { .. } | DeployError::BlobMissing { .. }),
                ) => {
                    tracing::warn!(%error, "fetching it again");
                }
                other => return other,
            },
            Decision::Fetch => {}
        }
        if let Some(Err(refusal)) = self.trust.as_ref().map(|trust| trust.check(manifest)) {
            // Not recorded: whoever can make up announcements must not be able to fill the records with them.
            return Err(self.refused(policy, Refusal::Untrusted(refusal)));
        }
        if let Err(refusal) = check_manifest(manifest, &self.model) {
            return Err(self.quarantine(policy, refusal));
        }
        let bytes = client.fetch(manifest).await?;
        let verified = self.tried(bytes.into(), &policy)?;
        let mut store = self.store();
        store.put(&policy, verified.file.bytes())?;
        store.update(|state| state.adopt(policy.clone()))?;
        drop(store);
        tracing::info!(%policy, sha256 = %policy.sha256, "policy verified and stored");
        Ok(verified)
    }

    /// The best policy on this robot's disk; `None` where there is none that may run. Damaged files and policies that no
    /// longer pass are passed over with a warning.
    ///
    /// # Errors
    /// [`DeployError::Runtime`] where nothing can be run at all; what the disk says.
    pub fn from_disk(&self) -> Result<Option<Verified>, DeployError> {
        let candidates = self.store().state().on_disk();
        for policy in candidates {
            match self.read_back(&policy) {
                Ok(verified) => return Ok(Some(verified)),
                Err(
                    error @ (DeployError::BlobDamaged { .. }
                    | DeployError::BlobMissing { .. }
                    | DeployError::Refused { .. }),
                ) => tracing::error!(%policy, %error, "policy on disk cannot run"),
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    /// Writes down what the control loop learnt.
    ///
    /// # Errors
    /// What the disk says.
    pub fn note(&self, event: PolicyEvent) -> Result<(), DeployError> {
        match event {
            PolicyEvent::Good(sha256) => self.store().update(|state| state.confirm(sha256)),
            PolicyEvent::Bad { policy, reason } => {
                self.metrics.refused.inc();
                self.store()
                    .update(|state| state.quarantine(policy, reason, Blame::Policy))
            }
            PolicyEvent::Replaced(runner) => {
                drop(runner);
                Ok(())
            }
        }
    }

    fn read_back(&self, policy: &PolicyRef) -> Result<Verified, DeployError> {
        let bytes = self.store().get(policy)?;
        self.checked(bytes, policy)
    }

    /// As [`Keeper::checked`], after a child process survived it.
    fn tried(&self, bytes: Arc<[u8]>, policy: &PolicyRef) -> Result<Verified, DeployError> {
        let probed = self.probe.as_ref().map(|probe| probe.run(policy, &bytes));
        match &probed {
            Some(Probed::Died(how)) => {
                let how = how.clone();
                return Err(self.quarantine(policy.clone(), Refusal::KilledItsProbe { how }));
            }
            Some(Probed::Unable(reason)) => tracing::warn!(reason, "the candidate was not tried"),
            _ => {}
        }
        // What the child found is found here again, and sorted by what is to blame.
        let verified = self.checked(bytes, policy)?;
        if let Some(Probed::Refused(reason)) = probed {
            return Err(self.quarantine(policy.clone(), Refusal::ByItsProbe(reason)));
        }
        Ok(verified)
    }

    fn checked(&self, bytes: Arc<[u8]>, policy: &PolicyRef) -> Result<Verified, DeployError> {
        verify(bytes, policy, &self.model).map_err(|error| match error {
            VerifyError::Runtime(error) => DeployError::Runtime(error),
            VerifyError::Refused(refusal) => self.quarantine(policy.clone(), refusal),
        })
    }

    /// Records the refusal. That a record could not be written must not hide the refusal itself.
    fn quarantine(&self, policy: PolicyRef, refusal: Refusal) -> DeployError {
        let (reason, blame) = (refusal.to_string(), refusal.blame(self.robot()));
        let entry = policy.clone();
        if let Err(error) = self.store().update(|s| s.quarantine(entry, reason, blame)) {
            tracing::error!(%error, "the refusal could not be recorded");
        }
        self.refused(policy, refusal)
    }

    fn refused(&self, policy: PolicyRef, refusal: Refusal) -> DeployError {
        self.metrics.refused.inc();
        DeployError::Refused {
            policy,
            refusal: Box::new(refusal),
        }
    }

    fn robot(&self) -> Sha256Digest {
        Sha256Digest(self.model.hash())
    }

    fn store(&self) -> MutexGuard<'_, PolicyStore> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Which policy a manifest announces.
pub fn reference(manifest: &Manifest) -> PolicyRef {
    PolicyRef {
        stream: manifest.stream.to_string(),
        version: manifest.version,
        sha256: Sha256Digest(manifest.sha256),
    }
}
