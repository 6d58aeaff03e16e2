//! Diagnoses one case folder and writes `report.json` into the current folder: `caudata-diagnose-case [--without ID]… [--threads N] CASE`.
//!
//! All that it is given is the folder: a robot file, runs to fit (`fit_*`) and held-out runs (`holdout_*`).

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use caudata_gap::check;
use caudata_gap::{Options, Request, Role, Run};
use caudata_model::RobotModel;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            // the parent reads the last line
            eprintln!("{message}");
            ExitCode::from(65)
        }
    }
}

fn run() -> Result<(), String> {
    let mut options = Options::default();
    let mut folder = None;
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--without" => options.without.push(args.next().ok_or("--without needs an effect id")?),
            "--threads" => {
                let n = args.next().and_then(|n| n.parse().ok());
                options.threads = n.ok_or("--threads needs a number")?;
            }
            _ => folder = Some(PathBuf::from(arg)),
        }
    }
    let folder = folder.ok_or("give a case folder")?;
    let report = diagnose(&folder, options)?;
    std::fs::write("report.json", report).map_err(|e| format!("report.json: {e}"))
}

fn diagnose(folder: &Path, options: Options) -> Result<String, String> {
    let said = |e: &dyn std::fmt::Display| e.to_string();
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)
        .map_err(|e| format!("{}: {e}", folder.display()))?
        .filter_map(|e| Some(e.ok()?.path()))
        .collect();
    entries.sort();
    let robot = entries
        .iter()
        .find(|p| p.to_string_lossy().ends_with(".robot.toml"))
        .ok_or_else(|| format!("{} holds no robot file", folder.display()))?;
    let model = RobotModel::load(robot).map_err(|e| said(&e))?;
    let dirs: Vec<&PathBuf> = entries.iter().filter(|p| p.is_dir()).collect();
    let (logs, checked) = check::check_dirs(&dirs, &model);
    let runs = logs
        .into_iter()
        .map(|(name, log)| Run {
            role: if name.starts_with("holdout") { Role::Holdout } else { Role::Fit },
            name,
            log,
            sha256: String::new(),
        })
        .collect();
    let read = |p: &Path| std::fs::read(p).map_err(|e| format!("{}: {e}", p.display()));
    let robot_toml = read(robot)?;
    let mjcf = entries.iter().find(|p| p.extension().is_some_and(|e| e == "xml"));
    let request = Request {
        robot_toml,
        mjcf: read(mjcf.ok_or_else(|| format!("{} holds no MJCF", folder.display()))?)?,
        label: robot.display().to_string(),
        runs,
        data_faults: checked.faults,
        options,
    };
    let diagnosis = caudata_gap::diagnose(&request, &mut |_| ()).map_err(|e| said(&e))?;
    serde_json::to_string(&diagnosis.report).map_err(|e| said(&e))
}
