//! What a group of lanes holds: parameters and state, one register per quantity.

use caudata_model::{JointKind, JointMotion, RobotModel};

use super::contact::MEMORY;
use super::program::Program;
use crate::params::backlash_joints;
use crate::simd::Lanes;
use crate::{EngineConfig, LaneParams};

/// A slide's end stop in N/m per N·m/rad of a hinge's: the same stop met at a lever of 0.1 m.
const SLIDE_STOP_FACTOR: f64 = 100.0;

/// Where the parts of [`Group::x`] begin.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Live joints.
    pub joints: usize,
    /// Contact points.
    pub points: usize,
}

impl Layout {
    /// Position of the base, world, m.
    pub const POS: usize = 0;
    /// Orientation of the base, w, x, y, z.
    pub const QUAT: usize = 3;
    /// Velocity of the base's origin, world, m/s.
    pub const VEL: usize = 7;
    /// Angular velocity of the base, world, rad/s.
    pub const ANG: usize = 10;
    /// Velocity of the IMU point at the end of the last period, world, m/s.
    pub const IMU: usize = 13;
    /// Acceleration of the base's origin in the last step, world, m/s².
    pub const ACC: usize = 16;
    /// Angular acceleration of the base in the last step, world, rad/s².
    pub const SPIN_ACC: usize = 19;
    const HEAD: usize = 22;

    /// Joint positions.
    pub fn q(self) -> usize {
        Self::HEAD
    }
    /// Joint velocities.
    pub fn qd(self) -> usize {
        Self::HEAD + self.joints
    }
    /// Deflections of the joints' friction bristles.
    pub fn bristle(self) -> usize {
        Self::HEAD + 2 * self.joints
    }
    /// Joint accelerations in the last step.
    pub fn qdd(self) -> usize {
        Self::HEAD + 3 * self.joints
    }
    /// What contact points keep, [`MEMORY`] each.
    pub fn contacts(self) -> usize {
        Self::HEAD + 4 * self.joints
    }
    /// Length of the whole.
    pub fn len(self) -> usize {
        Self::HEAD + 4 * self.joints + MEMORY * self.points
    }
}

/// A link's inertia.
#[derive(Debug, Clone, Copy)]
pub(super) struct LinkLane<R> {
    pub mass: R,
    /// Factor on the program's inertia.
    pub scale: R,
    /// Centre of mass in the node's frame, m.
    pub com: [R; 3],
}

/// A live joint's properties.
#[derive(Debug, Clone, Copy)]
pub(super) struct JointLane<R> {
    pub armature: R,
    pub damping: R,
    pub friction: R,
    pub low: R,
    pub high: R,
    pub spring: R,
    pub spring_ref: R,
    pub stop: R,
    pub stop_damping: R,
}

/// A servo's gains and limits (see [`crate::servo`]).
#[derive(Debug, Clone, Copy)]
pub(super) struct ServoLane<R> {
    pub kp: R,
    pub kd: R,
    pub tau_max: R,
    pub flat: R,
    pub slope: R,
    pub brake: R,
    pub back_drive: R,
}

/// Parameters of a group.
#[derive(Debug, Clone)]
pub(super) struct GroupParams<R> {
    pub gravity: [R; 3],
    /// Unit vector of it; −z without gravity.
    pub down: [R; 3],
    pub foot_friction: R,
    pub body_friction: R,
    /// As in [`Program::links`].
    pub links: Vec<LinkLane<R>>,
    /// As in [`Program::nodes`].
    pub joints: Vec<JointLane<R>>,
    /// Policy order.
    pub servos: Vec<ServoLane<R>>,
    /// What of the command delay is less than a control period, s.
    pub delay_left: R,
    /// Whole control periods of command delay, per lane.
    pub delay_periods: Vec<usize>,
}

/// A group of [`crate::real::Real::LANES`] lanes.
#[derive(Debug, Clone)]
pub(super) struct Group<R> {
    pub params: GroupParams<R>,
    /// State, see [`Layout`].
    pub x: Vec<R>,
    /// Commands, newest first. `[depth, A]`
    pub history: Vec<R>,
    /// Lanes that broke down.
    pub diverged: Vec<bool>,
    /// What the last period reported beside the state: means of motor torque `[A]`, power `[A]`, foot forces `[3 F]`, trunk force.
    pub sums: Vec<R>,
}

impl<R: Lanes> Group<R> {
    /// All zeros (not yet a robot: every lane is set before use).
    pub fn new(program: &Program<R>, depth: usize) -> Self {
        let o = R::zero();
        let link = LinkLane {
            mass: o,
            scale: o,
            com: [o; 3],
        };
        let joint = JointLane {
            armature: o,
            damping: o,
            friction: o,
            low: o,
            high: o,
            spring: o,
            spring_ref: o,
            stop: o,
            stop_damping: o,
        };
        let servo = ServoLane {
            kp: o,
            kd: o,
            tau_max: o,
            flat: o,
            slope: o,
            brake: o,
            back_drive: o,
        };
        Self {
            params: GroupParams {
                gravity: [o; 3],
                down: [o; 3],
                foot_friction: o,
                body_friction: o,
                links: vec![link; program.links.len()],
                joints: vec![joint; program.nodes.len()],
                servos: vec![servo; program.actuated],
                delay_left: o,
                delay_periods: vec![0; R::LANES],
            },
            x: vec![o; layout(program).len()],
            history: vec![o; depth * program.actuated],
            diverged: vec![false; R::LANES],
            sums: vec![o; sums_len(program)],
        }
    }

    /// Puts one lane's parameters in.
    pub fn set_params(
        &mut self,
        lane: usize,
        program: &Program<R>,
        model: &RobotModel,
        config: &EngineConfig,
        p: &LaneParams,
    ) {
        let to = &mut self.params;
        let gravity = p.gravity_mps2.map(f64::from);
        let length = caudata_model::pose::norm(gravity);
        for i in 0..3 {
            set(&mut to.gravity[i], lane, gravity[i]);
            let down = if length > 0.0 {
                gravity[i] / length
            } else {
                [0.0, 0.0, -1.0][i]
            };
            set(&mut to.down[i], lane, down);
        }
        set(&mut to.foot_friction, lane, f64::from(p.foot_friction));
        set(&mut to.body_friction, lane, f64::from(p.body_friction));
        for (to, place) in to.links.iter_mut().zip(&program.links) {
            let link = &model.links()[place.link];
            let scale = f64::from(p.link_mass_scale[place.link]);
            let offset = p.com_offset_m[place.link];
            let com = place
                .node_from_link
                .point([0, 1, 2].map(|i| link.com_m[i] + f64::from(offset[i])));
            set(&mut to.mass, lane, link.mass_kg * scale);
            set(&mut to.scale, lane, scale);
            for i in 0..3 {
                set(&mut to.com[i], lane, com[i]);
            }
        }
        for (to, node) in to.joints.iter_mut().zip(&program.nodes) {
            set_joint(to, lane, model, config, p, node.joint);
        }
        for (a, to) in to.servos.iter_mut().enumerate() {
            set_servo(to, lane, model, p, a);
        }
        let period = config.control_period_s();
        let delay = f64::from(p.command_delay_s);
        let whole = (delay / period).floor();
        to.delay_periods[lane] = whole as usize;
        set(&mut to.delay_left, lane, delay - whole * period);
    }

    /// Overwrites one lane's state.
    pub fn put(&mut self, lane: usize, x: &[f64]) {
        for (slot, &value) in self.x.iter_mut().zip(x) {
            set(slot, lane, value);
        }
    }

    /// One lane's state.
    pub fn get(&self, lane: usize) -> Vec<f64> {
        self.x.iter().map(|v| v.lane(lane)).collect()
    }
}

/// The layout of a program's state.
pub(super) fn layout<R: Lanes>(program: &Program<R>) -> Layout {
    Layout {
        joints: program.nodes.len(),
        points: program.points.len(),
    }
}

/// Length of [`Group::sums`].
pub(super) fn sums_len<R: Lanes>(program: &Program<R>) -> usize {
    2 * program.actuated + 3 * program.feet.len() + 1
}

/// Sets one lane.
#[inline(always)]
pub(super) fn set<R: Lanes>(slot: &mut R, lane: usize, value: f64) {
    *slot = slot.with_lane(lane, value);
}

fn set_joint<R: Lanes>(
    to: &mut JointLane<R>,
    lane: usize,
    model: &RobotModel,
    config: &EngineConfig,
    p: &LaneParams,
    j: usize,
) {
    let joint = &model.joints()[j];
    let (armature, damping, friction) = match joint.kind {
        JointKind::Actuated { index } => (
            f64::from(p.joint_armature_kgm2[index]),
            f64::from(p.joint_damping_nms_per_rad[index]),
            f64::from(p.joint_friction_nm[index]),
        ),
        JointKind::Passive | JointKind::Backlash => (
            joint.armature_kgm2,
            joint.damping_nm_s_per_rad,
            joint.friction_loss_nm,
        ),
    };
    let (low, high) = backlash_joints(model)
        .position(|b| b == j)
        .map(|b| f64::from(p.backlash_half_width_rad[b]))
        .map_or_else(
            || {
                joint
                    .range_rad
                    .unwrap_or((f64::NEG_INFINITY, f64::INFINITY))
            },
            |half| (-half, half),
        );
    let factor = match joint.motion {
        JointMotion::Hinge => 1.0,
        JointMotion::Slide => SLIDE_STOP_FACTOR,
    };
    set(&mut to.armature, lane, armature);
    set(&mut to.damping, lane, damping);
    set(&mut to.friction, lane, friction);
    set(&mut to.low, lane, low);
    set(&mut to.high, lane, high);
    set(&mut to.spring, lane, joint.stiffness_nm_per_rad);
    set(&mut to.spring_ref, lane, joint.spring_ref_rad);
    set(
        &mut to.stop,
        lane,
        config.stop_stiffness_nm_per_rad * factor,
    );
    set(
        &mut to.stop_damping,
        lane,
        config.stop_damping_nms_per_rad * factor,
    );
}

fn set_servo<R: Lanes>(
    to: &mut ServoLane<R>,
    lane: usize,
    model: &RobotModel,
    p: &LaneParams,
    a: usize,
) {
    let servo = model.servo(a);
    let torque = f64::from(p.torque_scale[a]);
    let speed = f64::from(p.supply_v) / servo.reference_supply_v;
    let (flat, end) = (servo.qd_tau_max_radps * speed, servo.qd_max_radps * speed);
    let slope = (servo.tau_qd_max_nm - servo.tau_max_nm) / (end - flat).max(1e-6);
    set(&mut to.kp, lane, f64::from(p.kp_nm_per_rad[a]));
    let kd = f64::from(p.kd_nms_per_rad[a]) + servo.kd_min_nm_s_per_rad;
    set(&mut to.kd, lane, kd);
    set(&mut to.tau_max, lane, servo.tau_max_nm * torque);
    set(&mut to.flat, lane, flat);
    set(&mut to.slope, lane, slope.min(0.0) * torque);
    set(&mut to.brake, lane, servo.tau_brake_max_nm * torque);
    set(&mut to.back_drive, lane, servo.back_drive_kp_ratio);
}
