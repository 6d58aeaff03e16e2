//! Getting policies: from the server, checked and stored; from the disk when there is no server.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use caudata_model::RobotModel;
use caudata_policy::{MAX_FILE_BYTES, PolicyFile};
use caudata_proto::registry::question::Facts;
use caudata_proto::registry::{LabelName, Manifest, RobotState as Word, StreamName};
use caudata_registry_client::{ClientError, RegistryClient};
use caudata_signing::{Trust, random_bytes};
use sha2::{Digest, Sha256};

use crate::DeployError;
use crate::boundary::FACTORY;
use crate::metrics::AgentMetrics;
use crate::probe::{CHILD, ProbeProgram, Probed};
use crate::reporter::{News, Reporter};
use crate::state::{Blame, Decision, PolicyRef, Sha256Digest};
use crate::store::{PolicyStore, read_bounded};
use crate::updates::PolicyEvent;
use crate::verify::{ANNOUNCEMENT, Announcement, Refusal, Verified, VerifyError, verify};

/// Decides which policy runs; shared by the threads of the agent.
#[derive(Clone, Debug)]
pub struct Keeper {
    store: Arc<Mutex<PolicyStore>>,
    model: Arc<RobotModel>,
    /// Takes only what its keys signed.
    pub(crate) trust: Option<Arc<Trust>>,
    /// What came with the program: runs where nothing else may.
    pub(crate) factory: Option<PolicyRef>,
    /// Lets a child process try candidates first.
    pub(crate) probe: Option<Arc<ProbeProgram>>,
    /// Tells the policy server what becomes of policies.
    pub(crate) reporter: Option<Arc<Reporter>>,
    metrics: AgentMetrics,
}

impl Keeper {
    /// A keeper over an open store.
    pub fn new(store: PolicyStore, model: Arc<RobotModel>, metrics: AgentMetrics) -> Self {
        Self {
            store: Arc::new(Mutex::new(store)),
            model,
            trust: None,
            factory: None,
            probe: None,
            reporter: None,
            metrics,
        }
    }

    /// The policy that `label` of `stream` leads to: fetched and verified, or read back where this robot has
    /// it. Where the trust file knows servers' keys, the server must prove that this is where the label leads
    /// now.
    ///
    /// # Errors
    /// [`DeployError::Refused`] with the reason, which is also recorded; [`DeployError::Server`],
    /// [`DeployError::NoPolicy`], [`DeployError::Stale`]; what the disk says.
    pub async fn pull(
        &self,
        client: &mut RegistryClient,
        stream: &StreamName,
        label: &LabelName,
    ) -> Result<Verified, DeployError> {
        let manifest = self.announced(client, stream, label).await?;
        self.take(client, &manifest).await
    }

    /// What `label` of `stream` leads to.
    ///
    /// # Errors
    /// As [`Keeper::pull`].
    pub async fn announced(
        &self,
        client: &mut RegistryClient,
        stream: &StreamName,
        label: &LabelName,
    ) -> Result<Manifest, DeployError> {
        let missing = |error: ClientError| match error.is_not_found() {
            true => DeployError::NoPolicy { stream: stream.to_string() },
            false => error.into(),
        };
        let stale = |reason: String| DeployError::Stale {
            stream: stream.to_string(),
            label: label.to_string(),
            reason,
        };
        let asked = Facts::of_stream(stream);
        let Some(trust) = self.trust.as_ref().filter(|t| t.knows_fresh_keys()) else {
            let manifest = client.labelled(stream, label).await.map_err(missing)?;
            asked.answered_by(&manifest).map_err(|why| stale(why.to_string()))?;
            return Ok(manifest);
        };
        // The proof first: what it names is then asked for by its number, so that a label that moves
        // meanwhile does no harm.
        // Nobody can have seen it before.
        let nonce = random_bytes().map_err(DeployError::system("random bytes"))?;
        let answer = client.freshness(nonce, stream, label).await.map_err(missing)?;
        trust.check_fresh(&answer, &nonce, stream, label).map_err(|why| stale(why.to_string()))?;
        let proved = answer.said;
        let manifest = client.manifest(stream, Some(proved.version)).await.map_err(missing)?;
        let asked = Facts { version: Some(proved.version), sha256: Some(&proved.sha256), ..asked };
        asked.answered_by(&manifest).map_err(|why| stale(why.to_string()))?;
        let mut store = self.store();
        if store.is_torn() {
            store.recover(stream.as_str(), proved.version, trust.version())?;
            tracing::warn!(%stream, floor = proved.version, "the lost state is begun anew: nothing older is taken");
        }
        drop(store);
        Ok(manifest)
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
        let policy = PolicyRef::from(manifest);
        // Its own statement: the store must not stay locked while the decision is carried out.
        let decision = self.store().decide(&policy, self.robot());
        match decision {
            Decision::StateLost => return Err(DeployError::StateLost),
            Decision::Refused { reason } => {
                return Err(self.refused(policy, Refusal::Before(reason)));
            }
            Decision::Older { have } => return Err(self.refused(policy, Refusal::Older { have })),
            Decision::HaveIt => match self.read_back(&policy) {
                Err(
                    error @ (DeployError::BlobDamaged { .. }
                    | DeployError::BlobMissing { .. }
                    | DeployError::NotSigned { .. }),
                ) => {
                    tracing::warn!(%error, "fetching it again");
                }
                other => return other,
            },
            Decision::Fetch => {}
        }
        let announcement =
            Announcement { manifest, trust: self.trust.as_deref(), model: &self.model };
        match announcement.check(ANNOUNCEMENT) {
            Ok(()) => {}
            // Not recorded: whoever can make up announcements must not be able to fill the records with them.
            Err(refusal @ Refusal::Untrusted(_)) => return Err(self.refused(policy, refusal)),
            Err(refusal) => return Err(self.quarantine(policy, refusal)),
        }
        // A disk that will not take it is asked before the network is: or it would be fetched again and
        // again.
        self.store().reserve(&policy, manifest.size)?;
        let bytes = client.fetch(manifest).await?;
        let verified = self.tried(bytes.into(), &policy)?;
        let mut store = self.store();
        store.put(&policy, verified.file.bytes())?;
        store.put_manifest(manifest)?;
        store.update(|state| state.adopt(policy.clone()))?;
        drop(store);
        tracing::info!(%policy, sha256 = %policy.sha256, "policy verified and stored");
        Ok(verified)
    }

    /// Counts, on the disk, that `policy` is made ready to drive the robot; whether it went through its trial
    /// here before.
    ///
    /// # Errors
    /// [`DeployError::Refused`] where that was too often already; what the disk says.
    pub fn begin(&self, policy: &PolicyRef) -> Result<bool, DeployError> {
        if policy.stream == FACTORY {
            return Ok(true);
        }
        let worn_out = {
            let store = self.store();
            let attempts = store.state().attempts(policy.sha256);
            let worn_out = store.state().is_worn_out(policy.sha256);
            worn_out.then_some(Refusal::TooManyAttempts { attempts })
        };
        if let Some(refusal) = worn_out {
            return Err(self.quarantine(policy.clone(), refusal));
        }
        let mut attempts = 0;
        let counted = self.store().update(|state| attempts = state.begin(policy.sha256));
        match counted {
            Ok(()) => {}
            // A card that takes nothing more must not keep a good policy from running; one on trial it does.
            Err(error) if attempts == 0 => tracing::error!(%error, "cannot write the state"),
            Err(error) => return Err(error),
        }
        let news = News { attempts, ..News::default() };
        self.tell(policy, Word::Armed, news);
        Ok(attempts == 0)
    }

    /// Whether the state was lost and no server proved yet what is newest.
    pub fn is_torn(&self) -> bool {
        self.store().is_torn()
    }

    /// An operator took `policy` out of use.
    pub fn withdraw(&self, policy: &PolicyRef, reason: &str) {
        let error = self.quarantine(policy.clone(), Refusal::Withdrawn(reason.to_owned()));
        tracing::error!(%error, "out of use");
    }

    fn tell(&self, policy: &PolicyRef, word: Word, news: News) {
        if let Some(reporter) = &self.reporter
            && policy.stream != FACTORY
        {
            reporter.tell(policy, word, news);
        }
    }

    /// The best policy that needs no server: on this robot's disk, else the one that came with the program.
    ///
    /// # Errors
    /// As [`Keeper::from_disk`].
    pub fn best(&self) -> Result<Option<PolicyRef>, DeployError> {
        if self.is_torn() {
            return Ok(self.factory.clone());
        }
        let on_disk = self.from_disk()?.map(|verified| verified.policy);
        Ok(on_disk.or_else(|| self.factory.clone()))
    }

    /// The best policy that went through its trial on this robot, else the one that came with the program:
    /// neither needs a count on the disk.
    pub fn proved(&self) -> Option<PolicyRef> {
        let kept = |keeper: &Self| keeper.store().state().last_good.clone();
        let last_good = if self.is_torn() { None } else { kept(self) };
        let runs = |policy: &PolicyRef| match self.read_back(policy) {
            Ok(_) => true,
            Err(error) => {
                tracing::error!(%policy, %error, "the last good policy cannot run");
                false
            }
        };
        last_good.filter(runs).or_else(|| self.factory.clone())
    }

    /// The best policy on this robot's disk; `None` where there is none that may run. Damaged files and
    /// policies that no longer pass are passed over with a warning.
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
                    | DeployError::NotSigned { .. }
                    | DeployError::Refused { .. }),
                ) => tracing::error!(%policy, %error, "policy on disk cannot run"),
                Err(error) => return Err(error),
            }
        }
        Ok(None)
    }

    /// Writes down what the loop learnt. A policy that came with the program has no record.
    pub fn note(&self, event: PolicyEvent) -> Result<(), DeployError> {
        let attempts = |policy: &PolicyRef| self.store().state().attempts(policy.sha256);
        let factory = |policy: &PolicyRef| policy.stream == FACTORY;
        match event {
            PolicyEvent::Bad { policy, reason, .. } | PolicyEvent::Unfit { policy, reason }
                if factory(&policy) =>
            {
                tracing::error!(reason, "the policy that came with the program does not do");
                Ok(())
            }
            PolicyEvent::Begun(policy) | PolicyEvent::Ended(policy) if factory(&policy) => Ok(()),
            PolicyEvent::Good { policy, .. } if factory(&policy) => Ok(()),
            PolicyEvent::Unfit { policy, reason } => {
                self.quarantine(policy, Refusal::ByTheLoop(reason));
                Ok(())
            }
            PolicyEvent::Begun(policy) => {
                let news = News { attempts: attempts(&policy), ..News::default() };
                self.tell(&policy, Word::Trial, news);
                Ok(())
            }
            PolicyEvent::Good { policy, walked_s } => {
                let news = News { walked_s, attempts: attempts(&policy), ..News::default() };
                self.tell(&policy, Word::Good, news);
                self.store().update(|state| state.confirm(policy.sha256))
            }
            PolicyEvent::Bad { policy, reason, walked_s, fell } => {
                self.metrics.refused.inc();
                let news = News {
                    reason: reason.clone(),
                    walked_s,
                    falls: u32::from(fell),
                    attempts: attempts(&policy),
                };
                self.tell(&policy, Word::Failed, news);
                self.store().update(|state| state.quarantine(policy, reason, Blame::Policy))
            }
            PolicyEvent::Ended(policy) => self.store().update(|s| s.end_in_order(policy.sha256)),
            // Neither is about what is kept.
            PolicyEvent::Ready { .. } | PolicyEvent::Replaced(_) => Ok(()),
        }
    }

    fn read_back(&self, policy: &PolicyRef) -> Result<Verified, DeployError> {
        let bytes = self.store().get(policy, self.trust.as_deref())?;
        self.checked(bytes, policy)
    }

    /// As [`Keeper::checked`], after a child process survived it.
    pub(crate) fn tried(
        &self,
        bytes: Arc<[u8]>,
        policy: &PolicyRef,
    ) -> Result<Verified, DeployError> {
        let Some(probe) = &self.probe else { return self.checked(bytes, policy) };
        let probed = probe.run(policy, &bytes);
        if let Probed::Unable(reason) = &probed {
            tracing::warn!(reason, "the candidate was not tried");
        }
        match probed.check(CHILD) {
            Ok(()) => self.checked(bytes, policy),
            Err(refusal) => {
                if matches!(refusal, Refusal::ByItsProbe(_)) {
                    // What the child found is found here again, and sorted by what is to blame.
                    self.checked(bytes, policy)?;
                }
                Err(self.quarantine(policy.clone(), refusal))
            }
        }
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
        // What the server knows itself, or never offered, needs no report.
        if !matches!(refusal, Refusal::Older { .. } | Refusal::Before(_) | Refusal::Withdrawn(_)) {
            let news = News { reason: refusal.to_string(), ..News::default() };
            self.tell(&policy, Word::Refused, news);
        }
        DeployError::Refused { policy, refusal: Box::new(refusal) }
    }

    fn robot(&self) -> Sha256Digest {
        Sha256Digest(self.model.hash())
    }

    fn store(&self) -> MutexGuard<'_, PolicyStore> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The policy that came with the program, completely checked. Nobody announced it, so that its own bytes say
/// which it is.
///
/// # Errors
/// [`DeployError::BlobMissing`], [`DeployError::Refused`], [`DeployError::Runtime`].
pub fn read_factory(path: &Path, model: &RobotModel) -> Result<Verified, DeployError> {
    let bytes: Arc<[u8]> = read_bounded(path, MAX_FILE_BYTES as u64)?.into();
    let mut policy = PolicyRef {
        stream: FACTORY.to_owned(),
        version: 0,
        sha256: Sha256Digest(Sha256::digest(&bytes).into()),
        reverts_to: None,
    };
    let file = PolicyFile::parse(bytes.clone()).map_err(|e| DeployError::refused(&policy, e))?;
    policy.version = file.metadata().version;
    verify(bytes, &policy, model).map_err(|error| DeployError::unverified(&policy, error))
}
