//! Starting from a policy that somebody has trained before, instead of from random weights.
//!
//! A policy file holds the actor, its exploration noise and the frozen normaliser, but no critic;
//! `learner.warm_start` says for how many iterations only the critic learns.

use std::path::Path;
use std::sync::Arc;

use caudata_policy::{MlpSpec, PolicyFile};
use caudata_task::{ObservationLayout, PolicyContract};

use crate::LearnerError;
use crate::network::ActorCritic;
use crate::normaliser::Moments;

/// How many observations the normaliser of the old policy counts as: a fresh batch then moves it by a few per
/// cent, not at once.
const OBSERVATIONS: u64 = 200_000;

/// Gives `net` the actor of the policy file at `path`, and answers its normaliser as moments. Its action
/// noise becomes at least `least_std`.
///
/// The old task may lack observations that the new one appends (the medium bit, earlier observations): they begin
/// with weight zero.
///
/// # Errors
/// [`LearnerError::Read`] when the file cannot be read, [`LearnerError::Policy`] when it is no policy,
/// [`LearnerError::Unfit`] when it does not fit the network or the robot's joints.
pub fn warm_start(
    net: &ActorCritic,
    path: &Path,
    least_std: f32,
    contract: &PolicyContract,
) -> Result<Moments, LearnerError> {
    let file = read(path)?;
    let refuse = |reason| LearnerError::Unfit { role: "warm_start", path: path.to_owned(), reason };
    check(net, &file, contract).map_err(refuse)?;
    let spec = file.spec();
    let mut values = net.to_vec()?;
    let least = least_std.ln();
    let log_std: Vec<f32> = file.metadata().log_std.iter().map(|x| x.max(least)).collect();
    net.set_policy(&mut values, &spec.widened(contract.obs_dim()), &log_std).map_err(refuse)?;
    net.copy_from_slice(&values).map_err(|error| refuse(error.to_string()))?;
    Ok(moments(spec, net.spec().seen_dim(), &contract.observation))
}

/// The policy at `path`.
pub(crate) fn read(path: &Path) -> Result<PolicyFile, LearnerError> {
    let most = caudata_policy::MAX_FILE_BYTES as u64;
    let bytes = caudata_durable::read_at_most(path, most)
        .map_err(|source| LearnerError::Read { path: path.to_owned(), source })?;
    Ok(PolicyFile::parse(Arc::from(bytes))?)
}

fn check(net: &ActorCritic, file: &PolicyFile, contract: &PolicyContract) -> Result<(), String> {
    let (spec, theirs) = (file.spec(), &file.metadata().contract);
    if theirs.joint_names != contract.joint_names {
        return Err("it is for other joints, or another order of them".to_owned());
    }
    if !contract.observation.begins_with(&theirs.observation) {
        return Err("its observation is no beginning of this task's".to_owned());
    }
    let wanted = net.spec().activation;
    if spec.activation != wanted {
        return Err(format!(
            "its activation is {:?}, learner.network.activation asks for {wanted:?}",
            spec.activation
        ));
    }
    let hidden: Vec<usize> = spec.layers.iter().map(|layer| layer.out).collect();
    let sizes = net.spec().policy_sizes();
    if hidden != sizes[1..] {
        return Err(format!(
            "its layers are {hidden:?}, learner.network.policy_hidden gives {:?}",
            &sizes[1..]
        ));
    }
    Ok(())
}

/// Those of `spec`; of an earlier observation that it does not know those of the present one.
fn moments(spec: &MlpSpec, seen_dim: usize, layout: &ObservationLayout) -> Moments {
    let mut moments = Moments::new(seen_dim);
    moments.count = OBSERVATIONS;
    moments.m2.fill(OBSERVATIONS as f64);
    let recalled: Vec<usize> = layout.recalled().flatten().collect();
    let earlier = layout.past().iter().flat_map(|_| &recalled);
    let like = (0..layout.present_dim()).chain(earlier.copied());
    for (d, like) in like.enumerate() {
        let from = if d < spec.obs_dim() { d } else { like };
        if let (Some(&mean), Some(&std)) = (spec.obs_mean.get(from), spec.obs_std.get(from)) {
            moments.mean[d] = f64::from(mean);
            moments.m2[d] = f64::from(std).powi(2) * OBSERVATIONS as f64;
        }
    }
    moments
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::{PolicyIdentity, export, write_policy};
    use crate::network::NetworkSpec;
    use crate::normaliser::Scaling;
    use caudata_config::Activation;
    use caudata_model::RobotModel;
    use caudata_task::TaskConfig;
    use caudata_task::mirror::SignedPermutation;
    use tch::{Device, Kind, Tensor};

    /// An amphibious task also looks back.
    fn contract(amphibious: bool) -> PolicyContract {
        let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
        let model = RobotModel::load(&robot).unwrap();
        let mut task = TaskConfig { observe_medium: amphibious, ..TaskConfig::default() };
        task.observation.past = if amphibious { vec![2] } else { Vec::new() };
        PolicyContract::new(&model, &task).unwrap()
    }

    fn network(contract: &PolicyContract, hidden: Vec<usize>, seed: u64) -> ActorCritic {
        let spec = NetworkSpec {
            obs_dim: contract.obs_dim(),
            critic: SignedPermutation::identity(0),
            act_dim: contract.act_dim(),
            policy_hidden: hidden,
            value_hidden: vec![8],
            activation: Activation::Elu,
            init_std: 0.3,
            std_min: 0.05,
            std_max: 1.5,
            mirror: None,
        };
        ActorCritic::new(spec, seed, Device::Cpu)
    }

    /// A policy of a task on land, in a file: normaliser mean 1, std 2 everywhere.
    fn old_policy(dir: &Path) -> (std::path::PathBuf, ActorCritic) {
        let contract = contract(false);
        let net = network(&contract, vec![12, 10], 1);
        let scaling = Scaling {
            mean: vec![1.0; contract.obs_dim()],
            std: vec![2.0; contract.obs_dim()],
            clip: 10.0,
        };
        let identity = PolicyIdentity {
            contract,
            run_id: "old".into(),
            training_commit: String::new(),
            config_hash: String::new(),
            seed: 1,
        };
        let path = dir.join("old.onnx");
        write_policy(&path, &export(&net, &scaling, &identity, 3, 100).unwrap()).unwrap();
        (path, net)
    }

    #[test]
    fn the_new_task_begins_with_the_old_actions_whatever_the_new_observation_says() {
        let dir = tempfile::tempdir().unwrap();
        let (path, old) = old_policy(dir.path());
        let amphibious = contract(true);
        let net = network(&amphibious, vec![12, 10], 2);
        // 97 and the medium bit; of earlier 3 · 16 + 6, and that bit
        let ones = |n: i64| Tensor::ones([1, n], (Kind::Float, Device::Cpu));
        let value_before = net.value().forward(&ones(153));
        let moments = warm_start(&net, &path, 0.0, &amphibious).unwrap();

        let scaling = moments.scaling(10.0);
        for i in 0..153 {
            let expected = if i == 97 || i == 152 { [0.0, 1.0] } else { [1.0, 2.0] };
            assert!((scaling.mean[i] - expected[0]).abs() < 1e-6, "{i}");
            assert!((scaling.std[i] - expected[1]).abs() < 1e-5, "{i}");
        }
        let x = Tensor::from_slice(&[0.3_f32; 97]).view([1, 97]);
        let wet = Tensor::cat(&[&x, &ones(56)], 1);
        let gap = |a: &Tensor, b: &Tensor| (a - b).abs().max().double_value(&[]);
        assert!(gap(&old.policy().forward(&x), &net.policy().forward(&wet)) < 1e-6);
        assert!(gap(&old.log_std(), &net.log_std()) < 1e-5);
        let value = net.value().forward(&ones(153));
        assert_eq!(gap(&value, &value_before), 0.0);
    }

    #[test]
    fn exploration_begins_no_smaller_than_asked_for() {
        let dir = tempfile::tempdir().unwrap();
        let (path, _) = old_policy(dir.path());
        let contract = contract(false);
        let net = network(&contract, vec![12, 10], 2);
        // The old policy's noise is 0.3.
        for (least, expected) in [(0.1, 0.3), (0.6, 0.6)] {
            warm_start(&net, &path, least, &contract).unwrap();
            let std = net.log_std().exp().mean(Kind::Float).double_value(&[]);
            assert!((std - expected).abs() < 1e-3, "{std}");
        }
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let (path, _) = old_policy(dir.path());
        let contract = contract(false);
        let refusal = |hidden: Vec<usize>, path: &Path| {
            let net = network(&contract, hidden, 2);
            warm_start(&net, path, 0.0, &contract).unwrap_err().to_string()
        };
        let error = refusal(vec![12, 11], &path);
        assert!(error.contains("[12, 10, 16]") && error.contains("[12, 11, 16]"), "{error}");
        let error = refusal(vec![12, 10], &dir.path().join("none.onnx"));
        assert!(error.contains("none.onnx"), "{error}");
    }
}
