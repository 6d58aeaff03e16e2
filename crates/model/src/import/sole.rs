//! What a leg stands on: the shapes of its sole.

use super::finish::{driven, reaching};
use crate::parts::Robot;
use crate::pose::{self, Pose};
use crate::types::{Geom, Shape};

/// How much higher than the lowest a shape may end and still be a foot, m.
pub(super) const FOOT_LEVEL_M: f64 = 0.03;
/// The same among the shapes of one foot.
const SOLE_LEVEL_M: f64 = 0.01;

/// Half of a shape's extent along the axes of the ground, m, and its middle.
fn extent(place: &Pose, geom: &Geom) -> ([f64; 3], [f64; 3]) {
    let at = place.compose(&geom.link_from_geom);
    let along = |axis| geom.shape.half_extent_m(at.inverse().rotate(axis));
    ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(along), at.pos_m)
}

fn bottom_m(place: &Pose, geom: &Geom) -> f64 {
    let (half_m, middle_m) = extent(place, geom);
    middle_m[2] - half_m[2]
}

/// The lowest shape of a body: its middle, the height of its lowest point, and itself.
pub(super) fn lowest<'a>(
    robot: &'a Robot,
    places: &[Pose],
    body: usize,
) -> Option<([f64; 3], f64, &'a Geom)> {
    let place = &places[body];
    let low = |geom: &&Geom| bottom_m(place, geom);
    let geom = reaching(&robot.bodies[body]).min_by(|a, b| low(a).total_cmp(&low(b)))?;
    Some((extent(place, geom).1, low(&geom), geom))
}

/// Whether a shape of a body at `place` belongs to the sole that `lowest` is of: it ends as low, and its middle is
/// as low, which that of a shin is not, or it is a box that lies.
pub(super) fn of_the_sole(place: &Pose, lowest: &Geom, geom: &Geom) -> bool {
    let (half_m, middle_m) = extent(place, geom);
    let (_, foot_m) = extent(place, lowest);
    let lies = matches!(geom.shape, Shape::Box { .. }) && half_m[2] < half_m[0].max(half_m[1]);
    bottom_m(place, geom) - bottom_m(place, lowest) < SOLE_LEVEL_M
        && (lies || (middle_m[2] - foot_m[2]).abs() < SOLE_LEVEL_M)
}

/// Toes without a drive belong to the foot that stands on the ground before them: that foot.
pub(super) fn foot_of(robot: &Robot, places: &[Pose], end: usize) -> Option<usize> {
    let foot = robot.bodies[end].parent.filter(|&p| p > 0 && !driven(robot, end))?;
    let [(_, foot_m, _), (_, toe_m, _)] =
        [lowest(robot, places, foot)?, lowest(robot, places, end)?];
    (foot_m - toe_m < FOOT_LEVEL_M).then_some(foot)
}

/// The middle of what a body ends in, and of its `toe`, in the body's frame, m; and whether that is wider than a
/// point. What it ends in is the shape farthest from its joint among the low ones, those of its form, and what is
/// as low but for rods, which are shins where a leg is stretched out.
pub(super) fn middle(
    robot: &Robot,
    places: &[Pose],
    body: usize,
    toe: Option<usize>,
) -> Option<([f64; 3], bool)> {
    let (_, low_m, _) = lowest(robot, places, body)?;
    let place = &places[body];
    let far = |g: &&Geom| pose::norm(g.link_from_geom.pos_m);
    let shapes = || reaching(&robot.bodies[body]);
    let tip = shapes()
        .filter(|g| bottom_m(place, g) - low_m < FOOT_LEVEL_M)
        .max_by(|a, b| far(a).total_cmp(&far(b)))?;
    let rod = |g: &Geom| matches!(g.shape, Shape::Capsule { .. } | Shape::Cylinder { .. });
    let belongs = |g: &&Geom| g.shape == tip.shape || !rod(g) && of_the_sole(place, tip, g);
    let mut outline: Vec<_> = shapes().filter(belongs).map(|g| extent(place, g)).collect();
    let up_m = outline.iter().map(|(_, m)| m[2]).sum::<f64>() / outline.len() as f64;
    if let Some((toe, (_, _, geom))) = toe.and_then(|t| Some((t, lowest(robot, places, t)?))) {
        outline.push(extent(&places[toe], geom));
    }
    let half_way = |axis: usize| {
        let ends =
            outline.iter().flat_map(|(half, m)| [m[axis] - half[axis], m[axis] + half[axis]]);
        let (low, high) = ends
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        (low + high) / 2.0
    };
    let wide = outline.len() > 1 || !matches!(tip.shape, Shape::Sphere { .. });
    Some((place.inverse().point([half_way(0), half_way(1), up_m]), wide))
}
