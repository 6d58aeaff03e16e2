//! `caudata policy`: policies on a policy server, and in files.

use std::path::{Path, PathBuf};

use caudata_evaluation::Summary;
use caudata_policy::PolicyFile;
use caudata_proto::registry::{LabelName, Manifest, QuarantineState};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Subcommand;
use serde_json::json;

use crate::commands::policy_calls::{ServerArgs, as_json};
pub use crate::commands::policy_calls::{block_on, hex};
use crate::commands::{policy_average, policy_join, policy_people, policy_publish, policy_sign};
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
    /// Show what a policy file says about itself (joints, gains, observation layout, origin), or what a
    /// server knows about a version
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
    /// Average the last versions of a training: nearer to what it converges to than most of them
    Average(policy_average::AverageArgs),
    /// Join two policies in one network, of which an observed value chooses: to get up where it has fallen,
    /// to walk where not
    Join(policy_join::JoinArgs),
    /// Make a key that signs policies, and a trust file for robots
    Keygen(policy_sign::KeygenArgs),
    /// Sign the trust file that follows the one robots have: other keys, by root keys
    TrustNext(policy_sign::TrustNextArgs),
    /// Publish a policy file: an averaged or joined one, or one of another server
    Publish(policy_publish::PublishArgs),
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

pub fn run(command: &PolicyCommand) -> Result<(), Failure> {
    match command {
        PolicyCommand::List { server, limit, json } => list(server, *limit, *json),
        PolicyCommand::Average(args) => policy_average::average(args),
        PolicyCommand::Join(args) => policy_join::join(args),
        PolicyCommand::Keygen(args) => policy_sign::keygen(args),
        PolicyCommand::TrustNext(args) => policy_sign::trust_next(args),
        PolicyCommand::Publish(args) => policy_publish::run(args),
        PolicyCommand::Release(args) => policy_sign::release(args),
        PolicyCommand::Label(args) => policy_people::label(args),
        PolicyCommand::Revert(args) => policy_people::revert(args),
        PolicyCommand::Quarantine(args) => policy_people::quarantine(args),
        PolicyCommand::Audit(args) => policy_people::audit(args),
        PolicyCommand::Show { file: Some(file), json, .. } => {
            show(file, &files::policy(file)?, *json)
        }
        PolicyCommand::Show { file: None, server, version, label, json } => {
            policy_people::show_version(server, *version, label.as_ref(), *json)
        }
        PolicyCommand::Pull { server, version, out, json } => pull(server, *version, out, *json),
    }
}

fn list(server: &ServerArgs, limit: u32, json: bool) -> Result<(), Failure> {
    let stream = server.stream()?;
    let (page, overview, all) = block_on(async {
        let mut client = server.client()?;
        let page = client.list(stream.as_ref(), limit, None).await?;
        let overview = client.overview(stream.as_ref()).await?;
        let all = match &stream {
            Some(_) => Some(client.overview(None).await?),
            None => None,
        };
        Ok((page, overview, all))
    })?;
    let all = &all.as_ref().unwrap_or(&overview).labels;
    let mut streams: Vec<String> = all.iter().map(|s| s.stream.to_string()).collect();
    streams.sort();
    streams.dedup();
    let streams = streams.join(", ");
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
    let policies = page.manifests.iter().map(|m| {
        let mut object = as_json(m);
        object["labels"] = json!(marks(m));
        object
    });
    let policies: Vec<_> = policies.collect();
    if json {
        return say::json(&json!({ "policies": policies, "more": page.more }));
    }
    if policies.is_empty() {
        let of = stream.filter(|_| !streams.is_empty());
        let of = of.map_or(String::new(), |s| format!(" of the stream {s}; it has {streams}"));
        say::line(format!("the server has no policy{of}"));
        return Ok(());
    }
    say::records(&policies, "stream version sha256 bytes env_steps labels");
    if page.more {
        say::line("… and more; --limit shows them");
    }
    if stream.is_none() {
        say::line(format!("streams: {streams}"));
    }
    Ok(())
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
    let layers: Vec<String> =
        policy.spec().layers.iter().map(|layer| layer.out.to_string()).collect();
    say::line(format!(
        "policy version {} of run {}, {} environment steps, seed {}",
        metadata.version, metadata.run_id, metadata.env_steps, metadata.seed
    ));
    say::line(format!("sha256 {}, {} bytes", policy.sha256_hex(), policy.bytes().len()));
    let commit = match metadata.training_commit.as_str() {
        "" => "unknown",
        known => known,
    };
    let hash = &metadata.config_hash;
    say::line(format!("trained by commit {commit}, configuration {hash}"));
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
    say::records(
        &summary.scenarios,
        "name command achieved fall_share power_w walks missed reached",
    );
    if let Some([met, of]) = summary.targets_met {
        say::line(format!("{met} of {of} targets met"));
    }
}

fn show_joints(policy: &PolicyFile) {
    let contract = &policy.metadata().contract;
    let row = |(i, name): (usize, &String)| {
        let number = |values: &[f32]| values.get(i).map_or(String::new(), |x| format!("{x:.3}"));
        let std: Vec<f32> = policy.metadata().log_std.iter().map(|x| x.exp()).collect();
        let mut row = vec![i.to_string(), name.clone()];
        row.extend(
            [
                &contract.nominal_pos_rad,
                &contract.lower_limit_rad,
                &contract.upper_limit_rad,
                &contract.kp_nm_per_rad,
                &contract.kd_nm_s_per_rad,
                &std,
            ]
            .map(|values| number(values)),
        );
        row
    };
    let head = ["#", "joint", "nominal rad", "lower rad", "upper rad", "Kp", "Kd", "exploration"];
    say::table(&head, contract.joint_names.iter().enumerate().map(row));
}

fn show_layout(policy: &PolicyFile) {
    let layout = &policy.metadata().contract.observation;
    let rows = layout.slices().iter().map(|slice| {
        vec![
            slice.start.to_string(),
            slice.len.to_string(),
            slice.name.to_string(),
            slice.unit.to_string(),
            slice.frame.to_string(),
        ]
    });
    say::table(&["start", "size", "observation", "unit", "frame"], rows);
    let [present, all] = [layout.present_dim(), layout.dim()];
    if present < all {
        say::line(format!(
            "{present} to {}: the same {:?} control steps ago, without phase and command",
            all - 1,
            layout.past()
        ));
    }
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
    files::write_whole(out, policy.bytes())?;
    say::either(json, &as_json(&manifest), |_| {
        let (version, out) = (manifest.version, out.display());
        say::line(format!("version {version} ({}) is in {out}", policy.sha256_hex()));
    })
}
