//! A measured run as diagnosis sees it: commands, switches, and sampled channels with their own stamps.

use caudata_declare::named;
use caudata_model::RobotModel;
use caudata_runlog::{BaseHold, LogMeta, RunLog};

use crate::units::at_joint;

/// What a run is used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Parameters are fitted to it.
    Fit,
    /// Only judged on it.
    Holdout,
}

/// A run to diagnose.
#[derive(Debug, Clone)]
pub struct Run {
    /// Folder name.
    pub name: String,
    /// Its rows and circumstances.
    pub log: RunLog,
    /// What it is used for.
    pub role: Role,
    /// SHA-256 of the log file, hexadecimal; for the report.
    pub sha256: String,
}

named! {
    /// Kind of a measured channel.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
    pub enum Kind {
        /// Joint position, rad.
        Position = "pos",
        /// Joint position by a second encoder on the other side of the gear, rad.
        SecondPosition = "pos2",
        /// Joint velocity as reported, rad/s.
        Velocity = "vel",
        /// Motor current, A.
        Current = "cur",
        /// Motor torque, N·m.
        Torque = "tau",
        /// Supply voltage, V.
        Voltage = "volt",
        /// Angular velocity in the IMU frame, rad/s.
        Gyro = "imu.gyro",
        /// Specific force in the IMU frame, m/s².
        Acceleration = "imu.acc",
        /// Direction of gravity in the IMU frame.
        Gravity = "imu.grav",
        /// Position of the base, world, m.
        BasePosition = "base.pos",
        /// Velocity of the base, world, m/s.
        BaseVelocity = "base.vel",
        /// Orientation of the base: roll and pitch by the direction of gravity in it, and yaw. `index` 0, 1, 3:
        /// x, y, z of gravity in the base; 2: yaw, rad, on past π where the base turns on.
        BaseAttitude = "base.quat",
        /// Position of a foot's ball, world, m. `index`: foot·3 + axis.
        Foot = "foot",
    }
}

/// Which component of [`Kind::BaseAttitude`] is the yaw.
pub const YAW: usize = 2;

impl Kind {
    /// SI unit.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Position | Self::SecondPosition | Self::BaseAttitude => "rad",
            Self::Velocity | Self::Gyro => "rad/s",
            Self::Current => "A",
            Self::Torque => "N·m",
            Self::Voltage => "V",
            Self::Acceleration => "m/s²",
            Self::Gravity => "",
            Self::BasePosition | Self::Foot => "m",
            Self::BaseVelocity => "m/s",
        }
    }

    /// SI unit at this joint or component: at joints that slide without radians.
    pub fn unit_at(self, model: &RobotModel, index: usize) -> &'static str {
        match self.of_joint() {
            true => at_joint(model, index, self.unit()),
            false => self.unit(),
        }
    }

    /// SI unit of all joints or components together: both where some joints slide and others do not.
    pub fn unit_of_all(self, model: &RobotModel) -> String {
        let mut units: Vec<&str> =
            (0..model.actuated().len()).map(|joint| self.unit_at(model, joint)).collect();
        units.sort_unstable();
        units.dedup();
        units.join(" and ")
    }

    /// Whether component `index` says where the robot is in the world, which no two runs of a free robot
    /// agree on.
    pub fn of_place(self, index: usize) -> bool {
        match self {
            Self::BasePosition | Self::Foot => true,
            Self::BaseAttitude => index == YAW,
            _ => false,
        }
    }

    /// Whether `index` of such a channel is an actuated joint.
    pub fn of_joint(self) -> bool {
        matches!(
            self,
            Self::Position | Self::SecondPosition | Self::Velocity | Self::Current | Self::Torque
        )
    }
}

/// One measured channel.
#[derive(Debug, Clone)]
pub struct Channel {
    /// What it is.
    pub kind: Kind,
    /// Joint (policy order), axis, or as [`Kind`] says.
    pub index: usize,
    /// Joint, axis or foot in words.
    pub name: String,
    /// Stamps, s, increasing. `[N]`
    pub time_s: Vec<f64>,
    /// Values, SI. `[N]`
    pub value: Vec<f64>,
}

impl Channel {
    /// Value at `t_s`, on the line between samples.
    pub fn at(&self, t_s: f64) -> f64 {
        between(&self.time_s, &self.value, t_s)
    }
}

/// The value at `t_s` on the line between samples (at least one) at `time_s`; beyond them the first or last.
fn between(time_s: &[f64], value: &[f64], t_s: f64) -> f64 {
    let k = time_s.partition_point(|&t| t < t_s);
    if k == 0 {
        return value[0];
    }
    if k >= value.len() {
        return value[value.len() - 1];
    }
    let (t0, t1) = (time_s[k - 1], time_s[k]);
    let share = if t1 > t0 { (t_s - t0) / (t1 - t0) } else { 0.0 };
    value[k - 1] + share * (value[k] - value[k - 1])
}

/// A force from outside on a link, as it was measured.
#[derive(Debug, Clone, Default)]
pub struct Force {
    /// Which link.
    pub link: usize,
    /// Where on it, in its frame, m.
    pub at_m: [f64; 3],
    /// Its components in the world, N: stamps (s) and values; empty where nothing was measured.
    pub axes: [(Vec<f64>, Vec<f64>); 3],
}

impl Force {
    /// At `t_s`, world, N.
    pub fn at(&self, t_s: f64) -> [f64; 3] {
        self.axes.each_ref().map(|(time_s, value)| match value.is_empty() {
            true => 0.0,
            false => between(time_s, value, t_s),
        })
    }
}

/// Values that hold until the next.
#[derive(Debug, Clone, Default)]
pub struct Steps {
    /// s, increasing.
    pub time_s: Vec<f64>,
    /// From that time on.
    pub value: Vec<f64>,
    /// Time from one frame to the next, s (one row of the log that has a value, one frame): in between, what
    /// holds is sent again. 0: nobody knows, nothing is.
    pub frame_s: f64,
}

impl Steps {
    /// What holds at `t_s`; the first value before all of them.
    pub fn at(&self, t_s: f64) -> f64 {
        let k = self.time_s.partition_point(|&t| t <= t_s);
        self.value.get(k.saturating_sub(1)).copied().unwrap_or(0.0)
    }
}

/// One run.
#[derive(Debug, Clone)]
pub struct Trial {
    /// Folder name.
    pub name: String,
    /// What it is used for.
    pub role: Role,
    /// How the base was held.
    pub base: BaseHold,
    /// First and last time that is replayed, s.
    pub span_s: (f64, f64),
    /// Per actuated joint, rad.
    pub commands: Vec<Steps>,
    /// Per actuated joint: speed commanded beside that, rad/s. `None`: none.
    pub speeds: Vec<Option<Steps>>,
    /// Per actuated joint: torque commanded beside that, N·m. `None`: none.
    pub torques: Vec<Option<Steps>>,
    /// From outside.
    pub forces: Vec<Force>,
    /// Per actuated joint: 1 where the servo gives torque. `None`: always.
    pub enabled: Vec<Option<Steps>>,
    /// What was measured.
    pub channels: Vec<Channel>,
    /// Conditions under which it was recorded: gains, weights, ….
    pub meta: LogMeta,
    /// Supply without load, V, as measured or noted.
    pub supply_v: Option<f64>,
    /// Trials with the same commands and settings have the same number.
    pub group: usize,
    /// Stretches of time that do not count (somebody touched the robot, …), s.
    pub masked_s: Vec<(f64, f64)>,
    /// Stretches of time after rows that are missing while commands changed, which do not count either, s: those of
    /// the commands that are replayed, whatever repeats have there.
    pub holes_s: Vec<(f64, f64)>,
    /// The runs that this one is the mean of; empty for a single run.
    pub members: Vec<Trial>,
    /// Where in the session it was recorded, 0 (first run) to 1 (last).
    pub session: f64,
}

impl Trial {
    /// Whether what was measured at time `t_s` does not count.
    pub fn is_left_out(&self, t_s: f64) -> bool {
        self.masked_s.iter().chain(&self.holes_s).any(|(from, to)| (*from..=*to).contains(&t_s))
    }

    /// Whether nothing acted beside the position commands.
    pub fn has_positions_alone(&self) -> bool {
        self.forces.is_empty() && self.speeds.iter().chain(&self.torques).all(Option::is_none)
    }

    /// s.
    pub fn duration_s(&self) -> f64 {
        self.span_s.1 - self.span_s.0
    }

    /// The channel of `kind` and `index`.
    pub fn channel(&self, kind: Kind, index: usize) -> Option<&Channel> {
        self.channels.iter().find(|c| c.kind == kind && c.index == index)
    }
}

impl Trial {
    /// A run of one joint that was never commanded, with `channels`, from 0 s on.
    pub(crate) fn bare(base: BaseHold, end_s: f64, channels: Vec<Channel>) -> Self {
        Self {
            name: "bare".into(),
            role: Role::Fit,
            base,
            span_s: (0.0, end_s),
            commands: vec![Steps::default()],
            speeds: vec![None],
            torques: vec![None],
            forces: Vec::new(),
            enabled: vec![None],
            channels,
            meta: LogMeta::new("bare", base, 100.0),
            supply_v: None,
            group: 0,
            masked_s: Vec::new(),
            holes_s: Vec::new(),
            members: Vec::new(),
            session: 0.0,
        }
    }
}

/// x and y of the direction of gravity in the body (level: 0, 0), yaw (rad), and its z (level: −1), of
/// world_from_body `[w, x, y, z]`.
pub fn attitude_of([w, x, y, z]: [f64; 4]) -> [f64; 4] {
    let n = (w * w + x * x + y * y + z * z).sqrt().max(1e-12);
    let (w, x, y, z) = (w / n, x / n, y / n, z / n);
    // minus the third row of the rotation matrix
    let gx = -2.0 * (x * z - w * y);
    let gy = -2.0 * (y * z + w * x);
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    let gz = -(1.0 - 2.0 * (x * x + y * y));
    [gx, gy, yaw, gz]
}

/// `angle_rad`, or as many whole turns away from it as bring it nearest to `near_rad`.
pub fn nearest_turn(angle_rad: f64, near_rad: f64) -> f64 {
    use std::f64::consts::TAU;
    angle_rad + TAU * ((near_rad - angle_rad) / TAU).round()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attitude_by_hand() {
        let near = |got: [f64; 4], want: [f64; 4]| {
            for i in 0..4 {
                assert!((got[i] - want[i]).abs() < 1e-12, "{got:?} {want:?}");
            }
        };
        near(attitude_of([1.0, 0.0, 0.0, 0.0]), [0.0, 0.0, 0.0, -1.0]);
        // nose down by 0.2 (positive turn about y): gravity towards +x of the body
        let (c, s) = (0.1_f64.cos(), 0.1_f64.sin());
        near(attitude_of([c, 0.0, s, 0.0]), [0.2_f64.sin(), 0.0, 0.0, -0.2_f64.cos()]);
        near(attitude_of([c, s, 0.0, 0.0]), [0.0, -0.2_f64.sin(), 0.0, -0.2_f64.cos()]);
        near(attitude_of([c, 0.0, 0.0, s]), [0.0, 0.0, 0.2, -1.0]);
        // on its back
        near(attitude_of([0.0, 1.0, 0.0, 0.0]), [0.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn turns_go_on_past_half_a_turn() {
        let turned = nearest_turn(-3.1, 3.1);
        assert!((turned - 3.183_185).abs() < 1e-6, "{turned}");
        assert_eq!(nearest_turn(0.3, 0.2), 0.3);
        let thrice = nearest_turn(0.1, 18.0);
        assert!((thrice - 18.949_556).abs() < 1e-6, "{thrice}");
    }

    #[test]
    fn steps_hold() {
        let s = Steps { time_s: vec![1.0, 2.0], value: vec![5.0, 7.0], ..Steps::default() };
        assert_eq!([0.0, 1.0, 1.9, 2.0, 9.0].map(|t| s.at(t)), [5.0, 5.0, 5.0, 7.0, 7.0]);
    }
}
