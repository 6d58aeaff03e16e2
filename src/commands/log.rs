//! `caudata log`: logs in the forms that people's tools open.

use std::cell::RefCell;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use caudata_gap::import::bam;
use caudata_model::{Pose, RobotModel};
use caudata_runlog::ros::{Compression, Frame, Scene, write_mcap};
use caudata_runlog::{
    Axis, LogError, LogMeta, LogWriter, META_NAME, QuatPart, RunLog, Signal, Table, TableWriter,
    meta_file, read_rows,
};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand, ValueEnum};
use serde_json::json;

use crate::commands::log_sample::sample;
use crate::say;

/// Time between two flushes, s of log time: the rows of a conversion are there already.
const FLUSH_S: f64 = 60.0;
/// The frame outside of all others.
const WORLD: &str = "world";

#[derive(Debug, Subcommand)]
pub enum LogCommand {
    /// Turn a log into MCAP for Foxglove, RViz, PlotJuggler and rerun, into Parquet, CSV or BAM
    Convert(ConvertArgs),
    /// Run an environment of a training under its newest policy, with all that befalls it there, as a log
    Sample(SampleArgs),
}

#[derive(Debug, Args)]
pub struct ConvertArgs {
    /// A log folder, a CSV file of a rollout, an MCAP file of ROS 2, or a Parquet file with a log's columns
    #[arg(value_name = "LOG")]
    log: PathBuf,
    /// Robot file, for the robot's description and its frames; default: what the log names, where it is found
    #[arg(long, value_name = "FILE.robot.toml")]
    robot: Option<PathBuf>,
    #[command(flatten)]
    to: Destination,
}

#[derive(Debug, Args)]
pub struct SampleArgs {
    /// The folder of the training, which may go on meanwhile
    #[arg(value_name = "RUN")]
    run: PathBuf,
    /// How long, s of the robot's time
    #[arg(long, value_name = "S", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=600))]
    seconds: u32,
    #[command(flatten)]
    to: Destination,
}

/// Where rows go, and how.
#[derive(Debug, Args)]
pub struct Destination {
    /// Where it goes: a FILE.mcap, a FILE.parquet, a FILE.csv, a FILE.json (BAM: one servo that swings a weight), or
    /// else a log folder (log.csv and log.toml)
    #[arg(long, value_name = "OUT")]
    out: PathBuf,
    /// When the run began, for the stamps in MCAP: seconds since 1970
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=2_000_000_000))]
    start: u32,
    /// How MCAP is packed
    #[arg(long, value_enum, default_value_t = Packing::Zstd)]
    packing: Packing,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// How an MCAP file is packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Packing {
    /// Small
    Zstd,
    /// Quick
    Lz4,
    /// Not at all: whatever begins of the file can be read
    None,
}

pub fn run(command: &LogCommand) -> Result<(), Failure> {
    let args = match command {
        LogCommand::Convert(args) => args,
        LogCommand::Sample(args) => {
            let (log, robot, notes) = sample(&args.run, args.seconds)?;
            return args.to.write(&args.run, Some(&log.meta), &log.table, Some(&robot), notes);
        }
    };
    let (meta, table) = read(&args.log)?;
    let mut notes = table.notes().to_vec();
    let robot = match extension(&args.to.out) {
        "mcap" => robot(args, meta.as_ref(), &mut notes)?,
        _ => None,
    };
    args.to.write(&args.log, meta.as_ref(), &table, robot.as_ref(), notes)
}

impl Destination {
    /// Writes rows that are `from` there.
    fn write(
        &self,
        from: &Path,
        meta: Option<&LogMeta>,
        table: &Table,
        robot: Option<&RobotModel>,
        notes: Vec<String>,
    ) -> Result<(), Failure> {
        if let (Ok(from), Ok(out)) = (from.canonicalize(), self.out.canonicalize())
            && from == out
        {
            let message = format!("--out {} is what is read", self.out.display());
            return Err(Failure::message(ExitCode::CannotCreate, message)
                .hint("give another --out: the new form may hold less than the old one"));
        }
        if let Some(folder) = self.out.parent() {
            files::make_folder(folder)?;
        }
        match extension(&self.out) {
            "mcap" => files::write(&self.out, mcap(self, table, robot)?)?,
            "json" => files::write(&self.out, bam(from, meta, table)?)?,
            form @ ("csv" | "parquet") => {
                match form {
                    "csv" => csv(&self.out, table)?,
                    _ => {
                        files::writable(&self.out)?;
                        table.to_parquet(&self.out).or_exit(ExitCode::Unavailable)?;
                    }
                }
                if let Some(meta) = meta {
                    let text = meta.to_toml().or_exit(ExitCode::Internal)?;
                    files::write(&self.out.with_extension("toml"), text)?;
                }
            }
            // a mistaken form, and not a folder called run.2 or walk_0.3
            other if is_word(other) && !self.out.is_dir() => return Err(no_such_form(other)),
            _ => folder(&self.out, from, meta, table)?,
        }
        let (rows, signals) = (table.len(), table.signals().len());
        let made = json!({ "out": self.out, "rows": rows, "signals": signals, "notes": notes });
        say::either(self.json, &made, |_| {
            for note in &notes {
                say::line(format!("note: {note}"));
            }
            let out = self.out.display();
            say::line(format!("{rows} rows of {signals} signals are in {out}"));
        })
    }
}

fn is_word(ending: &str) -> bool {
    !ending.is_empty() && ending.chars().all(char::is_alphabetic)
}

fn no_such_form(ending: &str) -> Failure {
    let message = format!("a log is not written as .{ending}");
    Failure::message(ExitCode::BadConfig, message)
        .hint("end --out with .mcap, .parquet, .csv or .json (BAM); a name without an ending is a log folder")
}

fn bam(log: &Path, meta: Option<&LogMeta>, table: &Table) -> Result<String, Failure> {
    let known = meta.ok_or_else(|| "it says nothing of the run's circumstances".to_owned());
    let text = known.and_then(|meta| bam::text(meta, table));
    text.map_err(|why| {
        let message = format!("{} cannot be said in BAM: {why}", log.display());
        Failure::message(ExitCode::BadInput, message)
    })
}

/// What the folder of a training has.
const RUN_ID: &str = "run_id.txt";

fn extension(path: &Path) -> &str {
    path.extension().and_then(|x| x.to_str()).unwrap_or("")
}

/// The rows of whatever is given, and its circumstances where they are known.
fn read(path: &Path) -> Result<(Option<LogMeta>, Table), Failure> {
    if path.is_dir() {
        if path.join(RUN_ID).is_file() {
            let message = format!("{} is the folder of a training", path.display());
            let hint = format!("its robot's log is {}", path.join("robot").display());
            return Err(Failure::message(ExitCode::NoInput, message).hint(hint));
        }
    } else if !meta_file(path).is_file() {
        let table = read_rows(path).map_err(|error| wrong(error, path))?;
        return Ok((None, table));
    }
    let log = RunLog::read(path).map_err(|error| wrong(error, path))?;
    Ok((Some(log.meta), log.table))
}

fn wrong(error: LogError, path: &Path) -> Failure {
    let code = match &error {
        LogError::Python { .. } => ExitCode::Unavailable,
        _ if path.exists() => ExitCode::BadInput,
        _ => ExitCode::NoInput,
    };
    Failure::new(code, error)
}

fn csv(out: &Path, table: &Table) -> Result<(), Failure> {
    let file = File::create(out)
        .or_exit_with(ExitCode::CannotCreate, || format!("cannot make {}", out.display()))?;
    let mut writer = TableWriter::new(BufWriter::new(file), table.signals(), FLUSH_S)
        .or_exit(ExitCode::IoError)?;
    for (k, t_s) in table.time_s().iter().enumerate() {
        let row = table.row(k).unwrap_or_default();
        writer.row(*t_s, &row).or_exit(ExitCode::IoError)?;
    }
    writer.flush().or_exit(ExitCode::IoError)
}

fn folder(out: &Path, log: &Path, meta: Option<&LogMeta>, table: &Table) -> Result<(), Failure> {
    let Some(meta) = meta else {
        let message = format!(
            "{} says nothing of the run's circumstances, which a log folder has",
            log.display()
        );
        let hint = format!(
            "write {META_NAME} into a folder with the file, and give the folder; or --out FILE.csv"
        );
        return Err(Failure::message(ExitCode::BadInput, message).hint(hint));
    };
    if out.join(RUN_ID).is_file() {
        let message = format!("{} is the folder of a training", out.display());
        return Err(Failure::message(ExitCode::CannotCreate, message).hint("give another --out"));
    }
    let cannot = |error: LogError| Failure::new(ExitCode::CannotCreate, error);
    let mut writer = LogWriter::create(out, table.signals(), meta).map_err(cannot)?;
    for (k, t_s) in table.time_s().iter().enumerate() {
        let row = table.row(k).unwrap_or_default();
        writer.row(*t_s, &row).or_exit(ExitCode::IoError)?;
    }
    writer.finish().or_exit(ExitCode::IoError)
}

/// The robot of a log: its file is named by flag, or by the log.
fn robot(
    args: &ConvertArgs,
    meta: Option<&LogMeta>,
    notes: &mut Vec<String>,
) -> Result<Option<RobotModel>, Failure> {
    if let Some(path) = &args.robot {
        return files::robot(path).map(Some);
    }
    let named = meta.map_or("", |meta| meta.robot.as_str());
    match files::robot_of_log(&args.log, named) {
        Some(path) => files::robot(&path).map(Some),
        None => {
            notes.push(format!(
                "no robot file for `{named}`: the file has no /tf and no /robot_description; give --robot"
            ));
            Ok(None)
        }
    }
}

fn mcap(to: &Destination, table: &Table, robot: Option<&RobotModel>) -> Result<Vec<u8>, Failure> {
    let compression = match to.packing {
        Packing::Zstd => Some(Compression::Zstd),
        Packing::Lz4 => Some(Compression::Lz4),
        Packing::None => None,
    };
    let start_ns = u64::from(to.start) * 1_000_000_000;
    let write = |scene: Option<&Scene<'_>>| {
        write_mcap(table, start_ns, compression, scene).or_exit(ExitCode::BadInput)
    };
    let Some(robot) = robot else { return write(None) };
    let frames = RefCell::new(Frames::new(robot, table)?);
    let description = robot.to_urdf();
    write(Some(&Scene {
        description: &description,
        base: robot.links().first().map_or("base", |link| &link.name),
        frames: &|row| frames.borrow_mut().at(row),
    }))
}

/// Where the links are, row by row. What a row has no sample of stays as it was.
struct Frames<'a> {
    robot: &'a RobotModel,
    table: &'a Table,
    /// Column of each joint's position, model order.
    joints: Vec<Option<&'a [Option<f64>]>>,
    joint_pos_rad: Vec<f64>,
    world_from_base: Pose,
}

impl<'a> Frames<'a> {
    fn new(robot: &'a RobotModel, table: &'a Table) -> Result<Self, Failure> {
        let column = |name: &str| table.column(&Signal::Position(name.to_owned()));
        let nominal = robot.full_pos_rad(robot.nominal_pos_rad());
        Ok(Self {
            joints: robot.joints().iter().map(|j| column(&j.name)).collect(),
            joint_pos_rad: nominal.or_exit(ExitCode::Internal)?,
            world_from_base: Pose::IDENTITY,
            robot,
            table,
        })
    }

    fn at(&mut self, row: usize) -> Vec<Frame> {
        for (position, column) in self.joint_pos_rad.iter_mut().zip(&self.joints) {
            *position = column.and_then(|c| c[row]).unwrap_or(*position);
        }
        let cell = |signal: Signal| self.table.column(&signal).and_then(|c| c[row]);
        if let [Some(x), Some(y), Some(z)] = Axis::ALL.map(|a| cell(Signal::BasePosition(a))) {
            self.world_from_base.pos_m = [x, y, z];
        }
        let quat = QuatPart::ALL.map(|p| cell(Signal::BaseQuaternion(p)));
        if let [Some(w), Some(x), Some(y), Some(z)] = quat {
            self.world_from_base.quat_wxyz = [w, x, y, z];
        }
        // The lengths fit: they are the robot's own.
        let places =
            self.robot.kinematics(&self.world_from_base, &self.joint_pos_rad).unwrap_or_default();
        let frame = |outer: &str, name: &str, pose: Pose| Frame {
            outer: outer.to_owned(),
            name: name.to_owned(),
            position_m: pose.pos_m,
            orientation_wxyz: pose.quat_wxyz,
        };
        let links = self.robot.links();
        let of_link = links.iter().zip(&places.links).map(|(link, place)| {
            match link.parent.map(|p| (&links[p].name, places.links[p])) {
                Some((outer, outer_place)) => {
                    frame(outer, &link.name, outer_place.inverse().compose(place))
                }
                None => frame(WORLD, &link.name, *place),
            }
        });
        let imu = self.robot.imu_site();
        let imu = imu.map(|site| frame(&links[site.link].name, "imu", site.link_from_site));
        of_link.chain(imu).collect()
    }
}
