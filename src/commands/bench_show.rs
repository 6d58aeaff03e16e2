//! What benchmarks found, in words.

use caudata_bench::measure::Rate;
use caudata_bench::sim::{DT_S, Speed};
use caudata_bench::transport::ingest;
use caudata_bench::{calibrate, explain, gap, session, sim, skill, train, transport};
use caudata_gap_benchmark::calibrate::Case;
use caudata_gap_benchmark::calibrate::fit::Score;
use caudata_gap_benchmark::case::Answer;
use caudata_gap_benchmark::score::{Outcome, summary::median_gain};
use caudata_sim::batch::Phase;

use crate::say;

/// Physics, its phases, and environment steps.
pub fn sim(found: &sim::Finding) {
    if !found.physics.is_empty() {
        say::records(
            &found.physics,
            "engine scene lane_width lanes steps_per_s all_threads_steps_per_s threads scaling mujoco_steps_per_s ratio diverged",
        );
        phases(&found.physics);
        say::line(format!(
            "{}. Its setting: Newton, 4 iterations, 8 line searches, pyramidal cone, one thread. All steps {} ms.",
            found.mujoco,
            1e3 * DT_S
        ));
    }
    rate(&found.environment);
}

/// Where the time of a step goes, one row per phase, one column per line of the other table.
fn phases(speeds: &[Speed]) {
    let timed: Vec<&Speed> = speeds.iter().filter(|s| !s.phases.is_empty()).collect();
    if timed.is_empty() {
        return;
    }
    let name = |s: &&Speed| match s.lane_width {
        0 => s.scene.name().to_owned(),
        width => format!("{}, {width} lanes", s.scene.name()),
    };
    let mut head = vec!["time of one thread".to_owned()];
    head.extend(timed.iter().map(name));
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    let rows = Phase::ALL.into_iter().enumerate().map(|(at, phase)| {
        let share = |s: &&Speed| format!("{:.1} %", 100.0 * s.phases[at].share);
        let name = std::iter::once(phase.name().to_owned());
        name.chain(timed.iter().map(share)).collect()
    });
    say::table(&head, rows);
}

/// Diagnosis against hidden effects.
pub fn gap(found: &gap::Finding, each: bool) {
    if each {
        for (outcome, answer) in found.outcomes.iter().zip(&found.answers) {
            say::line(one_case(outcome, answer));
        }
    }
    let rows = found.summary.rows().into_iter();
    say::table(
        &["", "measured (95 % interval)", "owed"],
        rows.map(|(what, value, owed)| vec![what, value, owed.to_owned()]),
    );
    if !found.baselines.is_empty() {
        say::line("");
        baselines(found);
    }
    if !found.left_out.is_empty() {
        say::line(format!(
            "\n{} cases were not made: their effect cannot be as large as asked for",
            found.left_out.len()
        ));
    }
    say::line(format!("\n{} cases in {:.0} s", found.cases, found.seconds));
}

fn baselines(found: &gap::Finding) {
    let ours = &found.summary;
    let row = |name: &str, alarms: String, first: String, figures: [f64; 3]| {
        let [wrong, ratio, seconds] = figures;
        let figures = [format!("{wrong:.2}"), format!("{ratio:.3}"), format!("{seconds:.1}")];
        [vec![name.to_owned(), alarms, first], figures.to_vec()].concat()
    };
    let figures = [ours.wrong_per_single, median_gain(&found.outcomes), ours.seconds.0];
    let alarms = ours.false_alarms.to_string();
    let caudata = row("caudata", alarms, ours.first_large.to_string(), figures);
    let others = found.baselines.iter().map(|b| {
        let figures = [b.wrong_per_case, b.holdout_ratio, b.seconds];
        let (alarms, first) = (b.false_alarms.to_string(), b.first_large.to_string());
        row(&b.baseline, alarms, first, figures)
    });
    say::table(
        &[
            "",
            "false alarms",
            "first name right, d >= 4",
            "wrong names per single",
            "held-out error, median ratio",
            "s",
        ],
        std::iter::once(caudata).chain(others),
    );
}

fn one_case(o: &Outcome, a: &Answer) -> String {
    let truth = a.effects.iter();
    let truth = truth.map(|t| format!("{} {} d {:.1}", t.effect, t.joint, t.d));
    let given = o.given.iter();
    let given = given.map(|(effect, place, c)| format!("{effect} {place} {c:.2}"));
    let mark = if o.right { "right" } else { "WRONG" };
    let what = match a.decoy.is_empty() {
        true => truth.collect::<Vec<_>>().join(", "),
        false => a.decoy.clone(),
    };
    format!(
        "{mark}  {:?} {} [{what}]: {} {} {}",
        o.block,
        o.rig,
        o.verdict,
        given.collect::<Vec<_>>().join(", "),
        o.failure
    )
}

/// One case of a calibration.
pub fn calibrated(case: &Case) {
    let name = |n: &caudata_gap_benchmark::calibrate::Name| {
        let mark = if n.right { "right" } else { "wrong" };
        format!("{} {:.2} {mark}", n.effect, n.confidence)
    };
    say::line(format!(
        "{} {:?} {} [{}]: {} {} {:.0} s",
        case.number,
        case.block,
        case.rig,
        case.hidden.join(", "),
        case.names.iter().map(name).collect::<Vec<_>>().join(", "),
        case.failure,
        case.seconds
    ));
}

/// All of them.
pub fn calibration(found: &calibrate::Finding) {
    let row = |what: &str, s: &Score| {
        let (wrong, of) = s.confident;
        let figures = [s.log_score, s.brier, s.calibration_error].map(|x| format!("{x:.3}"));
        let confident = format!("{wrong} of {of}");
        [vec![what.to_owned()], figures.to_vec(), vec![confident]].concat()
    };
    let mut rows =
        vec![row("what was said", &found.as_given), row("the map of this program", &found.shipped)];
    rows.extend(found.left_out.iter().map(|s| row("a new map, parts it has not seen", s)));
    let reports = found.cases.iter().filter(|c| c.verdict.is_some()).count();
    say::line(format!(
        "{} cases, {reports} with a report, {} names",
        found.cases.len(),
        found.as_given.names
    ));
    say::table(&["", "log score", "Brier", "calibration error", "0.7 or more and wrong"], rows);
}

/// One session.
pub fn session(case: &session::Case) {
    say::record(
        case,
        "hidden d ending verdict named right place_right motion_s right_after_s trials seconds failure",
    );
}

/// How many robots were understood.
pub fn sessions(found: &session::Finding) {
    let rates = [
        ("named", found.named),
        ("named within 60 s of motion", found.named_within_60_s),
        ("named, sure, and nothing else", found.sure),
        ("healthy, and nothing named", found.healthy),
    ];
    say::table(
        &["", "measured (95 % interval)"],
        rates.map(|(what, rate)| vec![what.to_owned(), rate.to_string()]),
    );
    say::line(format!(
        "{} sessions in {:.0} s, {} robots left out",
        found.cases.len(),
        found.seconds,
        found.left_out
    ));
}

/// One training from nothing.
pub fn skill(one: &skill::Skill) {
    say::record(one, "seed walks_after_s fast_after_s training_s last_speed_mps last_missed");
}

/// One explanation.
pub fn explained(case: &explain::Outcome) {
    say::record(case, "seed robot hidden verdict score causes named seconds");
}

/// How many mistakes were named.
pub fn explanations(found: &explain::Finding) {
    say::record(found, "mistakes first among_three wrong harmless healthy false_names median_s");
}

/// Where a second of training goes.
pub fn train(found: &train::Finding) {
    say::record(found, "cores busy wall_ratio cpu_ratio");
    say::records(&found.builds, "build starts_after_s iteration_ms cpu_ms steps_per_s");
    let mut head = vec!["part".to_owned()];
    for build in &found.builds {
        head.push(format!("{}, ms", build.build));
        head.push(format!("{}, share", build.build));
    }
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    let parts = found.builds.first().map_or(0, |build| build.parts.len());
    let rows = (0..parts).map(|at| {
        let mut row = vec![found.builds[0].parts[at].part.to_owned()];
        for build in &found.builds {
            let part = &build.parts[at];
            let unknown = || "-".to_owned();
            row.push(part.ms.map_or_else(unknown, |ms| format!("{ms:.2}")));
            let share = part.share.map(|share| format!("{:.1} %", 100.0 * share));
            row.push(share.unwrap_or_else(unknown));
        }
        row
    });
    say::table(&head, rows);
}

/// Links, and rollouts over them.
pub fn transport(found: &transport::Finding) {
    if !found.links.is_empty() {
        say::record(found, "frame_bytes actors seconds");
        say::records(
            &found.links,
            "what frames_per_s gigabytes_per_s latency_p50_us latency_p99_us cpu_s_per_gigabyte",
        );
    }
    if !found.rollouts.is_empty() {
        say::records(&found.rollouts, "what steps_per_s steps_per_cpu_s share_of_bare");
    }
}

/// Light actors against one learner.
pub fn ingest(found: &ingest::Finding) {
    say::record(found, "kind actors frame_bytes every_ms sent received seconds frames_per_s");
    say::record(
        found,
        "acknowledged_p50_ms acknowledged_p99_ms acknowledged_max_ms memory_max_mb memory_before_mb cpu_us_per_frame",
    );
}

/// A rate in words.
pub fn rate(found: &Rate) {
    say::record(found, "benchmark per_second unit rounds round_median_s round_p99_s settings");
}
