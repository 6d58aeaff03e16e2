//! Volumes and inertias of shapes, and inertias put together.

use crate::pose::{self, Pose};
use crate::types::{Geom, Shape, Softness};

/// Mass, centre of mass (m) and inertia about it (kg·m²), in the axes of the frame that it is seen from.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Inertial {
    pub mass_kg: f64,
    pub com_m: [f64; 3],
    pub inertia_kgm2: [[f64; 3]; 3],
}

impl Inertial {
    /// The same in an outer frame.
    pub fn seen_from(&self, outer_from_own: &Pose) -> Self {
        Self {
            mass_kg: self.mass_kg,
            com_m: outer_from_own.point(self.com_m),
            inertia_kgm2: pose::rotate_tensor(outer_from_own.quat_wxyz, self.inertia_kgm2),
        }
    }

    /// Both together.
    pub fn with(&self, other: &Self) -> Self {
        let mass_kg = self.mass_kg + other.mass_kg;
        if mass_kg <= 0.0 {
            return *self;
        }
        let weighted = |i: usize| self.mass_kg * self.com_m[i] + other.mass_kg * other.com_m[i];
        let com_m = [0, 1, 2].map(|i| weighted(i) / mass_kg);
        let mut inertia_kgm2 = [[0.0; 3]; 3];
        for part in [self, other] {
            let d = pose::sub(part.com_m, com_m);
            let square = pose::dot(d, d);
            for r in 0..3 {
                for c in 0..3 {
                    let own = if r == c { square } else { 0.0 } - d[r] * d[c];
                    inertia_kgm2[r][c] += part.inertia_kgm2[r][c] + part.mass_kg * own;
                }
            }
        }
        Self { mass_kg, com_m, inertia_kgm2 }
    }

    /// Principal moments all their mean where one exceeds the sum of the other two (MuJoCo's
    /// `balanceinertia`); only for inertias about the axes.
    pub fn balanced(mut self) -> Self {
        let i = self.inertia_kgm2;
        let [a, b, c] = [i[0][0], i[1][1], i[2][2]];
        if a + b < c || b + c < a || c + a < b {
            let mean = (a + b + c) / 3.0;
            self.inertia_kgm2 = diagonal([mean; 3]);
        }
        self
    }
}

/// Thinner than this nothing is drawn, m.
const THIN_M: f64 = 5e-4;

impl Inertial {
    /// The box of even density that has this inertia, to be looked at.
    pub fn drawn(&self) -> Geom {
        let ([x, y, z], quat_wxyz) = principal(self.inertia_kgm2);
        let half = |rest: f64| (1.5 * rest / self.mass_kg).max(0.0).sqrt().max(THIN_M);
        Geom {
            name: None,
            shape: Shape::Box { half_size_m: [y + z - x, z + x - y, x + y - z].map(half) },
            link_from_geom: Pose { pos_m: self.com_m, quat_wxyz },
            friction: 0.0,
            contype: 0,
            conaffinity: 0,
            soft: Softness::default(),
        }
    }
}

/// Turns of the search for principal axes; each halves the number of digits that are missing.
const SWEEPS: usize = 32;

/// Principal moments and the frame that they are about, seen from the given one (Jacobi's rotations).
pub(crate) fn principal(inertia: [[f64; 3]; 3]) -> ([f64; 3], [f64; 4]) {
    let mut m = inertia;
    let mut axes = diagonal([1.0; 3]);
    for _ in 0..SWEEPS {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if m[p][q] == 0.0 {
                continue;
            }
            let angle = 0.5 * (2.0 * m[p][q]).atan2(m[q][q] - m[p][p]);
            let (s, c) = angle.sin_cos();
            // columns p and q, then rows p and q
            for row in m.iter_mut().chain(&mut axes) {
                let (a, b) = (row[p], row[q]);
                row[p] = c * a - s * b;
                row[q] = s * a + c * b;
            }
            for k in 0..3 {
                let (a, b) = (m[p][k], m[q][k]);
                m[p][k] = c * a - s * b;
                m[q][k] = s * a + c * b;
            }
            (m[p][q], m[q][p]) = (0.0, 0.0);
        }
    }
    let column = |k: usize| [axes[0][k], axes[1][k], axes[2][k]];
    let quat = pose::quat_from_axes(column(0), column(1));
    ([m[0][0], m[1][1], m[2][2]], quat.unwrap_or(Pose::IDENTITY.quat_wxyz))
}

pub(crate) fn diagonal([x, y, z]: [f64; 3]) -> [[f64; 3]; 3] {
    [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]
}

/// A solid of density 1 about its own centre: volume (m³), centre, moments per density.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Solid {
    pub volume_m3: f64,
    pub centre_m: [f64; 3],
    /// About the centre, m⁵.
    pub moments: [[f64; 3]; 3],
}

impl Solid {
    /// A primitive, about its frame; `None` for a plane.
    pub fn of(shape: &Shape) -> Option<Self> {
        use std::f64::consts::PI;
        // volume, and moments for mass 1
        let (volume_m3, [x, y, z]) = match *shape {
            Shape::Sphere { radius_m: r } => (4.0 / 3.0 * PI * r.powi(3), [0.4 * r * r; 3]),
            Shape::Box { half_size_m: [a, b, c] } => {
                let (a2, b2, c2) = (a * a, b * b, c * c);
                (8.0 * a * b * c, [b2 + c2, a2 + c2, a2 + b2].map(|s| s / 3.0))
            }
            Shape::Ellipsoid { semi_axes_m: [a, b, c] } => {
                let (a2, b2, c2) = (a * a, b * b, c * c);
                let moments = [b2 + c2, a2 + c2, a2 + b2].map(|s| s / 5.0);
                (4.0 / 3.0 * PI * a * b * c, moments)
            }
            Shape::Cylinder { radius_m: r, half_length_m: h } => {
                let across = (3.0 * r * r + 4.0 * h * h) / 12.0;
                (2.0 * PI * r * r * h, [across, across, 0.5 * r * r])
            }
            Shape::Capsule { radius_m: r, half_length_m: h } => {
                let (rod, ball) = (2.0 * PI * r * r * h, 4.0 / 3.0 * PI * r.powi(3));
                let all = rod + ball;
                // half balls: their centres are 3/8 of the radius beyond the rod's ends
                let across = rod * (3.0 * r * r + 4.0 * h * h) / 12.0
                    + ball * (0.4 * r * r + h * h + 0.75 * r * h);
                let along = rod * 0.5 * r * r + ball * 0.4 * r * r;
                (all, [across / all, across / all, along / all])
            }
            Shape::Plane => return None,
        };
        Some(Self {
            volume_m3,
            centre_m: [0.0; 3],
            moments: diagonal([x, y, z].map(|m| m * volume_m3)),
        })
    }

    /// With this mass, seen from the frame in which the shape lies at `at`.
    pub fn with_mass(&self, mass_kg: f64, at: &Pose) -> Inertial {
        let density = mass_kg / self.volume_m3;
        Inertial {
            mass_kg,
            com_m: self.centre_m,
            inertia_kgm2: self.moments.map(|row| row.map(|m| m * density)),
        }
        .seen_from(at)
    }

    /// What stands for a mass that does not matter: 1 kg within 0.1 m.
    pub fn unit_ball() -> Inertial {
        Inertial { mass_kg: 1.0, com_m: [0.0; 3], inertia_kgm2: diagonal([0.004; 3]) }
    }
}

/// Whether an inertia tensor can belong to a body.
///
/// The second moments Σ = ½·tr(I)·E − I = ∫ r rᵀ dm must be positive semi-definite: that is the triangle
/// inequality of the principal moments (each at most the sum of the other two). A 3×3 matrix is, when all its
/// principal minors are ≥ 0.
pub(crate) fn check_inertia(i: [[f64; 3]; 3]) -> Result<(), String> {
    let half_trace = 0.5 * (i[0][0] + i[1][1] + i[2][2]);
    if !(i[0][0] > 0.0 && i[1][1] > 0.0 && i[2][2] > 0.0) {
        return Err("the moments of inertia must be above zero".to_owned());
    }
    // scaled to trace 1, so that the tolerance is relative
    let s = |r: usize, c: usize| {
        (if r == c { half_trace - i[r][c] } else { -i[r][c] }) / (2.0 * half_trace)
    };
    let minor2 = |a: usize, b: usize| s(a, a) * s(b, b) - s(a, b) * s(b, a);
    let det = s(0, 0) * minor2(1, 2) - s(0, 1) * (s(1, 0) * s(2, 2) - s(1, 2) * s(2, 0))
        + s(0, 2) * (s(1, 0) * s(2, 1) - s(1, 1) * s(2, 0));
    let minors = [s(0, 0), s(1, 1), s(2, 2), minor2(0, 1), minor2(0, 2), minor2(1, 2), det];
    const TOLERANCE: f64 = 1e-9;
    if minors.iter().any(|m| *m < -TOLERANCE) {
        return Err(
            "no body has this inertia: a principal moment exceeds the sum of the other two \
                    (triangle inequality)"
                .to_owned(),
        );
    }
    Ok(())
}

/// The inertia of a body that is nearest to one that no body has: its negative second moments become as good as 0.
pub(crate) fn nearest_inertia(inertia: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let ([a, b, c], axes) = principal(inertia);
    // enough for figures that are rounded to nine digits
    let least = 1e-6 * (a + b + c).abs();
    let [x, y, z] = [b + c - a, c + a - b, a + b - c].map(|twice| (0.5 * twice).max(least));
    pose::rotate_tensor(axes, diagonal([y + z, z + x, x + y]))
}

/// Whether shapes for the eye among the `geoms` of a link stand for those that touch, which are not drawn then. A nose
/// beside a trunk does not: they must fill a third of that. (A salamander's lower leg, slim about two balls that touch,
/// fills half.)
pub fn has_shell(geoms: &[Geom]) -> bool {
    const FILLS: f64 = 1.0 / 3.0;
    let filled_m3 = |touching: bool| -> f64 {
        let geoms = geoms.iter().filter(|g| g.collides() == touching);
        geoms.filter_map(|g| Solid::of(&g.shape)).map(|solid| solid.volume_m3).sum()
    };
    let shell_m3 = filled_m3(false);
    shell_m3 > 0.0 && shell_m3 >= FILLS * filled_m3(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn near(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-12 * b.abs().max(1.0), "{a} is not {b}");
    }

    #[test]
    fn inertia_of_a_thin_rod_is_the_limit_of_what_exists() {
        let diag = |a: f64, b: f64, c: f64| [[a, 0.0, 0.0], [0.0, b, 0.0], [0.0, 0.0, c]];
        // thin rod along x: (0, m l²/12, m l²/12); nearly that is fine
        assert!(check_inertia(diag(1e-9, 1.0, 1.0)).is_ok());
        // disc: Izz = Ixx + Iyy, the other limit
        assert!(check_inertia(diag(1.0, 1.0, 2.0)).is_ok());
        assert!(check_inertia(diag(1.0, 1.0, 2.001)).is_err());
        assert!(check_inertia(diag(0.0, 1.0, 1.0)).is_err());
        // positive diagonal, but not a tensor of anything: off-diagonal larger than the diagonal allows
        assert!(check_inertia([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 1.0]]).is_err());
        // Σ = [[0.5, -0.4, 0], [-0.4, 0.5, 0], [0, 0, 0.5]] is positive definite
        assert!(check_inertia([[1.0, 0.4, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]]).is_ok());
    }

    /// A box of 0.2 × 0.1 × 0.1 m holds 2 l, a ball of 5 cm 0.52 l, one of 6 cm 0.90 l.
    #[test]
    fn a_nose_is_no_shell_of_a_trunk() {
        let geom = |shape: Shape, touches: bool| Geom {
            shape,
            contype: u32::from(touches),
            conaffinity: u32::from(touches),
            name: None,
            link_from_geom: Pose::IDENTITY,
            friction: 1.0,
            soft: Softness::default(),
        };
        let trunk = geom(Shape::Box { half_size_m: [0.1, 0.05, 0.05] }, true);
        let ball = |radius_m| geom(Shape::Sphere { radius_m }, false);
        assert!(!has_shell(std::slice::from_ref(&trunk)));
        assert!(!has_shell(&[trunk.clone(), ball(0.05)]));
        assert!(has_shell(&[trunk, ball(0.06)]));
    }

    /// Where a robot that ships has shapes for the eye, what touches (balls at knees) is not drawn.
    #[test]
    fn robots_that_ship_are_drawn_by_their_shells() {
        for name in ["polymander", "quadruped", "biped", "hexapod", "snake"] {
            let file = format!("{}/../../robots/{name}.robot.toml", env!("CARGO_MANIFEST_DIR"));
            let model = crate::RobotModel::load(file.as_ref()).unwrap();
            for link in model.links().iter().filter(|l| l.geoms.iter().any(|g| !g.collides())) {
                assert!(has_shell(&link.geoms), "{name} {}", link.name);
            }
        }
    }

    /// Σ of (1, 2, 4) is (2.5, 1.5, −0.5); with 0 in its place the moments are 1.5, 2.5 and 4.
    #[test]
    fn the_nearest_inertia_has_no_negative_second_moment() {
        let turn = pose::quat_normalised([0.9, 0.1, -0.3, 0.2]).unwrap();
        let near_to = |moments| nearest_inertia(pose::rotate_tensor(turn, diagonal(moments)));
        let found = near_to([1.0, 2.0, 4.0]);
        assert!(check_inertia(found).is_ok());
        let right = pose::rotate_tensor(turn, diagonal([1.5, 2.5, 4.0]));
        for i in 0..9 {
            assert!((found[i / 3][i % 3] - right[i / 3][i % 3]).abs() < 2e-5, "{found:?}");
        }
        // what a body can have stays
        let same = near_to([3.0, 4.0, 5.0]);
        near(same[0][0], pose::rotate_tensor(turn, diagonal([3.0, 4.0, 5.0]))[0][0]);
    }

    #[test]
    fn a_box_of_two_halves_is_the_box() {
        // 0.2 × 0.4 × 0.6 m of 2 kg cut across x
        let half = Shape::Box { half_size_m: [0.05, 0.2, 0.3] };
        let whole = Shape::Box { half_size_m: [0.1, 0.2, 0.3] };
        let at = |x: f64| Pose::from_pos([x, 0.0, 0.0]);
        let piece = |x: f64| Solid::of(&half).unwrap().with_mass(1.0, &at(x));
        let both = piece(-0.05).with(&piece(0.05));
        let one = Solid::of(&whole).unwrap().with_mass(2.0, &at(0.0));
        near(both.mass_kg, 2.0);
        for i in 0..3 {
            near(both.com_m[i], 0.0);
            near(both.inertia_kgm2[i][i], one.inertia_kgm2[i][i]);
        }
        // m/12·(y² + z²) = 2/12·(0.16 + 0.36)
        near(one.inertia_kgm2[0][0], 2.0 / 12.0 * 0.52);
    }

    #[test]
    fn principal_moments_turned_back_are_the_tensor() {
        let quat = pose::quat_normalised([0.3, -0.4, 0.5, 0.7]).unwrap();
        for moments in [[1.0, 2.0, 2.5], [1.0, 1.0, 1.5], [1e-6, 3e-6, 3.5e-6]] {
            let tensor = pose::rotate_tensor(quat, diagonal(moments));
            let (mut found, turn) = principal(tensor);
            let back = pose::rotate_tensor(turn, diagonal(found));
            for i in 0..9 {
                let off = (back[i / 3][i % 3] - tensor[i / 3][i % 3]).abs();
                assert!(off < 1e-14 * moments[2], "{off}");
            }
            found.sort_by(f64::total_cmp);
            for i in 0..3 {
                assert!((found[i] - moments[i]).abs() < 1e-14 * moments[2]);
            }
        }
    }

    #[test]
    fn a_capsule_without_a_rod_is_a_ball_and_a_long_one_a_rod() {
        let ball = Solid::of(&Shape::Sphere { radius_m: 0.1 }).unwrap();
        let capsule = Shape::Capsule { radius_m: 0.1, half_length_m: 0.0 };
        let capsule = Solid::of(&capsule).unwrap();
        near(capsule.volume_m3, ball.volume_m3);
        near(capsule.moments[0][0], ball.moments[0][0]);
        near(capsule.moments[2][2], ball.moments[2][2]);
        let thin = Shape::Capsule { radius_m: 1e-6, half_length_m: 0.5 };
        let thin = Solid::of(&thin).unwrap();
        // m·l²/12
        assert!((thin.moments[0][0] / thin.volume_m3 - 1.0 / 12.0).abs() < 1e-5);
    }
}
