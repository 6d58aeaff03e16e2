//! The sections of the configuration that belong to no other crate. Each field says its unit, its range, and
//! what happens when it is too small or too large.

mod actors;
mod cluster;
mod learner;
mod run;
mod services;

pub use actors::ActorsConfig;
pub use cluster::ClusterConfig;
pub use learner::{
    Activation, AdvantageScale, Correction, Device, LearnerConfig, NetworkConfig, PpoConfig,
    Returns, StalenessConfig, TeacherConfig, WarmStartConfig,
};
pub use run::{EvaluationConfig, GatesConfig, RunConfig};
pub use services::{
    LogStyle, PolicyServerConfig, TelemetryConfig, TransportKind, TransportSection,
};
