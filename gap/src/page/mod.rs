//! `report.html`: a diagnosis to be looked at. One file, nothing loaded from anywhere; light and dark,
//! telephone and paper.

mod drawing;
mod figures;
mod heat;
mod sections;
mod style;

use std::fmt::Write;

use caudata_chart::{escape, number};

use crate::plots::{Overlay, Plots, Signature};
use crate::report::{Report, Verdict};

/// The page of a diagnosis of `robot`. `plots`: what there is to draw beyond the report itself.
pub fn render(robot: &str, report: &Report, plots: Option<&Plots>) -> String {
    let (word, class) = sections::verdict(report.verdict);
    // the headline is one sentence; what else there is to say is text
    let (headline, more) = match report.summary.split_once(". ") {
        Some((headline, more)) => (format!("{headline}."), more),
        None => (report.summary.clone(), ""),
    };
    let mut body = String::new();
    let _ = write!(
        body,
        "<p class=\"top\">Diagnosis of <b>{}</b></p><h1><span class=\"badge {class}\">{word}</span><br>{}</h1><p>{}</p>",
        escape(robot),
        escape(&headline),
        escape(more)
    );
    body.push_str(&sections::tiles(report));
    if !report.data_faults.is_empty() {
        section(
            &mut body,
            "faults",
            "Faults of the data",
            "What the logs themselves say, before any simulation.",
        );
        body.push_str(&sections::faults(report));
    }
    found(&mut body, report, plots);
    body.push_str(&sections::next(report));
    if report.verdict != Verdict::DataFault || !report.divergence.is_empty() {
        section(&mut body, "map", "Where simulation and measurement part", "");
        body.push_str(&heat::maps(report));
        body.push_str(&sections::cells(report));
    }
    if let Some(p) = plots.filter(|p| !p.overlays.is_empty()) {
        section(&mut body, "worst", "The worst cells", "");
        body.push_str(&figures::key(p.overlays.iter().any(|o| !o.after.is_empty())));
        grid(&mut body, p.overlays.iter().map(figures::overlay));
    }
    gain(&mut body, report, plots);
    if let Some(p) = plots.filter(|p| !p.hypotheses.is_empty()) {
        section(&mut body, "tried", "Everything that was tried", "");
        body.push_str(&figures::hypotheses(&p.hypotheses));
        if p.correlation.names.len() > 1 {
            body.push_str(&figures::correlation(&p.correlation));
        }
    }
    if !report.detection_floor.is_empty() {
        section(
            &mut body,
            "floors",
            "What could have been seen",
            "An effect below its size here would not have shown; one that is not excited could not.",
        );
        body.push_str(&sections::floors(report));
    }
    section(&mut body, "runs", "Runs", "");
    body.push_str(&sections::runs(report));
    let c = &report.compute;
    let _ = write!(
        body,
        "<footer>{} hypotheses, {} simulated runs, {} s simulated. Everything here is in <code>report.json</code> beside this page.</footer>",
        c.candidates,
        c.rollouts,
        number(c.simulated_s)
    );
    document(&format!("{word}: {}", escape(robot)), &body)
}

/// Causes, leads, and what else the model carries.
fn found(body: &mut String, report: &Report, plots: Option<&Plots>) {
    if !report.causes.is_empty() {
        section(body, "causes", "Causes", "");
        body.push_str(&figures::key(true));
        body.push_str(&sections::causes(report, plots));
    }
    if !report.leads.is_empty() {
        section(
            body,
            "leads",
            "Leads",
            "With these the extended model is closer to held-out runs, and it carries them. But each takes less off than it leaves, beside a greater cause at the same place: it may be there, and it may make up for what that cause's law lacks.",
        );
        body.push_str(&sections::leads(report));
    }
    body.push_str(&sections::unnamed(report));
}

/// A part of a page with pictures that are not of measured runs.
#[derive(Debug, Clone, Default)]
pub struct Chapter {
    /// Heading.
    pub title: String,
    /// HTML below it, made by the caller.
    pub lead: String,
    /// Pictures.
    pub figures: Vec<Signature>,
}

/// A page of curves alone: measured, and two models; then chapters. `lead`: HTML below the title, made by the
/// caller.
pub fn curves(title: &str, lead: &str, overlays: &[Overlay], chapters: &[Chapter]) -> String {
    let title = escape(title);
    let mut body = format!("<h1>{title}</h1>{lead}");
    if !overlays.is_empty() {
        body.push_str(&figures::key(overlays.iter().any(|o| !o.after.is_empty())));
        grid(&mut body, overlays.iter().map(figures::overlay));
    }
    for (i, chapter) in chapters.iter().enumerate() {
        section(&mut body, &format!("chapter{}", i + 1), &escape(&chapter.title), "");
        body.push_str(&chapter.lead);
        grid(&mut body, chapter.figures.iter().map(figures::signature));
    }
    document(&title, &body)
}

fn document(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width,initial-scale=1\"><title>{title}</title><style>{}{}</style></head><body><main>{body}</main></body></html>\n",
        style::CSS,
        caudata_chart::style()
    )
}

fn section(body: &mut String, id: &str, title: &str, lead: &str) {
    let _ = write!(body, "<h2 id=\"{id}\">{title}</h2>");
    if !lead.is_empty() {
        let _ = write!(body, "<p class=\"soft\">{lead}</p>");
    }
}

fn grid(body: &mut String, figures: impl Iterator<Item = String>) {
    body.push_str("<div class=\"grid\">");
    body.extend(figures);
    body.push_str("</div>");
}

fn gain(body: &mut String, report: &Report, plots: Option<&Plots>) {
    let horizons = plots.map_or(&[][..], |p| &p.horizons[..]);
    if report.gain.is_empty() && horizons.is_empty() {
        return;
    }
    section(body, "gain", "What it is worth on runs that were not used", "");
    if !report.gain.is_empty() {
        body.push_str(&figures::gains(report));
    }
    body.push_str(&sections::position_errors(report));
    if !horizons.is_empty() {
        grid(body, horizons.iter().map(figures::horizon));
    }
}
