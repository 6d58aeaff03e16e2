//! Writes logs of the salamander on a stand, one fault each: `stand OUT [REPEATS [SEED [NAME…]]]`. Commands of the battery, the Rapier engine at 1 ms.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use std::path::Path;
use std::sync::Arc;

use caudata_hidden_effects::stand;
use caudata_model::RobotModel;
use caudata_sim::LaneParams;

const FIT: [&str; 4] = ["chirp_medium", "steps_medium", "triangle_medium", "holds"];
const HOLDOUT: [&str; 2] = ["prbs_slow", "triangle_fast"];

fn main() {
    let out = std::path::PathBuf::from(std::env::args().nth(1).unwrap());
    let repeats: u64 = std::env::args().nth(2).map_or(1, |s| s.parse().unwrap());
    let seed: u64 = std::env::args().nth(3).map_or(40, |s| s.parse().unwrap());
    let wanted: Vec<String> = std::env::args().skip(4).collect();
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    let model = Arc::new(RobotModel::load(&robots.join("polymander.robot.toml")).unwrap());
    let knee = joint(&model, "FL_knee");
    let tail = joint(&model, "spine_2");
    type Fault<'a> = (&'a str, Box<dyn Fn(&mut LaneParams)>);
    let faults: Vec<Fault<'_>> = vec![
        ("healthy", Box::new(|_| ())),
        ("soft_knee", Box::new(move |p| p.kp_nm_per_rad[knee] *= 0.7)),
        (
            "slightly_soft_knee",
            Box::new(move |p| p.kp_nm_per_rad[knee] *= 0.9),
        ),
        (
            "slightly_soft_spine",
            Box::new(move |p| p.kp_nm_per_rad[tail] *= 0.9),
        ),
        (
            "weak_servo",
            Box::new(move |p| p.joints[knee].current_limit_a = 0.5),
        ),
        (
            "rubbing_spine",
            Box::new(move |p| p.joint_friction_nm[tail] += 0.08),
        ),
        (
            "loose_gear",
            Box::new(move |p| p.joints[knee].gear_half_gap_rad = 0.012),
        ),
    ];
    for (n, (name, fault)) in faults.iter().enumerate() {
        if !wanted.is_empty() && !wanted.iter().any(|w| w == name) {
            continue;
        }
        let mut lane = LaneParams::nominal(&model);
        fault(&mut lane);
        for (i, trial) in FIT.iter().chain(&HOLDOUT).enumerate() {
            let role = if i < FIT.len() { "fit" } else { "holdout" };
            for r in 0..repeats {
                let dir = out.join(name).join(role).join(format!("{trial}_{}", r + 1));
                let run = 10 * i as u64 + r;
                stand::record(&model, &lane, trial, seed + n as u64, run, &dir).unwrap();
            }
        }
        println!("{name}");
    }
}

fn joint(model: &RobotModel, name: &str) -> usize {
    let names = model.actuated_names();
    names.iter().position(|n| *n == name).unwrap()
}
