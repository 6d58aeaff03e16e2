//! `caudata policy label|revert|quarantine|audit`, and what `show` says about a version on a server.

use caudata_proto::registry::{LabelName, Manifest, Overview, SetLabel, reverting};
use caudata_registry_client::ClientError;
use caudata_telemetry::{ExitCode, Failure, unix_ms};
use serde_json::json;

use crate::commands::policy_calls::{ServerArgs, as_json, block_on};
use crate::commands::policy_sign::{KeyArgs, say_if_unsigned};
use crate::say;

/// Flags of `label`.
#[derive(Debug, clap::Args)]
pub struct LabelArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// Which label; all of them are shown when absent
    #[arg(long, value_name = "LABEL")]
    label: Option<LabelName>,
    /// Where it shall lead; where it leads is shown when absent
    #[arg(long, value_name = "N", requires = "label")]
    version: Option<u64>,
    /// Move it only if it leads here now
    #[arg(long, value_name = "N", requires = "version")]
    from: Option<u64>,
    /// Why `stable` is moved without the robots' reports that it needs; written down
    #[arg(long = "override", value_name = "REASON", requires = "version")]
    override_reason: Option<String>,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Flags of `revert`.
#[derive(Debug, clap::Args)]
pub struct RevertArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// The version to go back to
    #[arg(long, value_name = "N")]
    version: u64,
    /// Why; written down
    #[arg(long, value_name = "REASON")]
    reason: String,
    #[command(flatten)]
    key: KeyArgs,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Flags of `quarantine`.
#[derive(Debug, clap::Args)]
pub struct QuarantineArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// The version
    #[arg(long, value_name = "N")]
    version: u64,
    /// Why; written down, and told to robots
    #[arg(long, value_name = "REASON")]
    reason: String,
}

/// Flags of `audit`.
#[derive(Debug, clap::Args)]
pub struct AuditArgs {
    #[command(flatten)]
    server: ServerArgs,
    /// How many entries at most
    #[arg(long, default_value_t = 50)]
    limit: u32,
    /// Only entries before this number; 0: from the newest on
    #[arg(long, default_value_t = 0)]
    before: u64,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
}

/// Moves a label, or shows where labels lead.
pub fn label(args: &LabelArgs) -> Result<(), Failure> {
    let (Some(label), Some(version)) = (&args.label, args.version) else {
        return show_labels(args);
    };
    let stream = args.server.one_stream()?;
    let overview = block_on(async { args.server.client()?.overview(Some(&stream)).await })?;
    let known = overview.labels.iter().find(|state| state.label == *label);
    let leads = known.map(|state| state.version);
    if args.from.is_some() && leads != args.from {
        let now = leads.map_or("nowhere".to_owned(), |v| format!("to version {v}"));
        let message = format!("{label} of {stream} leads {now}; it was left there");
        return Err(Failure::message(ExitCode::TempFail, message));
    }
    let wanted = SetLabel {
        stream: stream.clone(),
        label: label.clone(),
        version,
        expected_generation: known.map_or(0, |state| state.generation),
        override_reason: args.override_reason.clone(),
    };
    let state = block_on(async { args.server.client()?.set_label(wanted).await })?;
    if args.json {
        return say::json(&json!({
            "stream": stream.as_str(), "label": label.as_str(), "version": state.version, "from": leads,
        }));
    }
    let from = leads.map_or(String::new(), |v| format!(" (was {v})"));
    say::line(format!("{label} of {stream} leads to version {version}{from}"));
    Ok(())
}

fn show_labels(args: &LabelArgs) -> Result<(), Failure> {
    let stream = args.server.stream()?;
    let overview = block_on(async { args.server.client()?.overview(stream.as_ref()).await })?;
    let wanted = |label: &LabelName| args.label.as_ref().is_none_or(|w| w == label);
    let labels: Vec<_> = overview.labels.iter().filter(|s| wanted(&s.label)).collect();
    let labels: Vec<_> = labels
        .iter()
        .map(|s| {
            let mut out = overview.quarantined.iter();
            json!({
                "stream": s.stream.as_str(), "label": s.label.as_str(), "version": s.version, "by": s.by,
                "override_reason": s.override_reason,
                "quarantined": out.any(|q| q.stream == s.stream && q.version == s.version),
            })
        })
        .collect();
    if args.json {
        return say::json(&json!({ "labels": labels }));
    }
    say::records(&labels, "stream label version by override_reason quarantined");
    Ok(())
}

/// Publishes an older version again under a higher number.
pub fn revert(args: &RevertArgs) -> Result<(), Failure> {
    let stream = args.server.one_stream()?;
    let key = args.key.read()?;
    let published = block_on(async {
        let mut client = args.server.client()?;
        let old = client.manifest(&stream, Some(args.version)).await?;
        let newest = client.list(Some(&stream), 1, None).await?.manifests;
        let next = newest.first().map_or(args.version, |m| m.version) + 1;
        let mut manifest = reverting(&old, next, unix_ms());
        if let Some(key) = &key {
            key.sign(&mut manifest);
        }
        client.revert(manifest, &args.reason).await
    })?;
    let version = published.manifest.version;
    if args.json {
        return say::json(&json!({
            "stream": stream.as_str(), "version": version, "reverts_to": args.version,
        }));
    }
    say::line(format!("{stream} version {version} is version {} again", args.version));
    say_if_unsigned(&published.manifest);
    Ok(())
}

/// Takes a version out of use.
pub fn quarantine(args: &QuarantineArgs) -> Result<(), Failure> {
    let stream = args.server.one_stream()?;
    let state = block_on(async {
        let mut client = args.server.client()?;
        client.quarantine(&stream, args.version, &args.reason).await
    })?;
    say::line(format!("{stream} version {} is out of use: {}", state.version, state.reason));
    Ok(())
}

/// Who changed what.
pub fn audit(args: &AuditArgs) -> Result<(), Failure> {
    let entries = block_on(async {
        let mut client = args.server.client()?;
        client.audit(args.limit, args.before).await
    })?;
    if args.json {
        return say::json(&json!({ "entries": entries }));
    }
    say::records(&entries, "number unix_ms by what stream version detail");
    Ok(())
}

/// What a server knows about one version.
pub fn show_version(
    server: &ServerArgs,
    version: Option<u64>,
    label: Option<&LabelName>,
    json: bool,
) -> Result<(), Failure> {
    let stream = server.one_stream()?;
    let (manifest, overview) = block_on(async {
        let mut client = server.client()?;
        let manifest = match label {
            Some(label) => client.labelled(&stream, label).await?,
            None => client.manifest(&stream, version).await?,
        };
        let overview = client.overview(Some(&stream)).await?;
        Ok::<_, ClientError>((manifest, overview))
    })?;
    let of = |v: u64| v == manifest.version;
    let labels: Vec<String> =
        overview.labels.iter().filter(|s| of(s.version)).map(|s| s.label.to_string()).collect();
    let quarantined = overview.quarantined.iter().find(|q| of(q.version));
    let signatures = manifest.signatures.iter().map(|s| s.key_id.clone());
    let mut object = as_json(&manifest);
    object["labels"] = json!(labels);
    object["quarantined"] = json!(quarantined.map(|q| &q.reason));
    object["reverts_to"] = json!(manifest.reverts_to);
    object["signed_by"] = json!(signatures.collect::<Vec<_>>());
    object["reports"] = reports_json(&overview, &manifest);
    say::either(json, &object, |object| {
        say::fields(
            object,
            "stream version created_unix_ms run_id env_steps sha256 bytes reverts_to signed_by labels quarantined",
        );
        if let Some(reports) = object["reports"].as_array().filter(|r| !r.is_empty()) {
            say::records(reports, "robot state reason walked_s attempts unix_ms");
        }
    })
}

fn reports_json(overview: &Overview, manifest: &Manifest) -> serde_json::Value {
    let reports = overview.reports.iter().filter(|r| r.version == manifest.version);
    let reports: Vec<_> = reports
        .map(|r| {
            json!({
                "robot": r.robot, "state": r.state.name(), "reason": r.reason, "walked_s": r.walked_s,
                "falls": r.falls, "attempts": r.attempts, "unix_ms": r.unix_ms,
            })
        })
        .collect();
    json!(reports)
}
