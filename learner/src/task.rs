//! The robot of a configuration, what is learnt on it, and the networks for that.

use caudata_config::Config;
use caudata_model::RobotModel;
use caudata_task::mirror::SignedPermutation;
use caudata_task::{Critic, Mirror, PolicyContract};

use crate::LearnerError;
use crate::network::NetworkSpec;

pub(crate) struct Task {
    pub model: RobotModel,
    pub contract: PolicyContract,
    pub critic: Critic,
    pub networks: NetworkSpec,
}

impl Task {
    pub fn new(config: &Config) -> Result<Self, LearnerError> {
        let path = config.robot_path();
        let model = RobotModel::load(&path).map_err(|source| LearnerError::Robot { source })?;
        let contract = PolicyContract::new(&model, &config.task)?;
        let (network, dims) = (&config.learner.network, (contract.obs_dim(), contract.act_dim()));
        let mut networks = NetworkSpec::new(network, dims.0, dims.1)?;
        let critic = Critic::new(&config.task.critic, contract.names())?;
        let mut seen = SignedPermutation::identity(critic.dim());
        if network.symmetric {
            let mirror = Mirror::new(&model, &contract.observation)?;
            seen = critic.mirrored(&mirror);
            networks = networks.symmetric(mirror)?;
        }
        Ok(Self { model, contract, critic, networks: networks.with_critic(seen) })
    }
}
