//! The project's targets for a policy: what is owed, what is aimed at, what was measured.

use crate::result::{Row, ScenarioResult, SuiteResult};
use crate::suite;

/// Fastest command that every gate is owed at, m/s, and a little for rounding.
const MOST_STRAIGHT_MPS: f64 = 0.501;

/// A figure that counts, and what stands against it.
struct Found {
    measured: Option<f64>,
    against: String,
}

impl Found {
    fn plain(measured: Option<f64>) -> Self {
        Self { measured, against: String::new() }
    }

    /// A figure of walking counts only where the scenario is walked by its gates.
    fn walked(scenario: Option<&ScenarioResult>, value: fn(&ScenarioResult) -> f64) -> Self {
        Self {
            measured: scenario.map(value),
            against: scenario.map(objections).unwrap_or_default(),
        }
    }
}

/// Why a scenario does not count as walked; empty where it does.
pub(crate) fn objections(scenario: &ScenarioResult) -> String {
    let missed = scenario.gates.as_ref().map_or_else(Vec::new, |g| g.missed());
    match scenario.walks() {
        Some(false) if missed.is_empty() => falls_in(scenario),
        Some(false) => format!("gates missed: {}", missed.join("; ")),
        _ => String::new(),
    }
}

pub(crate) fn falls_in(scenario: &ScenarioResult) -> String {
    format!("falls in {:.1} %", 100.0 * scenario.fall_share.mean)
}

/// What is owed, and the aim.
#[derive(Clone, Copy)]
enum Target {
    AtLeast(f64, f64),
    AtMost(f64, f64),
}
use Target::{AtLeast, AtMost};

fn row(name: &'static str, unit: &'static str, target: Target, found: Found) -> Row {
    let (owed, aim, at_least) = match target {
        AtLeast(owed, aim) => (owed, aim, true),
        AtMost(owed, aim) => (owed, aim, false),
    };
    let holds = |limit: f64| match found.measured {
        Some(x) if at_least => x >= limit,
        Some(x) => x <= limit,
        None => false,
    };
    let counts = found.against.is_empty();
    Row {
        name: name.into(),
        unit: unit.into(),
        owed,
        aim,
        at_least,
        measured: found.measured,
        met: counts && holds(owed),
        aim_met: counts && holds(aim),
        note: match found.measured {
            Some(_) => found.against,
            None => "not measured".to_owned(),
        },
    }
}

/// The table from the results of the suite `acceptance`. Times of training are not in it: a policy does not
/// show them.
pub fn acceptance(result: &SuiteResult) -> Vec<Row> {
    let mut rows = walking(result);
    rows.extend(standing_and_pushes(result));
    rows.extend(shore(result));
    rows.extend(elsewhere(result));
    rows
}

fn vx(s: &ScenarioResult) -> f64 {
    s.vx_mps.mean
}

fn walking(result: &SuiteResult) -> Vec<Row> {
    let flat = result.scenario(suite::FLAT);
    let cost: fn(&ScenarioResult) -> f64 = |s| s.cost_of_transport.mean;
    let rough = |i: usize| Found::walked(result.scenario(suite::ROUGH[i]), vx);
    #[rustfmt::skip]
    let rows = vec![
        row("flat, command 0.3 m/s: speed forward", "m/s", AtLeast(0.28, 0.295), Found::walked(flat, vx)),
        row("flat, command 0.3 m/s: cost of transport", "1", AtMost(1.2, 0.8), Found::walked(flat, cost)),
        row("fastest command tracked within 10 % on flat ground", "m/s", AtLeast(0.5, 0.8), fastest(result)),
        row("flat, 0.1 to 0.5 m/s and backward: walked by every gate", "1", AtLeast(1.0, 1.0), walked_straight(result)),
        row("rough easy (2 cm, 15°): speed forward", "m/s", AtLeast(0.24, 0.28), rough(0)),
        row("rough medium (4 cm, 15°): speed forward", "m/s", AtLeast(0.22, 0.26), rough(1)),
        row("rough hard (4 cm, 25°): speed forward", "m/s", AtLeast(0.19, 0.24), rough(2)),
    ];
    rows
}

/// Share of the commands straight ahead up to 0.5 m/s, and backward, that are walked by every gate.
fn walked_straight(result: &SuiteResult) -> Found {
    let straight = result.scenarios.iter().filter(|s| {
        s.name == suite::BACK || (s.name.starts_with("flat ") && s.command[0] <= MOST_STRAIGHT_MPS)
    });
    let all: Vec<&ScenarioResult> = straight.collect();
    if all.is_empty() {
        return Found::plain(None);
    }
    let against = |s: &&ScenarioResult| {
        let against = objections(s);
        (!against.is_empty()).then(|| format!("{}: {against}", s.name))
    };
    let walked = all.iter().filter(|s| objections(s).is_empty()).count();
    Found {
        measured: Some(walked as f64 / all.len() as f64),
        against: all.iter().filter_map(against).collect::<Vec<_>>().join(" | "),
    }
}

/// The fastest of the commands straight ahead on flat ground that is tracked within a tenth, every gate met.
fn fastest(result: &SuiteResult) -> Found {
    let mut tracked: Vec<(f64, String)> = result
        .scenarios
        .iter()
        .filter(|s| s.name.starts_with("flat "))
        .filter(|s| (s.vx_mps.mean - s.command[0]).abs() <= 0.1 * s.command[0])
        .map(|s| (s.command[0], objections(s)))
        .collect();
    tracked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let walked = tracked.iter().rev().find(|(_, against)| against.is_empty());
    let Some((best, _)) = walked.or(tracked.last()) else { return Found::plain(None) };
    // without any that counts, the fastest one's objections stand beside it
    let against = match walked {
        Some(_) => String::new(),
        None => tracked.last().map(|(_, a)| a.clone()).unwrap_or_default(),
    };
    Found { measured: Some(*best), against }
}

fn standing_and_pushes(result: &SuiteResult) -> Vec<Row> {
    let omni = |i: usize| Found::plain(result.scenario(suite::OMNI).map(|s| s.rmse_of_means[i]));
    let stand = result.scenario(suite::STAND);
    let survived = result.scenario(suite::PUSH).map(|s| 1.0 - s.fall_share.mean);
    #[rustfmt::skip]
    let rows = vec![
        row("omni grid: RMSE of vx", "m/s", AtMost(0.04, 0.02), omni(0)),
        row("omni grid: RMSE of vy", "m/s", AtMost(0.05, 0.02), omni(1)),
        row("omni grid: RMSE of yaw rate", "rad/s", AtMost(0.12, 0.06), omni(2)),
        row("zero command: power", "W", AtMost(2.0, 0.5), Found::plain(stand.map(|s| s.power_w.mean))),
        row("zero command: drift", "m/s", AtMost(0.01, 0.001), Found::plain(stand.map(|s| s.drift_mps.mean))),
        row("pushes of 0.5 m/s every 3 s: survived 20 s", "1", AtLeast(0.95, 0.99), Found::plain(survived)),
    ];
    rows
}

fn shore(result: &SuiteResult) -> Vec<Row> {
    let at = |name| result.scenario(name).and_then(|s| s.transition.as_ref());
    let into = at(suite::INTO_WATER);
    let back = at(suite::ONTO_LAND).map(|t| t.reached.mean);
    let swim = into.and_then(|t| t.swim_speed_mps).map(|e| e.mean);
    let wave = into.and_then(|t| t.wave_in_water.as_ref());
    let grows = wave.map(|w| f64::from(u8::from(w.travels_to_the_tail)));
    let legs = into.and_then(|t| t.leg_swing_kept);
    let touch = into.and_then(|t| t.foot_contact[1]);
    let [left, right] = suite::SWIM_TURN.map(|name| result.scenario(name));
    let yaw = |s: Option<&ScenarioResult>| s.map(|s| s.yaw_rate_radps.mean);
    let turn = yaw(left).zip(yaw(right).map(|w| -w)).map(|(l, r)| l.min(r));
    let straight = yaw(result.scenario(suite::SWIM)).map(f64::abs);
    #[rustfmt::skip]
    let rows = vec![
        row("shore: a body length into the water within 20 s", "1", AtLeast(0.95, 0.99), Found::plain(into.map(|t| t.reached.mean))),
        row("swimming speed, command 0.3 m/s", "m/s", AtLeast(0.15, 0.3), Found::plain(swim)),
        // a yes or no
        row("in water: phase lag grows at every joint to the tail", "1", AtLeast(1.0, 1.0), Found::plain(grows)),
        row("in water: leg swing over that on land", "1", AtMost(0.5, 0.5), Found::plain(legs)),
        row("in water: share of time that feet touch", "1", AtMost(0.02, 0.0), Found::plain(touch)),
        row("swimming, 0.5 rad/s commanded: turn, slower side", "rad/s", AtLeast(0.3, 0.5), Found::plain(turn)),
        row("swimming straight: yaw drift", "rad/s", AtMost(0.02, 0.01), Found::plain(straight)),
        row("shore: from the water back onto land within 30 s, heading held", "1", AtLeast(0.5, 0.95), Found::plain(back)),
    ];
    rows
}

fn elsewhere(result: &SuiteResult) -> Vec<Row> {
    let kept = |of: Option<&ScenarioResult>, over: Option<&ScenarioResult>| match (of, over) {
        (Some(of), Some(over)) if over.vx_mps.mean > 0.0 => Found {
            measured: Some(of.vx_mps.mean / over.vx_mps.mean),
            against: if of.fall_share.mean > 0.05 { objections(of) } else { String::new() },
        },
        _ => Found::plain(None),
    };
    let referee = result.referee.as_ref().and_then(|r| r.scenario(suite::FLAT));
    let (nominal, worst) = (result.scenario(suite::NOMINAL), result.scenario(suite::WORST_CORNER));
    vec![
        row(
            "on the second engine: speed kept",
            "1",
            AtLeast(0.9, 0.98),
            kept(referee, result.scenario(suite::FLAT)),
        ),
        row(
            "worst corner of the randomisation: speed kept",
            "1",
            AtLeast(0.85, 0.95),
            kept(worst, nominal),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Estimate, GateReport, Suite};

    fn scenario(name: &str, command: f64, vx: f64, walks: bool) -> ScenarioResult {
        ScenarioResult {
            name: name.to_owned(),
            command: [command, 0.0, 0.0],
            vx_mps: Estimate::of(&[vx]),
            cost_of_transport: Estimate::of(&[0.9]),
            gates: Some(GateReport { walks, gates: Vec::new() }),
            ..ScenarioResult::default()
        }
    }

    fn result(scenarios: Vec<ScenarioResult>) -> SuiteResult {
        SuiteResult {
            suite: Suite::Acceptance,
            engine: "batch".into(),
            policy_version: 1,
            policy_sha256: String::new(),
            scenarios,
            referee: None,
            acceptance: Vec::new(),
            animal: Vec::new(),
        }
    }

    fn find<'a>(rows: &'a [Row], start: &str) -> &'a Row {
        rows.iter().find(|r| r.name.starts_with(start)).unwrap()
    }

    #[test]
    fn figures_against_limits() {
        let rows = acceptance(&result(vec![scenario(suite::FLAT, 0.3, 0.285, true)]));
        let speed = find(&rows, "flat, command 0.3 m/s: speed");
        assert!(speed.met && !speed.aim_met && speed.at_least);
        // at most 1.2, aim 0.8: 0.9 meets what is owed
        let cost = find(&rows, "flat, command 0.3 m/s: cost");
        assert!(cost.met && !cost.aim_met && !cost.at_least);
        let omni = find(&rows, "omni grid: RMSE of vx");
        assert_eq!((omni.met, omni.note.as_str()), (false, "not measured"));
    }

    #[test]
    fn speed_without_walking_does_not_count() {
        let rows = acceptance(&result(vec![scenario(suite::FLAT, 0.3, 0.3, false)]));
        let speed = find(&rows, "flat, command 0.3 m/s: speed");
        assert_eq!(speed.measured, Some(0.3));
        assert!(!speed.met);
    }

    #[test]
    fn the_fastest_command_is_the_fastest_that_is_walked() {
        let rows = acceptance(&result(vec![
            scenario("flat 0.4 m/s", 0.4, 0.37, true),
            scenario("flat 0.5 m/s", 0.5, 0.51, false),
            // off by more than a tenth
            scenario("flat 0.6 m/s", 0.6, 0.53, true),
        ]));
        let fastest = find(&rows, "fastest");
        assert_eq!((fastest.measured, fastest.met), (Some(0.4), false));
    }

    #[test]
    fn speed_kept_in_the_worst_corner() {
        let rows = acceptance(&result(vec![
            scenario(suite::NOMINAL, 0.3, 0.30, true),
            scenario(suite::WORST_CORNER, 0.3, 0.27, true),
        ]));
        let kept = find(&rows, "worst corner");
        assert!((kept.measured.unwrap() - 0.9).abs() < 1e-12);
        assert!(kept.met && !kept.aim_met);
    }
}
