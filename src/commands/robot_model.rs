//! `caudata robot-model`: what a robot file says.

use std::path::PathBuf;
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_model::RobotModel;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;
use serde::Serialize;

use crate::say;

#[derive(Debug, Subcommand)]
pub enum RobotModelCommand {
    /// Read a robot file and its MJCF, check them, and print a summary
    Check {
        /// The robot file
        #[arg(value_name = "FILE.robot.toml")]
        file: PathBuf,
        /// One JSON object instead of a table
        #[arg(long)]
        json: bool,
    },
}

pub fn run(command: &RobotModelCommand) -> Result<(), Failure> {
    let RobotModelCommand::Check { file, json } = command;
    let model = load(file)?;
    caudata_sim::check_extension(&model).map_err(|error| {
        Failure::new(ExitCode::BadInput, error).context(format!("robot file {}", file.display()))
    })?;
    say::either(*json, &Summary::of(&model), |summary| {
        print(&model, summary)
    })
}

/// Reads a robot file; the failure says whether it is missing or wrong.
pub use caudata_studies::files::robot as load;

/// What the flags say, and the robot: that of `--robot`, else the configuration's.
pub fn configured(
    flags: &ConfigArgs,
    robot: Option<&PathBuf>,
) -> Result<(Config, Arc<RobotModel>), Failure> {
    let mut flags = flags.clone();
    flags.set_robot(robot.map(PathBuf::as_path));
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let model = Arc::new(load(&config.robot_path())?);
    Ok((config, model))
}

#[derive(Serialize)]
struct Summary<'a> {
    name: &'a str,
    hash: String,
    links: usize,
    joints: usize,
    actuated: Vec<&'a str>,
    total_mass_kg: f64,
    supply_v: f64,
    kp_nm_per_rad: f64,
    kd_nm_s_per_rad: f64,
}

impl<'a> Summary<'a> {
    fn of(model: &'a RobotModel) -> Self {
        Self {
            name: model.name(),
            hash: model.hash_hex(),
            links: model.links().len(),
            joints: model.joints().len(),
            actuated: model.actuated_names(),
            total_mass_kg: model.total_mass_kg(),
            supply_v: model.supply_v(),
            kp_nm_per_rad: model.kp_nm_per_rad(),
            kd_nm_s_per_rad: model.kd_nm_s_per_rad(),
        }
    }
}

fn print(model: &RobotModel, summary: &Summary<'_>) {
    say::line(format!(
        "{}: {} links, {} joints ({} actuated), {:.3} kg, {:.1} V, gains {} N·m/rad and {} N·m·s/rad",
        summary.name,
        summary.links,
        summary.joints,
        summary.actuated.len(),
        summary.total_mass_kg,
        summary.supply_v,
        summary.kp_nm_per_rad,
        summary.kd_nm_s_per_rad,
    ));
    say::line(format!("hash {}", summary.hash));
    let joints = summary
        .actuated
        .iter()
        .zip(model.nominal_pos_rad())
        .zip(model.joint_limits_rad());
    let row =
        |(index, ((name, nominal), (lower, upper))): (usize, ((&&str, &f64), &(f64, f64)))| {
            let degrees = |x: &f64| format!("{:.1}", x.to_degrees());
            let angles = [nominal, lower, upper].map(degrees);
            [vec![index.to_string(), (*name).to_owned()], angles.to_vec()].concat()
        };
    let head = ["#", "joint", "nominal °", "lower °", "upper °"];
    say::table(&head, joints.enumerate().map(row));
}
