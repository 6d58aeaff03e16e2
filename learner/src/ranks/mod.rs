//! Several processes that learn together: rank 0 is the learner with everything that a run has, and the other ranks work on shards for it.
//!
//! Rank 0 alone talks to the actors, shuffles, scales, steps, counts and saves. For every update it hands the whole batch to the other ranks, and for
//! each minibatch the parameters; each rank works on its own shards, a run of them in a row. The gradient then goes from rank to rank, and each
//! adds its shards to it in their order: **the sum is the one that a single process forms, bit for bit**, and nothing needs to be shared by
//! statistics, since mean and variance of the advantages, the KL divergence and the norm of the gradient are taken from the whole at rank 0.
//! A rank keeps nothing between two updates: it needs no checkpoint, and a run may go on with another number of ranks.
//!
//! *Invariant: every wait here ends, by an answer, by a closed connection or by its time limit.*

mod link;
mod rank;
mod root;
mod wire;

use std::net::{SocketAddr, ToSocketAddrs};
use std::path::PathBuf;
use std::time::Duration;

use caudata_config::Config;
use caudata_telemetry::StopFlag;

pub use rank::serve;
pub use root::Ranks;

use crate::LearnerError;

/// What the ranks of a run must agree on, and how they find each other.
#[derive(Clone, Debug)]
pub struct RankSettings {
    /// Processes, rank 0 included.
    pub count: u32,
    /// `host:port` at which rank 0 listens.
    pub address: String,
    /// How long ranks are waited for at the start, and rank 0 after it was lost.
    pub join_timeout: Duration,
    /// How long an answer may take.
    pub answer_timeout: Duration,
    /// How long rank 0 may have nothing to do for others: it waits for rollouts.
    pub idle_timeout: Duration,
    /// Certificates, needed where the address is not this host's own.
    pub tls_dir: Option<PathBuf>,
    /// Who they are.
    pub identity: RankIdentity,
    /// Whether the address is this host's own by its very words, whatever names lead to.
    here: bool,
}

/// What the ranks of a run must have in common.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RankIdentity {
    /// Of the run.
    pub run_id: String,
    /// Of what decides how training goes.
    pub config_hash: String,
    /// Of observations, actions and robot.
    pub contract_hash: String,
}

impl RankSettings {
    /// What `config` says.
    pub fn new(config: &Config, run_id: &str, contract_hash: String) -> Self {
        let cluster = &config.cluster;
        let answer_timeout = Duration::from_secs_f64(cluster.rank_timeout_s);
        Self {
            count: cluster.learner_ranks,
            address: cluster.rank_address.clone(),
            join_timeout: Duration::from_secs_f64(cluster.rank_join_timeout_s),
            answer_timeout,
            idle_timeout: Duration::from_secs_f64(config.learner.starve_timeout_s) + answer_timeout,
            tls_dir: cluster.certificates().map(std::path::Path::to_owned),
            identity: RankIdentity {
                run_id: run_id.to_owned(),
                config_hash: config.hash_hex(),
                contract_hash,
            },
            here: cluster.ranks_are_here(),
        }
    }

    /// The addresses behind [`address`](Self::address), and the certificates to use: none where it is written as this host's own. A name that
    /// only leads to loopback, as a host's own does on some, is that of a network.
    fn resolve(&self) -> Result<(Vec<SocketAddr>, Option<&PathBuf>), LearnerError> {
        let address = &self.address;
        let found = address
            .to_socket_addrs()
            .map_err(|error| LearnerError::RankAddress {
                address: address.clone(),
                source: error,
            })?;
        let found: Vec<SocketAddr> = found.collect();
        // Plain bytes stay here even where `localhost` leads elsewhere.
        if self.here && found.iter().all(|addr| addr.ip().is_loopback()) {
            return Ok((found, None));
        }
        match &self.tls_dir {
            Some(folder) => Ok((found, Some(folder))),
            None => Err(LearnerError::setting(format!(
                "cluster.rank_address {address} is reached over a network, which needs certificates: set cluster.tls_dir (`caudata pki`), or take an address of 127.0.0.1"
            ))),
        }
    }

    /// The name in the certificate of rank 0.
    fn host(&self) -> &str {
        let host = self.address.rsplit_once(':').map_or("", |(host, _)| host);
        host.trim_start_matches('[').trim_end_matches(']')
    }
}

/// Gives up a wait once `stop` is raised.
fn unless_asked(stop: &StopFlag) -> Result<(), String> {
    match stop.is_set() {
        true => Err("this one was asked to stop".to_owned()),
        false => Ok(()),
    }
}

/// The shards of `count` that `rank` of `ranks` works on: a run of them in a row, behind those of the ranks before it.
fn share(rank: u32, ranks: u32, count: usize) -> std::ops::Range<usize> {
    let at = |rank: u32| rank as usize * count / ranks.max(1) as usize;
    at(rank)..at(rank + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_shard_has_one_rank_and_they_follow_each_other() {
        for ranks in 1..6 {
            for count in 0..20 {
                let all: Vec<usize> = (0..ranks)
                    .flat_map(|rank| share(rank, ranks, count))
                    .collect();
                assert_eq!(all, (0..count).collect::<Vec<_>>(), "{ranks} ranks");
            }
        }
        assert_eq!((share(0, 2, 4), share(1, 2, 4)), (0..2, 2..4));
    }

    #[test]
    fn a_plain_connection_is_for_this_host_only() {
        let settings = |address: &str, tls_dir: &str| {
            let mut config = Config::default();
            config.cluster.rank_address = address.into();
            config.cluster.tls_dir = tls_dir.into();
            RankSettings::new(&config, "run", String::new())
        };
        for here in ["127.0.0.1:7450", "127.0.1.1:7450", "[::1]:7450"] {
            for tls_dir in ["", "certificates"] {
                let settings = settings(here, tls_dir);
                assert!(settings.resolve().unwrap().1.is_none(), "{here}");
            }
        }
        // The second leads to 127.0.0.1, as a name may.
        for elsewhere in ["192.0.2.1:7450", "127.1:7450"] {
            let error = settings(elsewhere, "").resolve().unwrap_err();
            assert_eq!(error.exit_code(), caudata_telemetry::ExitCode::BadConfig);
            assert!(error.to_string().contains("cluster.tls_dir"), "{error}");
            let secured = settings(elsewhere, "certificates");
            assert!(secured.resolve().unwrap().1.is_some(), "{elsewhere}");
        }
        assert_eq!(settings("192.0.2.1:7450", "").host(), "192.0.2.1");
        assert_eq!(settings("[::1]:7450", "").host(), "::1");
    }
}
