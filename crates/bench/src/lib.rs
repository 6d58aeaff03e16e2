//! How fast the parts are on this machine, and how near the truth the engines are.
//!
//! Each benchmark is a `Plan` (the flags of its command) and what it found (what `--json` prints). All
//! measure alike: after a warm-up, in rounds, side by side with what they are compared with ([`measure`]).
//! [`verify`] holds the engines against MuJoCo, closed forms and conservation laws.

pub mod calibrate;
pub mod explain;
pub mod gap;
pub mod measure;
pub mod parts;
pub mod session;
pub mod sim;
pub mod skill;
pub mod train;
pub mod transport;
pub mod verify;
