//! Whether every chunk that was sent is accounted for. Pure.

use caudata_actor::LedgerCount;
use caudata_telemetry::progress::ActorAccount;
use serde::Serialize;

/// `sent = accepted + rejected + dropped + lost`, over all actors of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Balance {
    /// Chunks that actors sent, by their own count.
    pub sent: u64,
    /// Used for learning.
    pub accepted: u64,
    /// Refused.
    pub rejected: u64,
    /// Valid but not used.
    pub dropped: u64,
    /// Sent by a killed actor, and gone with it: they never reached the learner.
    pub lost: u64,
    /// Whether everything adds up.
    pub holds: bool,
    /// Where it does not, one line each.
    pub problems: Vec<String>,
    /// Actors whose own count is torn, one line each: what they lost is not known.
    pub incomplete: Vec<String>,
}

/// Checks the learner's account of each actor against the actor's own count. An actor that said goodbye has
/// lost nothing; one that was killed may have lost what was on its way.
pub fn balance(accounts: &[ActorAccount], ledgers: &[LedgerCount]) -> Balance {
    let mut total = Balance::default();
    for account in accounts {
        let name = format!("actor {}.{}", account.actor_id, account.incarnation);
        let known = account.accepted + account.rejected + account.dropped;
        if known != account.received {
            total.problems.push(format!(
                "{name}: {} received, but {} accepted + {} rejected + {} dropped",
                account.received, account.accepted, account.rejected, account.dropped
            ));
        }
        let ledger = ledgers
            .iter()
            .find(|l| (l.actor_id, l.incarnation) == (account.actor_id, account.incarnation))
            .map(|l| l.sent);
        // A ledger is written before its chunk is sent: 0 after a chunk has arrived is what a power cut
        // leaves.
        let torn = |sent: &Option<u64>| sent.is_none_or(|sent| sent == 0 && account.received > 0);
        if ledger.as_ref().is_some_and(torn) {
            total.incomplete.push(format!(
                "{name}: its ledger is torn, so what it lost on the way is not known"
            ));
        }
        let ledger = ledger.filter(|sent| !torn(sent)).flatten();
        if let (Some(ledger), Some(bye)) = (ledger, account.sent)
            && ledger != bye
        {
            total
                .problems
                .push(format!("{name}: its ledger says {ledger} sent, its goodbye {bye}"));
        }
        let sent = ledger.or(account.sent).unwrap_or(account.received);
        match sent.checked_sub(account.received) {
            None => total
                .problems
                .push(format!("{name}: {} received, but only {sent} sent", account.received)),
            Some(lost) if lost > 0 && account.sent.is_some() => total
                .problems
                .push(format!("{name}: said goodbye, yet {lost} of {sent} chunks did not arrive")),
            Some(lost) => total.lost += lost,
        }
        total.sent += sent;
        total.accepted += account.accepted;
        total.rejected += account.rejected;
        total.dropped += account.dropped;
    }
    for ledger in ledgers {
        let heard = accounts
            .iter()
            .any(|a| (a.actor_id, a.incarnation) == (ledger.actor_id, ledger.incarnation));
        if !heard {
            // Killed before the learner heard of it: all of it is lost.
            let sent = ledger.sent.unwrap_or(0);
            total.sent += sent;
            total.lost += sent;
        }
    }
    total.holds = total.problems.is_empty()
        && total.sent == total.accepted + total.rejected + total.dropped + total.lost;
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    fn account(actor_id: u32, incarnation: u64, sent: Option<u64>, accepted: u64) -> ActorAccount {
        let received = accepted;
        ActorAccount { actor_id, incarnation, sent, received, accepted, rejected: 0, dropped: 0 }
    }

    fn ledger(actor_id: u32, incarnation: u64, sent: u64) -> LedgerCount {
        LedgerCount { actor_id, incarnation, sent: Some(sent) }
    }

    #[test]
    fn a_torn_ledger_leaves_the_books_incomplete_and_the_training_whole() {
        // Two bytes of eight in one, eight zeros in the other: both actors were killed.
        let mut ledgers = [ledger(0, 0, 0), ledger(1, 0, 0)];
        ledgers[0].sent = None;
        let found = balance(&[account(0, 0, None, 4), account(1, 0, None, 5)], &ledgers);
        assert!(found.holds && found.problems.is_empty(), "{found:?}");
        assert_eq!((found.sent, found.lost, found.incomplete.len()), (9, 0, 2));
        // Its goodbye says as much as the ledger would.
        let parted = balance(&[account(0, 0, Some(4), 4)], &ledgers[..1]);
        assert!(parted.holds && parted.incomplete.len() == 1, "{parted:?}");
    }

    #[test]
    fn a_killed_actor_may_lose_what_was_on_its_way() {
        // Actor 1 was killed after 5 chunks, of which 4 arrived; its next incarnation sent 6.
        let accounts =
            [account(0, 0, Some(10), 10), account(1, 0, None, 4), account(1, 1, Some(6), 6)];
        let ledgers = [ledger(0, 0, 10), ledger(1, 0, 5), ledger(1, 1, 6)];
        let balance = balance(&accounts, &ledgers);
        assert_eq!((balance.sent, balance.accepted, balance.lost), (21, 20, 1));
        assert!(balance.holds, "{balance:?}");
    }

    #[test]
    fn a_chunk_that_vanishes_is_noticed() {
        let gone = balance(&[account(0, 0, Some(10), 9)], &[ledger(0, 0, 10)]);
        assert!(!gone.holds && gone.problems[0].contains("1 of 10"), "{gone:?}");
        let twice = balance(&[account(0, 0, Some(10), 11)], &[ledger(0, 0, 10)]);
        assert!(!twice.holds, "{twice:?}");
        let unequal = balance(&[account(0, 0, Some(10), 10)], &[ledger(0, 0, 11)]);
        assert!(!unequal.holds, "{unequal:?}");
        let mut unsorted = account(0, 0, Some(3), 3);
        unsorted.rejected = 1;
        assert!(!balance(&[unsorted], &[]).holds);
    }

    #[test]
    fn without_a_ledger_the_goodbye_counts_and_an_unheard_actor_is_lost() {
        assert!(balance(&[account(0, 0, Some(7), 7)], &[]).holds);
        let unheard = balance(&[], &[ledger(2, 0, 1)]);
        assert_eq!((unheard.sent, unheard.lost, unheard.holds), (1, 1, true));
    }
}
