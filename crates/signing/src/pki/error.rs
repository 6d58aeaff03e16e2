//! Why certificates cannot be made or read, and what their files are called.

use std::path::PathBuf;

/// How long a certificate is valid by default, days. There is no revocation, so a stolen one is worth that
/// long; too short, and a long training must be restarted with new ones.
pub const VALID_DAYS: u32 = 7;
/// The longest validity, days.
pub const VALID_DAYS_MAX: u32 = 397;
/// File with the certificate of the authority, in every folder of certificates. The names are those of
/// Kubernetes' TLS secrets, so that a folder can be mounted as it is.
pub const CA_FILE: &str = "ca.crt";
/// File with the certificate of a process.
pub const CERTIFICATE_FILE: &str = "tls.crt";
/// File with its private key.
pub const KEY_FILE: &str = "tls.key";

/// Why certificates cannot be made or read.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum PkiError {
    /// A word that is no role.
    #[error("`{0}` is no role; roles are learner, actor, server, router, operator and robot")]
    Role(String),
    /// The name of a process or a host has letters that a certificate or a folder cannot have.
    #[error("`{0}` cannot be a name here: use 1 to 64 of a-z A-Z 0-9 - _ .")]
    Name(String),
    /// A validity that is none.
    #[error("{0} days is not a validity of 1 to {VALID_DAYS_MAX} days")]
    Days(u32),
    /// Something is there already.
    #[error("{} exists; nothing was changed", .0.display())]
    Exists(PathBuf),
    /// A file cannot be read or written.
    #[error("{}: {source}", path.display())]
    File { path: PathBuf, source: std::io::Error },
    /// A file is not the certificate or key that it should be.
    #[error("{}: {reason}", path.display())]
    Content { path: PathBuf, reason: String },
    /// The certificate cannot be made.
    #[error("cannot make a certificate: {0}")]
    Make(String),
}

impl PkiError {
    pub(super) fn file(path: &std::path::Path, source: std::io::Error) -> Self {
        Self::File { path: path.to_owned(), source }
    }
}
