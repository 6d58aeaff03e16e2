//! `caudata adapt`: from measured logs to a policy for the robot as it is.
//!
//! Each step is a command of its own, run as one and printed before it runs: diagnose, train in the extended model starting from the policy
//! that the robot has, evaluate before and after, publish. What was done so far stays in the output folder when a later step fails or is stopped, and the same command
//! goes on from there.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use caudata_config::{Config, ConfigArgs};
use caudata_evaluation::Suite;
use caudata_gap::check::run_name;
use caudata_gap::report::Verdict;
use caudata_proto::registry::StreamName;
use caudata_registry_client::{RegistryClient, manifest_of};
use caudata_runlog::{META_NAME, rows_file};
use caudata_telemetry::{ExitCode, Failure, FailureExt, Process};
use clap::Args;
use serde::Serialize;
use serde_json::Value;

use crate::commands::eval::{read_policy, suite_parser};
use crate::commands::gap::{file_sha256, log_folders};
use crate::commands::out_folder::{self, Asked, OutFolder, write_whole};
use crate::commands::policy::block_on;
use crate::commands::robot_model;
use crate::commands::steps::{Steps, Test, Training, measures, own};
use crate::say;

/// Share of the episodes that a new policy may fall in more often: less than that is chance.
const FALLS_TOLERANCE: f64 = 0.01;
/// Errors of velocity that nobody would notice, added to each before they are compared: forward and sideways m/s, turning rad/s. Without them a hair's breadth
/// more in what was nearly right outweighs much less in what was not.
const UNNOTICED: [f64; 3] = [0.005, 0.005, 0.01];

/// Of the error before, mean of the three axes, that may be left: less gain than that is chance.
const LEFT_AT_MOST: f64 = 0.95;
/// No axis may get worse than this many times.
const WORSE_AT_MOST: f64 = 1.25;

/// Exit codes of a diagnosis that has come to a verdict.
const VERDICTS: [i32; 6] = [0, 80, 81, 82, 83, 84];
/// Verdicts of a diagnosis whose extended model is worth training in.
const WORTH_IT: [Verdict; 3] = [
    Verdict::Explained,
    Verdict::Ambiguous,
    Verdict::PartlyExplained,
];
/// Folders of the two steps that take longest, in that of the output.
const DIAGNOSIS: &str = "diagnosis";
const RUN: &str = "run";
/// What a diagnosis leaves last.
const REPORT: &str = "report.json";
/// Keys that flags and the diagnosis set.
const OWN: [&str; 2] = ["robot", "run.iterations"];

#[derive(Debug, Args)]
pub struct AdaptArgs {
    /// Log folder of the robot, or a folder of log folders; may be given several times
    #[arg(long = "log", value_name = "DIR", required = true)]
    logs: Vec<PathBuf>,
    /// Log folder that diagnosis is only judged on
    #[arg(long = "holdout", value_name = "DIR")]
    holdouts: Vec<PathBuf>,
    /// The policy that the robot has
    #[arg(long, value_name = "P.onnx")]
    policy: PathBuf,
    /// Folder for everything that is made: diagnosis, run, evaluations, adapt.json. What is finished in it is not done again: the same command goes on where it was
    /// stopped
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Effects that the diagnosis does not try, by id
    #[arg(long, value_name = "ID")]
    without: Vec<String>,
    /// Only these effects are tried, by id
    #[arg(long, value_name = "ID")]
    only: Vec<String>,
    /// Robot file of the robot that the logs come from, where it is known (a simulated robot): both policies are evaluated on it as well
    #[arg(long, value_name = "R.robot.toml")]
    truth: Option<PathBuf>,
    /// Iterations of training
    #[arg(long, default_value_t = 600, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    iterations: u64,
    /// Suite of the evaluations: omni has commands in all directions
    #[arg(long, default_value = "omni", value_parser = suite_parser())]
    suite: Suite,
    /// Episodes of each scenario
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// Policy server to publish the new policy to, if it is better in the extended model; without it, it is not published
    #[arg(long, value_name = "HOST:PORT")]
    publish: Option<String>,
    /// Stream to publish under
    #[arg(long, default_value = "adapted", requires = "publish")]
    stream: String,
    /// One JSON object on the last line
    #[arg(long)]
    json: bool,
    /// How the policy was trained; without these flags config.toml beside the policy, else the preset flat
    #[command(flatten)]
    config: ConfigArgs,
}

/// `adapt.json`.
#[derive(Debug, Serialize)]
struct Adapted {
    /// Verdict of the diagnosis.
    verdict: Value,
    /// Effects it names.
    causes: Vec<Value>,
    /// Whether a policy was trained: not where nothing was found.
    trained: bool,
    /// The policy as it was, in the model as it was.
    before_in_nominal: Option<Value>,
    /// The policy as it was, in the extended model.
    before_in_extended: Option<Value>,
    /// The new policy, in the extended model.
    after_in_extended: Option<Value>,
    /// The policy as it was, on the robot that the logs come from, where that is known.
    before_in_truth: Option<Value>,
    /// The new policy there.
    after_in_truth: Option<Value>,
    /// Whether the new policy is the better one in the extended model; otherwise it is not published.
    better: Option<bool>,
    /// The new policy.
    policy: Option<PathBuf>,
    /// Version under which the server has it.
    published: Option<u64>,
    /// Wall time of each step of this call, s.
    seconds: Vec<(String, f64)>,
}

pub fn run(args: &AdaptArgs, process: &Process) -> Result<(), Failure> {
    let policy = read_policy(&args.policy)?;
    let flags = training_flags(args);
    let config = flags.load().or_exit(ExitCode::BadConfig)?;
    let robot = config.robot_path();
    let asked = asked(args, &config, &policy.sha256_hex())?;
    let _taken = OutFolder::take(&args.out, &asked)?;
    let mut steps = Steps::new(args.json, &process.stop);
    steps.after_stop("the same command goes on from here");

    let diagnosis = args.out.join(DIAGNOSIS);
    let report = diagnosed(&mut steps, args, &robot, &diagnosis)?;
    let verdict: Verdict = serde_json::from_value(report["verdict"].clone())
        .or_exit_with(ExitCode::BadInput, || {
            format!("{}: its verdict", diagnosis.join(REPORT).display())
        })?;
    let causes: Vec<Value> = report["causes"].as_array().cloned().unwrap_or_default();
    let mut adapted = Adapted {
        verdict: report["verdict"].clone(),
        causes: causes.iter().map(brief).collect(),
        trained: false,
        before_in_nominal: None,
        before_in_extended: None,
        after_in_extended: None,
        before_in_truth: None,
        after_in_truth: None,
        better: None,
        policy: None,
        published: None,
        seconds: Vec::new(),
    };
    if !WORTH_IT.contains(&verdict) || causes.is_empty() {
        adapted.seconds = steps.seconds();
        finish(args, &adapted)?;
        if !args.json {
            say::line(format_args!(
                "{}: nothing to adapt to; the policy stays as it is",
                text(&adapted.verdict)
            ));
        }
        return Ok(());
    }

    let extended = diagnosis.join("extended.robot.toml");
    let training = Training {
        flags: &flags,
        robot: &extended,
        start: Some(&args.policy),
        iterations: args.iterations,
        seed: None,
        set: &[],
        out: args.out.join(RUN),
        progress: None,
    };
    let new = steps.train("train", &training)?;
    adapted.trained = true;
    adapted.policy = Some(new.clone());

    let mut evaluate =
        |name: &str, policy: &Path, robot: &Path| -> Result<Option<Value>, Failure> {
            let test = Test {
                flags: &flags,
                policy,
                robot,
                suite: args.suite,
                episodes: args.episodes,
            };
            let file = args.out.join(format!("{name}.json"));
            steps.evaluate(name, &test, &file).map(Some)
        };
    adapted.before_in_nominal = evaluate("before_in_nominal", &args.policy, &robot)?;
    adapted.before_in_extended = evaluate("before_in_extended", &args.policy, &extended)?;
    adapted.after_in_extended = evaluate("after_in_extended", &new, &extended)?;
    if let Some(truth) = &args.truth {
        adapted.before_in_truth = evaluate("before_in_truth", &args.policy, truth)?;
        adapted.after_in_truth = evaluate("after_in_truth", &new, truth)?;
    }
    let better = improves(&adapted.before_in_extended, &adapted.after_in_extended);
    adapted.better = Some(better);
    steps.go_on()?;
    if let Some(server) = args.publish.as_ref().filter(|_| better) {
        adapted.published = Some(publish(server, &args.stream, &new)?);
    }
    adapted.seconds = steps.seconds();
    finish(args, &adapted)?;
    if !args.json {
        tell(&adapted, policy.metadata().version);
    }
    if args.publish.is_some() && !better {
        return Err(Failure::message(
            ExitCode::TargetMissed,
            "the new policy is not better than the old one in the extended model: it was not published".to_owned(),
        )
        .hint("train longer (--iterations), or look at the evaluations in the output folder"));
    }
    Ok(())
}

/// Whether the second of two evaluations of the same suite is the better one: no more falls (a hundredth of the episodes, all told), and less off the
/// commanded velocity: the errors forward, sideways and in turning, root mean square over all scenarios, as shares of those before, come to at most
/// [`LEFT_AT_MOST`] in the mean, none to more than [`WORSE_AT_MOST`].
fn improves(before: &Option<Value>, after: &Option<Value>) -> bool {
    let both = (
        before.as_ref().and_then(measures),
        after.as_ref().and_then(measures),
    );
    match both {
        (Some(old), Some(new)) => {
            let left =
                |axis: usize| (new.off[axis] + UNNOTICED[axis]) / (old.off[axis] + UNNOTICED[axis]);
            let left = [0, 1, 2].map(left);
            let mean = left.iter().sum::<f64>() / 3.0;
            new.falls <= old.falls + FALLS_TOLERANCE
                && mean <= LEFT_AT_MOST
                && left.iter().all(|share| *share <= WORSE_AT_MOST)
        }
        _ => false,
    }
}

/// The report of the diagnosis, which is not made again where it is complete.
fn diagnosed(
    steps: &mut Steps,
    args: &AdaptArgs,
    robot: &Path,
    diagnosis: &Path,
) -> Result<Value, Failure> {
    let report = diagnosis.join(REPORT);
    if report.is_file() {
        steps.is_there("diagnose", &report);
        return read_json(&report);
    }
    let mut command = own("gap")?;
    command.arg("diagnose").arg("--robot").arg(robot);
    for dir in &args.logs {
        command.arg("--log").arg(dir);
    }
    for dir in &args.holdouts {
        command.arg("--holdout").arg(dir);
    }
    for (flag, ids) in [("--without", &args.without), ("--only", &args.only)] {
        for id in ids {
            command.args([flag, id]);
        }
    }
    command.arg("--out").arg(diagnosis);
    steps.run("diagnose", &mut command, &VERDICTS)?;
    read_json(&report)
}

/// All that decides what is made.
///
/// # Errors
/// Where a robot or a log cannot be read.
fn asked(args: &AdaptArgs, config: &Config, policy: &str) -> Result<Asked, Failure> {
    let ids = |all: &[String]| match all.is_empty() {
        true => "none".to_owned(),
        false => all.join(" "),
    };
    let truth = match &args.truth {
        Some(truth) => robot_model::load(truth)?.hash_hex(),
        None => "none".to_owned(),
    };
    let flags = [
        ("--policy", policy.to_owned()),
        (
            "--robot",
            robot_model::load(&config.robot_path())?.hash_hex(),
        ),
        ("--truth", truth),
        ("--without", ids(&args.without)),
        ("--only", ids(&args.only)),
        ("--iterations", args.iterations.to_string()),
        ("--suite", args.suite.name().to_owned()),
        ("--episodes", args.episodes.to_string()),
    ];
    let mut asked = out_folder::asked(config, &OWN, flags);
    for (flag, dirs) in [("--log", &args.logs), ("--holdout", &args.holdouts)] {
        for (number, dir) in (1..).zip(log_folders(dirs)?) {
            let rows = file_sha256(&rows_file(&dir))?;
            let about = file_sha256(&dir.join(META_NAME))?;
            asked.insert(
                format!("{flag} {number}"),
                format!("{} {rows} {about}", run_name(&dir)),
            );
        }
    }
    Ok(asked)
}

/// The flags as given; else the configuration that lies beside the policy, else the preset `flat`.
fn training_flags(args: &AdaptArgs) -> ConfigArgs {
    let mut flags = args.config.clone();
    if flags.preset.is_none() && flags.config.is_none() {
        let beside = args.policy.with_file_name("config.toml");
        if beside.is_file() {
            flags.config = Some(beside);
        } else {
            flags.preset = Some("flat".into());
        }
    }
    flags
}

fn read_json(path: &Path) -> Result<Value, Failure> {
    let bytes = std::fs::read(path).or_exit_with(ExitCode::NoInput, || {
        format!("cannot read {}", path.display())
    })?;
    serde_json::from_slice(&bytes).or_exit_with(ExitCode::BadInput, || path.display().to_string())
}

/// Name, place and values of a cause.
fn brief(cause: &Value) -> Value {
    serde_json::json!({
        "effect": cause["effect"], "where": cause["where"], "parameters": cause["parameters"], "confidence": cause["confidence"],
    })
}

/// The version that it has on the server.
fn publish(server: &str, stream: &str, path: &Path) -> Result<u64, Failure> {
    let stream = StreamName::new(stream).or_exit(ExitCode::BadConfig)?;
    let file = read_policy(path)?;
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    let created_ms = now.map_or(0, |t| t.as_millis() as u64);
    let manifest = manifest_of(stream, &file, created_ms).or_exit(ExitCode::BadInput)?;
    block_on(async {
        let mut client = RegistryClient::new(server)?;
        client.publish(manifest, file.bytes()).await
    })?;
    Ok(file.metadata().version)
}

fn finish(args: &AdaptArgs, adapted: &Adapted) -> Result<(), Failure> {
    let bytes = serde_json::to_vec_pretty(adapted).or_exit(ExitCode::Internal)?;
    write_whole(&args.out.join("adapt.json"), &bytes)?;
    if args.json {
        say::json(adapted)?;
    }
    Ok(())
}

fn text(value: &Value) -> &str {
    value.as_str().unwrap_or_default()
}

fn tell(adapted: &Adapted, version: u64) {
    let names: Vec<String> = adapted
        .causes
        .iter()
        .map(|cause| {
            let places: Vec<&str> = cause["where"]
                .as_array()
                .into_iter()
                .flatten()
                .map(text)
                .collect();
            match places.as_slice() {
                [] => text(&cause["effect"]).to_owned(),
                some => format!("{} at {}", text(&cause["effect"]), some.join(", ")),
            }
        })
        .collect();
    say::line(format_args!(
        "{}: {}",
        text(&adapted.verdict),
        names.join("; ")
    ));
    let mut rows = vec![
        [
            "scenario",
            "policy",
            "model",
            "forward m/s",
            "rms off m/s",
            "sideways m/s",
            "turning rad/s",
            "falls",
            "power W",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];
    for (policy, model, result) in [
        (
            format!("as it was ({version})"),
            "nominal",
            &adapted.before_in_nominal,
        ),
        (
            format!("as it was ({version})"),
            "extended",
            &adapted.before_in_extended,
        ),
        ("new".to_owned(), "extended", &adapted.after_in_extended),
        (
            format!("as it was ({version})"),
            "true robot",
            &adapted.before_in_truth,
        ),
        ("new".to_owned(), "true robot", &adapted.after_in_truth),
    ] {
        let scenarios = result.as_ref().and_then(|r| r["scenarios"].as_array());
        for scenario in scenarios.into_iter().flatten() {
            let number = |key: &str| scenario[key]["mean"].as_f64().unwrap_or(f64::NAN);
            let off = |axis: usize| {
                let rms = scenario["rmse_of_strides"][axis].as_f64();
                format!("{:.3}", rms.unwrap_or(f64::NAN))
            };
            rows.push(vec![
                text(&scenario["name"]).to_owned(),
                policy.clone(),
                model.to_owned(),
                format!("{:.3}", number("vx_mps")),
                off(0),
                off(1),
                off(2),
                format!("{:.1} %", 100.0 * number("fall_share")),
                format!("{:.1}", number("power_w")),
            ]);
        }
    }
    say::table(&rows);
    if let Some(version) = adapted.published {
        say::line(format_args!("published as version {version}"));
    }
    if adapted.better == Some(false) {
        say::line("the new policy is not better than the old one in the extended model");
    }
    let total_s: f64 = adapted.seconds.iter().map(|(_, s)| s).sum();
    if let Some(policy) = &adapted.policy {
        say::line(format_args!(
            "new policy {} after {total_s:.0} s",
            policy.display()
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Scenarios: share of falls, and errors forward and in turning.
    fn evaluation(scenarios: &[(f64, f64, f64)]) -> Option<Value> {
        let scenario = |&(falls, off, turning): &(f64, f64, f64)| serde_json::json!({ "fall_share": { "mean": falls }, "rmse_of_strides": [off, 0.015, turning] });
        let scenarios: Vec<Value> = scenarios.iter().map(scenario).collect();
        Some(serde_json::json!({ "scenarios": scenarios }))
    }

    #[test]
    fn better_is_nearer_to_the_command_without_more_falls() {
        let before = evaluation(&[(0.0, 0.045, 0.09), (0.1, 0.045, 0.09)]); // falls 5 %
        let better = |scenarios: &[(f64, f64, f64)]| improves(&before, &evaluation(scenarios));
        // (0.02 + 0.005)/(0.045 + 0.005) = 0.5 forward, 1 sideways, (0.11 + 0.01)/(0.09 + 0.01) = 1.2 in turning: 0.9 in the mean
        assert!(better(&[(0.0, 0.02, 0.11), (0.1, 0.02, 0.11)]));
        // 0.13 in turning: 0.933 in the mean, and 1.4 there
        assert!(!better(&[(0.0, 0.015, 0.13), (0.1, 0.015, 0.13)]));
        // 0.04 forward: 0.9, and 0.967 in the mean: chance
        assert!(!better(&[(0.0, 0.04, 0.09), (0.1, 0.04, 0.09)]));
        assert!(better(&[(0.02, 0.02, 0.09), (0.1, 0.02, 0.09)])); // falls 6 %: chance
        assert!(!better(&[(0.05, 0.02, 0.09), (0.1, 0.02, 0.09)])); // 7.5 %
        // root mean square of 0 and 0.05: 0.0354, so 0.807 forward and 0.936 in the mean; the mean would be less as well at 0 and 0.08, and 0.0566 is not
        assert!(better(&[(0.0, 0.0, 0.09), (0.1, 0.05, 0.09)]));
        assert!(!better(&[(0.0, 0.0, 0.09), (0.1, 0.08, 0.09)]));
        assert!(!improves(&before, &before));
        assert!(!improves(&before, &None) && !improves(&None, &before));
    }
}
