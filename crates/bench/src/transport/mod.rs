//! Rate, latency and CPU of every link, beside memcpy and a bare TCP socket in the same run; and what
//! collecting rollouts costs over each link, beside the bare simulator and policy.

pub mod ingest;
mod link;
mod peer;
mod plan;
mod rollouts;
mod stage;

use caudata_telemetry::Failure;
use clap::ValueEnum;
use serde::Serialize;

pub use link::Speed;
pub use peer::serve_if_peer;
pub use plan::{FindActor, Kind, Plan};
pub use rollouts::Rollouts;

/// Links, and rollouts over them.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// `transport`.
    pub benchmark: &'static str,
    /// Size of a frame.
    pub frame_bytes: u32,
    /// Actors that sent.
    pub actors: u32,
    /// How long each was measured.
    pub seconds: f64,
    /// Each link, a bare socket, and memcpy.
    pub links: Vec<Speed>,
    /// Simulator and policy alone, and over each link.
    pub rollouts: Vec<Rollouts>,
}

/// Measures what the plan says.
///
/// # Errors
/// Where a link cannot be made, or its other end fails.
pub fn run(plan: &Plan, actor: FindActor<'_>) -> Result<Finding, Failure> {
    let kinds = match plan.kind.as_slice() {
        [] => Kind::value_variants(),
        some => some,
    };
    let mut finding = Finding {
        benchmark: "transport",
        frame_bytes: plan.frame_bytes,
        actors: plan.actors,
        seconds: plan.time.seconds,
        links: Vec::new(),
        rollouts: Vec::new(),
    };
    if !plan.rollouts_only {
        finding.links = link::all(kinds, plan)?;
    }
    if !plan.no_rollouts {
        finding.rollouts = rollouts::all(kinds, plan, actor)?;
    }
    Ok(finding)
}
