//! The curves of a run as SVG pictures, one file per quantity.

use std::path::Path;

use caudata_chart::{Axis, Chart, sheet};

use super::history::History;
use crate::LearnerError;

/// Size of one chart, pixels.
const CHART_PX: (f64, f64) = (720.0, 390.0);
/// Size of one chart among several in a picture, pixels.
const PANEL_PX: (f64, f64) = (480.0, 250.0);
const PANELS_PER_ROW: usize = 2;
/// Units of the horizontal axis: from how many steps on, how many steps each, and their name.
const UNITS: [(f64, f64, &str); 3] = [
    (1e6, 1e6, "environment steps, millions"),
    (1e4, 1e3, "environment steps, thousands"),
    (0.0, 1.0, "environment steps"),
];
/// Prefix of the names of reward terms in the history.
pub const TERM_PREFIX: &str = "term/";

/// File, value in the history, title, label of the vertical axis.
const CHARTS: [(&str, &str, &str, &str); 8] = [
    ("return", "mean_return", "Episode return", "mean return of the last 100 episodes"),
    ("episode_length", "mean_episode_length", "Episode length", "control steps"),
    ("step_reward", "mean_step_reward", "Reward per step", "mean over the batch"),
    ("kl", "kl", "KL divergence of an update", "nats"),
    ("std", "mean_std", "Action noise", "mean standard deviation"),
    ("steps_per_s", "steps_per_s", "Speed", "environment steps per second"),
    ("value_loss", "value_loss", "Value loss", "¼ · mean squared error"),
    ("learning_rate", "learning_rate", "Learning rate", "after the iteration"),
];

/// Writes the pictures into `folder`: `return.svg`, `reward_terms.svg`, …. Quantities that have no points yet
/// are left out.
///
/// # Errors
/// When a picture cannot be drawn or written.
pub fn draw_curves(folder: &Path, history: &History) -> Result<(), LearnerError> {
    std::fs::create_dir_all(folder).map_err(|source| LearnerError::write(folder, source))?;
    for (file, name, title, label) in CHARTS {
        let series = history.series(name);
        if !series.is_empty() {
            save(folder, file, &[chart(CHART_PX, title, label, &series)])?;
        }
    }
    // A term without weight is zero throughout and has no curve worth a panel.
    let mut terms = history.names(TERM_PREFIX);
    terms.retain(|name| history.series(name).iter().any(|point| point.1 != 0.0));
    if !terms.is_empty() {
        let panel = |name: &String| {
            let title = name.trim_start_matches(TERM_PREFIX);
            chart(PANEL_PX, title, "sum over an episode", &history.series(name))
        };
        let panels: Vec<Chart> = terms.iter().map(panel).collect();
        save(folder, "reward_terms", &panels)?;
    }
    Ok(())
}

fn save(folder: &Path, file: &str, charts: &[Chart]) -> Result<(), LearnerError> {
    let path = folder.join(format!("{file}.svg"));
    let svg = sheet(charts, PANELS_PER_ROW);
    caudata_durable::replace(&path, svg.as_bytes()).map_err(LearnerError::from)
}

fn chart(size: (f64, f64), title: &str, label: &str, series: &[(f64, f64)]) -> Chart {
    let x_max = series.last().map_or(1.0, |last| last.0);
    let (_, unit, x_label) = UNITS.into_iter().find(|unit| x_max >= unit.0).unwrap_or(UNITS[2]);
    let x: Vec<f64> = series.iter().map(|point| point.0 / unit).collect();
    let y: Vec<f64> = series.iter().map(|point| point.1).collect();
    let horizontal = Axis::exact(x.iter().copied().chain([0.0]));
    let mut chart = Chart::new(size, horizontal, Axis::over(y.iter().copied()), title, label);
    chart.line("after", &x, &y);
    chart.labels(x_label, label);
    chart
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Point;
    use std::collections::BTreeMap;

    fn history() -> History {
        let mut history = History::default();
        for i in 0..50 {
            let x = f64::from(i);
            let values = [
                ("mean_return", x.sqrt() * 10.0),
                ("kl", 0.01),
                ("steps_per_s", 70_000.0 + 1e3 * (x * 0.7).sin()),
                ("term/phase", x),
                ("term/power", -x * 1e-4),
                ("term/slip", 0.0),
            ];
            let values = BTreeMap::from(values.map(|(name, value)| (name.to_owned(), value)));
            history.push(Point { iterations: 1, steps: x * 1e5, values });
        }
        history
    }

    #[test]
    fn pictures_have_titles_axes_and_one_panel_per_term() {
        let dir = tempfile::tempdir().unwrap();
        draw_curves(dir.path(), &history()).unwrap();
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        let svg = read("return.svg");
        for text in ["Episode return", "environment steps, millions", "mean return of the last"] {
            assert!(svg.contains(text), "{text}");
        }
        let terms = read("reward_terms.svg");
        assert!(["phase", "power"].iter().all(|term| terms.contains(term)));
        assert!(!terms.contains("slip"), "a term that was never other than zero has no panel");
        assert!(!dir.path().join("episode_length.svg").exists(), "nothing known of it yet");
    }
}
