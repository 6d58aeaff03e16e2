//! Links over zenoh: actors anywhere that reaches the learner, or a common router, by TCP on one host, by
//! QUIC between hosts.
//!
//! Keys, with the run id and the link's number in hexadecimal:
//! - `caudata/<run>/up/<link>`: messages of an actor, the head as attachment, the frame as payload.
//! - `caudata/<run>/down/<link>`: the learner's answers to it.
//! - `caudata/<run>/policy`: a queryable; actors pull the newest policy piece by piece.
//!
//! zenoh's own delivery is not relied on: a put without a route or over a broken connection vanishes, and the
//! protocol in [`reliable`](crate::reliable) notices. Nothing here blocks a zenoh thread: a learner that does
//! not read lets no grants go out, and so nothing comes in.

mod access;
mod actor;
mod keys;
mod learner;
mod reconnect;
mod session;

pub(crate) use actor::actor;
pub(crate) use learner::learner;
