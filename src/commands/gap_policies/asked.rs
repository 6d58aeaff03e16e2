//! What a folder of policies was asked for: another call goes on in it only with the same.

use std::sync::Arc;

use caudata_model::RobotModel;

use super::{Effort, Given};
use crate::commands::out_folder::{self, Asked};

/// Keys that every training sets for itself.
const OWN: [&str; 3] = ["robot", "run.seed", "run.iterations"];

/// All that decides what one training and its evaluations come to; not how many there are.
pub fn all(effort: &Effort, given: &Given, models: &[Arc<RobotModel>; 3]) -> Asked {
    let [robot, extended, truth] = models.each_ref().map(|model| model.hash_hex());
    let flags = [
        ("--robot", robot),
        ("--extended", extended),
        ("--truth", truth),
        ("--policy", given.start.clone().unwrap_or("none".to_owned())),
        ("--iterations", effort.iterations.to_string()),
        ("--suite", effort.suite.name().to_owned()),
        ("--episodes", effort.episodes.to_string()),
        ("--referee-episodes", effort.referee_episodes.to_string()),
    ];
    out_folder::asked(&given.config, &OWN, flags)
}
