//! What is kept of an episode, step by step.

use caudata_env::VecEnv;
use caudata_task::{PerFoot, PerJoint};

/// The true state after one control step, and what was asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Frame {
    /// Command during the step: vx, vy (m/s), yaw rate (rad/s), heading frame.
    pub command: [f32; 3],
    /// Velocity of the whole body's centre of mass, heading frame, m/s.
    pub velocity_mps: [f32; 2],
    /// Yaw rate of the whole body (I⁻¹L), rad/s.
    pub yaw_rate_radps: f32,
    /// Centre of mass of the whole body, world, m.
    pub com_m: [f32; 3],
    /// Yaw of the line from hind to front girdle, rad.
    pub heading_rad: f32,
    /// Cosine of the base's tilt: 1 upright, −1 on its back.
    pub upright: f32,
    /// Height of each foot's lowest point above the ground, m.
    pub foot_height_m: PerFoot,
    /// Horizontal speed of each foot, m/s.
    pub foot_speed_mps: PerFoot,
    /// Vertical contact force on each foot, N.
    pub foot_force_n: PerFoot,
    /// Contact force on trunk and legs but not the feet, N.
    pub trunk_force_n: f32,
    /// Contact force on the tail, N.
    pub tail_force_n: f32,
    /// Position of each actuated joint, rad.
    pub joint_pos_rad: PerJoint,
    /// Velocity of each actuated joint, rad/s.
    pub joint_vel_radps: PerJoint,
    /// Torque of each motor, mean over the step, N·m.
    pub torque_nm: PerJoint,
    /// Mechanical power of each motor, mean over the step, W.
    pub power_w: PerJoint,
}

impl Frame {
    /// All zeros, for a robot with so many actuated joints and feet.
    pub fn still(joints: usize, feet: usize) -> Self {
        let (per_joint, per_foot) = (PerJoint::filled(joints, 0.0), PerFoot::filled(feet, 0.0));
        Self {
            foot_height_m: per_foot,
            foot_speed_mps: per_foot,
            foot_force_n: per_foot,
            joint_pos_rad: per_joint,
            joint_vel_radps: per_joint,
            torque_nm: per_joint,
            power_w: per_joint,
            ..Self::default()
        }
    }

    /// Reads one lane of `env` after a step that did not end its episode.
    pub fn read(env: &VecEnv, lane: usize) -> Self {
        let truth = env.truth(lane);
        let state = env.state();
        let [vx, vy, _] = truth.com_vel_mps;
        Self {
            command: env.command(lane),
            velocity_mps: [vx, vy],
            yaw_rate_radps: truth.yaw_rate_radps,
            com_m: std::array::from_fn(|i| state.com_pos_m[3 * lane + i]),
            heading_rad: state.heading_rad[lane],
            upright: upright(&state.base_quat_wxyz[4 * lane..]),
            foot_height_m: truth.foot_height_m,
            foot_speed_mps: truth.foot_vel_mps.map(|[x, y, _]| x.hypot(y)),
            foot_force_n: truth.foot_force_n.map(|[_, _, z]| z),
            trunk_force_n: truth.trunk_force_n,
            tail_force_n: state.tail_force_n[lane],
            joint_pos_rad: truth.joint_pos_rad,
            joint_vel_radps: truth.joint_vel_radps,
            torque_nm: truth.motor_torque_nm,
            power_w: truth.mech_power_w,
        }
    }
}

/// The z component of the base's z axis in the world, of world_from_base as w x y z.
fn upright(quat_wxyz: &[f32]) -> f32 {
    1.0 - 2.0 * (quat_wxyz[1] * quat_wxyz[1] + quat_wxyz[2] * quat_wxyz[2])
}

/// One episode.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace {
    /// Time between two frames, s.
    pub period_s: f64,
    /// Stride frequency of the gait clock, Hz.
    pub clock_hz: f64,
    /// The steps, oldest first. The last step of an episode is missing: the next one had begun when it could
    /// be read.
    pub frames: Vec<Frame>,
    /// Why the episode ended before its time; `None`: it lasted.
    pub fell: Option<&'static str>,
}

impl Trace {
    /// The frames from `from_s` on.
    pub fn after(&self, from_s: f64) -> &[Frame] {
        let first = (from_s / self.period_s).round() as usize;
        self.frames.get(first..).unwrap_or_default()
    }
}

/// An episode that can be shown: its trace, and the pose of the whole robot at each of its frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Film {
    /// What happened.
    pub trace: Trace,
    /// One pose per frame.
    pub poses: Vec<RobotPose>,
}

/// Where every part of the robot is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RobotPose {
    /// Origin of the base link, world, m.
    pub base_pos_m: [f32; 3],
    /// world_from_base, w x y z.
    pub base_quat_wxyz: [f32; 4],
    /// Every joint, model order, rad. `[J]`
    pub joint_pos_rad: Vec<f32>,
}

impl RobotPose {
    /// Reads one lane of `env`.
    pub fn read(env: &VecEnv, lane: usize) -> Self {
        let state = env.state();
        Self {
            base_pos_m: std::array::from_fn(|i| state.base_pos_m[3 * lane + i]),
            base_quat_wxyz: std::array::from_fn(|i| state.base_quat_wxyz[4 * lane + i]),
            joint_pos_rad: state.joint_pos_rad[lane * state.joints..][..state.joints].to_vec(),
        }
    }
}

/// How fast an episode went: for means and bands over all episodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Track {
    /// Commanded vx, vy (m/s) and yaw rate (rad/s), then the same achieved, per frame.
    pub rows: Vec<[f32; 6]>,
}

impl Track {
    /// Takes the velocities out of a trace.
    pub fn of(trace: &Trace) -> Self {
        let row = |f: &Frame| {
            let ([cx, cy, cw], [vx, vy]) = (f.command, f.velocity_mps);
            [cx, cy, cw, vx, vy, f.yaw_rate_radps]
        };
        Self { rows: trace.frames.iter().map(row).collect() }
    }
}
