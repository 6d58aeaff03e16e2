//! Contact with the ground: how high the robot stands, at which angle it slides.

use std::sync::Arc;

use caudata_sim::{Engine, InitialState, LaneParams, TerrainConfig, build};
use serde_json::json;

use super::error::VerifyError;
use super::row::{Bench, Row};
use super::{request, travel};

/// Standing: the nominal pose, held for this long.
const STAND_S: f64 = 3.0;

/// Height of the centre of mass and of the head, after standing, against MuJoCo.
pub(crate) fn standing(bench: &mut Bench<'_>) -> Result<Vec<Row>, VerifyError> {
    const WHAT: &str = "standing height of the centre of mass";
    let model = Arc::clone(&bench.model);
    let nominal: Vec<f32> = model.nominal_pos_rad().iter().map(|&q| q as f32).collect();
    let periods = (STAND_S / 0.02) as usize;
    let mut theirs = None;
    let mut rows = Vec::new();
    for subject in bench.settings.subjects.clone() {
        let config = bench.config(&subject, 0.002);
        let flat = TerrainConfig::default();
        let mut engine = build(Arc::clone(&model), 1, &config, &flat, 1, 1)?;
        engine.reset(0, &InitialState::nominal(&model))?;
        let start = travel::start_of(engine.as_ref(), 0);
        for _ in 0..periods {
            engine.step(&nominal, &[0.0; 6])?;
        }
        let ours = [engine.state().com_pos_m[2], engine.state().base_pos_m[2]].map(f64::from);
        let mujoco = match bench.mujoco.get() {
            Ok(mujoco) => mujoco,
            Err(why) => {
                rows.push(Row::skipped("standing", &subject.name, WHAT, "mm", why));
                continue;
            }
        };
        if theirs.is_none() {
            let run = json!({ "joint_pos": start.joint_pos, "base": start.base, "targets": vec![&nominal; periods] });
            let more = json!({ "runs": [run], "control_period_s": 0.02 });
            let ask = bench.robot.task("gaits", &model, request::converged(), more);
            let paths = travel::paths(&mujoco.ask(&ask)?)?;
            let last = paths[0].last().copied().unwrap_or([f64::NAN; 7]);
            theirs = Some([last[2], last[6]]);
        }
        let theirs = theirs.unwrap_or([f64::NAN; 2]);
        let off = |i: usize| (1e3 * (ours[i] - theirs[i]).abs(), "mm");
        let note = |i: usize| format!("{:.2} mm, MuJoCo {:.2} mm", 1e3 * ours[i], 1e3 * theirs[i]);
        let name = &subject.name;
        rows.push(Row::judged("standing", name, WHAT, off(0), 1.0, note(0)));
        // It hangs on the play hinges, which friction may hold anywhere within their play.
        let head = "standing height of the head";
        rows.push(Row::reported("standing", name, head, off(1), note(1)));
    }
    Ok(rows)
}

/// The angle from which the robot slides down, every contact with friction 0.5, against atan 0.5. The floor
/// stays level and gravity leans; one lane per angle, a quarter of a degree apart.
pub(crate) fn incline(bench: &mut Bench<'_>) -> Result<Vec<Row>, VerifyError> {
    const FRICTION: f32 = 0.5;
    const EACH_DEG: f64 = 0.25;
    const LANES: usize = 17;
    let model = Arc::clone(&bench.model);
    let limit_deg = f64::from(FRICTION).atan().to_degrees();
    let angle_deg = |lane: usize| limit_deg + EACH_DEG * (lane as f64 - (LANES / 2) as f64);
    let nominal: Vec<f32> = model.nominal_pos_rad().iter().map(|&q| q as f32).collect();
    let targets = nominal.repeat(LANES);
    let mut rows = Vec::new();
    for subject in bench.settings.subjects.clone() {
        for (what, downhill) in [("forwards", [1.0_f32, 0.0]), ("sideways", [0.0, 1.0])] {
            let config = bench.config(&subject, 0.002);
            let flat = TerrainConfig::default();
            let threads = bench.settings.threads;
            let mut engine = build(Arc::clone(&model), LANES, &config, &flat, 1, threads)?;
            for lane in 0..LANES {
                let angle = angle_deg(lane).to_radians() as f32;
                let params = LaneParams {
                    foot_friction: FRICTION,
                    body_friction: FRICTION,
                    gravity_mps2: [
                        9.81 * angle.sin() * downhill[0],
                        9.81 * angle.sin() * downhill[1],
                        -9.81 * angle.cos(),
                    ],
                    ..LaneParams::nominal(&model)
                };
                engine.set_params(lane, &params)?;
                engine.reset(lane, &InitialState::nominal(&model))?;
            }
            let slides = sliding(engine.as_mut(), &targets, downhill)?;
            let first = slides.iter().position(|s| *s).unwrap_or(LANES);
            let orderly =
                slides[first.min(LANES - 1)..].iter().all(|s| *s) && first > 0 && first < LANES;
            let found = angle_deg(first) - EACH_DEG / 2.0;
            let error = if orderly { (found - limit_deg).abs() } else { f64::NAN };
            let note = if orderly {
                format!("slides from {found:.2}°, atan 0.5 = {limit_deg:.2}°")
            } else {
                format!(
                    "no single angle between {:.2}° and {:.2}°",
                    angle_deg(0),
                    angle_deg(LANES - 1)
                )
            };
            let what = format!("angle of sliding {what}");
            rows.push(Row::judged("incline", &subject.name, what, (error, "deg"), 1.0, note));
        }
    }
    Ok(rows)
}

/// Whether each lane's centre of mass moves downhill after 2.5 s: a robot a quarter of a degree too steep is
/// then at 0.1 m/s.
fn sliding(
    engine: &mut dyn Engine,
    targets: &[f32],
    downhill: [f32; 2],
) -> Result<Vec<bool>, VerifyError> {
    const SETTLE_S: f64 = 2.0;
    const WATCH_S: f64 = 0.5;
    const MOVES_MPS: f32 = 0.03;
    let wrenches = vec![0.0; 6 * engine.lanes()];
    let place = |engine: &dyn Engine| -> Vec<f32> {
        let com = engine.state().com_pos_m.chunks_exact(3);
        com.map(|p| p[0] * downhill[0] + p[1] * downhill[1]).collect()
    };
    let run = |engine: &mut dyn Engine, seconds: f64| -> Result<(), VerifyError> {
        for _ in 0..(seconds / engine.config().control_period_s()).round() as usize {
            engine.step(targets, &wrenches)?;
        }
        Ok(())
    };
    run(engine, SETTLE_S)?;
    let before = place(engine);
    run(engine, WATCH_S)?;
    let after = place(engine);
    let moved = before.iter().zip(&after);
    Ok(moved.map(|(a, b)| b - a > MOVES_MPS * WATCH_S as f32).collect())
}
