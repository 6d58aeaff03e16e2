//! What a robot is made of: links, joints, geoms, sites, feet.
//!
//! Frames: every link has its own frame; at zero joint positions `Link::parent_from_link` places it in its
//! parent. Units are SI; positions m, angles rad, inertia kg·m².

use crate::pose::{Pose, cross, dot, norm, sub};

/// Whether the root link is free or fixed to the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BaseKind {
    /// Six degrees of freedom; the pose of the root link is part of the state.
    Free,
    /// The root link is fixed to (or jointed with) the world.
    Fixed,
}

/// A rigid body.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// Name of the MJCF body.
    pub name: String,
    /// Index of the parent link; `None` where the parent is the world (the root link).
    pub parent: Option<usize>,
    /// Pose of the link frame in the parent's link frame (or the world) with all joints at zero.
    pub parent_from_link: Pose,
    /// Mass, kg (> 0).
    pub mass_kg: f64,
    /// Centre of mass in the link frame, m.
    pub com_m: [f64; 3],
    /// Inertia about the centre of mass in link axes, kg·m², full symmetric matrix, rows first.
    pub inertia_kgm2: [[f64; 3]; 3],
    /// Model indices of the joints between the parent and this link, outermost (at the parent) first. Empty
    /// only for the root.
    pub joints: Vec<usize>,
    /// Shapes fixed to the link, in file order.
    pub geoms: Vec<Geom>,
}

/// How a joint moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointMotion {
    /// Turns about its axis; positions in rad, forces in N·m.
    Hinge,
    /// Slides along its axis; positions in m, forces in N.
    Slide,
}

/// What moves a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointKind {
    /// Driven by a servo; `index` is its place in the policy's joint order.
    Actuated {
        /// Place in the policy's joint order.
        index: usize,
    },
    /// Not driven; spring and damper from the robot file.
    Passive,
    /// Play at a connection: free within its range, from the robot file's `[backlash]`.
    Backlash,
}

/// One degree of freedom between a link and its parent.
///
/// For a slide read m for rad, N for N·m and kg for kg·m².
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// Name of the MJCF joint.
    pub name: String,
    /// Hinge or slide.
    pub motion: JointMotion,
    /// What moves it.
    pub kind: JointKind,
    /// Index of the link on the parent side; `None`: the world.
    pub parent_link: Option<usize>,
    /// Index of the link that this joint carries.
    pub child_link: usize,
    /// Unit axis in the child link's frame. Positive turns are right-handed about it.
    pub axis: [f64; 3],
    /// Anchor point in the child link's frame, m.
    pub anchor_m: [f64; 3],
    /// Lower and upper limit, rad; `None`: unlimited.
    pub range_rad: Option<(f64, f64)>,
    /// How these limits give way.
    pub stop: Softness,
    /// Spring stiffness, N·m/rad, towards `spring_ref_rad`.
    pub stiffness_nm_per_rad: f64,
    /// Position at which the spring is relaxed, rad.
    pub spring_ref_rad: f64,
    /// Viscous damping, N·m·s/rad.
    pub damping_nm_s_per_rad: f64,
    /// Inertia that the drive adds to the axis, kg·m².
    pub armature_kgm2: f64,
    /// Coulomb friction, N·m.
    pub friction_loss_nm: f64,
    /// Held at zero by the robot file (`[passive] locked`, `[backlash] enabled = false`); the joint keeps its
    /// place in model order.
    pub locked: bool,
}

impl Joint {
    /// Unit of its positions: rad or m.
    pub fn unit(&self) -> &'static str {
        match self.motion {
            JointMotion::Hinge => "rad",
            JointMotion::Slide => "m",
        }
    }

    /// What counts on this joint as a radian does on a hinge: of a slide the way at the end of a lever of 0.1 m.
    pub fn per_radian(&self) -> f64 {
        self.motion.per_radian()
    }
}

impl JointMotion {
    /// [`Joint::per_radian`].
    pub(crate) fn per_radian(self) -> f64 {
        match self {
            Self::Hinge => 1.0,
            Self::Slide => 0.1,
        }
    }
}

/// How a limit or a contact gives way, as MJCF writes it (`solref`, `solimp`; MuJoCo's documentation,
/// "Computation", "Solver parameters").
///
/// Beyond the limit by `r`, moving out at `v` with acceleration `a`, the constraint pushes back with
/// `f = (k·r − b·v − a)·d / ((1 − d)·A)`, where `A` is the inverse of the inertia that it meets in the
/// model's zero pose, `d(r)` the impedance, and `b = 2 / (d_max·τ)`, `k = d(r) / (d_max·τ·ζ)²`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Softness {
    /// Time constant τ (s) and damping ratio ζ; or, both negative, −stiffness (1/s²) and −damping (1/s).
    pub solref: [f64; 2],
    /// Impedance: d at the limit, d from `width` on, width (rad or m), midpoint (share of the width), power
    /// (1 or 2).
    pub solimp: [f64; 5],
}

impl Softness {
    /// Whether `solref` is a time constant and a damping ratio, or stiffness and damping.
    pub(crate) fn is_usable(&self) -> bool {
        let [time, damping] = self.solref;
        time > 0.0 && damping > 0.0 || time < 0.0 && damping <= 0.0
    }
}

impl Default for Softness {
    /// MuJoCo's defaults.
    fn default() -> Self {
        Self { solref: [0.02, 1.0], solimp: [0.9, 0.95, 0.001, 0.5, 2.0] }
    }
}

/// A primitive shape, centred on its own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Ball.
    Sphere {
        /// Radius, m.
        radius_m: f64,
    },
    /// Cylinder along z with half-ball ends.
    Capsule {
        /// Radius, m.
        radius_m: f64,
        /// Half the length of the straight part, m.
        half_length_m: f64,
    },
    /// Cylinder along z.
    Cylinder {
        /// Radius, m.
        radius_m: f64,
        /// Half the length, m.
        half_length_m: f64,
    },
    /// Box.
    Box {
        /// Half the edges along x, y, z, m.
        half_size_m: [f64; 3],
    },
    /// Ellipsoid.
    Ellipsoid {
        /// Semi-axes along x, y, z, m.
        semi_axes_m: [f64; 3],
    },
    /// Infinite plane with normal z; only in the world.
    Plane,
}

/// A driven joint whose limits are farther apart rolls: a policy sets its speed and does not see its angle.
pub const ROLLS_FROM_RAD: f64 = 100.0;

/// Points on each rim that stand for a cylinder.
const RIM_POINTS: u32 = 16;

impl Shape {
    /// MuJoCo's name for the shape and its sizes, m, in MuJoCo's order; `None` for a plane.
    pub fn mjcf(&self) -> Option<(&'static str, Vec<f64>)> {
        Some(match *self {
            Self::Sphere { radius_m } => ("sphere", vec![radius_m]),
            Self::Capsule { radius_m, half_length_m } => ("capsule", vec![radius_m, half_length_m]),
            Self::Cylinder { radius_m, half_length_m } => {
                ("cylinder", vec![radius_m, half_length_m])
            }
            Self::Box { half_size_m } => ("box", half_size_m.to_vec()),
            Self::Ellipsoid { semi_axes_m } => ("ellipsoid", semi_axes_m.to_vec()),
            Self::Plane => return None,
        })
    }

    /// The shape that MuJoCo calls `kind`, where `sizes` begins with as many as it needs, all above zero, m.
    pub(crate) fn from_mjcf(kind: &str, sizes: &[f64]) -> Option<Self> {
        let at = |i: usize| sizes.get(i).copied().filter(|x| *x > 0.0);
        Some(match kind {
            "sphere" => Self::Sphere { radius_m: at(0)? },
            "capsule" => Self::Capsule { radius_m: at(0)?, half_length_m: at(1)? },
            "cylinder" => Self::Cylinder { radius_m: at(0)?, half_length_m: at(1)? },
            "box" => Self::Box { half_size_m: [at(0)?, at(1)?, at(2)?] },
            "ellipsoid" => Self::Ellipsoid { semi_axes_m: [at(0)?, at(1)?, at(2)?] },
            _ => return None,
        })
    }

    /// Centres (shape's frame, m) and radius (m; 0: points) of the balls that stand for the shape where it
    /// touches the ground; `None` for an ellipsoid and a plane.
    ///
    /// Exact against a plane: ball; capsule (its two end balls); box (its eight corners). Approximate: cylinder
    /// (16 points on each rim; of a [wheel](crate::RobotModel::is_wheel) an engine takes the rims). Against uneven
    /// ground, straight sides can be hollow between their points: capsules longer than their radius get a
    /// ball in the middle.
    pub fn balls(&self) -> Option<(Vec<[f64; 3]>, f64)> {
        Some(match *self {
            Self::Sphere { radius_m } => (vec![[0.0; 3]], radius_m),
            Self::Capsule { radius_m, half_length_m: h } => {
                let mut centres = vec![[0.0, 0.0, -h], [0.0, 0.0, h]];
                if 2.0 * h > radius_m {
                    centres.push([0.0; 3]);
                }
                (centres, radius_m)
            }
            Self::Box { half_size_m: [x, y, z] } => {
                let signs = [-1.0, 1.0];
                let mut corners = Vec::new();
                for sx in signs {
                    for sy in signs {
                        for sz in signs {
                            corners.push([sx * x, sy * y, sz * z]);
                        }
                    }
                }
                (corners, 0.0)
            }
            Self::Cylinder { radius_m, half_length_m: h } => {
                let mut rim = Vec::new();
                for k in 0..RIM_POINTS {
                    let turn = std::f64::consts::TAU * f64::from(k) / f64::from(RIM_POINTS);
                    let (s, c) = turn.sin_cos();
                    for z in [-h, h] {
                        rim.push([radius_m * c, radius_m * s, z]);
                    }
                }
                (rim, 0.0)
            }
            Self::Ellipsoid { .. } | Self::Plane => return None,
        })
    }

    /// Half the extent of the shape along the unit direction `dir` (in the shape's own frame), m; infinite
    /// for a plane.
    ///
    /// This is the support function of a shape that is symmetric about its centre.
    pub fn half_extent_m(&self, dir: [f64; 3]) -> f64 {
        match *self {
            Self::Sphere { radius_m } => radius_m,
            Self::Capsule { radius_m, half_length_m } => radius_m + half_length_m * dir[2].abs(),
            Self::Cylinder { radius_m, half_length_m } => {
                radius_m * dir[0].hypot(dir[1]) + half_length_m * dir[2].abs()
            }
            Self::Box { half_size_m: h } => (0..3).map(|i| h[i] * dir[i].abs()).sum(),
            Self::Ellipsoid { semi_axes_m: a } => {
                (0..3).map(|i| (a[i] * dir[i]).powi(2)).sum::<f64>().sqrt()
            }
            Self::Plane => f64::INFINITY,
        }
    }
}

/// A shape fixed to a link (or to the world).
#[derive(Clone, Debug, PartialEq)]
pub struct Geom {
    /// Name, where the file gives one.
    pub name: Option<String>,
    /// The shape.
    pub shape: Shape,
    /// Pose of the shape in the link frame.
    pub link_from_geom: Pose,
    /// Sliding friction coefficient against the ground: on a link from the robot file's `[contact]`, in the
    /// world from the MJCF.
    pub friction: f64,
    /// MuJoCo collision bits: two geoms collide where `contype & other.conaffinity` or the reverse is not
    /// zero.
    pub contype: u32,
    /// See `contype`.
    pub conaffinity: u32,
    /// How a contact of this shape gives way (MuJoCo mixes it with the other shape's unless `priority`
    /// decides; here it is this shape's alone).
    pub soft: Softness,
}

impl Geom {
    /// Whether the geom touches anything at all; `false`: only to be looked at.
    pub fn collides(&self) -> bool {
        self.contype != 0 || self.conaffinity != 0
    }

    /// The radius, m, of a ball, cylinder or capsule about the line through `anchor_m` along the unit vector
    /// `axis` (link's frame; 5 % of slack): turning about that line does not move it. Of others `None`.
    pub(crate) fn radius_about_m(&self, anchor_m: [f64; 3], axis: [f64; 3]) -> Option<f64> {
        let off_m = norm(cross(sub(self.link_from_geom.pos_m, anchor_m), axis));
        let tilt = norm(cross(self.link_from_geom.rotate([0.0, 0.0, 1.0]), axis));
        let radius_m = match self.shape {
            Shape::Sphere { radius_m } => radius_m,
            Shape::Cylinder { radius_m, .. } | Shape::Capsule { radius_m, .. } if tilt < 0.05 => {
                radius_m
            }
            _ => return None,
        };
        (off_m < 0.05 * radius_m).then_some(radius_m)
    }

    /// A radius about the same line that the shape lies within, m.
    pub(crate) fn within_m(&self, anchor_m: [f64; 3], axis: [f64; 3]) -> f64 {
        let aside = if axis[0].abs() < 0.7 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
        let first = cross(axis, aside).map(|x| x / norm(cross(axis, aside)));
        let from_geom = self.link_from_geom.inverse();
        let far_m = |dir: [f64; 3]| {
            let off_m = dot(sub(self.link_from_geom.pos_m, anchor_m), dir).abs();
            off_m + self.shape.half_extent_m(from_geom.rotate(dir))
        };
        far_m(first).hypot(far_m(cross(axis, first)))
    }

    /// Whether this geom and `other` may touch (MuJoCo's rule, without the `exclude` list).
    pub fn collides_with(&self, other: &Self) -> bool {
        self.contype & other.conaffinity != 0 || other.contype & self.conaffinity != 0
    }
}

/// A named frame on a link.
#[derive(Clone, Debug, PartialEq)]
pub struct Site {
    /// Name of the MJCF site.
    pub name: String,
    /// Index of the link that carries it.
    pub link: usize,
    /// Pose in the link frame.
    pub link_from_site: Pose,
}

/// A ball on a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Centre, link frame, m.
    pub centre_m: [f64; 3],
    /// Radius, m.
    pub radius_m: f64,
}

/// A foot: the shapes at the end of a leg that are to touch the ground.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Foot {
    /// Leg name, for example `FL`.
    pub name: String,
    /// Index of the link that carries the shapes.
    pub link: usize,
    /// Indices of the shapes in that link's `geoms`.
    pub geoms: Vec<usize>,
    /// Mean of the shapes' centres, link frame, m.
    pub centre_m: [f64; 3],
    /// The balls that stand for the shapes (see [`Shape::balls`]). A ball has one: itself.
    pub balls: Vec<Ball>,
}

impl Foot {
    /// Whether the foot is a ball: its lowest point is then one radius below its centre, however it turns.
    pub fn is_ball(&self) -> bool {
        self.balls.len() == 1
    }

    /// Whether a shape belongs to both.
    pub(crate) fn shares_a_shape(&self, other: &Self) -> bool {
        self.link == other.link && self.geoms.iter().any(|g| other.geoms.contains(g))
    }

    /// Radius of the largest of its balls, m.
    pub fn radius_m(&self) -> f64 {
        self.balls.iter().map(|b| b.radius_m).fold(0.0, f64::max)
    }
}
