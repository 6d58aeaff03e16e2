//! The divergence map: how far simulation and measurement part, by joint and signal and regime, before and
//! after.

use std::collections::BTreeMap;
use std::fmt::Write;

use crate::report::{Divergence, Report};
use caudata_chart::{escape, number};

/// Ratios to the noise floor at which the colour changes: within the floor, seen, clear, strong, very strong.
const STEPS: [f64; 5] = [1.2, 2.0, 4.0, 8.0, 16.0];
const CELL_W: f64 = 46.0;
const CELL_H: f64 = 22.0;
const HEAD: f64 = 76.0;

type Cells<'a> = BTreeMap<(&'a str, &'a str, &'a str), &'a Divergence>;

/// Both maps, side by side where there is room.
pub fn maps(report: &Report) -> String {
    let after: Cells<'_> = cells(&report.divergence_after);
    let before: Cells<'_> = cells(&report.divergence);
    if before.is_empty() {
        return "<p class=\"soft\">No cell could be compared.</p>".to_owned();
    }
    let mut out = String::from("<div class=\"grid\">");
    let both = !after.is_empty();
    let title = if both { "As given" } else { "Model as given" };
    let _ = write!(
        out,
        "<figure class=\"card\"><figcaption><b>{title}</b></figcaption>{}</figure>",
        map(&before, &before, title)
    );
    if both {
        let title = "Extended";
        let _ = write!(
            out,
            "<figure class=\"card\"><figcaption><b>{title}</b></figcaption>{}</figure>",
            map(&after, &before, title)
        );
    }
    out.push_str("</div>");
    out.push_str(&legend());
    out
}

fn cells(all: &[Divergence]) -> Cells<'_> {
    all.iter()
        .map(|d| ((d.joint.as_str(), d.signal.as_str(), d.regime.as_str()), d))
        .collect()
}

/// Names in the order in which they first come up, worst first, but `all` before its parts.
fn order<'a>(names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut out: Vec<&str> = Vec::new();
    for n in names {
        if !out.contains(&n) {
            out.push(n);
        }
    }
    out.sort_by_key(|n| (*n != "all", *n));
    out
}

fn map(cells: &Cells<'_>, frame: &Cells<'_>, title: &str) -> String {
    let rows = {
        let mut joints: Vec<&str> = Vec::new();
        for (j, _, _) in frame.keys() {
            if !joints.contains(j) {
                joints.push(j);
            }
        }
        joints
    };
    let signals = order(frame.keys().map(|k| k.1));
    let columns: Vec<(&str, &str)> = signals
        .iter()
        .flat_map(|s| {
            let regimes = order(frame.keys().filter(|k| k.1 == *s).map(|k| k.2));
            regimes.into_iter().map(|r| (*s, r)).collect::<Vec<_>>()
        })
        .collect();
    let left = 12.0
        + 7.2
            * rows
                .iter()
                .map(|r| r.chars().count().max(5))
                .max()
                .unwrap_or(5) as f64;
    let (w, h) = (
        left + CELL_W * columns.len() as f64 + 8.0,
        HEAD + CELL_H * rows.len() as f64 + 4.0,
    );
    // A map of few columns does not grow over the whole card.
    let mut out = format!(
        r#"<svg viewBox="0 0 {w:.0} {h:.0}" style="max-width:{:.0}px" role="img" aria-label="{}: error over noise floor, {} rows by {} columns"><title>{}</title>"#,
        w * 1.35,
        escape(title),
        rows.len(),
        columns.len(),
        escape(title)
    );
    write_head(&mut out, left, &columns);
    for (r, joint) in rows.iter().enumerate() {
        let y = HEAD + CELL_H * r as f64;
        let name = if joint.is_empty() { "robot" } else { joint };
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="{:.1}" text-anchor="end">{}</text>"#,
            left - 7.0,
            y + 15.0,
            escape(name)
        );
        for (c, (signal, regime)) in columns.iter().enumerate() {
            let x = left + CELL_W * c as f64;
            let Some(d) = cells.get(&(*joint, *signal, *regime)) else {
                let _ = write!(
                    out,
                    r#"<rect x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="3" fill="none" class="g"/>"#,
                    x + 1.0,
                    y + 1.0,
                    CELL_W - 2.0,
                    CELL_H - 2.0
                );
                continue;
            };
            write_cell(&mut out, (x, y), name, d);
        }
    }
    out.push_str("</svg>");
    out
}

/// Signals, each over its regimes.
fn write_head(out: &mut String, left: f64, columns: &[(&str, &str)]) {
    let mut from = 0;
    while from < columns.len() {
        let to = columns[from..]
            .iter()
            .position(|c| c.0 != columns[from].0)
            .map_or(columns.len(), |n| from + n);
        let x = left + CELL_W * from as f64;
        let width = CELL_W * (to - from) as f64;
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="13" text-anchor="middle">{}</text><line class="g" x1="{:.1}" x2="{:.1}" y1="18" y2="18"/>"#,
            x + 0.5 * width,
            escape(columns[from].0),
            x + 3.0,
            x + width - 3.0
        );
        from = to;
    }
    for (c, (_, regime)) in columns.iter().enumerate() {
        let x = left + CELL_W * (c as f64 + 0.5) + 4.0;
        let _ = write!(
            out,
            r#"<text class="t" transform="translate({x:.1} {:.1}) rotate(-55)">{}</text>"#,
            HEAD - 6.0,
            escape(regime)
        );
    }
}

/// What is known of one cell, at its place.
fn write_cell(out: &mut String, (x, y): (f64, f64), name: &str, d: &Divergence) {
    let level = STEPS.iter().filter(|s| d.ratio >= **s).count();
    let about = format!(
        "{name} {}, {}: {} rms, noise floor {}, ratio {}, p {}",
        d.signal,
        d.regime,
        number(d.rmse),
        number(d.noise_floor),
        number(d.ratio),
        number(d.p)
    );
    let ink = if level >= 4 {
        " style=\"fill:var(--bg)\""
    } else {
        ""
    };
    let _ = write!(
        out,
        r#"<g><title>{}</title><rect x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="3" style="fill:var(--h{level})"/><text class="v" x="{:.1}" y="{:.1}" text-anchor="middle"{ink}>{}</text></g>"#,
        escape(&about),
        x + 1.0,
        y + 1.0,
        CELL_W - 2.0,
        CELL_H - 2.0,
        x + 0.5 * CELL_W,
        y + 15.0,
        number(if d.ratio >= 10.0 {
            d.ratio.round()
        } else {
            (10.0 * d.ratio).round() / 10.0
        })
    );
}

fn legend() -> String {
    let mut out = String::from(
        "<div class=\"key small\"><span>Error as a multiple of what repeats differ by:</span>",
    );
    let words = ["at the floor", "1.2", "2", "4", "8", "16 and more"];
    for (level, word) in words.iter().enumerate() {
        let _ = write!(
            out,
            "<span><i style=\"height:12px;border:0;border-radius:3px;background:var(--h{level})\"></i>{word}</span>"
        );
    }
    out.push_str("</div>");
    out
}
