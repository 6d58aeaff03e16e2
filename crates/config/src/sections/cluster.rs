//! `[cluster]`: what a run on several hosts needs besides the rest.

use std::path::PathBuf;

use caudata_declare::settings;
use serde::{Deserialize, Serialize};

settings! {
    /// `[cluster]`. None of it decides how training goes; `caudata train` uses `hang_timeout_s`.
    #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    pub struct ClusterConfig {
        /// Identifier of the run, the same for learner and actors: 1 to 64 letters, digits, `-`, `_` and `.`;
        /// empty takes `run.name`. Two runs with the same one on one router would take each other's learner
        /// for their own.
        pub run_id: String,
        /// Folder of the run on the learner's host; empty takes `<run.out_dir>/<run_id>`. `caudata up` goes
        /// on with a run that it finds there.
        pub run_dir: PathBuf,
        /// Folder with this process's `ca.crt`, `tls.crt` and `tls.key` (`caudata pki`). `{role}` in it is
        /// `learner`, `actor` or `server` (the policy server), so that each that `caudata up` starts has its
        /// own: `pki/{role}`. Empty: nothing but loopback can be used.
        pub tls_dir: PathBuf,
        /// Policy server for tools and robots, `https://host:port`; plain `host:port` on this host only.
        /// Empty: none.
        pub policy_server: String,
        /// Seconds without a sign of life after which an actor is killed and started again. 1 to 3,600. Too
        /// short: a busy host looks like a hung actor; too long: batches wait for it
        /// (`learner.batch_timeout_s`).
        pub hang_timeout_s: f64 = 30.0,
    }
}

impl ClusterConfig {
    /// The folder of certificates of a role, `learner`, `actor` or `server`, if there is one.
    pub fn certificates(&self, role: &str) -> Option<PathBuf> {
        let folder = self.tls_dir.to_str()?.replace("{role}", role);
        (!folder.is_empty()).then(|| folder.into())
    }
}
