//! What a joint may be asked for: range, speed, and torque that a servo stands for long.

use caudata_model::{Pose, RobotModel};

/// Distance kept from the ends of the range, share of the range.
const LIMIT_MARGIN: f64 = 0.05;
/// A wheel is swung no farther from its nominal angle than a joint whose file has no limits, rad.
const ROLLED_RAD: f64 = std::f64::consts::TAU;
/// Commands stay below this share of the speed without load.
const SPEED_SHARE: f64 = 0.6;
/// Commands ask for accelerations that take at most this share of the greatest torque.
const TORQUE_SHARE: f64 = 0.4;
/// Poses that are held take at most this share of the greatest torque. Servo makers advise a fifth of the
/// stall torque for steady work (ROBOTIS e-manual, note on stall torque); a bench session of minutes stands
/// more.
pub const HOLD_SHARE: f64 = 0.35;
/// The one trial that is meant to warm the servo.
pub const HOT_SHARE: f64 = 0.5;
/// Steps of the search for what gravity allows, rad; of a slide, so many of what counts as one.
const SEARCH_RAD: f64 = 0.02;

/// Limits of one actuated joint, with the others in their nominal pose and the base held level.
#[derive(Clone, Debug, PartialEq)]
pub struct JointLimits {
    /// Joint.
    pub name: String,
    /// Place in policy order.
    pub index: usize,
    /// What counts as a radian (of a slide, m).
    pub per_radian: f64,
    /// Nominal position, rad.
    pub nominal_rad: f64,
    /// What may be commanded, rad: the range less a margin.
    pub range_rad: (f64, f64),
    /// What may be held, rad: there gravity asks for no more than [`HOLD_SHARE`] of the torque.
    pub hold_rad: (f64, f64),
    /// Fastest command, rad/s.
    pub speed_radps: f64,
    /// Greatest acceleration of a command, rad/s².
    pub acceleration_radps2: f64,
    /// Inertia about the axis, with the drive's, kg·m².
    pub inertia_kgm2: f64,
    /// Greatest torque, N·m.
    pub tau_max_nm: f64,
    /// Gain of the position loop, N·m/rad.
    pub kp_nm_per_rad: f64,
    /// Its damping, the servo's own included, N·m·s/rad.
    pub kd_nm_s_per_rad: f64,
    /// Torque of gravity over the range, N·m, every [`SEARCH_RAD`] from the lower limit on.
    gravity_nm: Vec<f64>,
}

impl JointLimits {
    /// Limits of every actuated joint, policy order.
    pub fn all(robot: &RobotModel) -> Vec<Self> {
        (0..robot.actuated().len()).map(|a| Self::of(robot, a)).collect()
    }

    fn of(robot: &RobotModel, index: usize) -> Self {
        let (low, high) = robot.joint_limits_rad()[index];
        let nominal = robot.nominal_pos_rad()[index];
        let (low, high) = match robot.rolls(index) {
            true => (nominal - ROLLED_RAD, nominal + ROLLED_RAD),
            false => (low, high),
        };
        let margin = LIMIT_MARGIN * (high - low);
        let servo = robot.servo(index);
        let inertia_kgm2 = inertia(robot, index) + servo.armature_kgm2;
        let per_radian = robot.per_radian(index);
        let search = SEARCH_RAD * per_radian;
        let points = ((high - low) / search).ceil() as usize;
        let mut out = Self {
            name: robot.actuated_names()[index].to_owned(),
            index,
            per_radian,
            nominal_rad: nominal,
            range_rad: (low + margin, high - margin),
            hold_rad: (low + margin, high - margin),
            speed_radps: SPEED_SHARE * servo.qd_max_radps * robot.supply_v()
                / servo.reference_supply_v,
            acceleration_radps2: TORQUE_SHARE * servo.tau_max_nm / inertia_kgm2,
            inertia_kgm2,
            tau_max_nm: servo.tau_max_nm,
            kp_nm_per_rad: robot.kp_nm_per_rad(index),
            kd_nm_s_per_rad: robot.kd_nm_s_per_rad(index) + servo.kd_min_nm_s_per_rad,
            gravity_nm: (0..=points)
                .map(|i| gravity(robot, index, low + i as f64 * search))
                .collect(),
        };
        out.hold_rad = out.held_within(low, HOLD_SHARE);
        out
    }

    /// The part of the range around the nominal position that takes at most `share` of the greatest torque to
    /// hold.
    fn held_within(&self, low_rad: f64, share: f64) -> (f64, f64) {
        let allowed = |q: f64| self.at(q - low_rad).abs() <= share * self.tau_max_nm;
        let mut reach = (self.nominal_rad, self.nominal_rad);
        let search = SEARCH_RAD * self.per_radian;
        while reach.0 - search >= self.range_rad.0 && allowed(reach.0 - search) {
            reach.0 -= search;
        }
        while reach.1 + search <= self.range_rad.1 && allowed(reach.1 + search) {
            reach.1 += search;
        }
        reach
    }

    fn at(&self, above_low_rad: f64) -> f64 {
        let last = self.gravity_nm.len() - 1;
        let k = (above_low_rad / (SEARCH_RAD * self.per_radian)).round().clamp(0.0, last as f64);
        self.gravity_nm[k as usize]
    }

    /// Torque that holds position `q_rad` against gravity, N·m.
    pub fn gravity_nm(&self, q_rad: f64) -> f64 {
        let margin =
            (self.range_rad.1 - self.range_rad.0) / (1.0 - 2.0 * LIMIT_MARGIN) * LIMIT_MARGIN;
        self.at(q_rad - (self.range_rad.0 - margin))
    }

    /// Where the position loop comes to rest under the command `q_rad`: a gain hangs through, often towards
    /// where gravity pulls harder.
    fn rest_rad(&self, q_rad: f64) -> f64 {
        /// rad.
        const STEP: f64 = 0.002;
        let pull = |q: f64| self.kp_nm_per_rad * (q_rad - q) - self.gravity_nm(q);
        let way = pull(q_rad).signum();
        let mut q = q_rad;
        // no farther than the gain reaches with all of the servo's torque
        let most = self.tau_max_nm / self.kp_nm_per_rad.max(1e-9);
        while way * pull(q) > 0.0 && (q - q_rad).abs() < most {
            q += way * STEP * self.per_radian;
        }
        q
    }

    /// Command in the range whose hold takes most, but not more than [`HOT_SHARE`]; its torque as a share.
    pub fn hottest(&self) -> (f64, f64) {
        let mut best = (self.nominal_rad, 0.0);
        let mut q = self.range_rad.0;
        while q <= self.range_rad.1 {
            let torque = self.gravity_nm(self.rest_rad(q)).abs();
            let share = torque / self.tau_max_nm;
            if share <= HOT_SHARE && share > best.1 {
                best = (q, share);
            }
            q += SEARCH_RAD * self.per_radian;
        }
        best
    }

    /// Amplitude of a sine of `hz` that stays within speed and torque and `size_rad`.
    ///
    /// The torque is that of the position loop on this inertia: per rad of command
    /// `kp·|I·ω² − j·d·ω| / |kp − I·ω² + j·d·ω|`, which is most where the joint swings on its own gain.
    pub fn sine_rad(&self, size_rad: f64, hz: f64) -> f64 {
        let w = std::f64::consts::TAU * hz;
        let (inertia, damping) = (self.inertia_kgm2 * w * w, self.kd_nm_s_per_rad * w);
        let swing = (self.kp_nm_per_rad - inertia).hypot(damping).max(1e-9);
        let per_rad = self.kp_nm_per_rad * inertia.hypot(damping) / swing;
        size_rad.min(self.speed_radps / w).min(TORQUE_SHARE * self.tau_max_nm / per_rad.max(1e-9))
    }

    /// Size of random jumps every `bit_s` that a sine of no frequency among theirs would exceed by more than
    /// half.
    pub fn jump_rad(&self, size_rad: f64, bit_s: f64) -> f64 {
        let highest_hz = 0.5 / bit_s;
        let sines = (1..=20).map(|k| self.sine_rad(size_rad, highest_hz * f64::from(k) / 20.0));
        size_rad.min(1.5 * sines.fold(f64::INFINITY, f64::min))
    }
}

/// Potential energy with joint `index` at `q_rad`, J.
fn energy(robot: &RobotModel, index: usize, q_rad: f64) -> f64 {
    let mut pos = robot.nominal_pos_rad().to_vec();
    pos[index] = q_rad;
    let Ok(kinematics) =
        robot.full_pos_rad(&pos).and_then(|full| robot.kinematics(&Pose::IDENTITY, &full))
    else {
        return 0.0; // not reached: the lengths are the model's own
    };
    let c = robot.centre_of_mass_m(&kinematics);
    let g = robot.gravity_mps2();
    -robot.total_mass_kg() * (0..3).map(|k| g[k] * c[k]).sum::<f64>()
}

/// Torque against gravity, N·m: the slope of the potential energy.
fn gravity(robot: &RobotModel, index: usize, q_rad: f64) -> f64 {
    const H: f64 = 1e-4;
    (energy(robot, index, q_rad + H) - energy(robot, index, q_rad - H)) / (2.0 * H)
}

/// Inertia about the joint's axis of everything that it carries, in the nominal pose, kg·m².
fn inertia(robot: &RobotModel, index: usize) -> f64 {
    let full = robot.full_pos_rad(robot.nominal_pos_rad());
    let Ok(kinematics) = full.and_then(|full| robot.kinematics(&Pose::IDENTITY, &full)) else {
        return 0.0;
    };
    let j = robot.actuated()[index];
    let (frame, carried) = (kinematics.joints[j], robot.joints()[j].child_link);
    let links = robot.links();
    let below =
        |l: usize| std::iter::successors(Some(l), |&l| links[l].parent).any(|l| l == carried);
    (0..links.len())
        .filter(|&l| below(l))
        .map(|l| {
            let (link, pose) = (&links[l], &kinematics.links[l]);
            let com = pose.point(link.com_m);
            let r = [0, 1, 2].map(|k| com[k] - frame.anchor_m[k]);
            let across = {
                let a = frame.axis;
                [r[1] * a[2] - r[2] * a[1], r[2] * a[0] - r[0] * a[2], r[0] * a[1] - r[1] * a[0]]
            };
            // the axis in the link's own frame, in which its inertia is given
            let axis = pose.inverse().rotate(frame.axis);
            let turned: f64 = (0..3)
                .map(|i| (0..3).map(|k| axis[i] * link.inertia_kgm2[i][k] * axis[k]).sum::<f64>())
                .sum();
            turned + link.mass_kg * across.iter().map(|x| x * x).sum::<f64>()
        })
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> RobotModel {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/xl330_pendulum.robot.toml");
        RobotModel::load(path.as_ref()).unwrap()
    }

    #[test]
    fn a_pendulums_gravity_inertia_and_reach() {
        let j = &JointLimits::all(&rig())[0];
        // m·g·l·sin q: 0.49·9.81·0.1 = 0.4807 N·m level
        assert!((j.gravity_nm(std::f64::consts::FRAC_PI_2).abs() - 0.4807).abs() < 2e-3);
        assert!((j.gravity_nm(0.5).abs() - 0.4807 * 0.4794).abs() < 6e-3);
        // 0.49·0.01 + 2/5·0.49·0.0004 + armature 0.002
        assert!((j.inertia_kgm2 - (0.0049 + 7.84e-5 + 0.002)).abs() < 1e-9);
        // 0.35·0.77 = 0.2695 N·m: sin q ≤ 0.5606, q ≤ 0.595
        assert!((j.hold_rad.1 - 0.595).abs() < 0.03, "{:?}", j.hold_rad);
        assert!((j.hold_rad.0 + 0.595).abs() < 0.03);
        let (q, share) = j.hottest();
        assert!(share > 0.48 && share <= 0.5, "{q} {share}");
        // 2 Hz: I·ω² = 0.006978·157.9 = 1.102, d·ω = 0.0482·12.566 = 0.6057; 0.886·1.2575/|(−0.216, 0.6057)|
        // = 1.7327 N·m per rad; 0.4·0.77/1.7327 = 0.1778 rad, below 0.6·15.96/12.57 = 0.76 rad
        assert!((j.sine_rad(1.0, 2.0) - 0.1778).abs() < 0.002, "{}", j.sine_rad(1.0, 2.0));
    }

    /// Ranges less 5 % at either end: of 12 turns all of them, of a wheel one turn either way.
    #[test]
    fn only_wheels_are_held_to_a_turn() {
        let toml = include_str!("../../../robots/xl330_pendulum.robot.toml");
        let mjcf = include_str!("../../../robots/xl330_pendulum.xml");
        let reach_rad = |half: &str| {
            let mjcf = mjcf.replace("-3.14159 3.14159", half);
            let rig = RobotModel::from_bytes("rig", toml.as_bytes(), mjcf.as_bytes()).unwrap();
            JointLimits::all(&rig)[0].range_rad.1
        };
        assert!((reach_rad("-37.7 37.7") - 0.9 * 37.7).abs() < 1e-4);
        assert!((reach_rad("-1e5 1e5") - 0.9 * std::f64::consts::TAU).abs() < 1e-4);
    }
}
