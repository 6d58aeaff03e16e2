//! One lane: one robot in its own Rapier world.

use caudata_model::{JointKind, JointMotion, Pose as ModelPose, RobotModel};
use rapier3d::math::{Pose, Vector};
use rapier3d::prelude::*;

use super::contacts::ContactImpulses;
use super::convert;
use super::world::{self, Dof, RobotHandles};
use crate::delay::CommandHistory;
use crate::joint::{self, PassiveParams, StopParams};
use crate::observe::{self, Coordinates, LinkMass, Motion};
use crate::params::backlash_joints;
use crate::servo::{self, Envelope, Gains};
use crate::{EngineConfig, InitialState, LaneParams, SimError, State, Terrain};

/// What all lanes share.
pub(super) struct Shared {
    pub model: std::sync::Arc<RobotModel>,
    pub config: EngineConfig,
    pub terrain: std::sync::Arc<Terrain>,
}

/// Everything of one lane that changes while it runs, besides the Rapier world.
#[derive(Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct Memory {
    /// Friction bristle of each joint, rad. `[J]`
    pub bristle_rad: Vec<f32>,
    /// Commands that may not have reached the servos yet.
    pub history: CommandHistory,
    /// Velocity of the IMU point at the end of the last period, world, m/s.
    pub imu_vel_mps: [f64; 3],
    /// What was last reported.
    pub out: State,
}

/// One lane.
pub(super) struct Lane {
    pub params: LaneParams,
    pub world: PhysicsWorld,
    pub memory: Memory,
    handles: RobotHandles,
    masses: Vec<LinkMass>,
    /// `[A]`
    servos: Vec<(Envelope, Gains)>,
    /// `[J]`
    passive: Vec<PassiveParams>,
    /// Scratch, refilled in every period.
    at: Coordinates,
    motion: Motion,
    loads: Vec<Load>,
    sums: Sums,
}

/// Force and torque on one body, world, at its centre of mass.
#[derive(Clone, Copy, Default)]
struct Load {
    force_n: Vector,
    torque_nm: Vector,
}

/// A joint at the start of a physics step, and the motor torque it gets.
#[derive(Clone, Copy, Default)]
struct JointStep {
    q_rad: f32,
    qd_radps: f32,
    motor_nm: f32,
}

/// Sums over one control period.
#[derive(Default)]
struct Sums {
    /// ∫τ dt per motor, N·m·s.
    torque: Vec<f64>,
    /// Work per motor, J.
    work: Vec<f64>,
    contacts: ContactImpulses,
}

impl Lane {
    /// A lane in `init`.
    pub fn new(shared: &Shared, params: LaneParams, init: &InitialState) -> Result<Self, SimError> {
        let model = &*shared.model;
        let masses = observe::link_masses(model, &params);
        let (world, handles) =
            world::build(model, &shared.config, &params, &masses, &shared.terrain)?;
        let joints = model.joints().len();
        let servos = (0..model.actuated().len())
            .map(|a| {
                let envelope =
                    Envelope::new(model.servo(a), params.torque_scale[a], params.supply_v);
                let gains = Gains {
                    kp_nm_per_rad: params.kp_nm_per_rad[a],
                    kd_nms_per_rad: params.kd_nms_per_rad[a],
                };
                (envelope, gains)
            })
            .collect();
        let mut lane = Self {
            passive: passive_params(model, &params),
            loads: vec![Load::default(); handles.bodies.len()],
            memory: Memory {
                bristle_rad: vec![0.0; joints],
                history: CommandHistory::new(shared.config.control_period_s(), &init.joint_pos_rad),
                imu_vel_mps: [0.0; 3],
                out: State::zeros(1, joints, model.actuated().len(), model.feet().len()),
            },
            at: Coordinates::start(model, init)?,
            motion: Motion::default(),
            sums: Sums::default(),
            params,
            world,
            handles,
            masses,
            servos,
        };
        lane.at.world_from_base.pos_m[2] = start_height_m(shared, init, &lane.at)?;
        lane.set_armature(model);
        lane.place(shared)?;
        Ok(lane)
    }

    /// Rotor inertia of the actuated joints (the lane's), and of the others (the model's).
    fn set_armature(&mut self, model: &RobotModel) {
        let dofs = self.handles.dofs.clone();
        let armature: Vec<f32> = model
            .joints()
            .iter()
            .map(|j| match j.kind {
                JointKind::Actuated { index } => self.params.joint_armature_kgm2[index],
                JointKind::Passive | JointKind::Backlash => j.armature_kgm2 as f32,
            })
            .collect();
        if let Some(multibody) = self.multibody_mut() {
            for (dof, value) in dofs.iter().zip(armature) {
                if let Some(dof) = dof {
                    multibody.armature_mut()[dof.assembly] = value;
                }
            }
        }
    }

    /// Moves the freshly built robot (all joints at zero) to `self.at` and reports that state.
    fn place(&mut self, shared: &Shared) -> Result<(), SimError> {
        let root_offset = if self.handles.free_base {
            self.masses[0].com_m
        } else {
            [0.0; 3]
        };
        let root_pose = self
            .at
            .world_from_base
            .compose(&ModelPose::from_pos(root_offset));
        let root = self.handles.bodies[0];
        let arm = self.at.world_from_base.rotate(root_offset);
        let spin = caudata_model::pose::cross(self.at.base_angvel_radps, arm);
        let linvel = convert::vector(caudata_model::pose::add(self.at.base_vel_mps, spin));
        let angvel = convert::vector(self.at.base_angvel_radps);
        if let Some(body) = self.world.bodies.get_mut(root) {
            body.set_position(convert::pose(&root_pose), true);
            body.set_linvel(linvel, true);
            body.set_angvel(angvel, true);
        }
        if let Some(handle) = self.handles.multibody
            && let Some((multibody, _)) = self.world.multibody_joints.get_mut(handle)
        {
            let mut moves = vec![0.0; multibody.ndofs()];
            let mut speeds = vec![0.0; multibody.ndofs()];
            if self.handles.free_base {
                speeds[..3].copy_from_slice(&linvel.to_array());
                speeds[3..6].copy_from_slice(&angvel.to_array());
            }
            for (j, dof) in self.handles.dofs.iter().enumerate() {
                if let Some(dof) = dof {
                    moves[dof.assembly] = self.at.joint_pos_rad[j] as f32;
                    speeds[dof.assembly] = self.at.joint_vel_radps[j] as f32;
                }
            }
            multibody.apply_displacements(&moves);
            multibody
                .generalized_velocity_mut()
                .copy_from_slice(&speeds);
            multibody.forward_kinematics(&self.world.bodies, true);
            multibody.update_rigid_bodies(&mut self.world.bodies, true);
        }
        self.read_coordinates();
        self.memory.imu_vel_mps = self.report(shared)?;
        let standing = [0.0; 3];
        let out = &mut self.memory.out;
        observe::write_specific_force(
            out,
            0,
            &shared.model,
            &self.motion,
            self.params.gravity_mps2,
            standing,
            1.0,
        );
        Ok(())
    }

    /// One control period. A lane that breaks down keeps the state it last reported and stops.
    pub fn step(&mut self, shared: &Shared, targets_rad: &[f32], wrench: &[f32]) {
        if self.memory.out.diverged[0] {
            return;
        }
        let finite = targets_rad.iter().chain(wrench).all(|v| v.is_finite());
        if !finite || !self.run_period(shared, targets_rad, wrench) {
            self.memory.out.diverged[0] = true;
        }
    }

    /// Whether the period ended in a sound state, which is then reported.
    fn run_period(&mut self, shared: &Shared, targets_rad: &[f32], wrench: &[f32]) -> bool {
        let config = &shared.config;
        self.memory.history.push(targets_rad);
        self.sums
            .clear(self.servos.len(), shared.model.feet().len());
        for substep in 0..config.substeps {
            self.substep(shared, f64::from(substep) * config.dt_s, wrench);
            if !self.is_sound(config) {
                return false;
            }
        }
        self.read_coordinates();
        let before = self.memory.out.clone();
        let reported = self.report(shared);
        let Ok(imu_vel) = reported else {
            return false;
        };
        let period = config.control_period_s();
        let change = caudata_model::pose::sub(imu_vel, self.memory.imu_vel_mps);
        self.memory.imu_vel_mps = imu_vel;
        let out = &mut self.memory.out;
        observe::write_specific_force(
            out,
            0,
            &shared.model,
            &self.motion,
            self.params.gravity_mps2,
            change,
            period,
        );
        self.sums.write(out, period);
        let sound = out.is_finite();
        if !sound {
            *out = before;
        }
        sound
    }

    fn substep(&mut self, shared: &Shared, since_command_s: f64, wrench: &[f32]) {
        self.loads.fill(Load::default());
        let torso = self.handles.links[shared.model.torso_link()];
        self.loads[torso].force_n += Vector::from_slice(&wrench[..3]);
        self.loads[torso].torque_nm += Vector::from_slice(&wrench[3..6]);
        let before = self.load_joints(shared, since_command_s);
        for (&handle, load) in self.handles.bodies.iter().zip(&self.loads) {
            if let Some(body) = self.world.bodies.get_mut(handle) {
                body.reset_forces(false);
                body.reset_torques(false);
                body.add_force(load.force_n, false);
                body.add_torque(load.torque_nm, false);
            }
        }
        self.world.step();
        self.sums.contacts.add(&self.world);
        self.account_motion(shared, &before);
    }

    /// Applies servo and passive torques of every joint for the coming step. Returns where each joint starts.
    fn load_joints(&mut self, shared: &Shared, since_command_s: f64) -> Vec<JointStep> {
        let config = &shared.config;
        let stop = StopParams {
            stiffness_nm_per_rad: config.stop_stiffness_nm_per_rad as f32,
            damping_nms_per_rad: config.stop_damping_nms_per_rad as f32,
        };
        let mut joints = vec![JointStep::default(); self.handles.dofs.len()];
        let Some(handle) = self.handles.multibody else {
            return joints;
        };
        let Some((multibody, _)) = self.world.multibody_joints.get_mut(handle) else {
            return joints;
        };
        for (j, joint) in shared.model.joints().iter().enumerate() {
            let Some(dof) = self.handles.dofs[j] else {
                continue;
            };
            let (q, qd) = read_dof(multibody, &dof);
            let motor = match joint.kind {
                JointKind::Actuated { index } => {
                    let (envelope, gains) = &self.servos[index];
                    let delay = f64::from(self.params.command_delay_s);
                    let period = config.control_period_s();
                    let target = self.memory.history.delayed(
                        index,
                        delay,
                        period,
                        since_command_s,
                        config.dt_s,
                    );
                    servo::torque_nm(envelope, *gains, q, qd, target)
                }
                JointKind::Passive | JointKind::Backlash => 0.0,
            };
            let bristle = self.memory.bristle_rad[j];
            let stop = if joint.motion == JointMotion::Slide {
                stop.times(SLIDE_STOP_FACTOR)
            } else {
                stop
            };
            let passive =
                joint::passive_torque(&self.passive[j], stop, q, qd, bristle, config.dt_s as f32);
            multibody.damping_mut()[dof.assembly] = passive.damping_nms_per_rad;
            let Some(link) = multibody.link_mut(dof.link) else {
                continue;
            };
            link.joint
                .set_spring(dof.axis, passive.stiffness_nm_per_rad, passive.rest_rad);
            let frame = *link.local_to_world() * link.joint.data.local_frame2;
            let axis = frame.rotation * Vector::X;
            apply_pair(
                &mut self.loads,
                &dof,
                &frame,
                axis * (motor + passive.constant_nm),
                &self.world.bodies,
                &self.handles.bodies,
            );
            joints[j] = JointStep {
                q_rad: q,
                qd_radps: qd,
                motor_nm: motor,
            };
        }
        joints
    }

    /// After a step: drags the friction bristles and sums motor torque and work. `before`: see [`Self::load_joints`].
    fn account_motion(&mut self, shared: &Shared, before: &[JointStep]) {
        let Some(handle) = self.handles.multibody else {
            return;
        };
        let Some((multibody, _)) = self.world.multibody_joints.get(handle) else {
            return;
        };
        for (j, joint) in shared.model.joints().iter().enumerate() {
            let Some(dof) = &self.handles.dofs[j] else {
                continue;
            };
            let (start, (q, qd)) = (&before[j], read_dof(multibody, dof));
            self.memory.bristle_rad[j] =
                joint::drag_bristle(self.memory.bristle_rad[j], q - start.q_rad);
            if let JointKind::Actuated { index } = joint.kind {
                let impulse = f64::from(start.motor_nm) * shared.config.dt_s;
                self.sums.torque[index] += impulse;
                // Mean speed, not way moved: an Euler step moves by its final speed, which would count τ²·dt²/2I twice.
                self.sums.work[index] += impulse * 0.5 * f64::from(start.qd_radps + qd);
            }
        }
    }

    /// Whether speeds are finite and sane, and Rapier has not taken a body out.
    fn is_sound(&self, config: &EngineConfig) -> bool {
        let (joint_limit, base_limit) = (
            config.max_joint_speed_radps as f32,
            config.max_base_speed_mps as f32,
        );
        let below = |limit: f32, v: f32| v.abs() <= limit; // false for not-a-number
        let joints = self.multibody().is_none_or(|m| {
            let speed = m.generalized_velocity();
            self.handles
                .dofs
                .iter()
                .flatten()
                .all(|d| below(joint_limit, speed[d.assembly]))
        });
        let (linvel, angvel) = self.root_velocity();
        let base = linvel.to_array().iter().all(|&v| below(base_limit, v))
            && angvel.to_array().iter().all(|&v| below(joint_limit, v));
        joints && base && self.world.quarantine().is_empty()
    }

    /// Velocity of the free root body's centre of mass and its angular velocity, world; zero for a held base.
    fn root_velocity(&self) -> (Vector, Vector) {
        if !self.handles.free_base {
            return (Vector::ZERO, Vector::ZERO);
        }
        if let Some(multibody) = self.multibody() {
            // the body's own velocity fields lag behind by the solver's last pass
            let v = multibody.generalized_velocity();
            return (Vector::new(v[0], v[1], v[2]), Vector::new(v[3], v[4], v[5]));
        }
        self.world
            .bodies
            .get(self.handles.bodies[0])
            .map_or((Vector::ZERO, Vector::ZERO), |b| (b.linvel(), b.angvel()))
    }

    /// Fills `self.at` from the world.
    fn read_coordinates(&mut self) {
        if self.handles.free_base
            && let Some(body) = self.world.bodies.get(self.handles.bodies[0])
        {
            let com = self.masses[0].com_m;
            let pose =
                convert::model_pose(body.position()).compose(&ModelPose::from_pos(com.map(|c| -c)));
            let (linvel, angvel) = self.root_velocity();
            let (linvel, angvel) = (convert::array(linvel), convert::array(angvel));
            let arm = pose.rotate(com);
            self.at.base_vel_mps =
                caudata_model::pose::sub(linvel, caudata_model::pose::cross(angvel, arm));
            self.at.base_angvel_radps = angvel;
            self.at.world_from_base = pose;
        }
        let Some(handle) = self.handles.multibody else {
            return;
        };
        let Some((multibody, _)) = self.world.multibody_joints.get(handle) else {
            return;
        };
        for (j, dof) in self.handles.dofs.iter().enumerate() {
            if let Some(dof) = dof {
                let (q, qd) = read_dof(multibody, dof);
                self.at.joint_pos_rad[j] = f64::from(q);
                self.at.joint_vel_radps[j] = f64::from(qd);
            }
        }
    }

    /// Writes the kinematic fields of the report. Returns the IMU point's velocity.
    fn report(&mut self, shared: &Shared) -> Result<[f64; 3], SimError> {
        let model = &*shared.model;
        self.motion
            .update(model, &self.at)
            .map_err(|e| SimError::Model(e.to_string()))?;
        let out = &mut self.memory.out;
        let gravity = self.params.gravity_mps2;
        Ok(observe::write_kinematics(
            out,
            0,
            model,
            &self.masses,
            &shared.terrain,
            gravity,
            &self.at,
            &self.motion,
        ))
    }

    /// Takes over other parameters where the robot is: positions, velocities, commands under way and friction bristles stay, contact
    /// memory does not.
    pub fn rebuild(&mut self, shared: &Shared, params: LaneParams) -> Result<(), SimError> {
        let mut lane = Self::new(shared, params, &InitialState::nominal(&shared.model))?;
        if self.memory.out.diverged[0] {
            lane.memory = self.memory.clone(); // nothing to carry over; it waits for its reset
            *self = lane;
            return Ok(());
        }
        self.read_coordinates();
        lane.at = self.at.clone();
        lane.place(shared)?;
        let imu_vel_mps = lane.memory.imu_vel_mps;
        lane.memory = Memory {
            imu_vel_mps,
            ..self.memory.clone()
        };
        *self = lane;
        Ok(())
    }

    fn multibody(&self) -> Option<&Multibody> {
        self.world
            .multibody_joints
            .get(self.handles.multibody?)
            .map(|(m, _)| m)
    }

    fn multibody_mut(&mut self) -> Option<&mut Multibody> {
        self.world
            .multibody_joints
            .get_mut(self.handles.multibody?)
            .map(|(m, _)| m)
    }
}

/// Position and velocity of a joint.
fn read_dof(multibody: &Multibody, dof: &Dof) -> (f32, f32) {
    let q = multibody
        .link(dof.link)
        .map_or(0.0, |l| l.joint().coords()[dof.axis]);
    (q, multibody.generalized_velocity()[dof.assembly])
}

/// Puts a joint's effort (along its axis, world) on the body it carries and its opposite on the other one.
fn apply_pair(
    loads: &mut [Load],
    dof: &Dof,
    frame: &Pose,
    effort: Vector,
    bodies: &RigidBodySet,
    handles: &[RigidBodyHandle],
) {
    if dof.axis >= 3 {
        loads[dof.child].torque_nm += effort;
        loads[dof.parent].torque_nm -= effort;
        return;
    }
    // A force pair must act along one line, else it turns the robot.
    for (body, force) in [(dof.child, effort), (dof.parent, -effort)] {
        let com = bodies
            .get(handles[body])
            .map_or(frame.translation, |b| b.center_of_mass());
        loads[body].force_n += force;
        loads[body].torque_nm += (frame.translation - com).cross(force);
    }
}

fn passive_params(model: &RobotModel, params: &LaneParams) -> Vec<PassiveParams> {
    let mut all: Vec<PassiveParams> = model
        .joints()
        .iter()
        .map(|j| {
            let range = j
                .range_rad
                .map_or((f32::NEG_INFINITY, f32::INFINITY), |(l, h)| {
                    (l as f32, h as f32)
                });
            let (damping, friction) = match j.kind {
                JointKind::Actuated { index } => (
                    params.joint_damping_nms_per_rad[index],
                    params.joint_friction_nm[index],
                ),
                JointKind::Passive | JointKind::Backlash => {
                    (j.damping_nm_s_per_rad as f32, j.friction_loss_nm as f32)
                }
            };
            PassiveParams {
                stiffness_nm_per_rad: j.stiffness_nm_per_rad as f32,
                spring_ref_rad: j.spring_ref_rad as f32,
                damping_nms_per_rad: damping,
                friction_nm: friction,
                range_rad: range,
            }
        })
        .collect();
    for (j, &half) in backlash_joints(model).zip(&params.backlash_half_width_rad) {
        all[j].range_rad = (-half, half);
    }
    all
}

/// A slide's end stop in N/m per N·m/rad of a hinge's: the same stop met at a lever of 0.1 m.
const SLIDE_STOP_FACTOR: f32 = 100.0;

/// How high above touching height a held robot hangs unless told otherwise, m.
const HELD_CLEARANCE_M: f64 = 0.2;

/// Height of the base link's origin that `init` asks for.
fn start_height_m(shared: &Shared, init: &InitialState, at: &Coordinates) -> Result<f64, SimError> {
    use caudata_model::BaseKind;
    if let Some(z) = init.base_z_m {
        return Ok(f64::from(z));
    }
    if shared.model.base() == BaseKind::Fixed {
        return Ok(0.0); // where the model puts it
    }
    let touching = observe::touching_height_m(&shared.model, &shared.terrain, at)?;
    Ok(touching
        + if shared.config.fixed_base {
            HELD_CLEARANCE_M
        } else {
            0.0
        })
}

impl Sums {
    fn clear(&mut self, motors: usize, feet: usize) {
        self.torque.clear();
        self.torque.resize(motors, 0.0);
        self.work.clear();
        self.work.resize(motors, 0.0);
        self.contacts.clear(feet);
    }

    /// Means over a period of `period_s`.
    fn write(&self, out: &mut State, period_s: f64) {
        let mean = |to: &mut [f32], from: &[f64]| {
            for (slot, sum) in to.iter_mut().zip(from) {
                *slot = (sum / period_s) as f32;
            }
        };
        mean(&mut out.motor_torque_nm, &self.torque);
        mean(&mut out.mech_power_w, &self.work);
        mean(&mut out.foot_force_n, &self.contacts.feet_ns);
        mean(&mut out.trunk_force_n, &[self.contacts.trunk_ns]);
    }
}
