//! Holes in a log: rows that are missing in a row while commands changed, so that nobody knows what the robot was
//! told.

use caudata_runlog::{Signal, Table};

use super::series::{busiest, median_step_s};

/// Rows are missing in a row where a step is longer than so many median steps: of a single missing row the command is
/// nearly what it was before.
const MISSING_STEPS: f64 = 2.5;
/// A robot is where its commands have brought it so long after those that nobody knows, s.
const FORGOTTEN_S: f64 = 0.5;
/// A run that has more of its time in holes than this is not left out bit by bit: its rows come as they come.
const MOST_OF_A_RUN: f64 = 0.25;

/// A hole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Hole {
    /// The row before it, s.
    pub from_s: f64,
    /// The row after it, s.
    pub to_s: f64,
    /// Until then the robot is not where it would be without it, s.
    pub until_s: f64,
    /// Rows that are missing.
    pub rows: usize,
}

/// The holes of a log, in order.
pub(crate) fn holes(table: &Table) -> Vec<Hole> {
    let time_s = busiest(table);
    let median_s = median_step_s(&time_s);
    let (Some(first), Some(last)) = (time_s.first(), time_s.last()) else {
        return Vec::new();
    };
    let long = time_s.windows(2).filter(|w| w[1] - w[0] > MISSING_STEPS * median_s);
    let holes: Vec<Hole> = long
        .filter(|w| told_otherwise(table, w[0], w[1]))
        .map(|w| Hole {
            from_s: w[0],
            to_s: w[1],
            until_s: w[1] + FORGOTTEN_S,
            rows: ((w[1] - w[0]) / median_s).round() as usize - 1,
        })
        .collect();
    let mut reached_s = *first;
    let mut all_s = 0.0;
    for hole in &holes {
        let until_s = hole.until_s.min(*last);
        all_s += (until_s - hole.from_s.max(reached_s)).max(0.0);
        reached_s = reached_s.max(until_s);
    }
    if all_s > MOST_OF_A_RUN * (last - first) { Vec::new() } else { holes }
}

/// Whether any command is another one after a hole than before, and none tells what it was in between.
fn told_otherwise(table: &Table, from_s: f64, to_s: f64) -> bool {
    let commands = table.signals().iter().filter(|s| matches!(s, Signal::Command(_)));
    let time_s = table.time_s();
    let (low, high) =
        (time_s.partition_point(|t| *t <= from_s), time_s.partition_point(|t| *t < to_s));
    let changes = |column: &[Option<f64>]| {
        let before = column[..low].iter().rev().flatten().next();
        let after = column[high..].iter().flatten().next();
        let known = column[low..high].iter().any(Option::is_some);
        !known && matches!((before, after), (Some(b), Some(a)) if b != a)
    };
    commands.filter_map(|signal| table.column(signal)).any(changes)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    /// Rows every 10 ms for 6 s without some, with a command that rises by 1 rad/s until 4 s.
    fn log(missing: &[usize]) -> Table {
        let rows = (0..600).filter(|k| !missing.contains(k));
        let row = |k: usize| format!("{},{},0.1\n", 0.01 * k as f64, 0.01 * k.min(400) as f64);
        let text: String = rows.map(row).collect();
        Table::parse("log.csv", format!("t,cmd.a,pos.a\n{text}").as_bytes()).unwrap()
    }

    #[test]
    fn rows_that_are_missing_in_a_row_while_the_command_moves_are_a_hole() {
        let six = holes(&log(&[100, 101, 102, 103, 104, 105]));
        assert_eq!(six.len(), 1);
        // the row before is number 99, the one after 106
        assert!((six[0].from_s - 0.99).abs() < 1e-9 && (six[0].to_s - 1.06).abs() < 1e-9);
        assert!((six[0].until_s - 1.56).abs() < 1e-9);
        assert_eq!(six[0].rows, 6);
    }

    #[test]
    fn a_single_row_a_command_at_rest_and_a_log_full_of_holes_are_none() {
        assert_eq!(holes(&log(&[100, 200, 300])), []);
        assert_eq!(holes(&log(&[500, 501, 502, 503])), []);
        // four holes of 0.54 s in 6 s are more than a quarter
        let many: Vec<usize> = [50, 150, 250, 350].iter().flat_map(|k| *k..k + 4).collect();
        assert_eq!(holes(&log(&many)), []);
    }
}
