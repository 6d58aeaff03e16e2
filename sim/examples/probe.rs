//! scratch
use caudata_model::RobotModel;
use caudata_sim::*;
use std::sync::Arc;
fn main() {
    let model =
        Arc::new(RobotModel::load(std::path::Path::new("robots/polymander.robot.toml")).unwrap());
    let mut e = build(
        model.clone(),
        1,
        &EngineConfig::default(),
        &TerrainConfig::default(),
        1,
        1,
    )
    .unwrap();
    let q: Vec<f32> = model.nominal_pos_rad().iter().map(|&q| q as f32).collect();
    let w = vec![0.0; 6];
    let s = e.state();
    println!(
        "start com {:?} base {:?} foot h {:?}",
        s.com_pos_m, s.base_pos_m, s.foot_height_m
    );
    for k in 0..100 {
        e.step(&q, &w).unwrap();
        let s = e.state();
        if k < 5 || k % 20 == 19 {
            let fz: f32 = s.foot_force_n.chunks(3).map(|f| f[2]).sum();
            println!(
                "{k}: base z {:.5} com z {:.5} v {:.5} fz {:.3} trunk {:.3} sum {:.3} mg {:.3} foot h {:?} div {:?}",
                s.base_pos_m[2],
                s.com_pos_m[2],
                s.com_vel_mps[2],
                fz,
                s.trunk_force_n[0],
                fz + s.trunk_force_n[0],
                model.total_mass_kg() * 9.81,
                s.foot_height_m,
                s.diverged
            );
            println!(
                "    acc {:?} grav {:?} tau {:?}",
                s.imu_acc_mps2,
                s.imu_gravity,
                &s.motor_torque_nm[8..]
            );
            println!("    q {:?}", s.joint_pos_rad);
        }
    }
    let t = std::time::Instant::now();
    for _ in 0..200 {
        e.step(&q, &w).unwrap();
    }
    println!("{} steps/s", 1000.0 / t.elapsed().as_secs_f64());
    println!("snapshot {} bytes", e.snapshot().unwrap().len());
}
