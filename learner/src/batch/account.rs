//! The account of one incarnation of one actor: each sequence number that it used has exactly one fate.

use std::collections::{BTreeMap, BTreeSet};

use caudata_declare::named;
use serde::{Deserialize, Serialize};

/// Missing sequence numbers that are remembered per incarnation, in case they come late. Older ones count as
/// lost for good.
const MISSING_MAX: usize = 4096;
/// Largest step from one sequence number to the next that is believed.
const SEQUENCE_STEP_MAX: u64 = 1 << 20;
named! {
    /// Why a valid chunk was not used.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum DropReason {
        /// From a policy older than the allowed lag.
        Stale = "stale",
        /// More chunks of one policy version than the actor's quota.
        Surplus = "surplus",
        /// From a policy that this learner did not publish: a learner before it, which got further, did.
        UnknownPolicy = "unknown_policy",
        /// Came after the last batch.
        AtShutdown = "at_shutdown",
        /// Waited for a batch when the checkpoint was written that the run goes on from.
        Restart = "restart",
        /// Sent after that checkpoint was written: whatever became of it then does not count any more.
        RolledBack = "rolled_back",
        /// Sent, but never arrived.
        Lost = "lost",
    }
}

/// How a sequence number relates to those that came before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Not seen before.
    New,
    /// Seen before.
    Duplicate,
    /// Too far from all others to be believed, or from one incarnation too many.
    Implausible,
}

/// The account of one incarnation of one actor.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IncarnationAccount {
    /// One more than the highest sequence number seen.
    pub(super) next: u64,
    /// Numbers below `next` that have not been seen.
    pub(super) missing: BTreeSet<u64>,
    /// Such numbers that are not remembered one by one any more.
    pub(super) given_up: u64,
    /// Numbers below `next` that a learner before this one may have seen, after the checkpoint that the run
    /// goes on from.
    #[serde(default)]
    pub(super) rolled_back: BTreeSet<u64>,
    /// What the actor's last words or its ledger say that it sent.
    pub(super) claimed: Option<u64>,
    /// Whether it said goodbye.
    pub(super) said_bye: bool,
    /// Used for learning.
    pub(super) accepted: u64,
    /// In the queue for a batch.
    pub(super) waiting: u64,
    /// Refused, by reason.
    pub(super) rejected: BTreeMap<String, u64>,
    /// Valid but not used, by reason; without the lost ones.
    pub(super) dropped: BTreeMap<DropReason, u64>,
    /// Arrivals of sequence numbers seen before; not a fate of their own.
    pub(super) duplicates: u64,
}

impl IncarnationAccount {
    pub(super) fn arrive(&mut self, sequence: u64) -> Arrival {
        if sequence < self.next {
            return if self.missing.remove(&sequence) || self.rolled_back.remove(&sequence) {
                Arrival::New
            } else {
                self.duplicates += 1;
                Arrival::Duplicate
            };
        }
        if sequence - self.next > SEQUENCE_STEP_MAX {
            return Arrival::Implausible;
        }
        let remembered_from = self.next.max(sequence.saturating_sub(MISSING_MAX as u64));
        self.given_up += remembered_from - self.next;
        self.missing.extend(remembered_from..sequence);
        while self.missing.len() > MISSING_MAX {
            self.missing.pop_first();
            self.given_up += 1;
        }
        self.next = sequence + 1;
        Arrival::New
    }

    /// The run goes on from a checkpoint, and the ledger says `sent`: the numbers that the checkpoint does
    /// not know are rolled back. One of them that is still on its way counts when it comes.
    pub(super) fn roll_back(&mut self, sent: u64) {
        if sent <= self.next {
            return;
        }
        let remembered_from = self.next.max(sent.saturating_sub(MISSING_MAX as u64));
        let mut for_good = remembered_from - self.next;
        self.rolled_back.extend(remembered_from..sent);
        while self.rolled_back.len() > MISSING_MAX {
            self.rolled_back.pop_first();
            for_good += 1;
        }
        if for_good > 0 {
            *self.dropped.entry(DropReason::RolledBack).or_default() += for_good;
        }
        self.next = sent;
    }

    /// Chunks dropped by reason, without the lost ones.
    pub(super) fn dropped_by_reason(&self) -> BTreeMap<DropReason, u64> {
        let mut by_reason = self.dropped.clone();
        if !self.rolled_back.is_empty() {
            *by_reason.entry(DropReason::RolledBack).or_default() += self.rolled_back.len() as u64;
        }
        by_reason
    }

    /// Chunks dropped, without the lost ones.
    pub(super) fn dropped_but_not_lost(&self) -> u64 {
        self.dropped.values().sum::<u64>() + self.rolled_back.len() as u64
    }

    /// Chunks that it sent, as far as anybody knows.
    pub fn sent(&self) -> u64 {
        self.next.max(self.claimed.unwrap_or(0))
    }

    /// Chunks that were sent and never arrived.
    pub fn lost(&self) -> u64 {
        self.missing.len() as u64 + self.given_up + (self.sent() - self.next)
    }

    /// Chunks refused.
    pub fn rejected(&self) -> u64 {
        self.rejected.values().sum()
    }

    /// Chunks dropped, the lost ones included.
    pub fn dropped(&self) -> u64 {
        self.dropped_but_not_lost() + self.lost()
    }

    /// Whether every chunk has exactly one fate.
    pub fn holds(&self) -> bool {
        let claims_fewer = self.claimed.is_some_and(|claimed| claimed < self.next);
        let fates = self.accepted + self.rejected() + self.dropped() + self.waiting;
        fates == self.sent() && !claims_fewer
    }
}
