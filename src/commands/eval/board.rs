//! An evaluation where TensorBoard shows it: beside the curves of the training, at the step of the policy.

use std::io;
use std::path::Path;

use caudata_evaluation::SuiteResult;
use caudata_telemetry::{EventFile, unix_ms};
use serde_json::Value;

use super::show;

/// Adds the figures of `result` to the files of TensorBoard in `folder`: the project's targets, the means of each
/// scenario, and as a text what was met and what not.
pub fn write(folder: &Path, result: &SuiteResult) -> io::Result<()> {
    let now_s = unix_ms() as f64 * 1e-3;
    let step = result.policy_version;
    let mut file = EventFile::create(folder, now_s)?;
    file.scalars(now_s, step, &scalars(result))?;
    file.text(now_s, step, "Evaluation/verdict", verdict(result))?;
    file.flush()
}

fn scalars(result: &SuiteResult) -> Vec<(String, f64)> {
    let rows = &result.acceptance;
    let targets = rows.iter();
    let targets =
        targets.filter_map(|row| Some((format!("Acceptance/{}", row.name), row.measured?)));
    let mut out: Vec<(String, f64)> = targets.collect();
    if !rows.is_empty() {
        let met = rows.iter().filter(|row| row.met).count();
        out.push(("Acceptance/met".to_owned(), met as f64 / rows.len() as f64));
    }
    for scenario in &result.scenarios {
        let of = match result.scenarios.len() {
            1 => "Evaluation".to_owned(),
            _ => format!("Evaluation/{}", scenario.name),
        };
        let Ok(Value::Object(figures)) = serde_json::to_value(scenario) else { continue };
        // every estimate is an object with its mean
        let means = figures.iter();
        let means = means.filter_map(|(key, value)| Some((key, value.get("mean")?.as_f64()?)));
        out.extend(means.map(|(key, mean)| (format!("{of}/{key}"), mean)));
    }
    out
}

/// In Markdown: a table of the targets, and a line of each scenario.
fn verdict(result: &SuiteResult) -> String {
    let mut text = String::new();
    if !result.acceptance.is_empty() {
        text += "| target | owed | aim | measured | | |\n|---|---|---|---|---|---|\n";
    }
    for row in &result.acceptance {
        let cells = show::target(row).map(|cell| cell.replace('|', "\\|"));
        text += &format!("| {} |\n", cells.join(" | "));
    }
    text += "\n";
    for scenario in &result.scenarios {
        let falls = 100.0 * scenario.fall_share.mean;
        let verdict = show::verdict(scenario).map_or(String::new(), |v| format!("; {v}"));
        text += &format!("- {}: falls in {falls:.1} %{verdict}\n", scenario.name);
    }
    text
}
