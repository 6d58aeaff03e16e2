//! A hostile afternoon, again and again: the real programs, on this computer's loopback interface only, against
//! whatever somebody with a connection, a certificate, a file or a signal can do to them. Every attack is
//! bounded in number and ends by itself.
//!
//! The catalogue is [`ROWS`]: the next hole is one more row. `make test` tries each a few times, `make siege`
//! (`CAUDATA_SIEGE=times`) many times, and prints what came of each.

mod bits;
mod clocks;
mod deaths;
pub mod lab;
mod lies;
mod owners;
mod peers;

use anyhow::Result;
use lab::Lab;

/// One attack: tried so many times, it answers in a few words what the programs did; an error is a hole.
type Attack = fn(&Lab, usize) -> Result<String>;

/// What is tried.
struct Row {
    what: &'static str,
    attack: Attack,
}

const fn row(what: &'static str, attack: Attack) -> Row {
    Row { what, attack }
}

const ROWS: &[Row] = &[
    row("a server that answers with another signed stream", lies::another_stream),
    row("a server whose stored policy has other bytes", lies::other_bytes),
    row("an input without an end, wherever a file is named", lies::endless_inputs),
    row("silent connections on every listener", peers::silent),
    row("requests that drip in", peers::dripping),
    row("connections beyond the limit of open files", peers::few_files),
    row("a robot that never stops reporting", peers::chatty_robot),
    row("two policy servers on one folder", owners::two_servers),
    row("two trainings in one folder", owners::two_trainings),
    row("two robots on one state", owners::two_robots),
    row("links and folders of others where a program writes", owners::links),
    row("secrets that others may read", owners::open_secrets),
    row("a flipped bit in every kind of file", bits::every_kind),
    row("a policy server killed under publications", deaths::server),
    row("a robot killed while it fetches", deaths::robot),
    row("a wall clock that swings by hours in mid-run", clocks::swinging),
];

#[test]
fn the_programs_bear_every_row_of_the_catalogue() {
    let times = std::env::var("CAUDATA_SIEGE").map_or(2, |n| n.parse().expect("a number of times"));
    // Part of a row's name, to try a mended one alone.
    let only = std::env::var("CAUDATA_SIEGE_ROW").unwrap_or_default();
    let lab = Lab::open().unwrap();
    let mut holes = 0;
    let mut table = "| attack | times | what came of it |\n|---|---|---|\n".to_owned();
    for Row { what, attack } in ROWS.iter().filter(|row| row.what.contains(&only)) {
        let came = attack(&lab, times).unwrap_or_else(|hole| {
            holes += 1;
            format!("**hole**: {hole:#}")
        });
        let line = format!("| {what} | {times} | {came} |\n");
        // Seen as it goes with --nocapture: `make siege`.
        print!("{line}");
        table += &line;
    }
    assert_eq!(holes, 0, "\n{table}");
}
