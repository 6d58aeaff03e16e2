//! A run on several hosts: `caudata up` (this host's part with the learner), `caudata actors` (another host's
//! actors), `caudata status`, `caudata pki`.

pub mod actors;
pub mod pki;
pub mod status;
pub mod up;
