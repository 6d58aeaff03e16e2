//! The nominal robot with parameters turned: what a baseline can fit. Written on the engine's own parameters,
//! apart from `gap/`'s catalogue.

use caudata_model::RobotModel;
use caudata_sim::LaneParams;

/// A robot in the engine, and what its sensors make of it.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Physics.
    pub lane: LaneParams,
    /// Encoder offset, inside the loop, rad. `[A]`
    pub offset_rad: Vec<f64>,
    /// Relative error of the angle shown. `[A]`
    pub gain: Vec<f64>,
    /// Lag of the speed shown, s. `[A]`
    pub velocity_lag_s: Vec<f64>,
    /// Current shown without current, A. `[A]`
    pub current_bias_a: Vec<f64>,
}

impl Setup {
    /// The robot of the file.
    #[must_use]
    pub fn nominal(model: &RobotModel) -> Self {
        let zeros = vec![0.0; model.actuated().len()];
        Self {
            lane: LaneParams::nominal(model),
            offset_rad: zeros.clone(),
            gain: zeros.clone(),
            velocity_lag_s: zeros.clone(),
            current_bias_a: zeros,
        }
    }
}

/// One number that can be turned; 0 is the nominal robot.
pub struct Knob {
    /// Id of the effect that it stands for.
    pub effect: &'static str,
    /// Per joint, or once for the robot.
    pub per_joint: bool,
    /// A step that matters, in its own measure.
    pub scale: f64,
    /// Bounds.
    pub range: (f64, f64),
    /// Places to start from besides nothing (effects with a threshold have no slope there).
    pub starts: &'static [f64],
    /// Turns it.
    pub apply: fn(&mut Setup, &RobotModel, usize, f64),
}

fn link(model: &RobotModel, a: usize) -> usize {
    model.joints()[model.actuated()[a]].child_link
}

const fn knob(
    effect: &'static str,
    scale: f64,
    range: (f64, f64),
    starts: &'static [f64],
    apply: fn(&mut Setup, &RobotModel, usize, f64),
) -> Knob {
    Knob {
        effect,
        per_joint: true,
        scale,
        range,
        starts,
        apply,
    }
}

const fn global(
    effect: &'static str,
    scale: f64,
    range: (f64, f64),
    apply: fn(&mut Setup, &RobotModel, usize, f64),
) -> Knob {
    Knob {
        effect,
        per_joint: false,
        scale,
        range,
        starts: &[],
        apply,
    }
}

/// Everything that can be turned.
pub const KNOBS: &[Knob] = &[
    global("command_delay", 0.002, (0.0, 0.09), |s, _, _, x| {
        s.lane.command_delay_s = x as f32
    }),
    global("floor_slope", 0.02, (-0.4, 0.4), |s, _, _, x| {
        s.lane.tilt_floor(0.0, x as f32)
    }),
    global("supply_level", 0.3, (-8.0, 4.0), |s, _, _, x| {
        s.lane.supply_v += x as f32
    }),
    knob("encoder_offset", 0.01, (-0.3, 0.3), &[], |s, _, a, x| {
        s.offset_rad[a] = x
    }),
    knob("encoder_gain", 0.005, (-0.1, 0.1), &[], |s, _, a, x| {
        s.gain[a] = x
    }),
    knob("velocity_lag", 0.003, (0.0, 0.2), &[0.01], |s, _, a, x| {
        s.velocity_lag_s[a] = x
    }),
    knob("current_bias", 0.01, (-0.5, 0.5), &[], |s, _, a, x| {
        s.current_bias_a[a] = x
    }),
    knob(
        "command_low_pass",
        0.003,
        (0.0, 0.3),
        &[0.01],
        |s, _, a, x| s.lane.joints[a].command_low_pass_s = x as f32,
    ),
    knob(
        "servo_loop_delay",
        0.001,
        (0.0, 0.05),
        &[0.005],
        |s, _, a, x| s.lane.joints[a].loop_delay_s = x as f32,
    ),
    knob(
        "profile_limit",
        0.1,
        (0.0, 3.5),
        &[1.0, 2.0],
        |s, _, a, x| {
            s.lane.joints[a].profile_speed_radps = if x > 0.01 {
                12.0 * (-x).exp() as f32
            } else {
                0.0
            };
        },
    ),
    knob("kp_error", 0.05, (-1.2, 1.2), &[], |s, _, a, x| {
        s.lane.kp_nm_per_rad[a] *= x.exp() as f32
    }),
    knob("kd_error", 0.02, (-0.15, 1.0), &[], |s, _, a, x| {
        s.lane.kd_nms_per_rad[a] = (s.lane.kd_nms_per_rad[a] + x as f32).max(0.0)
    }),
    knob("integral_action", 2.0, (0.0, 120.0), &[], |s, _, a, x| {
        s.lane.joints[a].ki_nm_per_rad_s = x as f32
    }),
    knob("torque_constant", 0.05, (-0.9, 0.9), &[], |s, _, a, x| {
        let f = (-x).exp() as f32;
        s.lane.kp_nm_per_rad[a] *= f;
        s.lane.kd_nms_per_rad[a] *= f;
        s.lane.joints[a].kd_min_nms_per_rad *= f * f;
        s.lane.joints[a].torque_constant_nm_per_a *= f;
        s.lane.joints[a].speed_scale /= f;
        s.lane.torque_scale[a] *= f;
    }),
    knob(
        "winding_resistance",
        0.05,
        (-0.9, 0.9),
        &[],
        |s, _, a, x| s.lane.joints[a].winding_scale = x.exp() as f32,
    ),
    knob(
        "torque_limit",
        0.1,
        (0.0, 2.5),
        &[1.0, 2.0],
        |s, m, a, x| {
            let servo = m.servo(a);
            let limit_nm = servo.tau_max_nm * (-x).exp();
            s.lane.joints[a].current_limit_a =
                (limit_nm / servo.torque_per_current_nm_per_a + servo.current_dead_band_a) as f32;
        },
    ),
    knob(
        "voltage_limit",
        0.1,
        (0.0, 2.0),
        &[0.5, 1.0],
        |s, _, a, x| {
            let f = (-x).exp() as f32;
            s.lane.joints[a].speed_scale *= f;
        },
    ),
    knob(
        "controller_dead_band",
        0.003,
        (0.0, 0.1),
        &[0.01, 0.03],
        |s, _, a, x| s.lane.joints[a].dead_band_rad = x as f32,
    ),
    knob(
        "braking_asymmetry",
        0.2,
        (0.0, 4.0),
        &[1.0, 2.5],
        |s, _, a, x| s.lane.joints[a].brake_scale = (-x).exp() as f32,
    ),
    knob(
        "coulomb_friction",
        0.01,
        (-0.035, 0.5),
        &[],
        |s, _, a, x| {
            s.lane.joint_friction_nm[a] = (s.lane.joint_friction_nm[a] + x as f32).max(0.0)
        },
    ),
    knob(
        "viscous_friction",
        0.01,
        (-0.006, 0.5),
        &[],
        |s, _, a, x| {
            s.lane.joint_damping_nms_per_rad[a] =
                (s.lane.joint_damping_nms_per_rad[a] + x as f32).max(0.0)
        },
    ),
    knob(
        "stribeck_friction",
        0.01,
        (0.0, 0.4),
        &[0.05],
        |s, _, a, x| s.lane.joints[a].stribeck_nm = x as f32,
    ),
    knob(
        "load_dependent_friction",
        0.05,
        (0.0, 0.9),
        &[0.2],
        |s, _, a, x| {
            s.lane.joints[a].load_friction_driving = x as f32;
            s.lane.joints[a].load_friction_driven = x as f32;
        },
    ),
    knob("drive_asymmetry", 0.05, (0.0, 0.9), &[0.2], |s, _, a, x| {
        s.lane.joints[a].load_friction_driven = x as f32
    }),
    knob(
        "direction_asymmetry",
        0.01,
        (-0.3, 0.3),
        &[],
        |s, _, a, x| {
            s.lane.joints[a].friction_asymmetry_nm = x as f32;
            s.lane.joint_friction_nm[a] = s.lane.joint_friction_nm[a].max(x.abs() as f32 + 0.005);
        },
    ),
    knob("pre_sliding", 0.01, (0.0, 0.2), &[0.02], |s, _, a, x| {
        s.lane.joints[a].presliding_rad = 0.002 + x as f32
    }),
    knob(
        "gear_backlash",
        0.002,
        (0.0, 0.06),
        &[0.004, 0.012, 0.025],
        |s, _, a, x| s.lane.joints[a].gear_half_gap_rad = x as f32,
    ),
    knob(
        "gear_compliance",
        0.005,
        (0.0, 0.3),
        &[0.01, 0.05],
        |s, _, a, x| {
            s.lane.joints[a].gear_stiffness_nm_per_rad =
                if x > 2e-4 { (1.0 / x) as f32 } else { 0.0 };
        },
    ),
    knob("parallel_spring", 0.05, (0.0, 3.0), &[], |s, _, a, x| {
        s.lane.joints[a].spring_nm_per_rad = x as f32
    }),
    knob(
        "hard_stop",
        0.05,
        (0.0, 1.8),
        &[0.3, 0.7, 1.2],
        |s, _, a, x| s.lane.joints[a].high_rad -= x as f32,
    ),
    knob("link_mass", 0.05, (-0.9, 0.9), &[], |s, m, a, x| {
        s.lane.link_mass_scale[link(m, a)] = x.exp() as f32
    }),
    knob("link_com", 0.005, (-0.06, 0.06), &[], |s, m, a, x| {
        s.lane.com_offset_m[link(m, a)][2] -= x as f32
    }),
    knob("link_inertia", 0.3, (-1.0, 3.0), &[], |s, m, a, x| {
        s.lane.link_inertia_scale[link(m, a)] = x.exp() as f32
    }),
    knob("armature", 0.0005, (-0.002, 0.03), &[], |s, _, a, x| {
        s.lane.joint_armature_kgm2[a] = (s.lane.joint_armature_kgm2[a] + x as f32).max(1e-4)
    }),
];

/// The knob of an effect.
#[must_use]
pub fn knob_of(effect: &str) -> Option<&'static Knob> {
    let effect = if effect == "measurement_delay" {
        "command_delay"
    } else {
        effect
    };
    KNOBS.iter().find(|k| k.effect == effect)
}

/// A knob at a joint.
pub type Turn = (&'static Knob, usize);

/// All turns of `knobs` on a robot with `joints` joints.
#[must_use]
pub fn turns(knobs: &[&'static Knob], joints: usize) -> Vec<Turn> {
    knobs
        .iter()
        .flat_map(|k| (0..if k.per_joint { joints } else { 1 }).map(|a| (*k, a)))
        .collect()
}

/// The nominal robot with `turns` at `x`.
#[must_use]
pub fn turned(model: &RobotModel, turns: &[Turn], x: &[f64]) -> Setup {
    let mut setup = Setup::nominal(model);
    for (&(knob, a), &value) in turns.iter().zip(x) {
        (knob.apply)(
            &mut setup,
            model,
            a,
            value.clamp(knob.range.0, knob.range.1),
        );
    }
    setup
}
