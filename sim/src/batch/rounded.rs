//! Parts of the robot against each other with their shapes: capsules, boxes and cylinders, besides balls.
//!
//! A shape is a *core* with a rounding: what a ball of radius r covers whose centre moves in a box. A capsule is
//! one exactly (its box is a line), a ball too (a point); a box has its edges rounded by its own half thickness;
//! a cylinder is the capsule inside it. The nearest points of two cores are found by projecting back and forth,
//! which converges for convex sets; after that two rounded points meet like balls, with the law of
//! [`super::pairs`] (see [`super::cores`]).

use caudata_model::pose::sub;
use caudata_model::{Geom, Kinematics, Pose, RobotModel, Shape, has_shell};

use super::place::{Part, Place};
use super::vec3::{V3, add_scaled, dot};
use crate::real::Real;
use crate::self_contact;
use crate::simd::Lanes;
use crate::{EngineConfig, SimError};

/// Projections back and forth. The first already tells shapes side by side apart; after these, two capsules
/// that cross at 30° are within 1 % of their distance.
const ROUNDS: usize = 6;
/// Links between which there are fewer joints lie beside each other by construction.
const LEAST_APART: usize = 3;

/// A rounded box on a node.
#[derive(Debug, Clone)]
pub(super) struct Core<R: Lanes> {
    pub node: usize,
    /// Centre in the node's frame, m.
    pub centre: [R::Elem; 3],
    /// Columns: node from the shape.
    pub columns: [[R::Elem; 3]; 3],
    /// Half the box that the rounding's centre moves in, m.
    pub half: [R::Elem; 3],
    /// Rounding, m.
    pub radius: R::Elem,
    /// Radius of the ball round all of it, m.
    pub bound: R::Elem,
    pub part: Part,
}

/// A shape of the model that may meet others.
struct Candidate {
    link: usize,
    link_from_shape: Pose,
    half_m: [f64; 3],
    radius_m: f64,
    is_ball: bool,
    part: Part,
}

/// The cores of a robot and which of them may meet.
pub(super) type Cores<R> = (Vec<Core<R>>, Vec<(usize, usize)>);

/// Compiles the shapes that `config` lets meet. Balls that touch the ground meet each other elsewhere
/// ([`super::pairs`]); `shells`: what is to be looked at meets instead.
pub(super) fn cores<R: Lanes>(
    model: &RobotModel,
    config: &EngineConfig,
    place: &dyn Fn(usize, &Pose) -> Place<R>,
) -> Result<Cores<R>, SimError> {
    if !config.self_collision {
        return Ok((Vec::new(), Vec::new()));
    }
    let shapes = candidates(model, config.self_shells);
    let legs = self_contact::legs(model);
    let hanging = self_contact::hanging_legs(model, &legs);
    let refused = |e: caudata_model::ModelError| SimError::Model(e.to_string());
    let nominal = model.full_pos_rad(model.nominal_pos_rad()).map_err(refused)?;
    let places = model.kinematics(&Pose::IDENTITY, &nominal).map_err(refused)?;
    let mut pairs = Vec::new();
    for a in 0..shapes.len() {
        for b in a + 1..shapes.len() {
            let (one, other) = (&shapes[a], &shapes[b]);
            let both_balls = one.is_ball && other.is_ball && !config.self_shells;
            let links = (one.link, other.link);
            let excluded = model.excluded_pairs();
            let kept = !excluded.contains(&links) && !excluded.contains(&(links.1, links.0));
            let may =
                self_contact::may_meet(&legs, &hanging, links) || far_trunk(model, &legs, links);
            // what overlaps where the robot stands does so by construction
            if may && kept && !both_balls && gap_m(&places, one, other) > 0.0 {
                pairs.push((a, b));
            }
        }
    }
    let compiled = shapes.iter().map(|shape| {
        let at = place(shape.link, &shape.link_from_shape);
        let reach = shape.half_m.iter().map(|h| h * h).sum::<f64>().sqrt();
        Core {
            node: at.node,
            centre: at.at,
            columns: at.columns,
            half: shape.half_m.map(R::elem),
            radius: R::elem(shape.radius_m),
            bound: R::elem(reach + shape.radius_m),
            part: shape.part,
        }
    });
    Ok((compiled.collect(), pairs))
}

/// Two links of the trunk with several joints between them.
fn far_trunk(model: &RobotModel, legs: &[Option<usize>], links: (usize, usize)) -> bool {
    legs[links.0].is_none() && legs[links.1].is_none() && apart(model, links) >= LEAST_APART
}

/// Number of links on the way from one to the other, less one.
fn apart(model: &RobotModel, links: (usize, usize)) -> usize {
    let up = |link: usize| std::iter::successors(Some(link), |&l| model.links()[l].parent);
    let other: Vec<usize> = up(links.1).collect();
    let meet = up(links.0).enumerate().find_map(|(steps, link)| {
        let place = other.iter().position(|&o| o == link)?;
        Some(steps + place)
    });
    meet.unwrap_or(0)
}

fn candidates(model: &RobotModel, shells: bool) -> Vec<Candidate> {
    let mut out = Vec::new();
    for (l, link) in model.links().iter().enumerate() {
        let has_shell = has_shell(&link.geoms);
        for (g, geom) in link.geoms.iter().enumerate() {
            let foot = model.foot_of(l, g);
            let shown = !has_shell || !geom.collides() || foot.is_some();
            if !(if shells { shown } else { geom.collides() }) {
                continue;
            }
            let Some((half_m, radius_m)) = rounded(geom) else { continue };
            let other = if model.carries_feet(l) { Part::Trunk } else { Part::Tail };
            out.push(Candidate {
                link: l,
                link_from_shape: geom.link_from_geom,
                half_m,
                radius_m,
                is_ball: matches!(geom.shape, Shape::Sphere { .. }),
                part: foot.map_or(other, Part::Foot),
            });
        }
    }
    out
}

/// Box and rounding of a shape; `None`: it has none.
fn rounded(geom: &Geom) -> Option<([f64; 3], f64)> {
    Some(match geom.shape {
        Shape::Sphere { radius_m } => ([0.0; 3], radius_m),
        Shape::Capsule { radius_m, half_length_m } => ([0.0, 0.0, half_length_m], radius_m),
        Shape::Cylinder { radius_m, half_length_m } => {
            let radius = radius_m.min(half_length_m);
            ([radius_m - radius, radius_m - radius, half_length_m - radius], radius)
        }
        Shape::Box { half_size_m } => {
            let radius = half_size_m.iter().copied().fold(f64::INFINITY, f64::min);
            (half_size_m.map(|h| h - radius), radius)
        }
        Shape::Ellipsoid { .. } | Shape::Plane => return None,
    })
}

/// Distance of two shapes with the robot in its nominal pose, m.
fn gap_m(places: &Kinematics, a: &Candidate, b: &Candidate) -> f64 {
    let world = |shape: &Candidate| {
        let at = places.links[shape.link].compose(&shape.link_from_shape);
        let m = at.rotation();
        let columns = [0, 1, 2].map(|c| [0, 1, 2].map(|r| m[r][c]));
        (at.pos_m, columns, shape.half_m)
    };
    let (one, other) = (world(a), world(b));
    let (near, far) = nearest::<f64>(&one, &other);
    let d = sub(far, near);
    (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt() - a.radius_m - b.radius_m
}

/// A box in the world: centre, columns, half sizes.
pub(super) type Box3<R> = (V3<R>, [V3<R>; 3], V3<R>);

/// The points of two boxes that are nearest to each other.
#[inline(always)]
pub(super) fn nearest<R: Real>(a: &Box3<R>, b: &Box3<R>) -> (V3<R>, V3<R>) {
    let (mut on_a, mut on_b) = (a.0, b.0);
    for _ in 0..ROUNDS {
        on_a = within(a, on_b);
        on_b = within(b, on_a);
    }
    (on_a, on_b)
}

/// The point of a box that is nearest to `point`.
#[inline(always)]
fn within<R: Real>(shape: &Box3<R>, point: V3<R>) -> V3<R> {
    let (centre, columns, half) = shape;
    let d = [point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]];
    let mut at = *centre;
    for k in 0..3 {
        let along = dot(d, columns[k]).clamp(R::zero() - half[k], half[k]);
        at = add_scaled(at, columns[k], along);
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    fn upright(centre: [f64; 3], half: [f64; 3]) -> Box3<f64> {
        (centre, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], half)
    }

    #[test]
    fn boxes_side_by_side_and_corner_to_corner() {
        let a = upright([0.0; 3], [1.0, 1.0, 1.0]);
        let (near, far) = nearest(&a, &upright([3.0, 0.5, 0.0], [1.0, 1.0, 1.0]));
        assert!((far[0] - near[0] - 1.0).abs() < 1e-12 && (far[1] - near[1]).abs() < 1e-12);
        let (near, far) = nearest(&a, &upright([3.0, 4.0, 0.0], [1.0, 1.0, 1.0]));
        // corner (1, 1) to corner (2, 3)
        assert_eq!((near[0], near[1], far[0], far[1]), (1.0, 1.0, 2.0, 3.0));
    }

    #[test]
    fn crossing_rods_meet_at_their_common_normal() {
        let a = upright([0.0; 3], [0.0, 0.0, 0.5]);
        // along x, 0.1 m beside in y, its middle off
        let b = upright([0.2, 0.1, 0.1], [0.5, 0.0, 0.0]);
        let (near, far) = nearest(&a, &b);
        let gap = sub(far, near);
        assert!((gap[1] - 0.1).abs() < 1e-12 && gap[0].abs() < 1e-9 && gap[2].abs() < 1e-9);
    }
}
