//! Where policies come from and where they are kept: the flags, and what they open.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_proto::registry::{LabelName, StreamName};
use caudata_registry_client::is_loopback;
use caudata_signing::{Trust, check_private, pki};
use caudata_telemetry::Metrics;

use crate::DeployError;
use crate::boundary::alone_in;
use crate::follower::Follow;
use crate::keeper::{Keeper, read_factory};
use crate::metrics::AgentMetrics;
use crate::probe::{CHILD_DEADLINE, ProbeProgram};
use crate::reporter::Reporter;
use crate::server;
use crate::store::{PolicyStore, check_without_trust};
use caudata_durable::shipped_flag;

/// Where policies come from and where they are kept.
#[derive(Clone, Debug, clap::Args)]
pub struct SourceArgs {
    /// Robot file
    #[arg(
        long,
        value_name = "FILE.robot.toml",
        default_value = "robots/polymander.robot.toml",
        value_parser = shipped_flag
    )]
    pub robot: PathBuf,
    /// Policy server
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7401")]
    pub policy_server: String,
    /// Stream to follow; training publishes under its run id
    #[arg(long, value_name = "NAME")]
    pub stream: String,
    /// Label of the stream to follow: `latest`, or one that people move (`caudata policy label`)
    #[arg(long, value_name = "LABEL", default_value = LabelName::LATEST)]
    pub label: LabelName,
    /// Certificates for an https:// address: folder with ca.crt, tls.crt and tls.key
    #[arg(long, value_name = "DIR", env = "CAUDATA_TLS_DIR")]
    pub tls_dir: Option<PathBuf>,
    /// Name under which this robot reports to the policy server. That of its certificate when absent; without one
    /// the host's
    #[arg(long, value_name = "NAME")]
    pub name: Option<String>,
    /// Folder in which this robot keeps its policies
    #[arg(long, value_name = "DIR")]
    pub state: PathBuf,
    /// Take only policies that keys of this file signed (`caudata policy release`). Needed, like https, where
    /// the policy server is on another computer
    #[arg(long, value_name = "FILE.toml")]
    pub trust: Option<PathBuf>,
    /// Take policies of another computer without encryption or signatures: whoever is on the network can then
    /// move this robot
    #[arg(long)]
    pub insecure_accept_unsigned_plaintext: bool,
}

impl SourceArgs {
    /// Refuses a policy server on another computer that is not both encrypted and answerable to keys of this
    /// robot, and a secret that others may read.
    ///
    /// # Errors
    /// [`DeployError::Insecure`], [`DeployError::Key`].
    pub fn check(&self) -> Result<(), DeployError> {
        let address = &self.policy_server;
        let encrypted = address.starts_with("https://");
        if let Some(folder) = self.tls_dir.as_ref().filter(|_| encrypted) {
            check_private(&folder.join("tls.key"))?;
        }
        let missing = match (encrypted, &self.trust) {
            (true, Some(_)) => return Ok(()),
            (false, _) => "the connection is not encrypted",
            (true, None) => "no trust file says whose policies to take",
        };
        if is_loopback(address) || self.insecure_accept_unsigned_plaintext {
            return Ok(());
        }
        Err(DeployError::Insecure { address: address.clone(), missing })
    }
}

/// What every command that gets policies begins with.
pub(super) struct Source {
    pub(super) model: Arc<RobotModel>,
    pub(super) follow: Follow,
    pub(super) keeper: Keeper,
    /// No second agent or `pull` on one state: each would write over what the other learnt.
    _alone: caudata_durable::Owner,
}

impl Source {
    /// `factory`: the policy that came with the program.
    pub(super) fn open(
        args: &SourceArgs,
        factory: Option<&Path>,
        metrics: &Metrics,
    ) -> Result<(Self, AgentMetrics), DeployError> {
        args.check()?;
        let model = load_model(&args.robot)?;
        let stream = StreamName::new(&args.stream)
            .map_err(|source| DeployError::Stream { name: args.stream.clone(), source })?;
        let metrics = AgentMetrics::register(metrics);
        let trust = args.trust.as_deref().map(Trust::read).transpose();
        let trust = trust.map_err(DeployError::Trust)?;
        let provable = trust.as_ref().is_some_and(Trust::knows_fresh_keys);
        std::fs::create_dir_all(&args.state).map_err(DeployError::folder(&args.state))?;
        // Before anything in it is touched.
        let alone = alone_in(&args.state)?;
        let mut store = match PolicyStore::open(&args.state) {
            Err(error @ DeployError::StateDamaged { .. }) if provable || factory.is_some() => {
                tracing::error!(%error, "nothing is taken until a policy server proves what is newest");
                PolicyStore::open_torn(&args.state)?
            }
            other => other?,
        };
        match (&args.trust, &trust) {
            (Some(path), Some(trust)) => store.trust(path, trust.version())?,
            _ => check_without_trust(store.state(), &args.state)?,
        }
        let certified = || name_of(args.tls_dir.as_deref()?);
        let name = args.name.clone().or_else(certified).unwrap_or_else(host_name);
        let reporter = Reporter::start(&args.policy_server, args.tls_dir.as_deref(), name)?;
        let mut keeper = Keeper::new(store, model.clone(), metrics.clone());
        keeper.reporter = Some(reporter);
        keeper.trust = trust.map(Arc::new);
        // It is checked here, long before it is needed.
        let factory = factory.map(|file| read_factory(file, &model)).transpose()?;
        keeper.factory = factory.map(|verified| verified.policy);
        // Without a program of its own there is nobody to try candidates; the checks here stay.
        keeper.probe = std::env::current_exe().ok().map(|program| {
            let robot = args.robot.clone();
            Arc::new(ProbeProgram { program, robot, deadline: CHILD_DEADLINE })
        });
        let source = Self {
            keeper,
            model,
            _alone: alone,
            follow: Follow {
                address: args.policy_server.clone(),
                tls_dir: args.tls_dir.clone(),
                stream,
                label: args.label.clone(),
            },
        };
        Ok((source, metrics))
    }

    /// Pulls on a runtime of its own, which ends with the call.
    pub(super) fn pull(&self) -> Result<crate::verify::Verified, DeployError> {
        let follow = &self.follow;
        let (runtime, mut client) = server::connect(&follow.address, follow.tls_dir.as_deref())?;
        runtime.block_on(self.keeper.pull(&mut client, &follow.stream, &follow.label))
    }
}

/// The name in a robot's certificate. What is wrong with one is told where the connection is made.
fn name_of(tls_dir: &Path) -> Option<String> {
    pki::identity_of_pem(&tls_dir.join(pki::CERTIFICATE_FILE)).ok().map(|own| own.name)
}

/// The host's name, of what a robot's name may hold; `robot` where the system tells none.
fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let fits: String = name.trim().chars().filter(char::is_ascii_graphic).take(64).collect();
    if fits.is_empty() { "robot".to_owned() } else { fits }
}

pub(super) fn load_model(path: &Path) -> Result<Arc<RobotModel>, DeployError> {
    let model = RobotModel::load(path).map_err(|source| DeployError::Robot { source })?;
    // Refuses a robot that the task cannot drive, before anything is fetched.
    caudata_task::JointTable::from_model(&model)
        .map_err(|source| DeployError::Task { path: path.to_owned(), source })?;
    Ok(Arc::new(model))
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[test]
    fn fault_74_beyond_this_computer_no_policy_is_taken_in_the_open_or_unsigned() {
        let args = |address: &str, more: &[&str]| {
            let words = ["pull", "--stream", "s", "--state", "x", "--policy-server", address];
            #[derive(Parser)]
            struct Flags {
                #[command(flatten)]
                source: SourceArgs,
            }
            let words = words.iter().chain(more);
            Flags::try_parse_from(words).unwrap().source.check()
        };
        let trust = ["--trust", "trust.toml"];
        for local in ["127.0.0.1:7401", "localhost:1", "[::1]:7401", "http://127.3.2.1:9"] {
            assert!(args(local, &[]).is_ok(), "{local}");
        }
        for far in [
            "policies.lab:7401",
            "http://10.0.0.7:7401",
            "https://10.0.0.7:7401",
            "127.0.0.1.evil.org:7401",
            "localhost.evil.org:7401",
            "[fe80::1]:7401",
        ] {
            let error = args(far, &[]).unwrap_err();
            assert!(matches!(error, DeployError::Insecure { .. }), "{error}");
            assert!(args(far, &["--insecure-accept-unsigned-plaintext"]).is_ok());
            assert_eq!(args(far, &trust).is_ok(), far.starts_with("https://"), "{far}");
        }
    }
}
