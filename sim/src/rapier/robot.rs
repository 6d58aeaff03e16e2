//! The robot in its Rapier world: reading and writing its coordinates, loading its joints, stepping.

use caudata_model::pose::{add, cross, sub};
use caudata_model::{JointKind, Pose as ModelPose};
use rapier3d::math::{Matrix, Vector};
use rapier3d::prelude::*;

use super::convert;
use super::friction::{Friction, Grip, Owed, Skin, Slide};
use super::shared::Shared;
use super::world::{self, RobotHandles};
use crate::drive::lane::{JointState, Joints};
use crate::drive::{ImplicitTorque, ServoDrive};
use crate::observe::{Coordinates, LinkMass};
use crate::water::LinkMotion;
use crate::{EngineConfig, LaneParams, SimError};

/// One robot in one world.
pub(super) struct Robot {
    /// Public for snapshots only.
    pub world: PhysicsWorld,
    handles: RobotHandles,
    /// Centre of mass of a free root link in its own frame (its body's origin); 0 for a held base, m.
    root_com_m: [f64; 3],
    /// One per body, for the coming step.
    loads: Vec<Load>,
    skin: Skin,
    /// Rotor inertia of each joint, model order, kg·m² (the stops' inertia comes on top).
    armature_kgm2: Vec<f32>,
}

/// Force and torque on one body, world, at its centre of mass.
#[derive(Clone, Copy, Default)]
struct Load {
    force_n: Vector,
    torque_nm: Vector,
}

impl Robot {
    /// Builds the world, all joints at zero.
    pub fn new(
        shared: &Shared,
        params: &LaneParams,
        servos: &[ServoDrive<f64>],
        masses: &[LinkMass],
    ) -> Result<Self, SimError> {
        let (world, handles) = world::build(shared, params, masses)?;
        let armature_kgm2 = (shared.rig.model.joints().iter())
            .map(|joint| match joint.kind {
                JointKind::Actuated { index } => servos[index].armature_kgm2() as f32,
                JointKind::Passive | JointKind::Backlash => joint.armature_kgm2 as f32,
            })
            .collect();
        let mass_kg: f64 = masses.iter().map(|m| m.mass_kg).sum();
        let skin = Skin::new(&world, mass_kg as f32, |body| {
            let mut links = handles.links.iter().zip(&shared.mobility_per_kg);
            links
                .find(|(link, _)| handles.bodies[**link] == body)
                .map_or(0.0, |(_, give)| *give as f32)
        });
        Ok(Self {
            root_com_m: if handles.free_base { masses[0].com_m } else { [0.0; 3] },
            loads: vec![Load::default(); handles.bodies.len()],
            skin,
            world,
            handles,
            armature_kgm2,
        })
    }

    /// Moves a freshly built robot (all joints at zero) to `at`.
    pub fn place(&mut self, at: &Coordinates) {
        let Self { world, handles, root_com_m, .. } = self;
        let root_pose = at.world_from_base.compose(&ModelPose::from_pos(*root_com_m));
        let arm = at.world_from_base.rotate(*root_com_m);
        let linvel = convert::vector(add(at.base_vel_mps, cross(at.base_angvel_radps, arm)));
        let angvel = convert::vector(at.base_angvel_radps);
        if let Some(root) = world.bodies.get_mut(handles.bodies[0]) {
            root.set_position(convert::pose(&root_pose), true);
        }
        let Some((multibody, _)) = world.multibody_joints.get_mut(handles.multibody) else {
            return;
        };
        let mut moves = vec![0.0; multibody.ndofs()];
        let mut speeds = vec![0.0; multibody.ndofs()];
        if handles.free_base {
            speeds[..3].copy_from_slice(&linvel.to_array());
            speeds[3..6].copy_from_slice(&angvel.to_array());
        }
        for (j, dof) in handles.dofs.iter().enumerate() {
            if let Some(dof) = dof {
                moves[dof.assembly] = at.joint_pos_rad[j] as f32;
                speeds[dof.assembly] = at.joint_vel_radps[j] as f32;
            }
        }
        multibody.apply_displacements(&moves);
        multibody.generalized_velocity_mut().copy_from_slice(&speeds);
        multibody.forward_kinematics(&world.bodies, true);
        multibody.update_rigid_bodies(&mut world.bodies, true);
    }

    /// Fills `at` from the world; what cannot move (a held base, locked joints) is left as it is.
    pub fn read(&self, at: &mut Coordinates) {
        if self.handles.free_base
            && let Some(root) = self.world.bodies.get(self.handles.bodies[0])
        {
            let back = ModelPose::from_pos(self.root_com_m.map(|c| -c));
            at.world_from_base = convert::model_pose(root.position()).compose(&back);
            let (linvel, angvel) = self.root_velocity();
            let (linvel, angvel) = (convert::array(linvel), convert::array(angvel));
            let arm = at.world_from_base.rotate(self.root_com_m);
            at.base_vel_mps = sub(linvel, cross(angvel, arm));
            at.base_angvel_radps = angvel;
        }
        for j in 0..self.handles.dofs.len() {
            if let Some(state) = self.joint(j) {
                at.joint_pos_rad[j] = f64::from(state.pos);
                at.joint_vel_radps[j] = f64::from(state.vel);
            }
        }
    }

    /// Where link `link` (whose centre of mass is at `com_m` in its frame) is and how it moves; `None` for a
    /// body Rapier has lost.
    pub fn link_motion(&self, link: usize, com_m: [f32; 3]) -> Option<LinkMotion<f32>> {
        let handle = self.handles.bodies[self.handles.links[link]];
        let body = self.world.bodies.get(handle)?;
        let columns = Matrix::from_quat(body.position().rotation).transpose();
        let rotation = columns.to_cols_array_2d();
        let com = body.position().translation;
        let lever = Vector::from_array(rotation[2]).dot(Vector::from_array(com_m));
        Some(LinkMotion {
            rotation,
            origin_z_m: com.z - lever,
            com_vel_mps: body.linvel().to_array(),
            angvel_radps: body.angvel().to_array(),
        })
    }

    /// Gives a link's body other mass properties (about its origin, the centre of mass).
    pub fn set_mass(&mut self, link: usize, mass: MassProperties) {
        let handle = self.handles.bodies[self.handles.links[link]];
        if let Some(body) = self.world.bodies.get_mut(handle) {
            body.set_additional_mass_properties(mass, false);
        }
    }

    /// Takes every load off.
    pub fn clear_loads(&mut self) {
        self.loads.fill(Load::default());
    }

    /// Adds a force and torque (world, at the centre of mass; `[6]`) on a link for the coming step.
    pub fn push_link(&mut self, link: usize, wrench: &[f32]) {
        let load = &mut self.loads[self.handles.links[link]];
        load.force_n += Vector::from_slice(&wrench[..3]);
        load.torque_nm += Vector::from_slice(&wrench[3..6]);
    }

    /// One physics step under the loads.
    pub fn step(&mut self, grip: &Grip, owed: &mut Owed) {
        self.skin.find_slides(&self.world, grip, owed);
        for (&handle, load) in self.handles.bodies.iter().zip(&self.loads) {
            if let Some(body) = self.world.bodies.get_mut(handle) {
                body.reset_forces(false);
                body.reset_torques(false);
                body.add_force(load.force_n, false);
                body.add_torque(load.torque_nm, false);
            }
        }
        for slide in self.skin.slides() {
            if let Some(body) = self.world.bodies.get_mut(slide.body) {
                body.add_force(slide.force_n, false);
                body.add_torque(slide.arm_m.cross(slide.force_n), false);
            }
        }
        let friction = Friction { grip, slides: self.skin.slides() };
        self.world.step_with_events(&friction, &());
    }

    /// What slid in the last step.
    pub fn slides(&self) -> &[Slide] {
        self.skin.slides()
    }

    /// Whether speeds are finite and sane, and Rapier has not taken a body out.
    pub fn is_sound(&self, config: &EngineConfig) -> bool {
        let joint_limit = config.max_joint_speed_radps as f32;
        let base_limit = config.max_base_speed_mps as f32;
        let (linvel, angvel) = self.root_velocity();
        // each comparison is false for not-a-number
        self.world.quarantine().is_empty()
            && linvel.to_array().iter().all(|v| v.abs() <= base_limit)
            && angvel.to_array().iter().all(|v| v.abs() <= joint_limit)
            && (0..self.handles.dofs.len())
                .all(|j| self.joint(j).is_none_or(|s| s.vel.abs() <= joint_limit))
    }

    /// Velocity of a free root's centre of mass and its angular velocity, world; zero for a held base.
    fn root_velocity(&self) -> (Vector, Vector) {
        match self.multibody() {
            // The body's own velocity fields are those at the start of the last step.
            Some(multibody) if self.handles.free_base => {
                let v = multibody.generalized_velocity();
                (Vector::new(v[0], v[1], v[2]), Vector::new(v[3], v[4], v[5]))
            }
            _ => (Vector::ZERO, Vector::ZERO),
        }
    }

    fn multibody(&self) -> Option<&Multibody> {
        self.world.multibody_joints.get(self.handles.multibody).map(|(m, _)| m)
    }
}

impl Joints for Robot {
    fn joint(&self, j: usize) -> Option<JointState> {
        let dof = self.handles.dofs[j].as_ref()?;
        let multibody = self.multibody()?;
        Some(JointState {
            pos: multibody.link(dof.link)?.joint().coords()[dof.axis],
            vel: multibody.generalized_velocity()[dof.assembly],
        })
    }

    /// Spring and damper implicitly, the rest as it is.
    fn load_joint(&mut self, j: usize, torque: &ImplicitTorque<f32>, _motor_nm: f32) {
        let Self { world, handles, loads, armature_kgm2, .. } = self;
        let Some(dof) = handles.dofs[j] else { return };
        let Some(multibody) = multibody_mut(world, handles) else { return };
        multibody.damping_mut()[dof.assembly] = torque.damping_nms_per_rad;
        multibody.armature_mut()[dof.assembly] = armature_kgm2[j] + torque.inertia_kgm2;
        let Some(link) = multibody.link_mut(dof.link) else { return };
        // Relaxed where the joint is now: what the spring gives there already is in the constant part.
        let here = link.joint.coords()[dof.axis];
        link.joint.set_spring(dof.axis, torque.stiffness_nm_per_rad, here);
        let frame = *link.local_to_world() * link.joint.data.local_frame2;
        let along_axis = frame.rotation * Vector::X * torque.now_nm;
        for (body, sign) in [(dof.child, 1.0), (dof.parent, -1.0)] {
            if dof.is_hinge() {
                loads[body].torque_nm += along_axis * sign;
                continue;
            }
            // A force pair must act along one line, else it turns the robot.
            let com = world
                .bodies
                .get(handles.bodies[body])
                .map_or(frame.translation, |b| b.center_of_mass());
            loads[body].force_n += along_axis * sign;
            loads[body].torque_nm += (frame.translation - com).cross(along_axis * sign);
        }
    }
}

fn multibody_mut<'a>(
    world: &'a mut PhysicsWorld,
    handles: &RobotHandles,
) -> Option<&'a mut Multibody> {
    world.multibody_joints.get_mut(handles.multibody).map(|(m, _)| m)
}
