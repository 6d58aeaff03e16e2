//! The delivery protocol that iceoryx2 and zenoh links share: pure state machines, no threads, no sockets.
//!
//! Underneath is something that carries whole messages in order but may lose some when a connection breaks.
//! On top is the promise of [`ActorLink::send`](crate::ActorLink::send): a frame that was taken arrives
//! once and in order, unless a side dies, and one that was not taken does not arrive.
//!
//! Frames of a link are numbered 1, 2, 3 … The learner grants numbers: it keeps room for
//! `window_frames` unread frames per link, and the actor takes a frame only when its number is granted,
//! so a taken frame always has a place. The learner's [`Status`] says how far it has received and granted.
//! The actor keeps what is not acknowledged. Once per heartbeat it sends a probe; when the answer to a probe
//! shows that something sent before it is missing, that is sent again. A learner that restarts has a new
//! epoch, and everything unacknowledged goes to it again.

mod inbox;
mod message;
mod outbox;
#[cfg(test)]
mod simulation;

pub(crate) use inbox::Inbox;
pub(crate) use message::{PolicyHead, Status, UpHead};
pub(crate) use outbox::{Outbox, PolicyId, Step};
