//! A first task for any robot: what follows from its size, mass, legs and servos, as a TOML layer.
//!
//! The rules are those of thumb by which the presets of the robots that ship were begun. Speeds and times
//! follow from the length of a leg by Froude's law, powers from the weight, and what the servos can do bounds
//! both. A preset or a file on top may say everything otherwise.

use std::fmt::Write;

use caudata_model::{BaseKind, IMU_TILT_MAX_RAD, Pose, RobotModel};
use caudata_task::{JointTable, Mirror, ObservationLayout, check_joint_names};

use crate::ConfigError;

const GRAVITY_MPS2: f64 = 9.81;
/// Control rate that filters are worked out for, s.
const PERIOD_S: f64 = 0.02;
/// Most characters of `run.name`.
pub(crate) const MOST_OF_A_NAME: usize = 40;

/// What the rules start from.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Size {
    feet: usize,
    /// Driven wheels of a robot without feet.
    wheels: usize,
    /// See [`RobotModel::balances`].
    balances: bool,
    mass_kg: f64,
    /// Height of the legs' first joints above the feet, or the radius of the wheels, mean.
    leg_m: f64,
    /// Height of the centre of mass above the lowest point, nominal pose.
    com_m: f64,
    /// Speed without load of the slowest servo that moves it.
    servo_radps: f64,
    /// Viscous damping of a driven joint, mean, N·m·s/rad; of a slide at a lever of 0.1 m.
    damping_nms: f64,
    /// Position gain of a joint that carries it, mean, N·m/rad; of a slide alike.
    stiffness_nm: f64,
}

impl Size {
    fn of(model: &RobotModel) -> Result<Self, ConfigError> {
        let wrong = |error: caudata_model::ModelError| ConfigError::Robot(error.to_string());
        let pos = model.full_pos_rad(model.nominal_pos_rad()).map_err(wrong)?;
        let places = model.kinematics(&Pose::IDENTITY, &pos).map_err(wrong)?;
        let com_z = model.centre_of_mass_m(&places)[2];
        let foot_z = |foot: usize| {
            let foot = &model.feet()[foot];
            places.links[foot.link].point(foot.centre_m)[2]
        };
        let feet = model.feet().len();
        // heights of their axles and of their lowest points
        let wheel = |a: usize| {
            let link = model.joints()[model.actuated()[a]].child_link;
            let axle_z = places.links[link].pos_m[2];
            (axle_z, model.lowest_m(&places, link).map_or(axle_z, |z| z.min(axle_z)))
        };
        let driven = 0..model.actuated().len();
        let wheels: Vec<(f64, f64)> =
            driven.filter(|&a| feet == 0 && model.rolls(a)).map(wheel).collect();
        let lowest = match (feet, wheels.len()) {
            (0, 0) => places.links.iter().map(|l| l.pos_m[2]).fold(com_z, f64::min),
            (0, _) => wheels.iter().map(|w| w.1).fold(com_z, f64::min),
            _ => (0..feet).map(foot_z).fold(f64::INFINITY, f64::min),
        };
        let hip_z = |foot: usize| {
            let up = |&link: &usize| model.links()[link].parent;
            let leg = std::iter::successors(Some(model.feet()[foot].link), up)
                .take_while(|&link| model.leg_of(link) == Some(foot));
            leg.last().map_or(com_z, |hip| places.links[hip].pos_m[2])
        };
        let legs: f64 = (0..feet).map(|foot| hip_z(foot) - foot_z(foot)).sum();
        let radii: f64 = wheels.iter().map(|(axle, bottom)| axle - bottom).sum();
        let count = model.actuated().len();
        // an arm or a gripper does not carry it
        let leg = |a: usize| model.leg_of(model.joints()[model.actuated()[a]].child_link).is_some();
        let carries = |a: &usize| feet + wheels.len() == 0 || model.rolls(*a) || leg(*a);
        let speed = |a: usize| model.servo(a).qd_max_radps / model.per_radian(a);
        let turned = |a: usize, of_joint: f64| of_joint * model.per_radian(a).powi(2);
        Ok(Self {
            feet,
            wheels: wheels.len(),
            balances: model.balances(),
            mass_kg: model.total_mass_kg(),
            leg_m: match feet + wheels.len() {
                0 => 0.1,
                count => ((legs + radii) / count as f64).max(0.02),
            },
            com_m: (com_z - lowest).max(0.01),
            servo_radps: (0..count).filter(carries).map(speed).fold(f64::INFINITY, f64::min),
            damping_nms: mean((0..count).map(|a| turned(a, model.servo(a).damping_nm_s_per_rad))),
            stiffness_nm: mean(
                (0..count).filter(carries).map(|a| turned(a, model.kp_nm_per_rad(a))),
            ),
        })
    }

    /// Forward speed that such a robot is first asked for, m/s: a slow trot at a Froude number of 0.12, a
    /// biped's first steps at 0.01; no faster than feet can be swung, 0.1 m/s without feet or wheels.
    fn speed_mps(&self) -> f64 {
        let froude = match (self.feet, self.wheels) {
            (0, 0) => return 0.1,
            (1 | 2, _) => 0.01,
            _ => 0.12,
        };
        let walks = (froude * GRAVITY_MPS2 * self.leg_m).sqrt();
        walks.min(0.2 * self.servo_radps * self.leg_m)
    }

    /// Strides per second: about a leg's length each. What walks on two feet falls over the one that it stands
    /// on for half a stride, and must catch itself before it has fallen far: the smaller, the sooner
    /// (docs/reference/learning.md).
    fn stride_hz(&self) -> f64 {
        let (least, most) = match (self.feet, self.balances) {
            (1 | 2, _) => ((2.3 * self.falls_hz()).clamp(1.25, 2.5), 2.5),
            (_, true) => (1.25, 2.0),
            _ => (0.9, 2.0),
        };
        (self.speed_mps() / self.leg_m).clamp(least, most)
    }

    /// How fast it tips over, √(g/height), in turns of that many radians per second, Hz.
    fn falls_hz(&self) -> f64 {
        (GRAVITY_MPS2 / self.com_m).sqrt() / std::f64::consts::TAU
    }

    /// Height that feet are lifted to, m: a fifth of the leg.
    fn swing_m(&self) -> f64 {
        if self.feet == 0 { 0.0 } else { round((0.2 * self.leg_m).clamp(0.01, 0.08)) }
    }

    /// Power that carrying its weight is worth, W: weight times speed.
    fn carrying_w(&self) -> f64 {
        self.mass_kg * GRAVITY_MPS2 * round(self.speed_mps())
    }

    /// How many times as much steps take where the damping of its joints, not its weight, is most of it: 1 to 3.
    /// A leg of two alike parts, bent by 70°, bends its knee by h/(0.28 leg) more to lift its foot by h, hip and
    /// ankle by half of that, up and down once a stride.
    fn effort(&self) -> f64 {
        let knee_radps = 2.0 * 1.1 * self.stride_hz() * self.swing_m() / (0.28 * self.leg_m);
        let steps_w = self.feet as f64 * 1.5 * self.damping_nms * knee_radps * knee_radps;
        (steps_w / self.carrying_w()).clamp(1.0, 3.0)
    }

    /// Radians that an action of 1 turns a joint by. On two legs half a radian, or what is worth a sixth of its
    /// weight at the length of a leg: with soft gains less does not hold it up (docs/reference/learning.md).
    fn action_scale_rad(&self) -> f64 {
        let load_nm = self.mass_kg * GRAVITY_MPS2 * self.leg_m;
        if self.feet == 2 { (load_nm / 6.0 / self.stiffness_nm).clamp(0.5, 1.5) } else { 0.8 }
    }

    /// Cut-off of the action filter, Hz: below the stride's frequency, so that steps come of it instead of
    /// vibration; but what balances must act many times as fast as it falls, since its servos take their time
    /// too. How many: docs/reference/learning.md, by trainings of published bipeds.
    fn filter_hz(&self) -> f64 {
        let most_hz = 0.5 / PERIOD_S; // what control can follow
        if self.balances { (11.0 * self.falls_hz()).min(most_hz) } else { 0.8 * self.stride_hz() }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0), |(sum, count), v| (sum + v, count + 1));
    sum / f64::from(count.max(1))
}

/// Two digits that count.
fn round(x: f64) -> f64 {
    let scale = 10f64.powf(1.0 - x.abs().max(1e-12).log10().floor());
    (x * scale).round() / scale
}

/// Whether a robot can be trained to walk at all; training and `caudata robot check` ask the same.
///
/// # Errors
/// [`ConfigError::Robot`] for a robot that is held, touches nothing, has a joint that no policy can name, or an IMU
/// that is mounted turned over.
pub fn can_walk(model: &RobotModel) -> Result<(), ConfigError> {
    let mut geoms = model.links().iter().flat_map(|l| &l.geoms);
    let why = if model.base() == BaseKind::Fixed {
        "is held (base = \"fixed\"), so it cannot be trained to walk; a <freejoint/> on its root body frees an MJCF, \
         `robot import --base free` a URDF"
            .to_owned()
    } else if !geoms.any(|g| g.collides()) {
        "has no shape that touches the ground, so it falls through it; give its feet and its trunk shapes in the MJCF"
            .to_owned()
    } else if let Err(error) = check_joint_names(&model.actuated_names())
        .and_then(|()| JointTable::from_model(model).map(drop))
    {
        format!("cannot be trained: {error}")
    } else if let Some(tilt) = imu_tilt_rad(model).filter(|tilt| *tilt > IMU_TILT_MAX_RAD) {
        format!(
            "has an IMU that is mounted tilted by {:.0}°, so policies, which take what it feels for the trunk's, would \
             fall at once; turn its site in the MJCF until x is forward and z up (`robot import` does)",
            tilt.to_degrees()
        )
    } else {
        return Ok(());
    };
    Err(ConfigError::Robot(format!("robot '{}' {why}", model.name())))
}

/// How far the IMU's z axis is off the vertical in the nominal pose.
fn imu_tilt_rad(model: &RobotModel) -> Option<f64> {
    let site = model.imu_site()?;
    let pos = model.full_pos_rad(model.nominal_pos_rad()).ok()?;
    let places = model.kinematics(&Pose::IDENTITY, &pos).ok()?;
    let up = places.links[site.link].compose(&site.link_from_site).rotate([0.0, 0.0, 1.0]);
    Some(up[2].clamp(-1.0, 1.0).acos())
}

/// Whether the networks of a training may treat left and right alike: the robot is its own mirror image, and
/// so is what it sees, which is known of the built-in observation alone.
fn symmetric(model: &RobotModel, own_observation: bool) -> bool {
    let feet: Vec<String> = model.feet().iter().map(|f| f.name.clone()).collect();
    let layout = ObservationLayout::new(model.actuated().len(), &feet, false);
    !own_observation && Mirror::new(model, &layout).is_ok()
}

/// The layer for a robot; every value with the rule that it comes from. `own_observation`: what lies on top
/// lists the terms of the observation itself.
///
/// # Errors
/// [`ConfigError::Robot`] for a robot that cannot walk: one that is held, or whose pose cannot be worked out.
pub(crate) fn derived(model: &RobotModel, own_observation: bool) -> Result<String, ConfigError> {
    can_walk(model)?;
    let size = Size::of(model)?;
    let mut out = String::new();
    // Writing to a string cannot fail.
    let _ = write_layer(&mut out, model, own_observation, &size);
    Ok(out)
}

fn write_layer(
    out: &mut String,
    model: &RobotModel,
    own_observation: bool,
    size: &Size,
) -> std::fmt::Result {
    let (speed, stride_hz) = (round(size.speed_mps()), round(size.stride_hz()));
    let weight_n = size.mass_kg * GRAVITY_MPS2;
    let (walks, swing_m) = (if size.feet == 0 { 0.0 } else { 1.0 }, size.swing_m());
    // wheels do not roll aside
    let aside = if size.wheels == 0 { round(0.15 * speed) } else { 0.0 };
    // the rates at which full costs come in keep the proportion to what walking earns
    let slower = 0.3 / speed;
    write!(
        out,
        include_str!("robot_preset.toml.in"),
        name = model.name(),
        run = model.name().chars().take(MOST_OF_A_NAME).collect::<String>(),
        symmetric = symmetric(model, own_observation),
        speed = speed,
        swing_m = swing_m,
        feet = size.feet,
        wheels = size.wheels,
        mass = size.mass_kg,
        leg = size.leg_m,
        servo = size.servo_radps,
        speed_share = 0.9,
        power = round(1.6 * size.carrying_w() * size.effort()),
        slip = round(0.2 * speed),
        clearance = round(0.6 * swing_m),
        vibration = round(4.5 * stride_hz),
        duty = if size.feet <= 2 { "[0.35, 0.85]" } else { "[0.35, 0.75]" },
        scale = round(size.action_scale_rad()),
        alpha = round(1.0 - (-std::f64::consts::TAU * size.filter_hz() * PERIOD_S).exp()),
        filter_hz = size.filter_hz(),
        hz_low = round(0.95 * stride_hz),
        hz_high = round(1.05 * stride_hz),
        vx_low = round(0.3 * speed),
        vx_high = round(1.15 * speed),
        vy_low = -aside,
        vy_high = aside,
        lin_vel_sigma = round(0.5 * speed * speed),
        phase_sigma = round((0.4 * swing_m * swing_m * size.feet as f64).max(1e-4)),
        contact_n = round(0.04 * weight_n),
        costs_full = if size.feet == 2 { 4_000_000 } else { 500_000 },
        trunk_n = round(0.2 * weight_n),
        phase_weight = 1.75 * walks * round(size.effort()),
        in_step = if matches!(size.feet, 1 | 2) { 2.0 } else { 0.0 },
        zero_share = if size.balances { 0.15 } else { 0.05 },
        power_weight = -round(2e-2 * (2.6 * GRAVITY_MPS2 * 0.3) / size.carrying_w()),
        slip_weight = -round(2.0 * slower) * walks,
        trunk_weight = -5.0 * walks,
        com_low = round(if size.feet + size.wheels == 0 { -0.1 } else { 0.55 * size.com_m }),
        com_high = round(3.0 * size.com_m + 0.2),
        push_n = round(1.5 * size.mass_kg),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const BIPED: Size = Size {
        feet: 2,
        wheels: 0,
        balances: true,
        mass_kg: 1.8,
        leg_m: 0.18,
        com_m: 0.9,
        servo_radps: 30.0,
        damping_nms: 0.05,
        stiffness_nm: 300.0,
    };

    /// Two legs of 0.18 m lifted by 36 mm 1.25 times a second: knees turn at 1.96 rad/s, which takes 4.5 W at
    /// 0.39 N·m·s/rad, where 1.8 kg at 0.13 m/s are worth 2.3 W; no damping counts for more than threefold.
    #[test]
    fn steps_against_the_joints_damping_are_an_effort() {
        let of = |damping_nms| Size { damping_nms, ..BIPED }.effort();
        assert_eq!(of(0.05), 1.0);
        assert!((of(0.39) - 4.5 / 2.3).abs() < 0.03, "{}", of(0.39));
        assert_eq!(of(40.0), 3.0);
    }

    /// From a height of 0.3924 m it tips over at √(9.81/0.3924) = 5 rad/s, 0.796 Hz: 2.3 times that are 1.83 Hz.
    #[test]
    fn the_smaller_a_biped_the_quicker_its_clock() {
        let hz = |com_m| round(Size { com_m, ..BIPED }.stride_hz());
        assert_eq!([0.9, 0.3924, 0.1].map(hz), [1.3, 1.8, 2.5]);
    }

    /// 32 kg on legs of 0.6 m: a sixth of 188.4 N·m are 31.4 N·m, a radian at that stiffness.
    #[test]
    fn soft_gains_make_an_action_a_wider_turn() {
        let scale = |stiffness_nm| {
            round(Size { mass_kg: 32.0, leg_m: 0.6, stiffness_nm, ..BIPED }.action_scale_rad())
        };
        assert_eq!([300.0, 31.392, 1.0].map(scale), [0.5, 1.0, 1.5]);
        assert_eq!(Size { feet: 4, ..BIPED }.action_scale_rad(), 0.8);
    }
}
