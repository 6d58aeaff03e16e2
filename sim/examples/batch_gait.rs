//! Travel and power of an open-loop trot on the batch engine against step size and contact constants.
//! `batch_gait key=value ...` sets engine fields.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]
use caudata_model::RobotModel;
use caudata_sim::{EngineConfig, EngineKind, TerrainConfig, build};
use std::f64::consts::TAU;
use std::path::Path;
use std::sync::Arc;

fn main() {
    let robot = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/polymander.robot.toml");
    let model = Arc::new(RobotModel::load(&robot).expect("robot model"));
    let mut base = EngineConfig::default();
    let (mut mu, mut jf, mut kd) = (0.8_f32, 1.0_f32, 0.15_f32);
    for arg in std::env::args().skip(1) {
        let (key, value) = arg.split_once('=').unwrap();
        let v: f64 = value.parse().unwrap_or(0.0);
        match key {
            "k" => base.contact_stiffness_n_per_m = v,
            "d" => base.contact_damping_ns_per_m = v,
            "depth" => base.contact_damping_depth_m = v,
            "kt" => base.bristle_stiffness_n_per_m = v,
            "dt" => base.bristle_damping_ns_per_m = v,
            "lock" => base.lock_backlash = v > 0.0,
            "stop" => base.stop_stiffness_nm_per_rad = v,
            "stopd" => base.stop_damping_nms_per_rad = v,
            "mu" => mu = v as f32,
            "jf" => jf = v as f32,
            "kd" => kd = v as f32,
            "engine" => {
                base.kind = if value == "rapier" {
                    EngineKind::Rapier
                } else {
                    EngineKind::Batch
                }
            }
            _ => panic!("{key}"),
        }
    }
    let file = std::fs::read_to_string("/tmp/tgt/gaits.json").unwrap();
    let gaits: Vec<serde_json::Value> = serde_json::from_str(&file).unwrap();
    for (dt_ms, substeps) in [(2.0, 10), (0.5, 40)] {
        let config = EngineConfig {
            dt_s: dt_ms * 1e-3,
            substeps,
            ..base.clone()
        };
        let mut text = String::new();
        for (gi, g) in gaits.iter().enumerate() {
            let (m, g) = (&g["mujoco"], &g["gait"]);
            let mut e = build(model.clone(), 1, &config, &TerrainConfig::default(), 1, 1).unwrap();
            let mut p = caudata_sim::LaneParams::nominal(&model);
            p.foot_friction = mu;
            for f in &mut p.joint_friction_nm {
                *f *= jf;
            }
            for f in &mut p.kd_nms_per_rad {
                *f = kd;
            }
            e.set_params(0, &p).unwrap();
            let (x0, y0) = (e.state().com_pos_m[0], e.state().com_pos_m[1]);
            let (mut power, mut head, n) = (0.0, 0.0_f64, 1000);
            for k in 0..n {
                let f = |k: &str| g[k].as_f64().unwrap();
                let phase = TAU * f("f") * f64::from(k) * 0.02;
                let t: Vec<f32> = model
                    .actuated_names()
                    .iter()
                    .zip(model.nominal_pos_rad())
                    .map(|(name, q)| {
                        let leg = phase + g["leg"][&name[..2]].as_f64().unwrap_or(0.0);
                        let i = f64::from(name.as_bytes()[name.len() - 1]) - 48.0;
                        (q + match *name {
                            n if n.ends_with("hip") => f("hip") * leg.cos(),
                            n if n.ends_with("knee") => -f("knee") * (-leg.sin()).max(0.0),
                            n if n.starts_with("spine") => {
                                f("spine") * (phase + f("wave") * (i - 1.0) + f("bias")).cos()
                                    + f("turn")
                            }
                            _ => f("tail") * (phase + f("wave") * (i + 4.0)).cos(),
                        }) as f32
                    })
                    .collect();
                e.step(&t, &[0.0; 6]).unwrap();
                let h = f64::from(e.state().heading_rad[0]);
                head += (h - head + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0;
                power += e
                    .state()
                    .mech_power_w
                    .iter()
                    .map(|p| f64::from(p.abs()))
                    .sum::<f64>()
                    / f64::from(n);
            }
            let s = e.state();
            let v = |k: &str| m[k].as_f64().unwrap();
            text += &format!(
                "  gait {gi}: x {:.3} ({:.3}) y {:.3} ({:.3}) heading {:.1} ({:.1}) power {:.2} ({:.2}) dist {:+.1}%\n",
                s.com_pos_m[0] - x0,
                v("x"),
                s.com_pos_m[1] - y0,
                v("y"),
                head.to_degrees(),
                v("heading_deg"),
                power,
                v("power"),
                100.0
                    * ((f64::from(s.com_pos_m[0] - x0)).hypot(f64::from(s.com_pos_m[1] - y0))
                        / v("x").hypot(v("y"))
                        - 1.0)
            );
        }
        println!("dt {dt_ms}\n{text}");
    }
}
