//! The cases: generic ones for every transport and for links between processes, and those of one transport.

pub mod certificates;
pub mod configuration;
pub mod every;
pub mod floods;
pub mod iceoryx2;
pub mod processes;
pub mod zenoh;
