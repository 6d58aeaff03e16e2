//! What a call to the policy server can end with.

use caudata_proto::registry::RegistryError;
use caudata_proto::registry::question::OtherQuestion;
use tonic::{Code, Status};

use crate::limits::RATE_MIN;

/// What a call to the policy server can end with.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum ClientError {
    /// The address is not one.
    #[error("`{address}` is not an address like 127.0.0.1:7401")]
    Address { address: String },
    /// What is said there could be read and changed on the way.
    #[error(
        "policy server {address} is not on this host and the connection is not encrypted: give https://HOST:PORT and a folder of certificates (`caudata pki`)"
    )]
    Plain { address: String },
    /// The certificates are not there, or do not work.
    #[error("certificates: {reason}")]
    Certificates { reason: String },
    /// Nobody answers.
    #[error("policy server {address} does not answer: {reason}; {}", question(address, reason))]
    Unreachable { address: String, reason: String },
    /// The server answered with a refusal.
    #[error("policy server refuses ({code:?}): {message}")]
    Refused { code: Code, message: String },
    /// An answer that does not pass the checks.
    #[error("policy server sent a bad answer: {0}")]
    BadAnswer(#[from] RegistryError),
    /// An answer to another question than the one that was asked.
    #[error("policy server answers another question: {0}")]
    OtherQuestion(#[from] OtherQuestion),
    /// A fetch that broke the rules: too many bytes, or bytes of another file.
    #[error("fetched bytes are not those asked for: {reason}")]
    WrongBytes { reason: String },
    /// Bytes come, but too few.
    #[error("policy server sends less than {RATE_MIN} bytes per second; is the network that slow?")]
    TooSlow,
    /// The call took too long.
    #[error("policy server did not finish {what} in time; try again")]
    TimedOut { what: &'static str },
}

/// What to look at where nobody answers.
fn question(address: &str, reason: &str) -> &'static str {
    let says = |what: &[&str]| what.iter().any(|w| reason.contains(w));
    if says(&["certificate"]) {
        "is its certificate valid, for this address, and of the authority of the one here?"
    } else if !address.starts_with("https://") && says(&["roken pipe", "invalid size"]) {
        "is it running, and does it want https://?"
    } else {
        "is it running?"
    }
}

impl ClientError {
    /// True where the same call may succeed later.
    pub fn is_transient(&self) -> bool {
        match self {
            Self::Unreachable { .. } | Self::TimedOut { .. } => true,
            Self::Refused { code, .. } => matches!(
                code,
                Code::Unavailable
                    | Code::DeadlineExceeded
                    | Code::Aborted
                    | Code::Cancelled
                    | Code::Unknown
            ),
            _ => false,
        }
    }

    /// True where somebody else changed the same thing first: look again and decide anew.
    pub fn is_lost_race(&self) -> bool {
        matches!(self, Self::Refused { code: Code::Aborted, .. })
    }

    /// True where the server will not have this policy, or not there: it was quarantined, has another contract.
    pub fn is_of_the_policy(&self) -> bool {
        matches!(self, Self::Refused { code: Code::FailedPrecondition, .. })
    }

    /// True where the server does not hold what was asked for.
    pub fn is_not_found(&self) -> bool {
        matches!(self, Self::Refused { code: Code::NotFound, .. })
    }
}

/// A status without a message from the far side is the network's own.
pub(crate) fn refusal(address: &str, status: &Status) -> ClientError {
    use std::error::Error;
    let from_network = status.source().is_some();
    // A connection that broke under a call is `Unknown`, or `Internal` where HTTP/2 noticed first.
    let broken = [Code::Unavailable, Code::Unknown, Code::Internal, Code::Cancelled];
    if broken.contains(&status.code()) && from_network {
        return ClientError::Unreachable { address: address.to_owned(), reason: innermost(status) };
    }
    ClientError::Refused { code: status.code(), message: status.message().to_owned() }
}

fn innermost(error: &dyn std::error::Error) -> String {
    let mut last = error;
    while let Some(source) = last.source() {
        last = source;
    }
    last.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_does_not_answer_is_asked_about_what_it_said() {
        let asks = |address: &str, reason: &str| question(address, reason);
        assert_eq!(asks("127.0.0.1:7401", "connection refused"), "is it running?");
        assert!(asks("127.0.0.1:7401", "frame with invalid size").contains("https://"));
        let other = asks("https://lab:7401", "invalid peer certificate: UnknownIssuer");
        assert!(other.contains("authority"), "{other}");
    }
}
