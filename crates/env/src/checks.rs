//! What an environment is made of and given, held against each other.

use caudata_model::RobotModel;
use caudata_sim::Engine;
use caudata_task::TaskConfig;

use crate::EnvError;

/// How far the engine's control period may be from the task's, s.
const CONTROL_PERIOD_TOLERANCE_S: f64 = 1e-9;

pub(crate) fn check_engine(
    model: &RobotModel,
    task: &TaskConfig,
    engine: &dyn Engine,
) -> Result<(), EnvError> {
    if engine.lanes() == 0 {
        return Err(EnvError::NoLanes);
    }
    if engine.model().hash() != model.hash() {
        return Err(EnvError::OtherRobot {
            task: model.name().to_owned(),
            engine: engine.model().name().to_owned(),
        });
    }
    let engine_s = engine.config().control_period_s();
    if (engine_s - task.control_period_s).abs() > CONTROL_PERIOD_TOLERANCE_S {
        return Err(EnvError::ControlPeriod { task_s: task.control_period_s, engine_s });
    }
    Ok(())
}

pub(crate) fn check_actions(actions: &[f32], lanes: usize, width: usize) -> Result<(), EnvError> {
    let expected = lanes * width;
    if actions.len() != expected {
        return Err(EnvError::Shape { what: "actions", found: actions.len(), expected });
    }
    match actions.iter().position(|a| !a.is_finite()) {
        None => Ok(()),
        Some(index) => Err(EnvError::Action {
            lane: index / width,
            action: index % width,
            value: actions[index],
        }),
    }
}
