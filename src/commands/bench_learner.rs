//! `caudata bench learner`: asks the learner's own program, the only one with libtorch, and prints its answer.

use std::process::{Command, Stdio};

use caudata_config::ConfigArgs;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use serde_json::Value;

use crate::commands::train::Programs;
use crate::say;

pub fn run(config: &ConfigArgs, seconds: f64, json: bool) -> Result<(), Failure> {
    let mut command = Command::new(Programs::beside_this_one()?.find("caudata-learner")?);
    command
        .args(["bench", "--seconds", &seconds.to_string()])
        .args(super::bench::as_flags(config))
        .stderr(Stdio::inherit());
    let output = command.output().or_exit(ExitCode::OsResource)?;
    if !output.status.success() {
        let message = format!("caudata-learner bench ended with {}", output.status);
        return Err(Failure::message(ExitCode::Internal, message));
    }
    let found: Value = serde_json::from_slice(&output.stdout).or_exit(ExitCode::Internal)?;
    if json {
        return say::json(&found);
    }
    print(&found);
    Ok(())
}

fn print(found: &Value) {
    say::line(format_args!(
        "update of {} environment steps, {} epochs, policy {}, value {}",
        found["batch_rows"], found["epochs"], found["policy_hidden"], found["value_hidden"]
    ));
    let mut rows = vec![
        [
            "threads",
            "steps/s",
            "update ms",
            "GFLOP/s",
            "same shapes GFLOP/s",
            "large GFLOP/s",
            "of same shapes",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];
    for speed in found["speeds"].as_array().into_iter().flatten() {
        let number = |key: &str| speed[key].as_f64().unwrap_or(f64::NAN);
        let share = number("gflops") / number("ceiling_same_shape_gflops");
        rows.push(vec![
            speed["threads"].to_string(),
            format!("{:.0}", number("samples_per_s")),
            format!("{:.2}", 1e3 * number("update_median_s")),
            format!("{:.1}", number("gflops")),
            format!("{:.1}", number("ceiling_same_shape_gflops")),
            format!("{:.1}", number("ceiling_large_gflops")),
            format!("{:.0} %", 100.0 * share),
        ]);
    }
    say::table(&rows);
}
