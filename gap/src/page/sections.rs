//! The page's words and tables.

use std::fmt::Write;

use super::figures;
use crate::plots::Plots;
use crate::report::{
    Carried, Cause, DataFault, Divergence, Floor, Parameter, PositionError, Rejected, Report,
    RunUse, Verdict,
};
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
    let text =
        text.replace("coulomb", "Coulomb").replace("stribeck", "Stribeck").replace("imu", "IMU");
    let mut letters = text.chars();
    match letters.next() {
        Some(first) => first.to_uppercase().collect::<String>() + letters.as_str(),
        None => text,
    }
}

/// What a confidence is in: a name, or it and those of its layer that explain the runs as well; and what else
/// does.
fn among_rivals(cause: &Cause) -> String {
    let of_layer =
        |id: &&String| crate::effects::find(id).is_some_and(|e| e.layer.name() == cause.layer);
    let (same, others): (Vec<&String>, Vec<&String>) =
        cause.alternatives.iter().partition(of_layer);
    let lower = |id: &String| effect_name(id).to_lowercase();
    let names: Vec<String> = [&cause.effect].into_iter().chain(same).map(lower).collect();
    let others: Vec<String> = others.into_iter().map(lower).collect();
    match others.as_slice() {
        [] => names.join(" or "),
        _ => format!("{}; as good: {}", names.join(" or "), others.join(", ")),
    }
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
    if let Some((signal, best)) = report.gain.iter().min_by(|a, b| a.1.ratio.total_cmp(&b.1.ratio))
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
    let time = if c.seconds > 0.0 { format!(" in {} s", number(c.seconds)) } else { String::new() };
    tiles.push((
        c.rollouts.to_string(),
        format!("simulated runs of {} hypotheses{time}", c.candidates),
    ));
    let tile = |(figure, word): &(String, String)| {
        let (figure, word) = (escape(figure), escape(word));
        format!("<div class=\"tile\"><b>{figure}</b><span>{word}</span></div>")
    };
    let tiles: String = tiles.iter().map(tile).collect();
    format!("<div class=\"tiles\">{tiles}</div>")
}

/// Faults of the data.
pub fn faults(report: &Report) -> String {
    let row = |f: &DataFault| {
        let (class, word) = if f.fatal { ("bad", "") } else { ("warn", " (note)") };
        let kind = format!("<b class=\"{class}\">{}</b>{word}", escape(&f.kind));
        vec![kind, escape(&f.location), escape(&f.detail)]
    };
    let table = table("kind|where|what", report.data_faults.iter().map(row));
    format!("<div class=\"card scroll\">{table}</div>")
}

fn place(location: &[String]) -> String {
    if location.is_empty() {
        return "the whole robot".to_owned();
    }
    location.iter().map(|l| escape(l)).collect::<Vec<_>>().join(", ")
}

/// One card per cause, with its signature.
pub fn causes(report: &Report, plots: Option<&Plots>) -> String {
    let mut out = String::new();
    for (i, cause) in report.causes.iter().enumerate() {
        let class = if cause.is_open() { "cause amb" } else { "cause" };
        let _ = write!(
            out,
            "<div class=\"card {class}\"><h3>{}. {} <span class=\"soft\">at {}</span></h3><p class=\"small soft\">{} · <code>{}</code> · confidence <span class=\"conf\" role=\"img\" aria-label=\"{:.0} percent\"><i style=\"width:{:.0}%\"></i></span>{:.0} %{}</p>",
            i + 1,
            escape(&effect_name(&cause.effect)),
            place(&cause.location),
            escape(&cause.layer),
            escape(&cause.effect),
            100.0 * cause.confidence,
            100.0 * cause.confidence.clamp(0.0, 1.0),
            100.0 * cause.confidence,
            cause.of_kind()
        );
        out.push_str(&parameters(cause));
        if !cause.assumed.is_empty() {
            let _ = write!(
                out,
                "<p class=\"warn\">It corrects what the robot file assumes: {}. So it may be the file that is wrong, and the robot as it should be: look it up where a data sheet has it.</p>",
                escape(&cause.assumed.join(", "))
            );
        }
        if !cause.alternatives.is_empty() {
            let names = cause.as_good(&|id| escape(&effect_name(id)));
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
        let items = cause.evidence.iter().map(|e| format!("<li>{}</li>", escape(e)));
        let _ = write!(out, "<ul>{}</ul>", items.collect::<String>());
    }
    if !cause.rejected.is_empty() {
        let row = |r: &Rejected| vec![escape(&effect_name(&r.effect)), escape(&r.reason)];
        let _ = write!(
            out,
            "<details><summary>{} look-alikes tried and rejected</summary>{}</details>",
            cause.rejected.len(),
            table("", cause.rejected.iter().map(row))
        );
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
    let row = |c: &Carried| {
        let values = c.parameters.iter().map(|(name, v)| format!("{name} = {}", number(*v)));
        let values = values.collect::<Vec<_>>().join(", ");
        vec![escape(&effect_name(&c.effect)), place(&c.location), escape(&values)]
    };
    let rows: Vec<Vec<String>> = report.model.iter().filter(|c| !c.named).map(row).collect();
    match rows.is_empty() {
        true => String::new(),
        false => format!(
            "<details class=\"card\"><summary>What else the extended model carries, whose names are no findings</summary><div class=\"scroll\">{}</div></details>",
            table("", rows.into_iter())
        ),
    }
}

/// Parameters with their intervals as bars around the value.
fn parameters(cause: &Cause) -> String {
    let row = |(name, p): (&String, &Parameter)| {
        let note = match p.at_bound {
            true => "<span class=\"warn\">at its bound: no result</span>",
            false => "",
        };
        let [value, low, high] = [p.value, p.ci_low, p.ci_high].map(number);
        vec![
            escape(&name.replace('_', " ")),
            format!("<b>{value}</b>"),
            escape(&p.unit),
            format!("{} {low} to {high}", interval(p)),
            note.to_owned(),
        ]
    };
    let head = "parameter|>value|unit|95 % interval|";
    let table = table(head, cause.parameters.iter().map(row));
    format!("<div class=\"scroll\">{table}</div>")
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
        let separates: Vec<String> = n.separates.iter().map(|e| escape(&effect_name(e))).collect();
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
    let row = |(id, f): (&String, &Floor)| {
        let (effect, joint) = id.split_once('@').unwrap_or((id, ""));
        let (value, unit) = match f.excited {
            true => (number(f.value), escape(&f.unit)),
            false => ("<span class=\"soft\">not excited</span>".to_owned(), String::new()),
        };
        let parameter = escape(&f.parameter.replace('_', " "));
        vec![escape(&effect_name(effect)), escape(joint), parameter, value, unit]
    };
    let all = &report.detection_floor;
    let open = if all.len() <= 14 { " open" } else { "" };
    let head = "effect|where|parameter|>smallest|unit";
    format!(
        "<details class=\"card\"{open}><summary>{} effects: the smallest size of each that would have been seen in these runs</summary><div class=\"scroll\">{}</div></details>",
        all.len(),
        table(head, all.iter().map(row))
    )
}

/// Runs, and what it took.
pub fn runs(report: &Report) -> String {
    let row = |r: &RunUse| {
        let short: String = r.sha256.chars().take(16).collect();
        let role = match r.role.as_str() {
            "holdout" => "held out",
            other => other,
        };
        let short = format!("<code>{}</code>", escape(&short));
        vec![escape(&r.name), escape(role), number(r.duration_s), short]
    };
    format!(
        "<details class=\"card\"><summary>{} runs</summary><div class=\"scroll\">{}</div></details>",
        report.runs.len(),
        table("run|role|>s|SHA-256", report.runs.iter().map(row))
    )
}

/// The divergence map as a table, for readers without pictures.
pub fn cells(report: &Report) -> String {
    const MOST: usize = 40;
    const HEAD: &str = "joint|signal|regime|>rms error|>noise floor|>ratio|>extended|>p";
    let row = |d: &Divergence| {
        let same =
            |x: &&Divergence| x.joint == d.joint && x.signal == d.signal && x.regime == d.regime;
        let after = report.divergence_after.iter().find(same);
        let after = after.map_or("–".to_owned(), |x| number(x.ratio));
        let names = [&d.joint, &d.signal, &d.regime].map(|name| escape(name));
        let [rmse, floor, ratio, p] = [d.rmse, d.noise_floor, d.ratio, d.p].map(number);
        [names.to_vec(), vec![rmse, floor, ratio, after, p]].concat()
    };
    let table = table(HEAD, report.divergence.iter().take(MOST).map(row));
    format!(
        "<details><summary>The cells as a table</summary><div class=\"card scroll\">{table}</div></details>"
    )
}

/// Errors of angles: of the robot as given, of standard models, and of the extended one.
pub fn position_errors(report: &Report) -> String {
    let Some(given) = report.position_errors.first() else { return String::new() };
    let joints: Vec<&String> = given.joints_rad.keys().collect();
    let names: Vec<String> = joints.iter().map(|j| escape(j)).collect();
    let head = format!("model|all joints|{}", names.join("|"));
    let row = |e: &PositionError| {
        let of = |j: &&String| e.joints_rad.get(*j).copied().map_or(String::new(), number);
        let own = vec![escape(&e.model), number(e.mean_rad)];
        own.into_iter().chain(joints.iter().map(of)).collect()
    };
    let table = table(&head, report.position_errors.iter().map(row));
    format!(
        "<p class=\"soft\">Mean absolute error of the angles over whole held-out runs, {}. Standard models are fitted to the same runs.</p><div class=\"card scroll\">{table}</div>",
        given.units()
    )
}

/// A table of cells that are HTML already. `head`: the columns' names between bars, none for a table without; a
/// name that begins with `>` is of figures.
fn table(head: &str, rows: impl Iterator<Item = Vec<String>>) -> String {
    let names: Vec<&str> = head.split('|').collect();
    let cells = |tag: &str, cells: Vec<String>| {
        let cells = cells.into_iter().zip(names.iter().chain(std::iter::repeat(&"")));
        let cells = cells.map(|(cell, name)| match name.starts_with('>') {
            true => format!("<{tag} class=\"r\">{cell}</{tag}>"),
            false => format!("<{tag}>{cell}</{tag}>"),
        });
        format!("<tr>{}</tr>", cells.collect::<String>())
    };
    let words = names.iter().map(|h| h.trim_start_matches('>').to_owned());
    let head = match head {
        "" => String::new(),
        _ => format!("<thead>{}</thead>", cells("th", words.collect())),
    };
    let rows: String = rows.map(|row| cells("td", row)).collect();
    format!("<table>{head}<tbody>{rows}</tbody></table>")
}
