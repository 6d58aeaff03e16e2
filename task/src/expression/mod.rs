//! Short arithmetic over named signals of the state, for terms of a task that has no function here.
//!
//! An expression is read and checked once (names, numbers of values, units), and becomes a list of steps over
//! a stack of values. Whole vectors are worked on at once, so that the cost of a step is shared by all joints
//! or feet. A plain number takes whatever unit it needs.

mod checker;
mod parse;
mod program;
mod signal;
mod unit;

pub use program::{FUNCTIONS, FunctionInfo, Program, Source};
pub use signal::{Known, Names, Reason, SIGNALS, Shape, Signal, SignalInfo};
pub use unit::Unit;

use checker::Checker;
use parse::parse;

/// Checks an expression as far as that goes without a robot: which joints and feet there are is not known
/// then, everything else is. Its shape and unit (`None`: whatever is needed).
///
/// # Errors
/// What is wrong, in words that follow on the expression.
pub fn check(text: &str) -> Result<(Shape, Option<Unit>), Reason> {
    let mut checker = Checker::new(None);
    let typed = checker.compile(&parse(text)?)?;
    Ok((typed.shape, typed.unit))
}

/// Compiles an expression for a robot with these joints and feet.
///
/// # Errors
/// What is wrong, in words that follow on the expression.
pub fn compile(text: &str, names: Names<'_>) -> Result<Program, Reason> {
    let mut checker = Checker::new(Some(names));
    let typed = checker.compile(&parse(text)?)?;
    Ok(checker.finish(typed))
}

#[cfg(test)]
mod tests;
