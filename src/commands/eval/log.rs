//! One episode of each scenario as a log folder, which `caudata log convert` makes an MCAP file of.

use std::path::Path;

use caudata_evaluation::{Frame, Outcome, RobotPose};
use caudata_model::RobotModel;
use caudata_runlog::{Axis, BaseHold, LogMeta, LogWriter, QuatPart, Signal};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};

use crate::commands::ground;

/// Makes the folder; one that holds something is refused.
pub fn check(root: &Path) -> Result<(), Failure> {
    files::make_folder(root)?;
    let mut inside = root.read_dir().or_exit(ExitCode::CannotCreate)?;
    match inside.next() {
        None => Ok(()),
        Some(_) => {
            let message = format!("{} is not empty; give another --log", root.display());
            Err(Failure::message(ExitCode::CannotCreate, message))
        }
    }
}

/// Writes the filmed episodes below `root`, each called after its scenario.
pub fn write(
    root: &Path,
    outcomes: &[Outcome],
    seed: u64,
    robot: &Path,
    model: &RobotModel,
) -> Result<(), Failure> {
    let signals = signals(model);
    for outcome in outcomes {
        let (name, period_s) = (&outcome.result.name, outcome.period_s);
        let robot = robot.display().to_string();
        let base = match outcome.terrain.water_level_m {
            Some(_) => BaseHold::Water,
            None => BaseHold::Free,
        };
        let mut meta = LogMeta::new(robot, base, 1.0 / period_s);
        ground::note(&mut meta, &outcome.terrain_config, seed);
        meta.notes = format!("caudata eval, {name}");
        let folder = root.join(file_name(name));
        let log = LogWriter::create(&folder, &signals, &meta);
        let mut log = log.or_exit(ExitCode::CannotCreate)?;
        let film = outcome.film.iter();
        let frames = film.flat_map(|film| film.trace.frames.iter().zip(&film.poses));
        for (k, (frame, pose)) in frames.enumerate() {
            let row = log.row(k as f64 * period_s, &row(frame, pose));
            row.or_exit(ExitCode::IoError)?;
        }
        log.finish().or_exit(ExitCode::IoError)?;
    }
    Ok(())
}

/// The columns, in the order of [`row`].
pub fn signals(model: &RobotModel) -> Vec<Signal> {
    let joints = model.actuated_names();
    let feet = model.feet().iter().map(|foot| foot.name.clone());
    let mut signals = Signal::each(&[Signal::Position, Signal::Velocity, Signal::Torque], &joints);
    signals.extend(Axis::ALL.map(Signal::BasePosition));
    signals.extend(QuatPart::ALL.map(Signal::BaseQuaternion));
    signals.extend(feet.map(Signal::Contact));
    signals
}

/// A scenario's name as every file system and shell takes it.
fn file_name(scenario: &str) -> String {
    let plain = |c: char| match c {
        'a'..='z' | 'A'..='Z' | '0'..='9' | '.' | '-' => c,
        _ => '_',
    };
    scenario.chars().map(plain).collect()
}

/// A robot at one step.
pub fn row(frame: &Frame, pose: &RobotPose) -> Vec<Option<f64>> {
    let contact: Vec<f32> =
        frame.foot_force_n.iter().map(|force_n| f32::from(u8::from(*force_n > 0.0))).collect();
    let parts = [
        &frame.joint_pos_rad[..],
        &frame.joint_vel_radps,
        &frame.torque_nm,
        &pose.base_pos_m,
        &pose.base_quat_wxyz,
        &contact,
    ];
    parts.concat().into_iter().map(|x| Some(f64::from(x))).collect()
}
