//! `caudata policy`: policies on a policy server, and in files.

use std::path::{Path, PathBuf};

use caudata_evaluation::Summary;
use caudata_policy::PolicyFile;
use caudata_proto::registry::{LabelName, Manifest, QuarantineState, StreamName};
use caudata_registry_client::{ClientError, RegistryClient};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::{Args, Subcommand};
use serde_json::json;

use crate::commands::eval::read_policy;
use crate::commands::{policy_people, policy_sign};
use crate::say;

#[derive(Debug, Subcommand)]
pub enum PolicyCommand {
    /// List the versions that a policy server holds, newest first
    List {
        #[command(flatten)]
        server: ServerArgs,
        /// How many at most
        #[arg(long, default_value_t = 20)]
        limit: u32,
        /// One JSON object on the last line
        #[arg(long)]
        json: bool,
    },
    /// Show what a policy file says about itself (joints, gains, observation layout, origin), or what a server knows about a version
    Show {
        /// The policy; a version on the server when absent
        #[arg(value_name = "P.onnx")]
        file: Option<PathBuf>,
        #[command(flatten)]
        server: ServerArgs,
        /// Which version; the newest when absent
        #[arg(long, conflicts_with = "file")]
        version: Option<u64>,
        /// The version that this label leads to
        #[arg(long, conflicts_with_all = ["file", "version"])]
        label: Option<LabelName>,
        /// Everything, as one JSON object
        #[arg(long)]
        json: bool,
    },
    /// Make a key that signs policies, and a trust file for robots
    Keygen(policy_sign::KeygenArgs),
    /// Sign the trust file that follows the one robots have: other keys, by root keys
    TrustNext(policy_sign::TrustNextArgs),
    /// Publish a policy of one stream into another, signed
    Release(policy_sign::ReleaseArgs),
    /// Move a label such as `canary` or `stable` to a version, or show where labels lead
    Label(policy_people::LabelArgs),
    /// Publish an older version again, as a new and higher one: robots never go down
    Revert(policy_people::RevertArgs),
    /// Take a version out of use for good
    Quarantine(policy_people::QuarantineArgs),
    /// Show who changed what on a policy server
    Audit(policy_people::AuditArgs),
    /// Fetch a policy from a policy server, checked, into a file
    Pull {
        #[command(flatten)]
        server: ServerArgs,
        /// Which version; the newest when absent
        #[arg(long)]
        version: Option<u64>,
        /// Where to write it
        #[arg(long, value_name = "P.onnx")]
        out: PathBuf,
        /// One JSON object on the last line
        #[arg(long)]
        json: bool,
    },
}

#[derive(Debug, Args)]
pub struct ServerArgs {
    /// Address of the policy server
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7401")]
    server: String,
    /// Stream of policies: a run's id unless the run chose another name; all streams when absent
    #[arg(long)]
    stream: Option<String>,
    /// Certificates for an https:// address: folder with ca.crt, tls.crt and tls.key
    #[arg(long, value_name = "DIR", env = "CAUDATA_TLS_DIR")]
    tls_dir: Option<PathBuf>,
}

pub fn run(command: &PolicyCommand) -> Result<(), Failure> {
    match command {
        PolicyCommand::List {
            server,
            limit,
            json,
        } => list(server, *limit, *json),
        PolicyCommand::Keygen(args) => policy_sign::keygen(args),
        PolicyCommand::TrustNext(args) => policy_sign::trust_next(args),
        PolicyCommand::Release(args) => policy_sign::release(args),
        PolicyCommand::Label(args) => policy_people::label(args),
        PolicyCommand::Revert(args) => policy_people::revert(args),
        PolicyCommand::Quarantine(args) => policy_people::quarantine(args),
        PolicyCommand::Audit(args) => policy_people::audit(args),
        PolicyCommand::Show {
            file: Some(file),
            json,
            ..
        } => show(file, &read_policy(file)?, *json),
        PolicyCommand::Show {
            file: None,
            server,
            version,
            label,
            json,
        } => policy_people::show_version(server, *version, label.as_ref(), *json),
        PolicyCommand::Pull {
            server,
            version,
            out,
            json,
        } => pull(server, *version, out, *json),
    }
}

/// Runs a few calls to a policy server.
pub fn block_on<T>(work: impl Future<Output = Result<T, ClientError>>) -> Result<T, Failure> {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .or_exit(ExitCode::OsResource)?
        .block_on(work)
        .map_err(client_failure)
}

/// The exit code that a client error stands for.
pub fn client_failure(error: ClientError) -> Failure {
    let code = match &error {
        ClientError::Address { .. } | ClientError::Certificates { .. } => ExitCode::BadConfig,
        _ if error.is_not_found() => ExitCode::NoInput,
        ClientError::Unreachable { .. } => ExitCode::Unavailable,
        _ if error.is_lost_race() => ExitCode::TempFail,
        ClientError::TimedOut { .. } | ClientError::TooSlow => ExitCode::TempFail,
        ClientError::BadAnswer(_)
        | ClientError::OtherQuestion(_)
        | ClientError::WrongBytes { .. } => ExitCode::Protocol,
        ClientError::Refused { .. } => ExitCode::Unavailable,
    };
    Failure::new(code, error)
}

impl ServerArgs {
    /// The stream, where one was given.
    pub fn stream(&self) -> Result<Option<StreamName>, Failure> {
        self.stream
            .as_deref()
            .map(StreamName::new)
            .transpose()
            .or_exit(ExitCode::BadConfig)
    }

    /// The stream, which must have been given.
    pub fn one_stream(&self) -> Result<StreamName, Failure> {
        self.stream()?.ok_or_else(|| {
            Failure::message(
                ExitCode::BadConfig,
                "which stream? `caudata policy list` shows them",
            )
            .hint("add --stream NAME")
        })
    }

    /// A client of the server.
    pub fn client(&self) -> Result<RegistryClient, ClientError> {
        RegistryClient::with_tls(&self.server, self.tls_dir.as_deref())
    }
}

fn list(server: &ServerArgs, limit: u32, json: bool) -> Result<(), Failure> {
    let stream = server.stream()?;
    let (page, overview) = block_on(async {
        let mut client = server.client()?;
        let page = client.list(stream.as_ref(), limit, None).await?;
        let overview = client.overview(stream.as_ref()).await?;
        Ok((page, overview))
    })?;
    let marks = |m: &Manifest| -> Vec<String> {
        let labels = overview.labels.iter();
        let labels = labels.filter(|s| s.stream == m.stream && s.version == m.version);
        let mut marks: Vec<String> = labels.map(|s| s.label.to_string()).collect();
        let out = |q: &QuarantineState| q.stream == m.stream && q.version == m.version;
        if overview.quarantined.iter().any(out) {
            marks.push("quarantined".to_owned());
        }
        marks
    };
    if json {
        let policies = page.manifests.iter().map(|m| {
            let mut object = as_json(m);
            object["labels"] = json!(marks(m));
            object
        });
        let policies: Vec<_> = policies.collect();
        return say::json(&json!({ "policies": policies, "more": page.more }));
    }
    let mut rows = vec![
        ["stream", "version", "sha256", "bytes", "steps", "labels"]
            .map(String::from)
            .to_vec(),
    ];
    rows.extend(page.manifests.iter().map(|m| {
        let hash = hex(&m.sha256);
        vec![
            m.stream.to_string(),
            m.version.to_string(),
            hash[..12].to_owned(),
            m.size.to_string(),
            m.env_steps.to_string(),
            marks(m).join(" "),
        ]
    }));
    say::table(&rows);
    if page.more {
        say::line("… and older ones; --limit shows more");
    }
    Ok(())
}

/// What a manifest says.
pub fn as_json(manifest: &Manifest) -> serde_json::Value {
    json!({
        "stream": manifest.stream.as_str(),
        "version": manifest.version,
        "sha256": hex(&manifest.sha256),
        "bytes": manifest.size,
        "run_id": manifest.run_id,
        "env_steps": manifest.env_steps,
        "robot": manifest.robot_name,
        "created_unix_ms": manifest.created_unix_ms,
    })
}

fn show(path: &Path, policy: &PolicyFile, json: bool) -> Result<(), Failure> {
    let metadata = policy.metadata();
    // a summary that is stale or damaged says nothing about the policy
    let evaluation = Summary::beside(path, policy).unwrap_or_else(|error| {
        tracing::warn!("{error}");
        None
    });
    if json {
        return say::json(&json!({
            "sha256": policy.sha256_hex(),
            "bytes": policy.bytes().len(),
            "metadata": metadata,
            "evaluation": evaluation,
        }));
    }
    let contract = &metadata.contract;
    let layers: Vec<String> = policy
        .spec()
        .layers
        .iter()
        .map(|layer| layer.out.to_string())
        .collect();
    say::line(format!(
        "policy version {} of run {}, {} environment steps, seed {}",
        metadata.version, metadata.run_id, metadata.env_steps, metadata.seed
    ));
    say::line(format!(
        "sha256 {}, {} bytes",
        policy.sha256_hex(),
        policy.bytes().len()
    ));
    say::line(format!(
        "trained by commit {}, configuration {}",
        metadata.training_commit, metadata.config_hash
    ));
    say::line(format!("robot {} {}", contract.robot, contract.robot_hash));
    say::line(format!(
        "network {} → {} ({:?}), control period {} s, action scale {} rad",
        contract.obs_dim(),
        layers.join(" → "),
        policy.spec().activation,
        contract.control_period_s,
        contract.action.scale
    ));
    show_joints(policy);
    show_layout(policy);
    if let Some(evaluation) = &evaluation {
        show_evaluation(evaluation);
    }
    say::line("signatures travel with the announcement on a policy server, not in the file");
    Ok(())
}

fn show_evaluation(summary: &Summary) {
    let header = ["evaluated", "command", "achieved", "falls", "power W", ""];
    let mut rows = vec![header.map(String::from).to_vec()];
    let velocity = |v: [f64; 3]| v.map(|x| format!("{x:.2}")).join(" ");
    for line in &summary.scenarios {
        let verdict = match (line.walks, line.reached) {
            (Some(true), _) => "walks".to_owned(),
            (Some(false), _) => format!("does not walk: {}", line.missed.join("; ")),
            (None, Some(reached)) => format!("gets there in {:.1} %", 100.0 * reached),
            (None, None) => String::new(),
        };
        rows.push(vec![
            line.name.clone(),
            velocity(line.command),
            velocity(line.achieved),
            format!("{:.1} %", 100.0 * line.fall_share),
            format!("{:.1}", line.power_w),
            verdict,
        ]);
    }
    say::table(&rows);
    if let Some([met, of]) = summary.targets_met {
        say::line(format!("{met} of {of} targets met"));
    }
}

fn show_joints(policy: &PolicyFile) {
    let contract = &policy.metadata().contract;
    let header = [
        "#",
        "joint",
        "nominal rad",
        "lower rad",
        "upper rad",
        "Kp",
        "Kd",
        "exploration",
    ];
    let mut rows = vec![header.map(String::from).to_vec()];
    for (i, name) in contract.joint_names.iter().enumerate() {
        let number = |values: &[f32]| values.get(i).map_or(String::new(), |x| format!("{x:.3}"));
        let std = policy
            .metadata()
            .log_std
            .get(i)
            .map_or(String::new(), |x| format!("{:.3}", x.exp()));
        rows.push(vec![
            i.to_string(),
            name.clone(),
            number(&contract.nominal_pos_rad),
            number(&contract.lower_limit_rad),
            number(&contract.upper_limit_rad),
            number(&contract.kp_nm_per_rad),
            number(&contract.kd_nm_s_per_rad),
            std,
        ]);
    }
    say::table(&rows);
}

fn show_layout(policy: &PolicyFile) {
    let mut rows = vec![
        ["start", "size", "observation", "unit", "frame"]
            .map(String::from)
            .to_vec(),
    ];
    for slice in policy.metadata().contract.observation.slices() {
        rows.push(vec![
            slice.start.to_string(),
            slice.len.to_string(),
            slice.name.to_string(),
            slice.unit.to_string(),
            slice.frame.to_string(),
        ]);
    }
    say::table(&rows);
}

fn pull(
    server: &ServerArgs,
    version: Option<u64>,
    out: &std::path::Path,
    json: bool,
) -> Result<(), Failure> {
    let stream = server.one_stream()?;
    let (manifest, bytes) = block_on(async {
        let mut client = server.client()?;
        let manifest = client.manifest(&stream, version).await?;
        let bytes = client.fetch(&manifest).await?;
        Ok((manifest, bytes))
    })?;
    let policy = PolicyFile::parse(bytes.into()).or_exit(ExitCode::BadInput)?;
    caudata_durable::replace(out, policy.bytes()).or_exit_with(ExitCode::CannotCreate, || {
        format!("cannot write {}", out.display())
    })?;
    if json {
        return say::json(&as_json(&manifest));
    }
    say::line(format!(
        "version {} ({}) is in {}",
        manifest.version,
        policy.sha256_hex(),
        out.display()
    ));
    Ok(())
}

/// Bytes as lower-case hexadecimal.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
