//! From the networks to the policy file that everybody runs.

use std::path::Path;
use std::sync::Arc;

use caudata_policy::{Dense, MlpSpec, PolicyFile, PolicyMetadata, build_onnx};
use caudata_task::PolicyContract;
use tch::{Device, Tensor};

use crate::LearnerError;
use crate::network::ActorCritic;
use crate::normaliser::Scaling;

/// What the files of one run have in common.
#[derive(Clone, Debug)]
pub struct PolicyIdentity {
    /// What the policy's numbers mean.
    pub contract: PolicyContract,
    /// The training run.
    pub run_id: String,
    /// Commit of this program when the run began, as `BuildInfo::commit_word` has it; empty where unknown.
    pub training_commit: String,
    /// Hash of the training configuration.
    pub config_hash: String,
    /// Seed of the run.
    pub seed: u64,
}

/// The policy with its frozen normaliser as a file. No clock goes in: the same weights give the same bytes,
/// so that a resumed run publishes what the run before it has published.
///
/// # Errors
/// [`LearnerError::Policy`] when a weight is not finite, [`LearnerError::Torch`] when the device does not
/// hand them over.
pub fn export(
    net: &ActorCritic,
    scaling: &Scaling,
    identity: &PolicyIdentity,
    version: u64,
    env_steps: u64,
) -> Result<PolicyFile, LearnerError> {
    let spec = MlpSpec {
        obs_mean: scaling.mean[..net.spec().obs_dim].to_vec(),
        obs_std: scaling.std[..net.spec().obs_dim].to_vec(),
        obs_clip: Some(scaling.clip),
        layers: net
            .policy()
            .layers()
            .map(|(weight, bias)| dense(weight, bias))
            .collect::<Result<_, LearnerError>>()?,
        activation: net.spec().activation,
    };
    let metadata = PolicyMetadata {
        contract: identity.contract.clone(),
        version,
        run_id: identity.run_id.clone(),
        training_commit: identity.training_commit.clone(),
        config_hash: identity.config_hash.clone(),
        env_steps,
        seed: identity.seed,
        log_std: to_host(&net.log_std())?,
        created_unix_s: None,
        evaluation: None,
    };
    let bytes = build_onnx(&spec, &metadata)?;
    Ok(PolicyFile::parse(Arc::from(bytes))?)
}

/// Replaces the file at `path`, whole or not at all.
///
/// # Errors
/// [`LearnerError::Durable`].
pub fn write_policy(path: &Path, file: &PolicyFile) -> Result<(), LearnerError> {
    Ok(caudata_durable::replace(path, file.bytes())?)
}

fn dense(weight: &Tensor, bias: &Tensor) -> Result<Dense, LearnerError> {
    let size = weight.size();
    let side = |index: usize| {
        let length = size.get(index).copied().unwrap_or(0);
        usize::try_from(length).unwrap_or(0)
    };
    Ok(Dense { out: side(0), input: side(1), weight: to_host(weight)?, bias: to_host(bias)? })
}

/// Row-major values on the host.
fn to_host(tensor: &Tensor) -> Result<Vec<f32>, LearnerError> {
    let flat = tensor.to_device(Device::Cpu).contiguous().view([-1]);
    Ok(Vec::try_from(&flat)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::NetworkSpec;
    use caudata_config::Activation;
    use caudata_model::RobotModel;
    use caudata_policy::Inference;
    use caudata_random::{Key, Purpose, Stream};
    use caudata_task::TaskConfig;
    use caudata_task::mirror::SignedPermutation;
    use tch::Kind;

    fn identity() -> PolicyIdentity {
        let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        let model = RobotModel::load(&robot).unwrap();
        PolicyIdentity {
            contract: PolicyContract::new(&model, &TaskConfig::default()).unwrap(),
            run_id: "test".into(),
            training_commit: String::new(),
            config_hash: String::new(),
            seed: 3,
        }
    }

    fn network(activation: Activation, identity: &PolicyIdentity) -> ActorCritic {
        let spec = NetworkSpec {
            obs_dim: identity.contract.obs_dim(),
            critic: SignedPermutation::identity(0),
            act_dim: identity.contract.act_dim(),
            policy_hidden: vec![64, 32],
            value_hidden: vec![16],
            activation,
            init_std: 0.7,
            std_min: 0.05,
            std_max: 1.0,
            mirror: None,
        };
        let net = ActorCritic::new(spec, 11, Device::Cpu);
        // Weights of a trained size: fresh ones keep the actions near zero, where errors would hide.
        let values: Vec<f32> = net.to_vec().unwrap().iter().map(|w| 3.0 * w).collect();
        net.copy_from_slice(&values).unwrap();
        net
    }

    #[test]
    fn the_file_computes_what_libtorch_computes() {
        let identity = identity();
        let mut stream = Stream::new(Key { seed: 1, actor: 0, env: 0, episode: 0 }, Purpose::Init);
        let d = identity.contract.obs_dim();
        let scaling = Scaling {
            mean: (0..d).map(|_| stream.normal()).collect(),
            std: (0..d).map(|_| stream.uniform(0.1, 3.0)).collect(),
            clip: 5.0,
        };
        let lanes = 33;
        let observations: Vec<f32> = (0..lanes * d).map(|_| 4.0 * stream.normal()).collect();
        for activation in [Activation::Elu, Activation::Swish, Activation::Tanh, Activation::Relu] {
            let net = network(activation, &identity);
            let file = export(&net, &scaling, &identity, 7, 100).unwrap();
            let mut from_file = vec![0.0; lanes * identity.contract.act_dim()];
            let mut inference = Inference::new(&file, 1).unwrap();
            inference.run(&observations, lanes, &mut from_file).unwrap();

            let raw = Tensor::from_slice(&observations).view([lanes as i64, d as i64]);
            let from_torch = to_host(&net.policy().forward(&scaling.apply(&raw))).unwrap();
            let mut largest: f32 = 0.0;
            for (a, b) in from_file.iter().zip(&from_torch) {
                largest = largest.max((a - b).abs() / b.abs().max(1.0));
            }
            assert!(largest < 1e-5, "{activation:?}: {largest}");
            assert!(from_torch.iter().any(|a| a.abs() > 0.05), "{activation:?}");
        }
    }

    #[test]
    fn the_same_weights_give_the_same_bytes_and_others_do_not() {
        let identity = identity();
        let scaling = Scaling::identity(identity.contract.obs_dim(), 10.0);
        let net = network(Activation::Elu, &identity);
        let first = export(&net, &scaling, &identity, 1, 10).unwrap();
        let again = export(&net, &scaling, &identity, 1, 10).unwrap();
        assert_eq!(first.sha256(), again.sha256());
        let changed: Vec<f32> = net.to_vec().unwrap().iter().map(|w| w * 1.001).collect();
        net.copy_from_slice(&changed).unwrap();
        let other = export(&net, &scaling, &identity, 1, 10).unwrap();
        assert_ne!(first.sha256(), other.sha256());
        // Actors explore with the network's own noise. (The first file was made before the weights changed.)
        let fresh = network(Activation::Elu, &identity);
        assert_eq!(first.metadata().log_std, to_host(&fresh.log_std()).unwrap());
    }

    #[test]
    fn a_weight_that_is_not_finite_never_leaves() {
        let identity = identity();
        let scaling = Scaling::identity(identity.contract.obs_dim(), 10.0);
        let net = network(Activation::Elu, &identity);
        let (weight, _) = net.policy().layers().next().unwrap();
        let _ = weight.shallow_clone().get(0).fill_(f64::NAN);
        assert_eq!(weight.kind(), Kind::Float);
        assert!(export(&net, &scaling, &identity, 1, 10).is_err());
    }
}
