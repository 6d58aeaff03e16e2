//! Evaluations as text for a person.

use caudata_evaluation::{
    AnimalRow, Estimate, Gate, Row, ScenarioResult, SuiteResult, TransitionResult, animal_score,
};
use caudata_task::CommandContract;
use caudata_task::termination::TerminationReason;

use crate::say;

/// Said where episodes end because the simulation diverged.
pub const BREAKS_DOWN: &str = "the simulation breaks down (diverged): `caudata robot check` may say where; \
                               or train with --set engine.dt_s=0.001 --set engine.substeps=20";

/// One scenario.
pub fn print(r: &ScenarioResult) {
    say::line(format!("{}: {}", r.name, episodes(r)));
    body(r);
}

/// One scenario, with the name of the engine, by a policy that was trained with such commands.
pub fn print_on(engine: &str, r: &ScenarioResult, trained: &CommandContract) {
    say::line(format!("{} on {engine}: {}", r.name, episodes(r)));
    if let Some(beyond) = beyond(r.command, trained) {
        say::line(format!("  it was not trained for that: {beyond}"));
    }
    body(r);
}

/// Which part of a command (vx, vy, m/s; yaw rate, rad/s) no command of the training had.
fn beyond(command: [f64; 3], trained: &CommandContract) -> Option<String> {
    const ROUNDING: f64 = 1e-4;
    if command == [0.0; 3] {
        // to stand has a share of its own (`zero_share`)
        return None;
    }
    let ranges = [trained.vx_mps, trained.vy_mps, trained.yaw_rate_radps];
    let names = [("vx", "m/s"), ("vy", "m/s"), ("yaw rate", "rad/s")];
    let mut parts = names.into_iter().zip(command).zip(ranges.map(|range| range.map(f64::from)));
    let (((name, unit), x), [low, high]) =
        parts.find(|((_, x), [low, high])| *x < low - ROUNDING || *x > high + ROUNDING)?;
    Some(format!("{name} {x:.2} {unit}, commands were {low:.2} to {high:.2}"))
}

/// What is said after all scenarios: the second engine, the targets.
pub fn print_end(result: &SuiteResult) {
    if let Some(referee) = &result.referee {
        for there in &referee.scenarios {
            let Some(here) = result.scenario(&there.name) else { continue };
            let kept = match here.vx_mps.mean.abs() > STILL {
                true => format!("{:.1} %", 100.0 * there.vx_mps.mean / here.vx_mps.mean),
                false => "–".to_owned(),
            };
            say::line(format!(
                "{}: {:.3} m/s on {}, {:.3} m/s on {}: {kept} kept; falls {:.1} and {:.1} %",
                there.name,
                here.vx_mps.mean,
                result.engine,
                there.vx_mps.mean,
                referee.engine,
                100.0 * here.fall_share.mean,
                100.0 * there.fall_share.mean,
            ));
        }
    }
    if !result.acceptance.is_empty() {
        let head = ["target", "owed", "aim", "measured", "", ""];
        say::table(&head, result.acceptance.iter().map(|row| target(row).to_vec()));
    }
    if let Some(score) = animal_score(&result.animal) {
        let head = ["quantity", "salamander", "robot", "score", "source"];
        say::table(&head, result.animal.iter().map(beside_the_animal));
        say::line(format!(
            "score {score:.2}: the mean of the quantities measured; 1 is a salamander"
        ));
    }
}

/// A target as cells of a table.
pub fn target(row: &Row) -> [String; 6] {
    let sign = if row.at_least { "≥" } else { "≤" };
    let unit = if row.unit == "1" { "" } else { &row.unit };
    let with_unit = |x: f64| format!("{sign} {x} {unit}").trim_end().to_owned();
    let measured = row
        .measured
        .map_or_else(|| "–".to_owned(), |x| format!("{x:.3} {unit}").trim_end().to_owned());
    let met = match (row.met, row.aim_met) {
        (_, true) => "aim met",
        (true, false) => "met",
        (false, false) => "missed",
    };
    [
        row.name.to_string(),
        with_unit(row.owed),
        with_unit(row.aim),
        measured,
        met.to_owned(),
        row.note.clone(),
    ]
}

fn beside_the_animal(row: &AnimalRow) -> Vec<String> {
    let unit = if row.unit == "1" { "" } else { &row.unit };
    let [low, high] = row.animal;
    let animal = match low == high {
        true => format!("{low} {unit}"),
        false => format!("{low} to {high} {unit}"),
    };
    let or_none = |x: Option<f64>| x.map_or_else(|| "–".to_owned(), |x| format!("{x:.2}"));
    vec![
        row.name.to_string(),
        animal.trim_end().to_owned(),
        or_none(row.robot),
        or_none(row.score),
        row.source.to_string(),
    ]
}

fn pm(x: Estimate, digits: usize) -> String {
    let half = (x.ci_high - x.ci_low) / 2.0;
    format!("{:.digits$} ± {half:.digits$}", x.mean)
}

fn episodes(r: &ScenarioResult) -> String {
    let list: Vec<String> = r.falls.iter().map(|(reason, n)| format!("{reason} {n}")).collect();
    let reasons = if list.is_empty() { String::new() } else { format!(" ({})", list.join(", ")) };
    let falls = 100.0 * r.fall_share.mean;
    format!("{} episodes, falls {falls:.1} %{reasons}", r.episodes)
}

/// Slower than this share of its command a robot stands.
const STANDS_SHARE: f64 = 0.1;

/// Whether it keeps on its feet and hardly moves, though it is told to.
fn stands(r: &ScenarioResult) -> bool {
    let [vx_mps, vy_mps, yaw_radps] = r.command;
    let told = vx_mps.hypot(vy_mps);
    let moves = r.vx_mps.mean.hypot(r.vy_mps.mean) > STANDS_SHARE * told;
    let turns = r.yaw_rate_radps.mean.abs() > STANDS_SHARE * yaw_radps.abs().max(1.0);
    told > 0.0 && r.fall_share.mean < 0.5 && !moves && !turns
}

/// Slower than this, m/s and rad/s, a robot that is told to stand has no gait, and its cost of transport and what it
/// keeps of its speed elsewhere are divisions by nothing.
const STILL: f64 = 0.01;

fn has_no_gait(r: &ScenarioResult) -> bool {
    let moves = r.vx_mps.mean.hypot(r.vy_mps.mean) > STILL || r.yaw_rate_radps.mean.abs() > STILL;
    stands(r) || r.command == [0.0; 3] && !moves
}

fn body(r: &ScenarioResult) {
    if r.falls.values().sum::<usize>() == r.episodes && r.power_w.mean == 0.0 {
        say::line("  it falls in every episode before its gait can be measured");
    } else {
        figures(r);
    }
    if r.falls.contains_key(TerminationReason::Diverged.name()) {
        say::line(format_args!("  {BREAKS_DOWN}"));
    }
    if r.gates.is_none() && r.speed_share_least < 1.0 {
        let least = 100.0 * r.speed_share_least;
        say::line(format!("  the slowest episode keeps {least:.0} % of the commanded speed"));
    }
    if let Some(transition) = &r.transition {
        shore(transition);
    }
    if let Some(arrived) = &r.arrived {
        say::line(format!("  gets there in {:.1} %", 100.0 * arrived.mean));
    }
    if let Some(righting) = &r.righting {
        say::line(format!(
            "  on its feet within 3 s in {:.1} %, at the end in {:.1} % (after {} s)",
            100.0 * righting.in_time.mean,
            100.0 * righting.upright.mean,
            righting.righted_s.map_or_else(|| "–".to_owned(), |s| pm(s, 1)),
        ));
    }
    if let Some(verdict) = verdict(r) {
        say::line(format!("  {verdict}"));
    }
}

/// Whether it walks, and by which gates not; `None` where nothing judges.
pub fn verdict(r: &ScenarioResult) -> Option<String> {
    let (gates, walks) = (r.gates.as_ref()?, r.walks()?);
    Some(match (walks, gates.missed()) {
        (true, _) => "walks: every gate is met".to_owned(),
        (false, _) if stands(r) => {
            "stands still: `caudata explain` of its run folder says why".to_owned()
        }
        (false, missed) if missed.is_empty() => "misses a gate: it falls too often".to_owned(),
        (false, _) => {
            let missed = gates.gates.iter().filter(|gate| !gate.met);
            format!("misses gates: {}", missed.map(Gate::told).collect::<Vec<_>>().join("; "))
        }
    })
}

fn figures(r: &ScenarioResult) {
    say::line(format!(
        "  velocity {} m/s forward, {} left, yaw {} rad/s; rms off the command {:.3}, {:.3} m/s, {:.3} rad/s",
        pm(r.vx_mps, 3),
        pm(r.vy_mps, 3),
        pm(r.yaw_rate_radps, 3),
        r.rmse_of_means[0],
        r.rmse_of_means[1],
        r.rmse_of_means[2]
    ));
    say::line(format!(
        "  power {} W,{} torque {:.2} N·m rms, {:.2} peak, at the servo's limit {:.1} %",
        pm(r.power_w, 1),
        match has_no_gait(r) {
            true => String::new(),
            false => format!(" cost of transport {:.2},", r.cost_of_transport.mean),
        },
        r.torque_rms_nm,
        r.torque_peak_nm,
        100.0 * r.servo_limit_share
    ));
    if has_no_gait(r) {
        return;
    }
    let of_feet = format!(
        " duty {}, clearance {} cm, slip {:.1} cm/s,",
        each(&r.duty_factor, |d| format!("{d:.2}")),
        each(&r.clearance_m, |c| format!("{:.1}", 100.0 * c)),
        100.0 * r.slip_mps.mean,
    );
    let vibration = format!("vibration {:.1} %", 100.0 * r.vibration_share.mean);
    if r.duty_factor.is_empty() {
        // it lies or rolls on the ground
        return say::line(format!("  {vibration}"));
    }
    say::line(format!(
        "  stride {:.2} Hz,{of_feet} {vibration}, trunk down {:.1} %",
        r.stride_hz.mean,
        100.0 * r.trunk_contact_share.mean
    ));
}

fn shore(t: &TransitionResult) {
    let or_none = |x: Option<Estimate>, digits| x.map_or_else(|| "–".to_owned(), |x| pm(x, digits));
    let share =
        |x: Option<f64>| x.map_or_else(|| "–".to_owned(), |x| format!("{:.0} %", 100.0 * x));
    say::line(format!(
        "  gets there in {:.1} % ({} s); swims {} m/s at {} W; legs swing {} as far as on land; feet touch {} of the time, {} on land",
        100.0 * t.reached.mean,
        or_none(t.reached_s, 1),
        or_none(t.swim_speed_mps, 3),
        or_none(t.swim_power_w, 1),
        share(t.leg_swing_kept),
        share(t.foot_contact[1]),
        share(t.foot_contact[0]),
    ));
    let Some(wave) = &t.wave_in_water else { return };
    say::line(format!(
        "  in water the body bends at {:.2} Hz, lags behind the head by {}°: {}",
        wave.hz.mean,
        each(&wave.lag_rad, |lag| format!("{:.0}", lag.to_degrees())),
        match wave.travels_to_the_tail {
            true => "a wave that travels to the tail",
            false => "no wave that travels to the tail",
        }
    ));
}

/// Values side by side.
fn each(values: &[f64], show: impl Fn(f64) -> String) -> String {
    let shown: Vec<String> = values.iter().map(|&v| show(v)).collect();
    shown.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_speed_that_no_command_had_is_told() {
        let trained =
            CommandContract { vx_mps: [-0.1, 0.3], vy_mps: [0.0; 2], yaw_rate_radps: [-0.6, 0.6] };
        assert_eq!(beyond([0.3, 0.0, -0.6], &trained), None);
        let fast = CommandContract { vx_mps: [0.1, 0.3], ..trained.clone() };
        assert_eq!(beyond([0.0; 3], &fast), None, "standing has a share of its own");
        let what = "vx 0.50 m/s, commands were -0.10 to 0.30";
        assert_eq!(beyond([0.5, 0.0, 0.0], &trained).as_deref(), Some(what));
        let what = "yaw rate 0.70 rad/s, commands were -0.60 to 0.60";
        assert_eq!(beyond([0.2, 0.0, 0.7], &trained).as_deref(), Some(what));
    }
}
