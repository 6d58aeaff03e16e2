//! The divergence map: how far simulation and measurement part, by joint and signal and regime, before and
//! after.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::drawing::Drawing;
use super::figures::{NAME, TICK, VALUE, figure};
use crate::report::{Divergence, Report};
use caudata_chart::number;

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
    let both = !after.is_empty();
    let card = |cells, title| figure(&format!("<b>{title}</b>"), &map(cells, &before, title));
    let given = if both { "As given" } else { "Model as given" };
    let extended = if both { card(&after, "Extended") } else { String::new() };
    let given = card(&before, given);
    format!("<div class=\"grid\">{given}{extended}</div>{}", legend())
}

fn cells(all: &[Divergence]) -> Cells<'_> {
    all.iter().map(|d| ((d.joint.as_str(), d.signal.as_str(), d.regime.as_str()), d)).collect()
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
    let mut rows: Vec<&str> = Vec::new();
    for (joint, _, _) in frame.keys() {
        if !rows.contains(joint) {
            rows.push(joint);
        }
    }
    let signals = order(frame.keys().map(|k| k.1));
    let regimes = |s: &str| order(frame.keys().filter(|k| k.1 == s).map(|k| k.2));
    let columns = signals.iter().flat_map(|s| regimes(s).into_iter().map(|r| (*s, r)));
    let columns: Vec<(&str, &str)> = columns.collect();
    let longest = rows.iter().map(|r| r.chars().count().max(5)).max();
    let left = 12.0 + 7.2 * longest.unwrap_or(5) as f64;
    let w = left + CELL_W * columns.len() as f64 + 8.0;
    let h = HEAD + CELL_H * rows.len() as f64 + 4.0;
    let size = format!("{} rows by {} columns", rows.len(), columns.len());
    let about = format!("{title}: error over noise floor, {size}");
    // A map of few columns does not grow over the whole card.
    let mut out = Drawing::new((w, h), w * 1.35, title, &about);
    write_head(&mut out, left, &columns);
    for (r, joint) in rows.iter().enumerate() {
        let y = HEAD + CELL_H * r as f64;
        let name = if joint.is_empty() { "robot" } else { joint };
        out.text(NAME, "end", (left - 7.0, y + 15.0), name);
        for (c, (signal, regime)) in columns.iter().enumerate() {
            let at = (left + CELL_W * c as f64, y);
            match cells.get(&(*joint, *signal, *regime)) {
                Some(d) => write_cell(&mut out, at, name, d),
                None => write_box(&mut out, at, r#"fill="none" class="g""#),
            }
        }
    }
    out.finish()
}

fn write_box(out: &mut Drawing, (x, y): (f64, f64), look: &str) {
    let look = format!(r#"rx="3" {look}"#);
    out.bar(&look, (x + 1.0, y + 1.0), (CELL_W - 2.0, CELL_H - 2.0));
}

/// Signals, each over its regimes.
fn write_head(out: &mut Drawing, left: f64, columns: &[(&str, &str)]) {
    let mut from = 0;
    while from < columns.len() {
        let to = columns[from..]
            .iter()
            .position(|c| c.0 != columns[from].0)
            .map_or(columns.len(), |n| from + n);
        let x = left + CELL_W * from as f64;
        let width = CELL_W * (to - from) as f64;
        let middle = x + 0.5 * width;
        out.text(NAME, "middle", (middle, 13.0), columns[from].0);
        let (begin, end) = (x + 3.0, x + width - 3.0);
        let line = format!(r#"x1="{begin:.1}" x2="{end:.1}" y1="18" y2="18""#);
        out.push(&format!(r#"<line class="g" {line}/>"#));
        from = to;
    }
    for (c, (_, regime)) in columns.iter().enumerate() {
        let x = left + CELL_W * (c as f64 + 0.5) + 4.0;
        let turn = format!("translate({x:.1} {:.1}) rotate(-55)", HEAD - 6.0);
        let look = format!(r#"{TICK} transform="{turn}""#);
        out.text(&look, "start", (0.0, 0.0), regime);
    }
}

/// What is known of one cell, at its place.
fn write_cell(out: &mut Drawing, (x, y): (f64, f64), name: &str, d: &Divergence) {
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
    let ink = match level {
        4.. => r#"class="v" style="fill:var(--bg)""#,
        _ => VALUE,
    };
    let ratio = if d.ratio >= 10.0 { d.ratio.round() } else { (10.0 * d.ratio).round() / 10.0 };
    out.told(&about, |out| {
        write_box(out, (x, y), &format!(r#"style="fill:var(--h{level})""#));
        let middle = (x + 0.5 * CELL_W, y + 15.0);
        out.text(ink, "middle", middle, &number(ratio));
    });
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
