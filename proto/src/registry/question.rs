//! Whether an answer is one to the question that was asked: one rule for every call, for programs and robots
//! alike.
//!
//! A signature says who said something, not to whom. A server that holds an announcement which is genuinely
//! signed and about something else must not be able to pass it off as the one that was asked for.

use super::error::NONCE_BYTES;
use super::messages::{Freshness, LabelState, Manifest, QuarantineState};
use super::names::{LabelName, StreamName};
use crate::checks::Check;
use crate::hex::hex;

/// What a question fixes, or what an answer says. Whatever the question fixes, the answer must say likewise.
#[derive(Clone, Copy, Debug, Default)]
pub struct Facts<'a> {
    /// Stream on the policy server.
    pub stream: Option<&'a StreamName>,
    /// Version in it.
    pub version: Option<u64>,
    /// Label in it.
    pub label: Option<&'a LabelName>,
    /// SHA-256 of the policy file.
    pub sha256: Option<&'a [u8; 32]>,
    /// Name of the robot that it is for.
    pub robot: Option<&'a str>,
    /// Hash of that robot's model.
    pub model: Option<&'a [u8; 32]>,
    /// Number drawn for this question alone.
    pub nonce: Option<&'a [u8; NONCE_BYTES]>,
}

/// An answer is about something else than the question.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("it is about {what} {said}, asked was {asked}")]
pub struct OtherQuestion {
    /// What differs.
    pub what: &'static str,
    /// As the question has it.
    pub asked: String,
    /// As the answer has it.
    pub said: String,
}

/// Looks at one fact of a question and of its answer, in this order.
pub type Compare = fn(&Facts<'_>, &Facts<'_>) -> Result<(), OtherQuestion>;

/// What an answer is held against.
pub const ANSWERS: &[Check<Compare>] = &[
    Check::new("stream", |asked, said| {
        same("stream", asked.stream, said.stream, ToString::to_string)
    }),
    Check::new("version", |asked, said| {
        same("version", asked.version, said.version, u64::to_string)
    }),
    Check::new("label", |asked, said| same("label", asked.label, said.label, ToString::to_string)),
    Check::new("bytes", |asked, said| same("bytes", asked.sha256, said.sha256, |hash| hex(*hash))),
    Check::new("robot", |asked, said| same("robot", asked.robot, said.robot, ToString::to_string)),
    Check::new("robot model", |asked, said| {
        same("robot model", asked.model, said.model, |hash| hex(*hash))
    }),
    Check::new("nonce", |asked, said| same("nonce", asked.nonce, said.nonce, |nonce| hex(*nonce))),
];

fn same<T: PartialEq>(
    what: &'static str,
    asked: Option<T>,
    said: Option<T>,
    show: impl Fn(&T) -> String,
) -> Result<(), OtherQuestion> {
    let Some(wanted) = asked else { return Ok(()) };
    match said {
        Some(found) if found == wanted => Ok(()),
        found => Err(OtherQuestion {
            what,
            asked: show(&wanted),
            said: found.map_or_else(|| "nothing".to_owned(), |found| show(&found)),
        }),
    }
}

impl<'a> Facts<'a> {
    /// A question about one stream, or about all of them.
    pub fn of_stream(stream: impl Into<Option<&'a StreamName>>) -> Self {
        Self { stream: stream.into(), ..Self::default() }
    }

    /// Whether `said` answers this question.
    ///
    /// # Errors
    /// [`OtherQuestion`], with the first thing that differs.
    pub fn answered_by<'b>(&self, said: impl Into<Facts<'b>>) -> Result<(), OtherQuestion> {
        let said = said.into();
        ANSWERS.iter().try_for_each(|fact| (fact.refuse)(self, &said))
    }
}

impl<'a> From<&'a Manifest> for Facts<'a> {
    fn from(said: &'a Manifest) -> Self {
        Self {
            stream: Some(&said.stream),
            version: Some(said.version),
            sha256: Some(&said.sha256),
            robot: Some(&said.robot_name),
            model: Some(&said.robot_hash),
            ..Self::default()
        }
    }
}

impl<'a> From<&'a Freshness> for Facts<'a> {
    fn from(said: &'a Freshness) -> Self {
        Self {
            stream: Some(&said.stream),
            version: Some(said.version),
            label: Some(&said.label),
            sha256: Some(&said.sha256),
            nonce: Some(&said.nonce),
            ..Self::default()
        }
    }
}

impl<'a> From<&'a LabelState> for Facts<'a> {
    fn from(said: &'a LabelState) -> Self {
        Self {
            stream: Some(&said.stream),
            version: Some(said.version),
            label: Some(&said.label),
            ..Self::default()
        }
    }
}

impl<'a> From<&'a QuarantineState> for Facts<'a> {
    fn from(said: &'a QuarantineState) -> Self {
        Self { stream: Some(&said.stream), version: Some(said.version), ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checks::each_left_out;

    /// Tries to pass off, under a table, an answer that differs in one thing.
    fn attempt(what: &str, table: &[Check<Compare>]) -> Result<(), String> {
        let streams = ["release/flat", "experimental/rough"].map(|s| StreamName::new(s).unwrap());
        let labels = ["canary", "stable"].map(|l| LabelName::new(l).unwrap());
        let hashes = [[1; 32], [2; 32]];
        let asked = Facts {
            stream: Some(&streams[0]),
            version: Some(3500),
            label: Some(&labels[0]),
            sha256: Some(&hashes[0]),
            robot: Some("polymander"),
            model: Some(&hashes[0]),
            nonce: Some(&hashes[0]),
        };
        let mut said = asked;
        match what {
            "stream" => said.stream = Some(&streams[1]),
            "version" => said.version = Some(3510),
            "label" => said.label = Some(&labels[1]),
            "bytes" => said.sha256 = Some(&hashes[1]),
            "robot" => said.robot = Some("newt"),
            "robot model" => said.model = Some(&hashes[1]),
            "nonce" => said.nonce = None,
            other => panic!("no attempt at {other}"),
        }
        let refused = table.iter().find_map(|c| (c.refuse)(&asked, &said).err());
        refused.map_or(Ok(()), |other| Err(other.to_string()))
    }

    #[test]
    fn fault_17_each_step_and_no_other_keeps_an_answer_to_another_question_out() {
        let table = each_left_out(ANSWERS, attempt);
        // Seen with --nocapture: `make mutants`.
        eprintln!("{}", table.unwrap_or_else(|wrong| panic!("\n{wrong}")));
    }

    #[test]
    fn what_the_question_leaves_open_is_free() {
        let (one, other) = (StreamName::new("a").unwrap(), StreamName::new("b").unwrap());
        let said = Facts::of_stream(&other);
        assert!(Facts::default().answered_by(said).is_ok());
        let refused = Facts::of_stream(&one).answered_by(said).unwrap_err();
        assert_eq!(refused.to_string(), "it is about stream b, asked was a");
    }
}
