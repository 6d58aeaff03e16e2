//! The page's words and tables.

use std::fmt::Write;

use super::figures;
use crate::plots::Plots;
use crate::report::{Cause, Parameter, Report, Verdict};
use caudata_chart::{escape, number};

/// The verdict in words, and how it is coloured.
pub fn verdict(v: Verdict) -> (&'static str, &'static str) {
    match v {
        Verdict::NoGap => ("No gap", "ok"),
        Verdict::Explained => ("Explained", "ok"),
        Verdict::Ambiguous => ("Ambiguous", "warn"),
        Verdict::PartlyExplained => ("Partly explained", "warn"),
        Verdict::Unexplained => ("Unexplained", "bad"),
        Verdict::InsufficientData => ("Insufficient data", "note"),
        Verdict::DataFault => ("Data fault", "bad"),
    }
}

/// `coulomb_friction` → `Coulomb friction`.
pub fn effect_name(effect: &str) -> String {
    let text = effect.replace('_', " ");
    let text = text
        .replace("coulomb", "Coulomb")
        .replace("stribeck", "Stribeck")
        .replace("imu", "IMU");
    let mut letters = text.chars();
    match letters.next() {
        Some(first) => first.to_uppercase().collect::<String>() + letters.as_str(),
        None => text,
    }
}

/// What a confidence is in: a name, or it and those that explain the runs as well.
fn among_rivals(cause: &Cause) -> String {
    let names = std::iter::once(&cause.effect).chain(&cause.alternatives);
    let names: Vec<String> = names.map(|name| effect_name(name).to_lowercase()).collect();
    names.join(" or ")
}

/// Figures under the headline.
pub fn tiles(report: &Report) -> String {
    let mut tiles: Vec<(String, String)> = Vec::new();
    if let Some(worst) = report
        .divergence
        .iter()
        .filter(|d| d.ratio.is_finite())
        .max_by(|a, b| a.ratio.total_cmp(&b.ratio))
    {
        tiles.push((
            format!("× {}", number(worst.ratio)),
            format!(
                "worst cell over its noise: {} {}, {}",
                worst.joint, worst.signal, worst.regime
            ),
        ));
    }
    if let Some((signal, best)) = report
        .gain
        .iter()
        .min_by(|a, b| a.1.ratio.total_cmp(&b.1.ratio))
    {
        tiles.push((
            format!("{} %", number(100.0 * (1.0 - best.ratio))),
            format!("less error in {signal} on held-out runs"),
        ));
    }
    if let Some(first) = report.causes.first() {
        tiles.push((
            format!("{} %", number(100.0 * first.confidence)),
            format!("confidence in {}", among_rivals(first)),
        ));
    }
    let role = |r: &str| report.runs.iter().filter(|x| x.role == r).count();
    tiles.push((
        format!("{} + {}", role("fit"), role("holdout")),
        "runs fitted and held out".to_owned(),
    ));
    let c = &report.compute;
    let time = if c.seconds > 0.0 {
        format!(" in {} s", number(c.seconds))
    } else {
        String::new()
    };
    tiles.push((
        c.rollouts.to_string(),
        format!("simulated runs of {} hypotheses{time}", c.candidates),
    ));
    let mut out = String::from("<div class=\"tiles\">");
    for (figure, word) in tiles {
        let _ = write!(
            out,
            "<div class=\"tile\"><b>{}</b><span>{}</span></div>",
            escape(&figure),
            escape(&word)
        );
    }
    out.push_str("</div>");
    out
}

/// Faults of the data.
pub fn faults(report: &Report) -> String {
    let mut out = String::from(
        "<div class=\"card scroll\"><table><thead><tr><th>kind</th><th>where</th><th>what</th></tr></thead><tbody>",
    );
    for f in &report.data_faults {
        let class = if f.fatal { "bad" } else { "warn" };
        let word = if f.fatal { "" } else { " (note)" };
        let _ = write!(
            out,
            "<tr><td class=\"{class}\"><b>{}</b>{word}</td><td>{}</td><td>{}</td></tr>",
            escape(&f.kind),
            escape(&f.location),
            escape(&f.detail)
        );
    }
    out.push_str("</tbody></table></div>");
    out
}

fn place(location: &[String]) -> String {
    if location.is_empty() {
        return "the whole robot".to_owned();
    }
    location
        .iter()
        .map(|l| escape(l))
        .collect::<Vec<_>>()
        .join(", ")
}

/// One card per cause, with its signature.
pub fn causes(report: &Report, plots: Option<&Plots>) -> String {
    let mut out = String::new();
    for (i, cause) in report.causes.iter().enumerate() {
        let class = if cause.is_open() {
            "cause amb"
        } else {
            "cause"
        };
        let _ = write!(
            out,
            "<div class=\"card {class}\"><h3>{}. {} <span class=\"soft\">at {}</span></h3><p class=\"small soft\">{} · <code>{}</code> · confidence <span class=\"conf\" role=\"img\" aria-label=\"{:.0} percent\"><i style=\"width:{:.0}%\"></i></span>{:.0} %</p>",
            i + 1,
            escape(&effect_name(&cause.effect)),
            place(&cause.location),
            escape(&cause.layer),
            escape(&cause.effect),
            100.0 * cause.confidence,
            100.0 * cause.confidence.clamp(0.0, 1.0),
            100.0 * cause.confidence
        );
        out.push_str(&parameters(cause));
        if !cause.assumed.is_empty() {
            let _ = write!(
                out,
                "<p class=\"warn\">It corrects what the robot file assumes: {}. The confidence is in the file, and says nothing of the robot: look it up in the data sheet first.</p>",
                escape(&cause.assumed.join(", "))
            );
        }
        if !cause.alternatives.is_empty() {
            let names: Vec<String> = cause
                .alternatives
                .iter()
                .map(|a| escape(&effect_name(a)))
                .collect();
            let _ = write!(
                out,
                "<p class=\"warn\">As good an explanation in these runs: {}.</p>",
                names.join(", ")
            );
        }
        for other in &cause.elsewhere {
            let _ = write!(
                out,
                "<p class=\"warn\">As good an explanation in these runs: the same at {}.</p>",
                place(other)
            );
        }
        out.push_str(&evidence(cause));
        let own = |s: &&crate::plots::Signature| {
            s.effect == cause.effect
                && (s.joint.is_empty()
                    || cause.location.is_empty()
                    || cause.location.contains(&s.joint))
        };
        let marks: Vec<String> = plots
            .into_iter()
            .flat_map(|p| p.signatures.iter().filter(own))
            .map(figures::signature)
            .collect();
        if !marks.is_empty() {
            let _ = write!(out, "<div class=\"grid\">{}</div>", marks.concat());
        }
        out.push_str("</div>");
    }
    out
}

/// What speaks for a cause, and what was rejected in its place.
fn evidence(cause: &Cause) -> String {
    let mut out = String::new();
    if !cause.evidence.is_empty() {
        out.push_str("<ul>");
        for e in &cause.evidence {
            let _ = write!(out, "<li>{}</li>", escape(e));
        }
        out.push_str("</ul>");
    }
    if !cause.rejected.is_empty() {
        let _ = write!(
            out,
            "<details><summary>{} look-alikes tried and rejected</summary><table><tbody>",
            cause.rejected.len()
        );
        for r in &cause.rejected {
            let _ = write!(
                out,
                "<tr><td>{}</td><td>{}</td></tr>",
                escape(&effect_name(&r.effect)),
                escape(&r.reason)
            );
        }
        out.push_str("</tbody></table></details>");
    }
    out
}

/// What the model carries beside its causes and is no finding.
pub fn leads(report: &Report) -> String {
    let mut out = String::new();
    for s in &report.leads {
        let _ = write!(
            out,
            "<div class=\"card\"><h3>{} <span class=\"soft\">at {}</span></h3><p class=\"small soft\">{} · <code>{}</code></p>{}",
            escape(&effect_name(&s.effect)),
            place(&s.location),
            escape(&s.layer),
            escape(&s.effect),
            parameters(s)
        );
        if let Some(first) = s.evidence.first() {
            let _ = write!(out, "<p class=\"small\">{}</p>", escape(first));
        }
        out.push_str("</div>");
    }
    out
}

/// What the model carries without a name that anybody vouches for.
pub fn unnamed(report: &Report) -> String {
    let mut out = String::new();
    for c in report.model.iter().filter(|c| !c.named) {
        let values = c
            .parameters
            .iter()
            .map(|(name, v)| format!("{name} = {}", number(*v)));
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&effect_name(&c.effect)),
            place(&c.location),
            escape(&values.collect::<Vec<_>>().join(", "))
        );
    }
    match out.is_empty() {
        true => out,
        false => format!(
            "<details class=\"card\"><summary>What else the extended model carries, whose names are no findings</summary><div class=\"scroll\"><table><tbody>{out}</tbody></table></div></details>"
        ),
    }
}

/// Parameters with their intervals as bars around the value.
fn parameters(cause: &Cause) -> String {
    let mut out = String::from(
        "<div class=\"scroll\"><table><thead><tr><th>parameter</th><th class=\"r\">value</th><th>unit</th><th>95 % interval</th><th></th></tr></thead><tbody>",
    );
    for (name, p) in &cause.parameters {
        let note = if p.at_bound {
            "<span class=\"warn\">at its bound: no result</span>"
        } else {
            ""
        };
        let _ = write!(
            out,
            "<tr><td>{}</td><td class=\"r\"><b>{}</b></td><td>{}</td><td>{} {} to {}</td><td>{note}</td></tr>",
            escape(&name.replace('_', " ")),
            number(p.value),
            escape(&p.unit),
            interval(p),
            number(p.ci_low),
            number(p.ci_high)
        );
    }
    out.push_str("</tbody></table></div>");
    out
}

/// The interval on a line from zero to a little beyond its far end.
fn interval(p: &Parameter) -> String {
    let (low, high) = (p.ci_low.min(p.value), p.ci_high.max(p.value));
    if !(low.is_finite() && high.is_finite()) {
        return String::new();
    }
    let (from, to) = (low.min(0.0), high.max(0.0));
    let span = (to - from).max(1e-300);
    let x = |v: f64| 4.0 + 112.0 * (v - from) / span;
    format!(
        r#"<svg viewBox="0 0 120 14" style="width:120px;display:inline-block;vertical-align:middle" aria-hidden="true"><line class="g" x1="4" x2="116" y1="7" y2="7"/><line class="floor" x1="{z:.1}" x2="{z:.1}" y1="1" y2="13"/><line class="whisk" x1="{:.1}" x2="{:.1}" y1="7" y2="7"/><circle class="p-after" cx="{:.1}" cy="7" r="3.4"/></svg>"#,
        x(low),
        x(high),
        x(p.value),
        z = x(0.0)
    )
}

/// What is left, and what to record.
pub fn next(report: &Report) -> String {
    let mut out = String::new();
    if !report.unexplained.is_empty() {
        out.push_str("<h2 id=\"rest\">What is left</h2>");
        for u in &report.unexplained {
            let nearest = u.nearest.as_ref().map_or(String::new(), |n| {
                format!(" Nearest in the catalogue: {}.", escape(&effect_name(n)))
            });
            let depends = if u.depends_on.is_empty() {
                String::new()
            } else {
                format!(" It depends on {}.", escape(&u.depends_on.join(", ")))
            };
            let _ = write!(
                out,
                "<div class=\"card\"><h3>{}</h3><p>{}{depends}{nearest}</p></div>",
                escape(&u.location),
                escape(&u.description)
            );
        }
    }
    if let Some(n) = &report.next_experiment {
        let joints = if n.joints.is_empty() {
            String::new()
        } else {
            format!(" --joint {}", escape(&n.joints[0]))
        };
        let separates: Vec<String> = n
            .separates
            .iter()
            .map(|e| escape(&effect_name(e)))
            .collect();
        let tells = if separates.is_empty() {
            String::new()
        } else {
            format!(
                "<p class=\"soft\">It tells apart or makes visible: {}.</p>",
                separates.join(", ")
            )
        };
        let _ = write!(
            out,
            "<h2 id=\"next\">What to record next</h2><div class=\"card next\"><h3>{}</h3><p>{}</p>{tells}<p class=\"small\"><code>caudata gap excite --robot R.robot.toml --trial {}{joints} --out DIR</code></p></div>",
            escape(&n.trial.replace('_', " ")),
            escape(&n.reason),
            escape(&n.trial)
        );
    }
    out
}

/// Smallest sizes that would have been seen.
pub fn floors(report: &Report) -> String {
    let mut out = String::from("<details class=\"card\"");
    if report.detection_floor.len() <= 14 {
        out.push_str(" open");
    }
    let _ = write!(
        out,
        "><summary>{} effects: the smallest size of each that would have been seen in these runs</summary><div class=\"scroll\"><table><thead><tr><th>effect</th><th>where</th><th>parameter</th><th class=\"r\">smallest</th><th>unit</th></tr></thead><tbody>",
        report.detection_floor.len()
    );
    for (id, f) in &report.detection_floor {
        let (effect, joint) = id.split_once('@').unwrap_or((id, ""));
        let value = if f.excited {
            number(f.value)
        } else {
            "not excited".to_owned()
        };
        let class = if f.excited { "r" } else { "r soft" };
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td class=\"{class}\">{value}</td><td>{}</td></tr>",
            escape(&effect_name(effect)),
            escape(joint),
            escape(&f.parameter.replace('_', " ")),
            if f.excited {
                escape(&f.unit)
            } else {
                String::new()
            }
        );
    }
    out.push_str("</tbody></table></div></details>");
    out
}

/// Runs, and what it took.
pub fn runs(report: &Report) -> String {
    let mut out = format!(
        "<details class=\"card\"><summary>{} runs</summary><div class=\"scroll\"><table><thead><tr><th>run</th><th>role</th><th class=\"r\">s</th><th>SHA-256</th></tr></thead><tbody>",
        report.runs.len()
    );
    for r in &report.runs {
        let short: String = r.sha256.chars().take(16).collect();
        let role = if r.role == "holdout" {
            "held out"
        } else {
            r.role.as_str()
        };
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{}</td><td class=\"r\">{}</td><td><code>{}</code></td></tr>",
            escape(&r.name),
            escape(role),
            number(r.duration_s),
            escape(&short)
        );
    }
    out.push_str("</tbody></table></div></details>");
    out
}

/// The divergence map as a table, for readers without pictures.
pub fn cells(report: &Report) -> String {
    const MOST: usize = 40;
    let mut out = String::from(
        "<details><summary>The cells as a table</summary><div class=\"card scroll\"><table><thead><tr><th>joint</th><th>signal</th><th>regime</th><th class=\"r\">rms error</th><th class=\"r\">noise floor</th><th class=\"r\">ratio</th><th class=\"r\">extended</th><th class=\"r\">p</th></tr></thead><tbody>",
    );
    for d in report.divergence.iter().take(MOST) {
        let same = |x: &&crate::report::Divergence| {
            x.joint == d.joint && x.signal == d.signal && x.regime == d.regime
        };
        let after = report
            .divergence_after
            .iter()
            .find(same)
            .map_or("–".to_owned(), |x| number(x.ratio));
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td><td class=\"r\">{}</td><td class=\"r\">{}</td><td class=\"r\">{}</td><td class=\"r\">{after}</td><td class=\"r\">{}</td></tr>",
            escape(&d.joint),
            escape(&d.signal),
            escape(&d.regime),
            number(d.rmse),
            number(d.noise_floor),
            number(d.ratio),
            number(d.p)
        );
    }
    out.push_str("</tbody></table></div></details>");
    out
}

/// Errors of angles: of the robot as given, of standard models, and of the extended one.
pub fn position_errors(report: &Report) -> String {
    let Some(given) = report.position_errors.first() else {
        return String::new();
    };
    let mut out = String::from(
        "<p class=\"soft\">Mean absolute error of the angles over whole held-out runs, rad. Standard models are fitted to the same runs.</p><div class=\"card scroll\"><table><thead><tr><th>model</th><th>all joints</th>",
    );
    for joint in given.joints_rad.keys() {
        let _ = write!(out, "<th>{}</th>", escape(joint));
    }
    out.push_str("</tr></thead><tbody>");
    for e in &report.position_errors {
        let _ = write!(
            out,
            "<tr><td>{}</td><td>{}</td>",
            escape(&e.model),
            number(e.mean_rad)
        );
        for joint in given.joints_rad.keys() {
            let error = e
                .joints_rad
                .get(joint)
                .copied()
                .map_or(String::new(), number);
            let _ = write!(out, "<td>{error}</td>");
        }
        out.push_str("</tr>");
    }
    out.push_str("</tbody></table></div>");
    out
}
