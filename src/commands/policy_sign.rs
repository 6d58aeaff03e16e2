//! `caudata policy keygen` and `caudata policy release`: signed policies for robots that trust keys.

use std::path::PathBuf;

use caudata_proto::registry::StreamName;
use caudata_signing::ReleaseKey;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::json;

use crate::commands::policy::{ServerArgs, block_on};
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
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Makes a key.
pub fn keygen(args: &KeygenArgs) -> Result<(), Failure> {
    let key = ReleaseKey::generate(&args.key_id).or_exit(ExitCode::OsResource)?;
    key.write(&args.out).or_exit(ExitCode::CannotCreate)?;
    std::fs::write(&args.trust, key.trust_file()).or_exit(ExitCode::CannotCreate)?;
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
    let published = block_on(async {
        let mut client = args.server.client()?;
        let mut manifest = client.manifest(&from, args.version).await?;
        let bytes = client.fetch(&manifest).await?;
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
