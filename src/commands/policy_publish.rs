//! `caudata policy publish`: a policy file into a stream of a policy server.

use std::path::{Path, PathBuf};

use caudata_proto::registry::{Manifest, StreamName};
use caudata_registry_client::{ClientError, RegistryClient, manifest_of};
use caudata_signing::ReleaseKey;
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt, unix_ms};
use serde_json::json;

use crate::commands::policy_calls::{ServerArgs, as_json, block_on};
use crate::commands::policy_sign::{KeyArgs, as_signed, say_if_unsigned};
use crate::say;

/// Flags of `publish`.
#[derive(Debug, clap::Args)]
pub struct PublishArgs {
    /// The policy; it gets the version that it bears
    #[arg(value_name = "P.onnx")]
    file: PathBuf,
    #[command(flatten)]
    server: ServerArgs,
    #[command(flatten)]
    key: KeyArgs,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Publishes a policy file.
pub fn run(args: &PublishArgs) -> Result<(), Failure> {
    let stream = args.server.one_stream()?;
    let key = args.key.read()?;
    let Published { manifest, was_there } =
        publish(&args.file, stream, key.as_ref(), || args.server.client())?;
    if args.json {
        let mut object = as_json(&manifest);
        object["signed"] = json!(!manifest.signatures.is_empty());
        object["was_there"] = json!(was_there);
        return say::json(&object);
    }
    let again = if was_there { ", which was there already" } else { "" };
    say::line(format!("{} version {}{again}", manifest.stream, manifest.version));
    say_if_unsigned(&manifest);
    Ok(())
}

/// What a server has of a policy after it was published.
pub struct Published {
    /// How the server announces it.
    pub manifest: Manifest,
    /// Whether the server had it before.
    pub was_there: bool,
}

/// Publishes the policy in `path` into `stream`, signed if there is a key; what the server then has. The same again is
/// the same version, as it was made.
pub fn publish(
    path: &Path,
    stream: StreamName,
    key: Option<&ReleaseKey>,
    client: impl FnOnce() -> Result<RegistryClient, ClientError>,
) -> Result<Published, Failure> {
    let file = files::policy(path)?;
    let mut manifest = manifest_of(stream, &file, unix_ms()).or_exit(ExitCode::BadInput)?;
    let (was_there, wanted, published) = block_on(async {
        let mut client = client()?;
        let before = match client.manifest(&manifest.stream, Some(manifest.version)).await {
            Ok(there) => Some(there.created_unix_ms),
            Err(error) if error.is_not_found() => None,
            Err(error) => return Err(error),
        };
        manifest.created_unix_ms = before.unwrap_or(manifest.created_unix_ms);
        if let Some(key) = key {
            key.sign(&mut manifest);
        }
        let wanted = manifest.signatures.clone();
        Ok((before.is_some(), wanted, client.publish(manifest, file.bytes()).await?.manifest))
    })?;
    Ok(Published { manifest: as_signed(published, &wanted)?, was_there })
}
