//! Policies compared, as tables and as a chapter of a page.

use std::fmt::Write;

use caudata_gap::page::Chapter;
use caudata_gap::plots::{Series, Signature};

use super::figures::{Figures, Interval};
use super::results::{Compared, Trained};
use super::ways::Way;
use crate::Table;

impl Way {
    /// What people read, the class of its curve, and its colour on the page.
    fn look(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::AsGiven => ("model as given", "before", "--before"),
            Self::Extended => ("extended model", "after", "--after"),
            Self::Wide => ("as given, wide randomisation", "wide randomisation", "--ok"),
            Self::Truth => ("the robot's own model", "measured", "--meas"),
        }
    }
}

const HEAD: [&str; 5] = ["off forward m/s", "sideways m/s", "turning rad/s", "falls", "power W"];

/// In decimals, and zero without a sign.
fn number(x: f64, digits: usize) -> String {
    let text = format!("{x:.digits$}");
    match text.parse::<f64>() {
        Ok(0.0) => format!("{:.digits$}", 0.0),
        _ => text,
    }
}

/// `mean ± half`, without the interval where there is none.
fn cell(x: &Interval, digits: usize) -> String {
    let mean = number(x.mean, digits);
    match (x.ci_low, x.ci_high) {
        (Some(low), Some(high)) => {
            format!("{mean} ± {}", number(0.5 * (high - low), digits))
        }
        _ => mean,
    }
}

/// `mean (low to high)`: Wilson's interval is not symmetric.
fn share(x: &Interval) -> String {
    let percent = |x: f64| number(100.0 * x, 1);
    let mean = percent(x.mean);
    match (x.ci_low, x.ci_high) {
        (Some(low), Some(high)) => format!("{mean} % ({} to {})", percent(low), percent(high)),
        _ => format!("{mean} %"),
    }
}

fn cells(figures: &Figures) -> [String; 5] {
    [
        cell(&figures.forward_mps, 3),
        cell(&figures.sideways_mps, 3),
        cell(&figures.turning_radps, 3),
        share(&figures.falls),
        cell(&figures.power_w, 1),
    ]
}

/// Five tables of figures, a row for each way that has them.
pub fn tables(compared: &Compared) -> Vec<Table> {
    let table = |of: String, figures: &dyn Fn(&Trained) -> Option<&Figures>| {
        let row = |way: &Trained| {
            let name = std::iter::once(way.way.look().0.to_owned());
            Some(name.chain(cells(figures(way)?)).collect())
        };
        let head = std::iter::once(of).chain(HEAD.map(str::to_owned));
        Table { head: head.collect(), rows: compared.ways.iter().filter_map(row).collect() }
    };
    let suite = &compared.suite;
    vec![
        table(format!("on the robot ({suite})"), &|w| Some(&w.in_truth)),
        table("less than trained in the model as given".into(), &|w| w.gain.as_ref()),
        table(format!("in the model that it was trained in ({suite})"), &|w| Some(&w.at_home)),
        table("on the robot in Rapier (forward velocities that change)".into(), &|w| {
            Some(&w.in_rapier)
        }),
        table("less than trained in the model as given, in Rapier".into(), &|w| {
            w.gain_in_rapier.as_ref()
        }),
    ]
}

/// What stands below the tables.
pub fn about(compared: &Compared) -> String {
    let intervals = match compared.seeds {
        1 => "one training each, so that nothing is known of how trainings differ".to_owned(),
        n => format!(
            "{n} trainings each; ± is the 95 % interval over them, paired by seed where something is less"
        ),
    };
    let samples = compared.iterations;
    format!("{samples} iterations, {intervals}; of falls over all episodes")
}

/// The chapter of a page.
pub fn chapter(compared: &Compared) -> Chapter {
    let mut lead = format!(
        "<p class=\"soft\">Policies trained in the same way, from the same start and with as many samples, run on the robot that was recorded: {}.</p>",
        about(compared)
    );
    lead.extend(tables(compared).iter().map(Table::html));
    lead.push_str("<div class=\"key\"><span>trained in:</span>");
    for way in &compared.ways {
        let (words, _, colour) = way.way.look();
        let _ = write!(lead, "<span><i style=\"border-color:var({colour})\"></i>{words}</span>");
    }
    lead.push_str("<span><i class=\"kc\"></i>command</span></div>");
    Chapter { title: "Policies".into(), lead, figures: pictures(compared) }
}

/// Forward velocity over time, and the way achieved velocity goes with the commanded one.
fn pictures(compared: &Compared) -> Vec<Signature> {
    let signature = |title: &str, x: &str, y: &str, series| Signature {
        effect: String::new(),
        joint: String::new(),
        title: title.into(),
        x_label: x.into(),
        y_label: y.into(),
        series,
    };
    let Some(first) = compared.ways.first() else { return Vec::new() };
    let mut over_time = vec![line("command", &first.speed.time_s, &first.speed.command_mps)];
    let mut against = Vec::new();
    for way in &compared.ways {
        let (speed, (_, class, _)) = (&way.speed, way.way.look());
        over_time.push(Series {
            spread: speed.sd_mps.clone(),
            ..line(class, &speed.time_s, &speed.mean_mps)
        });
        let (commands, held) = way.speed.held();
        if against.is_empty() {
            against.push(line("command", &commands, &commands));
        }
        against.push(line(class, &commands, &held));
    }
    vec![
        signature(
            "Forward velocity on the robot in Rapier, band: standard deviation",
            "time, s",
            "velocity, m/s",
            over_time,
        ),
        signature(
            "Achieved against commanded, the last two seconds of each command",
            "commanded, m/s",
            "achieved, m/s",
            against,
        ),
    ]
}

fn line(label: &str, x: &[f64], y: &[f64]) -> Series {
    Series { label: label.into(), scatter: false, x: x.to_vec(), y: y.to_vec(), spread: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policies::speed::Speed;

    #[test]
    fn figures_read_with_their_intervals() {
        let x = Interval::of(&[0.010, 0.012, 0.014]);
        // s = 0.002, over √3 times 4.303: 0.004969
        assert_eq!(cell(&x, 3), "0.012 ± 0.005");
        assert_eq!(cell(&Interval::of(&[0.01]), 3), "0.010");
        let falls = Interval { mean: 0.1, ci_low: Some(0.05), ci_high: Some(0.2) };
        assert_eq!(share(&falls), "10.0 % (5.0 to 20.0)");
        assert_eq!(number(-1e-9, 3), "0.000");
    }

    #[test]
    fn the_chapter_has_every_way_and_its_curve() {
        let way = |way, gain: Option<Figures>| Trained {
            way,
            robot: "r".into(),
            set: Vec::new(),
            policies: Vec::new(),
            at_home: Figures::default(),
            in_truth: Figures::default(),
            in_rapier: Figures::default(),
            gain_in_rapier: gain.clone(),
            gain,
            speed: Speed {
                time_s: vec![0.0, 2.5],
                command_mps: vec![0.1, 0.1],
                mean_mps: vec![0.0, 0.08],
                sd_mps: vec![0.0, 0.01],
            },
        };
        let compared = Compared {
            seeds: 3,
            iterations: 10,
            suite: "omni".into(),
            ways: vec![
                way(Way::AsGiven, None),
                way(Way::Extended, Some(Figures::default())),
                way(Way::Wide, Some(Figures::default())),
            ],
            seconds: Vec::new(),
        };
        let chapter = chapter(&compared);
        assert_eq!(chapter.lead.matches("<td>extended model</td>").count(), 5);
        assert_eq!(chapter.lead.matches("<td>model as given</td>").count(), 3);
        let labels: Vec<&str> =
            chapter.figures[0].series.iter().map(|s| s.label.as_str()).collect();
        assert_eq!(labels, ["command", "before", "after", "wide randomisation"]);
        assert_eq!(chapter.figures[1].series[2].y, [0.08]);
    }
}
