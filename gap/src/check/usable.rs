//! Whether there is anything to check: the right robot, its joints, enough rows.

use std::collections::{BTreeMap, BTreeSet};

use super::channels::Channels;
use super::finding::{Finding, Run};
use crate::reading::{is_beside, is_read};

/// A run shorter than this says nothing, s.
const SHORTEST_RUN_S: f64 = 2.0;
/// A run with fewer rows than this says nothing.
const FEWEST_ROWS: usize = 50;

/// Whether a run can be checked at all; why not, and which columns are empty, goes to `out`.
pub(super) fn usable(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) -> bool {
    let before = out.len();
    columns(run, joints, out);
    misspelt(run, out);
    let table = &run.log.table;
    let span_s = table.time_s().last().unwrap_or(&0.0) - table.time_s().first().unwrap_or(&0.0);
    if table.len() < FEWEST_ROWS || span_s < SHORTEST_RUN_S {
        let detail = format!(
            "is {span_s:.2} s long in {} rows; a run has at least {SHORTEST_RUN_S} s and {FEWEST_ROWS} rows",
            table.len()
        );
        out.push(Finding::fatal("short", &run.log.rows_name, detail));
    }
    let usable = out.len() == before;
    for signal in table.signals() {
        let column = table.column(signal);
        if column.is_some_and(|c| c.iter().all(Option::is_none)) {
            let detail = "has no sample in the whole run".to_owned();
            out.push(Finding::note("empty", signal.to_string(), detail));
        }
    }
    usable
}

/// Keys of `log.toml` that count.
const KEYS: [&str; 11] = [
    "robot",
    "base",
    "terrain",
    "rate_hz",
    "notes",
    "kp",
    "kd",
    "supply_v",
    "water_level_m",
    "joint",
    "payload",
];

/// Settings that nobody reads because their keys are spelt a little otherwise than those that count.
fn misspelt(run: &Run<'_>, out: &mut Vec<Finding>) {
    // unit and plural are no other word
    let plain = |key: &str| {
        let key = key.to_lowercase().replace(['_', '-', ' '], "");
        let ends = ["nmperrad", "nmsperrad", "volts", "volt", "hz", "v", "s"];
        let end = ends.iter().find(|e| key.len() > e.len() + 1 && key.ends_with(**e));
        end.map_or(key.clone(), |e| key[..key.len() - e.len()].to_owned())
    };
    for key in run.log.meta.settings.keys() {
        let like = |k: &&&str| *k != key && one_letter_off(&plain(k), &plain(key));
        if let Some(meant) = KEYS.iter().find(like) {
            let detail = format!("`{key}` is not read; write `{meant}`");
            out.push(Finding::fatal("meta", &run.log.meta_name, detail));
        }
    }
}

/// What no diagnosis reads, with the number of runs that have it.
pub(super) fn not_used(runs: &[Run<'_>]) -> BTreeMap<String, usize> {
    let mut out = BTreeMap::new();
    for run in runs {
        let table = &run.log.table;
        let meta = &run.log.meta;
        let unread = table.signals().iter().filter(|s| !is_read(s, meta.base));
        // `base.pos.x` to `base.pos.z` are one thing
        let of_signals = unread.map(|s| {
            let name = s.to_string();
            let axis = name.rsplit_once('.').filter(|(_, end)| end.len() == 1);
            axis.map_or(name.clone(), |(all, _)| all.to_owned())
        });
        let keys = meta.settings.keys().filter(|k| !KEYS.contains(&k.as_str()));
        let of_meta = keys.map(|k| format!("setting {k}"));
        let of_table = table.notes().iter().cloned();
        let once: BTreeSet<String> = of_signals.chain(of_meta).chain(of_table).collect();
        for what in once {
            *out.entry(what).or_insert(0) += 1;
        }
    }
    out
}

/// Whether two words are the same but for one letter that is another one, missing or too much. Of short words
/// all letters count.
fn one_letter_off(a: &str, b: &str) -> bool {
    const SHORT: usize = 4;
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let longest = a.len().max(b.len());
    if a == b || longest < SHORT || a.len().abs_diff(b.len()) > 1 {
        return a == b;
    }
    let ahead = a.iter().zip(&b).take_while(|(x, y)| x == y).count();
    let behind = (a.iter().rev()).zip(b.iter().rev());
    let behind = behind.take_while(|(x, y)| x == y).count();
    ahead + behind + 1 >= longest
}

/// Whether the log has commands and positions of this robot's joints, and of no others.
fn columns(run: &Run<'_>, joints: &[Channels], out: &mut Vec<Finding>) {
    let mut fatal = |detail| out.push(Finding::fatal("columns", &run.log.rows_name, detail));
    let known = run.robot.actuated_names();
    let signals = run.log.table.signals().iter();
    let mut strangers: Vec<&str> =
        (signals.filter_map(|s| s.joint())).filter(|j| !known.contains(j)).collect();
    strangers.sort_unstable();
    strangers.dedup();
    let (robot, own, strange) = (run.robot.name(), known.join(", "), strangers.join(", "));
    if joints.is_empty() {
        return fatal(match strangers.is_empty() {
            true => {
                "has no joint column; a diagnosis needs `cmd.<joint>` and `pos.<joint>`".to_owned()
            }
            false => format!(
                "has joints {strange} where `{robot}` has {own}: a log of another robot (`robot = \"{}\"`)",
                run.log.meta.robot
            ),
        });
    }
    if !strangers.is_empty() {
        fatal(format!("has {strange} and `{robot}` has no such joint; its joints are {own}"));
    }
    for (what, has) in [
        (
            "cmd",
            joints.iter().any(|j| j.cmd.is_some()) || run.log.table.signals().iter().any(is_beside),
        ),
        ("pos", joints.iter().any(|j| j.pos.is_some())),
    ] {
        if !has {
            fatal(format!("has no column `{what}.<joint>`"));
        }
    }
}
