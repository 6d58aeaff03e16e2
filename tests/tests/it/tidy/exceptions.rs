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
    ("constant", ". LOOK_EVERY"),
    ("constant", ". OWN"),
    ("constant", "crates/runlog HEADER"),
    ("constant", "crates/signing DOMAIN"),
    ("constant", "crates/verify DT_S"),
    ("constant", "deploy AT_ONCE"),
    ("constant", "deploy DATAGRAM_MAX"),
    ("constant", "deploy LOOK"),
    ("constant", "deploy ROWS_MAX"),
    ("constant", "deploy TIMED"),
    ("constant", "deploy WAITING_MAX"),
    ("constant", "learner COLUMNS"),
    ("constant", "learner SLICE"),
    ("constant", "learner STOP_PATIENCE"),
    ("constant", "sim FORMAT"),
    ("constant", "sim LEAST"),
    ("constant", "sim MAX_LANES"),
    ("constant", "sim MAX_POINTS"),
    ("constant", "tests/chaos_proxy ON_THE_WAY_MAX"),
    ("constant", "transport RETRY"),
    ("documentation", "actor/src/gaussian.rs"),
    ("documentation", "crates/env/src/measure.rs"),
    ("documentation", "crates/evaluation/src/envelope.rs"),
    ("documentation", "crates/evaluation/src/summary.rs"),
    ("documentation", "crates/signing/src/rotation.rs"),
    ("documentation", "crates/telemetry/src/advice.rs"),
    ("documentation", "deploy/src/boundary.rs"),
    ("documentation", "deploy/src/commands/doctor.rs"),
    ("documentation", "deploy/src/stage.rs"),
    ("documentation", "learner/src/ppo/loss.rs"),
    ("documentation", "learner/src/ppo/reduction.rs"),
    ("documentation", "learner/src/ppo/update.rs"),
    ("documentation", "learner/src/ranks/link.rs"),
    ("documentation", "learner/src/ranks/mod.rs"),
    ("documentation", "learner/src/ranks/wire.rs"),
    ("documentation", "policy_server/src/audit.rs"),
    ("documentation", "proto/src/registry/people.rs"),
    ("documentation", "sim/src/batch/smooth.rs"),
    ("documentation", "sim/src/drive/loop_delay.rs"),
    ("documentation", "sim/src/mobility.rs"),
    ("documentation", "sim/src/momenta.rs"),
    ("documentation", "sim/src/rapier/friction.rs"),
    ("documentation", "src/commands/adapt.rs"),
    ("documentation", "src/commands/bench_lag.rs"),
    ("documentation", "src/commands/bench_skill.rs"),
    ("documentation", "src/commands/bench_transport.rs"),
    ("documentation", "src/commands/gap.rs"),
    ("documentation", "src/commands/gap_policies/figures.rs"),
    ("documentation", "src/commands/gap_policies/speed.rs"),
    ("documentation", "task/src/mirror.rs"),
    ("documentation", "task/src/reward/terms.rs"),
    ("documentation", "tests/chaos_proxy/src/datagrams.rs"),
    ("documentation", "tests/tests/it/chaos.rs"),
    ("documentation", "transport/tests/cases/processes.rs"),
    ("example", "docs/reference/configuration.md: caudata-learner --rank R"),
    ("file length", "crates/registry_client/src/lib.rs"),
    ("file length", "deploy/src/control.rs"),
    ("file length", "deploy/src/hardware/mod.rs"),
    ("file length", "deploy/src/supervisor/mod.rs"),
    ("file length", "learner/src/ppo/update.rs"),
    ("file length", "learner/src/train/run.rs"),
    ("file length", "policy_server/src/service.rs"),
    ("file length", "policy_server/src/store.rs"),
    ("file length", "sim/src/simd/x86.rs"),
    ("file length", "src/commands/bench_transport.rs"),
    ("file length", "src/commands/train/supervise.rs"),
    ("function length", "crates/model/src/load.rs::build"),
    ("function length", "crates/model/src/robot_file.rs::run"),
    ("function length", "crates/runlog/src/ros/container.rs::step"),
    ("function length", "crates/runlog/src/ros/write.rs::messages"),
    ("function length", "crates/verify/src/travel.rs::check"),
    ("function length", "deploy/src/commands/control_loop.rs::drive"),
    ("function length", "learner/src/ranks/rank.rs::work"),
    ("function length", "learner/src/train/setup.rs::train"),
    ("function length", "sim/src/batch/contact.rs::touch"),
    ("function length", "sim/src/batch/program.rs::new"),
    ("function length", "sim/src/extension.rs::visit"),
    ("function length", "sim/src/mobility.rs::of"),
    ("function length", "sim/src/params.rs::validate"),
    ("function length", "src/commands/adapt.rs::run"),
    ("function length", "src/commands/adapt.rs::tell"),
    ("function length", "src/commands/bench_ingest.rs::run"),
    ("function length", "src/commands/bench_sim.rs::one"),
    ("function length", "src/commands/bench_transport.rs::collected"),
    ("function length", "src/commands/gap_check.rs::print"),
    ("function length", "src/commands/gap_report.rs::print"),
    ("import circle", "crates/config/src/lib.rs"),
    ("import circle", "crates/dynamixel/src/lib.rs"),
    ("import circle", "crates/env/src/lib.rs"),
    ("import circle", "crates/evaluation/src/lib.rs"),
    ("import circle", "crates/model/src/lib.rs"),
    ("import circle", "crates/pki/src/lib.rs"),
    ("import circle", "crates/registry_client/src/lib.rs"),
    ("import circle", "crates/signing/src/lib.rs"),
    ("import circle", "crates/telemetry/src/lib.rs"),
    ("import circle", "crates/traces/src/lib.rs"),
    ("import circle", "crates/verify/src/lib.rs"),
    ("import circle", "deploy/src/lib.rs"),
    ("import circle", "learner/src/lib.rs"),
    ("import circle", "policy_server/src/lib.rs"),
    ("import circle", "proto/src/lib.rs"),
    ("import circle", "sim/src/lib.rs"),
    ("import circle", "src/main.rs"),
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
