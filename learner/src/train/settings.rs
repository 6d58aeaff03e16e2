//! What a run is told, and where its folder has what.

use std::io::Write;
use std::path::{Path, PathBuf};

use caudata_config::Config;
use caudata_telemetry::{Metrics, Pulse};
use caudata_transport::TransportConfig;

/// The account of all chunks, in the run folder.
pub(super) const ACCOUNT_FILE: &str = "accounting.json";

/// Whether a run starts anew or goes on.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Resume {
    /// From the start.
    #[default]
    No,
    /// From the newest checkpoint; from the start when there is none yet.
    Latest,
    /// From the checkpoint with this name, for instance `iter_000100`.
    Named(String),
}

/// What a run needs to know besides its configuration.
pub struct TrainSettings {
    /// The configuration.
    pub config: Config,
    /// The run folder.
    pub run_dir: PathBuf,
    /// Identifier of the run.
    pub run_id: String,
    /// Whether to go on from a checkpoint.
    pub resume: Resume,
    /// `host:port` of the policy server, if policies are to go there.
    pub policy_server: Option<String>,
    /// Instead of what the configuration says.
    pub transport: Option<TransportConfig>,
    /// Where metrics are registered.
    pub metrics: Metrics,
    /// Bound address of `/metrics`, for the first event.
    pub metrics_addr: Option<String>,
    /// Where progress events go, one JSON object per line.
    pub events: Box<dyn Write + Send>,
    /// Beats while the run makes progress, or waits for what it needs.
    pub pulse: Pulse,
}

/// Where the actors of a run keep their ledgers.
pub(super) fn ledger_folder(run_dir: &Path) -> PathBuf {
    run_dir.join("ledgers")
}

/// What is said of a ledger that cannot be read. What its actor lost is then not known; all that arrived is.
pub(super) fn torn_ledger((actor, incarnation): (u32, u64)) -> String {
    format!(
        "the ledger of actor {actor}, incarnation {incarnation} is torn: how much it sent is not known"
    )
}
