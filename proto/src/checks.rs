//! Tables of named checks: what stands between a bad answer, policy or request and whoever would act on it.
//!
//! A caller folds over its table and stops at the first refusal. Because the table is a value, a test can
//! hand over one with an entry less and show that exactly what this entry refuses then gets through
//! ([`each_left_out`]).

use std::fmt::Debug;

/// One entry of a table. `F` is the type of a function that looks at one thing and refuses it or not.
#[derive(Clone, Copy, Debug)]
pub struct Check<F> {
    /// Its name, unique within its table.
    pub name: &'static str,
    /// Refuses what must not pass.
    pub refuse: F,
}

impl<F> Check<F> {
    /// A check by its name.
    pub const fn new(name: &'static str, refuse: F) -> Self {
        Self { name, refuse }
    }
}

/// Tries to get past each check of `table`, with it and without it. `attempt` brings what the named check
/// alone refuses to the table that it is given, and says whether it was taken or why not. Gives a line for
/// each check.
///
/// # Errors
/// The same lines, where a check refuses nothing, where another one refuses the same, or where the table is
/// empty or has a name twice.
pub fn each_left_out<F: Copy, E: Debug>(
    table: &[Check<F>],
    attempt: impl Fn(&str, &[Check<F>]) -> Result<(), E>,
) -> Result<String, String> {
    let mut lines = String::new();
    let mut right = !table.is_empty();
    for Check { name, .. } in table {
        let less: Vec<_> = table.iter().filter(|c| c.name != *name).copied().collect();
        let refused = attempt(name, table);
        let got_through = attempt(name, &less);
        // Without it, what the others refuse is still refused.
        let others = less.iter().all(|c| attempt(c.name, &less).is_err());
        right &= refused.is_err() && got_through.is_ok() && others && less.len() + 1 == table.len();
        lines +=
            &format!("{name}: with it {refused:?}; without it {got_through:?}, others {others}\n");
    }
    if right { Ok(lines) } else { Err(lines) }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Gate = Check<fn(&str) -> Result<(), &'static str>>;

    const LEFT: Gate =
        Check { name: "left", refuse: |who| if who == "left" { Err("shut") } else { Ok(()) } };
    const RIGHT: Gate =
        Check { name: "right", refuse: |who| if who == "right" { Err("shut") } else { Ok(()) } };
    const ALWAYS: Gate = Check { name: "always", refuse: |_| Err("shut") };
    const NEVER: Gate = Check { name: "never", refuse: |_| Ok(()) };

    #[test]
    fn a_check_counts_where_it_and_nothing_else_refuses() {
        let try_table = |table: &[Gate]| {
            each_left_out(table, |name, table| {
                table.iter().try_for_each(|gate| (gate.refuse)(name))
            })
        };
        assert_eq!(
            try_table(&[LEFT, RIGHT]).unwrap(),
            "left: with it Err(\"shut\"); without it Ok(()), others true\n\
             right: with it Err(\"shut\"); without it Ok(()), others true\n"
        );
        assert!(try_table(&[LEFT, NEVER]).is_err(), "one refuses nothing");
        assert!(try_table(&[LEFT, ALWAYS]).is_err(), "another refuses the same");
        assert!(try_table(&[LEFT, LEFT]).is_err(), "one is there twice");
        assert!(try_table(&[]).is_err(), "no check is no proof");
    }
}
