//! `caudata robot-model`: what a robot file says.

use std::path::{Path, PathBuf};

use caudata_model::{ModelError, RobotModel};
use caudata_telemetry::{ExitCode, Failure};
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
    if *json {
        say::json(&Summary::of(&model))
    } else {
        print(&model)
    }
}

/// Reads a robot file; the failure says whether it is missing or wrong.
pub fn load(path: &Path) -> Result<RobotModel, Failure> {
    RobotModel::load(path).map_err(|error| {
        let code = match &error {
            ModelError::Read { .. } => ExitCode::NoInput,
            _ => ExitCode::BadInput,
        };
        Failure::new(code, error).context(format!("robot file {}", path.display()))
    })
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

fn print(model: &RobotModel) -> Result<(), Failure> {
    let summary = Summary::of(model);
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
    let mut rows = vec![
        ["#", "joint", "nominal °", "lower °", "upper °"]
            .map(String::from)
            .to_vec(),
    ];
    let joints = summary
        .actuated
        .iter()
        .zip(model.nominal_pos_rad())
        .zip(model.joint_limits_rad());
    for (index, ((name, nominal), (lower, upper))) in joints.enumerate() {
        let degrees = |x: f64| format!("{:.1}", x.to_degrees());
        let angles = [*nominal, *lower, *upper].map(degrees);
        rows.push([vec![index.to_string(), (*name).to_owned()], angles.to_vec()].concat());
    }
    say::table(&rows);
    Ok(())
}
