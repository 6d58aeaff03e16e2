//! The robot compiled once: a flat list of degrees of freedom with everything constant worked out.
//!
//! *Node* 0 is the base (or the world, where the base is held); every further node is one live joint and the
//! frame that it carries, a parent always before its children. A node's frame has its origin at the joint's
//! anchor and, wherever the axis allows it, the orientation of its parent at zero, so that turning is a plane
//! rotation of two columns; else it is laid so that the axis is z. Locked joints weld their link to the node
//! before; a link with several joints hangs on nodes without mass of their own.

use std::ops::Range;

use caudata_model::pose::{self, Pose};
use caudata_model::{Ball, BaseKind, Foot, Geom, JointKind, JointMotion, RobotModel, Shape};

use super::contact_law::THETA;
use super::place::{Part, Place};
use super::rounded::{self, Core};
use crate::mobility::Mobility;
use crate::self_contact;
use crate::simd::Lanes;
use crate::state::{self, FIELDS};
use crate::stop::Stop;
use crate::{EngineConfig, SimError};

/// Balls of a part: centres in its node's frame, and radii, m.
pub type Balls<R> = Vec<([<R as Lanes>::Elem; 3], <R as Lanes>::Elem)>;

/// Most degrees of freedom (beyond a free base's six) that the engine takes.
pub const MAX_JOINTS: usize = 256;
/// Most contact points that the engine takes.
pub const MAX_POINTS: usize = 4096;

/// Inverse mass of what cannot move, 1/kg: its contacts push on nothing, but by a finite force.
const LEAST_MOBILITY: f64 = 1e-3;

/// How far an axis may be off a frame axis and still count as aligned.
const ALIGNED: f64 = 1e-12;

/// A joint and the frame it carries.
#[derive(Debug, Clone)]
pub(super) struct Node<R: Lanes> {
    /// Node it hangs on.
    pub parent: usize,
    /// Slides instead of turning.
    pub slide: bool,
    /// Which column of the frame is the axis.
    pub axis: usize,
    /// −1 where the axis points against that column.
    pub negative: bool,
    /// Constant turn between the parent's frame and this one at zero, columns; `None`: none.
    pub turn: Option<[[R::Elem; 3]; 3]>,
    /// Anchor in the parent's frame, m.
    pub offset: [R::Elem; 3],
    /// Which components of `offset` are not zero.
    pub has_offset: [bool; 3],
    /// Whether nothing has been added to the parent's inertia when this one's turn comes (children come last
    /// first).
    pub first_for_parent: bool,
    /// Model index of the joint.
    pub joint: usize,
    /// Index in policy order of the servo, where it has one.
    pub servo: Option<usize>,
    /// Its end stops.
    pub stop: Stop,
}

/// Where a link is.
#[derive(Debug, Clone)]
pub(super) struct LinkPlace<R: Lanes> {
    /// Model index.
    pub link: usize,
    /// Node whose frame carries it.
    pub node: usize,
    /// Its frame in the node's.
    pub node_from_link: Pose,
    /// Columns: node from link.
    pub columns: [[R::Elem; 3]; 3],
    /// Origin in the node's frame, m.
    pub origin: [R::Elem; 3],
}

/// Deepest penetration that a contact's spring answers to, m: deeper, it pushes out with a constant force and
/// does not throw the robot off. Softer ones answer until they push as MuJoCo's default contact does there (2,770 s⁻²
/// times 10 mm), m/s², and their impedance is full.
const DEEPEST_M: f64 = 0.01;
const DEEPEST_MPS2: f64 = 27.0;

/// A ball (radius 0: a point) that may touch the ground.
#[derive(Debug, Clone)]
pub(super) struct Point<R: Lanes> {
    /// Model index of its link.
    pub link: usize,
    pub node: usize,
    /// Centre in the node's frame, m.
    pub centre: [R::Elem; 3],
    /// Radius, m.
    pub radius: R::Elem,
    /// `None`: a ball. Else the rim of a wheel about this axis (node's frame): its lowest point touches, wherever
    /// the wheel has turned to.
    pub axle: Option<[R::Elem; 3]>,
    /// Inverse of the mass that a contact reckons with, 1/kg.
    pub mobility: R::Elem,
    /// How it gives way.
    pub soft: Stop,
    /// Deepest penetration that its spring answers to, m.
    pub deepest: R::Elem,
    /// Stiffness of its bristle, N/m.
    pub kt: R::Elem,
    /// Damping of its bristle plus θ·dt·kt, N·s/m.
    pub dt_full: R::Elem,
    /// Whether it is a shape of its own, not a corner or an end of one.
    pub is_ball: bool,
    pub part: Part,
}

/// The compiled robot.
#[derive(Debug, Clone)]
pub(super) struct Program<R: Lanes> {
    /// Whether the base moves.
    pub free: bool,
    /// The point of the base's frame that everything is reckoned about, m: the robot's centre of mass in its
    /// nominal pose. Near the masses, single precision loses least (from the Polymander's nose, its tail
    /// fin's inertia is a difference of numbers a thousand times as large).
    pub centre: [R::Elem; 3],
    /// Nodes 1, 2, … (node k is `nodes[k − 1]`).
    pub nodes: Vec<Node<R>>,
    /// Links, sorted by node.
    pub links: Vec<LinkPlace<R>>,
    /// Which of them each node carries. `[nodes + 1]`
    pub links_of: Vec<Range<usize>>,
    /// Contact points, sorted by node.
    pub points: Vec<Point<R>>,
    /// Which of them each node carries. `[nodes + 1]`
    pub points_of: Vec<Range<usize>>,
    /// Contact points that may touch each other.
    pub pairs: Vec<(usize, usize)>,
    /// Shapes that may meet others with their own extent.
    pub cores: Vec<Core<R>>,
    /// Which of them may meet.
    pub core_pairs: Vec<(usize, usize)>,
    /// Place in `links` of the torso.
    pub torso: usize,
    /// Foot centres.
    pub feet: Vec<Place<R>>,
    /// The balls that stand for each foot: centres in the node's frame, and radii, m.
    pub foot_balls: Vec<Balls<R>>,
    /// IMU.
    pub imu: Place<R>,
    /// Hind and front end of the heading line.
    pub heading: Option<(Place<R>, Place<R>)>,
    /// Live joints between the world and the root link.
    pub base_joint_count: usize,
    /// Root link's frame.
    pub base_place: Place<R>,
    /// Root link's orientation in its node.
    pub base_quat: [R::Elem; 4],
    /// Joints of the model.
    pub joints: usize,
    /// Actuated joints.
    pub actuated: usize,
    /// Whether there is water.
    pub water: bool,
}

impl<R: Lanes> Program<R> {
    /// Compiles `model` as `config` asks for.
    pub fn new(model: &RobotModel, config: &EngineConfig, water: bool) -> Result<Self, SimError> {
        let mobility = Mobility::of(model, config)?;
        let (mut nodes, placed) = nodes(model, config, &mobility)?;
        let links = link_places(model, &placed);
        let links_of = ranges(nodes.len() + 1, links.iter().map(|l| l.node));
        mark_first_children(&mut nodes, &links_of);
        let points = contact_points(model, &placed, &mobility, config)?;
        let points_of = ranges(nodes.len() + 1, points.iter().map(|p| p.node));
        let place = |link: usize, at: &Pose| place::<R>(&placed, link, at);
        let find = |link: usize| {
            links
                .iter()
                .position(|l| l.link == link)
                .ok_or_else(|| SimError::Model(format!("link {link} is nowhere")))
        };
        let (cores, core_pairs) = rounded::cores(model, config, &place)?;
        Ok(Self {
            cores,
            core_pairs,
            free: config.frees_base(model),
            centre: nominal_centre(model)?.map(R::elem),
            torso: find(model.torso_link())?,
            base_place: place(0, &Pose::IDENTITY),
            base_quat: placed[0].1.quat_wxyz.map(R::elem),
            base_joint_count: placed[0].0,
            feet: model.feet().iter().map(|f| place(f.link, &Pose::from_pos(f.centre_m))).collect(),
            foot_balls: model
                .feet()
                .iter()
                .map(|f| foot_balls::<R>(f, &placed[f.link].1))
                .collect(),
            imu: model
                .imu_site()
                .map_or_else(|| place(0, &Pose::IDENTITY), |s| place(s.link, &s.link_from_site)),
            heading: model.heading_sites().map(|(hind, front)| {
                (place(hind.link, &hind.link_from_site), place(front.link, &front.link_from_site))
            }),
            joints: model.joints().len(),
            actuated: model.actuated().len(),
            water: water && model.water().is_some(),
            nodes,
            links,
            links_of,
            pairs: if config.self_collision && !config.self_shells {
                pairs(model, &points)
            } else {
                Vec::new()
            },
            points,
            points_of,
        })
    }

    /// Numbers per lane of each field of [`State`](crate::State), in its order.
    pub fn widths(&self) -> [usize; FIELDS] {
        state::widths(self.joints, self.actuated, self.feet.len())
    }

    /// Numbers per lane of all fields.
    pub fn report_len(&self) -> usize {
        self.widths().iter().sum()
    }

    /// Number of nodes with node 0.
    pub fn frames(&self) -> usize {
        self.nodes.len() + 1
    }
}

/// Which node carries each link, and where in it.
type Placed = Vec<(usize, Pose)>;

/// A node per live joint, and where they carry the links.
fn nodes<R: Lanes>(
    model: &RobotModel,
    config: &EngineConfig,
    mobility: &Mobility,
) -> Result<(Vec<Node<R>>, Placed), SimError> {
    let mut nodes: Vec<Node<R>> = Vec::new();
    let mut placed = Placed::new();
    for link in model.links() {
        let (mut node, mut at) = match link.parent {
            Some(p) => (placed[p].0, placed[p].1.compose(&link.parent_from_link)),
            None if model.base() == BaseKind::Fixed => (0, link.parent_from_link),
            None => (0, Pose::IDENTITY),
        };
        if link.parent.is_none() && config.frees_base(model) && !link.joints.is_empty() {
            return Err(SimError::Model(format!(
                "the root link {} is free and has joints as well",
                link.name
            )));
        }
        for &j in &link.joints {
            let joint = &model.joints()[j];
            if config.holds(joint) {
                continue;
            }
            let anchor = at.point(joint.anchor_m);
            let (turn_quat, axis, negative) = lay(at.rotate(joint.axis));
            let from_node = Pose { pos_m: anchor, quat_wxyz: turn_quat };
            nodes.push(Node {
                parent: node,
                slide: joint.motion == JointMotion::Slide,
                axis,
                negative,
                turn: (turn_quat != Pose::IDENTITY.quat_wxyz)
                    .then(|| constant_columns::<R>(turn_quat)),
                offset: anchor.map(R::elem),
                has_offset: anchor.map(|x| x != 0.0),
                first_for_parent: false,
                joint: j,
                servo: match joint.kind {
                    JointKind::Actuated { index } => Some(index),
                    JointKind::Passive | JointKind::Backlash => None,
                },
                stop: Stop::new(&joint.stop, mobility.joints[j]),
            });
            node = nodes.len();
            at = from_node.inverse().compose(&at);
        }
        placed.push((node, at));
    }
    if nodes.len() > MAX_JOINTS {
        return Err(SimError::Model(format!(
            "it has {} moving joints, the batch engine takes {MAX_JOINTS}",
            nodes.len()
        )));
    }
    Ok((nodes, placed))
}

/// Centre of mass in the nominal pose, in the base's frame.
fn nominal_centre(model: &RobotModel) -> Result<[f64; 3], SimError> {
    let refused = |e: caudata_model::ModelError| SimError::Model(e.to_string());
    let nominal = model.full_pos_rad(model.nominal_pos_rad()).map_err(refused)?;
    let places = model.kinematics(&Pose::IDENTITY, &nominal).map_err(refused)?;
    Ok(model.centre_of_mass_m(&places))
}

/// How a joint with this axis (parent's frame) is laid: constant turn of its frame, column that is the axis,
/// whether against it.
fn lay(axis: [f64; 3]) -> ([f64; 4], usize, bool) {
    for k in 0..3 {
        if (axis[k].abs() - 1.0).abs() < ALIGNED {
            return (Pose::IDENTITY.quat_wxyz, k, axis[k] < 0.0);
        }
    }
    // shortest turn that takes z to the axis (it is not −z, which is aligned)
    let [x, y, z] = axis;
    let quat = pose::quat_normalised([1.0 + z, -y, x, 0.0]);
    (quat.unwrap_or(Pose::IDENTITY.quat_wxyz), 2, false)
}

fn constant_columns<R: Lanes>(quat: [f64; 4]) -> [[R::Elem; 3]; 3] {
    let m = pose::quat_to_matrix(quat);
    [0, 1, 2].map(|c| [0, 1, 2].map(|r| R::elem(m[r][c])))
}

fn place<R: Lanes>(placed: &[(usize, Pose)], link: usize, link_from_place: &Pose) -> Place<R> {
    let (node, node_from_link) = placed[link];
    let at = node_from_link.compose(link_from_place);
    Place { node, at: at.pos_m.map(R::elem), columns: constant_columns::<R>(at.quat_wxyz) }
}

/// The balls of a foot in its node's frame.
fn foot_balls<R: Lanes>(foot: &Foot, node_from_link: &Pose) -> Balls<R> {
    let place = |at| node_from_link.point(at).map(R::elem);
    let ball = |ball: &Ball| (place(ball.centre_m), R::elem(ball.radius_m));
    foot.balls.iter().map(ball).collect()
}

fn link_places<R: Lanes>(model: &RobotModel, placed: &[(usize, Pose)]) -> Vec<LinkPlace<R>> {
    let mut links: Vec<LinkPlace<R>> = model
        .links()
        .iter()
        .enumerate()
        .map(|(link, _)| {
            let (node, node_from_link) = placed[link];
            LinkPlace {
                link,
                node,
                node_from_link,
                columns: constant_columns::<R>(node_from_link.quat_wxyz),
                origin: node_from_link.pos_m.map(R::elem),
            }
        })
        .collect();
    links.sort_by_key(|l| l.node);
    links
}

/// Per node, which entries of a list sorted by node are its own.
fn ranges(nodes: usize, sorted: impl Iterator<Item = usize> + Clone) -> Vec<Range<usize>> {
    (0..nodes)
        .map(|n| {
            let start = sorted.clone().take_while(|&k| k < n).count();
            start..start + sorted.clone().filter(|&k| k == n).count()
        })
        .collect()
}

/// A node whose parent has no mass of its own and no later child writes the parent's inertia instead of
/// adding to it.
fn mark_first_children<R: Lanes>(nodes: &mut [Node<R>], links_of: &[Range<usize>]) {
    let mut written: Vec<bool> = links_of.iter().map(|l| !l.is_empty()).collect();
    for node in nodes.iter_mut().rev() {
        node.first_for_parent = !written[node.parent];
        written[node.parent] = true;
    }
}

/// The balls, points and rims that stand for the model's colliding shapes (see [`caudata_model::Shape::balls`]).
fn contact_points<R: Lanes>(
    model: &RobotModel,
    placed: &[(usize, Pose)],
    mobility: &Mobility,
    config: &EngineConfig,
) -> Result<Vec<Point<R>>, SimError> {
    let mut points = Vec::new();
    for (i, link) in model.links().iter().enumerate() {
        for (g, geom) in link.geoms.iter().enumerate().filter(|(_, g)| g.collides()) {
            let foot = model.foot_of(i, g);
            let (node, node_from_link) = placed[i];
            let node_from_geom = node_from_link.compose(&geom.link_from_geom);
            let rims = model.is_wheel(i, geom);
            let (centres, radius) = match geom.shape {
                Shape::Cylinder { radius_m, half_length_m: h } if rims => {
                    (vec![[0.0, 0.0, -h], [0.0, 0.0, h]], radius_m)
                }
                _ => geom.shape.balls().ok_or_else(|| no_balls(geom, &link.name))?,
            };
            let axle = rims.then(|| node_from_geom.rotate([0.0, 0.0, 1.0]).map(R::elem));
            let other = if model.carries_feet(i) { Part::Trunk } else { Part::Tail };
            let soft = Stop::new(&geom.soft, mobility.links[i]).harder(config.contact_hardness);
            // the rim of a cylinder, of 16 points, holds as the four corners of a box do: light feet shake on more
            let share = (8.0 / centres.len() as f64).min(1.0);
            let kt = share * config.bristle_stiffness_n_per_m;
            let dt_full = share * config.bristle_damping_ns_per_m + THETA * config.dt_s * kt;
            let full_m = (DEEPEST_MPS2 / soft.stiffness_per_s2).max(geom.soft.solimp[2]);
            points.extend(centres.into_iter().map(|c| Point {
                link: i,
                node,
                centre: node_from_geom.point(c).map(R::elem),
                radius: R::elem(radius),
                axle,
                mobility: R::elem(mobility.links[i].max(LEAST_MOBILITY)),
                soft,
                deepest: R::elem(DEEPEST_M.max(full_m)),
                kt: R::elem(kt),
                dt_full: R::elem(dt_full),
                is_ball: matches!(geom.shape, Shape::Sphere { .. }),
                part: foot.map_or(other, Part::Foot),
            }));
        }
    }
    if points.len() > MAX_POINTS {
        return Err(SimError::Model(format!(
            "its shapes make {} contact points, the batch engine takes {MAX_POINTS}",
            points.len()
        )));
    }
    points.sort_by_key(|p| p.node);
    Ok(points)
}

fn no_balls(geom: &Geom, link: &str) -> SimError {
    SimError::Model(format!(
        "geom {} of link {link} is an ellipsoid, which the batch engine cannot collide; give it contype and \
         conaffinity 0, and put balls or capsules in its place",
        geom.name.as_deref().unwrap_or("without a name"),
    ))
}

/// Points of legs, with points of other legs and of the trunk that the leg does not hang on.
fn pairs<R: Lanes>(model: &RobotModel, points: &[Point<R>]) -> Vec<(usize, usize)> {
    let legs = self_contact::legs(model);
    let hanging = self_contact::hanging_legs(model, &legs);
    let mut pairs = Vec::new();
    for a in 0..points.len() {
        for b in a + 1..points.len() {
            let links = (points[a].link, points[b].link);
            let balls = points[a].is_ball && points[b].is_ball;
            if balls && self_contact::may_meet(&legs, &hanging, links) {
                pairs.push((a, b));
            }
        }
    }
    pairs
}
