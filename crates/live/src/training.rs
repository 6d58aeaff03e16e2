//! What the page of a training asks of those who serve it.

use serde_json::Value;

/// Takes settings, `key=value` each, that a training shall change to; or says in a line what is wrong.
pub type TakeChange = Box<dyn Fn(&[String]) -> Result<(), String> + Send + Sync>;

/// Shows a training beside another run: the names of those that there are, or, asked for one of them, the two side
/// by side; or says in a line what is wrong.
pub type LookBeside = Box<dyn Fn(Option<&str>) -> Result<Value, String> + Send + Sync>;

/// What the page of a training can do besides.
pub struct Training {
    /// Takes its changes.
    pub take: TakeChange,
    /// Shows it beside other runs.
    pub beside: LookBeside,
}
