//! The link between the robot program and a simulated robot: messages as checked values.
//!
//! One message is one frame of [`crate::framing`]. Both sides begin with a [`Hello`] and hang up
//! when the other's differs from their own; then commands go one way and sensors the other, once
//! per control period.

use prost::Message;
use thiserror::Error;

use crate::wire::robot_link as pb;

/// Version of the meaning of these messages.
pub const ROBOT_LINK_PROTOCOL: u32 = 1;
/// Most actuated joints of a robot.
pub const JOINTS_MAX: usize = 32;
/// Most feet of a robot.
pub const FEET_MAX: usize = 8;
/// Largest message, bytes.
pub const MAX_MESSAGE_BYTES: usize = 4096;

/// One message of the link.
#[derive(Debug, Clone, PartialEq)]
pub enum RobotMessage {
    /// First message of either side.
    Hello(Box<Hello>),
    /// Robot program to robot.
    Command(Command),
    /// Robot to robot program.
    Sensors(Box<Sensors>),
}

/// Which robot speaks; each side compares it with its own.
#[derive(Debug, Clone, PartialEq)]
pub struct Hello {
    /// Name of the robot model, 1 to 64 characters.
    pub robot_name: String,
    /// SHA-256 over the robot file and its model.
    pub robot_hash: [u8; 32],
    /// The 1 to [`JOINTS_MAX`] actuated joints in the policy's order, 1 to 32 characters each.
    pub joint_names: Vec<String>,
    /// Control period, s; above 0 and at most 1.
    pub control_period_s: f64,
}

/// What the robot program asks of the servos for one control period.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// Counts control periods, from 1.
    pub tick: u64,
    /// Position targets, rad.
    pub targets_rad: Vec<f32>,
    /// False: the servos are limp and the targets are ignored.
    pub torque_enabled: bool,
}

/// What the robot senses at the end of a control period.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensors {
    /// Tick of the command that this answers; 0 before the first.
    pub tick: u64,
    /// Time since the robot's start, s.
    pub time_s: f64,
    /// Joint positions, rad.
    pub joint_pos_rad: Vec<f32>,
    /// Joint velocities, rad/s.
    pub joint_vel_radps: Vec<f32>,
    /// Servo currents, A.
    pub current_a: Vec<f32>,
    /// Supply voltage, V.
    pub supply_v: f32,
    /// Angular velocity, rad/s, IMU frame.
    pub gyro_radps: [f32; 3],
    /// Specific force, m/s², IMU frame.
    pub acc_mps2: [f32; 3],
    /// Direction of gravity in the IMU frame, where the IMU works it out itself.
    pub imu_gravity: Option<[f32; 3]>,
    /// True pose, for logs only; a real robot has none.
    pub base_pose: Option<BasePose>,
    /// Bit i: foot i of the robot file touches the ground, at most [`FEET_MAX`]; where that is sensed.
    pub foot_contacts: Option<u32>,
    /// Whether its water sensor says that it swims, where it has one.
    pub in_water: Option<bool>,
}

impl Sensors {
    /// Whether these are the readings of a robot with so many joints and feet.
    pub fn fit(&self, joints: usize, feet: usize) -> bool {
        let lists = [&self.joint_pos_rad, &self.joint_vel_radps, &self.current_a];
        lists.iter().all(|list| list.len() == joints)
            && self.foot_contacts.is_none_or(|bits| bits >> feet.min(FEET_MAX) == 0)
    }
}

/// True pose of the root link.
#[derive(Debug, Clone, PartialEq)]
pub struct BasePose {
    /// Position, m, world.
    pub pos_m: [f32; 3],
    /// Orientation w, x, y, z, world from body.
    pub quat_wxyz: [f32; 4],
}

/// Why a message was refused.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum LinkError {
    /// Not a message of this link.
    #[error("not a robot message: {0}")]
    Malformed(#[from] prost::DecodeError),
    /// Longer than [`MAX_MESSAGE_BYTES`].
    #[error("robot message of {bytes} bytes, the limit is {MAX_MESSAGE_BYTES}")]
    TooLarge { bytes: usize },
    /// The far side speaks another version.
    #[error(
        "robot link has protocol {found}, this program speaks {ROBOT_LINK_PROTOCOL}; use the same build on both sides"
    )]
    Protocol { found: u32 },
    /// A part that must be there is not.
    #[error("robot message lacks `{field}`")]
    Missing { field: &'static str },
    /// A list of the wrong length.
    #[error("`{field}` has {found} entries, must have {expected}")]
    Length { field: &'static str, found: usize, expected: usize },
    /// A list of as many values as no robot has joints.
    #[error("`{field}` has {found} entries, must have 1 to {JOINTS_MAX}, one per joint")]
    Joints { field: &'static str, found: usize },
    /// NaN or infinity, or a number out of its range.
    #[error("`{field}` holds a number that is not finite or out of its range")]
    Value { field: &'static str },
    /// A name that is empty, too long or not printable.
    #[error("`{field}` must be 1 to {max} printable ASCII characters")]
    Text { field: &'static str, max: usize },
}

/// The payload of one frame.
pub fn encode(message: &RobotMessage) -> Vec<u8> {
    let body = match message {
        RobotMessage::Hello(hello) => pb::robot_message::Body::Hello(pb::Hello {
            protocol: ROBOT_LINK_PROTOCOL,
            robot_name: hello.robot_name.clone(),
            robot_hash: hello.robot_hash.to_vec(),
            joint_names: hello.joint_names.clone(),
            control_period_s: hello.control_period_s,
        }),
        RobotMessage::Command(command) => pb::robot_message::Body::Command(pb::Command {
            tick: command.tick,
            targets_rad: command.targets_rad.clone(),
            torque_enabled: command.torque_enabled,
        }),
        RobotMessage::Sensors(sensors) => {
            pb::robot_message::Body::Sensors(sensors_to_wire(sensors))
        }
    };
    pb::RobotMessage { body: Some(body) }.encode_to_vec()
}

/// Reads the payload of one frame and checks it completely.
///
/// # Errors
/// The first thing that is not right.
pub fn decode(payload: &[u8]) -> Result<RobotMessage, LinkError> {
    if payload.len() > MAX_MESSAGE_BYTES {
        return Err(LinkError::TooLarge { bytes: payload.len() });
    }
    let message = pb::RobotMessage::decode(payload)?;
    Ok(match message.body.ok_or(LinkError::Missing { field: "body" })? {
        pb::robot_message::Body::Hello(hello) => {
            RobotMessage::Hello(Box::new(hello_from_wire(hello)?))
        }
        pb::robot_message::Body::Command(command) => RobotMessage::Command(Command {
            tick: command.tick,
            targets_rad: per_joint("targets_rad", command.targets_rad)?,
            torque_enabled: command.torque_enabled,
        }),
        pb::robot_message::Body::Sensors(sensors) => {
            RobotMessage::Sensors(Box::new(sensors_from_wire(sensors)?))
        }
    })
}

fn hello_from_wire(hello: pb::Hello) -> Result<Hello, LinkError> {
    if hello.protocol != ROBOT_LINK_PROTOCOL {
        return Err(LinkError::Protocol { found: hello.protocol });
    }
    let period = hello.control_period_s;
    if !(period > 0.0 && period <= 1.0) {
        return Err(LinkError::Value { field: "control_period_s" });
    }
    let found = hello.joint_names.len();
    if !(1..=JOINTS_MAX).contains(&found) {
        return Err(LinkError::Joints { field: "joint_names", found });
    }
    let names: Result<Vec<String>, LinkError> =
        hello.joint_names.into_iter().map(|name| text("joint_names", name, 32)).collect();
    Ok(Hello {
        robot_name: text("robot_name", hello.robot_name, 64)?,
        robot_hash: array("robot_hash", &hello.robot_hash)?,
        joint_names: names?,
        control_period_s: period,
    })
}

fn sensors_to_wire(s: &Sensors) -> pb::Sensors {
    pb::Sensors {
        tick: s.tick,
        time_s: s.time_s,
        joint_pos_rad: s.joint_pos_rad.clone(),
        joint_vel_radps: s.joint_vel_radps.clone(),
        current_a: s.current_a.clone(),
        supply_v: s.supply_v,
        gyro_radps: s.gyro_radps.to_vec(),
        acc_mps2: s.acc_mps2.to_vec(),
        imu_gravity: s.imu_gravity.map(|g| g.to_vec()).unwrap_or_default(),
        base_pose: s
            .base_pose
            .as_ref()
            .map(|p| pb::BasePose { pos_m: p.pos_m.to_vec(), quat_wxyz: p.quat_wxyz.to_vec() }),
        foot_contacts: s.foot_contacts,
        in_water: s.in_water,
    }
}

fn sensors_from_wire(s: pb::Sensors) -> Result<Sensors, LinkError> {
    let gravity = &s.imu_gravity;
    Ok(Sensors {
        tick: s.tick,
        time_s: finite("time_s", s.time_s)?,
        joint_pos_rad: per_joint("joint_pos_rad", s.joint_pos_rad)?,
        joint_vel_radps: per_joint("joint_vel_radps", s.joint_vel_radps)?,
        current_a: per_joint("current_a", s.current_a)?,
        supply_v: numbers::<1>("supply_v", &[s.supply_v])?[0],
        gyro_radps: numbers("gyro_radps", &s.gyro_radps)?,
        acc_mps2: numbers("acc_mps2", &s.acc_mps2)?,
        imu_gravity: if gravity.is_empty() { None } else { Some(numbers("imu_gravity", gravity)?) },
        base_pose: s.base_pose.as_ref().map(pose_from_wire).transpose()?,
        foot_contacts: s.foot_contacts.map(feet_from_wire).transpose()?,
        in_water: s.in_water,
    })
}

fn pose_from_wire(pose: &pb::BasePose) -> Result<BasePose, LinkError> {
    Ok(BasePose {
        pos_m: numbers("base_pose.pos_m", &pose.pos_m)?,
        quat_wxyz: numbers("base_pose.quat_wxyz", &pose.quat_wxyz)?,
    })
}

fn feet_from_wire(bits: u32) -> Result<u32, LinkError> {
    if bits >> FEET_MAX != 0 {
        return Err(LinkError::Value { field: "foot_contacts" });
    }
    Ok(bits)
}

/// One finite number per joint; how many joints there are, the two ends know of each other by their hellos.
fn per_joint(field: &'static str, values: Vec<f32>) -> Result<Vec<f32>, LinkError> {
    let found = values.len();
    if !(1..=JOINTS_MAX).contains(&found) {
        return Err(LinkError::Joints { field, found });
    }
    if values.iter().all(|x| x.is_finite()) {
        return Ok(values);
    }
    Err(LinkError::Value { field })
}

fn numbers<const K: usize>(field: &'static str, values: &[f32]) -> Result<[f32; K], LinkError> {
    let values: [f32; K] = array(field, values)?;
    if values.iter().all(|x| x.is_finite()) {
        return Ok(values);
    }
    Err(LinkError::Value { field })
}

fn finite(field: &'static str, value: f64) -> Result<f64, LinkError> {
    if value.is_finite() { Ok(value) } else { Err(LinkError::Value { field }) }
}

fn array<T: Copy, const K: usize>(field: &'static str, values: &[T]) -> Result<[T; K], LinkError> {
    let found = values.len();
    values.try_into().map_err(|_| LinkError::Length { field, found, expected: K })
}

fn text(field: &'static str, text: String, max: usize) -> Result<String, LinkError> {
    if (1..=max).contains(&text.len()) && text.bytes().all(|b| b.is_ascii_graphic()) {
        return Ok(text);
    }
    Err(LinkError::Text { field, max })
}

#[cfg(test)]
mod tests;
