//! The store's checks by name, so that tests can show what each of them is there for: with one left out, exactly what it keeps out gets
//! through. That a version is never published twice with other bytes is not among them: the disk refuses the second file as well.

/// One check between a wrong request and the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// The bytes have the announced hash.
    Hash,
    /// A stream keeps to one contract.
    Contract,
    /// Quarantined bytes do not come back under another number.
    QuarantinedBytes,
    /// A label is where whoever moves it believes.
    LabelMoved,
    /// It leads to something that is there.
    LabelKnown,
    /// And that is not quarantined.
    LabelUsable,
    /// It never leads down.
    LabelUp,
    /// `stable` needs robots' word, or a reason.
    LabelProof,
    /// Stored bytes are still those of their name.
    StoredHash,
}

impl Step {
    /// Whether the check is made; always, outside of tests.
    #[cfg(not(test))]
    pub(crate) const fn on(self) -> bool {
        true
    }

    /// Whether the check is made: a test may leave one out.
    #[cfg(test)]
    pub(crate) fn on(self) -> bool {
        tests::LEFT_OUT.get() != Some(self)
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use caudata_left_out::{each_left_out, steps_in};
    use caudata_proto::hex::hex;
    use caudata_proto::registry::{LabelName, QuarantineState, SetLabel, StreamName};
    use sha2::{Digest, Sha256};

    use super::Step;
    use crate::audit::Origin;
    use crate::store::{Store, StoreLimits};
    use crate::testing::manifest;

    thread_local! {
        pub(super) static LEFT_OUT: Cell<Option<Step>> = const { Cell::new(None) };
    }

    fn label(name: &str, version: u64, expected_generation: u64) -> SetLabel {
        SetLabel {
            stream: StreamName::new("s").unwrap(),
            label: LabelName::new(name).unwrap(),
            version,
            expected_generation,
            override_reason: None,
        }
    }

    /// Tries to get past `step` with what it alone keeps out: versions 1, 2 and 3 are there, 3 is quarantined, `canary` leads to 2.
    fn attempt(step: Step) -> Result<(), String> {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Store::open(folder.path(), StoreLimits::default()).unwrap();
        let (origin, stream) = (Origin::local(), StreamName::new("s").unwrap());
        for bytes in [b"one", b"two", b"six"] {
            let version = store.newest(&stream).map_or(0, |r| r.manifest.version) + 1;
            store.publish(manifest("s", version, bytes), bytes).unwrap();
        }
        let out_of_use = QuarantineState {
            stream: stream.clone(),
            version: 3,
            reason: "falls".to_owned(),
            generation: 0,
            by: String::new(),
            unix_ms: 0,
        };
        store.quarantine(&origin, out_of_use).unwrap();
        let canary = store
            .set_label(&origin, label("canary", 2, 0))
            .unwrap()
            .generation;
        let mut four = manifest("s", 4, b"four");
        let outcome = match step {
            Step::Hash => store.publish(four, b"other").map(drop),
            Step::Contract => {
                four.contract_hash = [8; 32];
                store.publish(four, b"four").map(drop)
            }
            Step::QuarantinedBytes => store.publish(manifest("s", 4, b"six"), b"six").map(drop),
            Step::StoredHash => {
                let sha256: [u8; 32] = Sha256::digest(b"one").into();
                let blob = folder.path().join(format!("blobs/{}.onnx", hex(&sha256)));
                std::fs::write(blob, b"One").unwrap();
                store.read_blob(&sha256).map(drop)
            }
            label_step => {
                let wanted = match label_step {
                    Step::LabelMoved => label("canary", 2, canary - 1),
                    Step::LabelKnown => label("canary", 9, canary),
                    Step::LabelUsable => label("canary", 3, canary),
                    Step::LabelUp => label("canary", 1, canary),
                    _ => label("stable", 2, 0),
                };
                store.set_label(&origin, wanted).map(drop)
            }
        };
        outcome.map_err(|e| e.to_string())
    }

    const ALL: [Step; 9] = [
        Step::Hash,
        Step::Contract,
        Step::QuarantinedBytes,
        Step::LabelMoved,
        Step::LabelKnown,
        Step::LabelUsable,
        Step::LabelUp,
        Step::LabelProof,
        Step::StoredHash,
    ];

    #[test]
    fn each_step_and_no_other_keeps_its_request_out() {
        let table = each_left_out(&LEFT_OUT, &ALL, attempt);
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    #[test]
    fn the_table_holds_every_step() {
        let table = ALL.map(|step| format!("{step:?}"));
        assert_eq!(steps_in(include_str!("steps.rs")), table);
    }
}
