//! Policies whose verdict is known: made by hand, and those of other robots that ship.

use std::path::Path;
use std::sync::Arc;

use caudata_config::{Config, PRESETS, Source};
use caudata_evaluation::{Scenario, ScenarioResult, Settings, Suite, run_scenario};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_task::PolicyContract;

use crate::by_hand::{config, layer, policy, robot, swimming, vibrating};

const ACT_DIM: usize = 16;

/// Episodes of each verdict, and their length.
fn settings() -> Settings {
    Settings { episodes: 2, episode_s: 6.0, ..Settings::default() }
}

fn verdict(make: impl Fn(&PolicyContract) -> PolicyFile) -> ScenarioResult {
    run(&Scenario::walk("by hand", [0.3, 0.0, 0.0]), make)
}

fn run(scenario: &Scenario, make: impl Fn(&PolicyContract) -> PolicyFile) -> ScenarioResult {
    run_with(&settings(), scenario, make)
}

fn run_with(
    settings: &Settings,
    scenario: &Scenario,
    make: impl Fn(&PolicyContract) -> PolicyFile,
) -> ScenarioResult {
    let config = config();
    let model = robot();
    let contract = PolicyContract::new(&model, &config.task).unwrap();
    let policy = make(&contract);
    let outcome = run_scenario(&config, &model, &policy, scenario, settings, &|| true).unwrap();
    assert_eq!(outcome.result.episodes, settings.episodes as usize);
    outcome.result
}

#[test]
fn a_vibrating_policy_is_not_called_walking() {
    let result = verdict(|contract| vibrating(contract, 7.5));
    assert_eq!(result.walks(), Some(false));
    let missed = result.gates.as_ref().unwrap().missed();
    assert!(missed.contains(&"joint power above 6 Hz"), "{missed:?}");
    assert!(missed.contains(&"stride frequency off the clock"), "{missed:?}");
    assert!((result.stride_hz.mean - 7.5).abs() < 1.0, "{:?}", result.stride_hz);
}

#[test]
fn a_standing_policy_is_not_called_walking() {
    let result = verdict(|contract| policy(contract, vec![layer(ACT_DIM, contract.obs_dim())]));
    assert_eq!(result.walks(), Some(false));
    assert!(result.drift_mps.mean < 0.01, "{:?}", result.drift_mps);
    assert!(result.power_w.mean < 1.0, "{:?}", result.power_w);
    let missed = result.gates.as_ref().unwrap().missed();
    assert!(missed.contains(&"clearance, m"), "{missed:?}");
}

#[test]
fn a_standing_policy_stays_as_it_falls() {
    let thrown = Suite::Righting.scenarios(2.6, 0.3).remove(0);
    let settings = Settings { episodes: 32, ..settings() };
    let still =
        |contract: &PolicyContract| policy(contract, vec![layer(ACT_DIM, contract.obs_dim())]);
    let righting = run_with(&settings, &thrown, still).righting.unwrap();
    // those that land on their feet stand at once, those that land on their back never do
    assert!((0.2..0.8).contains(&righting.upright.mean), "{righting:?}");
    assert!((righting.upright.mean - righting.in_time.mean).abs() < 0.1, "{righting:?}");
}

#[test]
fn the_same_seed_gives_the_same_figures() {
    let run = || verdict(|contract| vibrating(contract, 5.0));
    assert_eq!(run(), run());
}

#[test]
fn a_wave_to_the_tail_swims_and_a_wave_to_the_head_does_not() {
    let deep = Suite::Transition.scenarios(2.6, 0.3).pop().unwrap();
    assert_eq!(deep.name, "swim 0.3 m/s");
    let ahead = run(&deep, |contract| swimming(contract, 0.8));
    let wave = ahead.wave.unwrap();
    assert!(wave.travels_to_the_tail, "{wave:?}");
    // each joint follows its command with much the same delay, so that the lags are those that were asked for
    for (j, lag) in wave.lag_rad.iter().enumerate() {
        let off = lag - 0.8 * j as f64;
        assert!(off.abs() < 0.4, "joint {j}: {:?}", wave.lag_rad);
    }
    assert!(ahead.vx_mps.mean > 0.03, "{:?}", ahead.vx_mps);
    assert_eq!(ahead.fall_share.mean, 0.0);

    let back = run(&deep, |contract| swimming(contract, -0.8));
    assert!(!back.wave.unwrap().travels_to_the_tail);
    assert!(back.vx_mps.mean < 0.0, "{:?}", back.vx_mps);
}

#[test]
fn swimming_at_the_shore_is_measured_in_the_water() {
    let onto_land = Suite::Transition.scenarios(2.6, 0.3).swap_remove(1);
    let result = run(&onto_land, |contract| swimming(contract, 0.8));
    let transition = result.transition.unwrap();
    assert!(transition.swim_speed_mps.unwrap().mean > 0.03);
    assert_eq!(transition.foot_contact[1], Some(0.0));
    assert!(transition.wave_in_water.unwrap().travels_to_the_tail);
}

#[test]
fn who_stays_where_it_is_arrives_nowhere_and_rough_gets_over_three_centimetres() {
    let up = Suite::Steps.scenarios(2.6, 0.3).swap_remove(1);
    assert_eq!(up.name, "steps of 3 cm up");
    let still =
        |contract: &PolicyContract| policy(contract, vec![layer(ACT_DIM, contract.obs_dim())]);
    assert_eq!(run(&up, still).arrived.unwrap().mean, 0.0);
    let config = Config::load(&Source::preset("rough")).unwrap();
    let rough = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../policies/rough.onnx");
    let rough = PolicyFile::parse(Arc::from(std::fs::read(rough).unwrap())).unwrap();
    // in 12 s it meets two risers
    let settings = Settings { episode_s: 12.0, ..settings() };
    let outcome = run_scenario(&config, &robot(), &rough, &up, &settings, &|| true).unwrap();
    assert_eq!(outcome.result.arrived.unwrap().mean, 1.0);
}

/// The policies of other robots than the salamander that ship, each by the gates of its preset and for the
/// robot file as it is.
#[test]
fn policies_of_other_robots_walk() {
    // legs that brush do so now and then, which a few seconds cannot tell from often
    let settings = Settings { episodes: 32, episode_s: 12.0, ..Settings::default() };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../policies");
    let mut walked = 0;
    for name in PRESETS.iter().filter(|p| p.derived).map(|p| p.name) {
        let Ok(bytes) = std::fs::read(folder.join(format!("{name}.onnx"))) else {
            continue;
        };
        let config = Config::load(&Source::preset(name)).unwrap();
        let model = Arc::new(RobotModel::load(&config.robot_path()).unwrap());
        let policy = PolicyFile::parse(Arc::from(bytes)).unwrap();
        let robot = &policy.metadata().contract.robot_hash;
        assert_eq!(*robot, model.hash_hex(), "{name}");
        let command = [config.evaluation.command_mps as f32, 0.0, 0.0];
        let walk = Scenario::walk(name, command);
        let outcome = run_scenario(&config, &model, &policy, &walk, &settings, &|| true).unwrap();
        let missed = outcome.result.gates.as_ref().map(|gates| gates.missed());
        assert_eq!(outcome.result.walks(), Some(true), "{name}: {missed:?}");
        walked += 1;
    }
    assert!(walked > 0, "none ships");
}

/// `policies/flat.onnx` where it stands and `policies/righting.onnx` where it lies, as one network.
#[test]
fn two_policies_in_one_network_get_up_and_walk() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../policies");
    let read = |name: &str| PolicyFile::parse(Arc::from(std::fs::read(folder.join(name)).unwrap()));
    let (flat, righting) = (read("flat.onnx").unwrap(), read("righting.onnx").unwrap());
    let gravity = flat.metadata().contract.observation.slice("gravity");
    let both = caudata_policy::join(&flat, &righting, gravity.unwrap().start + 2, -0.5).unwrap();
    let config = Config::load(&Source::preset("flat")).unwrap();
    let model = Arc::new(RobotModel::load(&config.robot_path()).unwrap());
    let thrown = Suite::Righting.scenarios(2.6, 0.3).remove(0);
    let settings = Settings { episodes: 32, episode_s: 8.0, settle_s: 4.0, ..settings() };
    let outcome = run_scenario(&config, &model, &both, &thrown, &settings, &|| true).unwrap();
    let righting = outcome.result.righting.unwrap();
    assert!(righting.in_time.mean > 0.85, "{righting:?}");
    assert!(outcome.result.vx_mps.mean > 0.27, "{:?}", outcome.result.vx_mps);
}
