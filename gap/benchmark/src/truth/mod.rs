//! The truth: an independent simulator of robots on a stand, in double precision, with effects that the
//! diagnosing simulator does not know or knows in simpler form.
//!
//! Nothing of `sim/` is used: other equations ([`tree`]), another integrator and step ([`sim`]), another
//! motor, friction and gear ([`drive`]), a sampled firmware loop that sees a counted encoder.

pub mod drive;
pub mod free;
pub mod linear;
pub mod sensors;
pub mod sim;
pub mod spec;
pub mod tree;

pub use sim::{Commands, Dense, Sim, Touch};
pub use spec::{JointSpec, Spec};
