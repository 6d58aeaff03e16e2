//! Where a robot is by its legs alone (dead reckoning): the velocities of [`LegOdometry`](crate::control::LegOdometry)
//! added up, in a frame that is level, begins where it begins, and drifts away from the world for ever.
//!
//! Height, roll and pitch are not added up: the lowest foot is at 0, gravity is down. Feet that slide count as walking.
//! Afloat, and where the legs tell nothing, the place stays and its uncertainty grows.

use std::sync::Arc;

use caudata_model::pose::{Pose, add, cross, dot, norm, quat_from_axes, quat_from_axis_angle, sub};
use caudata_model::{RobotModel, Site};

use crate::tap::Tick;

/// Error of a way by the legs, as a share of it (standard deviation): straight ahead the shipped policies' legs tell
/// 0.87 to 1.1 of what they walk; sideways in a turn it may be half.
const WAY_SHARE: f64 = 0.1;
/// Error of a velocity by the legs at one tick: the trunk sways and feet land, m/s.
const TICK_MPS: f64 = 0.1;
/// A robot of which nothing is told may go this fast, m/s.
const UNTOLD_MPS: f64 = 0.5;
/// Error of a gyroscope's reading, rad/s, and of the direction of gravity, rad.
const GYRO_RADPS: f64 = 0.02;
const LEVEL_RAD: f64 = 0.03;
/// Variance of what nobody measures.
pub const UNKNOWN: f64 = 1e6;
/// Where a robot is that was started again elsewhere, m.
const ANYWHERE_M: f64 = 1e3;
/// Ticks further apart than this were not seen: what came between is not known, s.
const APART_MAX_S: f64 = 0.5;

/// A place and a velocity by the legs. Variances are of x, y, z and the turns about these.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reckoned {
    /// Root link in the frame where it began.
    pub pose: Pose,
    /// m², rad².
    pub pose_variance: [f64; 6],
    /// Velocity of the root link in its own frame, m/s.
    pub linear_mps: [f64; 3],
    /// Its turning in the same frame, rad/s.
    pub angular_radps: [f64; 3],
    /// m²/s², rad²/s².
    pub twist_variance: [f64; 6],
}

/// Adds up ticks of one robot.
#[derive(Clone, Debug)]
pub struct DeadReckoning {
    robot: Arc<RobotModel>,
    time_s: Option<f64>,
    /// Place of the IMU, m; the root link begins at 0.
    place_m: Option<[f64; 2]>,
    /// Which axis of the IMU's site shows its yaw: the one that was most level at first.
    axis: Option<[f64; 3]>,
    /// Yaw of that axis; the heading begins at 0.
    yaw_rad: f64,
    /// Standard deviation of the yaw, rad.
    yaw_error_rad: f64,
    /// Length of the way, m.
    way_m: f64,
    /// How far the place is off because the yaw is, m.
    aside_m: f64,
    /// How far the robot may have gone untold, m.
    untold_m: f64,
}

impl DeadReckoning {
    /// At the beginning.
    pub fn new(robot: Arc<RobotModel>) -> Self {
        Self {
            robot,
            time_s: None,
            place_m: None,
            axis: None,
            yaw_rad: 0.0,
            yaw_error_rad: 0.0,
            way_m: 0.0,
            aside_m: 0.0,
            untold_m: 0.0,
        }
    }

    /// Adds a tick; `None` where its readings are no numbers or no robot's.
    pub fn add(&mut self, tick: &Tick) -> Option<Reckoned> {
        let measured: Vec<f64> = tick.pos_rad.iter().map(|x| f64::from(*x)).collect();
        let joints = self.robot.full_pos_rad(&measured).ok()?;
        let links = self.robot.kinematics(&Pose::IDENTITY, &joints).ok()?.links;
        let imu = self.robot.imu_site();
        let base_from_imu =
            imu.map_or(Pose::IDENTITY, |s| links[s.link].compose(&s.link_from_site));
        let up = base_from_imu.rotate(tick.gravity.map(|g| -f64::from(g)));
        let turn_radps = base_from_imu.rotate(tick.gyro_radps.map(f64::from));
        let place = |site: &Site| links[site.link].point(site.link_from_site.pos_m);
        let along = match self.robot.heading_sites() {
            Some((hind, front)) => sub(place(front), place(hind)),
            None => [1.0, 0.0, 0.0],
        };
        let along = sub(along, up.map(|u| u * dot(along, up)));
        let bend_rad = self.bend_rad(&base_from_imu, up, along);
        if self.time_s.is_none() {
            self.yaw_rad = -bend_rad;
        }
        // the heading's frame stands at the IMU: forward, left, up
        let base_from_heading = Pose {
            pos_m: base_from_imu.pos_m,
            quat_wxyz: quat_from_axes(along, cross(up, along))?,
        };
        let going = tick.going.map(|going| going.map(f64::from));
        let [vx, vy, yaw_radps] = going.unwrap_or([0.0, 0.0, dot(turn_radps, up)]);
        if ![vx, vy, yaw_radps, norm(turn_radps)].iter().all(|x| x.is_finite()) {
            return None;
        }
        let heights = self.robot.feet().iter().flat_map(|foot| {
            let link = links[foot.link];
            let bottom =
                move |b: &caudata_model::Ball| dot(link.point(b.centre_m), up) - b.radius_m;
            foot.balls.iter().map(bottom)
        });
        let lowest_m = heights.fold(f64::INFINITY, f64::min);
        let lowest_m = if lowest_m.is_finite() { lowest_m } else { 0.0 };
        self.go_on(tick.time_s, [vx, vy, yaw_radps], bend_rad, going.is_some());

        let turned = quat_from_axis_angle([0.0, 0.0, 1.0], self.yaw_rad + bend_rad);
        let odom_from_imu = Pose { pos_m: [0.0; 3], quat_wxyz: turned };
        let base = odom_from_imu.compose(&base_from_heading.inverse());
        let [x, y] = *self.place_m.get_or_insert([-base.pos_m[0], -base.pos_m[1]]);
        let z = dot(base_from_heading.pos_m, up) - lowest_m;
        let pose = Pose { pos_m: add(base.pos_m, [x, y, z]), ..base };
        let linear = base_from_heading.rotate([vx, vy, 0.0]);
        let place = (WAY_SHARE * self.way_m).powi(2) + self.aside_m.powi(2) + self.untold_m.powi(2);
        let speed = match going {
            Some(_) => TICK_MPS.powi(2) + (WAY_SHARE * vx.hypot(vy)).powi(2),
            None => UNKNOWN,
        };
        let [level, gyro] = [LEVEL_RAD.powi(2), GYRO_RADPS.powi(2)];
        Some(Reckoned {
            pose,
            pose_variance: [place, place, UNKNOWN, level, level, self.yaw_error_rad.powi(2)],
            linear_mps: sub(linear, cross(turn_radps, base_from_heading.pos_m)),
            angular_radps: turn_radps,
            twist_variance: [speed, speed, UNKNOWN, gyro, gyro, gyro],
        })
    }

    /// How far `along` is to the left of the IMU's axis about `up`: the gyroscope turns with the IMU's link, and a
    /// spine bends between that and the heading.
    fn bend_rad(&mut self, base_from_imu: &Pose, up: [f64; 3], along: [f64; 3]) -> f64 {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let steep = |axis: &[f64; 3]| dot(base_from_imu.rotate(*axis), up).abs();
        let flattest = axes.into_iter().min_by(|a, b| steep(a).total_cmp(&steep(b)));
        let axis = *self.axis.get_or_insert(flattest.unwrap_or(axes[0]));
        let axis = base_from_imu.rotate(axis);
        let axis = sub(axis, up.map(|u| u * dot(axis, up)));
        dot(cross(axis, along), up).atan2(dot(axis, along))
    }

    /// Moves on to `time_s` with forward and sideways velocities of the heading, if these are told, and the turning
    /// of the IMU; the heading is `bend_rad` to the left of the IMU's axis.
    fn go_on(&mut self, time_s: f64, [vx, vy, yaw_radps]: [f64; 3], bend_rad: f64, told: bool) {
        let passed_s = self.time_s.map_or(0.0, |before| time_s - before);
        self.time_s = Some(time_s);
        if passed_s < 0.0 {
            // its program was started again, and it may have been carried
            self.yaw_error_rad = std::f64::consts::PI;
            self.untold_m = ANYWHERE_M;
            return;
        }
        let seen_s = if passed_s > APART_MAX_S { 0.0 } else { passed_s };
        let middle_rad = self.yaw_rad + bend_rad + 0.5 * yaw_radps * seen_s;
        self.yaw_rad += yaw_radps * seen_s;
        // nothing shows a bias about the vertical
        let bias_radps = (self.robot.sensors().imu.as_ref()).map_or(0.0, |i| i.gyro_bias_std_radps);
        self.yaw_error_rad += bias_radps * passed_s;
        if seen_s < passed_s {
            // it may look anywhere
            self.yaw_error_rad = std::f64::consts::PI;
        }
        if !told || seen_s < passed_s {
            self.untold_m += UNTOLD_MPS * passed_s;
            return;
        }
        let (sin, cos) = middle_rad.sin_cos();
        if let Some([x, y]) = &mut self.place_m {
            *x += (vx * cos - vy * sin) * seen_s;
            *y += (vx * sin + vy * cos) * seen_s;
        }
        let way_m = vx.hypot(vy) * seen_s;
        self.way_m += way_m;
        self.aside_m += way_m * self.yaw_error_rad;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::model;
    use caudata_task::PerJoint;

    fn tick(time_s: f64, going: Option<[f32; 3]>, gyro_z_radps: f32) -> Tick {
        let pos_rad = PerJoint::from_fn(16, |j| model().nominal_pos_rad()[j] as f32);
        let zero = [0.0; 16].into();
        Tick {
            time_s,
            pos_rad,
            vel_radps: zero,
            current_a: zero,
            target_rad: zero,
            gyro_radps: [0.0, 0.0, gyro_z_radps],
            acc_mps2: [0.0, 0.0, 9.81],
            gravity: [0.0, 0.0, -1.0],
            going,
            supply_v: 12.0,
            stage: crate::motion::Stage::Walk,
            fault: None,
            policy_version: 1,
            overruns: 0,
            late_readings: 0,
            hottest_c: 30,
        }
    }

    #[test]
    fn a_quarter_of_a_circle_ends_where_geometry_says() {
        let mut legs = DeadReckoning::new(model());
        let mut here = legs.add(&tick(0.0, None, 0.0)).unwrap();
        assert_eq!(here.pose.pos_m[..2], [0.0, 0.0]);
        // the lowest foot is on the ground, and the robot above it
        assert!((0.02..0.12).contains(&here.pose.pos_m[2]), "{here:?}");
        let rate = std::f32::consts::FRAC_PI_2 / 5.0;
        let imu = |r: &Reckoned| {
            let model = model();
            let (site, joints) = (model.imu_site().unwrap(), model.nominal_pos_rad());
            let joints = model.full_pos_rad(joints).unwrap();
            let links = model.kinematics(&r.pose, &joints).unwrap().links;
            links[site.link].compose(&site.link_from_site).pos_m
        };
        let begun = imu(&here);
        for k in 1..=250 {
            let now = tick(0.02 * f64::from(k), Some([0.2, 0.0, rate]), rate);
            here = legs.add(&now).unwrap();
        }
        // the IMU goes round with radius v/ω, from (0, 0) to (r, r)
        let radius_m = 0.2 / f64::from(rate);
        let went = sub(imu(&here), begun);
        assert!((went[0] - radius_m).abs() < 1e-3 && (went[1] - radius_m).abs() < 1e-3, "{went:?}");
        // 1 m: a tenth of it, and what the yaw's error does
        let sd_m = here.pose_variance[0].sqrt();
        assert!((0.1..0.11).contains(&sd_m), "{sd_m}");
    }

    /// The spine bends and the IMU does not turn: neither does its link.
    #[test]
    fn a_bent_spine_turns_the_heading_and_not_the_link_of_the_imu() {
        let mut legs = DeadReckoning::new(model());
        let straight = legs.add(&tick(0.0, Some([0.0; 3]), 0.0)).unwrap();
        let mut bent = tick(0.02, Some([0.0; 3]), 0.0);
        let robot = model();
        for (joint, name) in robot.actuated_names().iter().enumerate() {
            if name.starts_with("spine") {
                bent.pos_rad[joint] += 0.2;
            }
        }
        let here = legs.add(&bent).unwrap();
        let level = |pose: &Pose| {
            let (site, pos) = (model().imu_site().cloned().unwrap(), bent.pos_rad);
            let measured: Vec<f64> = match pose == &straight.pose {
                true => model().nominal_pos_rad().to_vec(),
                false => pos.iter().map(|x| f64::from(*x)).collect(),
            };
            let joints = model().full_pos_rad(&measured).unwrap();
            let links = model().kinematics(pose, &joints).unwrap().links;
            links[site.link].rotate([1.0, 0.0, 0.0])
        };
        let (before, after) = (level(&straight.pose), level(&here.pose));
        assert!(norm(sub(before, after)) < 1e-6, "{before:?} {after:?}");
        // a program that was started again knows its place no more
        let again = legs.add(&tick(0.0, Some([0.0; 3]), 0.0)).unwrap();
        assert!(again.pose_variance[0] >= UNKNOWN, "{again:?}");
    }

    #[test]
    fn what_nobody_tells_makes_the_place_uncertain_and_does_not_move_it() {
        let mut legs = DeadReckoning::new(model());
        legs.add(&tick(0.0, None, 0.0)).unwrap();
        let walks = legs.add(&tick(0.02, Some([0.3, 0.0, 0.0]), 0.0)).unwrap();
        // afloat for 2 s
        let swims = (2..=101).map(|k| legs.add(&tick(0.02 * f64::from(k), None, 0.0)).unwrap());
        let swims = swims.last().unwrap();
        assert_eq!(swims.pose, walks.pose);
        assert!((swims.pose_variance[0].sqrt() - 1.0).abs() < 0.01, "{swims:?}");
        assert_eq!((swims.linear_mps, swims.twist_variance[0]), ([0.0; 3], UNKNOWN));
        // a minute that nobody saw
        let later = legs.add(&tick(62.02, Some([0.3, 0.0, 0.0]), 0.0)).unwrap();
        assert_eq!(later.pose, walks.pose);
        assert!(later.pose_variance[0].sqrt() > 30.0 && later.pose_variance[5].sqrt() > 3.0);
        // readings that are no numbers are no place
        assert_eq!(legs.add(&tick(62.04, Some([f32::NAN, 0.0, 0.0]), 0.0)), None);
    }
}
