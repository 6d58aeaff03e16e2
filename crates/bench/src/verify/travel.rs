//! Twenty seconds of random open-loop gaits: where they lead, against MuJoCo's converged setting, and how
//! that depends on the step.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{Engine, EngineConfig, EngineKind, InitialState, TerrainConfig, build};
use serde_json::{Value, json};

use super::error::VerifyError;
use super::gait::Gait;
use super::mujoco::Mujoco;
use super::request;
use super::request::RobotRequest;
use super::row::{Bench, Row, largest};

/// Steps whose travel is compared, s; the second is the one that is judged.
const STEPS_S: [f64; 4] = [0.004, 0.002, 0.001, 0.0005];
const JUDGED: usize = 1;

/// How far one joint is moved to see how MuJoCo's own answers scatter, rad.
const NUDGE_RAD: f32 = 1e-4;

/// Centre of mass (3), heading, base position (3), after each control period.
pub(crate) type Path = Vec<[f64; 7]>;

/// Where a lane stands, as MuJoCo wants it.
pub(crate) struct Start {
    /// Position, then w, x, y, z.
    pub base: Vec<f32>,
    /// Model order.
    pub joint_pos: Vec<f32>,
}

pub(crate) fn start_of(engine: &dyn Engine, lane: usize) -> Start {
    let s = engine.state();
    let of = |v: &[f32], k: usize| v[lane * k..(lane + 1) * k].to_vec();
    Start {
        base: [of(&s.base_pos_m, 3), of(&s.base_quat_wxyz, 4)].concat(),
        joint_pos: of(&s.joint_pos_rad, s.joints),
    }
}

/// Distance, m, and change of heading, rad, of several paths.
type Outcomes = Vec<(f64, f64)>;

/// The paths in an answer of the script.
pub(crate) fn paths(answer: &Value) -> Result<Vec<Path>, VerifyError> {
    serde_json::from_value(answer.clone()).map_err(|e| VerifyError::Mujoco(e.to_string()))
}

/// Horizontal distance between the ends, m, and the change of heading, rad, of a path.
fn outcome(path: &Path) -> (f64, f64) {
    let (Some(a), Some(b)) = (path.first(), path.last()) else { return (f64::NAN, f64::NAN) };
    // Heading unwrapped: a period turns by far less than half a turn.
    let turned = path.windows(2).map(|w| wrap(w[1][3] - w[0][3])).sum();
    ((b[0] - a[0]).hypot(b[1] - a[1]), turned)
}

fn wrap(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    (angle + PI).rem_euclid(TAU) - PI
}

pub(crate) fn check(bench: &mut Bench<'_>) -> Result<Vec<Row>, VerifyError> {
    let model = Arc::clone(&bench.model);
    let settings = bench.settings;
    let gaits: Vec<Gait> =
        (0..settings.gaits as u64).map(|i| Gait::random(settings.seed, i)).collect();
    let periods = (settings.gait_s / 0.02).round() as usize;
    let mut reference: Option<Outcomes> = None;
    let mut rows = Vec::new();
    for subject in &settings.subjects {
        let mut by_step = Vec::new();
        for dt_s in STEPS_S {
            let config = bench.config(subject, dt_s);
            by_step.push(ours(bench, &config, &gaits, periods)?);
        }
        let name = &subject.name;
        let travel = |step: usize| by_step[step].1.iter().map(|path| outcome(path).0);
        for step in 0..STEPS_S.len() - 1 {
            let finest = travel(STEPS_S.len() - 1);
            let change = mean(travel(step).zip(finest).map(|(a, b)| 100.0 * (a - b).abs() / b));
            let ms = 1e3 * STEPS_S[step];
            let what = format!("travel at {ms} ms against 0.5 ms, mean change");
            rows.push(Row::reported("travel", name, what, (change, "%"), ""));
        }
        let mujoco = match bench.mujoco.get() {
            Ok(mujoco) => mujoco,
            Err(why) => {
                rows.push(Row::skipped("travel", name, "against MuJoCo", "%", why));
                continue;
            }
        };
        if reference.is_none() {
            let runs = Runs {
                model: &model,
                robot: &bench.robot,
                gaits: &gaits,
                periods,
                start: &by_step[JUDGED].0,
            };
            reference = Some(runs.converged(mujoco, &mut rows)?);
        }
        let theirs = reference.as_deref().unwrap_or_default();
        rows.extend(against(name, &by_step[JUDGED].1, theirs));
        if subject.config.kind == EngineKind::Batch {
            // like for like: with MuJoCo's law of friction
            let config =
                EngineConfig { convex_friction: true, ..bench.config(subject, STEPS_S[JUDGED]) };
            let (_, convex) = ours(bench, &config, &gaits, periods)?;
            rows.extend(against(&format!("{name}, convex friction"), &convex, theirs));
        }
    }
    Ok(rows)
}

/// The gaits as MuJoCo walks them.
struct Runs<'a> {
    model: &'a RobotModel,
    robot: &'a RobotRequest,
    gaits: &'a [Gait],
    periods: usize,
    start: &'a Start,
}

impl Runs<'_> {
    /// With its converged setting; `rows` gain how much its answers scatter.
    fn converged(&self, mujoco: &mut Mujoco, rows: &mut Vec<Row>) -> Result<Outcomes, VerifyError> {
        let from = &self.start.joint_pos;
        let converged = self.outcomes(mujoco, request::converged(), from)?;
        let mut coarse = request::converged();
        coarse["dt_s"] = json!(0.001);
        let other = self.outcomes(mujoco, coarse, from)?;
        let step = "its own {} at 1 ms against 0.5 ms, mean change";
        rows.extend(own_change(step, &converged, &other));
        let mut nudged = from.clone();
        nudged[self.model.actuated()[0]] += NUDGE_RAD;
        let other = self.outcomes(mujoco, request::converged(), &nudged)?;
        let nudge = "its own {} from a start 0.1 mrad beside, mean change";
        rows.extend(own_change(nudge, &converged, &other));
        Ok(converged)
    }

    fn outcomes(
        &self,
        mujoco: &mut Mujoco,
        options: Value,
        from: &[f32],
    ) -> Result<Outcomes, VerifyError> {
        let run = |gait: &Gait| {
            let rows = gait.rows(self.model, self.periods);
            json!({ "joint_pos": from, "base": self.start.base, "targets": rows })
        };
        let runs: Vec<Value> = self.gaits.iter().map(run).collect();
        let more = json!({ "runs": runs, "control_period_s": 0.02 });
        let ask = self.robot.task("gaits", self.model, options, more);
        Ok(paths(&mujoco.ask(&ask)?)?.iter().map(outcome).collect())
    }
}

/// How much MuJoCo's own answers change with its settings: below that nothing can be told apart.
fn own_change(what: &str, fine: &[(f64, f64)], other: &[(f64, f64)]) -> [Row; 2] {
    let pairs = || fine.iter().zip(other);
    let travel = mean(pairs().map(|(a, b)| 100.0 * (a.0 - b.0).abs() / a.0));
    let heading = mean(pairs().map(|(a, b)| (a.1 - b.1).abs().to_degrees()));
    let row =
        |name: &str, value| Row::reported("travel", "mujoco", what.replace("{}", name), value, "");
    [row("travel", (travel, "%")), row("heading", (heading, "deg"))]
}

/// Mean and worst differences of travel and heading.
fn against(name: &str, ours: &[Path], theirs: &[(f64, f64)]) -> Vec<Row> {
    let ours: Vec<(f64, f64)> = ours.iter().map(outcome).collect();
    let pairs = || ours.iter().zip(theirs);
    let travel = || pairs().map(|(a, b)| 100.0 * (a.0 - b.0).abs() / b.0);
    let heading = || pairs().map(|(a, b)| (a.1 - b.1).abs().to_degrees());
    let note = pairs()
        .map(|(a, b)| {
            format!("{:.2}/{:.2} m {:.0}/{:.0}°", a.0, b.0, a.1.to_degrees(), b.1.to_degrees())
        })
        .collect::<Vec<_>>()
        .join(", ");
    let worst = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, largest);
    vec![
        Row::judged(
            "travel",
            name,
            "travel against MuJoCo, mean",
            (mean(travel()), "%"),
            5.0,
            format!("ours/MuJoCo: {note}"),
        ),
        Row::judged(
            "travel",
            name,
            "travel against MuJoCo, worst",
            (worst(&mut travel()), "%"),
            5.0,
            "",
        ),
        Row::judged(
            "travel",
            name,
            "heading against MuJoCo, mean",
            (mean(heading()), "deg"),
            3.0,
            "",
        ),
        Row::judged(
            "travel",
            name,
            "heading against MuJoCo, worst",
            (worst(&mut heading()), "deg"),
            3.0,
            "",
        ),
    ]
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    sum / n
}

/// All gaits as lanes of one engine: where each stood, and its path.
fn ours(
    bench: &Bench<'_>,
    config: &EngineConfig,
    gaits: &[Gait],
    periods: usize,
) -> Result<(Start, Vec<Path>), VerifyError> {
    let model = &bench.model;
    let flat = TerrainConfig::default();
    let threads = bench.settings.threads;
    let lanes = gaits.len();
    let mut engine = build(Arc::clone(model), lanes, config, &flat, 1, threads)?;
    for lane in 0..lanes {
        engine.reset(lane, &InitialState::nominal(model))?;
    }
    let start = start_of(engine.as_ref(), 0);
    let width = model.actuated().len();
    let mut targets = vec![0.0; lanes * width];
    let wrenches = vec![0.0; lanes * 6];
    let mut paths: Vec<Path> = vec![Vec::with_capacity(periods + 1); lanes];
    let report = |engine: &dyn Engine, paths: &mut [Path]| {
        let s = engine.state();
        for (lane, path) in paths.iter_mut().enumerate() {
            let com = &s.com_pos_m[3 * lane..3 * lane + 3];
            let base = &s.base_pos_m[3 * lane..3 * lane + 3];
            let row = [com[0], com[1], com[2], s.heading_rad[lane], base[0], base[1], base[2]];
            path.push(row.map(f64::from));
        }
    };
    report(engine.as_ref(), &mut paths);
    for k in 0..periods {
        for (gait, row) in gaits.iter().zip(targets.chunks_exact_mut(width)) {
            gait.targets(model, k as f64 * 0.02, row);
        }
        engine.step(&targets, &wrenches)?;
        report(engine.as_ref(), &mut paths);
    }
    Ok((start, paths))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outcomes_are_distance_and_unwrapped_turn() {
        let at = |x: f64, y: f64, heading: f64| [x, y, 0.0, heading, 0.0, 0.0, 0.0];
        let path = vec![at(1.0, 1.0, 3.0), at(2.0, 3.0, -3.0), at(4.0, 5.0, -2.0)];
        let (travel, turned) = outcome(&path);
        assert!((travel - 5.0).abs() < 1e-12);
        // from 3.0 over π to −3.0 is 0.283 forwards, then 1
        assert!((turned - (std::f64::consts::TAU - 6.0 + 1.0)).abs() < 1e-12);
    }

    #[test]
    fn a_path_that_is_lost_misses_its_target() {
        let rows = against("e", &[vec![[f64::NAN; 7]; 2]], &[(1.0, 0.0)]);
        assert!(rows.iter().all(|r| r.pass == Some(false)));
    }
}
