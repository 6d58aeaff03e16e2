//! Robots thrashing at random on every terrain: how many lanes break down, and that nothing that is reported is ever not finite.
//!
//! `cargo run --release -p caudata-sim --example batch_stress -- [lanes] [seconds] [threads] [terrain …]`, terrains by name (`DeepWater`); none: all.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;
use std::sync::Arc;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{EngineConfig, InitialState, TerrainConfig, TerrainKind, build};

fn main() {
    let mut args = std::env::args().skip(1);
    let lanes: usize = args.next().map_or(1024, |s| s.parse().expect("lanes"));
    let seconds: f64 = args.next().map_or(60.0, |s| s.parse().expect("seconds"));
    let threads: usize = args.next().map_or(1, |s| s.parse().expect("threads"));
    let only: Vec<String> = args.collect();
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&robot).expect("robot model"));
    for kind in TerrainKind::ALL {
        if !only.is_empty() && !only.contains(&format!("{kind:?}")) {
            continue;
        }
        let config = EngineConfig {
            self_collision: true,
            ..EngineConfig::default()
        };
        let terrain = TerrainConfig::of(kind);
        let mut engine =
            build(model.clone(), lanes, &config, &terrain, 1, threads).expect("engine");
        let mut stream = Stream::new(Key::for_run(3), Purpose::Action);
        let limits = model.joint_limits_rad();
        let mut targets = vec![0.0_f32; lanes * limits.len()];
        let wrenches = vec![0.0_f32; lanes * 6];
        let (mut broken, mut odd) = (0, 0);
        let periods = (seconds / config.control_period_s()) as usize;
        for period in 0..periods {
            if period % 5 == 0 {
                // anything within the joints' limits, ten times a second
                for (i, t) in targets.iter_mut().enumerate() {
                    let (low, high) = limits[i % limits.len()];
                    *t = stream.uniform(low as f32, high as f32);
                }
            }
            engine.step(&targets, &wrenches).expect("step");
            let fields = engine.state().fields();
            odd += fields
                .iter()
                .map(|f| f.iter().filter(|v| !v.is_finite()).count())
                .sum::<usize>();
            for lane in 0..lanes {
                if engine.state().diverged[lane] {
                    broken += 1;
                    engine
                        .reset(lane, &InitialState::nominal(&model))
                        .expect("reset");
                }
            }
        }
        println!(
            "{kind:?}: {lanes} lanes × {seconds} s: {broken} broke down, {odd} numbers not finite"
        );
    }
}
