//! `caudata policy keygen`, `caudata policy trust-next` and `caudata policy release`: signed policies for
//! robots that trust keys.

use std::path::{Path, PathBuf};

use caudata_durable::read_text_at_most;
use caudata_evaluation::Summary;
use caudata_proto::registry::{LabelName, Manifest, Signature, StreamName};
use caudata_signing::{
    ReleaseKey, SigningError, Trust, add_signature, read_signatures, successor_path,
};
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::json;

use crate::commands::policy_calls::{ServerArgs, block_on, hex};
use crate::say;

/// Largest trust file, and largest evaluation, bytes.
const FILE_MAX: u64 = 64 << 10;
const SUMMARY_MAX: u64 = 16 << 20;

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
    /// A key by which a policy server says where labels lead; it releases nothing. Added to the trust file,
    /// which must be there
    #[arg(long, conflicts_with = "root")]
    fresh: bool,
    /// A key that may name the next trust file (`trust-next`); it releases nothing. Added to the trust file,
    /// which must be there
    #[arg(long)]
    root: bool,
}

/// Flags of `trust-next`.
#[derive(Debug, clap::Args)]
pub struct TrustNextArgs {
    /// The first trust file of the robots; its successors lie beside it
    #[arg(long, value_name = "FILE.toml")]
    trust: PathBuf,
    /// What is to be trusted from now on, with the next `version`
    #[arg(long, value_name = "FILE.toml")]
    next: PathBuf,
    /// Secret root key
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Name of the key
    #[arg(long, value_name = "ID")]
    key_id: String,
}

/// Flags of `release`.
#[derive(Debug, clap::Args)]
pub struct ReleaseArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Which version; the newest when absent
    #[arg(long)]
    version: Option<u64>,
    /// The version that this label leads to, for instance `chosen`, which a training ended with
    #[arg(long, conflicts_with = "version")]
    label: Option<LabelName>,
    /// Stream to release into, which robots follow
    #[arg(long, value_name = "NAME")]
    to: String,
    /// Secret key
    #[arg(long, value_name = "FILE")]
    key: PathBuf,
    /// Name of the key
    #[arg(long, value_name = "ID")]
    key_id: String,
    /// Summary of an evaluation of exactly this policy (`caudata eval` writes it beside the policy); it is
    /// signed with it and people see it on the server's page
    #[arg(long, value_name = "FILE.json")]
    evaluation: Option<PathBuf>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Flags of what may be signed.
#[derive(Debug, clap::Args)]
pub struct KeyArgs {
    /// Secret key, for streams whose robots trust keys
    #[arg(long, value_name = "FILE", requires = "key_id")]
    key: Option<PathBuf>,
    /// Name of the key
    #[arg(long, value_name = "ID", requires = "key")]
    key_id: Option<String>,
}

impl KeyArgs {
    /// The key, where one was given.
    pub fn read(&self) -> Result<Option<ReleaseKey>, Failure> {
        let (Some(path), Some(id)) = (&self.key, &self.key_id) else { return Ok(None) };
        ReleaseKey::read(path, id).map(Some).map_err(unusable)
    }
}

/// Says so where nothing signs what was published.
pub fn say_if_unsigned(manifest: &Manifest) {
    if manifest.signatures.is_empty() {
        say::line("it is not signed: robots that trust keys will not take it (--key, --key-id)");
    }
}

/// What a key or trust file that cannot be used ends with.
pub fn unusable(error: SigningError) -> Failure {
    let code = if error.is_of_reading() { ExitCode::NoInput } else { ExitCode::BadInput };
    Failure::new(code, error)
}

/// What a server has after a publication, which must bear these signatures: a version that was there stays as it was.
pub fn as_signed(published: Manifest, signatures: &[Signature]) -> Result<Manifest, Failure> {
    if published.signatures == signatures {
        return Ok(published);
    }
    let message = format!(
        "{} version {} was there already with other words or signatures: it stays as it is",
        published.stream, published.version
    );
    Err(Failure::message(ExitCode::PolicyRefused, message)
        .hint("put it into another stream, or take another version"))
}

/// Makes a key.
pub fn keygen(args: &KeygenArgs) -> Result<(), Failure> {
    let key = ReleaseKey::generate(&args.key_id).or_exit(ExitCode::OsResource)?;
    let lines = match (args.fresh, args.root) {
        (true, _) => Some(key.trust_lines("fresh_key")),
        (_, true) => Some(key.trust_lines("root_key")),
        _ => None,
    };
    let trust = match lines {
        None => key.trust_file(),
        Some(lines) => {
            let before =
                read_text_at_most(&args.trust, FILE_MAX).or_exit_with(ExitCode::NoInput, || {
                    format!(
                        "cannot read {}: make it with a release key first",
                        args.trust.display()
                    )
                })?;
            format!("{}\n\n{lines}", before.trim_end())
        }
    };
    // A trust file that would not be taken must not come to be.
    Trust::parse(&trust).map_err(|reason| Failure::message(ExitCode::BadInput, reason))?;
    key.write(&args.out).or_exit(ExitCode::CannotCreate)?;
    caudata_durable::replace(&args.trust, trust.as_bytes()).or_exit(ExitCode::CannotCreate)?;
    say::line(format!("secret key {}, trust file {}", args.out.display(), args.trust.display()));
    Ok(())
}

/// Puts the next trust file beside the first one, and adds one signature to it. It is in force once enough
/// root keys of the file before it, and of its own, have signed.
pub fn trust_next(args: &TrustNextArgs) -> Result<(), Failure> {
    let key = ReleaseKey::read(&args.key, &args.key_id).map_err(unusable)?;
    let text = read_text_at_most(&args.next, FILE_MAX)
        .or_exit_with(ExitCode::NoInput, || format!("cannot read {}", args.next.display()))?;
    let bad = |reason| Failure::message(ExitCode::BadInput, reason);
    let next = Trust::parse(&text).map_err(bad)?;
    let version = next.version();
    if version < 2 {
        return Err(bad(format!(
            "{}: `version` is {version}; a trust file that follows another has 2 or more",
            args.next.display()
        )));
    }
    let before = Trust::before(&args.trust, version).map_err(unusable)?;
    // A signature that counts nowhere would look as if it did.
    if !before.has_root(&key) && !next.has_root(&key) {
        let message = format!(
            "key `{}` is a root key neither of version {} nor of {}: its signature would not count",
            args.key_id,
            before.version(),
            args.next.display()
        );
        return Err(bad(message).hint(
            "--key-id is the name under [[root_key]], --key the secret key that belongs to it",
        ));
    }
    let file = successor_path(&args.trust, version);
    match read_text_at_most(&file, FILE_MAX) {
        // Signatures that are there are over other bytes.
        Ok(there) if there != text => {
            let message = format!("{} is there with another content", file.display());
            return Err(Failure::message(ExitCode::CannotCreate, message));
        }
        Ok(_) => {}
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(error)
                .or_exit_with(ExitCode::NoInput, || format!("cannot read {}", file.display()));
        }
        Err(_) => {
            caudata_durable::replace(&file, text.as_bytes()).or_exit(ExitCode::CannotCreate)?;
        }
    }
    let signature = key.sign_trust(&text);
    if !read_signatures(&file).or_exit(ExitCode::BadInput)?.contains(&signature) {
        add_signature(&file, &signature).or_exit(ExitCode::CannotCreate)?;
    }
    say::line(match Trust::read(&args.trust) {
        Ok(trust) => format!("{} signed; version {} is in force", file.display(), trust.version()),
        Err(error) => format!("{} signed; not yet in force: {error}", file.display()),
    });
    Ok(())
}

/// Publishes a policy of one stream into another, signed. The bytes are fetched and checked; only the
/// announcement is new.
pub fn release(args: &ReleaseArgs) -> Result<(), Failure> {
    let key = ReleaseKey::read(&args.key, &args.key_id).map_err(unusable)?;
    let to = StreamName::new(&args.to).or_exit(ExitCode::BadConfig)?;
    let from = args.server.one_stream()?;
    let (mut manifest, bytes) = block_on(async {
        let mut client = args.server.client()?;
        let manifest = match &args.label {
            Some(label) => client.labelled(&from, label).await?,
            None => client.manifest(&from, args.version).await?,
        };
        let bytes = client.fetch(&manifest).await?;
        Ok((manifest, bytes))
    })?;
    if let Some(path) = &args.evaluation {
        manifest.evaluation_json = Some(evaluation(path, &manifest)?);
    }
    manifest.stream = to;
    manifest.signatures.clear();
    key.sign(&mut manifest);
    let signed = manifest.signatures.clone();
    let published = block_on(async {
        let mut client = args.server.client()?;
        client.publish(manifest, &bytes).await
    })?;
    let published = as_signed(published.manifest, &signed)?;
    let (stream, version) = (published.stream.to_string(), published.version);
    if args.json {
        return say::json(&json!({"stream": stream, "version": version, "key_id": args.key_id}));
    }
    say::line(format!("{stream} version {version}, signed by {}", args.key_id));
    Ok(())
}

/// The summary in `path`, as one line; it must be one of this policy.
fn evaluation(path: &Path, manifest: &Manifest) -> Result<String, Failure> {
    let shown = path.display();
    let text = read_text_at_most(path, SUMMARY_MAX)
        .or_exit_with(ExitCode::NoInput, || format!("cannot read {shown}"))?;
    let summary: Summary = serde_json::from_str(&text)
        .or_exit_with(ExitCode::BadInput, || format!("{shown} is no evaluation summary"))?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn root_keys_sign_the_trust_file_that_follows_and_nothing_else_does() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let make = |name: &str, trust: &str, root: bool| {
            let args = KeygenArgs {
                key_id: name.to_owned(),
                out: path(&format!("{name}.key")),
                trust: path(trust),
                fresh: false,
                root,
            };
            keygen(&args).unwrap();
        };
        make("release-1", "trust.toml", false);
        make("root-1", "trust.toml", true);
        make("release-2", "next.toml", false);
        make("root-2", "next.toml", true);
        let trust = path("trust.toml");
        let next = path("next.toml");
        let sign = |key: &str| {
            trust_next(&TrustNextArgs {
                trust: trust.clone(),
                next: next.clone(),
                key: path(&format!("{key}.key")),
                key_id: key.to_owned(),
            })
        };
        // It does not say that it follows.
        assert_eq!(sign("root-1").unwrap_err().code(), ExitCode::BadInput);
        let text = std::fs::read_to_string(&next).unwrap();
        let text = text.replacen("threshold = 1\n", "threshold = 1\nversion = 2\n", 1);
        std::fs::write(&next, &text).unwrap();
        let in_force = || Trust::read(&trust).map(|t| t.version()).ok();
        assert_eq!(in_force(), Some(1));
        // A release key may not say so, nor may another key under the name of one that may; neither leaves a
        // trace.
        for stranger in ["release-1", "release-2"] {
            let refused = sign(stranger).unwrap_err();
            assert_eq!(refused.code(), ExitCode::BadInput);
            let line = refused.to_string();
            assert!(
                line.contains(&format!(
                    "key `{stranger}` is a root key neither of version 1 nor of"
                )),
                "{line}"
            );
        }
        std::fs::rename(path("root-2.key"), path("kept.key")).unwrap();
        std::fs::copy(path("release-2.key"), path("root-2.key")).unwrap();
        assert_eq!(sign("root-2").unwrap_err().code(), ExitCode::BadInput);
        std::fs::rename(path("kept.key"), path("root-2.key")).unwrap();
        assert!(!successor_path(&trust, 2).exists());
        sign("root-1").unwrap();
        sign("root-1").unwrap();
        assert_eq!(in_force(), None, "its own root key is missing");
        sign("root-2").unwrap();
        assert_eq!(in_force(), Some(2));
        let signatures = read_signatures(&successor_path(&trust, 2)).unwrap();
        assert_eq!(signatures.len(), 2, "each key once");
        // One number was left out.
        let fourth = text.replacen("version = 2", "version = 4", 1);
        std::fs::write(&next, fourth).unwrap();
        let line = sign("root-2").unwrap_err().to_string();
        assert!(line.contains("4 is not the next of any"), "{line}");
        // What robots may have already is not changed under its number.
        std::fs::write(&next, format!("{text}\n")).unwrap();
        assert_eq!(sign("root-1").unwrap_err().code(), ExitCode::CannotCreate);
    }
}
