//! From minimal coordinates to everything [`State`] reports. Engine-independent, in f64.

use caudata_model::pose::{add, cross, dot, sub};
use caudata_model::{Ball, BaseKind, JointMotion, Kinematics, Pose, RobotModel};
use nalgebra::{Matrix3, Vector3};

use crate::{InitialState, LaneParams, Rig, SimError, State, Terrain};

/// Position and velocity of one robot.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Coordinates {
    /// world_from_base (for a fixed base: how far the whole robot is shifted from its place in the model).
    pub world_from_base: Pose,
    /// Velocity of the base link's origin, world, m/s.
    pub base_vel_mps: [f64; 3],
    /// Angular velocity of the base link, world, rad/s.
    pub base_angvel_radps: [f64; 3],
    /// Joint positions, model order, rad. `[J]`
    pub joint_pos_rad: Vec<f64>,
    /// Joint velocities, model order, rad/s. `[J]`
    pub joint_vel_radps: Vec<f64>,
}

/// Masses of one lane's links.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LinkMass {
    /// kg.
    pub mass_kg: f64,
    /// Centre of mass in the link frame, m.
    pub com_m: [f64; 3],
    /// About the centre of mass, link axes, kg·m².
    pub inertia_kgm2: Matrix3<f64>,
}

/// The model's link masses with the lane's scales, offsets and payload.
pub(crate) fn link_masses(model: &RobotModel, params: &LaneParams) -> Vec<LinkMass> {
    let mut all: Vec<LinkMass> = model
        .links()
        .iter()
        .enumerate()
        .map(|(i, link)| {
            let mass = f64::from(params.link_mass_scale[i]);
            let inertia = mass * f64::from(params.link_inertia_scale[i]);
            LinkMass {
                mass_kg: link.mass_kg * mass,
                com_m: add(link.com_m, params.com_offset_m[i].map(f64::from)),
                inertia_kgm2: Matrix3::from_fn(|r, c| link.inertia_kgm2[r][c]) * inertia,
            }
        })
        .collect();
    if params.payload_kg > 0.0 {
        let torso = &mut all[model.torso_link()];
        *torso =
            with_point_mass(torso, f64::from(params.payload_kg), params.payload_m.map(f64::from));
    }
    all
}

/// A link with a point mass fixed to it.
fn with_point_mass(link: &LinkMass, mass_kg: f64, at_m: [f64; 3]) -> LinkMass {
    let total = link.mass_kg + mass_kg;
    let share = mass_kg / total;
    let apart = Vector3::from(sub(at_m, link.com_m));
    // Both about their common centre of mass: the reduced mass at their distance.
    let reduced = link.mass_kg * share;
    LinkMass {
        mass_kg: total,
        com_m: add(link.com_m, (apart * share).into()),
        inertia_kgm2: link.inertia_kgm2
            + (Matrix3::identity() * apart.norm_squared() - apart * apart.transpose()) * reduced,
    }
}

/// Where every link is and how it moves.
#[derive(Debug, Clone, Default)]
pub(crate) struct Motion {
    /// Poses of links and joint axes.
    pub places: Kinematics,
    /// Velocity of each link's origin, world, m/s.
    pub vel_mps: Vec<[f64; 3]>,
    /// Angular velocity of each link, world, rad/s.
    pub angvel_radps: Vec<[f64; 3]>,
}

impl Motion {
    /// Forward kinematics of positions and velocities.
    pub fn update(&mut self, model: &RobotModel, at: &Coordinates) -> Result<(), SimError> {
        model
            .kinematics_into(&at.world_from_base, &at.joint_pos_rad, &mut self.places)
            .map_err(|e| SimError::Model(e.to_string()))?;
        self.vel_mps.clear();
        self.angvel_radps.clear();
        for (i, link) in model.links().iter().enumerate() {
            // velocity of the material point at `point`, first on the parent's side
            let (mut vel, mut angvel, mut point) = match link.parent {
                Some(p) => (self.vel_mps[p], self.angvel_radps[p], self.places.links[p].pos_m),
                None => (at.base_vel_mps, at.base_angvel_radps, self.places.links[i].pos_m),
            };
            for &j in &link.joints {
                let frame = self.places.joints[j];
                let along_axis = frame.axis.map(|a| a * at.joint_vel_radps[j]);
                vel = add(vel, cross(angvel, sub(frame.anchor_m, point)));
                point = frame.anchor_m;
                match model.joints()[j].motion {
                    JointMotion::Hinge => angvel = add(angvel, along_axis),
                    JointMotion::Slide => vel = add(vel, along_axis),
                }
            }
            let origin = self.places.links[i].pos_m;
            self.vel_mps.push(add(vel, cross(angvel, sub(origin, point))));
            self.angvel_radps.push(angvel);
        }
        Ok(())
    }

    /// World position and velocity of a point given in a link's frame.
    pub fn point(&self, link: usize, local_m: [f64; 3]) -> ([f64; 3], [f64; 3]) {
        let pose = &self.places.links[link];
        let arm = pose.rotate(local_m);
        (add(pose.pos_m, arm), add(self.vel_mps[link], cross(self.angvel_radps[link], arm)))
    }
}

/// Motion of the robot as if it were one rigid body: centre of mass, its velocity, I⁻¹L about it.
pub(crate) struct WholeBody {
    pub com_m: [f64; 3],
    pub vel_mps: [f64; 3],
    pub angvel_radps: [f64; 3],
}

impl WholeBody {
    pub fn of(motion: &Motion, masses: &[LinkMass]) -> Self {
        let total: f64 = masses.iter().map(|m| m.mass_kg).sum();
        let (mut com, mut vel) = (Vector3::zeros(), Vector3::zeros());
        for (i, m) in masses.iter().enumerate() {
            let (p, v) = motion.point(i, m.com_m);
            com += Vector3::from(p) * m.mass_kg;
            vel += Vector3::from(v) * m.mass_kg;
        }
        com /= total;
        vel /= total;
        let (mut inertia, mut momentum) = (Matrix3::zeros(), Vector3::zeros());
        for (i, m) in masses.iter().enumerate() {
            let (p, v) = motion.point(i, m.com_m);
            let (d, u) = (Vector3::from(p) - com, Vector3::from(v) - vel);
            let rotation = Matrix3::from_fn(|r, c| motion.places.links[i].rotation()[r][c]);
            let own = rotation * m.inertia_kgm2 * rotation.transpose();
            let spin = Vector3::from(motion.angvel_radps[i]);
            inertia +=
                own + (Matrix3::identity() * d.norm_squared() - d * d.transpose()) * m.mass_kg;
            momentum += own * spin + d.cross(&u) * m.mass_kg;
        }
        let angvel = inertia.try_inverse().map_or(Vector3::zeros(), |inv| inv * momentum);
        Self { com_m: com.into(), vel_mps: vel.into(), angvel_radps: angvel.into() }
    }
}

/// One lane's links and where they are, from which its report is written.
pub(crate) struct Observer {
    pub masses: Vec<LinkMass>,
    pub at: Coordinates,
    pub motion: Motion,
}

impl Observer {
    pub fn new(model: &RobotModel, params: &LaneParams, at: Coordinates) -> Self {
        Self { masses: link_masses(model, params), at, motion: Motion::default() }
    }

    /// Works out `motion` from `at`.
    pub fn follow(&mut self, model: &RobotModel) -> Result<(), SimError> {
        self.motion.update(model, &self.at)
    }

    /// Fills what `out` (one lane) has of base, joints, centre of mass, heading, feet and IMU. `before_mps` is
    /// the IMU point's velocity (world, m/s) one control period ago, if there was one; returned is that of now.
    pub fn report(
        &mut self,
        out: &mut State,
        rig: &Rig,
        gravity_mps2: [f32; 3],
        before_mps: Option<[f64; 3]>,
    ) -> Result<[f64; 3], SimError> {
        let model = &*rig.model;
        self.follow(model)?;
        let (at, motion) = (&self.at, &self.motion);
        let base = &motion.places.links[0];
        put(&mut out.base_pos_m, 0, base.pos_m);
        put(&mut out.base_quat_wxyz, 0, base.quat_wxyz);
        put(&mut out.base_vel_mps, 0, motion.vel_mps[0]);
        put(&mut out.base_angvel_radps, 0, unrotate(base, motion.angvel_radps[0]));
        put_all(&mut out.joint_pos_rad, 0, &at.joint_pos_rad);
        put_all(&mut out.joint_vel_radps, 0, &at.joint_vel_radps);

        let whole = WholeBody::of(motion, &self.masses);
        put(&mut out.com_pos_m, 0, whole.com_m);
        put(&mut out.com_vel_mps, 0, whole.vel_mps);
        put(&mut out.com_angvel_radps, 0, whole.angvel_radps);
        put(&mut out.heading_rad, 0, [heading_rad(model, motion)]);

        for (f, foot) in model.feet().iter().enumerate() {
            let (p, v) = motion.point(foot.link, foot.centre_m);
            let ground = f64::from(rig.terrain.height_m(p[0] as f32, p[1] as f32));
            put(&mut out.foot_pos_m, f, p);
            put(&mut out.foot_vel_mps, f, v);
            let low = |ball: &Ball| motion.point(foot.link, ball.centre_m).0[2] - ball.radius_m;
            let lowest = foot.balls.iter().map(low).fold(f64::INFINITY, f64::min);
            put(&mut out.foot_height_m, f, [lowest - ground]);
        }

        let (link, link_from_imu) = imu_place(model);
        let world_from_imu = motion.places.links[link].compose(&link_from_imu);
        put(&mut out.imu_gyro_radps, 0, unrotate(&world_from_imu, motion.angvel_radps[link]));
        put(&mut out.imu_gravity, 0, unrotate(&world_from_imu, unit_or_down(gravity_mps2)));

        let vel = motion.point(link, link_from_imu.pos_m).1;
        let period_s = rig.config.control_period_s();
        let acceleration = sub(vel, before_mps.unwrap_or(vel)).map(|v| v / period_s);
        let force = sub(acceleration, gravity_mps2.map(f64::from));
        put(&mut out.imu_acc_mps2, 0, unrotate(&world_from_imu, force));
        Ok(vel)
    }
}

/// The IMU's link and pose in it; the base frame on a robot without one.
fn imu_place(model: &RobotModel) -> (usize, Pose) {
    model.imu_site().map_or((0, Pose::IDENTITY), |s| (s.link, s.link_from_site))
}

fn heading_rad(model: &RobotModel, motion: &Motion) -> f64 {
    let line = match model.heading_sites() {
        Some((hind, front)) => sub(
            motion.point(front.link, front.link_from_site.pos_m).0,
            motion.point(hind.link, hind.link_from_site.pos_m).0,
        ),
        None => motion.places.links[0].rotate([1.0, 0.0, 0.0]),
    };
    line[1].atan2(line[0])
}

/// A world vector in a pose's own frame.
fn unrotate(pose: &Pose, world: [f64; 3]) -> [f64; 3] {
    pose.inverse().rotate(world)
}

fn unit_or_down(v: [f32; 3]) -> [f64; 3] {
    let v = v.map(f64::from);
    let length = dot(v, v).sqrt();
    if length > 0.0 { v.map(|x| x / length) } else { [0.0, 0.0, -1.0] }
}

fn put<const K: usize>(field: &mut [f32], row: usize, values: [f64; K]) {
    put_all(field, row, &values);
}

fn put_all(field: &mut [f32], row: usize, values: &[f64]) {
    let k = values.len();
    for (slot, value) in field[row * k..(row + 1) * k].iter_mut().zip(values) {
        *slot = *value as f32;
    }
}

impl Coordinates {
    /// The coordinates `init` asks for.
    pub fn start(rig: &Rig, init: &InitialState) -> Result<Self, SimError> {
        let Rig { model, config, terrain, .. } = rig;
        let wide = |v: &[f32]| -> Vec<f64> { v.iter().map(|&x| f64::from(x)).collect() };
        let full =
            |v: &[f32]| model.full_pos_rad(&wide(v)).map_err(|e| SimError::Model(e.to_string()));
        let [roll, pitch, yaw] = init.base_rpy_rad.map(f64::from);
        let turn = nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let [x, y] = init.base_xy_m.map(f64::from);
        let world_from_base =
            Pose { pos_m: [x, y, 0.0], quat_wxyz: [turn.w, turn.i, turn.j, turn.k] };
        let mut at = Self {
            base_vel_mps: init.base_vel_mps.map(f64::from),
            base_angvel_radps: world_from_base.rotate(init.base_angvel_radps.map(f64::from)),
            world_from_base,
            joint_pos_rad: full(&init.joint_pos_rad)?,
            joint_vel_radps: full(&init.joint_vel_radps)?,
        };
        at.world_from_base.pos_m[2] = start_height_m(model, terrain, config.fixed_base, init, &at)?;
        Ok(at)
    }
}

/// How high above touching height a held robot hangs unless told otherwise, m.
const HELD_CLEARANCE_M: f64 = 0.2;

/// Height of the base's origin that `init` asks for, m: touching the ground, a held robot (`hung`) a little
/// higher, and either at the surface of water that is deeper.
fn start_height_m(
    model: &RobotModel,
    terrain: &Terrain,
    hung: bool,
    init: &InitialState,
    at: &Coordinates,
) -> Result<f64, SimError> {
    if let Some(z) = init.base_z_m {
        return Ok(f64::from(z));
    }
    if model.base() == BaseKind::Fixed {
        return Ok(0.0); // where the model puts it
    }
    let clearance = if hung { HELD_CLEARANCE_M } else { 0.0 };
    let standing = touching_height_m(model, terrain, at)? + clearance;
    let floating = terrain.water_level_m.map_or(f64::NEG_INFINITY, f64::from);
    Ok(standing.max(floating))
}

/// Height of the base's origin at which the lowest colliding geom just touches the terrain, m. Exact on flat
/// ground; elsewhere each geom is kept above the highest ground under its bounding square, so it may hang a
/// little.
fn touching_height_m(
    model: &RobotModel,
    terrain: &Terrain,
    at: &Coordinates,
) -> Result<f64, SimError> {
    let mut placed = at.world_from_base;
    placed.pos_m[2] = 0.0;
    let places =
        model.kinematics(&placed, &at.joint_pos_rad).map_err(|e| SimError::Model(e.to_string()))?;
    let mut height = f64::NEG_INFINITY;
    for (link, pose) in model.links().iter().zip(&places.links) {
        for geom in link.geoms.iter().filter(|g| g.collides()) {
            let world = pose.compose(&geom.link_from_geom);
            let reach = |axis: [f64; 3]| geom.shape.half_extent_m(world.inverse().rotate(axis));
            let (rx, ry, rz) =
                (reach([1.0, 0.0, 0.0]), reach([0.0, 1.0, 0.0]), reach([0.0, 0.0, 1.0]));
            let ground = highest_ground_m(terrain, world.pos_m, rx, ry);
            height = height.max(ground - (world.pos_m[2] - rz));
        }
    }
    Ok(if height.is_finite() { height } else { 0.0 })
}

/// Highest ground in the square of half edges `rx`, `ry` around a point, sampled.
fn highest_ground_m(terrain: &Terrain, centre: [f64; 3], rx: f64, ry: f64) -> f64 {
    const STEPS: i32 = 4;
    let mut highest = f64::NEG_INFINITY;
    for i in -STEPS..=STEPS {
        for j in -STEPS..=STEPS {
            let x = centre[0] + rx * f64::from(i) / f64::from(STEPS);
            let y = centre[1] + ry * f64::from(j) / f64::from(STEPS);
            highest = highest.max(f64::from(terrain.height_m(x as f32, y as f32)));
        }
    }
    highest
}
