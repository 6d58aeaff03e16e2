//! The checks of a fetch by name, so that tests can show what each of them is there for: with one left out, exactly what it keeps out gets
//! through.

use caudata_proto::registry::{FetchPart, Manifest};
use sha2::{Digest, Sha256};

use crate::ClientError;

/// One check between what a server sends and the file that was asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// What follows is the file that was asked for, from where it was asked for.
    Follows,
    /// No byte more than announced is taken.
    Size,
    /// No byte less.
    Length,
    /// The bytes have the announced hash.
    Hash,
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

/// The bytes that `part` adds to the `have` bytes that came so far, the first of this answer behind `offset`.
///
/// # Errors
/// [`ClientError::WrongBytes`] where it is not a part of the file.
pub(crate) fn piece(
    manifest: &Manifest,
    offset: u64,
    have: usize,
    part: FetchPart,
) -> Result<Vec<u8>, ClientError> {
    match part {
        FetchPart::Info(info)
            if !Step::Follows.on()
                || (info.offset == offset
                    && info.size == manifest.size
                    && info.sha256 == manifest.sha256) =>
        {
            Ok(Vec::new())
        }
        FetchPart::Data(piece)
            if !Step::Size.on() || have as u64 + piece.len() as u64 <= manifest.size =>
        {
            Ok(piece)
        }
        _ => Err(ClientError::WrongBytes {
            reason: format!(
                "the server left the {} bytes of the manifest",
                manifest.size
            ),
        }),
    }
}

/// Refuses what is not, byte for byte, the file of `manifest`.
///
/// # Errors
/// [`ClientError::WrongBytes`].
pub(crate) fn check_whole(manifest: &Manifest, bytes: &[u8]) -> Result<(), ClientError> {
    let length = !Step::Length.on() || bytes.len() as u64 == manifest.size;
    let actual: [u8; 32] = Sha256::digest(bytes).into();
    if length && (!Step::Hash.on() || actual == manifest.sha256) {
        return Ok(());
    }
    Err(ClientError::WrongBytes {
        reason: format!(
            "{} of {} bytes came, or their hash differs",
            bytes.len(),
            manifest.size
        ),
    })
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use caudata_left_out::{each_left_out, steps_in};
    use caudata_proto::registry::{FetchInfo, StreamName};

    use super::*;

    thread_local! {
        pub(super) static LEFT_OUT: Cell<Option<Step>> = const { Cell::new(None) };
    }

    fn manifest(bytes: &[u8]) -> Manifest {
        Manifest {
            stream: StreamName::new("s").unwrap(),
            version: 1,
            sha256: Sha256::digest(bytes).into(),
            size: bytes.len() as u64,
            created_unix_ms: 5,
            run_id: "run".into(),
            contract_hash: [2; 32],
            robot_name: "polymander".into(),
            robot_hash: [3; 32],
            env_steps: 9,
            training_commit: String::new(),
            config_hash: String::new(),
            evaluation_json: None,
            reverts_to: None,
            signatures: Vec::new(),
        }
    }

    /// Tries to get past `step` with what it alone keeps out.
    fn attempt(step: Step) -> Result<(), String> {
        let mut manifest = manifest(b"a policy");
        let outcome = match step {
            Step::Follows => {
                let info = FetchInfo {
                    sha256: manifest.sha256,
                    size: manifest.size,
                    offset: 0,
                };
                // Four bytes are there, and it begins anew.
                piece(&manifest, 4, 4, FetchPart::Info(info)).map(drop)
            }
            Step::Size => piece(&manifest, 0, 8, FetchPart::Data(vec![7])).map(drop),
            Step::Length => {
                manifest.size += 1;
                check_whole(&manifest, b"a policy")
            }
            Step::Hash => check_whole(&manifest, b"A policy"),
        };
        outcome.map_err(|e| e.to_string())
    }

    const ALL: [Step; 4] = [Step::Follows, Step::Size, Step::Length, Step::Hash];

    #[test]
    fn each_step_and_no_other_keeps_its_bytes_out() {
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
