//! Structured logs on standard error: readable on a terminal, one JSON object per line elsewhere.

use std::io::{IsTerminal, Write};
use std::sync::OnceLock;
use std::time::Duration;

use tracing_subscriber::filter::EnvFilter;
use tracing_subscriber::fmt::time::SystemTime;
use tracing_subscriber::fmt::writer::BoxMakeWriter;

use crate::queue::{LINES_MAX, LineQueue};

/// How long the end of a process waits for a reader of its last lines.
const LAST_LINES_MAX: Duration = Duration::from_secs(1);
/// Where lines go in a process that must not wait for their reader.
static QUEUE: OnceLock<LineQueue> = OnceLock::new();

/// The two log flags that every binary has, and the address of its metrics.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct LogArgs {
    /// Log format on standard error: auto (pretty on a terminal, else json), pretty, json
    #[arg(
        long,
        hide_possible_values = true,
        value_name = "FORMAT",
        default_value = "auto",
        global = true,
        help_heading = "Logging"
    )]
    pub log_format: LogFormat,
    /// What to log, for instance `info` or `warn,caudata_learner=debug`
    #[arg(
        long = "log-filter",
        id = "log_filter",
        value_name = "FILTER",
        env = "CAUDATA_LOG",
        default_value = "info",
        global = true,
        help_heading = "Logging"
    )]
    pub log: String,
}

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// Pretty when standard error is a terminal, JSON otherwise.
    #[default]
    Auto,
    /// For people.
    Pretty,
    /// One JSON object per line, spans included.
    Json,
}

/// Why logging could not be set up.
#[derive(Debug, thiserror::Error)]
pub enum LoggingError {
    /// The system refuses the thread that writes lines.
    #[error("the system refuses a thread for the log: {0}")]
    Thread(std::io::Error),
    /// The filter does not parse.
    #[error("log filter `{filter}` is not valid: {reason}")]
    Filter { filter: String, reason: String },
}

/// Sends events and spans of this process to standard error and writes the banner line.
///
/// A second call in the same process (tests, in-process actors) changes nothing.
///
/// # Errors
/// [`LoggingError::Filter`] when `filter` does not parse.
pub fn init_logging(
    process_name: &str,
    format: LogFormat,
    filter: &str,
) -> Result<(), LoggingError> {
    install(process_name, format, filter, BoxMakeWriter::new(std::io::stderr))
}

/// As [`init_logging`], for a process that moves something: no line ever waits for whoever reads standard
/// error. Where that one sleeps, the first and the newest lines are kept, and how many are missing between
/// them is told where they are missing.
///
/// # Errors
/// As [`init_logging`], and [`LoggingError::Thread`].
pub(crate) fn init_queued_logging(
    process_name: &str,
    format: LogFormat,
    filter: &str,
) -> Result<(), LoggingError> {
    let pretty = is_pretty(format);
    let loss = move |lost: u64| match pretty {
        true => format!(" WARN {lost} log lines were lost: nobody read them\n"),
        false => format!(
            "{{\"level\":\"WARN\",\"message\":\"log lines were lost: nobody read them\",\"lost\":{lost}}}\n"
        ),
    };
    let queue = match QUEUE.get() {
        Some(queue) => queue.clone(),
        None => {
            let new = LineQueue::start(std::io::stderr(), LINES_MAX, loss)
                .map_err(LoggingError::Thread)?;
            QUEUE.get_or_init(|| new).clone()
        }
    };
    let writer = BoxMakeWriter::new(move || queue.clone());
    install(process_name, format, filter, writer)
}

/// The last words of a process: past the queue's end in order, and not for ever.
pub(crate) fn last_words(text: &[u8]) {
    match QUEUE.get() {
        Some(queue) => {
            if !text.is_empty() {
                queue.push(text);
            }
            queue.flush(LAST_LINES_MAX);
        }
        // Nothing is left to do when standard error itself is gone.
        None => {
            let _ = std::io::stderr().write_all(text);
        }
    }
}

fn is_pretty(format: LogFormat) -> bool {
    match format {
        LogFormat::Auto => std::io::stderr().is_terminal(),
        LogFormat::Pretty => true,
        LogFormat::Json => false,
    }
}

fn install(
    process_name: &str,
    format: LogFormat,
    filter: &str,
    writer: BoxMakeWriter,
) -> Result<(), LoggingError> {
    let env_filter = EnvFilter::try_new(filter).map_err(|error| LoggingError::Filter {
        filter: filter.to_owned(),
        reason: error.to_string(),
    })?;
    let terminal = std::io::stderr().is_terminal();
    let builder = tracing_subscriber::fmt()
        .with_env_filter(env_filter)
        .with_writer(writer)
        // Where nobody reads standard error any more, saying so there would be a panic.
        .log_internal_errors(false)
        .with_timer(SystemTime);
    let installed = if is_pretty(format) {
        builder.with_ansi(terminal).try_init()
    } else {
        builder.json().flatten_event(true).with_span_list(true).try_init()
    };
    if installed.is_ok() {
        crate::banner::log_banner(process_name);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bad_filter_is_named() {
        let error = init_logging("t", LogFormat::Json, "a=b=c").unwrap_err();
        assert!(error.to_string().contains("a=b=c"), "{error}");
    }
}
