//! A policy that an actor acts with: exactly the bytes that arrived, checked before use.

use caudata_policy::PolicyFile;
use caudata_task::{Mirror, PolicyContract};
use caudata_transport::PolicyUpdate;
use sha2::{Digest, Sha256};

use crate::gaussian::Density;
use crate::{ActorError, Network};

/// A checked policy, ready to run.
pub(crate) struct LoadedPolicy {
    /// Version announced with it and written in it.
    pub version: u64,
    /// Environment steps that training had seen when it was made.
    pub env_steps: u64,
    /// SHA-256 of its bytes.
    pub sha256: [u8; 32],
    /// Natural logarithm of the action noise's standard deviation.
    pub log_std: Vec<f32>,
    /// `exp(log_std)`.
    pub std: Vec<f32>,
    /// Density of the actions around their means.
    pub density: Density,
    network: Network,
}

impl LoadedPolicy {
    /// Checks hash, file, contract and version, then takes up the weights, in the room of the policy `before`.
    /// `mirror`: of the robot, if it has one.
    pub fn load(
        update: &PolicyUpdate,
        expected: &PolicyContract,
        mirror: Option<&Mirror>,
        before: Option<Self>,
    ) -> Result<Self, ActorError> {
        let version = update.version;
        let refused = |source| ActorError::PolicyRefused { version, source };
        let sha256: [u8; 32] = Sha256::digest(&update.bytes).into();
        if sha256 != update.sha256 {
            return Err(ActorError::PolicyHash { version });
        }
        let file = PolicyFile::parse(update.bytes.clone()).map_err(refused)?;
        file.check_contract(expected).map_err(refused)?;
        let metadata = file.metadata();
        if metadata.version != version {
            return Err(ActorError::PolicyVersion { announced: version, found: metadata.version });
        }
        let log_std = metadata.log_std.clone();
        let std = log_std.iter().map(|x| x.exp()).collect();
        let network = match before {
            None => Network::new(file.spec(), mirror),
            Some(Self { mut network, .. }) => {
                network.replace(file.spec(), mirror);
                network
            }
        };
        let env_steps = metadata.env_steps;
        Ok(Self {
            version,
            env_steps,
            sha256,
            density: Density::new(&log_std),
            log_std,
            std,
            network,
        })
    }

    /// `means [N, A]` for `observations [N, D]`, refused when one is not finite.
    pub fn run(
        &mut self,
        observations: &[f32],
        lanes: usize,
        means: &mut [f32],
    ) -> Result<(), ActorError> {
        self.network.run(observations, lanes, means);
        match means.iter().position(|mean| !mean.is_finite()) {
            None => Ok(()),
            Some(at) => Err(ActorError::NotFinite {
                version: self.version,
                lane: at / self.std.len().max(1),
            }),
        }
    }
}
