//! MJCF: read as other tools write it, and as a robot's own file must be.
//!
//! One reader makes both. What it lets pass in a file of another tool, with a note or without, it refuses in a
//! robot's own file, which is of the subset in [`subset`]: nothing in it is ever passed over in silence.

mod actuators;
mod compiler;
mod contact;
mod context;
mod joint;
mod read;
mod shape;
mod subset;

use std::path::Path;

use crate::error::ModelError;
use crate::parts::Robot;
use crate::tree::{self, Remarks};

pub(crate) use read::read;

/// Reads a robot's own MJCF; `file` names it in errors.
pub(crate) fn parse(file: &str, text: &str) -> Result<Robot, ModelError> {
    let root = tree::of_text(file, text)?;
    let mut remarks = Remarks { strict: true, ..Remarks::default() };
    subset::check(&root, &mut remarks);
    let robot = match remarks.refusals.is_empty() {
        true => read(&root, Path::new(file), &mut remarks),
        false => None,
    };
    let mut said = remarks.refusals.into_iter().chain(remarks.notes);
    match (said.next(), robot) {
        (None, Some(robot)) => Ok(robot),
        (Some(first), _) => Err(ModelError::Mjcf(first)),
        (None, None) => Err(ModelError::Mjcf(root.remark("holds no robot"))),
    }
}
