//! `caudata robot`: what a robot file says.

use std::path::PathBuf;
use std::sync::Arc;

use caudata_config::{Config, ConfigArgs};
use caudata_model::RobotModel;
use caudata_model::import::{self, ImportError, ImportOptions};
use caudata_sim::{EngineConfig, TerrainConfig};
use caudata_task::{PolicyContract, TaskConfig};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;
use serde::Serialize;

use crate::say;

#[derive(Debug, Subcommand)]
pub enum RobotCommand {
    /// Read a robot file and its MJCF, check them, and print a summary
    Check {
        /// The robot file
        #[arg(value_name = "FILE.robot.toml")]
        file: PathBuf,
        /// One JSON object instead of a table
        #[arg(long)]
        json: bool,
    },
    /// Make a robot file and an MJCF out of any MJCF or URDF; what cannot be had is refused, all at once
    Import(ImportArgs),
    /// Write a robot for tools that read another format
    Export {
        /// The robot file
        #[arg(value_name = "FILE.robot.toml")]
        file: PathBuf,
        /// The URDF to write
        #[arg(long, value_name = "FILE.urdf")]
        urdf: PathBuf,
    },
}

#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// The MJCF or URDF
    #[arg(value_name = "FILE.xml|FILE.urdf")]
    file: PathBuf,
    /// Folder for NAME.robot.toml and NAME.xml
    #[arg(long, value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// Name of the robot [default: the file's own]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Whether the base moves; only a URDF needs to be told [default: free if several chains hang on it]
    #[arg(long, value_enum, value_name = "WORD")]
    base: Option<BaseWord>,
    /// Overwrite files that are there
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
enum BaseWord {
    Free,
    Fixed,
}

pub fn run(command: &RobotCommand) -> Result<(), Failure> {
    match command {
        RobotCommand::Check { file, json } => {
            let model = load(file)?;
            check(&model)
                .map_err(|failure| failure.context(format!("robot file {}", file.display())))?;
            say::either(*json, &Summary::of(&model), |summary| {
                print(&model, summary)
            })
        }
        RobotCommand::Import(args) => import(args),
        RobotCommand::Export { file, urdf } => {
            let text = load(file)?.to_urdf();
            std::fs::write(urdf, text).or_exit_with(ExitCode::IoError, || {
                format!("cannot write {}", urdf.display())
            })?;
            say::line(format!("wrote {}", urdf.display()));
            Ok(())
        }
    }
}

/// What training asks of a robot beyond that its files are right.
fn check(model: &RobotModel) -> Result<(), Failure> {
    caudata_sim::check_extension(model).or_exit(ExitCode::BadInput)?;
    let (engine, terrain) = (EngineConfig::default(), TerrainConfig::default());
    let robot = Arc::new(model.clone());
    caudata_sim::build(robot, 1, &engine, &terrain, 0, 1).or_exit(ExitCode::BadInput)?;
    let contract = PolicyContract::new(model, &TaskConfig::default());
    contract.or_exit(ExitCode::BadInput)?;
    Ok(())
}

fn import(args: &ImportArgs) -> Result<(), Failure> {
    let options = ImportOptions {
        name: args.name.clone(),
        free_base: args.base.map(|word| word == BaseWord::Free),
    };
    let made = match import::import(&args.file, &options) {
        Err(ImportError::Refused(all)) => {
            all.iter()
                .for_each(|remark| say::line(format!("refused: {remark}")));
            let count = all.len();
            let message = format!("{}: {count} refused", args.file.display());
            let hint = "each is said above, with what to do";
            return Err(Failure::message(ExitCode::BadInput, message).hint(hint));
        }
        other => other.or_exit(ExitCode::BadInput)?,
    };
    for note in &made.notes {
        say::line(format!("note: {note}"));
    }
    let files = [
        (format!("{}.xml", made.name), &made.mjcf),
        (format!("{}.robot.toml", made.name), &made.robot_toml),
    ];
    for (name, text) in files {
        let path = args.out.join(name);
        if path.exists() && !args.force {
            let why = format!("{} is there already", path.display());
            return Err(Failure::message(ExitCode::BadInput, why).hint("--force overwrites it"));
        }
        std::fs::write(&path, text).or_exit_with(ExitCode::IoError, || {
            format!("cannot write {}", path.display())
        })?;
        say::line(format!("wrote {}", path.display()));
    }
    Ok(())
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
    /// One per actuated joint.
    kp_nm_per_rad: Vec<f64>,
    /// One per actuated joint.
    kd_nm_s_per_rad: Vec<f64>,
    /// One per actuated joint.
    servos: Vec<&'a str>,
    feet: Vec<&'a str>,
    imu: Option<&'a str>,
    /// Why it cannot be trained to walk; `None` where it can.
    cannot_walk: Option<String>,
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
            kp_nm_per_rad: model.gains().iter().map(|g| g.kp_nm_per_rad).collect(),
            kd_nm_s_per_rad: model.gains().iter().map(|g| g.kd_nm_s_per_rad).collect(),
            servos: (0..model.actuated().len())
                .map(|a| model.servo_name(a))
                .collect(),
            feet: model.feet().iter().map(|foot| foot.name.as_str()).collect(),
            imu: model
                .imu_site()
                .map(|site| model.links()[site.link].name.as_str()),
            cannot_walk: caudata_config::can_walk(model)
                .err()
                .map(|error| error.to_string()),
        }
    }
}

fn print(model: &RobotModel, summary: &Summary<'_>) {
    say::line(format!(
        "{}: {} links, {} joints ({} actuated), {:.3} kg, {:.1} V",
        summary.name,
        summary.links,
        summary.joints,
        summary.actuated.len(),
        summary.total_mass_kg,
        summary.supply_v,
    ));
    say::line(format!(
        "feet: {}; IMU: {}",
        or_none(&summary.feet.join(", ")),
        summary
            .imu
            .map_or("none".to_owned(), |link| format!("on {link}")),
    ));
    say::line(format!("hash {}", summary.hash));
    if let Some(why) = &summary.cannot_walk {
        say::line(format!("no preset trains it: {why}"));
    }
    let row = |(index, name): (usize, &&str)| {
        let (lower, upper) = model.joint_limits_rad()[index];
        let degrees = |x: f64| format!("{:.1}", x.to_degrees());
        let angles = [model.nominal_pos_rad()[index], lower, upper].map(degrees);
        let gains = [summary.kp_nm_per_rad[index], summary.kd_nm_s_per_rad[index]];
        let own = vec![index.to_string(), (*name).to_owned()];
        let servo = vec![summary.servos[index].to_owned()];
        [
            own,
            angles.to_vec(),
            gains.map(|g| g.to_string()).to_vec(),
            servo,
        ]
        .concat()
    };
    let head = [
        "#",
        "joint",
        "nominal °",
        "lower °",
        "upper °",
        "kp N·m/rad",
        "kd N·m·s/rad",
        "servo",
    ];
    say::table(&head, summary.actuated.iter().enumerate().map(row));
}

fn or_none(list: &str) -> &str {
    if list.is_empty() { "none" } else { list }
}
