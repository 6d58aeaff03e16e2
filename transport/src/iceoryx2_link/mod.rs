//! Links over iceoryx2: actors are processes on the learner's host, frames lie in shared memory.
//!
//! A learner process makes a fresh set of services in a directory of its own, named by its epoch, and posts
//! the epoch in the run's directory; actors find it there. Nothing of a killed learner is ever opened again.
//! - `data`: publish-subscribe, actors to learner, safe overflow off, nothing kept for late joiners.
//! - `status`: publish-subscribe, learner to actors, the table of all answers; only the newest counts.
//! - `policy`: publish-subscribe, learner to actors, history 1 and overflow on: only the newest counts, and
//!   late joiners get it.
//! - `up`, `down`: events that wake the other side. A lost one costs at most 50 ms.

mod actor;
mod learner;
mod run_dir;
mod services;

pub(crate) use actor::actor;
pub(crate) use learner::learner;
pub(crate) use run_dir::clean_up;
