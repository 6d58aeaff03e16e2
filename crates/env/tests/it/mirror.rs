//! The robot is its own mirror image, in the simulator too: mirrored actions lead to mirrored observations.

use std::f32::consts::TAU;
use std::sync::Arc;

use crate::support::{calm_task, model};
use caudata_env::VecEnv;
use caudata_sim::{EngineConfig, TerrainConfig, TerrainKind};
use caudata_task::Mirror;

const ACT_DIM: usize = 16;

/// A gait with nothing symmetric about it.
fn action(step: usize) -> [f32; ACT_DIM] {
    std::array::from_fn(|i| {
        let turn = step as f32 * 0.02 * (0.8 + 0.1 * i as f32) + i as f32 * 0.37;
        0.5 * (TAU * turn).sin()
    })
}

#[test]
fn mirrored_actions_lead_to_mirrored_observations() {
    let mut task = calm_task();
    task.reset.joint_pos_noise_rad = 0.0;
    task.reset.base_vel_noise_mps = 0.0;
    task.reset.yaw_range_rad = 0.0;
    task.episode_steps = 1000;
    task.critic.sees = ["velocity", "yaw_rate", "torque"].map(str::to_owned).into();
    task.termination.com_height_m = [-0.1, 10.0]; // deep water is 2 m deep
    let model = model();
    for kind in [TerrainKind::Flat, TerrainKind::DeepWater] {
        let terrain = TerrainConfig::of(kind);
        let engine =
            caudata_sim::build(Arc::clone(&model), 2, &EngineConfig::default(), &terrain, 1, 1)
                .unwrap();
        let mut env = VecEnv::new(Arc::clone(&model), task.clone(), engine, 1, 0).unwrap();
        let layout = env.contract().observation.clone();
        let mirror = Mirror::new(&model, &layout).unwrap();
        // Apart for each quantity: large joint velocities must not hide a wrong sign of the gyroscope.
        let parts = ["joint_vel", "joint_pos_offset", "gyro", "gravity", "actions"];
        let mut squares = [[0.0_f64; 2]; 5];
        let of_critic = env.critic().mirrored(&mirror);
        let mut of_views = [[0.0_f64; 2]; 3];
        for step in 0..50 {
            let actions = action(step);
            let both = [actions.to_vec(), mirror.action.apply(&actions)].concat();
            env.step(&both).unwrap();
            // clock and command are each lane's own
            let (left, right) = env.observations().split_at(layout.dim());
            let image = mirror.observation.apply(left);
            for (part, [off, seen]) in parts.iter().zip(&mut squares) {
                let slice = layout.slice(part).unwrap();
                for i in slice.start..slice.start + slice.len {
                    // gravity's z says nothing about sides
                    if *part != "gravity" || i < slice.start + 2 {
                        *off += f64::from(image[i] - right[i]).powi(2);
                        *seen += f64::from(right[i]).powi(2);
                    }
                }
            }
            let (left, right) = env.privileged().split_at(of_critic.len());
            for (i, image) in of_critic.apply(left).iter().enumerate() {
                let [off, seen] = &mut of_views[usize::from(i > 2) + usize::from(i > 3)];
                *off += f64::from(image - right[i]).powi(2);
                *seen += f64::from(right[i]).powi(2);
            }
        }
        for (view, [off, seen]) in of_views.into_iter().enumerate() {
            let share = (off / seen).sqrt();
            assert!(seen > 0.0 && share < 0.3, "{kind:?}, view {view}: {share}");
        }
        // Masses are a little lopsided (the facts file has centres of mass off the middle by a fraction of a
        // millimetre).
        for (part, [off, seen]) in parts.iter().zip(squares) {
            let share = (off / seen).sqrt();
            assert!(seen > 0.0 && share < 0.2, "{kind:?}, {part}: {share}");
        }
    }
}
