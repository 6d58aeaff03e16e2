//! Physics steps per second of the batch engine, per lane width and scene, for a walking-like open-loop gait.
//!
//! `cargo run --release -p caudata-sim --example batch_bench -- [lanes] [seconds per case] [threads]`
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]

use std::f32::consts::TAU;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, Precision, TerrainConfig, TerrainKind, build};

/// CPU time of this thread, s (a shared machine's clock says little); with several threads the clock's time.
fn seconds_now(threads: usize, since: Instant) -> f64 {
    if threads > 1 {
        return since.elapsed().as_secs_f64();
    }
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").expect("Linux");
    stat.split_whitespace()
        .next()
        .unwrap()
        .parse::<f64>()
        .unwrap()
        * 1e-9
}

fn main() {
    let begin = Instant::now();
    let mut args = std::env::args().skip(1);
    let lanes: usize = args.next().map_or(256, |s| s.parse().expect("lanes"));
    let seconds: f64 = args.next().map_or(1.0, |s| s.parse().expect("seconds"));
    let threads: usize = args.next().map_or(1, |s| s.parse().expect("threads"));
    let widths: Vec<u32> = args
        .next()
        .map_or(vec![16, 8, 4, 1], |s| vec![s.parse().expect("lane width")]);
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&robot).expect("robot model"));
    let rough = TerrainConfig {
        kind: TerrainKind::Rugged,
        height_m: 0.02,
        ..TerrainConfig::default()
    };
    let water = TerrainConfig::of(TerrainKind::DeepWater);
    for (name, terrain) in [
        ("flat", TerrainConfig::default()),
        ("rough", rough),
        ("water", water),
    ] {
        for (width, precision) in widths
            .iter()
            .map(|&w| (w, Precision::Single))
            .chain((widths.len() > 1).then_some((1, Precision::Double)))
        {
            let config = EngineConfig {
                lane_width: width,
                precision,
                ..EngineConfig::default()
            };
            let mut engine = match build(model.clone(), lanes, &config, &terrain, 1, threads) {
                Ok(engine) => engine,
                Err(e) => {
                    println!("{name} width {width}: {e}");
                    continue;
                }
            };
            let names = model.actuated_names();
            let mut targets = vec![0.0_f32; lanes * names.len()];
            let wrenches = vec![0.0_f32; lanes * 6];
            let (mut periods, mut spent) = (0_u32, 0.0);
            while spent < seconds {
                for lane in 0..lanes {
                    let phase = TAU * 1.3 * 0.02 * periods as f32 + lane as f32;
                    for (a, n) in names.iter().enumerate() {
                        let leg = if n.starts_with("FL") || n.starts_with("HR") {
                            phase
                        } else {
                            phase + TAU / 2.0
                        };
                        let offset = match *n {
                            n if n.ends_with("hip") => 0.35 * leg.cos(),
                            n if n.ends_with("knee") => -0.5 * (-leg.sin()).max(0.0),
                            n if n.starts_with("spine") => 0.1 * phase.cos(),
                            _ => 0.0,
                        };
                        targets[lane * names.len() + a] =
                            model.nominal_pos_rad()[a] as f32 + offset;
                    }
                }
                let start = seconds_now(threads, begin);
                engine.step(&targets, &wrenches).unwrap();
                spent += seconds_now(threads, begin) - start;
                periods += 1;
            }
            let rate = f64::from(periods) * lanes as f64 / spent;
            let x: f32 = engine.state().com_pos_m.iter().step_by(3).sum::<f32>() / lanes as f32;
            println!(
                "{name:<6} width {width:>2} {precision:?} lanes {lanes} threads {threads}: {:>9.0} physics steps/s, {:>8.0} control steps/s, travel {x:.3} m in {:.1} s, diverged {}",
                rate * f64::from(config.substeps),
                rate,
                f64::from(periods) * 0.02,
                engine.state().diverged.iter().filter(|d| **d).count()
            );
        }
    }
}
