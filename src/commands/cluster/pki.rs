//! `caudata pki`: the certificates of a lab.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use caudata_signing::pki::{
    Authority, CERTIFICATE_FILE, PkiError, Request, Role, VALID_DAYS, identity_of_pem,
};
use caudata_telemetry::{ExitCode, Failure};
use clap::Subcommand;

use crate::say;

#[derive(Debug, Subcommand)]
pub enum PkiCommand {
    /// Make the authority of a lab; its key stays in the folder and goes nowhere
    Init {
        /// Folder
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
        /// Name of the lab
        #[arg(long, default_value = "caudata")]
        lab: String,
    },
    /// Make the certificate of one process, in a folder of its own: ca.crt, tls.crt, tls.key
    Issue {
        /// Folder of the authority
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
        /// learner, actor, server, router, operator or robot
        #[arg(long)]
        role: String,
        /// Name of the process and of its folder; otherwise its role
        #[arg(long)]
        name: Option<String>,
        /// Name or address by which others reach it; may be given several times
        #[arg(long = "host", value_name = "HOST")]
        hosts: Vec<String>,
        /// Validity
        #[arg(long, value_name = "N", default_value_t = VALID_DAYS)]
        days: u32,
        /// Make a new key and certificate where there is one already
        #[arg(long)]
        renew: bool,
    },
    /// Make certificates again that end soon, for the same roles, names and hosts; others stay as they are
    Renew {
        /// Folder of the authority
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
        /// Those that end within so many days
        #[arg(long, value_name = "N", default_value_t = 2)]
        within: u32,
    },
    /// Show the certificates of a folder and how long they are valid
    Show {
        /// Folder of the authority
        #[arg(long, value_name = "DIR")]
        dir: PathBuf,
    },
}

pub fn run(command: &PkiCommand) -> Result<(), Failure> {
    match command {
        PkiCommand::Init { dir, lab } => {
            Authority::create(dir, lab, SystemTime::now()).map_err(failure)?;
            say::line(format!(
                "the authority of {lab} is in {}; keep ca.key there, and a copy of it where nobody else reads",
                dir.display()
            ));
            Ok(())
        }
        PkiCommand::Issue { dir, role, name, hosts, days, renew } => {
            let role: Role = role.parse().map_err(failure)?;
            if role.listens() && hosts.is_empty() {
                let message =
                    format!("others connect to a {role}: its certificate must name its hosts");
                return Err(Failure::message(ExitCode::BadConfig, message)
                    .hint("give --host for every name or address by which it is reached"));
            }
            let request = Request {
                role,
                name: name.clone().unwrap_or_else(|| role.to_string()),
                hosts: hosts.clone(),
                days: *days,
            };
            let authority = Authority::open(dir).map_err(failure)?;
            let folder = authority.issue(&request, SystemTime::now(), *renew).map_err(failure)?;
            say::line(format!(
                "{}: {role} `{}`, valid for {days} days",
                folder.display(),
                request.name
            ));
            Ok(())
        }
        PkiCommand::Renew { dir, within } => renew(dir, *within),
        PkiCommand::Show { dir } => show(dir),
    }
}

/// The folders with a certificate, in order.
fn issued(dir: &Path) -> Result<Vec<PathBuf>, Failure> {
    let entries = std::fs::read_dir(dir).map_err(|error| {
        Failure::message(ExitCode::NoInput, format!("{}: {error}", dir.display()))
    })?;
    let folders = entries.flatten().map(|entry| entry.path());
    let mut folders: Vec<PathBuf> =
        folders.filter(|folder| folder.join(CERTIFICATE_FILE).is_file()).collect();
    folders.sort();
    Ok(folders)
}

fn name_of(folder: &Path) -> String {
    let name = folder.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

fn days_left(until: SystemTime) -> String {
    match until.duration_since(SystemTime::now()) {
        Ok(left) => format!("{:.1} days", left.as_secs_f64() / 86_400.0),
        Err(_) => "expired".to_owned(),
    }
}

fn renew(dir: &Path, within_days: u32) -> Result<(), Failure> {
    let authority = Authority::open(dir).map_err(failure)?;
    let within = Duration::from_secs(u64::from(within_days) * 86_400);
    let mut rows = Vec::new();
    for folder in issued(dir)? {
        let name = name_of(&folder);
        let (until, renewed) =
            authority.renew(&name, SystemTime::now(), within).map_err(failure)?;
        let what = if renewed { "renewed" } else { "kept" };
        rows.push(vec![name, what.to_owned(), days_left(until)]);
    }
    say::table(&["folder", "", "valid for"], rows);
    Ok(())
}

fn show(dir: &Path) -> Result<(), Failure> {
    let mut rows = Vec::new();
    for folder in issued(dir)? {
        let identity = identity_of_pem(&folder.join(CERTIFICATE_FILE)).map_err(failure)?;
        rows.push(vec![
            name_of(&folder),
            identity.role.to_string(),
            identity.name,
            days_left(identity.not_after),
        ]);
    }
    say::table(&["folder", "role", "name", "valid for"], rows);
    Ok(())
}

/// The exit code of what went wrong with certificates.
pub fn failure(error: PkiError) -> Failure {
    let code = match &error {
        PkiError::Role(_) | PkiError::Name(_) | PkiError::Days(_) => ExitCode::BadConfig,
        PkiError::Exists(_) => ExitCode::CannotCreate,
        PkiError::File { source, .. } => match source.kind() {
            std::io::ErrorKind::NotFound => ExitCode::NoInput,
            std::io::ErrorKind::InvalidData => ExitCode::BadInput,
            _ => ExitCode::IoError,
        },
        PkiError::Content { .. } => ExitCode::BadInput,
        PkiError::Make(_) => ExitCode::Internal,
    };
    let failure = Failure::new(code, error);
    match code {
        ExitCode::NoInput => failure
            .hint("certificates come from `caudata pki init --dir DIR`, then `caudata pki issue`"),
        _ => failure,
    }
}
