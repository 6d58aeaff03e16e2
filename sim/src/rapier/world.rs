//! Builds one lane's Rapier world: the robot as one multibody, and the ground.
//!
//! Each link is a rigid body whose frame is the link's frame moved to its centre of mass. (Rapier integrates
//! a free root's *origin* with the velocity of its *centre of mass*, so the two must coincide.) A link with
//! several joints hangs on massless bodies, one less than it has joints: the reduced-coordinates mass matrix
//! only needs the masses beyond each joint. Welded links and locked joints are joints without degrees of
//! freedom.

use caudata_model::pose::sub;
use caudata_model::{BaseKind, Geom, JointMotion, Link, Pose as ModelPose, RobotModel, Shape};
use rapier3d::math::{Pose, Real, Rotation, Vector};
use rapier3d::prelude::*;

use super::convert;
use super::shared::Shared;
use super::tags::{GROUND_TAG, TAIL_TAG, TRUNK_TAG, foot_tag};
use crate::observe::LinkMass;
use crate::self_contact;
use crate::terrain::APRON_DROP_M;
use crate::{EngineConfig, LaneParams, SimError, Terrain};

/// Collision group of the robot.
const ROBOT: Group = Group::GROUP_1;
/// Collision group of the ground.
const GROUND: Group = Group::GROUP_2;
/// Collision group of the trunk, where the robot can touch itself.
const TRUNK: Group = Group::GROUP_3;
/// First of the collision groups of legs.
const FIRST_LEG: u32 = 3;
/// Most legs that have a group of their own.
const MAX_LEGS: usize = 28;
/// Collision group of the leg with foot `foot`.
fn leg_group(foot: usize) -> Group {
    Group::from_bits_truncate(1 << (FIRST_LEG + (foot % MAX_LEGS) as u32))
}

/// Where one model joint is in the multibody; `None` for a locked joint.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dof {
    /// Link of the multibody whose joint this is.
    pub link: usize,
    /// Rapier's axis number: 0 for a slide along x, 3 for a turn about x.
    pub axis: usize,
    /// Index in the generalised vectors.
    pub assembly: usize,
    /// Body that the joint carries, as an index into [`RobotHandles::bodies`].
    pub child: usize,
    /// Body it reacts against, likewise.
    pub parent: usize,
}

impl Dof {
    /// Whether it turns (else it slides).
    pub fn is_hinge(&self) -> bool {
        self.axis >= 3
    }
}

/// What the lane needs to find its way in the world it built.
pub(super) struct RobotHandles {
    /// Every body of the robot, massless ones and a fixed base's anchor included.
    pub bodies: Vec<RigidBodyHandle>,
    /// Body of each link, as an index into `bodies`.
    pub links: Vec<usize>,
    /// `[J]`, model order.
    pub dofs: Vec<Option<Dof>>,
    /// A joint of the multibody, which stands for it.
    pub multibody: MultibodyJointHandle,
    /// Whether the base moves freely.
    pub free_base: bool,
}

/// A world with the ground and the robot, all joints at zero.
pub(super) fn build(
    shared: &Shared,
    params: &LaneParams,
    masses: &[LinkMass],
) -> Result<(PhysicsWorld, RobotHandles), SimError> {
    let mut world = PhysicsWorld {
        gravity: Vector::from_array(params.gravity_mps2),
        integration_parameters: integration_parameters(&shared.rig.config),
        ..PhysicsWorld::default()
    };
    insert_ground(&mut world, shared);
    let legs = self_contact::legs(&shared.rig.model);
    let handles = Builder {
        hanging: self_contact::hanging_legs(&shared.rig.model, &legs),
        legs,
        world: &mut world,
        model: &shared.rig.model,
        config: &shared.rig.config,
        params,
        masses,
    }
    .insert_robot()?;
    Ok((world, handles))
}

fn integration_parameters(config: &EngineConfig) -> IntegrationParameters {
    let softness = SpringCoefficients::new(
        config.contact_frequency_hz as Real,
        config.contact_damping_ratio as Real,
    );
    IntegrationParameters {
        dt: config.dt_s as Real,
        num_solver_iterations: config.solver_iterations as usize,
        contact_softness: softness,
        static_contact_softness: softness,
        normalized_prediction_distance: config.contact_margin_m as Real,
        // A foot at 3 m/s moves 12 mm in a step of 4 ms: less than its radius.
        max_ccd_substeps: 0,
        // Friction otherwise only acts after positions have moved; with one iteration per step that lets feet
        // slip: this brings the travel of an open-loop trot at 4 ms from 6 % below its small-step limit to 3
        // %, at 10 ms from 19 % to 9 %.
        friction_in_bias_pass: true,
        // Recycled contacts lag behind rolling feet; and a ball has one contact, so there is nothing to
        // merge.
        contact_recycling: false,
        contact_clustering: false,
        ..IntegrationParameters::default()
    }
}

fn insert_ground(world: &mut PhysicsWorld, shared: &Shared) {
    // The robot's own coefficient counts (the larger one wins, the ground has none).
    let finish = |builder: ColliderBuilder| {
        builder
            .friction(0.0)
            .friction_combine_rule(CoefficientCombineRule::Max)
            .restitution(0.0)
            .active_hooks(ActiveHooks::MODIFY_SOLVER_CONTACTS)
            .collision_groups(InteractionGroups::new(GROUND, ROBOT, InteractionTestMode::And))
            .user_data(GROUND_TAG)
    };
    let plane = |z: f64| {
        finish(ColliderBuilder::new(SharedShape::halfspace(Vector::Z)))
            .position(Pose::from_translation(Vector::new(0.0, 0.0, z as f32)))
    };
    let Some(shape) = &shared.ground else {
        world.colliders.insert(plane(0.0));
        return;
    };
    let upright = Rotation::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let field = finish(ColliderBuilder::new(shape.clone())).position(Pose::from_rotation(upright));
    world.colliders.insert(field);
    world.colliders.insert(plane(-APRON_DROP_M));
}

/// The terrain's height field as Rapier has it: in x–z with y up, rows along z. Turned by 90° about x, its
/// rows run against our y.
pub(super) fn height_field(terrain: &Terrain) -> Option<SharedShape> {
    let grid = terrain.grid()?;
    let n = grid.points();
    let mut heights = Array2::zeros(n, n);
    for iy in 0..n {
        for ix in 0..n {
            heights[(n - 1 - iy, ix)] = grid.at(ix, iy);
        }
    }
    let size = grid.size_m() as Real;
    Some(SharedShape::heightfield(heights, Vector::new(size, 1.0, size)))
}

struct Builder<'a> {
    world: &'a mut PhysicsWorld,
    model: &'a RobotModel,
    config: &'a EngineConfig,
    params: &'a LaneParams,
    masses: &'a [LinkMass],
    /// See [`self_contact`].
    legs: Vec<Option<usize>>,
    hanging: Vec<Vec<usize>>,
}

impl Builder<'_> {
    fn insert_robot(mut self) -> Result<RobotHandles, SimError> {
        let free_base = self.config.frees_base(self.model);
        let mut handles = RobotHandles {
            bodies: Vec::new(),
            links: Vec::new(),
            dofs: vec![None; self.model.joints().len()],
            multibody: MultibodyJointHandle::invalid(),
            free_base,
        };
        for (i, link) in self.model.links().iter().enumerate() {
            let body = match link.parent {
                Some(p) => {
                    let from = (handles.links[p], self.masses[p].com_m);
                    self.insert_chain(&mut handles, i, from, &link.parent_from_link)?
                }
                None => self.insert_root(&mut handles, i, link)?,
            };
            handles.links.push(body);
            for (g, geom) in link.geoms.iter().enumerate().filter(|(_, g)| g.collides()) {
                self.insert_geom(i, g, geom, handles.bodies[body]);
            }
        }
        self.assign_dofs(&mut handles)?;
        Ok(handles)
    }

    /// Inserts the root link; a held one hangs on a fixed anchor at the world's origin.
    fn insert_root(
        &mut self,
        handles: &mut RobotHandles,
        i: usize,
        link: &Link,
    ) -> Result<usize, SimError> {
        if handles.free_base {
            let at = Pose::from_translation(convert::vector(self.masses[i].com_m));
            return Ok(self.insert_body(handles, self.link_body(i).pose(at)));
        }
        let anchor = self.insert_body(handles, RigidBodyBuilder::fixed());
        let placed = match self.model.base() {
            BaseKind::Free => ModelPose::IDENTITY,
            BaseKind::Fixed => link.parent_from_link,
        };
        self.insert_chain(handles, i, (anchor, [0.0; 3]), &placed)
    }

    /// Inserts link `i` and the joints that carry it. `from`: body on the parent side and its centre of mass
    /// in the parent link's frame.
    fn insert_chain(
        &mut self,
        handles: &mut RobotHandles,
        i: usize,
        from: (usize, [f64; 3]),
        parent_from_link: &ModelPose,
    ) -> Result<usize, SimError> {
        let joints: Vec<usize> = self.model.links()[i]
            .joints
            .iter()
            .copied()
            .filter(|&j| !self.config.holds(&self.model.joints()[j]))
            .collect();
        let (mut parent, parent_com) = from;
        // Placement of the current frame in the parent body's frame, before the joint moves.
        let mut placed = ModelPose::from_pos(parent_com.map(|c| -c)).compose(parent_from_link);
        for (k, slot) in
            joints.iter().map(Some).chain(joints.is_empty().then_some(None)).enumerate()
        {
            let last = k + 1 >= joints.len();
            let com = if last { self.masses[i].com_m } else { [0.0; 3] };
            let builder = if last { self.link_body(i) } else { massless_body() };
            let child = self.insert_body(handles, builder);
            let joint = match slot {
                Some(&j) => self.moving_joint(j, &placed, com),
                None => welded_joint(&placed, com),
            };
            let handle = self
                .world
                .multibody_joints
                .insert(handles.bodies[parent], handles.bodies[child], joint, true)
                .ok_or_else(|| {
                    SimError::Model(format!(
                        "link {} cannot be joined to its parent",
                        self.model.links()[i].name
                    ))
                })?;
            handles.multibody = handle;
            if let Some(&j) = slot {
                let axis = match self.model.joints()[j].motion {
                    JointMotion::Slide => 0,
                    JointMotion::Hinge => 3,
                };
                handles.dofs[j] = Some(Dof { link: 0, axis, assembly: 0, child, parent });
            }
            parent = child;
            placed = ModelPose::IDENTITY;
        }
        Ok(parent)
    }

    fn insert_body(&mut self, handles: &mut RobotHandles, body: RigidBodyBuilder) -> usize {
        handles.bodies.push(self.world.bodies.insert(body));
        handles.bodies.len() - 1
    }

    /// Joint `j` between a body in which the link's frame is at `placed` and a body whose origin is at
    /// `com_m` in that frame.
    fn moving_joint(&self, j: usize, placed: &ModelPose, com_m: [f64; 3]) -> GenericJoint {
        let joint = &self.model.joints()[j];
        let axis = convert::rotation_from_x(joint.axis);
        let locked = match joint.motion {
            JointMotion::Slide => JointAxesMask::LOCKED_PRISMATIC_AXES,
            JointMotion::Hinge => JointAxesMask::LOCKED_REVOLUTE_AXES,
        };
        let frame1 =
            convert::pose(placed) * Pose::from_parts(convert::vector(joint.anchor_m), axis);
        let frame2 = Pose::from_parts(convert::vector(sub(joint.anchor_m, com_m)), axis);
        GenericJointBuilder::new(locked)
            .local_frame1(frame1)
            .local_frame2(frame2)
            .contacts_enabled(false)
            .build()
    }

    fn link_body(&self, i: usize) -> RigidBodyBuilder {
        let m = &self.masses[i];
        body().additional_mass_properties(convert::mass_properties(m.mass_kg, &m.inertia_kgm2))
    }

    fn insert_geom(&mut self, link: usize, index: usize, geom: &Geom, body: RigidBodyHandle) {
        let foot = self.model.foot_of(link, index);
        let Some((shape, turn)) = collider_shape(geom.shape) else { return };
        let tag = match foot {
            Some(foot) => foot_tag(foot),
            None if self.model.carries_feet(link) => TRUNK_TAG,
            None => TAIL_TAG,
        };
        let in_body =
            ModelPose::from_pos(self.masses[link].com_m.map(|c| -c)).compose(&geom.link_from_geom);
        let collider = ColliderBuilder::new(shape)
            .position(convert::pose(&in_body) * Pose::from_rotation(turn))
            .density(0.0)
            .friction(match foot {
                Some(foot) => self.params.foot_friction * self.params.foot_friction_scale[foot],
                None => self.params.body_friction,
            })
            .friction_combine_rule(CoefficientCombineRule::Max)
            .restitution(0.0)
            .collision_groups(self.groups(link))
            .user_data(tag);
        self.world.colliders.insert_with_parent(collider, body, &mut self.world.bodies);
    }

    /// What the shapes of a link are, and what they touch.
    fn groups(&self, link: usize) -> InteractionGroups {
        let (own, others) = if self.config.self_collision {
            let every: Group = (0..self.model.feet().len()).map(leg_group).collect();
            match self.legs[link] {
                Some(leg) => (leg_group(leg), TRUNK | (every - leg_group(leg))),
                None => {
                    let hanging: Group =
                        self.hanging[link].iter().copied().map(leg_group).collect();
                    (TRUNK, every - hanging)
                }
            }
        } else {
            (Group::empty(), Group::empty())
        };
        InteractionGroups::new(ROBOT | own, GROUND | others, InteractionTestMode::And)
    }

    /// Settles the multibody (its root may only now turn out to be fixed) and looks up where each joint ended
    /// up.
    fn assign_dofs(&mut self, handles: &mut RobotHandles) -> Result<(), SimError> {
        let joints = &mut self.world.multibody_joints;
        for dof in handles.dofs.iter_mut().flatten() {
            if let Some(id) = joints.rigid_body_link(handles.bodies[dof.child]) {
                dof.link = id.id;
            }
        }
        let (multibody, _) = joints
            .get_mut(handles.multibody)
            .ok_or_else(|| SimError::Model("it has no joints".to_owned()))?;
        multibody.set_self_contacts_enabled(self.config.self_collision);
        multibody.forward_kinematics(&self.world.bodies, true);
        // Rapier gives angular degrees of freedom a damping of 0.1 by default.
        multibody.damping_mut().fill(0.0);
        for dof in handles.dofs.iter_mut().flatten() {
            if let Some(link) = multibody.link(dof.link) {
                dof.assembly = link.assembly_id();
            }
        }
        Ok(())
    }
}

fn body() -> RigidBodyBuilder {
    RigidBodyBuilder::dynamic().can_sleep(false).ccd_enabled(false)
}

fn massless_body() -> RigidBodyBuilder {
    body().additional_mass_properties(MassProperties::new(Vector::ZERO, 0.0, Vector::ZERO))
}

fn welded_joint(placed: &ModelPose, com_m: [f64; 3]) -> GenericJoint {
    let frame2 = Pose::from_translation(-convert::vector(com_m));
    GenericJointBuilder::new(JointAxesMask::LOCKED_FIXED_AXES)
        .local_frame1(convert::pose(placed))
        .local_frame2(frame2)
        .contacts_enabled(false)
        .build()
}

/// Rapier's shape, and how it is turned in ours (its cylinder stands along y). `None`: a plane, which only
/// the world can have.
fn collider_shape(shape: Shape) -> Option<(SharedShape, Rotation)> {
    let upright = Rotation::from_rotation_x(std::f32::consts::FRAC_PI_2);
    let as_is = Rotation::IDENTITY;
    Some(match shape {
        Shape::Sphere { radius_m } => (SharedShape::ball(radius_m as Real), as_is),
        Shape::Capsule { radius_m, half_length_m } => {
            (SharedShape::capsule_z(half_length_m as Real, radius_m as Real), as_is)
        }
        Shape::Cylinder { radius_m, half_length_m } => {
            (SharedShape::cylinder(half_length_m as Real, radius_m as Real), upright)
        }
        Shape::Box { half_size_m: [x, y, z] } => {
            (SharedShape::cuboid(x as Real, y as Real, z as Real), as_is)
        }
        Shape::Ellipsoid { semi_axes_m } => (ellipsoid(semi_axes_m)?, as_is),
        Shape::Plane => return None,
    })
}

/// Convex hull of points on the ellipsoid (within 2 % of it), since Rapier has no ellipsoid.
fn ellipsoid(semi_axes_m: [f64; 3]) -> Option<SharedShape> {
    const RINGS: u32 = 10;
    const SECTORS: u32 = 20;
    let mut points = Vec::new();
    for r in 0..=RINGS {
        let polar = std::f64::consts::PI * f64::from(r) / f64::from(RINGS);
        for s in 0..SECTORS {
            let azimuth = std::f64::consts::TAU * f64::from(s) / f64::from(SECTORS);
            let unit = [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()];
            points.push(convert::vector([0, 1, 2].map(|i| unit[i] * semi_axes_m[i])));
        }
    }
    SharedShape::convex_hull(&points)
}
