//! How much an actor may collect before it has to wait for the next policy. A pure state machine.

/// Credits of one actor: each chunk costs one, each new policy version pays for one quota, and never more
/// than `1 + max_lead` quotas are held.
///
/// `max_lead = 0`: one quota per version, then wait (every chunk is from the newest policy). `max_lead = 1`:
/// one quota more than the versions seen, so that the actor collects while the learner learns and its data is
/// one version old. Versions that were skipped pay nothing above the cap: after a pause there is no burst of
/// old data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quota {
    per_version: u32,
    max_lead: u32,
    /// Credits left, to save it.
    pub credits: u32,
    newest: Option<u64>,
}

impl Quota {
    /// No policy yet, so nothing may be collected. `per_version` is at least 1.
    pub fn new(per_version: u32, max_lead: u32) -> Self {
        Self { per_version: per_version.max(1), max_lead, credits: 0, newest: None }
    }

    /// The most credits that can be held.
    fn cap(&self) -> u32 {
        self.per_version.saturating_mul(self.max_lead.saturating_add(1))
    }

    /// A policy arrived. The first one fills the account; later ones pay per version, a repeated one nothing.
    /// A link never goes back to an older policy of the same learner, so that an older one is the first of
    /// another learner: it fills the account again, or this actor and that learner would wait for each other.
    pub fn policy_arrived(&mut self, version: u64) {
        let versions = match self.newest.and_then(|newest| version.checked_sub(newest)) {
            None => u64::from(self.max_lead) + 1,
            Some(versions) => versions,
        };
        let paid = u64::from(self.per_version).saturating_mul(versions);
        let credits = u64::from(self.credits).saturating_add(paid).min(u64::from(self.cap()));
        // At most the cap, which is a u32.
        self.credits = credits as u32;
        self.newest = Some(version);
    }

    /// Whether another chunk may be collected now.
    pub fn may_collect(&self) -> bool {
        self.credits > 0
    }

    /// A chunk was collected.
    pub fn chunk_collected(&mut self) {
        self.credits = self.credits.saturating_sub(1);
    }

    /// The version seen last.
    pub fn newest(&self) -> Option<u64> {
        self.newest
    }

    /// As it was when saved: with these credits and this newest version.
    pub fn restored(self, credits: u32, newest: Option<u64>) -> Self {
        Self { credits: credits.min(self.cap()), newest, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many chunks may be collected right now.
    fn spend_all(quota: &mut Quota) -> u32 {
        let mut chunks = 0;
        while quota.may_collect() {
            quota.chunk_collected();
            chunks += 1;
        }
        chunks
    }

    /// Chunks collected after each of the versions that arrive.
    fn collected(per_version: u32, max_lead: u32, versions: &[u64]) -> Vec<u32> {
        let mut quota = Quota::new(per_version, max_lead);
        assert_eq!(spend_all(&mut quota), 0, "nothing without a policy");
        versions
            .iter()
            .map(|&version| {
                quota.policy_arrived(version);
                spend_all(&mut quota)
            })
            .collect()
    }

    #[test]
    fn in_sync_each_version_gets_one_quota() {
        assert_eq!(collected(1, 0, &[7, 8, 9]), [1, 1, 1]);
        assert_eq!(collected(3, 0, &[0, 1, 2]), [3, 3, 3]);
    }

    #[test]
    fn with_a_lead_the_first_version_gets_one_more() {
        assert_eq!(collected(1, 1, &[7, 8, 9]), [2, 1, 1]);
        assert_eq!(collected(2, 2, &[0, 1, 2]), [6, 2, 2]);
    }

    #[test]
    fn skipped_versions_pay_up_to_the_cap_and_repeated_ones_nothing() {
        assert_eq!(collected(2, 1, &[0, 9]), [4, 4]);
        assert_eq!(collected(1, 0, &[5, 5, 6]), [1, 0, 1]);
    }

    /// A learner that was killed goes on from an older checkpoint, and may count from there.
    #[test]
    fn an_older_version_is_a_new_beginning() {
        assert_eq!(collected(1, 0, &[5, 3, 4]), [1, 1, 1]);
        assert_eq!(collected(2, 1, &[5, 3, 4]), [4, 4, 2]);
    }

    #[test]
    fn an_unfinished_quota_does_not_pile_up() {
        let mut quota = Quota::new(2, 0);
        quota.policy_arrived(0);
        quota.chunk_collected();
        quota.policy_arrived(1);
        assert_eq!(spend_all(&mut quota), 2);
    }

    #[test]
    fn restoring_goes_on_where_it_was() {
        let quota = Quota::new(1, 0).restored(0, Some(4));
        let mut resumed = quota;
        resumed.policy_arrived(4);
        assert!(!resumed.may_collect());
        resumed.policy_arrived(5);
        assert_eq!(spend_all(&mut resumed), 1);
    }
}
