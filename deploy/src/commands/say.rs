//! Words on standard output.

use std::io::Write;
use std::time::Duration;

use serde::Serialize;

use crate::DeployError;

/// One line on standard output; a reader that is gone does no harm.
pub(super) fn say(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

pub(super) fn say_json(value: &impl Serialize) -> Result<(), DeployError> {
    say(&json_line(value)?);
    Ok(())
}

pub(super) fn json_line(value: &impl Serialize) -> Result<String, DeployError> {
    serde_json::to_string(value).map_err(|e| DeployError::Internal { what: e.to_string() })
}

/// As [`say`], but waits at most for `limit` for whoever reads; whether it was taken.
pub(super) fn say_within(text: String, limit: Duration) -> bool {
    let (taken, waits) = crossbeam_channel::bounded(1);
    let thread = std::thread::Builder::new().name("last-words".into());
    let spawned = thread.spawn(move || {
        say(&text);
        let _ = taken.send(());
    });
    spawned.is_ok() && waits.recv_timeout(limit).is_ok()
}
