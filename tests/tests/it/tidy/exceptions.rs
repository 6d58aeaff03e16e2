//! What may break a rule, and why. An exception that nothing needs any more is a fault too.

/// (rule, place, reason)
#[rustfmt::skip]
const EXCEPTIONS: &[(&str, &str, &str)] = &[
    ("unused dependency", "proto tonic", "the code that is generated from the .proto files names it"),
    ("unused dependency", "proto tonic-prost", "the code that is generated from the .proto files names it"),
    ("unused dependency", "tests proptest", "so that programs and tests resolve the same features, and nothing is compiled twice"),
];

/// What broke a rule before the rule was there. To be emptied: add nothing here. (rule, place)
#[rustfmt::skip]
const NOT_YET: &[(&str, &str)] = &[
    ("constant", "crates/runlog HEADER"),
    ("constant", "crates/signing DOMAIN"),
    ("constant", "deploy AT_ONCE"),
    ("constant", "deploy DATAGRAM_MAX"),
    ("constant", "deploy LOOK"),
    ("constant", "deploy ROWS_MAX"),
    ("constant", "deploy TIMED"),
    ("constant", "deploy WAITING_MAX"),
    ("constant", "gap ARGUMENTS"),
    ("constant", "gap BASE"),
    ("constant", "gap MARGIN"),
    ("constant", "gap RESAMPLES"),
    ("constant", "gap TORQUE_SHARE"),
    ("constant", "gap WINDOW_S"),
    ("constant", "gap/benchmark HOLDOUT"),
    ("constant", "gap/benchmark SETTLE_S"),
    ("constant", "gap/benchmark STEP_S"),
    ("constant", "policy_server ROBOTS_MAX"),
    ("constant", "tests/chaos_proxy ON_THE_WAY_MAX"),
    ("function length", "crates/runlog/src/ros/container.rs::step"),
    ("function length", "gap/benchmark/src/replay.rs::predict_shifted"),
    ("function length", "gap/benchmark/src/score/summary.rs::rows"),
    ("function length", "gap/benchmark/src/sets.rs::plan"),
    ("function length", "gap/src/diagnose/verdict.rs::conclude"),
    ("function length", "gap/src/page/heat.rs::map"),
    ("function length", "gap/src/page/sections.rs::causes"),
    ("import circle", "crates/config/src/lib.rs"),
    ("import circle", "crates/dynamixel/src/lib.rs"),
    ("import circle", "crates/registry_client/src/lib.rs"),
    ("import circle", "crates/telemetry/src/lib.rs"),
    ("import circle", "crates/traces/src/lib.rs"),
    ("import circle", "deploy/src/lib.rs"),
    ("import circle", "policy_server/src/lib.rs"),
];

/// Something that breaks a rule.
pub struct Offence {
    place: String,
    what: String,
}

impl Offence {
    /// At `place`, as exceptions name it; `what` is for people.
    pub fn new(place: impl Into<String>, what: impl Into<String>) -> Self {
        Self {
            place: place.into(),
            what: what.into(),
        }
    }
}

/// Fails where `rule` is broken and nothing excepts it, and where an exception is not needed.
pub fn hold(rule: &str, offences: Vec<Offence>) {
    let lasting = EXCEPTIONS.iter().map(|(r, place, _)| (*r, *place));
    let excepted: Vec<&str> = lasting
        .chain(NOT_YET.iter().copied())
        .filter(|(r, _)| *r == rule)
        .map(|(_, place)| place)
        .collect();
    let mut faults: Vec<String> = offences
        .iter()
        .filter(|o| !excepted.contains(&o.place.as_str()))
        .map(|o| format!("{}: {}", o.place, o.what))
        .collect();
    let needed = |place: &&&str| offences.iter().any(|o| o.place == **place);
    let idle = excepted.iter().filter(|place| !needed(place));
    faults
        .extend(idle.map(|place| format!("{place}: an exception that nothing needs; take it out")));
    assert!(
        faults.is_empty(),
        "{rule}: {} faults\n{}",
        faults.len(),
        faults.join("\n")
    );
}
