//! `caudata policy keygen` and `caudata policy release`: signed policies for robots that trust keys.

use std::path::{Path, PathBuf};

use caudata_evaluation::Summary;
use caudata_proto::registry::{Manifest, StreamName};
use caudata_signing::{ReleaseKey, Trust};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::json;

use crate::commands::policy::{ServerArgs, block_on, hex};
use crate::say;

/// Flags of `keygen`.
#[derive(Debug, clap::Args)]
pub struct KeygenArgs {
    /// Name of the key, as signatures and trust files call it
    #[arg(long, value_name = "ID")]
    key_id: String,
    /// Where to write the secret key; keep it off learners and servers
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Where to write a trust file for robots
    #[arg(long, value_name = "FILE.toml")]
    trust: PathBuf,
    /// A key by which a policy server says where labels lead; it releases nothing. Added to the trust file, which must be there
    #[arg(long)]
    fresh: bool,
}

/// Flags of `release`.
#[derive(Debug, clap::Args)]
pub struct ReleaseArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Which version; the newest when absent
    #[arg(long)]
    version: Option<u64>,
    /// Stream to release into, which robots follow
    #[arg(long, value_name = "NAME")]
    to: String,
    /// Secret key
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Name of the key
    #[arg(long, value_name = "ID")]
    key_id: String,
    /// Summary of an evaluation of exactly this policy (`caudata eval` writes it beside the policy); it is signed with it and people
    /// see it on the server's page
    #[arg(long, value_name = "FILE.json")]
    evaluation: Option<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Makes a key.
pub fn keygen(args: &KeygenArgs) -> Result<(), Failure> {
    let key = ReleaseKey::generate(&args.key_id).or_exit(ExitCode::OsResource)?;
    let trust = match args.fresh {
        false => key.trust_file(),
        true => {
            let before =
                std::fs::read_to_string(&args.trust).or_exit_with(ExitCode::NoInput, || {
                    format!(
                        "cannot read {}: make it with a release key first",
                        args.trust.display()
                    )
                })?;
            format!("{}\n\n{}", before.trim_end(), key.fresh_trust_lines())
        }
    };
    // A trust file that would not be taken must not come to be.
    Trust::parse(&trust).map_err(|reason| Failure::message(ExitCode::BadInput, reason))?;
    key.write(&args.out).or_exit(ExitCode::CannotCreate)?;
    caudata_durable::replace(&args.trust, trust.as_bytes()).or_exit(ExitCode::CannotCreate)?;
    say::line(format!(
        "secret key {}, trust file {}",
        args.out.display(),
        args.trust.display()
    ));
    Ok(())
}

/// Publishes a policy of one stream into another, signed. The bytes are fetched and checked; only the announcement is new.
pub fn release(args: &ReleaseArgs) -> Result<(), Failure> {
    let key = ReleaseKey::read(&args.key, &args.key_id).or_exit(ExitCode::NoInput)?;
    let to = StreamName::new(&args.to).or_exit(ExitCode::BadConfig)?;
    let from = args.server.one_stream()?;
    let (mut manifest, bytes) = block_on(async {
        let mut client = args.server.client()?;
        let manifest = client.manifest(&from, args.version).await?;
        let bytes = client.fetch(&manifest).await?;
        Ok((manifest, bytes))
    })?;
    if let Some(path) = &args.evaluation {
        manifest.evaluation_json = Some(evaluation(path, &manifest)?);
    }
    let published = block_on(async {
        let mut client = args.server.client()?;
        manifest.stream = to;
        manifest.signatures.clear();
        key.sign(&mut manifest);
        client.publish(manifest, &bytes).await
    })?;
    let (stream, version) = (
        published.manifest.stream.to_string(),
        published.manifest.version,
    );
    if args.json {
        return say::json(&json!({"stream": stream, "version": version, "key_id": args.key_id}));
    }
    say::line(format!(
        "{stream} version {version}, signed by {}",
        args.key_id
    ));
    Ok(())
}

/// The summary in `path`, as one line; it must be one of this policy.
fn evaluation(path: &Path, manifest: &Manifest) -> Result<String, Failure> {
    let shown = path.display();
    let text = std::fs::read_to_string(path)
        .or_exit_with(ExitCode::NoInput, || format!("cannot read {shown}"))?;
    let summary: Summary = serde_json::from_str(&text).or_exit_with(ExitCode::BadInput, || {
        format!("{shown} is no evaluation summary")
    })?;
    if summary.policy_sha256 != hex(&manifest.sha256) {
        let message = format!(
            "{shown} is about policy {}, not {}",
            summary.policy_sha256,
            hex(&manifest.sha256)
        );
        return Err(Failure::message(ExitCode::BadInput, message)
            .hint("evaluate the policy that is released: `caudata policy pull`, `caudata eval`"));
    }
    serde_json::to_string(&summary).or_exit(ExitCode::Internal)
}
