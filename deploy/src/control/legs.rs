//! How fast a robot goes, told by its legs (leg odometry): the lowest point of the foot that stands does not move, so
//! the trunk moves by as much as that point moves the other way. The foot that stands is the one that is lowest
//! beside its own mean: so a slope, or an IMU that is mounted off level, does not decide. A foot that slides is not
//! told from one that holds.

use std::sync::Arc;

use caudata_model::pose::{Pose, add, cross, dot, sub};
use caudata_model::{Ball, Kinematics, RobotModel, Site};
use caudata_task::{COMMAND_DIM, PerJoint};

/// Ticks over which the mean height of a foot is taken (1 s, longer than a stride).
const MEAN_TICKS: f64 = 50.0;

/// Leg odometry of one robot.
#[derive(Clone, Debug)]
pub struct LegOdometry {
    model: Arc<RobotModel>,
    /// What of each foot may touch the ground.
    feet: Vec<Touching>,
    /// What of the trunk may.
    trunk: Vec<Touching>,
    /// Link and pose of the IMU's frame in it.
    imu: (usize, Pose),
    pos_rad: Vec<f64>,
    kinematics: Kinematics,
    /// `imu_from_link` of this tick, one per link, and of the one before; empty until then.
    now: Vec<Pose>,
    last: Vec<Pose>,
    /// Mean height of each foot in the IMU's frame, m; empty until the first tick.
    mean_m: Vec<f64>,
}

/// What the legs are asked at one tick. All in the IMU's frame.
#[derive(Clone, Copy, Debug)]
pub struct Posture<'a> {
    /// Joint angles, rad, policy order.
    pub pos_rad: &'a PerJoint,
    /// Angular velocity without its bias, rad/s.
    pub gyro_radps: [f64; 3],
    /// Away from gravity, unit vector.
    pub up: [f64; 3],
    /// Since the tick before, s.
    pub dt_s: f64,
}

/// What may touch the ground on a link: balls, link frame.
#[derive(Clone, Debug)]
struct Touching {
    link: usize,
    balls: Vec<Ball>,
}

impl Touching {
    /// The lowest point, IMU frame, m.
    fn lowest(&self, imu_from_link: &[Pose], up: [f64; 3]) -> Option<[f64; 3]> {
        let pose = imu_from_link.get(self.link)?;
        let bottom = |ball: &Ball| add(pose.point(ball.centre_m), up.map(|u| -u * ball.radius_m));
        let bottoms = self.balls.iter().map(bottom);
        bottoms.min_by(|a, b| dot(*a, up).total_cmp(&dot(*b, up)))
    }
}

impl LegOdometry {
    /// `None` for a robot with fewer than two feet: one foot is back where it was after each hop.
    pub fn new(model: Arc<RobotModel>) -> Option<Self> {
        let feet: Vec<_> = model
            .feet()
            .iter()
            .map(|foot| Touching { link: foot.link, balls: foot.balls.clone() })
            .collect();
        let trunk = (0..model.links().len())
            .filter(|&link| model.carries_feet(link) && model.leg_of(link).is_none())
            .map(|link| trunk(&model, link))
            .collect();
        let imu =
            model.imu_site().map_or((0, Pose::IDENTITY), |site| (site.link, site.link_from_site));
        (feet.len() > 1).then(|| Self {
            feet,
            trunk,
            imu,
            pos_rad: vec![0.0; model.joints().len()],
            kinematics: Kinematics::default(),
            now: Vec::new(),
            last: Vec::new(),
            mean_m: Vec::new(),
            model,
        })
    }

    /// Forward and sideways velocity of the IMU's place along the robot's heading, m/s, and its yaw rate, rad/s,
    /// since the tick before. No velocity where the trunk is as low as the feet; `None` for the first tick, and where
    /// readings are no numbers.
    pub fn velocity(&mut self, posture: &Posture) -> Option<[f64; COMMAND_DIM]> {
        let &Posture { gyro_radps, up, dt_s, .. } = posture;
        self.place(posture.pos_rad)?;
        let (link, point_m) = self.standing(up)?;
        let before = self.last.get(link)?.point(self.now[link].inverse().point(point_m));
        let velocity = match dt_s > 0.0 && !self.lies(up) {
            true => {
                let shift = sub(before, point_m).map(|m| m / dt_s);
                sub(shift, cross(gyro_radps, point_m))
            }
            false => [0.0; 3],
        };
        let along = self.heading();
        let along = sub(along, up.map(|u| u * dot(along, up)));
        let size = dot(along, along).sqrt();
        let forward = along.map(|x| x / size);
        let left = cross(up, forward);
        let velocity = [dot(velocity, forward), dot(velocity, left), dot(gyro_radps, up)];
        velocity.iter().all(|v| v.is_finite()).then_some(velocity)
    }

    /// Works out where all links are.
    fn place(&mut self, pos_rad: &PerJoint) -> Option<()> {
        for (&joint, &pos_rad) in self.model.actuated().iter().zip(pos_rad.iter()) {
            self.pos_rad[joint] = f64::from(pos_rad);
        }
        let kinematics = &mut self.kinematics;
        self.model.kinematics_into(&Pose::IDENTITY, &self.pos_rad, kinematics).ok()?;
        let (link, link_from_imu) = self.imu;
        let imu_from_base = kinematics.links[link].compose(&link_from_imu).inverse();
        std::mem::swap(&mut self.now, &mut self.last);
        self.now.clear();
        let poses = kinematics.links.iter();
        self.now.extend(poses.map(|pose| imu_from_base.compose(pose)));
        Some(())
    }

    /// Link and lowest point, IMU frame, m, of the foot that stands.
    fn standing(&mut self, up: [f64; 3]) -> Option<(usize, [f64; 3])> {
        let first = self.mean_m.is_empty();
        let mut deepest: Option<(f64, usize, [f64; 3])> = None;
        for (number, foot) in self.feet.iter().enumerate() {
            let point_m = foot.lowest(&self.now, up)?;
            let height_m = dot(point_m, up);
            if !height_m.is_finite() {
                return None;
            }
            if first {
                self.mean_m.push(height_m);
            }
            let mean_m = &mut self.mean_m[number];
            let depth_m = *mean_m - height_m;
            *mean_m -= depth_m / MEAN_TICKS;
            if deepest.is_none_or(|(most_m, ..)| depth_m > most_m) {
                deepest = Some((depth_m, foot.link, point_m));
            }
        }
        deepest.map(|(_, link, point_m)| (link, point_m))
    }

    /// Whether the trunk is lower than every foot.
    fn lies(&self, up: [f64; 3]) -> bool {
        let least = |all: &[Touching]| {
            let heights = all.iter().filter_map(|t| t.lowest(&self.now, up));
            heights.map(|point_m| dot(point_m, up)).fold(f64::INFINITY, f64::min)
        };
        least(&self.trunk) < least(&self.feet)
    }

    /// Along the robot's heading, IMU frame, any length: from the hind to the front site, else x of the root link.
    fn heading(&self) -> [f64; 3] {
        let place = |site: &Site| self.now[site.link].point(site.link_from_site.pos_m);
        match self.model.heading_sites() {
            Some((hind, front)) => sub(place(front), place(hind)),
            None => self.now[0].rotate([1.0, 0.0, 0.0]),
        }
    }
}

/// What of a link of the trunk may touch the ground.
fn trunk(model: &RobotModel, link: usize) -> Touching {
    let geoms = model.links()[link].geoms.iter().filter(|geom| geom.collides());
    let balls = geoms.filter_map(|geom| {
        let (centres, radius_m) = geom.shape.balls()?;
        Some(
            centres
                .into_iter()
                .map(move |centre| Ball { centre_m: geom.link_from_geom.point(centre), radius_m }),
        )
    });
    Touching { link, balls: balls.flatten().collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::model;

    /// The standing robot, with the joints that end in `part` moved by `shift_rad`, policy order.
    fn standing(model: &RobotModel, part: &str, shift_rad: f64) -> PerJoint {
        let names = model.actuated_names();
        PerJoint::from_fn(names.len(), |j| {
            let shift = if names[j].ends_with(part) { shift_rad } else { 0.0 };
            (model.nominal_pos_rad()[j] + shift) as f32
        })
    }

    #[test]
    fn a_trunk_that_turns_about_its_foot() {
        let model = model();
        let mut legs = LegOdometry::new(model.clone()).unwrap();
        let now = Posture {
            pos_rad: &standing(&model, "", 0.0),
            gyro_radps: [0.0, 0.0, 0.5],
            up: [0.0, 0.0, 1.0],
            dt_s: 0.02,
        };
        assert_eq!(legs.velocity(&now), None, "the first tick");
        let [vx, vy, yaw] = legs.velocity(&now).unwrap();
        let (_, foot_m) = legs.standing(now.up).unwrap();
        // the foot at (x, y) of the IMU stands: the IMU goes by −ω × r = ω · (y, −x)
        assert!((vx - 0.5 * foot_m[1]).abs() < 1e-6, "{vx} {foot_m:?}");
        assert!((vy + 0.5 * foot_m[0]).abs() < 1e-6, "{vy} {foot_m:?}");
        assert!((yaw - 0.5).abs() < 1e-9);
    }

    #[test]
    fn a_robot_on_its_back_goes_nowhere() {
        let model = model();
        let mut legs = LegOdometry::new(model.clone()).unwrap();
        let mut paddles = |shift_rad: f64| {
            legs.velocity(&Posture {
                pos_rad: &standing(&model, "_hip", shift_rad),
                gyro_radps: [0.0; 3],
                up: [0.0, 0.0, -1.0],
                dt_s: 0.02,
            })
        };
        paddles(0.0);
        assert_eq!(paddles(0.1), Some([0.0; COMMAND_DIM]));
    }

    /// A trot on ideal servos, its velocity by the legs as the mean over 10 s, by gravity off level by `tilt_rad`.
    fn trots(tilt_rad: f64) -> f64 {
        let model = model();
        let names = model.actuated_names();
        let mut legs = LegOdometry::new(model.clone()).unwrap();
        let mut sum = 0.0;
        for tick in 0..500 {
            let phase = std::f64::consts::TAU * 0.02 * f64::from(tick);
            let pos_rad = PerJoint::from_fn(names.len(), |j| {
                let (leg, joint) = names[j].split_once('_').unwrap();
                let side = if matches!(leg, "FR" | "HL") { -1.0 } else { 1.0 };
                let swing = match joint {
                    "hip" => 0.3 * side * phase.cos(),
                    "knee" => 0.2 * side * phase.sin(),
                    _ => 0.0,
                };
                (model.nominal_pos_rad()[j] + swing) as f32
            });
            let going = legs.velocity(&Posture {
                pos_rad: &pos_rad,
                gyro_radps: [0.0; 3],
                up: [-tilt_rad.sin(), 0.0, tilt_rad.cos()],
                dt_s: 0.02,
            });
            sum += going.map_or(0.0, |v| v[0]);
        }
        sum / 500.0
    }

    #[test]
    fn a_slope_does_not_decide_which_foot_stands() {
        // The foot is 8 to 12 cm from the hip: 2 · 0.3 rad of it in half a second are some 0.1 m/s.
        let level = trots(0.0);
        assert!((0.07..0.2).contains(&level), "{level}");
        for tilt_rad in [0.17, -0.17] {
            let share = trots(tilt_rad) / level;
            assert!((0.8..1.2).contains(&share), "{tilt_rad}: {share}");
        }
    }
}
