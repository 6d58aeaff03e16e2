//! What an eye sees: whether it is straight, alike on both sides, off its stops, and through itself.

use caudata_model::Kinematics;
use caudata_task::PerJoint;
use serde::{Deserialize, Serialize};

use crate::anatomy::Anatomy;
use crate::overlap::DEPTH_M;
use crate::trace::Frame;

/// A joint this near its end is at its stop, rad: 1°; a slide 1.75 mm.
const AT_STOP_RAD: f64 = 0.0175;
/// Every how many frames the robot is looked at for parts that meet.
const OVERLAP_EVERY: usize = 5;

/// One episode. Means are over its frames after settling.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Posture {
    /// Mean position of each joint, rad.
    pub mean_rad: PerJoint<f64>,
    /// Standard deviation of each joint, rad.
    pub swing_rad: PerJoint<f64>,
    /// How far each mean is from the nominal pose or, where that is nearer, from the mirror image of its
    /// counterpart's, rad.
    pub off_rad: PerJoint<f64>,
    /// Largest difference of the swing of a leg's joint and its counterpart's, rad.
    pub sides_apart_rad: f64,
    /// Share of time that each joint is at an end stop.
    pub at_stop_share: PerJoint<f64>,
    /// |mean yaw rate − commanded|, rad/s.
    pub yaw_off_radps: f64,
    /// |mean velocity to the left − commanded|, m/s.
    pub side_off_mps: f64,
    /// Power of the tail's joints over that of all.
    pub tail_power_share: f64,
    /// Largest share of a joint in the swing of the trunk; 0 where the trunk has fewer than two.
    pub trunk_bend_share: f64,
    /// Largest difference of the duty factors of a foot and the one on the other side.
    pub duty_apart: f64,
    /// Share of time that parts of the robot overlap.
    pub overlap_share: f64,
}

impl Posture {
    /// Measures some frames of one episode, in which each foot has this duty factor.
    pub(crate) fn of(frames: &[Frame], duty_factor: &[f64], anatomy: &Anatomy) -> Self {
        let joints = anatomy.nominal_rad.len();
        let n = frames.len().max(1) as f64;
        let mean = |value: &dyn Fn(&Frame) -> f64| frames.iter().map(value).sum::<f64>() / n;
        let each = |value: &dyn Fn(&Frame, usize) -> f64| {
            PerJoint::from_fn(joints, |j| mean(&|f| value(f, j)))
        };
        let mean_rad = each(&|f, j| f64::from(f.joint_pos_rad[j]));
        let variance = each(&|f, j| (f64::from(f.joint_pos_rad[j]) - mean_rad[j]).powi(2));
        let swing_rad = PerJoint::from_fn(joints, |j| variance[j].sqrt());
        let off = |j: usize| {
            let (other, sign) = anatomy.counterpart[j];
            let nominal = (mean_rad[j] - anatomy.nominal_rad[j]).abs();
            nominal.min((mean_rad[j] - sign * mean_rad[other]).abs())
        };
        let sides = (0..joints).filter(|&j| anatomy.in_leg[j]);
        let sides = sides.map(|j| (swing_rad[j] - swing_rad[anatomy.counterpart[j].0]).abs());
        let feet = duty_factor.iter().zip(&anatomy.other_foot);
        let duty = feet.map(|(own, &other)| (own - duty_factor[other]).abs());
        let power_w = each(&|f, j| f64::from(f.power_w[j].abs()));
        let tail_w: f64 = (0..joints).filter(|&j| anatomy.in_tail[j]).map(|j| power_w[j]).sum();
        Self {
            off_rad: PerJoint::from_fn(joints, off),
            sides_apart_rad: sides.fold(0.0, f64::max),
            at_stop_share: each(&|f, j| {
                let [low, high] = anatomy.range_rad[j];
                let q = f64::from(f.joint_pos_rad[j]);
                let near = AT_STOP_RAD * anatomy.per_radian[j];
                f64::from(u8::from(q < low + near || q > high - near))
            }),
            yaw_off_radps: mean(&|f| f64::from(f.yaw_rate_radps - f.command[2])).abs(),
            side_off_mps: mean(&|f| f64::from(f.velocity_mps[1] - f.command[1])).abs(),
            tail_power_share: tail_w / power_w.iter().sum::<f64>().max(f64::MIN_POSITIVE),
            trunk_bend_share: bend_share(&swing_rad, anatomy),
            duty_apart: duty.fold(0.0, f64::max),
            overlap_share: overlap_share(frames, anatomy),
            mean_rad,
            swing_rad,
        }
    }
}

/// Share of the most bent joint of the trunk.
fn bend_share(swing_rad: &[f64], anatomy: &Anatomy) -> f64 {
    let trunk = swing_rad.iter().zip(&anatomy.in_trunk).filter(|&(_, &is)| is);
    let bends: Vec<f64> = trunk.map(|(&bend, _)| bend).collect();
    let all: f64 = bends.iter().sum();
    if bends.len() > 1 && all > 0.0 { bends.iter().copied().fold(0.0, f64::max) / all } else { 0.0 }
}

/// Share of some frames in which parts of the robot overlap.
fn overlap_share(frames: &[Frame], anatomy: &Anatomy) -> f64 {
    let mut at = Kinematics::default();
    let mut meet = |frame: &&Frame| {
        let q = PerJoint::from_fn(frame.joint_pos_rad.len(), |j| f64::from(frame.joint_pos_rad[j]));
        anatomy.shapes.deepest_m(&q, &mut at) > DEPTH_M
    };
    let looked_at = frames.len().div_ceil(OVERLAP_EVERY).max(1);
    let met = frames.iter().step_by(OVERLAP_EVERY).filter(|f| meet(f));
    met.count() as f64 / looked_at as f64
}

/// A scenario: each joint's mean over its episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PostureResult {
    /// Mean position, rad.
    pub mean_rad: PerJoint<f64>,
    /// Standard deviation within an episode, rad.
    pub swing_rad: PerJoint<f64>,
    /// Nominal pose, rad.
    pub nominal_rad: PerJoint<f64>,
    /// Share of time at an end stop.
    pub at_stop_share: PerJoint<f64>,
}

impl PostureResult {
    pub(crate) fn of(postures: &[&Posture], anatomy: &Anatomy) -> Option<Self> {
        let n = postures.len() as f64;
        let joints = anatomy.nominal_rad.len();
        let mean = |value: &dyn Fn(&Posture) -> &PerJoint<f64>| {
            PerJoint::from_fn(joints, |j| postures.iter().map(|p| value(p)[j]).sum::<f64>() / n)
        };
        (!postures.is_empty()).then(|| Self {
            mean_rad: mean(&|p| &p.mean_rad),
            swing_rad: mean(&|p| &p.swing_rad),
            nominal_rad: anatomy.nominal_rad,
            at_stop_share: mean(&|p| &p.at_stop_share),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anatomy::tests::polymander;
    use std::f64::consts::TAU;

    /// 10 s: fore legs swing, by `left` and `right` rad; the head is held at `head_rad`, the tail swings.
    fn frames(head_rad: f32, left: f64, right: f64) -> Vec<Frame> {
        let frame = |i: i32| {
            let swing = (TAU * 0.02 * f64::from(i)).sin();
            let mut f = Frame::still(16, 4);
            f.joint_pos_rad = PerJoint::from_fn(16, |j| polymander_nominal(j) as f32);
            f.joint_pos_rad[0] = head_rad;
            f.joint_pos_rad[1] = (0.3 * swing) as f32;
            f.joint_pos_rad[2] = (0.1 * swing) as f32;
            f.joint_pos_rad[8] = (left * swing) as f32;
            f.joint_pos_rad[10] = (right * swing) as f32;
            f.power_w = PerJoint::from_fn(16, |j| if j == 6 { 1.0 } else { 0.2 });
            f.yaw_rate_radps = 0.05;
            f.command = [0.3, 0.0, 0.02];
            f
        };
        (0..500).map(frame).collect()
    }

    fn polymander_nominal(joint: usize) -> f64 {
        [36.0_f64, 36.0, 54.0, 54.0]
            .get(joint.wrapping_sub(9) / 2)
            .filter(|_| joint > 8 && joint % 2 == 1)
            .map_or(0.0, |deg| deg.to_radians())
    }

    #[test]
    fn figures_by_hand() {
        let anatomy = Anatomy::of(&polymander());
        let posture = Posture::of(&frames(0.5, 0.4, 0.2), &[0.5, 0.6, 0.5, 0.5], &anatomy);
        // the head is 0.5 rad from nominal, and 1 from its mirror image
        assert!((posture.off_rad[0] - 0.5).abs() < 1e-6);
        assert!(posture.off_rad[1..].iter().all(|&off| off < 1e-6));
        // standard deviations 0.4/√2 and 0.2/√2
        assert!((posture.sides_apart_rad - 0.2 / 2.0_f64.sqrt()).abs() < 1e-3);
        assert!((posture.duty_apart - 0.1).abs() < 1e-9);
        // three quarters of the trunk's bend
        assert!((posture.trunk_bend_share - 0.75).abs() < 1e-6);
        // 1 + 0.2 + 0.2 of 1 + 15·0.2
        assert!((posture.tail_power_share - 1.4 / 4.0).abs() < 1e-6);
        assert!((posture.yaw_off_radps - 0.03).abs() < 1e-6);
        assert!(posture.at_stop_share.iter().all(|&share| share == 0.0));
        let [_, high] = anatomy.range_rad[0];
        let at_stop = Posture::of(&frames(high as f32 - 0.01, 0.3, 0.3), &[0.5; 4], &anatomy);
        assert_eq!((at_stop.at_stop_share[0], at_stop.sides_apart_rad), (1.0, 0.0));
    }
}
