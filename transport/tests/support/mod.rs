//! What the conformance suite stands on: self-checking frames, a rig per transport, and helper processes.

pub mod frames;
pub mod process;
pub mod rig;
