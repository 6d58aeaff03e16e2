//! The page's curves and bars, from what a diagnosis left in [`Plots`].

use super::drawing::Drawing;
use crate::plots::{Correlation, Horizon, Hypothesis, Overlay, Signature};
use crate::report::Report;
use caudata_chart::{Axis, Chart, escape, number};

const WIDE: (f64, f64) = (470.0, 240.0);

// How texts of pictures look: names of rows, values, figures on axes.
pub(super) const NAME: &str = r#"class="n""#;
pub(super) const VALUE: &str = r#"class="v""#;
pub(super) const TICK: &str = r#"class="t""#;

pub(super) fn figure(caption: &str, picture: &str) -> String {
    format!("<figure class=\"card\"><figcaption>{caption}</figcaption>{picture}</figure>")
}

fn known(values: &[Option<f64>]) -> Vec<f64> {
    values.iter().map(|x| x.unwrap_or(f64::NAN)).collect()
}

/// Key of the curves.
pub fn key(extended: bool) -> String {
    let mut out = String::from(
        "<div class=\"key\"><span><i style=\"border-color:var(--meas)\"></i>measured</span><span><i class=\"kb\"></i>range of repeats</span><span><i style=\"border-color:var(--before)\"></i>simulation as given</span>",
    );
    if extended {
        out.push_str("<span><i style=\"border-color:var(--after)\"></i>simulation extended</span>");
    }
    out.push_str("<span><i class=\"kc\"></i>command</span></div>");
    out
}

/// Measured band against old and new simulation, one cell each.
pub fn overlay(o: &Overlay) -> String {
    let (measured, low, high) =
        (known(&o.measured), known(&o.measured_low), known(&o.measured_high));
    let y = [&measured, &low, &high, &o.before, &o.after].into_iter().flatten().copied();
    // A command far away (a weak servo) must not flatten what is compared.
    let y = Axis::over(y);
    let title = format!("{} {}", o.joint, o.signal);
    let about = format!(
        "{title} in {}: measured against simulation over {} s",
        o.run,
        number(o.time_s.last().unwrap_or(&0.0) - o.time_s.first().unwrap_or(&0.0))
    );
    let mut c = Chart::new(WIDE, Axis::exact(o.time_s.iter().copied()), y, &title, &about);
    c.band("band", &o.time_s, &low, &high);
    let command: Vec<f64> = o
        .command
        .iter()
        .map(|u| if (-0.02..=1.02).contains(&y.place(*u)) { *u } else { f64::NAN })
        .collect();
    c.line("command", &o.time_s, &command);
    c.line("measured", &o.time_s, &measured);
    c.line("before", &o.time_s, &o.before);
    c.line("after", &o.time_s, &o.after);
    c.labels("time, s", &format!("{}, {}", o.signal, o.unit));
    figure(&format!("<b>{}</b> in {}", escape(&title), escape(&o.run)), &c.finish())
}

/// A cause's own mark.
pub fn signature(s: &Signature) -> String {
    let (xs, ys) = (
        || s.series.iter().flat_map(|r| r.x.iter().copied()),
        || {
            s.series.iter().flat_map(|r| {
                let spread = |i: usize| r.spread.get(i).copied().unwrap_or(0.0);
                r.y.iter().enumerate().flat_map(move |(i, y)| [y - spread(i), y + spread(i)])
            })
        },
    );
    let octaves = s.x_label.contains("Hz") && xs().all(|x| x > 0.0);
    let x = if octaves { Axis::log_over(xs()) } else { Axis::over(xs()) };
    let about = format!("{}: {} against {}", s.title, s.y_label, s.x_label);
    let mut c = Chart::new(WIDE, x, Axis::over(ys()), &s.title, &about);
    for r in &s.series {
        let class = match r.label.as_str() {
            "measured" | "before" | "after" | "command" => r.label.as_str(),
            _ => "other",
        };
        if !r.spread.is_empty() {
            let edge = |sign: f64| -> Vec<f64> {
                r.y.iter().zip(&r.spread).map(|(y, d)| y + sign * d).collect()
            };
            c.band(&format!("b-{class}"), &r.x, &edge(-1.0), &edge(1.0));
        }
        if r.scatter {
            c.points(&format!("p-{class}"), &r.x, &r.y);
        } else {
            c.line(class, &r.x, &r.y);
        }
    }
    c.labels(&s.x_label, &s.y_label);
    let others: Vec<String> = s
        .series
        .iter()
        .filter(|r| !["measured", "before", "after", "command"].contains(&r.label.as_str()))
        .map(|r| escape(&r.label))
        .collect();
    let more =
        if others.is_empty() { String::new() } else { format!(" · green: {}", others.join(", ")) };
    figure(&format!("<b>{}</b> {}{more}", escape(&s.title), escape(&s.joint)), &c.finish())
}

/// Error against how far ahead is predicted.
pub fn horizon(h: &Horizon) -> String {
    let ys = h.before.iter().chain(&h.after).chain(&h.floor).copied();
    let title = format!("{}: error against horizon", h.signal);
    let mut c = Chart::new(
        WIDE,
        Axis::log_over(h.horizon_s.iter().copied()),
        Axis::over(ys).with(0.0),
        &title,
        &title,
    );
    c.line("floor", &h.horizon_s, &h.floor);
    for (class, y) in [("before", &h.before), ("after", &h.after)] {
        c.line(class, &h.horizon_s, y);
        c.points(&format!("p-{class}"), &h.horizon_s, y);
    }
    c.labels("predicted ahead, s", &format!("error, {}", h.unit));
    figure(
        &format!(
            "<b>{}</b> by horizon, held-out runs; dotted: what repeats differ by",
            escape(&h.signal)
        ),
        &c.finish(),
    )
}

/// Hypotheses with what they explain on held-out runs.
pub fn hypotheses(all: &[Hypothesis]) -> String {
    const MOST: usize = 16;
    let shown = &all[..all.len().min(MOST)];
    let (left, row, width) = (290.0, 24.0, 860.0);
    let height = row * shown.len() as f64 + 30.0;
    let shares = shown.iter().flat_map(|h| [h.ci_low, h.ci_high, h.share_holdout]);
    let shares = shares.filter(|x| x.is_finite()).map(|x| x.clamp(-1.0, 1.0));
    let (low, high) = shares.fold((0.0f64, 0.1f64), |(l, h), x| (l.min(x), h.max(x)));
    let right = width - 120.0;
    let px = |x: f64| left + (x.clamp(low, high) - low) / (high - low) * (right - left);
    let about = "share of the excess error that each hypothesis explains on held-out runs";
    let mut out = Drawing::new((width, height), 900.0, "Hypotheses", about);
    for (i, h) in shown.iter().enumerate() {
        let y = row * i as f64;
        let place = match h.location.as_slice() {
            [] => String::new(),
            some => format!(" @ {}", short_list(some)),
        };
        let look = match h.in_answer_set {
            true => r#"class="bar-set" rx="2""#,
            false => r#"class="bar-out" rx="2""#,
        };
        let (name, tick) = match h.accepted {
            true => (r#"class="n" style="font-weight:650""#, " ✓"),
            false => (NAME, ""),
        };
        out.text(name, "end", (left - 8.0, y + 16.0), &format!("{}{place}", h.effect));
        let (zero, end) = (px(0.0), px(h.share_holdout));
        let size = ((end - zero).abs().max(1.0), row - 10.0);
        out.bar(look, (zero.min(end), y + 5.0), size);
        let (from, to, middle, top) = (px(h.ci_low), px(h.ci_high), y + 12.0, y + 8.0);
        let ends = format!("M{from:.1} {top:.1}v8M{to:.1} {top:.1}v8");
        out.push(&format!(r#"<path class="whisk" d="M{from:.1} {middle:.1}H{to:.1}{ends}"/>"#));
        let probability = format!("{} %{tick}", number(100.0 * h.probability));
        out.text(VALUE, "start", (right + 8.0, y + 16.0), &probability);
    }
    out.rule(px(0.0), height - 26.0);
    out.text(TICK, "middle", (px(0.0), height - 10.0), "0");
    let most = format!("{} of the excess error explained on held-out runs", number(high));
    out.text(TICK, "end", (right, height - 10.0), &most);
    let more = match all.len() - shown.len() {
        0 => String::new(),
        left_out => format!(" {left_out} more explain less."),
    };
    figure(
        &format!(
            "<b>What was tried</b>: share explained with its 95 % interval, and the probability on the right. Coloured: in the answer set; ✓ accepted.{more}"
        ),
        &out.finish(),
    )
}

/// `a, b and 3 more`.
pub fn short_list(names: &[String]) -> String {
    match names {
        [] => "whole robot".to_owned(),
        [a] => a.clone(),
        [a, b] => format!("{a}, {b}"),
        [a, b, rest @ ..] => format!("{a}, {b} and {} more", rest.len()),
    }
}

/// Correlation of parameters that were fitted together.
pub fn correlation(c: &Correlation) -> String {
    let n = c.names.len();
    let longest = c.names.iter().map(|s| s.chars().count()).max().unwrap_or(4);
    let (cell, left) = (26.0, 16.0 + 6.6 * longest as f64);
    let (w, h) = (left + cell * n as f64 + 10.0, 8.0 + cell * n as f64 + 22.0);
    let title = "Correlation of fitted parameters";
    let mut out = Drawing::new((w, h), 1.3 * w, title, "correlation of fitted parameters");
    for (i, name) in c.names.iter().enumerate() {
        let y = 6.0 + cell * i as f64;
        out.text(NAME, "end", (left - 6.0, y + 17.0), &format!("{name} {}", i + 1));
        let below = (left + cell * (i as f64 + 0.5), h - 8.0);
        out.text(TICK, "middle", below, &(i + 1).to_string());
        for (k, r) in c.matrix.get(i).into_iter().flatten().enumerate() {
            let colour = if *r >= 0.0 { "after" } else { "before" };
            let opacity = 0.06 + 0.9 * r.abs().min(1.0);
            let look = format!(r#"rx="3" style="fill:var(--{colour});opacity:{opacity:.2}""#);
            let other = c.names.get(k).map_or("", String::as_str);
            out.told(&format!("{name} and {other}: {}", number(*r)), |out| {
                let at = (left + cell * k as f64 + 1.0, y + 1.0);
                out.bar(&look, at, (cell - 2.0, cell - 2.0));
            });
        }
    }
    figure(
        "<b>Parameters that were fitted together</b>: strong colour means that the data hardly tell them apart",
        &out.finish(),
    )
}

/// Error by signal before and after, with the interval of the ratio.
pub fn gains(report: &Report) -> String {
    let (left, row, width) = (110.0, 46.0, 760.0);
    let height = row * report.gain.len() as f64 + 8.0;
    let right = width - 230.0;
    let about = "error on held-out runs before and after, by signal";
    let mut out = Drawing::new((width, height), 820.0, "Gain on held-out runs", about);
    for (i, (signal, g)) in report.gain.iter().enumerate() {
        let y = row * i as f64;
        let most = g.before.max(g.after).max(1e-300);
        let [before, after] = [g.before, g.after].map(|x| (x / most * (right - left)).max(1.0));
        out.text(NAME, "end", (left - 8.0, y + 24.0), signal);
        out.bar(r#"class="bar-before" rx="2""#, (left, y + 5.0), (before, 14.0));
        out.bar(r#"class="bar-after" rx="2""#, (left, y + 21.0), (after, 14.0));
        out.text(VALUE, "start", (left + before + 6.0, y + 16.5), &number(g.before));
        let [after_is, ratio, low, high] = [g.after, g.ratio, g.ci_low, g.ci_high].map(number);
        let said = format!("{after_is} · × {ratio} ({low} to {high})");
        out.text(VALUE, "start", (left + after + 6.0, y + 32.5), &said);
    }
    figure(
        "<b>Root mean square error on held-out runs</b>, as given and extended, SI units; × ratio with its 95 % interval",
        &out.finish(),
    )
}
