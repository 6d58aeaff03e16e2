//! The certificates of a lab: one authority, one certificate per process, and the role of a process in its
//! certificate.
//!
//! A certificate's common name is the [`Role`], its organisational unit the name of the process. Servers
//! decide by the role what the other side may do. Certificates are short-lived (there is no revocation): a
//! leaked one is worth days.
//!
//! *Invariant:* a private key is written once, readable by its owner alone, and never printed.

mod authority;
mod error;
mod inspect;
mod listen;
mod role;

pub use authority::{Authority, Request};
pub use error::{CA_FILE, CERTIFICATE_FILE, KEY_FILE, PkiError, VALID_DAYS, VALID_DAYS_MAX};
pub use inspect::{Identity, hosts_of_pem, identity_of_der, identity_of_pem};
pub use listen::{Callers, listen_as, listen_unknown};
pub use role::Role;
