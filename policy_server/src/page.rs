//! The page for people: versions, how they did, where labels lead, which robot runs what. Plain HTML, nothing
//! from elsewhere, nothing that changes anything.

use std::collections::BTreeMap;
use std::fmt::Write;

use axum::Router;
use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE};
use axum::response::IntoResponse;
use axum::routing::get;
use caudata_chart::escape;
use caudata_proto::hex::hex;
use caudata_proto::registry::{Manifest, Overview, RobotReport, StreamName};
use caudata_telemetry::serve_http;
use tokio::net::TcpListener;
use tokio::sync::watch;

use crate::audit::Origin;
use crate::shared::SharedStore;
use crate::store::Store;

/// Versions of one stream that are shown, the newest first.
const VERSIONS_MAX: usize = 30;
/// Streams that are shown, those with the newest versions first.
const STREAMS_MAX: usize = 20;

const STYLE: &str = "\
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:75rem;padding:0 1rem}
h1{font-size:1.5rem;margin:0 0 .3rem}h2{font-size:1.15rem;margin:2rem 0 .4rem}h3{font-size:1rem;margin:1.2rem 0 .3rem}
p{margin:.2rem 0}table{border-collapse:collapse;width:100%}.wide{overflow-x:auto}
th,td{text-align:left;padding:.3rem .9rem .3rem 0;border-bottom:1px solid #8884;vertical-align:top}
th{font-weight:600;white-space:nowrap}td.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
.tag{border:1px solid #07a;color:#07a;border-radius:.6rem;padding:0 .45rem;margin-right:.3rem;white-space:nowrap}
.bad{color:#b22}.good{color:#182}.quiet{color:#777}code{font-size:.85em}
@media (prefers-color-scheme:dark){.tag{border-color:#5bd;color:#5bd}.bad{color:#f77}.good{color:#6c7}.quiet{color:#999}}";

/// Serves the page until `stop` turns true.
pub async fn serve_page(
    listener: TcpListener,
    store: SharedStore,
    mut stop: watch::Receiver<bool>,
) -> std::io::Result<()> {
    let page = move || {
        let store = store.clone();
        async move {
            let text = render(&store.lock(), Origin::local().unix_ms);
            let headers = [
                (CONTENT_TYPE, "text/html; charset=utf-8"),
                (CACHE_CONTROL, "no-store"),
                (CONTENT_SECURITY_POLICY, "default-src 'none'; style-src 'unsafe-inline'"),
            ];
            (headers, text).into_response()
        }
    };
    let ended = async move { _ = stop.wait_for(|stop| *stop).await };
    serve_http(listener, Router::new().route("/", get(page)), None, ended).await
}

/// The page, as of `now`.
pub fn render(store: &Store, now_unix_ms: u64) -> String {
    let all = store.overview(None);
    let mut page = format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><title>Policies</title>\
         <meta name=\"viewport\" content=\"width=device-width\"><meta http-equiv=\"refresh\" content=\"10\"><style>{STYLE}</style></head>\
         <body><h1>Policies</h1>"
    );
    let (versions, streams) = (store.records(None).count(), store.stream_names().count());
    let changes = all.generation;
    let state = format!("{versions} versions in {streams} streams, {changes} changes so far");
    paragraph(&mut page, "quiet", &state);
    if let Some(reason) = &all.read_only {
        let words = format!("Cannot be changed: {}", escape(reason));
        paragraph(&mut page, "bad", &words);
    }
    robots(&mut page, &all, now_unix_ms);
    let mut newest: Vec<(u64, &StreamName)> = store
        .stream_names()
        .map(|name| (store.newest(name).map_or(0, |r| r.manifest.created_unix_ms), name))
        .collect();
    newest.sort_by(|a, b| b.cmp(a));
    for (_, name) in newest.iter().take(STREAMS_MAX) {
        stream(&mut page, store, name, &all, now_unix_ms);
    }
    if streams == 0 {
        page.push_str("<p>Nothing is published yet: <code>caudata train</code> does it, or <code>caudata policy release</code>.</p>");
    }
    if streams > STREAMS_MAX {
        let more = streams - STREAMS_MAX;
        paragraph(&mut page, "quiet", &format!("and {more} older streams"));
    }
    page.push_str("</body></html>\n");
    page
}

/// What each robot said last.
fn robots(page: &mut String, all: &Overview, now: u64) {
    let mut last: BTreeMap<&str, &RobotReport> = BTreeMap::new();
    // Newest first: the first word of each robot is its last one.
    for report in &all.reports {
        last.entry(&report.robot).or_insert(report);
    }
    page.push_str("<h2>Robots</h2>");
    if last.is_empty() {
        paragraph(page, "quiet", "No robot has said anything yet.");
        return;
    }
    let head = ["robot", "stream", "version", "state", "walked", "said"];
    let row = |report: &&RobotReport| {
        vec![
            escape(&report.robot),
            escape(report.stream.as_str()),
            report.version.to_string(),
            state(report),
            format!("{:.0} s", report.walked_s),
            age(report.unix_ms, now),
        ]
    };
    table(page, &head, &[2, 4], last.values().map(row));
}

fn stream(page: &mut String, store: &Store, name: &StreamName, all: &Overview, now: u64) {
    let _ = write!(page, "<h2>{}</h2>", escape(name.as_str()));
    let head =
        ["version", "labels", "evaluation", "robots", "steps", "signed by", "sha256", "published"];
    let row = |manifest: &Manifest| {
        let mine = |r: &&RobotReport| r.stream == *name && r.version == manifest.version;
        let said = |r: &RobotReport| format!("{} {}", escape(&r.robot), state(r));
        let mut reports: Vec<String> = all.reports.iter().filter(mine).map(said).collect();
        reports.sort();
        let keys = manifest.signatures.iter().map(|s| escape(&s.key_id));
        let keys: Vec<String> = keys.collect();
        vec![
            number(manifest),
            tags(all, name, manifest.version),
            evaluation(manifest),
            reports.join("<br>"),
            thousands(manifest.env_steps),
            if keys.is_empty() { span("quiet", "nobody") } else { keys.join(", ") },
            format!("<code>{}</code>", &hex(&manifest.sha256)[..12]),
            age(manifest.created_unix_ms, now),
        ]
    };
    let shown = store.records(Some(name)).take(VERSIONS_MAX);
    table(page, &head, &[0, 4], shown.map(|r| row(&r.manifest)));
    let versions = store.records(Some(name)).count();
    if versions > VERSIONS_MAX {
        let more = versions - VERSIONS_MAX;
        paragraph(page, "quiet", &format!("and {more} older versions"));
    }
}

/// A table of cells that are HTML; those in the columns `figures` stand at the right.
fn table(
    page: &mut String,
    head: &[&str],
    figures: &[usize],
    rows: impl Iterator<Item = Vec<String>>,
) {
    let head = head.join("</th><th>");
    let _ = write!(page, "<div class=\"wide\"><table><tr><th>{head}</th></tr>");
    for row in rows {
        page.push_str("<tr>");
        for (column, cell) in row.iter().enumerate() {
            let class = if figures.contains(&column) { " class=\"n\"" } else { "" };
            let _ = write!(page, "<td{class}>{cell}</td>");
        }
        page.push_str("</tr>");
    }
    page.push_str("</table></div>");
}

fn paragraph(page: &mut String, class: &str, html: &str) {
    let _ = write!(page, "<p class=\"{class}\">{html}</p>");
}

fn span(class: &str, html: &str) -> String {
    format!("<span class=\"{class}\">{html}</span>")
}

fn number(manifest: &Manifest) -> String {
    match manifest.reverts_to {
        None => manifest.version.to_string(),
        Some(old) => {
            let old = span("quiet", &format!("= {old}"));
            format!("{}<br>{old}", manifest.version)
        }
    }
}

fn tags(all: &Overview, name: &StreamName, version: u64) -> String {
    let mut tags = String::new();
    for label in &all.labels {
        if label.stream == *name && label.version == version {
            let title = match &label.override_reason {
                Some(reason) => format!(" title=\"overridden: {}\"", escape(reason)),
                None => String::new(),
            };
            let mark = if label.override_reason.is_some() { " !" } else { "" };
            let name = &label.label;
            let _ = write!(tags, "<span class=\"tag\"{title}>{name}{mark}</span>");
        }
    }
    let out =
        |q: &&caudata_proto::registry::QuarantineState| q.stream == *name && q.version == version;
    if let Some(state) = all.quarantined.iter().find(out) {
        let words = format!("quarantined: {}", escape(&state.reason));
        tags.push_str(&span("bad", &words));
    }
    tags
}

/// One line per scenario of the summary that travels with the version.
fn evaluation(manifest: &Manifest) -> String {
    let none = || span("quiet", "none");
    let Some(text) = &manifest.evaluation_json else { return none() };
    let Ok(value) = serde_json::from_str::<serde_json::Value>(text) else { return none() };
    let Some(scenarios) = value.get("scenarios").and_then(|s| s.as_array()) else {
        let short: String = text.chars().take(120).collect();
        return format!("<code>{}</code>", escape(&short));
    };
    let figure =
        |value: &serde_json::Value, key: &str| value.get(key).and_then(serde_json::Value::as_f64);
    let lines: Vec<String> = scenarios
        .iter()
        .map(|line| {
            let name = line.get("name").and_then(|n| n.as_str()).unwrap_or("?");
            let speed =
                line.get("achieved").and_then(|a| a.get(0)).and_then(serde_json::Value::as_f64);
            let mut words = escape(name);
            if let Some(speed) = speed {
                let _ = write!(words, ": {speed:.2} m/s");
            }
            if let Some(falls) = figure(line, "fall_share") {
                let _ = write!(words, ", falls {:.0} %", 100.0 * falls);
            }
            if let Some(power) = figure(line, "power_w") {
                let _ = write!(words, ", {power:.0} W");
            }
            match line.get("walks").and_then(serde_json::Value::as_bool) {
                Some(true) => words.push_str(", <span class=\"good\">walks</span>"),
                Some(false) => words.push_str(", <span class=\"bad\">does not walk</span>"),
                None => {}
            }
            words
        })
        .collect();
    lines.join("<br>")
}

fn state(report: &RobotReport) -> String {
    let class = if report.state.went_well() { "good" } else { "bad" };
    let reason = match report.reason.as_str() {
        "" => String::new(),
        reason => format!(": {}", escape(reason)),
    };
    span(class, report.state.name()) + &reason
}

/// How long ago, in the largest fitting unit.
fn age(then_ms: u64, now_ms: u64) -> String {
    let s = now_ms.saturating_sub(then_ms) / 1000;
    match s {
        0..60 => format!("{s} s ago"),
        60..3600 => format!("{} min ago", s / 60),
        3600..172_800 => format!("{} h ago", s / 3600),
        _ => format!("{} days ago", s / 86_400),
    }
}

fn thousands(number: u64) -> String {
    let digits = number.to_string();
    let mut out = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            out.push('\u{202f}');
        }
        out.push(digit);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::StoreLimits;
    use crate::testing::manifest;
    use caudata_proto::registry::{LabelName, QuarantineState, RobotState, SetLabel};

    fn report(robot: &str, version: u64, bytes: &[u8], state: RobotState) -> RobotReport {
        let manifest = manifest("polymander/flat", version, bytes);
        RobotReport {
            robot: robot.into(),
            stream: manifest.stream,
            version,
            sha256: manifest.sha256,
            state,
            reason: if state.went_well() { String::new() } else { "fell <twice>".into() },
            walked_s: 12.0,
            falls: 0,
            attempts: 1,
            unix_ms: 0,
        }
    }

    #[test]
    fn versions_labels_evaluation_and_robots_are_on_the_page_and_nothing_runs_in_a_browser() {
        let folder = tempfile::tempdir().unwrap();
        let mut store = Store::open(folder.path(), StoreLimits::default()).unwrap();
        assert!(render(&store, 0).contains("Nothing is published yet"));
        let origin = Origin { by: "operator:ana".into(), unix_ms: 1_700_000_100_000 };
        let mut first = manifest("polymander/flat", 1, b"one");
        first.evaluation_json = Some(
            r#"{"scenarios":[{"name":"flat<script>","achieved":[0.291,0,0],"fall_share":0.25,"power_w":7.7,"walks":true}]}"#.into(),
        );
        store.publish(first, b"one").unwrap();
        store.publish(manifest("polymander/flat", 2, b"two"), b"two").unwrap();
        store.report(&origin, report("robot-1", 1, b"one", RobotState::Good)).unwrap();
        store.report(&origin, report("robot-2", 2, b"two", RobotState::Failed)).unwrap();
        let stream = StreamName::new("polymander/flat").unwrap();
        let label = SetLabel {
            stream: stream.clone(),
            label: LabelName::new("stable").unwrap(),
            version: 1,
            expected_generation: 0,
            override_reason: None,
        };
        store.set_label(&origin, label).unwrap();
        let out = QuarantineState {
            stream,
            version: 2,
            reason: "falls \"often\"".into(),
            by: String::new(),
            generation: 0,
            unix_ms: 0,
        };
        store.quarantine(&origin, out).unwrap();
        let page = render(&store, 1_700_000_160_000);
        for part in [
            "<h2>polymander/flat</h2>",
            "<span class=\"tag\">latest</span><span class=\"tag\">stable</span>",
            "flat&lt;script&gt;: 0.29 m/s, falls 25 %, 8 W, <span class=\"good\">walks</span>",
            "quarantined: falls &quot;often&quot;",
            "fell &lt;twice&gt;",
            "robot-1",
            "1 min ago",
            "2 min ago",
        ] {
            assert!(page.contains(part), "{part}\n{page}");
        }
        assert!(!page.contains("<script"), "{page}");
    }
}
