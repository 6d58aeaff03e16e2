//! What a group of lanes holds: parameters and state, one register per quantity.

use caudata_model::{RobotModel, pose};

use super::contact_law::MEMORY;
use super::program::Program;
use crate::drive::loss::LossMemory;
use crate::drive::supply::Supply;
use crate::drive::{
    CommandHistory, DriveFeatures, JointMemory, JointPassive, ServoDrive, WantedTorques,
    loop_memory_steps,
};
use crate::observe;
use crate::per_lane::PerLane as _;
use crate::simd::Lanes;
use crate::water::{Surface, WaterLink};
use crate::{CommandLoss, EngineConfig, LaneParams};

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
    /// Bus voltage, V.
    pub const BUS: usize = 22;
    const HEAD: usize = 23;

    /// Joint positions.
    pub fn q(self) -> usize {
        Self::HEAD
    }
    /// Joint velocities.
    pub fn qd(self) -> usize {
        Self::HEAD + self.joints
    }
    /// Deflections of the friction bristles of joints without a servo.
    pub fn bristle(self) -> usize {
        Self::HEAD + 2 * self.joints
    }
    /// Joint accelerations in the last step.
    pub fn qdd(self) -> usize {
        Self::HEAD + 3 * self.joints
    }
    /// The same without the joints' stops.
    pub fn free(self) -> usize {
        Self::HEAD + 4 * self.joints
    }
    /// What contact points keep, [`MEMORY`] each.
    pub fn contacts(self) -> usize {
        Self::HEAD + 5 * self.joints
    }
    /// Length of the whole.
    pub fn len(self) -> usize {
        Self::HEAD + 5 * self.joints + MEMORY * self.points
    }
}

/// A link's inertia.
#[derive(Debug, Clone, Copy)]
pub(super) struct LinkLane<R> {
    pub mass: R,
    /// Centre of mass in the node's frame, m.
    pub com: [R; 3],
    /// About it, node axes, xx, xy, xz, yy, yz, zz.
    pub inertia: [R; 6],
}

/// Parameters of a group.
#[derive(Debug, Clone)]
pub(super) struct GroupParams<R> {
    pub gravity: [R; 3],
    /// Unit vector of it; −z without gravity.
    pub down: [R; 3],
    pub foot_friction: Vec<R>,
    pub body_friction: R,
    /// As in [`Program::links`].
    pub links: Vec<LinkLane<R>>,
    /// As in [`Program::nodes`].
    pub hinges: Vec<JointPassive<R>>,
    /// Rotor inertia, likewise, kg·m².
    pub armature: Vec<R>,
    /// Policy order.
    pub servos: Vec<ServoDrive<R>>,
    pub supply: Supply<R>,
    /// As in [`Program::links`]; empty on dry ground.
    pub water: Vec<WaterLink<R>>,
    pub surface: Surface<R>,
    /// Torque from outside on each joint, as in [`Program::nodes`], N·m; empty where there never was one.
    pub outer_nm: Vec<R>,
    /// Per lane.
    pub loss: Vec<CommandLoss>,
    /// What each lane's drive-lines need.
    needs: Vec<DriveFeatures>,
    /// What any of them needs.
    pub features: DriveFeatures,
}

/// A group of [`crate::real::Real::LANES`] lanes.
#[derive(Debug, Clone)]
pub(super) struct Group<R> {
    pub params: GroupParams<R>,
    /// State, see [`Layout`].
    pub x: Vec<R>,
    /// Drive-lines. `[A]`
    pub drives: Vec<JointMemory<R>>,
    pub wanted: WantedTorques<R>,
    pub history: CommandHistory<R>,
    /// Per lane.
    pub loss: Vec<LossMemory>,
    /// Lanes that broke down.
    pub diverged: Vec<bool>,
    /// What the last period reported beside the state: means of motor torque `[A]`, power `[A]`, foot forces
    /// `[3 F]`, trunk force, tail force.
    pub sums: Vec<R>,
}

impl<R: Lanes> Group<R> {
    /// All zeros (not yet a robot: every lane is set before use).
    pub fn new(program: &Program<R>, period_s: f64) -> Self {
        let o = R::zero();
        let link = LinkLane { mass: o, com: [o; 3], inertia: [o; 6] };
        let water = if program.water { program.links.len() } else { 0 };
        Self {
            params: GroupParams {
                gravity: [o; 3],
                down: [o; 3],
                foot_friction: vec![o; program.feet.len()],
                body_friction: o,
                links: vec![link; program.links.len()],
                hinges: vec![JointPassive::default(); program.nodes.len()],
                armature: vec![o; program.nodes.len()],
                servos: vec![ServoDrive::default(); program.actuated],
                supply: Supply::default(),
                water: vec![WaterLink::default(); water],
                surface: Surface { level_m: o, current_mps: [o; 3], gravity_mps2: [o; 3] },
                outer_nm: Vec::new(),
                loss: vec![CommandLoss::default(); R::LANES],
                needs: vec![DriveFeatures::default(); R::LANES],
                features: DriveFeatures::default(),
            },
            x: vec![o; layout(program).len()],
            drives: vec![JointMemory::default(); program.actuated],
            wanted: WantedTorques::new(program.actuated),
            history: CommandHistory::new(period_s, &vec![o; program.actuated]),
            loss: vec![LossMemory::default(); R::LANES],
            diverged: vec![false; R::LANES],
            sums: vec![o; sums_len(program)],
        }
    }

    /// Puts one lane's parameters in. `water_level_m`: the terrain's.
    pub fn set_params(
        &mut self,
        lane: usize,
        program: &Program<R>,
        model: &RobotModel,
        config: &EngineConfig,
        water_level_m: f64,
        p: &LaneParams,
    ) {
        let to = &mut self.params;
        let gravity = p.gravity_mps2.map(f64::from);
        let length = pose::norm(gravity);
        to.gravity.set_lane(lane, &gravity);
        let down = if length > 0.0 { gravity.map(|g| g / length) } else { [0.0, 0.0, -1.0] };
        to.down.set_lane(lane, &down);
        for (to, scale) in to.foot_friction.iter_mut().zip(&p.foot_friction_scale) {
            to.set_lane(lane, &f64::from(p.foot_friction * scale));
        }
        to.body_friction.set_lane(lane, &f64::from(p.body_friction));
        let masses = observe::link_masses(model, p);
        for (to, place) in to.links.iter_mut().zip(&program.links) {
            let mass = &masses[place.link];
            let local = [0, 1, 2].map(|r| [0, 1, 2].map(|c| mass.inertia_kgm2[(r, c)]));
            let m = pose::rotate_tensor(place.node_from_link.quat_wxyz, local);
            let com = place.node_from_link.point(mass.com_m);
            to.mass.set_lane(lane, &mass.mass_kg);
            to.com.set_lane(lane, &com);
            let six = [m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2]];
            for (to, one) in to.inertia.iter_mut().zip(six) {
                to.set_lane(lane, &one);
            }
        }
        let servos = ServoDrive::all(model, p, config.dt_s);
        let hinges = JointPassive::all(model, p);
        for (i, node) in program.nodes.iter().enumerate() {
            let joint = &model.joints()[node.joint];
            let hinge = hinges[node.joint].stepped(joint, &node.stop, &servos, config.dt_s);
            to.hinges[i].set_lane(lane, &hinge);
            let armature = node.servo.map_or(joint.armature_kgm2, |a| servos[a].armature_kgm2());
            to.armature[i].set_lane(lane, &armature);
        }
        for (to, servo) in to.servos.iter_mut().zip(&servos) {
            to.set_lane(lane, servo);
        }
        to.supply.set_lane(lane, &Supply::new(p, config.dt_s));
        if let Some(water) = WaterLink::all(model, p) {
            for (to, place) in to.water.iter_mut().zip(&program.links) {
                to.set_lane(lane, &water[place.link]);
            }
        }
        let level = water_level_m + f64::from(p.water_level_offset_m);
        to.surface.level_m.set_lane(lane, &level);
        let current = p.water_current_mps.map(f64::from);
        to.surface.current_mps.set_lane(lane, &current);
        to.surface.gravity_mps2.set_lane(lane, &gravity);
        for outer_nm in &mut to.outer_nm {
            outer_nm.set_lane(lane, &0.0);
        }
        to.loss[lane] = p.command_loss;
        let steps = loop_memory_steps(p, config.dt_s);
        self.wanted.set_steps(lane, steps);
        to.needs[lane] = (servos.iter().map(DriveFeatures::of))
            .fold(DriveFeatures::default(), DriveFeatures::or);
        to.features = (to.needs.iter().copied()).fold(DriveFeatures::default(), DriveFeatures::or);
    }

    /// Puts one lane's commanded torques (policy order) and torques from outside (model order) in, N·m.
    pub fn feed(
        &mut self,
        lane: usize,
        program: &Program<R>,
        commanded_nm: &[f32],
        outer_nm: &[f32],
    ) {
        let to = &mut self.params;
        for (servo, nm) in to.servos.iter_mut().zip(commanded_nm) {
            servo.feed_forward_nm.set_lane(lane, &f64::from(*nm));
        }
        let fed = commanded_nm.iter().any(|nm| *nm != 0.0);
        to.needs[lane].feed_forward |= fed;
        to.features.feed_forward |= fed;
        if to.outer_nm.is_empty() && outer_nm.iter().any(|nm| *nm != 0.0) {
            to.outer_nm = vec![R::zero(); program.nodes.len()];
        }
        for (to, node) in to.outer_nm.iter_mut().zip(&program.nodes) {
            to.set_lane(lane, &f64::from(outer_nm[node.joint]));
        }
    }
}

/// The layout of a program's state.
pub(super) fn layout<R: Lanes>(program: &Program<R>) -> Layout {
    Layout { joints: program.nodes.len(), points: program.points.len() }
}

/// Length of [`Group::sums`].
pub(super) fn sums_len<R: Lanes>(program: &Program<R>) -> usize {
    2 * program.actuated + 3 * program.feet.len() + 2
}
