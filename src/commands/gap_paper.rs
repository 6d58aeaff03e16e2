//! `caudata gap paper`: the pipeline of the paper, from logs to pictures, on logs of a simulated robot.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_config::ConfigArgs;
use caudata_gap::{GoOn, Role, Run, extension, page};
use caudata_gap_benchmark::paper::{self, Pictures, Row};
use caudata_gap_benchmark::salamander::{self, LabFile, SalamanderPlan};
use caudata_gap_benchmark::truth::free::Channels;
use caudata_runlog::{BaseHold, RunLog};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process, StopFlag};
use clap::Args;

use super::gap_policies::{self, Effort, Given, Robots};
use super::out_folder::{OutFolder, write_whole};
use super::steps::{Steps, own};
use crate::say;

/// Folder of the logs and of the robot file as a lab has it.
const LOGS: &str = "logs";
/// The same while they are made.
const PART: &str = "logs.part";
/// The robot that was recorded, beside them.
const TRUTH: &str = "truth.robot.toml";
/// Runs whose name begins so are held out, and drawn.
const HELD_OUT_WALK: &str = "holdout_walk";

#[derive(Debug, Args)]
pub struct PaperArgs {
    /// Folder for logs, diagnosis, extended robot file and pictures
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Seed of the lab's day: friction, noise, supply
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Threads; the result does not depend on it
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: u32,
    /// Ends with the pictures: no policies are trained
    #[arg(long)]
    no_policies: bool,
    #[command(flatten)]
    effort: Effort,
    /// How policies are trained; without these flags the preset flat
    #[command(flatten)]
    config: ConfigArgs,
}

pub fn run(args: &PaperArgs, process: &Process) -> Result<(), Failure> {
    let logs = args.out.join(LOGS);
    if logs.exists() {
        let message = format!("{} is there already; choose another folder", logs.display());
        return Err(Failure::message(ExitCode::CannotCreate, message)
            .hint("trainings that were stopped go on with `caudata gap policies`"));
    }
    // Hours before the trainings that need it.
    let given = Given::read(&args.effort, &args.config)?;
    let _taken = OutFolder::lock(&args.out)?;
    let mut steps = Steps::new(false, &process.stop);
    let what = format!("logs of a simulated robot into {}", logs.display());
    steps.inside("record", &what, |stop| make(args, stop))?;
    let diagnosis = args.out.join("diagnosis");
    let mut command = own("gap")?;
    command.arg("diagnose").arg("--robot").arg(robot(&logs));
    for folder in folders(&logs)? {
        let held = name(&folder).starts_with("holdout");
        command
            .arg(if held { "--holdout" } else { "--log" })
            .arg(folder);
    }
    command.args(["--threads", &args.threads.to_string(), "--out"]);
    command.arg(&diagnosis);
    // whatever the verdict is, there are pictures to look at
    steps.run("diagnose", &mut command, &[0, 80, 81, 82, 83])?;

    let model = Arc::new(super::robot_model::load(&robot(&logs))?);
    let extended_file = diagnosis.join("extended.robot.toml");
    let text = std::fs::read_to_string(&extended_file).or_exit(ExitCode::NoInput)?;
    let extended = match extension::read(&text).or_exit(ExitCode::BadInput)? {
        Some(found) => extension::terms(&found, &model).or_exit(ExitCode::BadInput)?,
        None => Vec::new(),
    };
    let runs = walks(&logs)?;
    let pictures = steps.inside("draw", "held-out walks in both models", |stop| {
        let stop = stop.clone();
        let go_on = GoOn::as_long_as(move || !stop.is_set());
        let threads = args.threads as usize;
        paper::pictures(&model, extended, &runs, threads, go_on).or_exit(ExitCode::BadInput)
    })?;
    let file = args.out.join("paper.html");
    let draw = |chapters: &[page::Chapter]| {
        let title = "The paper's robot, measured and simulated";
        let html = page::curves(title, &lead(&pictures), &pictures.overlays, chapters);
        write_whole(&file, html.as_bytes())
    };
    // Pictures first: trainings take longer, and may be stopped.
    draw(&[])?;
    show(&pictures);
    if !args.no_policies {
        let robots = Robots {
            given: &robot(&logs),
            extended: &extended_file,
            truth: &args.out.join(TRUTH),
        };
        let folder = args.out.join("policies");
        steps.after_stop(&format!(
            "go on with the same flags and: caudata gap policies --robot {} --extended {} --truth {} --out {}",
            robots.given.display(),
            robots.extended.display(),
            robots.truth.display(),
            folder.display()
        ));
        let compared = gap_policies::compare(&robots, &folder, &args.effort, &given, steps)?;
        gap_policies::tables(&compared);
        draw(&[gap_policies::chapter(&compared)])?;
    }
    say::line(format!("pictures   {}", file.display()));
    say::line(format!(
        "report     {}",
        diagnosis.join("report.html").display()
    ));
    Ok(())
}

/// Writes the logs, whole or not at all, and, beside them, the robot that they come from.
fn make(args: &PaperArgs, stop: &StopFlag) -> Result<(), Failure> {
    let plan = SalamanderPlan {
        name: PART.to_owned(),
        file: LabFile::Stiff,
        place: BaseHold::Free,
        hidden: paper::HIDDEN,
        channels: Channels {
            imu: true,
            mocap: true,
        },
        seed: args.seed,
        repeats: 2,
    };
    let part = args.out.join(PART);
    let cannot = || format!("cannot write {}", part.display());
    if part.exists() {
        // of a call that was stopped
        std::fs::remove_dir_all(&part).or_exit_with(ExitCode::CannotCreate, cannot)?;
    }
    let go_on = || !stop.is_set();
    salamander::make(&plan, &args.out, &go_on).or_exit(ExitCode::Internal)?;
    paper::on_stand(plan.file, plan.seed, &part, &go_on).or_exit(ExitCode::Internal)?;
    let (_, mjcf, _) = salamander::lab_file(LabFile::Stiff).or_exit(ExitCode::Internal)?;
    let truth =
        salamander::true_salamander(LabFile::Stiff, paper::HIDDEN).or_exit(ExitCode::Internal)?;
    write_whole(&args.out.join("polymander.xml"), mjcf.as_bytes())?;
    write_whole(&args.out.join(TRUTH), truth.as_bytes())?;
    std::fs::rename(&part, args.out.join(LOGS)).or_exit_with(ExitCode::CannotCreate, cannot)
}

fn robot(logs: &Path) -> PathBuf {
    logs.join("polymander.robot.toml")
}

fn name(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

fn folders(logs: &Path) -> Result<Vec<PathBuf>, Failure> {
    super::gap::log_folders(&[logs.to_owned()])
}

/// The held-out walks.
fn walks(logs: &Path) -> Result<Vec<Run>, Failure> {
    folders(logs)?
        .into_iter()
        .filter(|folder| name(folder).starts_with(HELD_OUT_WALK))
        .map(|folder| {
            Ok(Run {
                log: RunLog::read(&folder).or_exit(ExitCode::BadInput)?,
                name: name(&folder),
                role: Role::Holdout,
                sha256: String::new(),
            })
        })
        .collect()
}

/// Rows of the three tables: what, unit, factor to that unit, rows.
fn tables(pictures: &Pictures) -> Vec<(&'static str, &'static str, f64, Vec<Row>)> {
    let mut worst = pictures.joints.clone();
    worst.sort_by(|a, b| b.before.total_cmp(&a.before));
    worst.truncate(6);
    vec![
        ("joint off its measured position, rms", "mrad", 1e3, worst),
        (
            "height that a foot reaches",
            "mm",
            1e3,
            pictures.feet.clone(),
        ),
        (
            "speed over ground",
            "m/s",
            1.0,
            pictures.speed.iter().cloned().collect(),
        ),
    ]
}

fn cells(row: &Row, factor: f64) -> [String; 3] {
    let text = |x: f64| format!("{:.3}", x * factor);
    [
        row.measured.map_or_else(String::new, text),
        text(row.before),
        text(row.after),
    ]
}

fn show(pictures: &Pictures) {
    for (what, unit, factor, rows) in tables(pictures) {
        let head = [
            format!("{what}, {unit}"),
            "measured".into(),
            "as given".into(),
            "extended".into(),
        ];
        let mut table = vec![head.to_vec()];
        for row in &rows {
            let [measured, before, after] = cells(row, factor);
            table.push(vec![row.of.clone(), measured, before, after]);
        }
        say::line("");
        say::table(&table);
    }
}

/// The tables as HTML. Names are those of the robot file that this program holds.
fn lead(pictures: &Pictures) -> String {
    let mut html = String::from(
        "<p class=\"soft\">Held-out walks of a simulated robot (another engine) with play of 4° at the girdles, a command low-pass and a weaker servo; each stretch of two seconds begins as measured.</p>",
    );
    for (what, unit, factor, rows) in tables(pictures) {
        let _ = write!(
            html,
            "<table><thead><tr><th>{what}, {unit}</th><th>measured</th><th>as given</th><th>extended</th></tr></thead><tbody>"
        );
        for row in &rows {
            let [measured, before, after] = cells(row, factor);
            let _ = write!(
                html,
                "<tr><td>{}</td><td>{measured}</td><td>{before}</td><td>{after}</td></tr>",
                row.of
            );
        }
        html.push_str("</tbody></table>");
    }
    html
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_say_what_was_measured() {
        let row = |of: &str, measured| Row {
            of: of.to_owned(),
            measured,
            before: 0.02,
            after: 0.0125,
        };
        let pictures = Pictures {
            joints: vec![row("FL_hip", None)],
            feet: vec![row("FL", Some(0.031))],
            speed: None,
            overlays: Vec::new(),
        };
        let html = lead(&pictures);
        assert!(
            html.contains("<tr><td>FL_hip</td><td></td><td>20.000</td><td>12.500</td></tr>"),
            "{html}"
        );
        assert!(
            html.contains("<tr><td>FL</td><td>31.000</td><td>20.000</td><td>12.500</td></tr>"),
            "{html}"
        );
    }
}
