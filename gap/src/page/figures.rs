//! The page's curves and bars, from what a diagnosis left in [`Plots`].

use std::fmt::Write;

use crate::plots::{Correlation, Horizon, Hypothesis, Overlay, Signature, WaterfallStep};
use crate::report::Report;
use caudata_chart::{Axis, Chart, escape, number};

const WIDE: (f64, f64) = (470.0, 240.0);

fn figure(caption: &str, picture: &str) -> String {
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
    let (measured, low, high) = (
        known(&o.measured),
        known(&o.measured_low),
        known(&o.measured_high),
    );
    let y = [&measured, &low, &high, &o.before, &o.after]
        .into_iter()
        .flatten()
        .copied();
    // A command far away (a weak servo) must not flatten what is compared.
    let y = Axis::over(y);
    let title = format!("{} {}", o.joint, o.signal);
    let about = format!(
        "{title} in {}: measured against simulation over {} s",
        o.run,
        number(o.time_s.last().unwrap_or(&0.0) - o.time_s.first().unwrap_or(&0.0))
    );
    let mut c = Chart::new(
        WIDE,
        Axis::exact(o.time_s.iter().copied()),
        y,
        &title,
        &about,
    );
    c.band("band", &o.time_s, &low, &high);
    let command: Vec<f64> = o
        .command
        .iter()
        .map(|u| {
            if (-0.02..=1.02).contains(&y.place(*u)) {
                *u
            } else {
                f64::NAN
            }
        })
        .collect();
    c.line("command", &o.time_s, &command);
    c.line("measured", &o.time_s, &measured);
    c.line("before", &o.time_s, &o.before);
    c.line("after", &o.time_s, &o.after);
    c.labels("time, s", &format!("{}, {}", o.signal, o.unit));
    figure(
        &format!("<b>{}</b> in {}", escape(&title), escape(&o.run)),
        &c.finish(),
    )
}

/// A cause's own mark.
pub fn signature(s: &Signature) -> String {
    let (xs, ys) = (
        || s.series.iter().flat_map(|r| r.x.iter().copied()),
        || {
            s.series.iter().flat_map(|r| {
                let spread = |i: usize| r.spread.get(i).copied().unwrap_or(0.0);
                r.y.iter()
                    .enumerate()
                    .flat_map(move |(i, y)| [y - spread(i), y + spread(i)])
            })
        },
    );
    let octaves = s.x_label.contains("Hz") && xs().all(|x| x > 0.0);
    let x = if octaves {
        Axis::log_over(xs())
    } else {
        Axis::over(xs())
    };
    let about = format!("{}: {} against {}", s.title, s.y_label, s.x_label);
    let mut c = Chart::new(WIDE, x, Axis::over(ys()), &s.title, &about);
    for r in &s.series {
        let class = match r.label.as_str() {
            "measured" | "before" | "after" | "command" => r.label.as_str(),
            _ => "other",
        };
        if !r.spread.is_empty() {
            let edge = |sign: f64| -> Vec<f64> {
                r.y.iter()
                    .zip(&r.spread)
                    .map(|(y, d)| y + sign * d)
                    .collect()
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
    let more = if others.is_empty() {
        String::new()
    } else {
        format!(" · green: {}", others.join(", "))
    };
    figure(
        &format!("<b>{}</b> {}{more}", escape(&s.title), escape(&s.joint)),
        &c.finish(),
    )
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

/// How the misfit falls from cause to cause.
pub fn waterfall(steps: &[WaterfallStep]) -> String {
    let steps: Vec<WaterfallStep> = steps
        .iter()
        .filter(|s| s.misfit.is_finite())
        .cloned()
        .collect();
    let most = steps.iter().map(|s| s.misfit).fold(1.0, f64::max);
    let (left, row, width) = (230.0, 30.0, 760.0);
    let height = row * steps.len() as f64 + 26.0;
    let scale = |x: f64| left + (x.max(0.0) / most) * (width - left - 70.0);
    let mut out = format!(
        r#"<svg viewBox="0 0 {width:.0} {height:.0}" style="max-width:860px" role="img" aria-label="misfit after each cause"><title>Misfit after each cause</title>"#
    );
    for (i, s) in steps.iter().enumerate() {
        let y = row * i as f64;
        let before = if i == 0 {
            s.misfit
        } else {
            steps[i - 1].misfit
        };
        let class = match s.label.as_str() {
            "floor" => "bar-out",
            _ if i == 0 => "bar-before",
            _ => "bar-after",
        };
        let fall = (before - s.misfit).max(0.0);
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="{:.1}" text-anchor="end">{}</text><rect class="{class}" x="{left:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="2"/>"#,
            left - 8.0,
            y + 19.0,
            escape(&s.label),
            y + 6.0,
            (scale(s.misfit) - left).max(1.5),
            row - 11.0
        );
        if fall > 0.0 && s.label != "floor" {
            let _ = write!(
                out,
                r#"<rect x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="2" style="fill:none;stroke:var(--soft);stroke-dasharray:3 3"/>"#,
                scale(s.misfit),
                y + 6.0,
                scale(before) - scale(s.misfit),
                row - 11.0
            );
        }
        let _ = write!(
            out,
            r#"<text class="v" x="{:.1}" y="{:.1}">{}</text>"#,
            scale(before.max(s.misfit)) + 6.0,
            y + 19.0,
            number(s.misfit)
        );
    }
    let floor = scale(1.0);
    let _ = write!(
        out,
        r#"<line class="floor" x1="{floor:.1}" x2="{floor:.1}" y1="0" y2="{:.1}"/><text class="t" x="{floor:.1}" y="{:.1}" text-anchor="middle">1 = noise</text></svg>"#,
        height - 20.0,
        height - 6.0
    );
    figure(
        "<b>Mean squared error on held-out runs</b>, in units of the noise, after each cause; dashed: what the cause took away",
        &out,
    )
}

/// Hypotheses with what they explain on held-out runs.
pub fn hypotheses(all: &[Hypothesis]) -> String {
    const MOST: usize = 16;
    let shown = &all[..all.len().min(MOST)];
    let (left, row, width) = (290.0, 24.0, 860.0);
    let height = row * shown.len() as f64 + 30.0;
    let (low, high) = shown
        .iter()
        .flat_map(|h| [h.ci_low, h.ci_high, h.share_holdout])
        .filter(|x| x.is_finite())
        .fold((0.0f64, 0.1f64), |(l, h), x| {
            (l.min(x.max(-1.0)), h.max(x.min(1.0)))
        });
    let right = width - 120.0;
    let px = |x: f64| left + (x.clamp(low, high) - low) / (high - low) * (right - left);
    let mut out = format!(
        r#"<svg viewBox="0 0 {width:.0} {height:.0}" style="max-width:900px" role="img" aria-label="share of the excess error that each hypothesis explains on held-out runs"><title>Hypotheses</title>"#
    );
    for (i, h) in shown.iter().enumerate() {
        let y = row * i as f64;
        let place = if h.location.is_empty() {
            String::new()
        } else {
            format!(" @ {}", short_list(&h.location))
        };
        let class = if h.in_answer_set {
            "bar-set"
        } else {
            "bar-out"
        };
        let (zero, end) = (px(0.0), px(h.share_holdout));
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="{:.1}" text-anchor="end"{}>{}</text><rect class="{class}" x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="2"/><path class="whisk" d="M{:.1} {m:.1}H{:.1}M{:.1} {a:.1}v8M{:.1} {a:.1}v8"/><text class="v" x="{:.1}" y="{:.1}">{} %{}</text>"#,
            left - 8.0,
            y + 16.0,
            if h.accepted {
                " style=\"font-weight:650\""
            } else {
                ""
            },
            escape(&format!("{}{place}", h.effect)),
            zero.min(end),
            y + 5.0,
            (end - zero).abs().max(1.0),
            row - 10.0,
            px(h.ci_low),
            px(h.ci_high),
            px(h.ci_low),
            px(h.ci_high),
            right + 8.0,
            y + 16.0,
            number(100.0 * h.probability),
            if h.accepted { " ✓" } else { "" },
            m = y + 12.0,
            a = y + 8.0,
        );
    }
    let zero = px(0.0);
    let _ = write!(
        out,
        r#"<line class="floor" x1="{zero:.1}" x2="{zero:.1}" y1="0" y2="{:.1}"/><text class="t" x="{zero:.1}" y="{:.1}" text-anchor="middle">0</text><text class="t" x="{right:.1}" y="{:.1}" text-anchor="end">{} of the excess error explained on held-out runs</text></svg>"#,
        height - 26.0,
        height - 10.0,
        height - 10.0,
        number(high)
    );
    let left_out = all.len() - shown.len();
    let more = if left_out > 0 {
        format!(" {left_out} more explain less.")
    } else {
        String::new()
    };
    figure(
        &format!(
            "<b>What was tried</b>: share explained with its 95 % interval, and the probability on the right. Coloured: in the answer set; ✓ accepted.{more}"
        ),
        &out,
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
    let (cell, left) = (
        26.0,
        16.0 + 6.6 * c.names.iter().map(|s| s.chars().count()).max().unwrap_or(4) as f64,
    );
    let (w, h) = (left + cell * n as f64 + 10.0, 8.0 + cell * n as f64 + 22.0);
    let mut out = format!(
        r#"<svg viewBox="0 0 {w:.0} {h:.0}" style="max-width:{:.0}px" role="img" aria-label="correlation of fitted parameters"><title>Correlation of fitted parameters</title>"#,
        1.3 * w
    );
    for (i, name) in c.names.iter().enumerate() {
        let y = 6.0 + cell * i as f64;
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="{:.1}" text-anchor="end">{} {}</text>"#,
            left - 6.0,
            y + 17.0,
            escape(name),
            i + 1
        );
        let _ = write!(
            out,
            r#"<text class="t" x="{:.1}" y="{:.1}" text-anchor="middle">{}</text>"#,
            left + cell * (i as f64 + 0.5),
            h - 8.0,
            i + 1
        );
        for (k, r) in c.matrix.get(i).into_iter().flatten().enumerate() {
            let colour = if *r >= 0.0 { "after" } else { "before" };
            let _ = write!(
                out,
                r#"<g><title>{} and {}: {}</title><rect x="{:.1}" y="{:.1}" width="{:.1}" height="{:.1}" rx="3" style="fill:var(--{colour});opacity:{:.2}"/></g>"#,
                escape(name),
                escape(c.names.get(k).map_or("", String::as_str)),
                number(*r),
                left + cell * k as f64 + 1.0,
                y + 1.0,
                cell - 2.0,
                cell - 2.0,
                0.06 + 0.9 * r.abs().min(1.0)
            );
        }
    }
    out.push_str("</svg>");
    figure(
        "<b>Parameters that were fitted together</b>: strong colour means that the data hardly tell them apart",
        &out,
    )
}

/// Error by signal before and after, with the interval of the ratio.
pub fn gains(report: &Report) -> String {
    let (left, row, width) = (110.0, 46.0, 760.0);
    let height = row * report.gain.len() as f64 + 8.0;
    let right = width - 230.0;
    let mut out = format!(
        r#"<svg viewBox="0 0 {width:.0} {height:.0}" style="max-width:820px" role="img" aria-label="error on held-out runs before and after, by signal"><title>Gain on held-out runs</title>"#
    );
    for (i, (signal, g)) in report.gain.iter().enumerate() {
        let y = row * i as f64;
        let most = g.before.max(g.after).max(1e-300);
        let bar = |x: f64| (x / most * (right - left)).max(1.0);
        let _ = write!(
            out,
            r#"<text class="n" x="{:.1}" y="{:.1}" text-anchor="end">{}</text><rect class="bar-before" x="{left:.1}" y="{:.1}" width="{:.1}" height="14" rx="2"/><rect class="bar-after" x="{left:.1}" y="{:.1}" width="{:.1}" height="14" rx="2"/><text class="v" x="{:.1}" y="{:.1}">{}</text><text class="v" x="{:.1}" y="{:.1}">{} · × {} ({} to {})</text>"#,
            left - 8.0,
            y + 24.0,
            escape(signal),
            y + 5.0,
            bar(g.before),
            y + 21.0,
            bar(g.after),
            left + bar(g.before) + 6.0,
            y + 16.5,
            number(g.before),
            left + bar(g.after) + 6.0,
            y + 32.5,
            number(g.after),
            number(g.ratio),
            number(g.ci_low),
            number(g.ci_high)
        );
    }
    out.push_str("</svg>");
    figure(
        "<b>Root mean square error on held-out runs</b>, as given and extended, SI units; × ratio with its 95 % interval",
        &out,
    )
}
