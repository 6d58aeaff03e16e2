//! Files that commands read and write, with the exit code of what goes wrong.

use std::path::{Path, PathBuf};

use caudata_config::{Config, Source};
use caudata_durable::{DurableError, shipped};
use caudata_model::{ModelError, RobotModel};
use caudata_policy::PolicyFile;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};

/// The bytes of a file.
///
/// # Errors
/// As [`ExitCode::of_io`] has it for reading.
pub fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    std::fs::read(path).map_err(|error| {
        Failure::new(ExitCode::of_io(&error, false), error)
            .context(format!("cannot read {}", path.display()))
    })
}

/// The value in a JSON file.
///
/// # Errors
/// As [`read`], and exit code 65 where it is something else.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, Failure> {
    serde_json::from_slice(&read(path)?)
        .or_exit_with(ExitCode::BadInput, || path.display().to_string())
}

/// A robot file and its MJCF, checked; a relative path may be that of a robot that came with the program.
///
/// # Errors
/// Exit code 66 where one is missing, 65 where it is wrong.
pub fn robot(path: &Path) -> Result<RobotModel, Failure> {
    if let Some(kind @ ("xml" | "urdf")) = path.extension().and_then(|e| e.to_str()) {
        let kind = if kind == "xml" { "an MJCF" } else { "a URDF" };
        let message = format!("{}: this is {kind}, no robot file", path.display());
        let hint = format!("caudata robot import {} makes one of it", path.display());
        return Err(Failure::message(ExitCode::BadInput, message).hint(hint));
    }
    RobotModel::load(&shipped(path)).map_err(|error| {
        let code = match &error {
            ModelError::Read { .. } => ExitCode::NoInput,
            _ => ExitCode::BadInput,
        };
        let failure = Failure::new(code, error).context("robot file");
        let failure = meant(failure, path, "robots", |file| ends_with(file, ".robot.toml"));
        if path.exists() || !path.is_absolute() {
            return failure;
        }
        let near = failure.hint_text().map(|hint| format!("{hint} ")).unwrap_or_default();
        failure.hint(near + MOVED)
    })
}

/// A run names its robot by its whole path.
const MOVED: &str = "if the robot file of a run has moved: `robot` in config.toml of the run folder is its old path; write the new one";

/// The robot file of a log: that of the training whose folder it lies in, or the one that it names; a robot's name
/// stands for its file in `robots/`.
pub fn robot_of_log(log: &Path, named: &str) -> Option<PathBuf> {
    let run = log.parent().map(|run| run.join("config.toml")).filter(|config| config.is_file());
    let run = run.and_then(|config| Config::load(&Source::file(&config)).ok());
    let run = run.filter(|run| robot(&run.robot_path()).is_ok_and(|robot| robot.name() == named));
    let named = [named.to_owned(), format!("robots/{named}.robot.toml")]
        .map(|robot| Config { robot: robot.into(), ..Config::default() });
    run.into_iter().chain(named).map(|config| config.robot_path()).find(|path| path.is_file())
}

/// A policy file, checked; a relative path may be that of a policy that came with the program.
///
/// # Errors
/// Exit code 66 where it cannot be read, 65 where it is wrong.
pub fn policy(path: &Path) -> Result<PolicyFile, Failure> {
    let shown = || format!("policy {}", path.display());
    if path.is_dir() {
        let message = format!("{} is a folder", path.display());
        let hint = format!("the policy of a training is {}", path.join("policy.onnx").display());
        return Err(Failure::message(ExitCode::NoInput, message).hint(hint));
    }
    let bytes =
        caudata_durable::read_at_most(&shipped(path), caudata_policy::MAX_FILE_BYTES as u64)
            .or_exit_with(ExitCode::NoInput, || format!("cannot read {}", shown()))
            .map_err(|failure| meant(failure, path, "policies", |file| ends_with(file, ".onnx")))?;
    PolicyFile::parse(bytes.into()).or_exit_with(ExitCode::BadInput, shown).map_err(|failure| {
        failure.hint("a policy comes out of `caudata train`, or of caudata.write_policy in Python")
    })
}

/// Refuses what is not the folder of a training.
///
/// # Errors
/// Exit code 66, with the run that was most likely meant.
pub fn run_folder(path: &Path) -> Result<(), Failure> {
    let is_run = |folder: &Path| folder.join("config.toml").is_file();
    if is_run(path) {
        return Ok(());
    }
    let message = match path.exists() {
        true => format!("{} is no run folder", path.display()),
        false => format!("there is no run folder {}", path.display()),
    };
    let failure = Failure::message(ExitCode::NoInput, message);
    Err(meant(failure, path, "runs", is_run))
}

fn ends_with(file: &Path, ending: &str) -> bool {
    file.to_str().is_some_and(|name| name.ends_with(ending))
}

/// Adds what was most likely meant by a path that leads nowhere: of what `is_one` beside it, or in `folder`,
/// which may be one that came with the program.
fn meant(failure: Failure, path: &Path, folder: &str, is_one: fn(&Path) -> bool) -> Failure {
    /// Names less alike (0 to 1, Jaro–Winkler) confuse more than they help.
    const ALIKE: f64 = 0.85;
    let stem = |name: &str| name.split('.').next().unwrap_or_default().to_lowercase();
    let Some(asked) = path.file_name().filter(|_| !shipped(path).exists()) else { return failure };
    let asked = stem(&asked.to_string_lossy());
    let near = |parent: &Path| {
        let found = std::fs::read_dir(shipped(parent)).ok()?.flatten();
        let names = found
            .filter(|entry| is_one(&entry.path()))
            .filter_map(|entry| entry.file_name().into_string().ok());
        let scored = names.map(|n| (strsim::jaro_winkler(&stem(&n), &asked), n));
        let best = scored.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)))?;
        (best.0 >= ALIKE).then(|| parent.join(best.1))
    };
    let beside = path.parent().filter(|p| *p != Path::new(""));
    match beside.and_then(near).or_else(|| near(Path::new(folder))) {
        Some(file) => failure.hint(format!("did you mean {}?", file.display())),
        None => failure,
    }
}

/// Writes a file that was asked for by name; it may be a pipe or a terminal.
///
/// # Errors
/// As [`ExitCode::of_io`] has it for writing.
pub fn write(path: &Path, bytes: impl AsRef<[u8]>) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|error| {
        Failure::new(ExitCode::of_io(&error, true), error)
            .context(format!("cannot write {}", path.display()))
    })
}

/// Refuses what [`write`] could not write later, and leaves what is there as it is.
///
/// # Errors
/// As [`write`].
pub fn writable(path: &Path) -> Result<(), Failure> {
    let new = match path.symlink_metadata() {
        // a pipe or a terminal would wait for a reader
        Ok(there) if !there.is_file() => return Ok(()),
        Ok(_) => false,
        Err(_) => true,
    };
    let opened = std::fs::OpenOptions::new().append(true).create(true).open(path);
    opened.and_then(|_| if new { std::fs::remove_file(path) } else { Ok(()) }).map_err(|error| {
        Failure::new(ExitCode::of_io(&error, true), error)
            .context(format!("cannot write {}", path.display()))
    })
}

/// Writes a file whole: one that is there is complete.
///
/// # Errors
/// As [`ExitCode::of_io`] has it for writing.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    caudata_durable::replace(path, bytes).map_err(|error| {
        let code = match &error {
            DurableError::Io { source, .. } => ExitCode::of_io(source, true),
            DurableError::DiskFull { .. } => ExitCode::IoError,
            DurableError::Exists { .. } => ExitCode::CannotCreate,
        };
        Failure::new(code, error).context(format!("cannot write {}", path.display()))
    })
}

/// Writes a value as JSON for people, whole.
///
/// # Errors
/// As [`write_whole`].
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), Failure> {
    let bytes = serde_json::to_vec_pretty(value).or_exit(ExitCode::Internal)?;
    write_whole(path, &bytes)
}

/// Makes a folder, and those above it, where it is absent.
///
/// # Errors
/// Exit code 73.
pub fn make_folder(path: &Path) -> Result<(), Failure> {
    std::fs::create_dir_all(path)
        .or_exit_with(ExitCode::CannotCreate, || format!("folder {}", path.display()))
}

/// SHA-256 of a file, in hexadecimal.
///
/// # Errors
/// As [`read`].
pub fn sha256(path: &Path) -> Result<String, Failure> {
    Ok(hex::encode(Sha256::digest(read(path)?)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// Names with a letter wrong or left out, and one like no other.
    #[test]
    fn a_file_that_is_not_there_is_guessed() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        let told = |failure: Failure| failure.hint_text().unwrap_or_default().to_owned();
        let missed = told(robot(&root.join("robots/polymandr.robot.toml")).unwrap_err());
        assert!(
            missed.contains("did you mean") && missed.contains("robots/polymander.robot.toml?"),
            "{missed}"
        );
        assert!(missed.ends_with(MOVED), "{missed}");
        let missed = told(policy(&root.join("policies/flt.onnx")).unwrap_err());
        assert!(
            missed.contains("did you mean") && missed.contains("policies/flat.onnx?"),
            "{missed}"
        );
        let missed = told(policy(&root.join("policies/zebra.onnx")).unwrap_err());
        assert!(!missed.contains("did you mean"), "{missed}");
        let runs = tempfile::tempdir().unwrap();
        for name in ["walk-first", "walk-not-a-run", "swim"] {
            std::fs::create_dir(runs.path().join(name)).unwrap();
        }
        for name in ["walk-first", "swim"] {
            std::fs::write(runs.path().join(name).join("config.toml"), "").unwrap();
        }
        let missed = told(run_folder(&runs.path().join("walk-fisrt")).unwrap_err());
        assert!(missed.ends_with("/walk-first?"), "{missed}");
        let none = run_folder(&runs.path().join("walk-not-a-run")).unwrap_err();
        assert!(none.to_string().ends_with("is no run folder"), "{none}");
        assert_eq!(none.hint_text(), None);
    }

    #[test]
    fn a_wrong_robot_file_is_named_once() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("wrong.robot.toml");
        std::fs::write(&file, "name = \"a\"\nname = \"b\"\n").unwrap();
        let said = robot(&file).unwrap_err().to_string();
        assert!(said.contains("wrong.robot.toml:2: "), "{said}");
        assert_eq!(said.matches("wrong.robot.toml").count(), 1, "{said}");
    }
}
