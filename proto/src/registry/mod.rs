//! The policy registry's messages as checked values.
//!
//! The gRPC service and client are generated ([`crate::wire::registry`]); a server turns each
//! request into a type of this module before it looks at it, a client does so with each answer.

mod convert;
mod error;
mod field;
mod messages;
mod names;
pub mod question;
#[cfg(test)]
mod tests;

pub use error::*;
pub use messages::*;
pub use names::{LabelName, StreamName};
