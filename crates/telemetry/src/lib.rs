//! What every `caudata` process shares with its surroundings: logs, metrics, the banner, exit codes,
//! stop signals and the progress events between the learner and the command line.
//!
//! A binary's `main` then reads aloud:
//!
//! ```no_run
//! use caudata_telemetry::{Failure, LogArgs, Process, parse_args};
//! #[derive(clap::Parser)]
//! struct Args {
//!     #[command(flatten)]
//!     log: LogArgs,
//! }
//! fn main() -> std::process::ExitCode {
//!     let args: Args = parse_args(); // bad flag: exit code 64
//!     Process::run("caudata-example", &args.log, |process| -> Result<(), Failure> {
//!         process.stop.wait(std::time::Duration::from_secs(1)); // … work until asked to stop …
//!         Ok(())
//!     })
//! }
//! ```
//!
//! *Invariant:* nothing here knows robots, policies or rollouts.

mod advice;
mod announce;
mod banner;
mod clock;
mod error;
mod exit;
mod files;
mod http;
mod incoming;
mod logging;
mod metrics;
mod parent;
mod process;
pub mod progress;
mod pulse;
mod queue;
mod serve;
pub mod spans;
mod stop;
mod tensorboard;
mod thread;
pub mod traces;

pub use advice::{Advice, Advisor, IterationLoad};
pub use announce::{Listening, announce, read_announcement};
pub use banner::{BuildInfo, Code, build_info};
pub use clock::{now_ns, unix_ms};
pub use error::ServeError;
pub use exit::{ExitCode, Failure, FailureExt};
pub use files::raise_file_limit;
pub use http::{Connection, serve_http};
pub use incoming::{
    CONNECTIONS_MAX, ConnectionLimits, Incoming, PEER_CONNECTIONS_MAX, Peer, incoming,
};
pub use logging::{LogArgs, LogFormat};
pub use metrics::{
    Counter, Gauge, Histogram, IntGauge, Kind, LabelledCounter, Metrics, SecondsCounter,
};
pub use parent::PARENT_PID_VAR;
pub use process::{Process, parse_args};
pub use pulse::Pulse;
pub use serve::{HttpServer, MetricsServer};
pub use stop::{DRAIN_DEADLINE, INSIST_DEADLINE, Insistence, StopFlag};
pub use tensorboard::EventFile;
pub use thread::Joined;
