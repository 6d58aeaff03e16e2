//! Who may say what: signatures over policy manifests, and the certificates of a lab ([`pki`]).
//!
//! A robot that trusts keys takes policies by who signed them, not by where they came from: a stolen server
//! or a stolen TLS key cannot make it walk differently.
//!
//! Ed25519 over one exact sequence of bytes ([`signed_bytes`]) that holds every field of the manifest but the
//! signatures. The SHA-256 of the policy file is one of them, and the file holds its contract, so one
//! signature binds all of it.
//!
//! *Invariant:* whatever a manifest or a file says, checking never panics, and a key counts once.

mod error;
mod key;
pub mod pki;
mod rotation;
mod trust;

pub use error::{SigningError, check_private};
pub use key::{ReleaseKey, TRUST_FORMAT, freshness_bytes, random_bytes, signed_bytes};
pub use rotation::{NoSuccessor, TrustSignature, add_signature, read_signatures, successor_path};
pub use trust::{Stale, Trust, Untrusted};
