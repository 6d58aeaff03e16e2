//! What to measure of links.

use std::path::PathBuf;
use std::time::Duration;

use caudata_config::ConfigArgs;
use caudata_declare::named;
use caudata_telemetry::Failure;
use clap::{Args, ValueEnum};

use crate::parts::Time;

/// Longest single wait on a link.
pub const WAIT: Duration = Duration::from_millis(100);
/// What is not measured at the start of each phase.
pub const WARM_UP_S: f64 = 0.5;
/// Longest wait for the other ends to come or to leave.
pub const LEAVE_MAX: Duration = Duration::from_secs(10);

/// What to measure.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    #[command(flatten)]
    pub(super) time: Time,
    /// Links to measure; default: all. May be given several times
    #[arg(long, value_enum)]
    pub(super) kind: Vec<Kind>,
    /// Size of a frame, bytes
    #[arg(long, default_value_t = 256 << 10, value_parser = clap::value_parser!(u32).range(64..=1 << 28))]
    pub(super) frame_bytes: u32,
    /// Actors that send
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub(super) actors: u32,
    /// Leave out what collecting rollouts costs
    #[arg(long)]
    pub(super) no_rollouts: bool,
    /// Only what collecting rollouts costs
    #[arg(long, conflicts_with = "no_rollouts")]
    pub(super) rollouts_only: bool,
    /// How often that is measured over each link, in turns with the bare simulator and policy; medians are
    /// printed
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) rounds: u32,
    /// Robot, task and network of the rollouts; the preset `quick` without these flags
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

/// Where the program of an actor is; asked only where one is needed.
pub type FindActor<'a> = &'a dyn Fn() -> Result<PathBuf, Failure>;

named! {
    /// Links that can be measured.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
    pub enum Kind {
        /// Between threads
        Inproc = "inproc",
        /// Shared memory
        Iceoryx2 = "iceoryx2",
        /// zenoh over plain TCP on this machine
        Zenoh = "zenoh",
        /// zenoh over QUIC with certificates on both sides
        Quic = "quic",
    }
}
