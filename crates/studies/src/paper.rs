//! The pipeline of the paper, from logs to pictures, on logs of a simulated robot.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use caudata_gap::report::Verdict;
use caudata_gap::{GoOn, Role, Run, extension, page};
use caudata_gap_benchmark::paper::{self, Pictures, Row};
use caudata_gap_benchmark::salamander::{self, LabFile, SalamanderPlan};
use caudata_gap_benchmark::truth::free::Channels;
use caudata_runlog::{BaseHold, RunLog};
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag};
use clap::Args;

use crate::diagnosis::{self, logs_at};
use crate::out_folder::OutFolder;
use crate::policies::{self, Compared, Effort, Given, Robots};
use crate::{Steps, Table, files};

/// Folder of the logs and of the robot file as a lab has it.
const LOGS: &str = "logs";
/// The same while they are made.
const PART: &str = "logs.part";
/// The robot that was recorded, beside them.
const TRUTH: &str = "truth.robot.toml";
/// Runs whose name begins so are held out, and drawn.
const HELD_OUT_WALK: &str = "holdout_walk";

/// What to record and diagnose.
#[derive(Clone, Debug, Args)]
pub struct Plan {
    /// Folder for logs, diagnosis, extended robot file and pictures
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Seed of the lab's day: friction, noise, supply
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Threads; the result does not depend on it
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: u32,
}

/// What was drawn, and what goes on from there. The folder is this process's as long as it lives.
pub struct Drawn {
    pictures: Pictures,
    robots: Robots,
    folder: PathBuf,
    /// The page with the pictures.
    pub page: PathBuf,
    /// The page of the diagnosis.
    pub report: PathBuf,
    _taken: OutFolder,
}

/// Records a simulated robot, diagnoses the logs, and draws held-out walks in both models.
///
/// # Errors
/// Where logs are there already, a file cannot be read or written, or a step fails or is stopped.
pub fn draw(plan: &Plan, steps: &mut Steps<'_>) -> Result<Drawn, Failure> {
    let logs = plan.out.join(LOGS);
    if logs.exists() {
        let message = format!("{} is there already; choose another folder", logs.display());
        return Err(Failure::message(ExitCode::CannotCreate, message)
            .hint("trainings that were stopped go on with `caudata gap policies`"));
    }
    let taken = OutFolder::lock(&plan.out)?;
    let what = format!("logs of a simulated robot into {}", logs.display());
    steps.run("record", &what, |stop, _| make(plan, stop))?;
    let folders = logs_at(std::slice::from_ref(&logs))?;
    let held = |folder: &PathBuf| name(folder).starts_with("holdout");
    let (holdouts, fit) = folders.iter().cloned().partition(held);
    let diagnosis = diagnosis::Plan {
        robot: logs.join("polymander.robot.toml"),
        logs: fit,
        holdouts,
        out: plan.out.join("diagnosis"),
        without: Vec::new(),
        only: Vec::new(),
        threads: Some(plan.threads as usize),
        seed: 1,
        budget: None,
    };
    // Whatever else the verdict is, there are pictures to look at.
    let report = steps.diagnose("diagnose", &diagnosis)?;
    if report.verdict == Verdict::DataFault {
        return Err(Failure::outcome(ExitCode::DataFault, report.summary));
    }
    let robots = Robots {
        extended: match diagnosis::carries(&report) {
            true => diagnosis.out.join(diagnosis::EXTENDED),
            false => diagnosis.robot.clone(),
        },
        given: diagnosis.robot,
        truth: plan.out.join(TRUTH),
    };
    let model = Arc::new(files::robot(&robots.given)?);
    let (text, ..) = diagnosis::robot_files(&robots.extended)?;
    let extended = extension::read(&String::from_utf8_lossy(&text)).or_exit(ExitCode::BadInput)?;
    let extended = match extended {
        Some(found) => extension::terms(&found, &model).or_exit(ExitCode::BadInput)?,
        None => Vec::new(),
    };
    let runs = walks(&folders)?;
    let pictures = steps.run("draw", "held-out walks in both models", |stop, _| {
        let stop = stop.clone();
        let go_on = GoOn::as_long_as(move || !stop.is_set());
        let threads = plan.threads as usize;
        paper::pictures(&model, extended, &runs, threads, go_on).or_exit(ExitCode::BadInput)
    })?;
    let drawn = Drawn {
        pictures,
        robots,
        folder: plan.out.join("policies"),
        page: plan.out.join("paper.html"),
        report: diagnosis.out.join("report.html"),
        _taken: taken,
    };
    // Pictures first: trainings take longer, and may be stopped.
    drawn.write(&[])?;
    Ok(drawn)
}

impl Drawn {
    /// What was measured, in the model as given, and in the extended one.
    pub fn tables(&self) -> Vec<Table> {
        tables(&self.pictures)
    }

    /// Trains policies without and with what was found, runs them on the robot, and puts them on the page.
    ///
    /// # Errors
    /// As [`policies::compare`].
    pub fn train(
        &self,
        effort: &Effort,
        given: &Given,
        mut steps: Steps<'_>,
    ) -> Result<Compared, Failure> {
        let Robots { given: robot, extended, truth } = &self.robots;
        steps.after_stop(&format!(
            "go on with the same flags and: caudata gap policies --robot {} --extended {} --truth {} --out {}",
            robot.display(),
            extended.display(),
            truth.display(),
            self.folder.display()
        ));
        let compared = policies::compare(&self.robots, &self.folder, effort, given, steps)?;
        self.write(&[policies::chapter(&compared)])?;
        Ok(compared)
    }

    fn write(&self, chapters: &[page::Chapter]) -> Result<(), Failure> {
        let title = "The paper's robot, measured and simulated";
        let lead = lead(&self.pictures);
        let html = page::curves(title, &lead, &self.pictures.overlays, chapters);
        files::write_whole(&self.page, html.as_bytes())
    }
}

/// Writes the logs, whole or not at all, and, beside them, the robot that they come from.
fn make(plan: &Plan, stop: &StopFlag) -> Result<(), Failure> {
    let lab = SalamanderPlan {
        name: PART.to_owned(),
        file: LabFile::Stiff,
        place: BaseHold::Free,
        hidden: paper::HIDDEN,
        channels: Channels { imu: true, mocap: true },
        seed: plan.seed,
        repeats: 2,
    };
    let part = plan.out.join(PART);
    let cannot = || format!("cannot write {}", part.display());
    if part.exists() {
        // of a call that was stopped
        std::fs::remove_dir_all(&part).or_exit_with(ExitCode::CannotCreate, cannot)?;
    }
    let go_on = || !stop.is_set();
    salamander::make(&lab, &plan.out, &go_on).or_exit(ExitCode::Internal)?;
    paper::on_stand(lab.file, lab.seed, &part, &go_on).or_exit(ExitCode::Internal)?;
    let (_, mjcf, _) = salamander::lab_file(LabFile::Stiff).or_exit(ExitCode::Internal)?;
    let truth =
        salamander::true_salamander(LabFile::Stiff, paper::HIDDEN).or_exit(ExitCode::Internal)?;
    files::write_whole(&plan.out.join("polymander.xml"), mjcf.as_bytes())?;
    files::write_whole(&plan.out.join(TRUTH), truth.as_bytes())?;
    std::fs::rename(&part, plan.out.join(LOGS)).or_exit_with(ExitCode::CannotCreate, cannot)
}

fn name(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

/// The held-out walks.
fn walks(folders: &[PathBuf]) -> Result<Vec<Run>, Failure> {
    let walks = folders.iter().filter(|folder| name(folder).starts_with(HELD_OUT_WALK));
    walks
        .map(|folder| {
            Ok(Run {
                log: RunLog::read(folder).or_exit(ExitCode::BadInput)?,
                name: name(folder),
                role: Role::Holdout,
                sha256: String::new(),
            })
        })
        .collect()
}

fn tables(pictures: &Pictures) -> Vec<Table> {
    let table = |of: &str, factor: f64, rows: &[Row]| {
        let text = |x: f64| format!("{:.3}", x * factor);
        let cells = |row: &Row| {
            let measured = row.measured.map_or_else(String::new, text);
            vec![row.of.clone(), measured, text(row.before), text(row.after)]
        };
        Table {
            head: [of, "measured", "as given", "extended"].map(str::to_owned).to_vec(),
            rows: rows.iter().map(cells).collect(),
        }
    };
    let mut worst = pictures.joints.clone();
    worst.sort_by(|a, b| b.before.total_cmp(&a.before));
    worst.truncate(6);
    vec![
        table("joint off its measured position, rms, mrad", 1e3, &worst),
        table("height that a foot reaches, mm", 1e3, &pictures.feet),
        table("speed over ground, m/s", 1.0, pictures.speed.as_slice()),
    ]
}

/// The tables as HTML. Names are those of the robot file that this program holds.
fn lead(pictures: &Pictures) -> String {
    let mut html = String::from(
        "<p class=\"soft\">Held-out walks of a simulated robot (another engine) with play of 4° at the girdles, a command low-pass and a weaker servo; each stretch of two seconds begins as measured.</p>",
    );
    html.extend(tables(pictures).iter().map(Table::html));
    html
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tables_say_what_was_measured() {
        let row =
            |of: &str, measured| Row { of: of.to_owned(), measured, before: 0.02, after: 0.0125 };
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
