//! `caudata gap apply`: what a diagnosis found, merged into a robot file.

use std::path::PathBuf;

use caudata_gap::extension;
use caudata_studies::diagnosis::{EXTENDED, REPORT, robot_files};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure};
use clap::Args;
use serde_json::json;

use crate::say;

#[derive(Debug, Args)]
pub struct ApplyArgs {
    /// Robot file to extend
    #[arg(long, value_name = "R.robot.toml")]
    robot: PathBuf,
    /// Folder that `caudata gap diagnose` wrote
    #[arg(long, value_name = "DIR")]
    diagnosis: PathBuf,
    /// The extended robot file; the MJCF goes beside it
    #[arg(long, value_name = "NEW.robot.toml")]
    out: PathBuf,
    /// Extend a robot file that is not the one that was diagnosed
    #[arg(long)]
    force: bool,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

pub fn run(args: &ApplyArgs) -> Result<(), Failure> {
    let robot = files::robot(&args.robot)?;
    let (robot_toml, mjcf_name, mjcf) = robot_files(&args.robot)?;
    let extended = args.diagnosis.join(EXTENDED);
    if args.diagnosis.join(REPORT).is_file() && !extended.is_file() {
        let message = "this diagnosis refused its data, or found no model that is nearer than the robot as given: take that one";
        return Err(Failure::message(ExitCode::NoInput, message));
    }
    let found = files::robot(&extended)?;
    let Some(extension) = found.extension() else {
        return Err(Failure::message(
            ExitCode::BadInput,
            format!("{} holds no extension", args.diagnosis.display()),
        ));
    };
    if extension.base != robot.hash_hex() && !args.force {
        let message = format!(
            "the diagnosis is of another robot file (hash {:.12}, this one {:.12})",
            extension.base,
            robot.hash_hex()
        );
        return Err(
            Failure::message(ExitCode::BadInput, message).hint("diagnose this one, or say --force")
        );
    }
    let text = String::from_utf8_lossy(&robot_toml);
    let extended =
        extension::append(extension, &text).map_err(|e| Failure::new(ExitCode::BadInput, e))?;
    files::write(&args.out, extended)?;
    let beside = args.out.with_file_name(&mjcf_name);
    // in the robot's own folder it is there already
    if std::fs::read(&beside).ok().as_deref() != Some(&mjcf[..]) {
        if beside.exists() {
            return Err(Failure::message(
                ExitCode::CannotCreate,
                format!("{} is another file of that name", beside.display()),
            )
            .hint("choose another folder for --out"));
        }
        files::write(&beside, &mjcf)?;
    }
    let made = files::robot(&args.out)?;
    let effects: Vec<&str> = extension.effect.iter().map(|e| e.id.as_str()).collect();
    if args.json {
        return say::json(
            &json!({ "robot": args.out, "hash": made.hash_hex(), "effects": effects, "parameters": extension.lane }),
        );
    }
    let out = args.out.display();
    let found = extension.effect.iter().filter(|e| e.confidence > 0.0).count();
    let (effects, lane) = (effects.len(), extension.lane.len());
    say::line(match effects {
        0 => format!("{out}: the robot as given, nothing was found that it lacks"),
        _ => format!(
            "{out}: {effects} effect(s), of which {found} have a name in the report; {lane} parameter(s) of the simulator"
        ),
    });
    Ok(())
}
