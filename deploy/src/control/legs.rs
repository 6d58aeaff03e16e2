//! How fast a robot goes, told by its legs (leg odometry): the lowest point of the lowest foot stands on the ground,
//! so the trunk moves by as much as that point moves the other way. A foot that slides is not told from one that
//! holds.

use std::sync::Arc;

use caudata_model::pose::{Pose, add, cross, dot, sub};
use caudata_model::{Ball, Kinematics, RobotModel};
use caudata_task::COMMAND_DIM;

use super::plan::Sensed;

/// Leg odometry of one robot.
#[derive(Clone, Debug)]
pub struct LegOdometry {
    model: Arc<RobotModel>,
    /// Balls that may touch the ground, by link; of a foot, or of the trunk.
    touching: Vec<(usize, bool, Vec<Ball>)>,
    /// Link and pose of the IMU's frame in it.
    imu: (usize, Pose),
    pos_rad: Vec<f64>,
    kinematics: Kinematics,
    /// `imu_from_link` of this tick, one per link, and of the one before; empty until then.
    now: Vec<Pose>,
    last: Vec<Pose>,
}

impl LegOdometry {
    /// `None` for a robot without feet, without an IMU or without a heading.
    pub fn new(model: Arc<RobotModel>) -> Option<Self> {
        let imu = model
            .imu_site()
            .map(|site| (site.link, site.link_from_site))?;
        model.heading_sites()?;
        let feet = model
            .feet()
            .iter()
            .map(|foot| (foot.link, true, foot.balls.clone()));
        let mut touching: Vec<_> = feet.collect();
        if touching.is_empty() {
            return None;
        }
        for link in (0..model.links().len())
            .filter(|&link| model.carries_feet(link) && model.leg_of(link).is_none())
        {
            touching.push((link, false, trunk(&model, link)));
        }
        Some(Self {
            touching,
            imu,
            pos_rad: vec![0.0; model.joints().len()],
            kinematics: Kinematics::default(),
            now: Vec::new(),
            last: Vec::new(),
            model,
        })
    }

    /// Forward and sideways velocity of the IMU's place along the robot's heading, m/s, and its yaw rate, rad/s,
    /// since the tick `dt_s` ago. No velocity where the trunk is as low as the feet; `None` for the first tick, and
    /// where readings are no numbers.
    pub fn velocity(&mut self, sensed: &Sensed, dt_s: f64) -> Option<[f64; COMMAND_DIM]> {
        for (&joint, &pos_rad) in self
            .model
            .actuated()
            .iter()
            .zip(sensed.servos.pos_rad.iter())
        {
            self.pos_rad[joint] = f64::from(pos_rad);
        }
        let kinematics = &mut self.kinematics;
        self.model
            .kinematics_into(&Pose::IDENTITY, &self.pos_rad, kinematics)
            .ok()?;
        let (link, link_from_imu) = self.imu;
        let imu_from_base = kinematics.links[link].compose(&link_from_imu).inverse();
        std::mem::swap(&mut self.now, &mut self.last);
        self.now.clear();
        let poses = kinematics.links.iter();
        self.now
            .extend(poses.map(|pose| imu_from_base.compose(pose)));
        let up = sensed.gravity.map(|g| -f64::from(g));
        let gyro_radps = sensed.imu.gyro_radps.map(f64::from);
        let yaw_radps = dot(gyro_radps, up);
        let (link, on_foot, point_m) = self.lowest(up)?;
        let before = self
            .last
            .get(link)?
            .point(self.now[link].inverse().point(point_m));
        let velocity = match on_foot && dt_s > 0.0 {
            true => {
                let shift = sub(before, point_m).map(|m| m / dt_s);
                sub(shift, cross(gyro_radps, point_m))
            }
            false => [0.0; 3],
        };
        let (hind, front) = self.model.heading_sites()?;
        let place =
            |site: &caudata_model::Site| self.now[site.link].point(site.link_from_site.pos_m);
        let along = sub(place(front), place(hind));
        let along = sub(along, up.map(|u| u * dot(along, up)));
        let size = dot(along, along).sqrt();
        let forward = along.map(|x| x / size);
        let velocity = [
            dot(velocity, forward),
            dot(velocity, cross(up, forward)),
            yaw_radps,
        ];
        velocity.iter().all(|v| v.is_finite()).then_some(velocity)
    }

    /// The lowest point, IMU frame, m; its link; whether it is a foot's.
    fn lowest(&self, up: [f64; 3]) -> Option<(usize, bool, [f64; 3])> {
        let points = self.touching.iter().flat_map(|(link, foot, balls)| {
            let pose = &self.now[*link];
            balls.iter().map(move |ball| {
                let point = add(pose.point(ball.centre_m), up.map(|u| -u * ball.radius_m));
                (*link, *foot, point)
            })
        });
        points.min_by(|a, b| dot(a.2, up).total_cmp(&dot(b.2, up)))
    }
}

/// The balls that stand for what may touch the ground on a link, link frame.
fn trunk(model: &RobotModel, link: usize) -> Vec<Ball> {
    let geoms = model.links()[link]
        .geoms
        .iter()
        .filter(|geom| geom.collides());
    let balls = geoms.filter_map(|geom| {
        let (centres, radius_m) = geom.shape.balls()?;
        Some(centres.into_iter().map(move |centre| Ball {
            centre_m: geom.link_from_geom.point(centre),
            radius_m,
        }))
    });
    balls.flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::{GroundTruth, Health, ImuReading, ServoReadings};
    use crate::testing::model;
    use caudata_task::PerJoint;

    /// The standing robot with one angle in all joints of that name's end, turning at `yaw_radps`.
    fn sensed(model: &RobotModel, joints: &str, shift_rad: f64, yaw_radps: f32) -> Sensed {
        let names = model.actuated_names();
        let pos_rad = PerJoint::from_fn(names.len(), |j| {
            let shift = if names[j].ends_with(joints) {
                shift_rad
            } else {
                0.0
            };
            (model.nominal_pos_rad()[j] + shift) as f32
        });
        Sensed {
            servos: ServoReadings {
                time_s: 0.0,
                pos_rad,
                vel_radps: pos_rad.map(|_| 0.0),
                current_a: pos_rad.map(|_| 0.0),
                supply_v: 12.0,
            },
            imu: ImuReading {
                gyro_radps: [0.0, 0.0, yaw_radps],
                acc_mps2: [0.0, 0.0, 9.81],
                gravity: None,
            },
            gravity: [0.0, 0.0, -1.0],
            truth: GroundTruth::default(),
            health: Health::default(),
            in_water: None,
        }
    }

    #[test]
    fn a_trunk_that_turns_about_its_foot() {
        let model = model();
        let mut legs = LegOdometry::new(model.clone()).unwrap();
        let now = sensed(&model, "none", 0.0, 0.5);
        assert_eq!(legs.velocity(&now, 0.02), None, "the first tick");
        let [vx, vy, yaw] = legs.velocity(&now, 0.02).unwrap();
        let (_, on_foot, foot_m) = legs.lowest([0.0, 0.0, 1.0]).unwrap();
        assert!(on_foot);
        // the foot at (x, y) of the IMU stands: the IMU goes by −ω × r = ω · (y, −x)
        assert!((vx - 0.5 * foot_m[1]).abs() < 1e-6, "{vx} {foot_m:?}");
        assert!((vy + 0.5 * foot_m[0]).abs() < 1e-6, "{vy} {foot_m:?}");
        assert!((yaw - 0.5).abs() < 1e-9);
    }

    #[test]
    fn a_robot_on_its_belly_goes_nowhere() {
        let model = model();
        let mut legs = LegOdometry::new(model.clone()).unwrap();
        let mut lying = sensed(&model, "none", 0.0, 0.0);
        lying.gravity = [0.0, 0.0, 1.0];
        legs.velocity(&lying, 0.02);
        let mut paddling = sensed(&model, "_hip", 0.1, 0.0);
        paddling.gravity = lying.gravity;
        assert_eq!(legs.velocity(&paddling, 0.02), Some([0.0; COMMAND_DIM]));
    }
}
