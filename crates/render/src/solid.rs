//! Where rays meet the shapes of a model.

use caudata_model::pose::dot;
use caudata_model::{Pose, Shape};

use crate::vector::{Vec3, unit};

/// Nearest distances that count: a ray that leaves a surface does not meet it again.
const NEAR_M: f64 = 1e-6;

/// A ray, `from + t·along` with unit `along`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ray {
    pub from: Vec3,
    pub along: Vec3,
}

impl Ray {
    pub fn at(&self, t: f64) -> Vec3 {
        [0, 1, 2].map(|i| self.from[i] + t * self.along[i])
    }
}

/// Where a ray first meets a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Hit {
    /// Distance along the ray, m.
    pub t: f64,
    /// Outward unit normal.
    pub normal: Vec3,
}

/// A shape in the world, ready to be met.
#[derive(Clone, Debug)]
pub(crate) struct Solid {
    shape: Shape,
    centre: Vec3,
    /// Rows: the shape's axes in the world.
    axes: [Vec3; 3],
    /// Radius of a ball around it.
    reach: f64,
}

impl Solid {
    /// `None` for a plane, which belongs to the ground.
    pub fn new(shape: Shape, world_from_shape: &Pose) -> Option<Self> {
        let reach = match shape {
            Shape::Sphere { radius_m } => radius_m,
            Shape::Capsule { radius_m, half_length_m } => radius_m + half_length_m,
            Shape::Cylinder { radius_m, half_length_m } => radius_m.hypot(half_length_m),
            Shape::Box { half_size_m } => dot(half_size_m, half_size_m).sqrt(),
            Shape::Ellipsoid { semi_axes_m } => semi_axes_m.into_iter().fold(0.0, f64::max),
            Shape::Plane => return None,
        };
        let m = world_from_shape.rotation();
        Some(Self {
            shape,
            centre: world_from_shape.pos_m,
            axes: [0, 1, 2].map(|c| [m[0][c], m[1][c], m[2][c]]),
            reach,
        })
    }

    /// Centre and radius of a ball around it.
    pub fn bounds(&self) -> (Vec3, f64) {
        (self.centre, self.reach)
    }

    /// First meeting from outside nearer than `far`.
    pub fn meet(&self, ray: &Ray, far: f64) -> Option<Hit> {
        let to = [0, 1, 2].map(|i| ray.from[i] - self.centre[i]);
        let b = dot(to, ray.along);
        let beside = dot(to, to) - b * b;
        if beside > self.reach * self.reach || -b + self.reach < 0.0 {
            return None;
        }
        let o = self.axes.map(|axis| dot(axis, to));
        let d = self.axes.map(|axis| dot(axis, ray.along));
        let (t, local) = match self.shape {
            Shape::Sphere { radius_m } => ball(o, d, radius_m)?,
            Shape::Box { half_size_m } => cuboid(o, d, half_size_m)?,
            Shape::Ellipsoid { semi_axes_m } => ellipsoid(o, d, semi_axes_m)?,
            Shape::Cylinder { radius_m, half_length_m } => cylinder(o, d, radius_m, half_length_m)?,
            Shape::Capsule { radius_m, half_length_m } => capsule(o, d, radius_m, half_length_m)?,
            Shape::Plane => return None,
        };
        let normal = [0, 1, 2].map(|i| (0..3).map(|k| self.axes[k][i] * local[k]).sum());
        (t > NEAR_M && t < far).then_some(Hit { t, normal })
    }
}

/// Smaller root of a·t² + 2·b·t + c = 0.
fn first_root(a: f64, b: f64, c: f64) -> Option<f64> {
    let discriminant = b * b - a * c;
    (a > 0.0 && discriminant >= 0.0).then(|| (-b - discriminant.sqrt()) / a)
}

fn ball(o: Vec3, d: Vec3, radius: f64) -> Option<(f64, Vec3)> {
    let t = first_root(dot(d, d), dot(o, d), dot(o, o) - radius * radius)?;
    Some((t, unit([0, 1, 2].map(|i| o[i] + t * d[i]))))
}

fn ellipsoid(o: Vec3, d: Vec3, semi: Vec3) -> Option<(f64, Vec3)> {
    let (os, ds) = ([0, 1, 2].map(|i| o[i] / semi[i]), [0, 1, 2].map(|i| d[i] / semi[i]));
    let t = first_root(dot(ds, ds), dot(os, ds), dot(os, os) - 1.0)?;
    Some((t, unit([0, 1, 2].map(|i| (os[i] + t * ds[i]) / semi[i]))))
}

fn cuboid(o: Vec3, d: Vec3, half: Vec3) -> Option<(f64, Vec3)> {
    let (mut enter, mut leave, mut side) = (f64::NEG_INFINITY, f64::INFINITY, 0);
    for i in 0..3 {
        if d[i] == 0.0 {
            if o[i].abs() > half[i] {
                return None;
            }
            continue;
        }
        let (a, b) = ((-half[i] - o[i]) / d[i], (half[i] - o[i]) / d[i]);
        if a.min(b) > enter {
            (enter, side) = (a.min(b), i);
        }
        leave = leave.min(a.max(b));
    }
    if enter > leave {
        return None;
    }
    let mut normal = [0.0; 3];
    normal[side] = -d[side].signum();
    Some((enter, normal))
}

/// The side of a cylinder about z.
fn tube(o: Vec3, d: Vec3, radius: f64) -> Option<(f64, Vec3)> {
    let t = first_root(
        d[0] * d[0] + d[1] * d[1],
        o[0] * d[0] + o[1] * d[1],
        o[0] * o[0] + o[1] * o[1] - radius * radius,
    )?;
    Some((t, [(o[0] + t * d[0]) / radius, (o[1] + t * d[1]) / radius, 0.0]))
}

fn cylinder(o: Vec3, d: Vec3, radius: f64, half: f64) -> Option<(f64, Vec3)> {
    if let Some((t, normal)) = tube(o, d, radius)
        && (o[2] + t * d[2]).abs() <= half
    {
        return Some((t, normal));
    }
    if d[2] == 0.0 {
        return None;
    }
    // the lid on the ray's side
    let lid = -d[2].signum();
    let t = (lid * half - o[2]) / d[2];
    let (x, y) = (o[0] + t * d[0], o[1] + t * d[1]);
    (x.hypot(y) <= radius).then_some((t, [0.0, 0.0, lid]))
}

fn capsule(o: Vec3, d: Vec3, radius: f64, half: f64) -> Option<(f64, Vec3)> {
    if let Some((t, normal)) = tube(o, d, radius)
        && (o[2] + t * d[2]).abs() <= half
    {
        return Some((t, normal));
    }
    let ends = [-half, half].map(|z| ball([o[0], o[1], o[2] - z], d, radius));
    ends.into_iter().flatten().min_by(|a, b| a.0.total_cmp(&b.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From (x, y, 5) straight down.
    fn down(shape: Shape, x: f64, y: f64) -> Option<Hit> {
        let ray = Ray { from: [x, y, 5.0], along: [0.0, 0.0, -1.0] };
        Solid::new(shape, &Pose::IDENTITY).unwrap().meet(&ray, 1e9)
    }

    fn near(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-12, "{a} is not {b}");
    }

    #[test]
    fn shapes_are_met_where_they_are() {
        let ball = Shape::Sphere { radius_m: 1.0 };
        near(down(ball, 0.6, 0.0).unwrap().t, 5.0 - 0.8);
        near(down(ball, 0.6, 0.0).unwrap().normal[0], 0.6);
        assert_eq!(down(ball, 0.8, 0.7), None);
        let cuboid = Shape::Box { half_size_m: [1.0, 2.0, 3.0] };
        near(down(cuboid, 0.9, -1.9).unwrap().t, 2.0);
        assert_eq!(down(cuboid, 1.1, 0.0), None);
        let upright = Shape::Cylinder { radius_m: 1.0, half_length_m: 2.0 };
        near(down(upright, 0.6, 0.7).unwrap().t, 3.0);
        let pill = Shape::Capsule { radius_m: 1.0, half_length_m: 2.0 };
        // the upper end ball: 2 + √(1 − 0.36)
        near(down(pill, 0.6, 0.0).unwrap().t, 5.0 - 2.8);
        let egg = Shape::Ellipsoid { semi_axes_m: [1.0, 1.0, 2.0] };
        near(down(egg, 0.6, 0.0).unwrap().t, 5.0 - 1.6);
    }

    #[test]
    fn a_lying_capsule_is_met_on_its_side() {
        // turned by 90° about y: its axis is x
        let turn =
            caudata_model::pose::quat_from_axis_angle([0.0, 1.0, 0.0], std::f64::consts::FRAC_PI_2);
        let pose = Pose { pos_m: [0.0; 3], quat_wxyz: turn };
        let pill = Shape::Capsule { radius_m: 0.5, half_length_m: 2.0 };
        let ray = Ray { from: [1.5, 0.3, 5.0], along: [0.0, 0.0, -1.0] };
        let hit = Solid::new(pill, &pose).unwrap().meet(&ray, 1e9).unwrap();
        near(hit.t, 5.0 - 0.4);
        near(hit.normal[1], 0.6);
        near(hit.normal[2], 0.8);
    }
}
