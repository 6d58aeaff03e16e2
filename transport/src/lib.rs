//! Rollouts and policy versions between actors and learner over one trait: in-process, iceoryx2, zenoh.
//!
//! Frames are opaque bytes: what is inside is the business of `caudata-proto`. Rollout frames go
//! many-to-one from [`ActorLink`]s to the [`LearnerLink`], in order per actor link, each delivered
//! once while both sides live. Policies go one-to-many, latest only: an actor sees the newest one,
//! never an older one after it, and a late actor gets the newest at once.
//!
//! Nothing is dropped silently. When the learner falls behind, [`ActorLink::send`] returns
//! [`SendError::Full`] at its deadline and the frame has *not* been taken: the caller tries again.
//! `docs/reference/transport.md` has the protocol, the limits and the fault table.

mod actor_core;
mod config;
mod crew;
mod error;
mod iceoryx2_link;
mod identity;
mod inproc;
mod learner_core;
mod link;
mod policy_cell;
mod reliable;
mod zenoh_link;

pub use config::{Iceoryx2Config, InprocConfig, Limits, TlsFiles, TransportConfig, ZenohConfig};
pub use error::{SendError, TransportError};
pub use inproc::InprocHub;
pub use link::{
    ActorLink, Control, Frame, LearnerLink, LinkStats, PolicyUpdate, Value, actor_link, clean_up,
    learner_link,
};
