//! Writing XML as text.

use std::fmt::Write as _;

/// A line, indented.
pub(crate) fn line(w: &mut String, depth: usize, text: &str) {
    // writing to a string does not fail
    let _ = writeln!(w, "{}{text}", "  ".repeat(depth));
}

/// A text as an attribute may hold it.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}
