//! Leaves verification steps out one by one, and looks whether exactly what each of them keeps out then gets through.
//!
//! A crate that is to be looked at names its steps in an `enum Step`, asks `Step::on` at each of them, and has in its tests a [`Seam`], a table of
//! all steps and, for each, an attempt to get past it. No program links this crate.

use std::cell::Cell;
use std::fmt::Debug;
use std::thread::LocalKey;

/// The step that this thread leaves out, if any.
pub type Seam<S> = LocalKey<Cell<Option<S>>>;

/// Puts every step back, however a test ends.
struct PutBack<S: 'static>(&'static Seam<S>);

impl<S> Drop for PutBack<S> {
    fn drop(&mut self) {
        self.0.set(None);
    }
}

/// Tries to get past each step with it and without it. `attempt` brings what that step alone keeps out, and tells whether it was taken or why not.
/// The table: a line for each step.
///
/// # Errors
/// The same table, where a step refuses nothing, or something else refuses what was brought.
pub fn each_left_out<S: Copy + Debug + 'static>(
    seam: &'static Seam<S>,
    steps: &[S],
    attempt: impl Fn(S) -> Result<(), String>,
) -> Result<String, String> {
    let put_back = PutBack(seam);
    let mut table = String::new();
    let mut right = !steps.is_empty();
    for &step in steps {
        seam.set(None);
        let refused = attempt(step);
        seam.set(Some(step));
        let got_through = attempt(step);
        right &= refused.is_err() && got_through.is_ok();
        table += &format!("{step:?}: with it {refused:?}; without it {got_through:?}\n");
    }
    drop(put_back);
    if right { Ok(table) } else { Err(table) }
}

/// The variants of `enum Step` in the text of the file that defines it, each on a line of its own; compared with the table of a test, they show
/// that it holds every step.
#[must_use]
pub fn steps_in(source: &str) -> Vec<&str> {
    let body = source
        .split_once("enum Step {\n")
        .and_then(|(_, rest)| rest.split_once("\n}"))
        .map_or("", |(body, _)| body);
    body.lines()
        .filter_map(|line| line.trim().strip_suffix(','))
        .filter(|name| name.chars().all(|c| c.is_ascii_alphanumeric()))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Gate {
        Left,
        Right,
    }

    thread_local! {
        static LEFT_OUT: Cell<Option<Gate>> = const { Cell::new(None) };
    }

    /// A door behind these gates.
    fn door(gates: &[Gate]) -> Result<(), String> {
        match gates.iter().find(|&&gate| LEFT_OUT.get() != Some(gate)) {
            Some(gate) => Err(format!("{gate:?} is shut")),
            None => Ok(()),
        }
    }

    #[test]
    fn a_step_counts_where_it_and_nothing_else_refuses() {
        let all = [Gate::Left, Gate::Right];
        let table = each_left_out(&LEFT_OUT, &all, |gate| door(&[gate])).unwrap_or_default();
        assert_eq!(
            table,
            "Left: with it Err(\"Left is shut\"); without it Ok(())\n\
             Right: with it Err(\"Right is shut\"); without it Ok(())\n"
        );
        // One that refuses nothing, and one behind which another refuses the same.
        assert!(each_left_out(&LEFT_OUT, &all, |_| door(&[])).is_err());
        assert!(each_left_out(&LEFT_OUT, &all, |_| door(&all)).is_err());
        // The wrong one among right ones.
        assert!(each_left_out(&LEFT_OUT, &all, |_| door(&[Gate::Right])).is_err());
        // No step is no proof.
        assert!(each_left_out(&LEFT_OUT, &[], |gate: Gate| door(&[gate])).is_err());
        assert_eq!(LEFT_OUT.get(), None);
    }

    #[test]
    fn every_step_is_put_back_where_an_attempt_panics() {
        let panics = || {
            each_left_out(&LEFT_OUT, &[Gate::Left], |gate| {
                assert!(door(&[gate]).is_err(), "with the step it is refused");
                Ok(())
            })
        };
        assert!(std::panic::catch_unwind(panics).is_err());
        assert_eq!(LEFT_OUT.get(), None);
    }

    #[test]
    fn steps_are_read_from_their_source() {
        let source = "/// What.\npub(crate) enum Step {\n    /// One, of two,\n    First,\n    /// The other.\n    Second2,\n}\n\nenum Other {\n    No,\n}\n";
        assert_eq!(steps_in(source), ["First", "Second2"]);
        assert_eq!(steps_in("enum Step{}"), [""; 0]);
    }
}
