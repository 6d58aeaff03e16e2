//! Which policies the actors ran, by the hash that their chunks name.

use std::collections::BTreeMap;

use caudata_policy::PolicyFile;
use caudata_telemetry::progress::ActorsPolicy;

/// Versions that chunks may still name.
const VERSIONS_MAX: usize = 64;

/// What the learner made, and the newest of it that actors ran: one that was published before one that was not.
#[derive(Debug, Default)]
pub(super) struct PoliciesSeen {
    made: BTreeMap<u64, Made>,
    pub best: Option<ActorsPolicy>,
}

#[derive(Debug)]
struct Made {
    sha256: [u8; 32],
    published: bool,
}

impl PoliciesSeen {
    /// The actors were given `policy`; `published`: the policy server was too.
    pub fn made(&mut self, policy: &PolicyFile, published: bool) {
        let (version, sha256) = (policy.metadata().version, policy.sha256());
        self.note(version, sha256, published);
    }

    fn note(&mut self, version: u64, sha256: [u8; 32], published: bool) {
        self.made.insert(version, Made { sha256, published });
        while self.made.len() > VERSIONS_MAX {
            self.made.pop_first();
        }
    }

    /// A chunk came from an actor that had loaded bytes with this hash as `version`.
    pub fn ran(&mut self, version: u64, sha256: &[u8; 32]) {
        let Some(made) = self.made.get(&version) else {
            return;
        };
        let rank = |published: bool, version: u64| (published, version);
        let newer = self
            .best
            .as_ref()
            .is_none_or(|best| rank(best.published, best.version) < rank(made.published, version));
        if newer {
            self.best = Some(ActorsPolicy {
                version,
                sha256: hex(sha256),
                learner_sha256: hex(&made.sha256),
                published: made.published,
            });
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_published_one_is_told_and_else_the_newest() {
        let mut seen = PoliciesSeen::default();
        let version = |seen: &PoliciesSeen| seen.best.as_ref().map(|best| best.version);
        for v in 0..4 {
            seen.note(v, [v as u8; 32], v == 2);
        }
        seen.ran(9, &[9; 32]);
        assert_eq!(version(&seen), None, "not one of ours");
        seen.ran(0, &[0; 32]);
        seen.ran(1, &[1; 32]);
        assert_eq!(version(&seen), Some(1));
        seen.ran(2, &[2; 32]);
        seen.ran(3, &[3; 32]);
        assert_eq!(version(&seen), Some(2), "version 3 is not on the server");
        let best = seen.best.unwrap();
        assert_eq!(best.sha256, best.learner_sha256);
        assert!(best.sha256.starts_with("0202") && best.published);
    }
}
