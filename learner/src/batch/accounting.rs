//! What became of every chunk, per actor and incarnation.
//!
//! Each sequence number that an incarnation used has exactly one fate: accepted, rejected, dropped (which
//! includes lost and rolled back), or waiting. `sent = accepted + rejected + dropped + waiting` is checked
//! from counts that are kept apart: `lost` comes from gaps in the sequence numbers and from what the actor
//! says it sent, never from the difference. What this check finds is a chunk that the learner counted twice
//! or not at all; that nothing vanished on the way is seen from `lost` of the actors that said goodbye.

use std::collections::BTreeMap;

use caudata_telemetry::progress;
use serde::{Deserialize, Serialize};

use super::account::{Arrival, DropReason, IncarnationAccount};

/// Incarnations that are told apart; one more is turned away.
const INCARNATIONS_MAX: usize = 65_536;

/// Actor and incarnation.
pub type ActorKey = (u32, u64);

/// The accounts of all actors of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "Stored", from = "Stored")]
pub struct Accounting {
    actors: BTreeMap<ActorKey, IncarnationAccount>,
    /// Frames that cannot be put down to any actor, by reason.
    unattributed: BTreeMap<String, u64>,
}

/// JSON has no maps with pairs as keys.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Stored {
    actors: Vec<(ActorKey, IncarnationAccount)>,
    unattributed: BTreeMap<String, u64>,
}

impl From<Accounting> for Stored {
    fn from(accounting: Accounting) -> Self {
        Self {
            actors: accounting.actors.into_iter().collect(),
            unattributed: accounting.unattributed,
        }
    }
}

impl From<Stored> for Accounting {
    fn from(stored: Stored) -> Self {
        Self { actors: stored.actors.into_iter().collect(), unattributed: stored.unattributed }
    }
}

impl Accounting {
    /// Notes that a chunk with this number has come; counts it if it is a duplicate.
    pub fn arrive(&mut self, actor: ActorKey, sequence: u64) -> Arrival {
        if !self.actors.contains_key(&actor) && self.actors.len() >= INCARNATIONS_MAX {
            return Arrival::Implausible;
        }
        let fresh = !self.actors.contains_key(&actor);
        let arrival = self.actors.entry(actor).or_default().arrive(sequence);
        if fresh && arrival == Arrival::Implausible {
            self.actors.remove(&actor);
        }
        arrival
    }

    /// An actor is known even before its first chunk.
    pub fn greet(&mut self, actor: ActorKey) {
        if self.actors.len() < INCARNATIONS_MAX {
            self.actors.entry(actor).or_default();
        }
    }

    /// A new chunk waits for a batch.
    pub fn wait(&mut self, actor: ActorKey) {
        self.change(actor, |account| account.waiting += 1);
    }

    /// A waiting chunk is used.
    pub fn accept(&mut self, actor: ActorKey) {
        self.change(actor, |account| {
            account.waiting = account.waiting.saturating_sub(1);
            account.accepted += 1;
        });
    }

    /// A new chunk is refused.
    pub fn reject(&mut self, actor: ActorKey, reason: &str) {
        self.change(actor, |account| *account.rejected.entry(reason.to_owned()).or_default() += 1);
    }

    /// A new chunk is not used.
    pub fn drop_new(&mut self, actor: ActorKey, reason: DropReason) {
        self.change(actor, |account| *account.dropped.entry(reason).or_default() += 1);
    }

    /// A waiting chunk is not used after all.
    pub fn drop_waiting(&mut self, actor: ActorKey, reason: DropReason) {
        self.change(actor, |account| account.waiting = account.waiting.saturating_sub(1));
        self.drop_new(actor, reason);
    }

    /// A frame that belongs to no actor of this run, as far as can be told.
    pub fn reject_unattributed(&mut self, reason: &str) {
        *self.unattributed.entry(reason.to_owned()).or_default() += 1;
    }

    /// The actor's own last word on how many chunks it sent.
    pub fn goodbye(&mut self, actor: ActorKey, sent: u64) {
        self.greet(actor);
        self.change(actor, |account| {
            account.said_bye = true;
            account.claimed = Some(sent);
        });
    }

    /// What the ledger of an actor says that it sent; its last words win over it. One that has gone back to 0
    /// (it is not synced, and power was lost) says nothing.
    pub fn ledger(&mut self, actor: ActorKey, sent: u64) {
        self.greet(actor);
        self.change(actor, |account| {
            if !account.said_bye && (sent > 0 || account.next == 0) {
                account.claimed = Some(sent);
            }
        });
    }

    /// After a restart nothing waits any more: the chunks were not part of the checkpoint.
    pub fn restarted(&mut self) {
        for account in self.actors.values_mut().filter(|account| account.waiting > 0) {
            *account.dropped.entry(DropReason::Restart).or_default() += account.waiting;
            account.waiting = 0;
        }
    }

    /// The run goes on from a checkpoint, and this is what the ledger of an actor says that it sent in all.
    /// The actor is known from then on, so that none of its incarnations is used again.
    pub fn rolled_back(&mut self, actor: ActorKey, sent: u64) {
        self.greet(actor);
        self.change(actor, |account| account.roll_back(sent));
    }

    /// Whether `sent = accepted + rejected + dropped + waiting` for every incarnation.
    pub fn holds(&self) -> bool {
        self.actors.values().all(IncarnationAccount::holds)
    }

    /// The first incarnation of `actor_id` that has not been heard of.
    pub fn next_incarnation(&self, actor_id: u32) -> u64 {
        let of_actor = self.actors.range((actor_id, 0)..=(actor_id, u64::MAX));
        of_actor.last().map_or(0, |((_, incarnation), _)| incarnation + 1)
    }

    /// Sums for the progress line. Frames, so duplicates count as rejected; lost chunks were never received.
    pub fn summary(&self) -> progress::Accounting {
        let mut sum = progress::Accounting::default();
        let mut add = |reason: &str, count: u64| {
            if count > 0 {
                *sum.reasons.entry(reason.to_owned()).or_default() += count;
            }
        };
        let (mut accepted, mut rejected, mut dropped) = (0, 0, 0);
        for account in self.actors.values() {
            accepted += account.accepted;
            rejected += account.rejected() + account.duplicates;
            dropped += account.dropped_but_not_lost();
            add("duplicate", account.duplicates);
            account.rejected.iter().for_each(|(reason, count)| add(reason, *count));
            account
                .dropped_by_reason()
                .iter()
                .for_each(|(reason, count)| add(reason.name(), *count));
        }
        for (reason, count) in &self.unattributed {
            rejected += count;
            add(reason, *count);
        }
        sum.accepted = accepted;
        sum.rejected = rejected;
        sum.dropped = dropped;
        let waiting: u64 = self.actors.values().map(|account| account.waiting).sum();
        sum.received = accepted + rejected + dropped + waiting;
        sum
    }

    /// Chunks that were sent and never arrived, over all actors.
    pub fn lost(&self) -> u64 {
        self.actors.values().map(IncarnationAccount::lost).sum()
    }

    /// Per incarnation, for the last event of a run. Chunks, so duplicates are left out.
    pub fn per_actor(&self) -> Vec<progress::ActorAccount> {
        let row = |((actor_id, incarnation), account): (&ActorKey, &IncarnationAccount)| {
            let dropped = account.dropped_but_not_lost();
            progress::ActorAccount {
                actor_id: *actor_id,
                incarnation: *incarnation,
                sent: account.claimed.filter(|_| account.said_bye),
                received: account.accepted + account.rejected() + dropped + account.waiting,
                accepted: account.accepted,
                rejected: account.rejected(),
                dropped,
            }
        };
        self.actors.iter().map(row).collect()
    }

    /// The table that goes into `accounting.json`.
    pub fn report(&self) -> Report {
        let rows: Vec<ReportRow> =
            self.actors.iter().map(|(key, account)| row(*key, account)).collect();
        let total = |pick: fn(&ReportRow) -> u64| rows.iter().map(pick).sum();
        Report {
            identity: "sent = accepted + rejected + dropped + waiting",
            holds: self.holds(),
            sent: total(|row| row.sent),
            accepted: total(|row| row.accepted),
            rejected: total(|row| row.rejected.values().sum()),
            dropped: total(|row| row.dropped.values().sum()),
            waiting: total(|row| row.waiting),
            duplicates: total(|row| row.duplicates),
            unattributed: self.unattributed.clone(),
            actors: rows,
        }
    }

    fn change(&mut self, actor: ActorKey, what: impl FnOnce(&mut IncarnationAccount)) {
        if let Some(account) = self.actors.get_mut(&actor) {
            what(account);
        }
    }
}

fn row((actor_id, incarnation): ActorKey, account: &IncarnationAccount) -> ReportRow {
    let mut dropped: BTreeMap<&'static str, u64> =
        account.dropped_by_reason().iter().map(|(reason, count)| (reason.name(), *count)).collect();
    if account.lost() > 0 {
        dropped.insert(DropReason::Lost.name(), account.lost());
    }
    ReportRow {
        actor_id,
        incarnation,
        sent: account.sent(),
        said_bye: account.said_bye,
        accepted: account.accepted,
        rejected: account.rejected.clone(),
        dropped,
        waiting: account.waiting,
        duplicates: account.duplicates,
        holds: account.holds(),
    }
}

/// `accounting.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Report {
    /// What is checked, in words.
    pub identity: &'static str,
    /// Whether it holds for every incarnation.
    pub holds: bool,
    /// Chunks sent, over all actors.
    pub sent: u64,
    /// Used for learning.
    pub accepted: u64,
    /// Refused.
    pub rejected: u64,
    /// Valid but not used, or lost.
    pub dropped: u64,
    /// In the queue for the next batch.
    pub waiting: u64,
    /// Frames that came again; no fate of their own.
    pub duplicates: u64,
    /// Frames that belong to no actor of this run, by reason.
    pub unattributed: BTreeMap<String, u64>,
    /// One row per actor and incarnation.
    pub actors: Vec<ReportRow>,
}

/// One incarnation of one actor in [`Report`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ReportRow {
    /// Actor.
    pub actor_id: u32,
    /// How many times it was started before.
    pub incarnation: u64,
    /// Chunks it sent, as far as anybody knows.
    pub sent: u64,
    /// Whether it ended in good order.
    pub said_bye: bool,
    /// Used.
    pub accepted: u64,
    /// Refused, by reason.
    pub rejected: BTreeMap<String, u64>,
    /// Not used, by reason.
    pub dropped: BTreeMap<&'static str, u64>,
    /// In the queue.
    pub waiting: u64,
    /// Frames that came again.
    pub duplicates: u64,
    /// Whether the identity holds for this row.
    pub holds: bool,
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const A: ActorKey = (3, 0);

    fn accepted(accounting: &mut Accounting, sequence: u64) {
        assert_eq!(accounting.arrive(A, sequence), Arrival::New);
        accounting.wait(A);
        accounting.accept(A);
    }

    #[test]
    fn gaps_are_lost_until_they_are_filled() {
        let mut accounting = Accounting::default();
        accepted(&mut accounting, 0);
        accepted(&mut accounting, 3);
        // 4 sent (0 to 3), 2 accepted, 1 and 2 lost.
        assert_eq!((accounting.report().sent, accounting.lost()), (4, 2));
        accepted(&mut accounting, 1);
        assert_eq!(accounting.lost(), 1);
        assert_eq!(accounting.arrive(A, 1), Arrival::Duplicate);
        assert!(accounting.holds());
        let report = accounting.report();
        assert_eq!((report.sent, report.accepted, report.dropped, report.duplicates), (4, 3, 1, 1));
    }

    #[test]
    fn what_was_sent_and_never_came_is_known_from_the_last_words_or_the_ledger() {
        let mut accounting = Accounting::default();
        accepted(&mut accounting, 0);
        accounting.ledger(A, 3);
        assert_eq!(accounting.lost(), 2);
        accounting.goodbye(A, 2);
        accounting.ledger(A, 9);
        assert_eq!(accounting.lost(), 1, "the last words win");
        assert!(accounting.holds());
        accounting.goodbye((4, 0), 5);
        assert_eq!(accounting.lost(), 6, "an actor of which nothing came");
        accounting.goodbye(A, 0);
        assert!(!accounting.holds(), "fewer claimed than came");
    }

    #[test]
    fn absurd_numbers_are_not_believed() {
        let mut accounting = Accounting::default();
        assert_eq!(accounting.arrive(A, u64::MAX), Arrival::Implausible);
        assert_eq!(accounting.report().actors.len(), 0);
        assert_eq!(accounting.arrive(A, 100_000), Arrival::New);
        accounting.reject(A, "not_finite");
        // Only the newest 4,096 of the 100,000 missing ones may still come.
        assert_eq!(accounting.lost(), 100_000);
        assert_eq!(accounting.arrive(A, 5), Arrival::Duplicate);
        assert_eq!(accounting.arrive(A, 99_999), Arrival::New);
        accounting.drop_new(A, DropReason::Stale);
        assert_eq!(accounting.lost(), 99_999);
        assert!(accounting.holds());
    }

    #[test]
    fn a_checkpoint_keeps_everything_but_the_queue() {
        let mut accounting = Accounting::default();
        accepted(&mut accounting, 0);
        accounting.arrive(A, 1);
        accounting.wait(A);
        accounting.reject_unattributed("malformed");
        let text = serde_json::to_string(&accounting).unwrap();
        let mut restored: Accounting = serde_json::from_str(&text).unwrap();
        assert_eq!(restored, accounting);
        restored.restarted();
        assert!(restored.holds());
        assert_eq!(restored.report().actors[0].dropped["restart"], 1);
        assert_eq!((restored.next_incarnation(3), restored.next_incarnation(2)), (1, 0));
    }

    #[test]
    fn what_came_after_the_checkpoint_is_rolled_back_once() {
        let mut accounting = Accounting::default();
        accepted(&mut accounting, 0);
        // The checkpoint is of then. The ledger says 4 in all, and an incarnation of later sent 2.
        accounting.rolled_back(A, 4);
        accounting.rolled_back((3, 1), 2);
        assert!(accounting.holds());
        let report = accounting.report();
        assert_eq!((report.sent, report.accepted, report.dropped), (6, 1, 5));
        assert_eq!(report.actors[0].dropped["rolled_back"], 3);
        assert_eq!((accounting.lost(), accounting.next_incarnation(3)), (0, 2));
        let row = &accounting.per_actor()[0];
        assert_eq!((row.received, row.dropped), (4, 3));
        assert_eq!(accounting.summary().reasons["rolled_back"], 5);
        // At the end the ledgers are read again.
        accounting.ledger(A, 4);
        assert_eq!((accounting.lost(), accounting.report().sent), (0, 6));
        // One that was on its way to the learner before counts now; used before, it comes again: a duplicate.
        accepted(&mut accounting, 3);
        assert_eq!(accounting.arrive(A, 0), Arrival::Duplicate);
        assert_eq!(accounting.report().actors[0].dropped["rolled_back"], 2);
        // More than are remembered one by one.
        accounting.rolled_back((5, 0), 10_000);
        assert_eq!(accounting.per_actor()[2].dropped, 10_000);
        assert!(accounting.holds());
    }

    #[test]
    fn frames_and_chunks_are_summed_apart() {
        let mut accounting = Accounting::default();
        accepted(&mut accounting, 0);
        accounting.arrive(A, 0);
        accounting.reject_unattributed("wrong_run");
        let sum = accounting.summary();
        assert_eq!((sum.received, sum.accepted, sum.rejected, sum.dropped), (3, 1, 2, 0));
        let row = &accounting.per_actor()[0];
        assert_eq!((row.received, row.accepted, row.rejected, row.sent), (1, 1, 0, None));
    }

    proptest! {
        #[test]
        fn the_identity_holds_whatever_happens(
            events in prop::collection::vec((0_u32..3, 0_u64..2, 0_u64..40, 0_u8..6), 0..200),
            byes in prop::collection::vec((0_u32..3, 0_u64..2, 40_u64..60), 0..6),
        ) {
            let mut accounting = Accounting::default();
            for (actor, incarnation, sequence, fate) in events {
                let key = (actor, incarnation);
                if accounting.arrive(key, sequence) == Arrival::New {
                    match fate {
                        0 => accounting.reject(key, "dimensions"),
                        1 => accounting.drop_new(key, DropReason::Surplus),
                        2 => accounting.wait(key),
                        3 => { accounting.wait(key); accounting.drop_waiting(key, DropReason::Stale); }
                        _ => { accounting.wait(key); accounting.accept(key); }
                    }
                }
                prop_assert!(accounting.holds());
            }
            for (actor, incarnation, sent) in byes {
                accounting.goodbye((actor, incarnation), sent);
                prop_assert!(accounting.holds());
            }
            accounting.restarted();
            let report = accounting.report();
            prop_assert!(report.holds && report.waiting == 0);
            prop_assert_eq!(report.sent, report.accepted + report.rejected + report.dropped);
        }
    }
}
