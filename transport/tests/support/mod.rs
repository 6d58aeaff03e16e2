//! What the conformance suite stands on: self-checking frames, a rig per transport, helper processes, and
//! a network that breaks.

pub mod frames;
pub mod policies;
pub mod process;
pub mod proxy;
pub mod rig;
