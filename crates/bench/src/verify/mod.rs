//! Ground truth for the engines: MuJoCo, closed forms, conservation laws, and each other. The table of
//! `caudata sim verify`.
//!
//! Every check runs on every engine given, through the [`Engine`](caudata_sim::Engine) trait, and yields
//! [`Row`]s: a figure, its target, whether it is met. Rows that need MuJoCo say `skipped: …` where there is
//! none. `docs/reference/simulation.md` says what each row means.

mod accelerations;
mod drift;
mod error;
mod gait;
mod ground;
mod mujoco;
mod request;
mod row;
mod travel;
mod water;

use std::sync::Arc;

use caudata_model::RobotModel;

pub use error::VerifyError;
pub use gait::Gait;
pub use mujoco::{Mujoco, Presence};
pub use request::RobotRequest;
use row::Bench;
pub use row::{Row, Settings, Subject};

/// The names of all checks, in the order of the table.
pub const CHECKS: [&str; 6] =
    ["accelerations", "conservation", "standing", "incline", "travel", "water"];

/// Runs the checks; `progress` hears of each one that is done.
///
/// # Errors
/// [`VerifyError`] where something cannot run at all; a figure that misses its target is a row, not an error.
pub fn run(settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Vec<Row>, VerifyError> {
    let mut bench = Bench {
        settings,
        model: Arc::new(RobotModel::load(&settings.robot)?),
        robot: RobotRequest::read(&settings.robot)?,
        mujoco: Mujoco::start(),
    };
    type Check = fn(&mut Bench<'_>) -> Result<Vec<Row>, VerifyError>;
    let checks: [(&str, Check); 6] = [
        (CHECKS[0], accelerations::check),
        (CHECKS[1], drift::check),
        (CHECKS[2], ground::standing),
        (CHECKS[3], ground::incline),
        (CHECKS[4], travel::check),
        (CHECKS[5], water::check),
    ];
    let mut rows = Vec::new();
    for (name, check) in checks {
        if settings.only.is_empty() || settings.only.iter().any(|only| only == name) {
            rows.extend(check(&mut bench)?);
            progress(name);
        }
    }
    Ok(rows)
}
