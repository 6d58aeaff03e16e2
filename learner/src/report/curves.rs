//! The curves of a run as SVG pictures, one file per quantity.

use std::path::Path;

use plotters::coord::Shift;
use plotters::prelude::*;

use super::history::History;
use crate::LearnerError;

/// Size of one chart, pixels.
const CHART_PX: (u32, u32) = (760, 420);
/// Size of one chart among several in a picture, pixels.
const PANEL_PX: (u32, u32) = (480, 280);
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
    (
        "return",
        "mean_return",
        "Episode return",
        "mean return of the last 100 episodes",
    ),
    (
        "episode_length",
        "mean_episode_length",
        "Episode length",
        "control steps",
    ),
    (
        "step_reward",
        "mean_step_reward",
        "Reward per step",
        "mean over the batch",
    ),
    ("kl", "kl", "KL divergence of an update", "nats"),
    ("std", "mean_std", "Action noise", "mean standard deviation"),
    (
        "steps_per_s",
        "steps_per_s",
        "Speed",
        "environment steps per second",
    ),
    (
        "value_loss",
        "value_loss",
        "Value loss",
        "¼ · mean squared error",
    ),
    (
        "learning_rate",
        "learning_rate",
        "Learning rate",
        "after the iteration",
    ),
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
            let svg = picture(CHART_PX, |area| chart(area, title, label, &series))?;
            save(folder, file, &svg)?;
        }
    }
    // A term without weight is zero throughout and has no curve worth a panel.
    let mut terms = history.names(TERM_PREFIX);
    terms.retain(|name| history.series(name).iter().any(|point| point.1 != 0.0));
    if !terms.is_empty() {
        save(folder, "reward_terms", &term_panels(history, &terms)?)?;
    }
    Ok(())
}

fn save(folder: &Path, file: &str, svg: &str) -> Result<(), LearnerError> {
    let path = folder.join(format!("{file}.svg"));
    caudata_durable::replace(&path, svg.as_bytes()).map_err(LearnerError::from)
}

fn term_panels(history: &History, terms: &[String]) -> Result<String, LearnerError> {
    let columns = PANELS_PER_ROW.min(terms.len());
    let rows = terms.len().div_ceil(columns);
    let size = (PANEL_PX.0 * columns as u32, PANEL_PX.1 * rows as u32);
    picture(size, |area| {
        for (panel, name) in area.split_evenly((rows, columns)).iter().zip(terms) {
            let title = name.trim_start_matches(TERM_PREFIX);
            chart(panel, title, "sum over an episode", &history.series(name))?;
        }
        Ok(())
    })
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

fn picture(size: (u32, u32), draw: impl FnOnce(&Area) -> Drawn) -> Result<String, LearnerError> {
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let drawn = area.fill(&WHITE).map_err(Into::into);
        let drawn = drawn.and_then(|()| draw(&area));
        drawn
            .and_then(|()| area.present().map_err(Into::into))
            .map_err(|error| LearnerError::Picture(error.to_string()))?;
    }
    Ok(svg)
}

fn chart(area: &Area, title: &str, label: &str, series: &[(f64, f64)]) -> Drawn {
    let x_max = series.last().map_or(1.0, |last| last.0);
    let (_, unit, x_label) = UNITS
        .into_iter()
        .find(|unit| x_max >= unit.0)
        .unwrap_or(UNITS[2]);
    let (low, high) = vertical_range(series);
    let mut context = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(42)
        .y_label_area_size(72)
        .build_cartesian_2d(0.0..(x_max / unit).max(f64::MIN_POSITIVE), low..high)?;
    context
        .configure_mesh()
        .x_desc(x_label)
        .y_desc(label)
        .x_labels(6)
        .y_labels(6)
        .light_line_style(WHITE)
        .x_label_formatter(&|x| number(*x))
        .y_label_formatter(&|y| {
            number(if y.abs() < 1e-6 * (high - low) {
                0.0
            } else {
                *y
            })
        })
        .label_style(("sans-serif", 13))
        .axis_desc_style(("sans-serif", 14))
        .draw()?;
    let points = series.iter().map(|&(x, y)| (x / unit, y));
    context.draw_series(LineSeries::new(points, BLUE.stroke_width(2)))?;
    Ok(())
}

/// The values with a twentieth of room above and below; never empty.
fn vertical_range(series: &[(f64, f64)]) -> (f64, f64) {
    let finite = || series.iter().map(|point| point.1).filter(|y| y.is_finite());
    let low = finite().fold(f64::INFINITY, f64::min);
    let high = finite().fold(f64::NEG_INFINITY, f64::max);
    if low > high {
        return (0.0, 1.0);
    }
    let room = ((high - low) * 0.05)
        .max(high.abs().max(low.abs()) * 0.01)
        .max(1e-9);
    (low - room, high + room)
}

/// A number in three or four digits.
fn number(x: f64) -> String {
    let size = x.abs();
    if size >= 1e5 || (size > 0.0 && size < 1e-3) {
        format!("{x:.1e}")
    } else if size >= 100.0 || x.fract() == 0.0 {
        format!("{x:.0}")
    } else if size >= 1.0 {
        format!("{x:.2}")
    } else {
        format!("{x:.4}").trim_end_matches('0').to_owned()
    }
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
            history.push(Point {
                iterations: 1,
                steps: x * 1e5,
                values,
            });
        }
        history
    }

    #[test]
    fn pictures_have_titles_axes_and_one_panel_per_term() {
        let dir = tempfile::tempdir().unwrap();
        draw_curves(dir.path(), &history()).unwrap();
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        let svg = read("return.svg");
        for text in [
            "Episode return",
            "environment steps, millions",
            "mean return of the last",
        ] {
            assert!(svg.contains(text), "{text}");
        }
        let terms = read("reward_terms.svg");
        assert!(["phase", "power"].iter().all(|term| terms.contains(term)));
        assert!(
            !terms.contains("slip"),
            "a term that was never other than zero has no panel"
        );
        assert!(
            !dir.path().join("episode_length.svg").exists(),
            "nothing known of it yet"
        );
    }

    #[test]
    fn flat_and_strange_values_have_a_range() {
        let (low, high) = vertical_range(&[(0.0, 2.0), (1.0, 2.0)]);
        assert!(low < 2.0 && high > 2.0);
        assert_eq!(vertical_range(&[(0.0, f64::NAN)]), (0.0, 1.0));
    }

    #[test]
    fn numbers_are_short() {
        let shown: Vec<String> = [0.0, 3.0, 0.25, 12.5, 1234.5, 2.5e6, 1e-5]
            .map(number)
            .into_iter()
            .collect();
        assert_eq!(
            shown,
            ["0", "3", "0.25", "12.50", "1234", "2.5e6", "1.0e-5"]
        );
    }
}
