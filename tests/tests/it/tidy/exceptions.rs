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
    ("constant", "crates/bench DT_S"),
    ("constant", "crates/runlog HEADER"),
    ("constant", "crates/signing DOMAIN"),
    ("constant", "crates/studies OWN"),
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
    ("documentation", "crates/bench/src/lag.rs"),
    ("documentation", "crates/bench/src/measure.rs"),
    ("documentation", "crates/bench/src/transport/rollouts.rs"),
    ("documentation", "crates/env/src/measure.rs"),
    ("documentation", "crates/evaluation/src/envelope.rs"),
    ("documentation", "crates/evaluation/src/summary.rs"),
    ("documentation", "crates/signing/src/rotation.rs"),
    ("documentation", "crates/studies/src/adapt.rs"),
    ("documentation", "crates/studies/src/policies/figures.rs"),
    ("documentation", "crates/studies/src/policies/speed.rs"),
    ("documentation", "crates/studies/src/table.rs"),
    ("documentation", "crates/telemetry/src/advice.rs"),
    ("documentation", "deploy/src/boundary.rs"),
    ("documentation", "deploy/src/commands/doctor.rs"),
    ("documentation", "deploy/src/stage.rs"),
    ("documentation", "gap/benchmark/src/score/summary.rs"),
    ("documentation", "gap/benchmark/src/score/wilson.rs"),
    ("documentation", "gap/src/check/excites.rs"),
    ("documentation", "gap/src/diagnose/doubt.rs"),
    ("documentation", "gap/src/diagnose/losses.rs"),
    ("documentation", "gap/src/diagnose/noise.rs"),
    ("documentation", "gap/src/plots.rs"),
    ("documentation", "gap/src/replay/observe.rs"),
    ("documentation", "gap/src/replay/starts.rs"),
    ("documentation", "gap/src/report.rs"),
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
    ("file length", "gap/benchmark/src/generate.rs"),
    ("file length", "gap/benchmark/src/salamander.rs"),
    ("file length", "gap/src/diagnose/judge.rs"),
    ("file length", "gap/src/diagnose/losses.rs"),
    ("file length", "gap/src/diagnose/search.rs"),
    ("file length", "gap/src/diagnose/verdict.rs"),
    ("file length", "learner/src/ppo/update.rs"),
    ("file length", "learner/src/train/run.rs"),
    ("file length", "policy_server/src/service.rs"),
    ("file length", "policy_server/src/store.rs"),
    ("file length", "src/commands/train/supervise.rs"),
    ("function length", "crates/bench/src/verify/travel.rs::check"),
    ("function length", "crates/runlog/src/ros/container.rs::step"),
    ("function length", "crates/runlog/src/ros/write.rs::messages"),
    ("function length", "deploy/src/commands/control_loop.rs::drive"),
    ("function length", "gap/benchmark/src/baselines/fit.rs::evolve"),
    ("function length", "gap/benchmark/src/baselines/fit.rs::least_squares"),
    ("function length", "gap/benchmark/src/replay.rs::predict_shifted"),
    ("function length", "gap/benchmark/src/salamander.rs::make"),
    ("function length", "gap/benchmark/src/salamander.rs::truth"),
    ("function length", "gap/benchmark/src/score/outcome.rs::judge"),
    ("function length", "gap/benchmark/src/score/summary.rs::of"),
    ("function length", "gap/benchmark/src/score/summary.rs::rows"),
    ("function length", "gap/benchmark/src/sets.rs::plan"),
    ("function length", "gap/src/check/repeats.rs::odd_spans"),
    ("function length", "gap/src/diagnose/judge.rs::nuisances"),
    ("function length", "gap/src/diagnose/pictures.rs::overlays"),
    ("function length", "gap/src/diagnose/screen.rs::judge"),
    ("function length", "gap/src/diagnose/search.rs::search"),
    ("function length", "gap/src/diagnose/verdict.rs::cause"),
    ("function length", "gap/src/diagnose/verdict.rs::conclude"),
    ("function length", "gap/src/diagnose/verdict.rs::summary"),
    ("function length", "gap/src/import/bam.rs::parse"),
    ("function length", "gap/src/page/heat.rs::map"),
    ("function length", "gap/src/page/sections.rs::causes"),
    ("function length", "gap/src/replay/observe.rs::channel"),
    ("function length", "gap/src/trial.rs::new"),
    ("function length", "learner/src/ranks/rank.rs::work"),
    ("function length", "learner/src/train/setup.rs::train"),
    ("import circle", "crates/config/src/lib.rs"),
    ("import circle", "crates/dynamixel/src/lib.rs"),
    ("import circle", "crates/env/src/lib.rs"),
    ("import circle", "crates/pki/src/lib.rs"),
    ("import circle", "crates/registry_client/src/lib.rs"),
    ("import circle", "crates/signing/src/lib.rs"),
    ("import circle", "crates/telemetry/src/lib.rs"),
    ("import circle", "crates/traces/src/lib.rs"),
    ("import circle", "deploy/src/lib.rs"),
    ("import circle", "learner/src/lib.rs"),
    ("import circle", "policy_server/src/lib.rs"),
    ("import circle", "proto/src/lib.rs"),
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
