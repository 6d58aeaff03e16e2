//! Physics steps per second of CPU time, one lane on one thread, for a walking-like open-loop gait on flat ground.
//!
//! `cargo run --release -p caudata-sim --example engine_bench -- [robot.toml] [seconds]` prints one line per solver setting:
//! speed, and how far the gait travelled (the accuracy side of the bargain).
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]

use std::f64::consts::TAU;
use std::path::PathBuf;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_sim::{Engine, EngineConfig, InitialState, TerrainConfig, TerrainKind, build};

/// Trot of 1.3 Hz: diagonal legs together, hips swing ±20°, knees lift in swing; the spine bends with it.
fn gait(model: &RobotModel, t_s: f64, out: &mut [f32]) {
    let phase = TAU * 1.3 * t_s;
    for (a, name) in model.actuated_names().iter().enumerate() {
        let leg_phase = if name.starts_with("FL") || name.starts_with("HR") {
            phase
        } else {
            phase + TAU / 2.0
        };
        let offset = if name.ends_with("hip") {
            0.35 * leg_phase.cos()
        } else if name.ends_with("knee") {
            -0.5 * (-leg_phase.sin()).max(0.0)
        } else if name.starts_with("spine") {
            0.1 * phase.cos()
        } else {
            0.0
        };
        out[a] = (model.nominal_pos_rad()[a] + offset) as f32;
    }
}

/// CPU time of this process, s.
fn cpu_s() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/schedstat").expect("Linux");
    stat.split_whitespace()
        .next()
        .unwrap()
        .parse::<f64>()
        .unwrap()
        * 1e-9
}

fn main() {
    let mut args = std::env::args().skip(1);
    let robot = args.next().map_or_else(
        || {
            PathBuf::from(concat!(
                env!("CARGO_MANIFEST_DIR"),
                "/../robots/polymander.robot.toml"
            ))
        },
        PathBuf::from,
    );
    let seconds: f64 = args.next().map_or(10.0, |s| s.parse().expect("seconds"));
    let model = Arc::new(RobotModel::load(&robot).expect("robot model"));
    let flat = TerrainConfig::default();
    let rough = TerrainConfig {
        kind: TerrainKind::Rugged,
        height_m: 0.02,
        ..flat.clone()
    };
    println!(
        "{:<8} {:>6} {:>5} {:>12} {:>10} {:>10} {:>9} {:>9}",
        "terrain", "dt ms", "iter", "steps/s", "x real", "travel m", "power W", "diverged"
    );
    for (name, terrain) in [("flat", &flat), ("rough", &rough)] {
        for (dt_ms, substeps, iterations) in [
            (10.0, 2, 1),
            (20.0 / 3.0, 3, 1),
            (5.0, 4, 1),
            (4.0, 5, 1),
            (4.0, 5, 2),
            (4.0, 5, 4),
            (2.0, 10, 1),
            (1.0, 20, 1),
            (0.5, 40, 1),
        ] {
            let config = EngineConfig {
                dt_s: dt_ms * 1e-3,
                substeps,
                solver_iterations: iterations,
                ..EngineConfig::rapier()
            };
            let mut engine = build(model.clone(), 1, &config, terrain, 1, 1).expect("engine");
            engine.reset(0, &InitialState::nominal(&model)).unwrap();
            report(name, engine.as_mut(), seconds);
        }
    }
}

fn report(name: &str, engine: &mut dyn Engine, seconds: f64) {
    let config = engine.config().clone();
    let mut targets = vec![0.0; engine.model().actuated().len()];
    let wrench = [0.0; 6];
    let periods = (seconds / config.control_period_s()) as usize;
    let start_x = engine.state().com_pos_m[0];
    let (begin, mut power) = (cpu_s(), 0.0);
    for k in 0..periods {
        gait(
            engine.model(),
            k as f64 * config.control_period_s(),
            &mut targets,
        );
        engine.step(&targets, &wrench).unwrap();
        power += engine
            .state()
            .mech_power_w
            .iter()
            .map(|p| p.abs())
            .sum::<f32>();
    }
    let spent = cpu_s() - begin;
    let steps = periods as f64 * f64::from(config.substeps);
    println!(
        "{:<8} {:>6.1} {:>5} {:>12.0} {:>10.1} {:>10.3} {:>9.2} {:>9}",
        name,
        config.dt_s * 1e3,
        config.solver_iterations,
        steps / spent,
        steps * config.dt_s / spent,
        engine.state().com_pos_m[0] - start_x,
        power / periods as f32,
        engine.state().diverged[0],
    );
}
