//! The value of each term: a pure function, ≥ 0, of one control step.

use std::f32::consts::PI;

use super::{RewardConfig, RewardInput};
use crate::command::along_course;
use crate::phase::reference_height_m;

/// Forward speed at which the wave has the amplitude that is configured, m/s.
const WAVE_SPEED_MPS: f32 = 0.3;

/// exp(−‖v_cmd − v_xy‖²/σ_v), v of the whole body's centre of mass in the heading frame (paper), or along the
/// course where one is held.
pub fn tracking_lin_vel(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let [x, y] = along_course(input.com_vel_mps, input.off_course_rad);
    let (dx, dy) = (input.command[0] - x, input.command[1] - y);
    (-(dx * dx + dy * dy) / config.lin_vel_sigma).exp()
}

/// exp(−(ω_cmd − ω_z)²/σ_ω), ω of the whole body's equivalent rotation. Paper.
pub fn tracking_yaw_rate(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let error = input.command[2] - input.yaw_rate_radps;
    (-error * error / config.yaw_rate_sigma).exp()
}

/// exp(−Σ (z_j − z_ref(φ_j))²/σ_phase), z the height of the foot's lowest point above the ground. Paper;
/// z_ref of MuJoCo Playground. Feet that cannot reach the ground are left out, so it is 1 afloat.
pub fn phase(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let error: f32 = (0..input.foot_height_m.len())
        .map(|j| {
            let reference_m = reference_height_m(input.phase_rad[j], input.swing_height_m);
            input.on_ground[j] * (input.foot_height_m[j] - reference_m).powi(2)
        })
        .sum();
    (-error / config.phase_sigma).exp()
}

/// Share of the feet that bear weight where the clock asks for it, φ within 0.4·π of ±π, and none within 0.4·π of
/// 0, the top of the swing; a foot in between, or one that cannot reach the ground, counts as right.
pub fn in_step(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let feet = input.foot_force_n.len();
    let right = |&j: &usize| {
        let phase_rad = input.phase_rad[j].abs();
        let bears = input.foot_force_n[j][2] > config.contact_force_n;
        input.on_ground[j] == 0.0
            || (0.4 * PI..=0.6 * PI).contains(&phase_rad)
            || bears == (phase_rad > 0.5 * PI)
    };
    if feet == 0 { 1.0 } else { (0..feet).filter(right).count() as f32 / feet as f32 }
}

/// 1: what ends early earns less.
pub fn alive(_: &RewardConfig, _: &RewardInput<'_>) -> f32 {
    1.0
}

/// Σ|q̇τ|, W. Paper. Braking counts as much as driving: a servo cannot feed energy back.
pub fn power(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input.mech_power_w.iter().map(|p| p.abs()).sum()
}

/// Σ(a_t − a_{t−1})².
pub fn action_rate(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    squared_distance(input.action, input.previous_action)
}

/// Σ τ², N²m².
pub fn torque(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input.motor_torque_nm.iter().map(|t| t * t).sum()
}

/// Σ((q̇_t − q̇_{t−1})/dt)², rad²/s⁴.
pub fn joint_acceleration(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    squared_distance(input.joint_vel_radps, input.previous_joint_vel_radps)
        / (input.dt_s * input.dt_s)
}

/// Σ of how far joints are outside the middle `soft_limit_share` of their range, rad.
pub fn joint_limits(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let joints = input.joints;
    (0..joints.len())
        .map(|i| {
            let middle = 0.5 * (joints.lower_rad[i] + joints.upper_rad[i]);
            let half = 0.5 * config.soft_limit_share * (joints.upper_rad[i] - joints.lower_rad[i]);
            ((input.joint_pos_rad[i] - middle).abs() - half).max(0.0)
        })
        .sum()
}

/// Σ of how far targets are beyond the joints' limits, rad.
pub fn target_limits(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let joints = input.joints;
    (0..joints.len())
        .map(|i| {
            let target = input.target_rad[i];
            (target - joints.upper_rad[i]).max(joints.lower_rad[i] - target).max(0.0)
        })
        .sum()
}

/// Σ of the horizontal speeds of the feet in contact, m/s.
pub fn slip(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input
        .foot_vel_mps
        .iter()
        .zip(input.foot_force_n)
        .filter(|(_, force)| force[2] > config.contact_force_n)
        .map(|(v, _)| (v[0] * v[0] + v[1] * v[1]).sqrt())
        .sum()
}

/// g_x² + g_y², the squared sine of the lean.
pub fn orientation(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input.gravity[0].powi(2) + input.gravity[1].powi(2)
}

/// Force on links that carry feet, the feet left out, as a share of `trunk_force_n`, at most 1; 0 while the
/// centre of mass is under water: ashore a swimmer lands on its belly.
pub fn trunk_contact(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    (1.0 - input.submerged) * (input.trunk_force_n / config.trunk_force_n).clamp(0.0, 1.0)
}

/// v_z² of the whole body's centre of mass, m²/s².
pub fn vertical_velocity(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input.com_vel_mps[2].powi(2)
}

/// ω_x² + ω_y² of the body, rad²/s².
pub fn rocking(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    input.gyro_radps[0].powi(2) + input.gyro_radps[1].powi(2)
}

/// Σ|q − q_nominal| while the command is to stand, rad; wheels have no angle to stand in.
pub fn stand_still(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    if !input.standing {
        return 0.0;
    }
    let off = |i: usize| (input.joint_pos_rad[i] - input.joints.nominal_rad[i]).abs();
    (0..input.joint_pos_rad.len()).filter(|&i| !input.joints.rolls(i)).map(off).sum()
}

/// Σ(q − q_nominal)² of the joints that move no leg, rad²; 0 afloat, where the body swims.
pub fn bend(_: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let joints = 0..input.joint_pos_rad.len();
    let body = joints.filter(|&i| !input.in_leg[i] && !input.joints.rolls(i));
    let squares = body.map(|i| (input.joint_pos_rad[i] - input.joints.nominal_rad[i]).powi(2));
    (1.0 - input.afloat) * squares.sum::<f32>()
}

fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

/// Mean over the leg joints of max(0, 1 − |q − q_swimming|/`leg_fold_within_rad`) afloat, 1 elsewhere. Not an
/// exponential: that does not pull a leg that hangs, 2.5 rad off.
pub fn leg_fold(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let folded = |i: usize, _| {
        let error = (input.joint_pos_rad[i] - input.swimming_rad[i]).abs();
        (1.0 - error / config.leg_fold_within_rad).max(0.0)
    };
    judged_afloat(input, || mean(input, true, folded))
}

/// Mean over the body joints, head to tail, of exp(−(q_i − q_wave,i)²/σ) afloat, 1 elsewhere.
pub fn body_wave(config: &RewardConfig, input: &RewardInput<'_>) -> f32 {
    let bodies = input.in_leg.iter().filter(|&&leg| !leg).count();
    let follows = |i: usize, place: usize| {
        let error = input.joint_pos_rad[i] - wave_rad(config, input, place, bodies);
        (-error * error / config.wave_sigma).exp()
    };
    judged_afloat(input, || mean(input, false, follows))
}

/// What asks for swimming pays in full where nobody swims: a robot must not lose by leaving the water. (By
/// entering it, it loses what its style lacks.)
fn judged_afloat(input: &RewardInput<'_>, value: impl FnOnce() -> f32) -> f32 {
    if input.afloat > 0.0 { value() } else { 1.0 }
}

/// Mean over the joints that are in a leg, or are not, each of which earns for itself (1 where there is
/// none): with the exponential of a sum, one leg that is far off hides from the others that they get better.
/// `value` is told a joint and its place among those that count.
fn mean(input: &RewardInput<'_>, legs: bool, value: impl Fn(usize, usize) -> f32) -> f32 {
    let all = input.in_leg.iter().enumerate();
    let (mut sum, mut count) = (0.0, 0);
    for (joint, _) in all.filter(|&(_, &leg)| leg == legs) {
        sum += value(joint, count);
        count += 1;
    }
    match count {
        0 => 1.0,
        count => sum / count as f32,
    }
}

/// q_wave,i = s·a_i·sin(φ − i·lag) − turn·ω_cmd: φ the gait clock (the phase of the first foot), a_i linear
/// over the `joints` of the body from head to tail, s the commanded forward speed over 0.3 m/s, 0 to 1.5.
/// Straight while standing.
fn wave_rad(config: &RewardConfig, input: &RewardInput<'_>, i: usize, joints: usize) -> f32 {
    if input.standing {
        return 0.0;
    }
    let speed = (input.command[0] / WAVE_SPEED_MPS).clamp(0.0, 1.5);
    let [head, tail] = config.wave_amplitude_rad;
    let along = i as f32 / (joints.max(2) - 1) as f32;
    let amplitude = head + (tail - head) * along;
    let wave = (input.phase_rad[0] - i as f32 * config.wave_lag_rad).sin();
    // A joint that turns to the left turns what is behind it, so that the body bends to the right.
    speed * amplitude * wave - config.wave_turn_rad * input.command[2]
}
