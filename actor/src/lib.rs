//! Steps environments, runs the ONNX policy and streams rollouts.
//!
//! [`run`] is one actor: it waits for a policy, checks it, collects chunks of `steps × lanes` with it, and
//! hands them to the learner over an [`ActorLink`](caudata_transport::ActorLink). The binary `caudata-actor`
//! runs one per process; the learner's in-process mode runs several as threads.
//!
//! With `max_lead = 0` the chunks of an actor depend on nothing but the configuration, the seed and the
//! policies' bytes: not on clocks, thread counts, or the transport.
//!
//! *Invariant:* libtorch is not linked.

mod chunk;
mod error;
pub mod gaussian;
mod identity;
mod ledger;
mod link;
mod metrics;
pub mod moments;
mod network;
mod policy;
mod pulse;
pub mod quota;
mod retune;
mod run;
mod settings;
mod snapshot;
mod trace;

/// The file in the run folder that the learner locks: nobody else writes there then.
pub const LEARNER_LOCK: &str = "learner.lock";

pub use error::ActorError;
pub use identity::{clock_incarnation, host_name, named_actor_id};
pub use ledger::{Ledger, LedgerCount, ledger_path, ledgers_in, read_ledger};
pub use link::{
    decode_transport, encode_transport, transport_config, transport_of, with_certificates,
};
pub use metrics::ActorMetrics;
pub use network::Network;
pub use pulse::{ALIVE, JOINED, PulsedLink, say_alive};
pub use retune::Retunes;
pub use run::{ActorReport, run};
pub use settings::{ActorSettings, actor_key, build_env, tracer_of};
pub use snapshot::{ActorSnapshot, SnapshotPort};
