//! Charts as SVG: axes, curves, bands and points, inside an HTML page or as files of their own.
//!
//! Every still picture of curves is drawn here. Only the evaluation's page draws on canvases instead: its
//! diagrams move with the replay. *Invariant:* the same data give the same bytes.

mod axis;
mod chart;
mod style;
mod text;

pub use axis::Axis;
pub use chart::{Chart, sheet};
pub use style::style;
pub use text::{escape, number};
