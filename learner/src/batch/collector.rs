//! Decides about each frame, and when a batch is complete. Pure: bytes and versions in, batches out; the
//! caller has the link and the clock.

use std::collections::{BTreeMap, BTreeSet};

use caudata_proto::{ChunkIdentity, DecodeLimits, Envelope, RolloutChunk, chunk_identity, decode};

use super::account::{Arrival, DropReason};
use super::accounting::{Accounting, ActorKey};

/// Refused chunks after which an incarnation is not listened to any more.
pub const STRIKES_MAX: u32 = 3;
/// Share of a batch that is not waited for where actors may be ahead (`max_lead` above 0): one slow actor
/// among many would otherwise set the pace of all. Their chunks count in the next batch.
const STRAGGLERS: f64 = 0.05;

/// What the collector checks chunks against.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectorSettings {
    /// The run.
    pub run_id: String,
    /// SHA-256 of the policy contract.
    pub contract_hash: [u8; 32],
    /// T.
    pub steps: usize,
    /// N.
    pub lanes: usize,
    /// D.
    pub obs_dim: usize,
    /// A.
    pub act_dim: usize,
    /// Actors that are expected from the start, numbered from 0.
    pub actors: u32,
    /// Chunks per actor and policy version.
    pub chunks_per_version: u32,
    /// Quotas that an actor may be ahead. 0: a batch consists of chunks of the current version only.
    pub max_lead: u32,
    /// Batches of equal share per actor, whose lag is exactly `max_lead`; lanes lie side by side, whoever
    /// stepped them.
    pub lockstep: bool,
    /// Versions that a chunk may be old when it is used.
    pub max_lag: u64,
    /// Share of a full batch that is enough when actors are missing.
    pub min_share: f64,
    /// Bounds for decoding.
    pub limits: DecodeLimits,
}

impl CollectorSettings {
    /// Chunks of a full batch.
    pub fn full_batch(&self) -> usize {
        self.actors as usize * self.chunks_per_version as usize
    }

    /// The lag that is really allowed.
    fn lag(&self) -> u64 {
        if self.max_lead == 0 { 0 } else { self.max_lag }
    }

    /// Chunks of one version that an actor may have used up.
    fn quota(&self) -> usize {
        self.chunks_per_version as usize * (self.max_lead as usize + 1)
    }

    /// Chunks of a batch of `target` that may come later. None below twenty.
    fn stragglers(&self, target: usize) -> usize {
        match self.max_lead {
            0 => 0,
            _ if self.lockstep => 0,
            _ => (STRAGGLERS * target as f64) as usize,
        }
    }

    fn fewest(&self) -> usize {
        ((self.min_share * self.full_batch() as f64).ceil() as usize)
            .clamp(1, self.full_batch().max(1))
    }
}

/// What a frame turned out to be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// An actor introduced itself.
    Hello(ActorKey),
    /// An actor said goodbye.
    Bye(ActorKey),
    /// A chunk waits for a batch.
    Waiting(ActorKey),
    /// A chunk that had come before.
    Duplicate(ActorKey),
    /// Refused, with the reason's name and what is wrong in words.
    Rejected(Option<ActorKey>, &'static str, String),
    /// Valid but not used.
    Dropped(ActorKey, DropReason),
}

/// Frames in, batches out.
#[derive(Debug)]
pub struct Collector {
    settings: CollectorSettings,
    accounting: Accounting,
    /// SHA-256 of the policies that chunks may still come from.
    policies: BTreeMap<u64, [u8; 32]>,
    current: u64,
    waiting: Vec<RolloutChunk>,
    /// Chunks used or waiting per actor and version, for the quota.
    used: BTreeMap<(u32, u64), usize>,
    strikes: BTreeMap<ActorKey, u32>,
    /// Actors whose chunks a batch waits for.
    present: BTreeSet<u32>,
    /// Newest incarnation of each actor; the goodbye of an older one does not mean that the actor is gone.
    newest: BTreeMap<u32, u64>,
    closed: bool,
}

impl Collector {
    /// At the start, or going on with the accounts of a checkpoint.
    pub fn new(settings: CollectorSettings, mut accounting: Accounting) -> Self {
        accounting.restarted();
        Self {
            present: (0..settings.actors).collect(),
            settings,
            accounting,
            policies: BTreeMap::new(),
            current: 0,
            waiting: Vec::new(),
            used: BTreeMap::new(),
            strikes: BTreeMap::new(),
            newest: BTreeMap::new(),
            closed: false,
        }
    }

    /// What became of every chunk.
    pub fn accounting(&self) -> &Accounting {
        &self.accounting
    }

    /// The accounts, to add what ledgers say.
    pub fn accounting_mut(&mut self) -> &mut Accounting {
        &mut self.accounting
    }

    /// From now on `version` is the current policy. Chunks that are now too old are dropped.
    pub fn policy_published(&mut self, version: u64, sha256: [u8; 32]) {
        self.current = version;
        let oldest = version.saturating_sub(self.settings.lag());
        self.policies.insert(version, sha256);
        self.policies.retain(|&v, _| v >= oldest);
        self.used.retain(|&(_, v), _| v >= oldest);
        self.drop_waiting_if(DropReason::Stale, |chunk| chunk.policy_version < oldest);
    }

    /// Takes a frame of any actor.
    pub fn offer(&mut self, frame: &[u8]) -> Outcome {
        match decode(frame, &self.settings.limits) {
            Ok(Envelope::Chunk(chunk)) => self.offer_chunk(*chunk),
            Ok(Envelope::Hello(hello)) => {
                let actor = (hello.actor_id, hello.incarnation);
                if let Some(outcome) = self.wrong_run(&hello.run_id) {
                    return outcome;
                }
                if hello.contract_hash != self.settings.contract_hash {
                    return self.reject_unattributed(
                        "contract",
                        "an actor has another robot, engine, terrain or task than the learner: give both one configuration and one version",
                    );
                }
                self.heard(actor);
                self.accounting.greet(actor);
                Outcome::Hello(actor)
            }
            Ok(Envelope::Bye(bye)) => {
                let actor = (bye.actor_id, bye.incarnation);
                if let Some(outcome) = self.wrong_run(&bye.run_id) {
                    return outcome;
                }
                self.accounting.goodbye(actor, bye.sent);
                if self.newest.get(&bye.actor_id).is_none_or(|&newest| newest <= bye.incarnation) {
                    self.present.remove(&bye.actor_id);
                }
                Outcome::Bye(actor)
            }
            Err(error) => {
                let identity = chunk_identity(frame);
                self.reject_invalid(identity, error.reason_id(), &error.to_string())
            }
        }
    }

    /// Takes a chunk of an actor in this process, which has not been bytes in between; checked all the same.
    pub fn offer_value(&mut self, chunk: RolloutChunk) -> Outcome {
        match chunk.check(&self.settings.limits) {
            Ok(()) => self.offer_chunk(chunk),
            Err(error) => {
                let identity = chunk.identity();
                self.reject_invalid(Some(identity), error.reason_id(), &error.to_string())
            }
        }
    }

    /// Whether a batch is complete: full, or everything that the actors that are there will send.
    ///
    /// In lockstep: when every actor has sent all that it may before the next policy comes, so that none of
    /// them can miss a version.
    pub fn is_ready(&self) -> bool {
        let per_actor = self.settings.chunks_per_version as usize;
        if self.settings.lockstep {
            let owed = per_actor * (self.settings.max_lead as usize).max(1);
            let came = |actor: &u32| self.waiting_of(*actor) >= owed;
            return !self.present.is_empty() && self.present.iter().all(came);
        }
        let coming = self.present.len() * per_actor;
        let target = coming.max(self.settings.fewest()).min(self.settings.full_batch());
        self.waiting.len() >= target - self.settings.stragglers(target)
    }

    /// Whether what has come is enough to go on without the rest.
    pub fn has_enough(&self) -> bool {
        self.waiting.len() >= self.settings.fewest()
    }

    /// Chunks in the queue.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }

    /// Takes at most a full batch, oldest policy first, then by actor, incarnation and sequence: the order
    /// does not depend on the order of arrival. Actors of which nothing has come are not waited for until
    /// they are heard again.
    pub fn take(&mut self) -> Vec<RolloutChunk> {
        self.waiting.sort_by_key(order);
        let batch = match self.settings.lockstep {
            true => self.take_shares(),
            false => {
                let count = self.waiting.len().min(self.settings.full_batch());
                self.waiting.drain(..count).collect()
            }
        };
        let count = batch.len();
        for chunk in &batch {
            self.accounting.accept((chunk.actor_id, chunk.incarnation));
        }
        if count < self.settings.full_batch() {
            let came: BTreeSet<u32> = batch.iter().map(|chunk| chunk.actor_id).collect();
            self.present.retain(|actor| came.contains(actor));
        }
        batch
    }

    /// The oldest chunks of each actor, as many as it sends per version.
    fn take_shares(&mut self) -> Vec<RolloutChunk> {
        let share = self.settings.chunks_per_version as usize;
        let mut taken: BTreeMap<u32, usize> = BTreeMap::new();
        let (batch, rest) =
            std::mem::take(&mut self.waiting).into_iter().partition(|chunk: &RolloutChunk| {
                let of_actor = taken.entry(chunk.actor_id).or_default();
                *of_actor += 1;
                *of_actor <= share
            });
        self.waiting = rest;
        batch
    }

    fn waiting_of(&self, actor: u32) -> usize {
        let of_actor = |chunk: &&RolloutChunk| chunk.actor_id == actor;
        self.waiting.iter().filter(of_actor).count()
    }

    /// No more batches will be taken.
    pub fn close(&mut self) {
        self.closed = true;
        self.drop_waiting_if(DropReason::AtShutdown, |_| true);
    }

    /// Whether every actor that was there has said goodbye. One that was expected and never heard of has
    /// nothing to say.
    pub fn all_gone(&self) -> bool {
        let silent = |actor: &u32| !self.newest.contains_key(actor);
        self.present.iter().all(silent)
    }

    /// Actors that a batch waits for.
    pub fn present(&self) -> usize {
        self.present.len()
    }

    fn offer_chunk(&mut self, chunk: RolloutChunk) -> Outcome {
        if let Some(outcome) = self.wrong_run(&chunk.run_id) {
            return outcome;
        }
        let actor = (chunk.actor_id, chunk.incarnation);
        match self.accounting.arrive(actor, chunk.sequence) {
            Arrival::New => {}
            Arrival::Duplicate => return Outcome::Duplicate(actor),
            Arrival::Implausible => return self.implausible(),
        }
        if let Some(outcome) = self.quarantined(actor) {
            return outcome;
        }
        if let Err((reason, message)) = self.check(&chunk) {
            return self.strike(actor, reason, message);
        }
        self.heard(actor);
        if let Some(reason) = self.unusable(&chunk) {
            self.accounting.drop_new(actor, reason);
            return Outcome::Dropped(actor, reason);
        }
        *self.used.entry((chunk.actor_id, chunk.policy_version)).or_default() += 1;
        self.accounting.wait(actor);
        self.waiting.push(chunk);
        Outcome::Waiting(actor)
    }

    /// What no honest actor of this run sends.
    fn check(&self, chunk: &RolloutChunk) -> Result<(), (&'static str, String)> {
        let s = &self.settings;
        if chunk.contract_hash != s.contract_hash {
            return Err(("contract", "made with another robot, engine, terrain or task".into()));
        }
        let dims = [chunk.steps, chunk.lanes, chunk.obs_dim, chunk.act_dim];
        let expected = [s.steps, s.lanes, s.obs_dim, s.act_dim];
        if dims != expected {
            return Err((
                "dimensions",
                format!("[T, N, D, A] is {dims:?}, this run has {expected:?}"),
            ));
        }
        if s.lockstep && chunk.actor_id >= s.actors {
            let (actor, actors) = (chunk.actor_id, s.actors);
            return Err((
                "actor_number",
                format!("actor {actor} in a run in lockstep with {actors} actors"),
            ));
        }
        match self.policies.get(&chunk.policy_version) {
            Some(sha256) if *sha256 != chunk.policy_sha256 => {
                let version = chunk.policy_version;
                Err((
                    "policy_hash",
                    format!("its policy version {version} has other bytes than ours"),
                ))
            }
            _ => Ok(()),
        }
    }

    fn unusable(&self, chunk: &RolloutChunk) -> Option<DropReason> {
        let used = self.used.get(&(chunk.actor_id, chunk.policy_version)).copied().unwrap_or(0);
        if self.closed {
            Some(DropReason::AtShutdown)
        } else if chunk.policy_version + self.settings.lag() < self.current {
            Some(DropReason::Stale)
        } else if !self.policies.contains_key(&chunk.policy_version) {
            Some(DropReason::UnknownPolicy)
        } else if used >= self.settings.quota() {
            Some(DropReason::Surplus)
        } else {
            None
        }
    }

    fn wrong_run(&mut self, run_id: &str) -> Option<Outcome> {
        if run_id == self.settings.run_id {
            return None;
        }
        Some(self.reject_unattributed("wrong_run", "a frame of another run"))
    }

    fn implausible(&mut self) -> Outcome {
        self.reject_unattributed("sequence", "a sequence number far from all others")
    }

    fn reject_unattributed(&mut self, reason: &'static str, message: &str) -> Outcome {
        self.accounting.reject_unattributed(reason);
        Outcome::Rejected(None, reason, message.to_owned())
    }

    fn reject_invalid(
        &mut self,
        identity: Option<ChunkIdentity>,
        reason: &'static str,
        message: &str,
    ) -> Outcome {
        let identity = identity.filter(|id| id.run_id == self.settings.run_id);
        let Some(identity) = identity else { return self.reject_unattributed(reason, message) };
        let actor = (identity.actor_id, identity.incarnation);
        match self.accounting.arrive(actor, identity.sequence) {
            Arrival::New => {}
            Arrival::Duplicate => return Outcome::Duplicate(actor),
            Arrival::Implausible => return self.implausible(),
        }
        if let Some(outcome) = self.quarantined(actor) {
            return outcome;
        }
        self.strike(actor, reason, message.to_owned())
    }

    fn quarantined(&mut self, actor: ActorKey) -> Option<Outcome> {
        if !self.is_quarantined(actor) {
            return None;
        }
        self.accounting.reject(actor, "quarantined");
        let message = format!("{STRIKES_MAX} of its chunks were refused before");
        Some(Outcome::Rejected(Some(actor), "quarantined", message))
    }

    fn is_quarantined(&self, actor: ActorKey) -> bool {
        self.strikes.get(&actor).is_some_and(|&strikes| strikes >= STRIKES_MAX)
    }

    fn strike(&mut self, actor: ActorKey, reason: &'static str, message: String) -> Outcome {
        self.accounting.reject(actor, reason);
        let strikes = self.strikes.entry(actor).or_default();
        *strikes += 1;
        if *strikes >= STRIKES_MAX {
            self.present.remove(&actor.0);
        }
        Outcome::Rejected(Some(actor), reason, message)
    }

    fn heard(&mut self, (actor_id, incarnation): ActorKey) {
        if self.is_quarantined((actor_id, incarnation)) {
            return;
        }
        let newest = self.newest.entry(actor_id).or_default();
        *newest = incarnation.max(*newest);
        if incarnation == *newest {
            self.present.insert(actor_id);
        }
    }

    fn drop_waiting_if(&mut self, reason: DropReason, unwanted: impl Fn(&RolloutChunk) -> bool) {
        let accounting = &mut self.accounting;
        self.waiting.retain(|chunk| {
            let drop = unwanted(chunk);
            if drop {
                accounting.drop_waiting((chunk.actor_id, chunk.incarnation), reason);
            }
            !drop
        });
    }
}

fn order(chunk: &RolloutChunk) -> (u64, u32, u64, u64) {
    (chunk.policy_version, chunk.actor_id, chunk.incarnation, chunk.sequence)
}

#[cfg(test)]
mod tests;
