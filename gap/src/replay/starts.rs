//! What was measured when a stretch begins.

use caudata_model::{JointMotion, Pose, RobotModel};

use super::cuts::{SPEED_WINDOW_S, Servos};
use crate::trial::{Channel, Kind, Trial, YAW};

/// What was measured when a stretch begins.
#[derive(Debug, Clone, Default)]
pub struct Start {
    /// Joint positions as shown, rad. `[A]`
    pub pos_rad: Vec<f64>,
    /// Joint velocities, rad/s. `[A]`
    pub vel_radps: Vec<f64>,
    /// Base position, world, m.
    pub base_pos_m: Option<[f64; 3]>,
    /// Roll, pitch, yaw of the base, rad.
    pub base_rpy_rad: Option<[f64; 3]>,
    /// Velocity of the base, world, m/s.
    pub base_vel_mps: Option<[f64; 3]>,
    /// Angular velocity of the base, body, rad/s.
    pub base_angvel_radps: Option<[f64; 3]>,
}

/// Roll and pitch of a body in which gravity points along (`gx`, `gy`, `gz`), rad: gravity in the body is
/// (sin p, −cos p·sin r, −cos p·cos r).
pub(super) fn roll_pitch(gx: f64, gy: f64, gz: f64) -> [f64; 2] {
    let pitch = gx.clamp(-1.0, 1.0).asin();
    [(-gy).atan2(-gz), pitch]
}

/// As measured at `t_s`.
pub(super) fn start(model: &RobotModel, trial: &Trial, t_s: f64) -> Start {
    let joints = model.actuated().len();
    let mut start = Start {
        pos_rad: model.nominal_pos_rad().to_vec(),
        vel_radps: vec![0.0; joints],
        ..Start::default()
    };
    for a in 0..joints {
        if let Some(c) = trial.channel(Kind::Position, a) {
            let (pos, slope) = line(c, t_s);
            start.pos_rad[a] = pos;
            start.vel_radps[a] = slope;
        }
        if let Some(c) = trial.channel(Kind::Velocity, a) {
            let near = c.time_s.partition_point(|&t| t < t_s).min(c.value.len() - 1);
            // a reported speed is less noisy than a difference of counts, and later: take the smaller
            let reported = c.value[near];
            let slope = start.vel_radps[a];
            start.vel_radps[a] = if reported * slope <= 0.0 {
                0.0
            } else if reported.abs() < slope.abs() {
                reported
            } else {
                slope
            };
        }
    }
    let three = |kind: Kind| -> Option<[(f64, f64); 3]> {
        let mut out = [(0.0, 0.0); 3];
        for (axis, out) in out.iter_mut().enumerate() {
            *out = line(trial.channel(kind, axis)?, t_s);
        }
        Some(out)
    };
    if let Some(p) = three(Kind::BasePosition) {
        start.base_pos_m = Some(p.map(|x| x.0));
        start.base_vel_mps = Some(p.map(|x| x.1));
    }
    if let Some(v) = three(Kind::BaseVelocity) {
        start.base_vel_mps = Some(v.map(|x| x.0));
    }
    let imu = ImuPlace::of(model, &start);
    let attitude = three(Kind::BaseAttitude).zip(trial.channel(Kind::BaseAttitude, 3));
    if let Some((a, gz)) = attitude {
        let [roll, pitch] = roll_pitch(a[0].0, a[1].0, line(gz, t_s).0);
        start.base_rpy_rad = Some([roll, pitch, a[YAW].0]);
    } else if let (Some(g), Some(imu)) = (three(Kind::Gravity), &imu) {
        let [gx, gy, gz] = imu.base_from_imu.rotate(g.map(|x| x.0));
        let [roll, pitch] = roll_pitch(gx, gy, gz);
        start.base_rpy_rad = Some([roll, pitch, 0.0]);
    }
    if let (Some(w), Some(imu)) = (three(Kind::Gyro), &imu) {
        let turned = imu.base_from_imu.rotate(w.map(|x| x.0));
        start.base_angvel_radps = Some([0, 1, 2].map(|i| turned[i] - imu.angvel_radps[i]));
    }
    start
}

/// Where the IMU is and how its link turns against the base, by the joints between the two.
pub(super) struct ImuPlace {
    pub base_from_imu: Pose,
    /// Angular velocity of the IMU's link less that of the base, in the base, rad/s.
    pub angvel_radps: [f64; 3],
}

impl ImuPlace {
    /// With joints as in `start`; what no servo moves is at rest in its zero. `None` where `start` does not
    /// fit the model.
    pub(super) fn of(model: &RobotModel, start: &Start) -> Option<Self> {
        let mut pos_rad = vec![0.0; model.joints().len()];
        let mut vel_radps = pos_rad.clone();
        for (a, &j) in model.actuated().iter().enumerate() {
            pos_rad[j] = start.pos_rad[a];
            vel_radps[j] = start.vel_radps[a];
        }
        let places = model.kinematics(&Pose::IDENTITY, &pos_rad).ok()?;
        let (link, link_from_imu) =
            model.imu_site().map_or((0, Pose::IDENTITY), |s| (s.link, s.link_from_site));
        let links = model.links();
        let carrying: Vec<usize> =
            std::iter::successors(Some(link), |&l| links[l].parent).collect();
        let mut angvel_radps = [0.0; 3];
        for (j, joint) in model.joints().iter().enumerate() {
            if carrying.contains(&joint.child_link) && joint.motion == JointMotion::Hinge {
                for (w, axis) in angvel_radps.iter_mut().zip(places.joints[j].axis) {
                    *w += axis * vel_radps[j];
                }
            }
        }
        Some(Self { base_from_imu: places.links[link].compose(&link_from_imu), angvel_radps })
    }
}

/// Joints that swing at `t_s`: position as it was read, speed from positions alone, since a servo's own
/// reading of it lags behind a swing, and from those before only where a servo that was let go or held again
/// has just changed it.
pub(super) fn swinging(model: &RobotModel, trial: &Trial, t_s: f64, servos: Servos) -> Start {
    let mut swinging = start(model, trial, t_s);
    let from_before = servos.just_switched(t_s);
    for a in 0..swinging.pos_rad.len() {
        if let Some(c) = trial.channel(Kind::Position, a) {
            let at_s = if from_before { t_s - SPEED_WINDOW_S } else { t_s };
            swinging.pos_rad[a] = c.at(t_s);
            swinging.vel_radps[a] = line(c, at_s).1;
        }
    }
    swinging
}

/// Value and slope of a channel at `t_s` by a straight line through its samples nearby.
pub(super) fn line(c: &Channel, t_s: f64) -> (f64, f64) {
    let low = c.time_s.partition_point(|&t| t < t_s - SPEED_WINDOW_S);
    let high = c.time_s.partition_point(|&t| t <= t_s + SPEED_WINDOW_S);
    let n = (high - low) as f64;
    if n < 1.0 {
        return across(c, t_s);
    }
    let (t, y) = (&c.time_s[low..high], &c.value[low..high]);
    let mean_t = t.iter().sum::<f64>() / n;
    let mean_y = y.iter().sum::<f64>() / n;
    let (mut sxx, mut sxy) = (0.0, 0.0);
    for (t, y) in t.iter().zip(y) {
        sxx += (t - mean_t).powi(2);
        sxy += (t - mean_t) * (y - mean_y);
    }
    let slope = if sxx > 1e-9 { sxy / sxx } else { 0.0 };
    (mean_y + slope * (t_s - mean_t), slope)
}

/// The same where there are no samples nearby (motion capture was covered): on the line between the last one
/// before and the first one after.
fn across(c: &Channel, t_s: f64) -> (f64, f64) {
    let last = c.value.len() - 1;
    let after = c.time_s.partition_point(|&t| t < t_s);
    if after == 0 || after > last {
        return (c.value[after.min(last)], 0.0);
    }
    let (from, to) = (after - 1, after);
    let slope = (c.value[to] - c.value[from]) / (c.time_s[to] - c.time_s[from]).max(1e-9);
    (c.value[from] + slope * (t_s - c.time_s[from]), slope)
}
