//! `[cluster]`: what a run on several hosts needs besides the rest.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// `[cluster]`. None of it decides how training goes; `caudata train` uses `hang_timeout_s` and what is about ranks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClusterConfig {
    /// Identifier of the run, the same for learner and actors: 1 to 64 letters, digits, `-`, `_` and `.`; empty takes `run.name`. Two runs
    /// with the same one on one router would take each other's learner for their own.
    pub run_id: String,
    /// Folder of the run on the learner's host; empty takes `<run.out_dir>/<run_id>`. `caudata up` goes on with a run that it finds there.
    pub run_dir: PathBuf,
    /// Folder with this process's `ca.crt`, `tls.crt` and `tls.key` (`caudata pki`). Empty: nothing but loopback can be used.
    pub tls_dir: PathBuf,
    /// Policy server for tools and robots, `https://host:port`; plain `host:port` on this host only. Empty: none.
    pub policy_server: String,
    /// Seconds without a sign of life after which an actor is killed and started again. 1 to 3,600. Too short: a busy host looks like
    /// a hung actor; too long: batches wait for it (`learner.batch_timeout_s`).
    pub hang_timeout_s: f64,
    /// Processes that learn together: the learner, and ranks 1, 2, … that work on shards of its batches. 1 to 64, default 1. On CPUs the weights are
    /// the same bits for any number. `caudata up` and `train` start them on this host; where `rank_address` is that of a network, start
    /// `caudata-learner --rank R` elsewhere. More than a minibatch has shards of 512 samples have nothing to do.
    pub learner_ranks: u32,
    /// Where the learner listens for the other ranks, `host:port` (TCP). Default `127.0.0.1:7450`. Beyond loopback both sides need certificates of
    /// the role `learner` (`tls_dir`), the learner's for this host name. Unused with one rank.
    pub rank_address: String,
    /// Seconds that the learner waits for the other ranks at its start, and they for a learner that was lost. Above 0, to 86,400, default 60. Too
    /// short: hosts that start slowly are missed; too long: a rank that never comes is noticed late. Exit code 85.
    pub rank_join_timeout_s: f64,
    /// Seconds that one answer of a rank may take. Above 0, to 3,600, default 60. Too short: a busy host ends the run; too long: a hung rank holds it
    /// up. Exit code 85.
    pub rank_timeout_s: f64,
}

impl Default for ClusterConfig {
    fn default() -> Self {
        Self {
            run_id: String::new(),
            run_dir: PathBuf::new(),
            tls_dir: PathBuf::new(),
            policy_server: String::new(),
            hang_timeout_s: 30.0,
            learner_ranks: 1,
            rank_address: "127.0.0.1:7450".to_owned(),
            rank_join_timeout_s: 60.0,
            rank_timeout_s: 60.0,
        }
    }
}

impl ClusterConfig {
    /// Whether the other ranks of the learner run on its own host, so that whoever starts it starts them, too.
    pub fn ranks_are_here(&self) -> bool {
        let Some((host, _)) = self.rank_address.rsplit_once(':') else {
            return false;
        };
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let ip = host.parse::<std::net::IpAddr>();
        host == "localhost" || ip.is_ok_and(|ip| ip.is_loopback())
    }

    /// The folder of certificates, if there is one.
    pub fn certificates(&self) -> Option<&std::path::Path> {
        Some(self.tls_dir.as_path()).filter(|folder| !folder.as_os_str().is_empty())
    }
}
