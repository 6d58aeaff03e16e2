//! Policies made by hand, whose verdict is known.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod by_hand;

use caudata_evaluation::{Scenario, ScenarioResult, Settings, run_scenario};
use caudata_policy::PolicyFile;
use caudata_task::{ACT_DIM, PolicyContract};

use by_hand::{config, layer, policy, robot, vibrating};

/// Episodes of each verdict, and their length.
fn settings() -> Settings {
    Settings {
        episodes: 2,
        episode_s: 6.0,
        ..Settings::default()
    }
}

fn verdict(make: impl Fn(&PolicyContract) -> PolicyFile) -> ScenarioResult {
    let config = config();
    let model = robot();
    let contract = PolicyContract::new(&model, &config.task).unwrap();
    let scenario = Scenario::walk("by hand", [0.3, 0.0, 0.0]);
    let policy = make(&contract);
    let outcome = run_scenario(&config, &model, &policy, &scenario, &settings(), &|| true).unwrap();
    assert_eq!(outcome.result.episodes, 2);
    outcome.result
}

#[test]
fn a_vibrating_policy_is_not_called_walking() {
    let result = verdict(|contract| vibrating(contract, 7.5));
    assert_eq!(result.walks(), Some(false));
    let missed = result.gates.as_ref().unwrap().missed();
    assert!(missed.contains(&"joint power above 6 Hz"), "{missed:?}");
    assert!(
        missed.contains(&"stride frequency off the clock"),
        "{missed:?}"
    );
    assert!(
        (result.stride_hz.mean - 7.5).abs() < 1.0,
        "{:?}",
        result.stride_hz
    );
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
fn the_same_seed_gives_the_same_figures() {
    let run = || verdict(|contract| vibrating(contract, 5.0));
    assert_eq!(run(), run());
}
