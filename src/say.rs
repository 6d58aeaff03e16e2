//! Standard output for people and for programs.

use std::fmt::Display;
use std::io::{ErrorKind, IsTerminal, Write};
use std::sync::OnceLock;
use std::time::{Duration, Instant, UNIX_EPOCH};

use caudata_studies::Table;
use caudata_telemetry::{ExitCode, Failure, FailureExt};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use serde_json::Value;

/// The flags of a command, and how its answer is wanted.
#[derive(Debug, Args)]
pub struct WithJson<P: Args> {
    #[command(flatten)]
    pub plan: P,
    /// One JSON object on the last line
    #[arg(long)]
    pub json: bool,
}

/// One line for a person. A reader that has gone away (`caudata … | head`) is no error.
pub fn line(text: impl Display) {
    if let Err(error) = writeln!(std::io::stdout(), "{text}")
        && error.kind() != ErrorKind::BrokenPipe
    {
        UNWRITTEN.get_or_init(|| error);
    }
}

/// What kept a line from being written.
static UNWRITTEN: OnceLock<std::io::Error> = OnceLock::new();

/// Fails where a line could not be written: on a full disk `caudata task new … > my.task.toml` is no task.
///
/// # Errors
/// The first error of standard output, with code 74.
pub fn written() -> Result<(), Failure> {
    UNWRITTEN.get().map_or(Ok(()), |error| {
        let why = format!("cannot write to standard output: {error}");
        Err(Failure::message(ExitCode::IoError, why))
    })
}

/// One line for a program: JSON.
///
/// # Errors
/// When the value has no JSON form.
pub fn json(value: &impl Serialize) -> Result<(), Failure> {
    line(serde_json::to_string(value).or_exit(ExitCode::Internal)?);
    Ok(())
}

/// The bar with its parts as the template says.
pub fn laid_out(bar: ProgressBar, template: &str) -> ProgressBar {
    // Templates are constants; a wrong one would only lose the layout.
    match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// How often a line tells how far something is, where there is no terminal.
const SHARE_EVERY: Duration = Duration::from_secs(10);

/// How much of something long is done and how long the rest will take, on standard error: a bar on a terminal,
/// elsewhere a line from time to time.
pub struct Share {
    bar: Option<ProgressBar>,
    what: &'static str,
    total: usize,
    done: usize,
    began: Instant,
    told: Instant,
}

impl Share {
    /// A task of `total` equal parts; `what` names one of them.
    pub fn new(what: &'static str, total: usize) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let layout = "{bar:24} {pos}/{len} {msg}, {eta} left";
            laid_out(ProgressBar::new(total as u64), layout).with_message(what)
        });
        let now = Instant::now();
        Self { bar, what, total, done: 0, began: now, told: now }
    }

    /// One more part is done.
    pub fn one_more(&mut self) {
        self.done += 1;
        if let Some(bar) = &self.bar {
            bar.inc(1);
        } else if self.told.elapsed() >= SHARE_EVERY {
            self.told = Instant::now();
            let (done, total, what) = (self.done, self.total, self.what);
            let part_s = self.began.elapsed().as_secs_f64() / done as f64;
            let left_s = part_s * total.saturating_sub(done) as f64;
            let _ = writeln!(std::io::stderr(), "{done}/{total} {what}, {left_s:.0} s left");
        }
    }

    /// Prints what a person shall keep, above the bar.
    pub fn above(&self, print: impl FnOnce()) {
        match &self.bar {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// A value for a program, with `json`, or in words.
///
/// # Errors
/// When the value has no JSON form.
pub fn either<T: Serialize>(json: bool, value: &T, words: impl FnOnce(&T)) -> Result<(), Failure> {
    if json {
        return self::json(value);
    }
    words(value);
    Ok(())
}

/// A table with its columns aligned; `head` names them, or is empty.
pub fn table(head: &[&str], rows: impl IntoIterator<Item = Vec<String>>) {
    let head: Vec<String> = head.iter().map(|&cell| cell.to_owned()).collect();
    aligned(std::iter::once(head).filter(|h| !h.is_empty()).chain(rows));
}

/// Records as a table: the fields that `keys` names, a column each.
pub fn records<T: Serialize>(records: &[T], keys: &str) {
    let keys: Vec<&str> = keys.split_whitespace().collect();
    let row = |record: &T| {
        let record = serde_json::to_value(record).unwrap_or_default();
        keys.iter().map(|key| cell(key, &record[*key])).collect()
    };
    let head: Vec<&str> = keys.iter().map(|key| title(key)).collect();
    table(&head, records.iter().map(row));
}

/// One record on a line: the fields that `keys` names.
pub fn record(record: &impl Serialize, keys: &str) {
    line(named(record, keys).collect::<Vec<_>>().join(", "));
}

/// One record, a line for each field that `keys` names.
pub fn fields(record: &impl Serialize, keys: &str) {
    named(record, keys).for_each(line);
}

fn named(record: &impl Serialize, keys: &str) -> impl Iterator<Item = String> {
    let record = serde_json::to_value(record).unwrap_or_default();
    let field = move |key: &str| format!("{} {}", title(key), cell(key, &record[key]));
    keys.split_whitespace().map(field)
}

/// What a person calls a field: a time is no number there.
fn title(key: &str) -> &str {
    match key.trim_end_matches("unix_ms") {
        "" => "time",
        what => what.trim_end_matches('_'),
    }
}

/// A field of a record, short: a hash by its beginning, a time in words, a dash where there is nothing.
fn cell(key: &str, value: &Value) -> String {
    match value {
        Value::Null => "-".to_owned(),
        Value::String(text) if is_hash(text) => text.chars().take(12).collect(),
        Value::String(text) => text.clone(),
        Value::Number(number) if key.ends_with("unix_ms") => utc(number.as_u64().unwrap_or(0)),
        Value::Number(number) if number.is_f64() => short(number.as_f64().unwrap_or(f64::NAN)),
        Value::Array(list) if list.is_empty() => "-".to_owned(),
        Value::Array(list) => {
            let cells = list.iter().map(|value| cell(key, value));
            cells.collect::<Vec<_>>().join(" ")
        }
        other => other.to_string(),
    }
}

/// A SHA-256.
fn is_hash(text: &str) -> bool {
    text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit())
}

/// Date and time of day, to the second.
fn utc(unix_ms: u64) -> String {
    /// The last moment of the year 9999, beyond which a date has no such form.
    const LATEST_MS: u64 = 253_402_300_799_999;
    let time = UNIX_EPOCH + Duration::from_millis(unix_ms.min(LATEST_MS));
    let text = humantime::format_rfc3339_seconds(time).to_string();
    text.trim_end_matches('Z').replace('T', " ")
}

/// Four significant digits.
pub fn short(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let decimals = (3 - x.abs().log10().floor() as i32).clamp(0, 9) as usize;
    format!("{x:.decimals$}")
}

/// Tables with an empty line before each.
pub fn tables(tables: Vec<Table>) {
    for table in tables {
        line("");
        aligned(std::iter::once(table.head).chain(table.rows));
    }
}

fn aligned(rows: impl Iterator<Item = Vec<String>>) {
    let rows: Vec<Vec<String>> = rows.collect();
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    for row in &rows {
        let cells = row.iter().zip(&widths);
        let cells: Vec<String> = cells.map(|(cell, width)| format!("{cell:<width$}")).collect();
        line(cells.join("  ").trim_end());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_short() {
        let cells = serde_json::json!([
            1.0 / 3.0,
            123_456.7,
            12,
            null,
            "abc",
            "0".repeat(64),
            ["a", "b"],
            true
        ]);
        let cells: Vec<String> =
            cells.as_array().unwrap().iter().map(|value| cell("", value)).collect();
        let wanted = ["0.3333", "123457", "12", "-", "abc", "000000000000", "a b", "true"];
        assert_eq!(cells, wanted);
    }

    #[test]
    fn dates_are_those_of_the_calendar() {
        assert_eq!(utc(0), "1970-01-01 00:00:00");
        // `date -u -d @1709210096` and `date -u -d @4107542399`.
        assert_eq!(utc(1_709_210_096_789), "2024-02-29 12:34:56");
        assert_eq!(utc(4_107_542_399_000), "2100-02-28 23:59:59");
        assert_eq!(utc(u64::MAX), "9999-12-31 23:59:59");
    }
}
