//! A shipped policy on MuJoCo: what it keeps of its speed there. Skipped with a message where there is no
//! Python with MuJoCo.

use std::path::Path;
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::{Evaluation, EvaluationError, Settings, Suite};
use caudata_model::RobotModel;
use caudata_policy::PolicyFile;
use caudata_sim::EngineKind;

use crate::by_hand::robot;

const SETTINGS: Settings =
    Settings { episodes: 4, episode_s: 6.0, settle_s: 2.0, seed: 31, film: false };

/// `policies/flat.onnx`, the robot, and the task that it was trained for.
fn shipped() -> (Config, Arc<RobotModel>, PolicyFile) {
    let preset = ConfigArgs { preset: Some("flat".into()), ..ConfigArgs::default() };
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../policies/flat.onnx");
    let policy = PolicyFile::parse(std::fs::read(file).unwrap().into()).unwrap();
    (preset.load().unwrap(), robot(), policy)
}

#[test]
fn a_policy_walks_on_mujoco_as_on_batch() {
    if let Err(why) = caudata_sim::mujoco::version() {
        eprintln!("skipped: {why}");
        return;
    }
    let (config, model, policy) = shipped();
    let evaluation = Evaluation {
        config: &config,
        model: &model,
        policy: &policy,
        suite: Suite::Rough,
        settings: SETTINGS,
        referee: Some(EngineKind::Mujoco),
    };
    let (result, _) = evaluation.run(&|| true, &mut |_, _| {}).unwrap();
    let referee = result.referee.as_ref().unwrap();
    assert_eq!(referee.engine, "mujoco");
    assert_eq!(referee.scenarios.len(), result.scenarios.len());
    for (here, there) in result.scenarios.iter().zip(&referee.scenarios) {
        let kept = there.vx_mps.mean / here.vx_mps.mean;
        eprintln!("{}: {kept:.3} kept", here.name);
        // four episodes on rough ground scatter by a few per cent
        assert!((0.85..1.15).contains(&kept), "{}: {kept}", here.name);
        assert_eq!(there.fall_share.mean, 0.0, "{}", here.name);
        // the same work, by the same servos
        let work = there.power_w.mean / here.power_w.mean;
        assert!((0.8..1.25).contains(&work), "{}: {work}", here.name);
    }
}

#[test]
fn what_mujoco_does_not_simulate_is_refused() {
    if caudata_sim::mujoco::version().is_err() {
        eprintln!("skipped: no MuJoCo");
        return;
    }
    let (mut config, model, policy) = shipped();
    config.engine.self_collision = true;
    let evaluation = Evaluation {
        config: &config,
        model: &model,
        policy: &policy,
        suite: Suite::Push,
        settings: SETTINGS,
        referee: Some(EngineKind::Mujoco),
    };
    match evaluation.run(&|| true, &mut |_, _| {}) {
        Err(error @ EvaluationError::Build(_)) => {
            assert!(error.to_string().contains("it does not simulate self_collision"), "{error}")
        }
        other => panic!("{other:?}"),
    }
}
