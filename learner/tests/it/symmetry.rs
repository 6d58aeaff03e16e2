//! Left and right alike, from the preset to the policy file and the simulator.

use std::sync::Arc;

use caudata_actor::build_env;
use caudata_config::{Config, PRESETS, Source};
use caudata_learner::export::{PolicyIdentity, export};
use caudata_learner::network::{ActorCritic, NetworkSpec};
use caudata_learner::normaliser::{Moments, Scaling};
use caudata_model::RobotModel;
use caudata_policy::{Inference, PolicyFile};
use caudata_random::{Key, Purpose, Stream};
use caudata_task::{Mirror, PolicyContract};
use tch::Device;

/// A preset's robot and its mirror, and a policy with weights of a trained size that sees through a
/// normaliser of lopsided observations.
struct Case {
    config: Config,
    model: Arc<RobotModel>,
    mirror: Mirror,
    net: ActorCritic,
    scaling: Scaling,
    file: PolicyFile,
}

fn draw(n: usize) -> Vec<f32> {
    let mut stream = Stream::new(Key::for_run(7), Purpose::Sensor);
    (0..n).map(|_| stream.normal()).collect()
}

fn case(preset: &str) -> Case {
    let config =
        Config::load(&Source { preset: Some(preset.to_owned()), ..Source::default() }).unwrap();
    let model = Arc::new(RobotModel::load(&config.robot_path()).unwrap());
    let contract = PolicyContract::new(&model, &config.task).unwrap();
    let mirror = Mirror::new(&model, &contract.observation).unwrap();
    let dims = (contract.obs_dim(), contract.act_dim());
    let spec = NetworkSpec::new(&config.learner.network, dims.0, dims.1).unwrap();
    let spec = spec.symmetric(mirror.clone()).unwrap();
    let net = ActorCritic::new(spec, 3, Device::Cpu);
    let larger: Vec<f32> = net.to_vec().unwrap().iter().map(|w| 2.0 * w).collect();
    net.copy_from_slice(&larger).unwrap();
    let moments = Moments::of(&draw(40 * dims.0), dims.0);
    let scaling = moments.with_image(&mirror.observation).scaling(10.0);
    let identity = PolicyIdentity {
        contract,
        run_id: "test".into(),
        training_commit: String::new(),
        config_hash: String::new(),
        seed: 3,
    };
    let file = export(&net, &scaling, &identity, 1, 1).unwrap();
    Case { config, model, mirror, net, scaling, file }
}

fn act(inference: &mut Inference, observation: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0; inference.act_dim()];
    inference.run(observation, 1, &mut out).unwrap();
    out
}

fn apart(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn every_preset_but_the_paper_s_asks_for_it() {
    for preset in PRESETS {
        let config = case(preset.name).config;
        // The paper's networks are as printed. The robots of all presets are alike on both sides.
        let asks = config.learner.network.symmetric;
        assert_eq!(asks, preset.name != "paper", "{}", preset.name);
    }
}

#[test]
fn the_policy_of_the_mirror_image_is_the_mirror_image_of_the_policy() {
    for preset in PRESETS {
        let case = case(preset.name);
        let mut inference = Inference::new(&case.file, 1).unwrap();
        let dim = inference.obs_dim();
        let seen: Vec<f32> = draw(20 * dim).iter().map(|x| 2.0 * x).collect();
        for seen in seen.chunks(dim) {
            let image = case.mirror.observation.apply(seen);
            let action = act(&mut inference, seen);
            let of_image = act(&mut inference, &image);
            let off = apart(&case.mirror.action.apply(&action), &of_image);
            assert!(off < 1e-5, "{}: {off}", preset.name);
            assert!(apart(&action, &of_image) > 1e-3, "{}", preset.name);
            let value = |o: &[f32]| {
                let raw = tch::Tensor::from_slice(o).view([1, dim as i64]);
                case.net.value().forward(&case.scaling.apply(&raw)).double_value(&[0, 0])
            };
            let (value, of_image) = (value(seen), value(&image));
            assert!((value - of_image).abs() < 1e-4 * value.abs().max(1.0));
        }
        // what commutes must commute in each layer, not by chance
        let half = case.net.to_vec().unwrap();
        let image = case.net.counterparts().map_or(half.clone(), |mirror| mirror.apply(&half));
        assert_eq!(image, half, "{}: symmetric to the bit", preset.name);
    }
}

/// Two robots side by side under the same policy, the second told what the first one's mirror image would be
/// told (its clock half a cycle on, its command turned round): they move as mirror images of each other.
#[test]
fn a_mirrored_rollout_mirrors() {
    let mut case = case("quick");
    let task = &mut case.config.task;
    task.randomisation.enabled = false;
    task.push.enabled = false;
    task.noise.enabled = false;
    task.stagger_first_episode = false;
    task.reset.joint_pos_noise_rad = 0.0;
    task.reset.base_vel_noise_mps = 0.0;
    task.reset.yaw_range_rad = 0.0;
    (case.config.actors.lanes, case.config.actors.threads) = (2, 1);
    let mut env = build_env(&case.config, Arc::clone(&case.model), 0).unwrap();
    env.hold_commands(&[[0.2, 0.04, 0.25], [0.2, -0.04, -0.25]]).unwrap();
    let mut inference = Inference::new(&case.file, 1).unwrap();
    let layout = env.contract().observation.clone();
    let told: Vec<_> = ["phase", "command"].map(|part| layout.slice(part).unwrap()).into();
    let (mut off, mut moved) = (0.0_f64, 0.0_f64);
    for _ in 0..40 {
        let (first, second) = env.observations().split_at(layout.dim());
        let image = case.mirror.observation.apply(first);
        let mut second = second.to_vec();
        for slice in &told {
            let range = slice.start..slice.start + slice.len;
            second[range.clone()].copy_from_slice(&image[range]);
        }
        for part in ["joint_vel", "joint_pos_offset", "gyro"] {
            let slice = layout.slice(part).unwrap();
            for i in slice.start..slice.start + slice.len {
                off += f64::from(image[i] - second[i]).powi(2);
                moved += f64::from(image[i]).powi(2);
            }
        }
        let both = [act(&mut inference, first), act(&mut inference, &second)].concat();
        env.step(&both).unwrap();
    }
    // The facts file has centres of mass off the middle by a fraction of a millimetre.
    let share = (off / moved).sqrt();
    assert!(moved > 1.0 && share < 0.2, "{share}");
}
