//! What episodes hand to the engine: parameters, starts, targets; and what observations carry.

use crate::support::{calm_task, env, model};
use caudata_env::VecEnv;
use caudata_sim::LaneParams;

const ACT_DIM: usize = 16;

#[test]
fn without_randomisation_every_lane_is_the_nominal_robot() {
    let env = env(&calm_task(), 3, 1);
    let nominal = LaneParams::nominal(&model());
    for lane in 0..3 {
        assert_eq!(*env.engine().params(lane), nominal);
    }
}

#[test]
fn draws_become_parameters() {
    let mut task = calm_task();
    let random = &mut task.randomisation;
    random.enabled = true;
    // One value each: what comes out can be worked out.
    random.foot_friction_scale = [0.5, 0.5];
    random.body_friction_scale = [2.0, 2.0];
    random.total_mass_scale = [1.5, 1.5];
    random.link_mass_scale = [0.5, 0.5];
    random.com_offset_m = [0.25, 0.25];
    random.joint_friction_scale = [2.0, 2.0];
    random.armature_scale = [4.0, 4.0];
    random.damping_scale = [0.5, 0.5];
    random.kp_scale = [0.5, 0.5];
    random.kd_scale = [2.0, 2.0];
    random.torque_scale = [0.75, 0.75];
    random.supply_scale = [0.5, 0.5];
    random.command_delay_s = [0.015625, 0.015625];
    random.backlash_scale = [0.5, 0.5];
    random.payload_kg = [0.25, 0.25];
    let env = env(&task, 2, 1);
    let (n, p) = (LaneParams::nominal(&model()), env.engine().params(1));
    assert_eq!(p.foot_friction, 0.5 * n.foot_friction);
    assert_eq!(p.body_friction, 2.0 * n.body_friction);
    assert!(p.link_mass_scale.iter().all(|s| *s == 0.75)); // 1.5·0.5
    assert!(p.com_offset_m.iter().flatten().all(|o| *o == 0.25));
    for i in 0..ACT_DIM {
        assert_eq!(p.joint_friction_nm[i], 2.0 * n.joint_friction_nm[i]);
        assert_eq!(p.joint_armature_kgm2[i], 4.0 * n.joint_armature_kgm2[i]);
        assert_eq!(p.joint_damping_nms_per_rad[i], 0.5 * n.joint_damping_nms_per_rad[i]);
        assert_eq!(p.kp_nm_per_rad[i], 0.5 * n.kp_nm_per_rad[i]);
        assert_eq!(p.kd_nms_per_rad[i], 2.0 * n.kd_nms_per_rad[i]);
        assert_eq!(p.torque_scale[i], 0.75);
    }
    assert_eq!(p.supply_v, 0.5 * n.supply_v);
    assert_eq!(p.command_delay_s, 0.015625);
    assert_eq!(p.payload_kg, 0.25);
    for (p, n) in p.backlash_half_width_rad.iter().zip(&n.backlash_half_width_rad) {
        assert_eq!(*p, 0.5 * n);
    }
}

#[test]
fn a_joint_that_is_made_limp_stays_so_in_the_next_episode() {
    let mut env = env(&calm_task(), 2, 1);
    let mut strengths = [1.0; ACT_DIM];
    strengths[3] = 0.0;
    env.set_joint_strengths(&strengths).unwrap();
    let torques = |env: &VecEnv| env.engine().params(1).torque_scale.clone();
    assert_eq!(torques(&env), strengths);
    // A step before the limit of twenty, so that an episode is under way.
    env.step(&[0.0; 2 * ACT_DIM]).unwrap();
    env.reset_all().unwrap();
    assert_eq!(torques(&env), strengths);
    env.set_joint_strengths(&[1.0; ACT_DIM]).unwrap();
    assert_eq!(*env.engine().params(1), LaneParams::nominal(&model()));
    assert!(env.set_joint_strengths(&[1.0]).is_err());
    strengths[3] = f32::NAN;
    assert!(env.set_joint_strengths(&strengths).is_err());
}

#[test]
fn a_servo_that_fails_is_limp_or_stuck() {
    let mut task = calm_task();
    task.randomisation.enabled = true;
    task.randomisation.limp_share = 1.0;
    let limp = env(&task, 4, 1);
    task.randomisation.limp_share = 0.0;
    task.randomisation.stuck_share = 1.0;
    let stuck = env(&task, 4, 1);
    for lane in 0..4 {
        let (limp, stuck) = (limp.engine().params(lane), stuck.engine().params(lane));
        let count = |values: &[f32], value: f32| values.iter().filter(|v| **v == value).count();
        assert_eq!(count(&limp.torque_scale, 0.0), 1);
        assert_eq!(count(&limp.joint_friction_nm, 20.0), 0);
        assert_eq!(count(&stuck.torque_scale, 0.0), 0);
        assert_eq!(count(&stuck.joint_friction_nm, 20.0), 1);
    }
}

#[test]
fn episodes_may_begin_in_any_attitude() {
    let mut task = calm_task();
    task.reset.fallen_share = 1.0;
    task.termination.max_tilt_rad = std::f32::consts::PI;
    let env = env(&task, 64, 1);
    let up = |lane: usize| -env.state().imu_gravity[3 * lane + 2];
    let back = (0..64).filter(|&lane| up(lane) < 0.0).count();
    assert!((20..44).contains(&back), "{back} of 64 on their backs");
}

#[test]
fn each_episode_is_another_robot() {
    let mut task = calm_task();
    task.randomisation.enabled = true;
    let mut env = env(&task, 1, 1);
    let first = env.engine().params(0).clone();
    for _ in 0..20 {
        assert_eq!(*env.engine().params(0), first);
        env.step(&[0.0; ACT_DIM]).unwrap();
    }
    assert_ne!(*env.engine().params(0), first);
}

#[test]
fn observations_carry_policy_order_command_and_phase() {
    let mut task = calm_task();
    task.reset.joint_pos_noise_rad = 0.2;
    task.reset.joint_vel_noise_radps = 1.0;
    task.command.zero_share = 0.0;
    let env = env(&task, 2, 1);
    let model = model();
    let (state, joints) = (env.state(), model.joints().len());
    for lane in 0..2 {
        let obs = &env.observations()[lane * 97..][..97];
        for (i, &j) in model.actuated().iter().enumerate() {
            assert_eq!(obs[i], state.joint_vel_radps[lane * joints + j]);
            let offset = state.joint_pos_rad[lane * joints + j] - model.nominal_pos_rad()[i] as f32;
            assert_eq!(obs[16 + i], offset);
        }
        assert_eq!(obs[35..38], state.imu_gravity[lane * 3..][..3]);
        for (foot, phase) in env.phases_rad(lane).into_iter().enumerate() {
            assert_eq!(obs[38 + 2 * foot..][..2], [phase.cos(), phase.sin()]);
        }
        assert_eq!(obs[46..49], env.command(lane));
        assert!((1.25..=1.5).contains(&env.stride_frequency_hz(lane)));
    }
}

#[test]
fn past_actions_are_seen_newest_first_and_clipped() {
    let mut task = calm_task();
    task.action.clip = 1.0;
    let mut env = env(&task, 1, 1);
    for value in [0.1, 0.2, 7.0] {
        env.step(&[value; ACT_DIM]).unwrap();
    }
    let actions = &env.observations()[49..97];
    assert_eq!(actions[..16], [1.0; 16]);
    assert_eq!(actions[16..32], [0.2; 16]);
    assert_eq!(actions[32..], [0.1; 16]);
}

#[test]
fn targets_are_filtered_offsets_from_nominal() {
    let mut task = calm_task();
    task.reset.joint_pos_noise_rad = 0.0;
    let mut env = env(&task, 1, 1);
    // y = 0.5·0.4 = 0.2; target nominal + 0.5·0.2; the toy's joints go half of the way: 0.05 rad.
    env.step(&[0.4; ACT_DIM]).unwrap();
    for offset in &env.observations()[16..32] {
        assert!((offset - 0.05).abs() < 1e-6);
    }
    // And that in 20 ms: 2.5 rad/s.
    for velocity in &env.observations()[..16] {
        assert!((velocity - 2.5).abs() < 1e-4);
    }
}

#[test]
fn commands_change_while_an_episode_runs_and_a_zero_command_stops_the_clock() {
    let mut task = calm_task();
    task.episode_steps = 1000;
    task.command.resample_s = [0.1, 0.1];
    task.command.zero_share = 0.5;
    let mut env = env(&task, 1, 2);
    let (mut standing, mut walking, mut changes) = (0, 0, 0);
    let mut last = env.command(0);
    for _ in 0..400 {
        env.step(&[0.0; ACT_DIM]).unwrap();
        let command = env.command(0);
        changes += i32::from(command != last);
        last = command;
        if command == [0.0; 3] {
            standing += 1;
            assert_eq!(env.phases_rad(0), [std::f32::consts::PI; 4]);
        } else {
            walking += 1;
            assert_ne!(env.phases_rad(0)[0], env.phases_rad(0)[1]);
        }
    }
    // 80 commands of 5 steps each, half of them zero.
    assert!(standing > 100 && walking > 100 && changes > 40, "{standing} {walking} {changes}");
}

#[test]
fn sensors_quantise_and_drift_as_the_robot_file_says() {
    let mut task = calm_task();
    let noise = &mut task.noise;
    noise.enabled = true;
    noise.joint_vel_std_radps = 0.0;
    noise.joint_pos_std_rad = 0.0;
    noise.joint_offset_std_rad = 0.0;
    noise.gyro_std_radps = 0.0;
    noise.gravity_std = 0.0;
    task.reset.joint_vel_noise_radps = 1.0;
    let env = env(&task, 1, 1);
    let (model, state, obs) = (model(), env.state(), env.observations());
    let servo = model.servo(0);
    for (i, &j) in model.actuated().iter().enumerate() {
        let position = obs[16 + i] + model.nominal_pos_rad()[i] as f32;
        let counts = f64::from(position) / servo.encoder_lsb_rad();
        assert!((counts - counts.round()).abs() < 1e-3, "{counts}");
        assert!((position - state.joint_pos_rad[j]).abs() < 0.51 * servo.encoder_lsb_rad() as f32);
        let steps = f64::from(obs[i]) / servo.velocity_lsb_radps;
        assert!((steps - steps.round()).abs() < 1e-3, "{steps}");
    }
    // The toy does not turn: what the gyroscope reads is its bias and noise.
    let imu = model.sensors().imu.as_ref().unwrap();
    for rate in &obs[32..35] {
        assert!(*rate != 0.0 && f64::from(rate.abs()) < 5.0 * imu.gyro_bias_std_radps + 0.01);
    }
    assert_eq!(obs[35..38], state.imu_gravity[..3]);
}
