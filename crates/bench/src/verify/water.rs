//! A raft in deep water, against closed forms.
//!
//! A box of 0.4 × 0.2 × 0.1 m with the inertia of a solid one, 5.6 kg, displacing 8 kg, heave damping 12
//! N·s/m (each number in the model below).
//! - float line: 0.7 of it is under water, so its middle is 2 cm below the surface;
//! - bobbing by 5 mm: ω² = ρ·A·g/m − δ², δ = 0.7·k_d/(2m) (the damping acts in proportion to the immersed
//!   share);
//! - sinking with buoyancy 2.8 kg and quadratic drag ½·ρ·b_x·b_y = 40 N·s²/m² only: v² = 2.8·g/40.

use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, InitialState, LaneParams, TerrainConfig, TerrainKind, build};

use super::error::VerifyError;
use super::row::{Bench, Row};

const G: f64 = 9.81;
const MASS_KG: f64 = 5.6;
const SURFACE_M: f64 = 2.0;
const FLOAT_M: f64 = SURFACE_M - 0.02;
const HEAVE_NS_PER_M: f64 = 12.0;
const DT_S: f64 = 0.002;

pub(crate) fn check(bench: &mut Bench<'_>) -> Result<Vec<Row>, VerifyError> {
    let model = Arc::new(raft()?);
    let mut rows = Vec::new();
    for subject in &bench.settings.subjects {
        let name = &subject.name;
        // one step per control period: peaks are seen to 2 ms
        let config = EngineConfig { dt_s: DT_S, substeps: 1, ..subject.config.clone() };
        let bobbing =
            run(&model, &config, &quiet(&model, 1.0, HEAVE_NS_PER_M), FLOAT_M + 0.005, 20.0)?;
        let sinking = run(&model, &config, &sinker(&model), 1.9, 1.2)?;
        let last = bobbing.last().map_or(f64::NAN, |p| p[0]);
        let draft = 100.0 * (last - FLOAT_M).abs() / 0.07;
        let (rate, decay) = bob(&bobbing);
        let share = |got: f64, want: f64| 100.0 * (got - want).abs() / want;
        let delta = 0.7 * HEAVE_NS_PER_M / (2.0 * MASS_KG);
        let omega = (1000.0 * 0.08 * G / MASS_KG - delta * delta).sqrt();
        let want_hz = omega / std::f64::consts::TAU;
        let speed = sinking.last().map_or(f64::NAN, |p| -p[1]);
        let want_mps = (2.8 * G / 40.0).sqrt();
        #[rustfmt::skip]
        rows.extend([
            Row::judged("water", name, "float line", (draft, "%"), 1.0, format!("middle at {:.2} mm, closed form {:.2} mm", 1e3 * (last - SURFACE_M), -20.0)),
            Row::judged("water", name, "bobbing frequency", (share(rate, want_hz), "%"), 1.0, format!("{rate:.4} Hz, closed form {want_hz:.4}")),
            Row::judged("water", name, "bobbing decay", (share(decay, delta), "%"), 1.0, format!("{decay:.4} /s, closed form {delta:.4}")),
            Row::judged("water", name, "terminal velocity", (share(speed, want_mps), "%"), 1.0, format!("{speed:.4} m/s, closed form {want_mps:.4}")),
        ]);
    }
    Ok(rows)
}

/// Height of the middle and its velocity after each step.
fn run(
    model: &Arc<RobotModel>,
    config: &EngineConfig,
    params: &LaneParams,
    from_m: f64,
    seconds: f64,
) -> Result<Vec<[f64; 2]>, VerifyError> {
    let pool = TerrainConfig::of(TerrainKind::DeepWater);
    let mut engine = build(Arc::clone(model), 1, config, &pool, 1, 1)?;
    engine.set_params(0, params)?;
    let start = InitialState { base_z_m: Some(from_m as f32), ..InitialState::nominal(model) };
    engine.reset(0, &start)?;
    let mut path = Vec::new();
    for _ in 0..(seconds / config.control_period_s()).round() as usize {
        engine.step(&[0.0], &[0.0; 6])?;
        let s = engine.state();
        path.push([s.base_pos_m[2], s.base_vel_mps[2]].map(f64::from));
    }
    Ok(path)
}

/// Frequency, Hz, and decay, 1/s, from the first to the ninth upper turning point.
fn bob(path: &[[f64; 2]]) -> (f64, f64) {
    let mut peaks = Vec::new();
    for (k, pair) in path.windows(2).enumerate() {
        let (v0, v1) = (pair[0][1], pair[1][1]);
        if v0 > 0.0 && v1 <= 0.0 {
            // the turning point lies between the samples, where the velocity is zero
            let share = v0 / (v0 - v1);
            let height = pair[0][0] + 0.5 * share * DT_S * v0;
            peaks.push(((k as f64 + share) * DT_S, height - FLOAT_M));
        }
    }
    let (Some(first), Some(last)) = (peaks.first(), peaks.get(8)) else {
        return (f64::NAN, f64::NAN);
    };
    let span = last.0 - first.0;
    (8.0 / span, (first.1 / last.1).ln() / span)
}

/// Without drag: buoyancy (as a factor) and heave damping only.
fn quiet(model: &RobotModel, buoyancy: f32, heave_ns_per_m: f64) -> LaneParams {
    let mut params = LaneParams::nominal(model);
    for link in &mut params.water {
        link.buoyancy_scale = buoyancy;
        link.heave_damping_ns_per_m = 0.0;
        link.linear_drag_scale = 0.0;
        link.quadratic_torque_scale = 0.0;
        link.quadratic_drag_scale_x = 0.0;
        link.quadratic_drag_scale_y = 0.0;
        link.quadratic_drag_scale_z = 0.0;
    }
    params.water[0].heave_damping_ns_per_m = heave_ns_per_m as f32;
    params.gravity_mps2 = [0.0, 0.0, -G as f32];
    params
}

fn sinker(model: &RobotModel) -> LaneParams {
    let mut params = quiet(model, 0.35, 0.0);
    params.water[0].quadratic_drag_scale_z = 1.0;
    params
}

/// The raft. (An engine wants a joint: a disc of 0.1 g turns in it.)
fn raft() -> Result<RobotModel, VerifyError> {
    const ROBOT: &str = include_str!("raft.robot.toml");
    const MJCF: &str = include_str!("raft.xml");
    Ok(RobotModel::from_bytes("raft.robot.toml", ROBOT.as_bytes(), MJCF.as_bytes())?)
}
