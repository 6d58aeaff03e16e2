//! `caudata adapt`: from measured logs to a policy for the robot as it is. The work is in `crates/studies`.

use std::path::Path;

use caudata_evaluation::SuiteResult;
use caudata_proto::registry::StreamName;
use caudata_registry_client::RegistryClient;
use caudata_studies::adapt::{self, Adapted, Named};
use caudata_studies::files;
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;

use crate::commands::gap_diagnose::steps;
use crate::commands::policy_publish::publish;
use crate::say::{self, WithJson};

#[derive(Debug, Args)]
pub struct AdaptArgs {
    #[command(flatten)]
    asked: WithJson<adapt::Plan>,
    /// Policy server to publish the new policy to, if it is better in the extended model; without it, it is
    /// not published
    #[arg(long, value_name = "HOST:PORT")]
    publish: Option<String>,
    /// Stream to publish under
    #[arg(long, default_value = "adapted", requires = "publish")]
    stream: String,
}

pub fn run(args: &AdaptArgs, process: &Process) -> Result<(), Failure> {
    let WithJson { plan, json } = &args.asked;
    let old = files::policy(&plan.policy)?.metadata().version;
    let publish = |path: &Path| {
        let server = args.publish.as_deref().unwrap_or_default();
        let stream = StreamName::new(&args.stream).or_exit(ExitCode::BadConfig)?;
        let published = publish(path, stream, None, || RegistryClient::new(server))?;
        Ok(published.manifest.version)
    };
    let publish: &dyn Fn(&Path) -> Result<u64, Failure> = &publish;
    let steps = steps(*json, process, "the same command goes on from here")?;
    let adapted = adapt::adapt(plan, steps, args.publish.as_ref().map(|_| publish))?;
    say::either(*json, &adapted, |adapted| tell(adapted, old))?;
    match (&args.publish, adapted.better) {
        (Some(_), Some(false)) => Err(Failure::message(
            ExitCode::TargetMissed,
            "the new policy is not better than the old one in the extended model: it was not published",
        )
        .hint("train longer (--iterations), or look at the evaluations in the output folder")),
        _ => Ok(()),
    }
}

fn tell(adapted: &Adapted, old: u64) {
    let verdict = crate::commands::gap_report::word(&adapted.verdict);
    if !adapted.trained {
        say::line(format_args!("{verdict}: nothing to adapt to; the policy stays as it is"));
        return;
    }
    let name = |cause: &Named| match cause.location.as_slice() {
        [] => cause.effect.clone(),
        some => format!("{} at {}", cause.effect, some.join(", ")),
    };
    let names: Vec<String> = adapted.causes.iter().map(name).collect();
    say::line(format_args!("{verdict}: {}", names.join("; ")));
    let old = format!("as it was ({old})");
    let evaluations = [
        (old.as_str(), "nominal", &adapted.before_in_nominal),
        (&old, "extended", &adapted.before_in_extended),
        ("new", "extended", &adapted.after_in_extended),
        (&old, "true robot", &adapted.before_in_truth),
        ("new", "true robot", &adapted.after_in_truth),
    ];
    say::table(
        &[
            "scenario",
            "policy",
            "model",
            "forward m/s",
            "rms off m/s",
            "sideways m/s",
            "turning rad/s",
            "falls",
            "power W",
        ],
        evaluations
            .iter()
            .filter_map(|(policy, model, result)| Some((policy, model, result.as_ref()?)))
            .flat_map(|(policy, model, result)| rows(policy, model, result)),
    );
    if let Some(version) = adapted.published {
        say::line(format_args!("published as version {version}"));
    }
    if adapted.better == Some(false) {
        say::line("the new policy is not better than the old one in the extended model");
    }
    let total_s: f64 = adapted.seconds.iter().map(|(_, s)| s).sum();
    if let Some(policy) = &adapted.policy {
        say::line(format_args!("new policy {} after {total_s:.0} s", policy.display()));
    }
}

fn rows(policy: &str, model: &str, result: &SuiteResult) -> Vec<Vec<String>> {
    let row = |s: &caudata_evaluation::ScenarioResult| {
        let figures =
            [s.vx_mps.mean].into_iter().chain(s.rmse_of_strides).map(|x| format!("{x:.3}"));
        let mut row = vec![s.name.clone(), policy.to_owned(), model.to_owned()];
        row.extend(figures);
        row.push(format!("{:.1} %", 100.0 * s.fall_share.mean));
        row.push(format!("{:.1}", s.power_w.mean));
        row
    };
    result.scenarios.iter().map(row).collect()
}
