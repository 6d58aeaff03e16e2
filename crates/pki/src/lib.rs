//! The certificates of a lab: one authority, one certificate per process, and the role of a process in its certificate.
//!
//! A certificate's common name is the [`Role`], its organisational unit the name of the process. Servers decide by the role what
//! the other side may do. Certificates are short-lived (there is no revocation): a leaked one is worth days.
//!
//! *Invariant:* a private key is written once, readable by its owner alone, and never printed.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used, clippy::panic))]

mod authority;
mod inspect;
mod role;

pub use authority::{Authority, Request, VALID_DAYS, VALID_DAYS_MAX};
pub use inspect::{Identity, identity_of_der, identity_of_pem};
pub use role::Role;

use std::path::PathBuf;

/// File with the certificate of the authority, in every folder of certificates. The names are those of Kubernetes'
/// TLS secrets, so that a folder can be mounted as it is.
pub const CA_FILE: &str = "ca.crt";
/// File with the certificate of a process.
pub const CERTIFICATE_FILE: &str = "tls.crt";
/// File with its private key.
pub const KEY_FILE: &str = "tls.key";

/// Why certificates cannot be made or read.
#[derive(Debug, thiserror::Error)]
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
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not the certificate or key that it should be.
    #[error("{}: {reason}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The certificate cannot be made.
    #[error("cannot make a certificate: {0}")]
    Make(String),
}

impl PkiError {
    fn file(path: &std::path::Path, source: std::io::Error) -> Self {
        Self::File {
            path: path.to_owned(),
            source,
        }
    }
}
