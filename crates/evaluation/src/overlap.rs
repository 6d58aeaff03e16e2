//! Whether a robot pushes one part of itself through another: contact between its own parts is not simulated
//! unless it is asked for, and a film shows what a simulator lets pass.
//!
//! Each shape is taken for the largest capsule along its longest side that lies within it, so that what is
//! called an overlap is one.

use std::sync::Arc;

use caudata_model::{Geom, Kinematics, Pose, RobotModel, Shape, pose};

/// Overlaps up to this depth are not counted, m: capsules touch before the eye sees it.
pub const DEPTH_M: f64 = 1e-3;

/// A capsule on a link.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Capsule {
    link: usize,
    /// Ends of its axis in the link frame, m.
    ends_m: [[f64; 3]; 2],
    radius_m: f64,
}

/// The shapes of a robot, and which of them must not meet: those of links that are not neighbours, and that
/// do not meet in the nominal pose by construction.
#[derive(Clone, Debug)]
pub struct Shapes {
    model: Arc<RobotModel>,
    capsules: Vec<Capsule>,
    pairs: Vec<(usize, usize)>,
}

impl Shapes {
    /// The shapes of `model`.
    pub fn of(model: &Arc<RobotModel>) -> Self {
        let links = model.links().iter().enumerate();
        let capsules: Vec<Capsule> = links
            .flat_map(|(link, l)| l.geoms.iter().filter_map(move |g| capsule(link, g)))
            .collect();
        let mut shapes = Self { model: Arc::clone(model), capsules, pairs: Vec::new() };
        let mut at = Kinematics::default();
        if !shapes.place(model.nominal_pos_rad(), &mut at) {
            return shapes;
        }
        let parent = |l: usize| model.links()[l].parent;
        let neighbours = |a: usize, b: usize| {
            a == b || parent(a) == Some(b) || parent(b) == Some(a) || parent(a) == parent(b)
        };
        let placed = shapes.placed(&at);
        for i in 0..shapes.capsules.len() {
            for j in i + 1..shapes.capsules.len() {
                let (a, b) = (shapes.capsules[i].link, shapes.capsules[j].link);
                if !neighbours(a, b) && depth_m(&placed[i], &placed[j]) <= 0.0 {
                    shapes.pairs.push((i, j));
                }
            }
        }
        shapes
    }

    /// The foremost point of all shapes along the horizontal unit vector `ahead`, links placed as in `at`, m.
    pub fn foremost_m(&self, at: &Kinematics, ahead: [f64; 2]) -> f64 {
        let reach = |capsule: &Capsule| {
            let along = |end: [f64; 3]| {
                let at_m = at.links[capsule.link].point(end);
                at_m[0] * ahead[0] + at_m[1] * ahead[1]
            };
            capsule.ends_m.map(along).into_iter().fold(f64::MIN, f64::max) + capsule.radius_m
        };
        self.capsules.iter().map(reach).fold(f64::MIN, f64::max)
    }

    /// Depth of the deepest overlap at these positions of the actuated joints (rad), m; 0 where nothing
    /// meets. `at` is room to work in.
    pub fn deepest_m(&self, joint_pos_rad: &[f64], at: &mut Kinematics) -> f64 {
        if !self.place(joint_pos_rad, at) {
            return 0.0;
        }
        let placed = self.placed(at);
        let pairs = self.pairs.iter().map(|&(i, j)| (&placed[i], &placed[j]));
        let near = pairs.filter(|(a, b)| a.ball_meets(b));
        near.map(|(a, b)| depth_m(a, b)).fold(0.0, f64::max)
    }

    /// Places the links; false where the number of joints is not the robot's.
    fn place(&self, joint_pos_rad: &[f64], at: &mut Kinematics) -> bool {
        let full = self.model.full_pos_rad(joint_pos_rad);
        let placed = full.and_then(|q| self.model.kinematics_into(&Pose::IDENTITY, &q, at));
        placed.is_ok()
    }

    /// The shapes where links are placed as in `at`.
    fn placed(&self, at: &Kinematics) -> Vec<Placed> {
        let place = |c: &Capsule| {
            let ends_m = c.ends_m.map(|end| at.links[c.link].point(end));
            let middle_m = pose::add(ends_m[0], ends_m[1]).map(|x| 0.5 * x);
            let ball_m = c.radius_m + pose::norm(pose::sub(ends_m[1], middle_m));
            Placed { ends_m, radius_m: c.radius_m, middle_m, ball_m }
        };
        self.capsules.iter().map(place).collect()
    }
}

/// A capsule in the world, and the ball around it.
struct Placed {
    ends_m: [[f64; 3]; 2],
    radius_m: f64,
    middle_m: [f64; 3],
    ball_m: f64,
}

impl Placed {
    /// Whether the balls around two capsules meet: those of most pairs do not.
    fn ball_meets(&self, other: &Self) -> bool {
        let apart_m = pose::sub(self.middle_m, other.middle_m);
        pose::dot(apart_m, apart_m) < (self.ball_m + other.ball_m).powi(2)
    }
}

/// How deep two shapes are in each other, m; negative: how far apart they are.
fn depth_m(a: &Placed, b: &Placed) -> f64 {
    a.radius_m + b.radius_m - apart_m(a.ends_m, b.ends_m)
}

/// The capsule in a shape; `None` for a plane.
fn capsule(link: usize, geom: &Geom) -> Option<Capsule> {
    let along =
        |axis: usize, half_m: f64| std::array::from_fn(|i| if i == axis { half_m } else { 0.0 });
    let longest = |sizes: [f64; 3]| {
        let axis = (0..3).max_by(|&a, &b| sizes[a].total_cmp(&sizes[b])).unwrap_or(0);
        let across = (0..3).filter(|&i| i != axis).map(|i| sizes[i]);
        (axis, across.fold(f64::INFINITY, f64::min))
    };
    let (axis_m, radius_m): ([f64; 3], f64) = match geom.shape {
        Shape::Sphere { radius_m } => ([0.0; 3], radius_m),
        Shape::Capsule { radius_m, half_length_m } => (along(2, half_length_m), radius_m),
        Shape::Cylinder { radius_m, half_length_m } => {
            let radius_m = radius_m.min(half_length_m);
            (along(2, half_length_m - radius_m), radius_m)
        }
        Shape::Box { half_size_m } => {
            let (axis, radius_m) = longest(half_size_m);
            (along(axis, half_size_m[axis] - radius_m), radius_m)
        }
        // a ball of radius 0.8·b fits into an ellipsoid of semi-axes a > b up to 0.6·√(a² − b²) from its
        // middle, where a ball of radius b·√(1 − h²/(a² − b²)) touches it
        Shape::Ellipsoid { semi_axes_m } => {
            let (axis, b) = longest(semi_axes_m);
            let a = semi_axes_m[axis];
            match b > 0.8 * a {
                true => ([0.0; 3], b),
                false => (along(axis, 0.6 * (a * a - b * b).sqrt()), 0.8 * b),
            }
        }
        Shape::Plane => return None,
    };
    let end = |sign: f64| geom.link_from_geom.point(axis_m.map(|x| sign * x));
    Some(Capsule { link, ends_m: [end(-1.0), end(1.0)], radius_m })
}

/// Distance between two segments (Ericson 2004, "Real-Time Collision Detection", section 5.1.9), m.
fn apart_m([p, p_end]: [[f64; 3]; 2], [q, q_end]: [[f64; 3]; 2]) -> f64 {
    const POINT: f64 = 1e-18;
    let (d1, d2, r) = (pose::sub(p_end, p), pose::sub(q_end, q), pose::sub(p, q));
    let (a, e, f) = (pose::dot(d1, d1), pose::dot(d2, d2), pose::dot(d2, r));
    let (c, b) = (pose::dot(d1, r), pose::dot(d1, d2));
    let unit = |x: f64| x.clamp(0.0, 1.0);
    let denominator = a * e - b * b;
    let mut s = if denominator > POINT { unit((b * f - c * e) / denominator) } else { 0.0 };
    let t = if e > POINT { unit((b * s + f) / e) } else { 0.0 };
    if a > POINT {
        s = unit((b * t - c) / a);
    }
    let on =
        |from: [f64; 3], along: [f64; 3], share: f64| pose::add(from, along.map(|x| x * share));
    pose::norm(pose::sub(on(p, d1, s), on(q, d2, t)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anatomy::tests::polymander;

    #[test]
    fn distances_of_segments_by_hand() {
        let x = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        // crossing one above the other; beside its end; a point; parallel
        assert_eq!(apart_m(x, [[0.5, -1.0, 0.2], [0.5, 1.0, 0.2]]), 0.2);
        assert_eq!(apart_m(x, [[2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), 1.0);
        assert_eq!(apart_m(x, [[0.3, 0.4, 0.0], [0.3, 0.4, 0.0]]), 0.4);
        assert_eq!(apart_m(x, [[0.0, 0.0, 0.7], [1.0, 0.0, 0.7]]), 0.7);
    }

    #[test]
    fn a_head_turned_onto_a_leg_meets_it() {
        let model = polymander();
        let shapes = Shapes::of(&model);
        let deepest = |change: &[(usize, f64)]| {
            let mut q = model.nominal_pos_rad().to_vec();
            change.iter().for_each(|&(joint, rad)| q[joint] = rad);
            shapes.deepest_m(&q, &mut Kinematics::default())
        };
        assert_eq!(deepest(&[]), 0.0);
        // the head turned to one side, the fore leg of that side swung forward
        let met = [-1.2, 1.2]
            .map(|head| deepest(&[(0, head), (10, 1.2)]).max(deepest(&[(0, head), (8, 1.2)])));
        assert!(met.iter().all(|&depth_m| depth_m > DEPTH_M), "{met:?}");
    }
}
