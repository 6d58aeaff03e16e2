//! Which policies the actors ran, by the hash that their chunks name.

use std::collections::BTreeMap;

use caudata_policy::PolicyFile;
use caudata_proto::hex::hex;
use caudata_telemetry::progress::ActorsPolicy;

/// Versions that chunks and the policy server may still name.
const VERSIONS_MAX: usize = 64;

/// What the learner made, and what became of it.
#[derive(Debug, Default)]
pub(super) struct PoliciesSeen {
    made: BTreeMap<u64, Made>,
    /// The newest of the forgotten ones that actors ran and that was published.
    forgotten: Option<ActorsPolicy>,
}

#[derive(Debug)]
struct Made {
    sha256: [u8; 32],
    /// Hash of the bytes that actors had loaded.
    ran: Option<[u8; 32]>,
    published: bool,
}

impl PoliciesSeen {
    /// The actors were given `policy`.
    pub fn made(&mut self, policy: &PolicyFile) {
        self.note(policy.metadata().version, policy.sha256());
    }

    /// The policy server has `version`.
    pub fn published(&mut self, version: u64) {
        if let Some(made) = self.made.get_mut(&version) {
            made.published = true;
        }
    }

    /// A chunk came from an actor that had loaded bytes with this hash as `version`.
    pub fn ran(&mut self, version: u64, sha256: &[u8; 32]) {
        if let Some(made) = self.made.get_mut(&version) {
            made.ran = Some(*sha256);
        }
    }

    /// The newest policy that actors ran and that the policy server has; without one, the newest that they
    /// ran.
    pub fn best(&self) -> Option<ActorsPolicy> {
        let ran = || self.made.iter().rev().filter_map(|(v, made)| told(*v, made));
        let published = ran().find(|policy| policy.published);
        published.or_else(|| self.forgotten.clone()).or_else(|| ran().next())
    }

    fn note(&mut self, version: u64, sha256: [u8; 32]) {
        let made = Made { sha256, ran: None, published: false };
        self.made.insert(version, made);
        while self.made.len() > VERSIONS_MAX {
            let Some((version, made)) = self.made.pop_first() else { return };
            let kept = told(version, &made).filter(|policy| policy.published);
            self.forgotten = kept.or(self.forgotten.take());
        }
    }
}

fn told(version: u64, made: &Made) -> Option<ActorsPolicy> {
    Some(ActorsPolicy {
        version,
        sha256: hex(&made.ran?),
        learner_sha256: hex(&made.sha256),
        published: made.published,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_published_one_is_told_and_else_the_newest() {
        let mut seen = PoliciesSeen::default();
        let version = |seen: &PoliciesSeen| seen.best().map(|best| best.version);
        for v in 0..4 {
            seen.note(v, [v as u8; 32]);
        }
        seen.ran(9, &[9; 32]);
        assert_eq!(version(&seen), None, "not one of ours");
        seen.ran(0, &[0; 32]);
        seen.ran(1, &[1; 32]);
        assert_eq!(version(&seen), Some(1));
        seen.ran(2, &[2; 32]);
        seen.ran(3, &[3; 32]);
        assert_eq!(version(&seen), Some(3));
        seen.published(2);
        assert_eq!(version(&seen), Some(2), "version 3 is not on the server");
        let best = seen.best().unwrap();
        assert_eq!(best.sha256, best.learner_sha256);
        assert!(best.sha256.starts_with("0202") && best.published);
        // However long ago that was.
        (4..200).for_each(|v| seen.note(v, [1; 32]));
        seen.ran(199, &[1; 32]);
        assert_eq!(version(&seen), Some(2));
    }
}
