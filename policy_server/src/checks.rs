//! What stands between a wrong request and the store, as tables. That a version is never published twice with
//! other bytes is not among them: the disk refuses the second file as well.

use caudata_proto::checks::Check;
use caudata_proto::hex::hex;
use caudata_proto::registry::{LabelState, Manifest, SetLabel};

use crate::error::StoreError;
use crate::notes::{Hash, Quarantined, UsedUp};

/// Looks at the hash that bytes must have and the one that they have; true: they are others.
pub(crate) type HashCheck = fn(&Hash, &Hash) -> bool;

/// What bytes must be, when they come and when they are read back.
pub(crate) const BYTES: &[Check<HashCheck>] =
    &[Check { name: "hash", refuse: |announced, actual| announced != actual }];

/// A new version, and where it is to be published.
pub(crate) struct Publication<'a> {
    /// Numbers of its stream that are used up.
    pub(crate) used_up: Option<&'a UsedUp>,
    /// The stream's newest version.
    pub(crate) newest: Option<&'a Manifest>,
    /// What is out of use in the stream.
    pub(crate) quarantined: Vec<&'a Quarantined>,
    pub(crate) manifest: &'a Manifest,
}

pub(crate) type PublicationCheck = fn(&Publication<'_>) -> Result<(), StoreError>;

/// What a new version must be.
pub(crate) const PUBLICATION: &[Check<PublicationCheck>] = &[
    // Its number was never another's.
    Check::new("number", |new| {
        let (version, sha256) = (new.manifest.version, &new.manifest.sha256);
        let why = new.used_up.and_then(|used| used.objection(version, sha256));
        why.map_or(Ok(()), |why| {
            Err(StoreError::UsedUp { stream: new.manifest.stream.to_string(), version, why })
        })
    }),
    // A stream keeps to one contract.
    Check::new("contract", |new| match new.newest {
        Some(newest) if newest.contract_hash != new.manifest.contract_hash => {
            Err(StoreError::ContractMismatch {
                stream: new.manifest.stream.to_string(),
                expected: hex(&newest.contract_hash),
                actual: hex(&new.manifest.contract_hash),
            })
        }
        _ => Ok(()),
    }),
    // Bytes that are out of use under one number do not come back under another.
    Check::new("quarantined bytes", |new| {
        let same = |known: &&&Quarantined| known.sha256 == Some(new.manifest.sha256);
        let found = new.quarantined.iter().find(same);
        found.map_or(Ok(()), |known| {
            refused(format!(
                "these bytes are version {} of {}, which is quarantined: {}",
                known.state.version, known.state.stream, known.state.reason
            ))
        })
    }),
];

impl Publication<'_> {
    pub(crate) fn check(&self, checks: &[Check<PublicationCheck>]) -> Result<(), StoreError> {
        checks.iter().try_for_each(|check| (check.refuse)(self))
    }
}

/// A label that is to be moved, and where it is.
pub(crate) struct Move<'a> {
    /// Its version is there.
    pub(crate) known: bool,
    /// Its version is out of use.
    pub(crate) quarantined: bool,
    /// Robots that said that the version went well, and how many `stable` needs.
    pub(crate) good: (usize, usize),
    pub(crate) wanted: &'a SetLabel,
    pub(crate) before: Option<&'a LabelState>,
}

pub(crate) type MoveCheck = fn(&Move<'_>) -> Result<(), StoreError>;

/// What moving a label must be.
pub(crate) const MOVE: &[Check<MoveCheck>] = &[
    // It is where whoever moves it believes.
    Check::new("label moved", |to| {
        let found = to.before.map_or(0, |state| state.generation);
        match found == to.wanted.expected_generation {
            true => Ok(()),
            false => Err(StoreError::LabelMoved {
                stream: to.wanted.stream.to_string(),
                label: to.wanted.label.to_string(),
                found,
                expected: to.wanted.expected_generation,
            }),
        }
    }),
    // It leads to something that is there.
    Check::new("label known", |to| {
        let (stream, version) = (&to.wanted.stream, to.wanted.version);
        match to.known {
            true => Ok(()),
            false => {
                refused(format!("{stream} has no version {version} that a label could lead to"))
            }
        }
    }),
    // And that is not quarantined.
    Check::new("label usable", |to| {
        let (stream, version) = (&to.wanted.stream, to.wanted.version);
        match to.quarantined {
            false => Ok(()),
            true => refused(format!("{stream} version {version} is quarantined")),
        }
    }),
    // It never leads down.
    Check::new("label up", |to| match to.before {
        Some(before) if before.version > to.wanted.version => refused(format!(
            "{} leads to version {}, and robots never go back to a lower one; `caudata policy revert` publishes \
             version {} again under a higher number",
            to.wanted.label, before.version, to.wanted.version
        )),
        _ => Ok(()),
    }),
    // `stable` needs robots' word, or a reason.
    Check::new("label proof", |to| {
        let SetLabel { stream, label, version, override_reason, .. } = to.wanted;
        let (good, needed) = to.good;
        match label.needs_proof() && good < needed && override_reason.is_none() {
            false => Ok(()),
            true => refused(format!(
                "{good} robots ran {stream} version {version} through its trial, {label} needs {needed}; let robots \
                 follow another label first, or give a reason to override"
            )),
        }
    }),
];

impl Move<'_> {
    pub(crate) fn check(&self, checks: &[Check<MoveCheck>]) -> Result<(), StoreError> {
        checks.iter().try_for_each(|check| (check.refuse)(self))
    }
}

fn refused(reason: String) -> Result<(), StoreError> {
    Err(StoreError::NotAllowed { reason })
}

#[cfg(test)]
mod tests {
    use caudata_proto::checks::each_left_out;
    use caudata_proto::registry::{LabelName, QuarantineState, StreamName};

    use super::*;
    use crate::audit::Origin;
    use crate::store::{Store, StoreLimits};
    use crate::testing::manifest;

    fn stream() -> StreamName {
        StreamName::new("s").unwrap()
    }

    fn label(name: &str, version: u64, expected_generation: u64) -> SetLabel {
        SetLabel {
            stream: stream(),
            label: LabelName::new(name).unwrap(),
            version,
            expected_generation,
            override_reason: None,
        }
    }

    /// Versions 1, 2 and 3 are there, 3 is quarantined, 4 is used up, `canary` leads to 2.
    fn store(folder: &std::path::Path) -> (Store, LabelState) {
        let mut store = Store::open(folder, StoreLimits::default()).unwrap();
        for (version, bytes) in [(1, b"one"), (2, b"two"), (3, b"six")] {
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let out_of_use = QuarantineState {
            stream: stream(),
            version: 3,
            reason: "falls".to_owned(),
            generation: 0,
            by: String::new(),
            unix_ms: 0,
        };
        store.quarantine(&Origin::local(), out_of_use).unwrap();
        let canary = store.set_label(&Origin::local(), label("canary", 2, 0));
        store.used_up.entry(stream()).or_default().damage(4, None);
        (store, canary.unwrap())
    }

    #[test]
    fn each_step_and_no_other_keeps_its_request_out() {
        let folder = tempfile::tempdir().unwrap();
        let (store, canary) = store(folder.path());
        let bytes = each_left_out(BYTES, |_, checks| {
            match checks.iter().any(|c| (c.refuse)(&[1; 32], &[2; 32])) {
                true => Err("other bytes"),
                false => Ok(()),
            }
        });
        let publications = each_left_out(PUBLICATION, |name, checks| {
            let mut new = match name {
                "number" => manifest("s", 4, b"four"),
                "contract" => manifest("s", 5, b"five"),
                _ => manifest("s", 5, b"six"),
            };
            if name == "contract" {
                new.contract_hash = [8; 32];
            }
            store.publication(&new).check(checks)
        });
        let moves = each_left_out(MOVE, |name, checks| {
            let (wanted, before) = match name {
                "label moved" => (label("canary", 2, canary.generation - 1), Some(&canary)),
                "label known" => (label("canary", 9, canary.generation), Some(&canary)),
                "label usable" => (label("canary", 3, canary.generation), Some(&canary)),
                "label up" => (label("canary", 1, canary.generation), Some(&canary)),
                _ => (label("stable", 2, 0), None),
            };
            store.moving(&wanted, before).check(checks)
        });
        // Seen with --nocapture: `make mutants`.
        for table in [bytes, publications, moves] {
            eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
        }
    }
}
