//! Worked examples of every term and of the sum.

use std::f32::consts::PI;

use super::*;
use crate::PerJoint;
use crate::{COMMAND_DIM, JointTable, PerFoot};

const ACT_DIM: usize = 16;
const FEET: usize = 4;
const JOINTS: JointTable = JointTable {
    nominal_rad: PerJoint::filled(ACT_DIM, 0.1),
    lower_rad: PerJoint::filled(ACT_DIM, -1.0),
    upper_rad: PerJoint::filled(ACT_DIM, 1.0),
};
const NOMINAL: [f32; ACT_DIM] = [0.1; ACT_DIM];
/// Eight joints of the body, then two of each leg.
const IN_LEG: [bool; ACT_DIM] = {
    let mut in_leg = [false; ACT_DIM];
    let mut i = 8;
    while i < ACT_DIM {
        in_leg[i] = true;
        i += 1;
    }
    in_leg
};
/// The last three of the body.
const IN_TAIL: [bool; ACT_DIM] = {
    let mut in_tail = [false; ACT_DIM];
    in_tail[5] = true;
    in_tail[6] = true;
    in_tail[7] = true;
    in_tail
};
const ZEROS: [f32; ACT_DIM] = [0.0; ACT_DIM];
const FULL: Scales = Scales { costs: 1.0, guides: 1.0 };

/// Shapes and weights other than the defaults, as training on flat ground uses them.
pub(crate) fn matched() -> RewardConfig {
    RewardConfig {
        lin_vel_sigma: 0.05,
        yaw_rate_sigma: 0.12,
        phase_sigma: 0.004,
        weights: RewardWeights {
            phase: 1.75,
            power: -3e-3,
            action_rate: -0.05,
            slip: -1.0,
            orientation: -0.5,
            trunk_contact: -1.0,
            ..RewardWeights::default()
        },
        ..RewardConfig::default()
    }
}

/// Standing still in the nominal pose, feet down, with the zero command.
fn rest() -> RewardInput<'static> {
    RewardInput {
        joints: &JOINTS,
        dt_s: 0.02,
        swing_height_m: 0.05,
        command: [0.0; COMMAND_DIM],
        standing: false,
        phase_rad: PerFoot::filled(FEET, PI),
        off_course_rad: 0.0,
        com_vel_mps: [0.0; 3],
        com_height_m: 0.12,
        yaw_rate_radps: 0.0,
        gyro_radps: [0.0; 3],
        gravity: [0.0, 0.0, -1.0],
        joint_pos_rad: &NOMINAL,
        joint_vel_radps: &ZEROS,
        previous_joint_vel_radps: &ZEROS,
        motor_torque_nm: &ZEROS,
        mech_power_w: &ZEROS,
        foot_height_m: &[0.0; FEET],
        foot_vel_mps: &[[0.0; 3]; FEET],
        foot_force_n: &[[0.0, 0.0, 6.0]; FEET],
        trunk_force_n: 0.0,
        push_n: [0.0; 3],
        friction: 0.8,
        submerged: 0.0,
        afloat: 0.0,
        on_ground: PerFoot::filled(FEET, 1.0),
        in_leg: &IN_LEG,
        in_tail: &IN_TAIL,
        swimming_rad: &ZEROS,
        target_rad: &NOMINAL,
        action: &ZEROS,
        previous_action: &ZEROS,
    }
}

#[track_caller]
fn check(term: fn(&RewardConfig, &RewardInput<'_>) -> f32, input: &RewardInput<'_>, expected: f32) {
    let found = term(&RewardConfig::default(), input);
    assert!(
        (found - expected).abs() <= 1e-5 * expected.abs().max(1.0),
        "{found} is not {expected}"
    );
}

fn with(index: usize, value: f32) -> [f32; ACT_DIM] {
    std::array::from_fn(|i| if i == index { value } else { 0.0 })
}

#[test]
fn tracking_of_velocity() {
    check(terms::tracking_lin_vel, &rest(), 1.0);
    // Command (0.3, −0.1), velocity (0.1, 0.1): 0.2² + 0.2² = 0.08; exp(−0.08/0.25) = 0.726149
    let input = RewardInput { command: [0.3, -0.1, 9.0], com_vel_mps: [0.1, 0.1, 9.0], ..rest() };
    check(terms::tracking_lin_vel, &input, 0.726_149);
    // Standing under a 0.3 m/s command: exp(−0.09/0.25) = 0.697676: 70 % for doing nothing.
    let input = RewardInput { command: [0.3, 0.0, 0.0], ..rest() };
    check(terms::tracking_lin_vel, &input, 0.697_676);
    // Told to hold a course and turned a quarter to the left of it, 0.3 m/s forward are 0 along the course
    // and 0.3 across: 0.3² + 0.3² = 0.18; exp(−0.18/0.25) = 0.486752
    let input = RewardInput {
        command: [0.3, 0.0, 0.0],
        com_vel_mps: [0.3, 0.0, 0.0],
        off_course_rad: PI / 2.0,
        ..rest()
    };
    check(terms::tracking_lin_vel, &input, 0.486_752);
}

#[test]
fn tracking_of_yaw_rate() {
    // (0.5 − (−0.25))² = 0.5625; exp(−0.5625/0.25) = exp(−2.25) = 0.105399
    let input = RewardInput { command: [9.0, 9.0, 0.5], yaw_rate_radps: -0.25, ..rest() };
    check(terms::tracking_yaw_rate, &input, 0.105_399);
}

#[test]
fn a_robot_that_lives_earns_one() {
    check(terms::alive, &rest(), 1.0);
}

#[test]
fn phase_of_the_feet() {
    check(terms::phase, &rest(), 1.0);
    // φ = 0 asks FL and HR for 5 cm; they are at 2 and 5 cm; FR and HL asked for 0, at 0 and 1 cm:
    // 0.03² + 0 + 0.01² + 0 = 0.001; exp(−0.001/0.01) = 0.904837
    let input = RewardInput {
        phase_rad: [0.0, PI, PI, 0.0].into(),
        foot_height_m: &[0.02, 0.0, 0.01, 0.05],
        ..rest()
    };
    check(terms::phase, &input, 0.904_837);
}

/// Trot at φ = 0 of FL and HR: FL is up, FR bears 6 N, HL and HR are the wrong way round: 2 of 4. A quarter of a
/// turn on, all are between stance and swing.
#[test]
fn feet_bear_weight_in_step_with_the_clock() {
    check(terms::in_step, &rest(), 1.0);
    let input = RewardInput {
        phase_rad: [0.0, PI, PI, 0.0].into(),
        foot_force_n: &[[0.0, 0.0, 0.5], [0.0, 0.0, 6.0], [0.0; 3], [0.0, 0.0, 6.0]],
        ..rest()
    };
    check(terms::in_step, &input, 0.5);
    let between = RewardInput { phase_rad: [0.5 * PI; 4].into(), ..input };
    check(terms::in_step, &between, 1.0);
    // HL cannot reach the ground
    let shore = RewardInput { on_ground: [1.0, 1.0, 0.0, 1.0].into(), ..input };
    check(terms::in_step, &shore, 0.75);
}

#[test]
fn power_counts_braking_as_well() {
    let power: [f32; ACT_DIM] = std::array::from_fn(|i| if i % 2 == 0 { 0.5 } else { -0.25 });
    // 8·0.5 + 8·0.25 = 6 W
    check(terms::power, &RewardInput { mech_power_w: &power, ..rest() }, 6.0);
}

#[test]
fn bend_of_the_body() {
    check(terms::bend, &rest(), 0.0);
    // joints 0 and 5 are the body's, joint 9 is a knee: 0.3² + 0.2² = 0.13
    let mut pos = NOMINAL;
    (pos[0], pos[5], pos[9]) = (pos[0] - 0.3, pos[5] + 0.2, pos[9] + 1.0);
    let bent = RewardInput { joint_pos_rad: &pos, ..rest() };
    check(terms::bend, &bent, 0.13);
    let afloat = RewardInput { afloat: 1.0, ..bent };
    check(terms::bend, &afloat, 0.0);
}

#[test]
fn action_rate_torque_and_acceleration() {
    let (a, b) = (with(3, 0.5), with(3, -0.1));
    // 0.6² = 0.36
    check(terms::action_rate, &RewardInput { action: &a, previous_action: &b, ..rest() }, 0.36);
    check(terms::torque, &RewardInput { motor_torque_nm: &a, ..rest() }, 0.25);
    // 0.6 rad/s in 0.02 s: 30 rad/s²; 900
    let input = RewardInput { joint_vel_radps: &a, previous_joint_vel_radps: &b, ..rest() };
    check(terms::joint_acceleration, &input, 900.0);
}

#[test]
fn joint_limits_start_at_the_soft_share() {
    check(terms::joint_limits, &rest(), 0.0);
    // Range ±1, soft ±0.95: −0.99 is 0.04 beyond, 1.05 is 0.1 beyond.
    let mut pos = ZEROS;
    (pos[0], pos[15], pos[7]) = (-0.99, 1.05, 0.94);
    check(terms::joint_limits, &RewardInput { joint_pos_rad: &pos, ..rest() }, 0.14);
}

#[test]
fn slip_counts_only_feet_in_contact() {
    // FL slides at 0.5 m/s (3-4-5), its vertical speed does not count; FR is in the air (0.5 N); HL slides
    // back.
    let input = RewardInput {
        foot_vel_mps: &[[0.3, 0.4, 7.0], [9.0, 0.0, 0.0], [-0.1, 0.0, 0.0], [0.0; 3]],
        foot_force_n: &[[0.0, 0.0, 6.0], [0.0, 0.0, 0.5], [1.0, 1.0, 2.0], [0.0; 3]],
        ..rest()
    };
    check(terms::slip, &input, 0.6);
}

#[test]
fn posture_terms() {
    // Rolled by 30°: g_y² = 0.25.
    let input = RewardInput { gravity: [0.0, -0.5, -0.866_025], ..rest() };
    check(terms::orientation, &input, 0.25);
    // 2 N of 5 N; 50 N is cut at 1.
    check(terms::trunk_contact, &RewardInput { trunk_force_n: 2.0, ..rest() }, 0.4);
    check(terms::trunk_contact, &RewardInput { trunk_force_n: 50.0, ..rest() }, 1.0);
    let input = RewardInput { com_vel_mps: [9.0, 9.0, -0.3], ..rest() };
    check(terms::vertical_velocity, &input, 0.09);
    let input = RewardInput { gyro_radps: [0.6, -0.8, 9.0], ..rest() };
    check(terms::rocking, &input, 1.0);
}

#[test]
fn stand_still_only_when_told_to_stand() {
    // 16·|0 − 0.1| = 1.6 rad
    let input = RewardInput { joint_pos_rad: &ZEROS, ..rest() };
    check(terms::stand_still, &input, 0.0);
    check(terms::stand_still, &RewardInput { standing: true, ..input }, 1.6);
}

#[test]
fn the_reward_is_the_weighted_sum_times_dt() {
    let power = [0.5; ACT_DIM];
    let input = RewardInput {
        command: [0.3, 0.0, 0.0],
        mech_power_w: &power,
        trunk_force_n: 50.0,
        ..rest()
    };
    let mut parts = PerTerm::filled(0, f32::NAN);
    let own = &mut Programs::default();
    let total = evaluate(&RewardConfig::default(), own, &input, 0.02, FULL, &mut parts);
    // Paper: 1.0·0.697676 + 0.5·1 + 1.0·1 − 1e-3·8 = 2.189676; times 0.02 = 0.0437935. Trunk contact: weight
    // 0.
    assert!((total - 0.043_793_5).abs() < 1e-7, "{total}");
    assert_eq!(total, parts.iter().sum::<f32>());
    let part = |name: &str| parts[TERMS.iter().position(|t| t.name == name).unwrap()];
    assert!((part("tracking_lin_vel") - 0.013_953_5).abs() < 1e-7);
    assert!((part("power") + 0.000_16).abs() < 1e-9);
    assert_eq!(part("trunk_contact"), 0.0);
    let _ = evaluate(&matched(), own, &input, 0.02, FULL, &mut parts);
    let part = |name: &str| parts[TERMS.iter().position(|t| t.name == name).unwrap()];
    // Matched: exp(−0.09/0.05) = 0.165299 · 0.02; trunk contact −1·1·0.02.
    assert!((part("tracking_lin_vel") - 0.003_305_98).abs() < 1e-7);
    assert!((part("trunk_contact") + 0.02).abs() < 1e-8);
}

#[test]
fn the_table_matches_the_weights() {
    let defaults = RewardWeights::default().to_array();
    assert_eq!(TERMS.len(), TERM_COUNT);
    for (term, weight) in TERMS.iter().zip(defaults) {
        assert_eq!(term.default_weight, weight, "{}", term.name);
        assert!(match term.sense {
            Sense::Reward | Sense::Guide => weight >= 0.0,
            Sense::Cost => weight <= 0.0,
        });
    }
    matched().validate().unwrap();
}

#[test]
fn a_wrong_sign_or_scale_is_refused_by_name() {
    let mut config = RewardConfig::default();
    config.weights.power = 3e-3;
    assert_eq!(
        config.validate().unwrap_err().to_string(),
        "task.reward.weights.power is 0.003: this term costs, its weight must be -10000 to 0"
    );
    config = RewardConfig::default();
    config.weights.phase = -1.0;
    assert!(config.validate().unwrap_err().to_string().contains("reward.weights.phase"));
    config = RewardConfig { phase_sigma: 0.0, ..RewardConfig::default() };
    assert!(config.validate().unwrap_err().to_string().contains("reward.phase_sigma"));
}

#[test]
fn targets_beyond_the_limits_cost_what_they_are_beyond_them() {
    check(terms::target_limits, &rest(), 0.0);
    // Limits ±1: 1.5 is half a radian beyond the upper one, −3 two beyond the lower one, 0.99 within.
    let mut target = ZEROS;
    (target[0], target[5], target[9]) = (1.5, -3.0, 0.99);
    let input = RewardInput { target_rad: &target, ..rest() };
    check(terms::target_limits, &input, 2.5);
}

#[test]
fn in_water_legs_fold_instead_of_stepping() {
    // The nominal pose is 0.1 rad in each of the 8 leg joints, the swimming pose 0.6: 1 − 0.5/π = 0.840845
    // for each.
    let fold = [0.6; ACT_DIM];
    let input = RewardInput { submerged: 1.0, afloat: 1.0, swimming_rad: &fold, ..rest() };
    check(terms::leg_fold, &input, 0.840_845);
    // One leg that is 2.4 rad off in one joint and 4.4 in the other, (6·0.840845 + 0.236056 + 0)/8 =
    // 0.660141: it hides nothing from the other six.
    let mut one_off = input.joint_pos_rad.to_vec();
    (one_off[8], one_off[9]) = (3.0, 5.0);
    let one_leg = RewardInput { joint_pos_rad: &one_off, ..input };
    check(terms::leg_fold, &one_leg, 0.660_141);
    // Each of the styles pays in full where it is not asked for, so that nothing is lost or won by going from
    // one to the other.
    let input = RewardInput { on_ground: [0.0; FEET].into(), foot_height_m: &[0.3; FEET], ..input };
    check(terms::phase, &input, 1.0);
    let on_land = RewardInput {
        submerged: 0.0,
        afloat: 0.0,
        on_ground: PerFoot::filled(FEET, 1.0),
        foot_height_m: &[0.0; FEET],
        ..input
    };
    check(terms::leg_fold, &on_land, 1.0);
    check(terms::phase, &on_land, 1.0);
    // Wading, the hind feet over deep water: the fore feet step (2 cm off, exp(−2·0.02²/0.01) = 0.923116),
    // and the belly may touch.
    let wading = RewardInput {
        afloat: 0.0,
        on_ground: [1.0, 1.0, 0.0, 0.0].into(),
        foot_height_m: &[0.02, 0.02, 0.3, 0.3],
        trunk_force_n: 100.0,
        ..input
    };
    check(terms::leg_fold, &wading, 1.0);
    check(terms::phase, &wading, 0.923_116);
    check(terms::trunk_contact, &wading, 0.0);
}

#[test]
fn costs_grow_over_the_run_guides_fall_and_rewards_stay() {
    let config = RewardConfig {
        costs_at_start: 0.2,
        costs_full_after_env_steps: 1000,
        guides_at_start: 3.0,
        ..matched()
    };
    config.validate().unwrap();
    // Halfway: 0.2 + 0.8·0.5, and 3 − 2·0.5.
    let expected = [(0, 0.2, 3.0), (500, 0.6, 2.0), (1000, 1.0, 1.0), (5000, 1.0, 1.0)];
    for (steps, costs, guides) in expected {
        let found = config.scales(steps);
        assert!((found.costs - costs).abs() < 1e-6, "{found:?}");
        assert!((found.guides - guides).abs() < 1e-6, "{found:?}");
    }
    assert_eq!(RewardConfig::default().scales(0), FULL);
    // 10 W cost 0.02·3e-3·10 = 6e-4, at 0.2 of the costs 1.2e-4; tracking pays 0.02 either way, and feet on
    // the clock 0.02·1.75, three times that at the start.
    let input = RewardInput { mech_power_w: &with(3, 10.0), ..rest() };
    let at = |name: &str| TERMS.iter().position(|t| t.name == name).unwrap();
    for (scales, power, phase) in [(FULL, -6e-4, 0.035), (config.scales(0), -1.2e-4, 0.105)] {
        let mut parts = PerTerm::filled(0, 0.0);
        let own = &mut Programs::default();
        let _ = evaluate(&config, own, &input, 0.02, scales, &mut parts);
        assert!((parts[at("power")] - power).abs() < 1e-8);
        assert!((parts[at("phase")] - phase).abs() < 1e-7, "{parts:?}");
        assert!((parts[at("tracking_lin_vel")] - 0.02).abs() < 1e-8);
    }
    let wrong = RewardConfig { guides_at_start: 0.5, ..matched() };
    assert!(wrong.validate().unwrap_err().to_string().contains("guides_at_start"));
}

#[test]
fn in_water_the_body_makes_a_wave_that_travels_to_the_tail() {
    let config = RewardConfig {
        wave_amplitude_rad: [0.2, 0.2],
        wave_lag_rad: PI / 2.0,
        wave_sigma: 0.3,
        ..RewardConfig::default()
    };
    // Clock at a quarter, 0.15 m/s commanded, half of the height: sin(π/2 − i·π/2)·0.1 = 0.1, 0, −0.1, 0,
    // 0.1, 0, −0.1, 0.
    let wave: [f32; ACT_DIM] = std::array::from_fn(|i| match i {
        0 | 4 => 0.1,
        2 | 6 => -0.1,
        _ => 0.0,
    });
    let input = RewardInput {
        submerged: 1.0,
        afloat: 1.0,
        command: [0.15, 0.0, 0.0],
        phase_rad: [PI / 2.0; FEET].into(),
        joint_pos_rad: &wave,
        ..rest()
    };
    assert!((terms::body_wave(&config, &input) - 1.0).abs() < 1e-5);
    // A straight body: four joints are off by 0.1, (4 + 4·exp(−0.1²/0.3))/8 = 0.983608.
    let straight = RewardInput { joint_pos_rad: &ZEROS, ..input };
    assert!((terms::body_wave(&config, &straight) - 0.983_608).abs() < 1e-5);
    // Turning to the left at 0.5 rad/s, each joint lags by 0.2·0.5 = 0.1 rad.
    let turning = RewardConfig { wave_turn_rad: 0.2, ..config.clone() };
    let bent = wave.map(|q| q - 0.1);
    let to_the_left = RewardInput { command: [0.15, 0.0, 0.5], joint_pos_rad: &bent, ..input };
    assert!((terms::body_wave(&turning, &to_the_left) - 1.0).abs() < 1e-5);
    // Standing asks for a straight body; on land none is asked for, and it pays in full.
    let standing = RewardInput { standing: true, ..straight };
    assert!((terms::body_wave(&config, &standing) - 1.0).abs() < 1e-6);
    let on_land = RewardInput { submerged: 0.0, afloat: 0.0, ..input };
    assert_eq!(terms::body_wave(&config, &on_land), 1.0);
}

#[test]
fn terms_of_ones_own_count_with_the_others() {
    let text = r#"
        costs_at_start = 0.5
        costs_full_after_env_steps = 1000
        term = [
            { name = "crouch", value = "exp(-(height - 0.12)^2 / 0.01)", weight = 2.0 },
            { name = "knees", value = "sum(abs(joint_pos - nominal))", weight = -0.5 },
            { name = "broken", value = "1 / (height - height)", weight = 1.0 },
            { name = "tail", value = "sum(abs(power) * in_tail)", weight = 1.0 },
        ]"#;
    let config: RewardConfig = toml::from_str(text).unwrap();
    config.validate().unwrap();
    assert_eq!(config.term_names()[TERM_COUNT..], ["crouch", "knees", "broken", "tail"]);
    let names = Names {
        joints: &std::array::from_fn::<_, ACT_DIM, _>(|i| format!("j{i}")),
        feet: &["FL", "FR", "HL", "HR"].map(str::to_owned),
    };
    let mut own = config.programs(names).unwrap();
    let mut pos = NOMINAL;
    pos[3] += 0.4;
    let power = std::array::from_fn::<_, ACT_DIM, _>(|i| i as f32 - 6.0);
    let input = RewardInput { joint_pos_rad: &pos, mech_power_w: &power, ..rest() };
    let mut parts = PerTerm::default();
    let scale = config.scales(0);
    let total = evaluate(&config, &mut own, &input, 0.02, scale, &mut parts);
    // 0.02·2·1; a cost at half: 0.02·0.5·(−0.5)·0.4; what is not finite is 0; 0.02·(1 + 0 + 1) of the tail
    for (found, expected) in parts[TERM_COUNT..].iter().zip([0.04, -0.002, 0.0, 0.04]) {
        assert!((found - expected).abs() < 1e-6, "{parts:?}");
    }
    assert_eq!(total, parts.iter().sum::<f32>());
}

#[test]
fn wrong_terms_are_refused_when_the_file_is_read() {
    for (term, reason) in [
        ("name = \"power\", value = \"1\"", "name of another term"),
        ("name = \"a b\", value = \"1\"", "letters, digits and _"),
        ("name = \"a\", value = \"torque\"", "per joint, not one number"),
        ("name = \"a\", value = \"speed\"", "no signal"),
        ("name = \"a\", value = \"1\", weight = 1e9", "-10000 to 10000"),
    ] {
        let config: RewardConfig = toml::from_str(&format!("term = [{{ {term} }}]")).unwrap();
        let error = config.validate().unwrap_err().to_string();
        assert!(error.contains(reason), "{error}");
    }
    assert!(toml::from_str::<RewardConfig>("term = [{ nam = \"a\" }]").is_err());
}
