//! Rows to MCAP.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;

use mcap::records::MessageHeader;
use mcap::{Compression, McapError, WriteOptions};

use super::messages::{
    BatteryState, DiagnosticArray, DiagnosticStatus, Header, Imu, JointState, Number, Odometry,
    PoseStamped, Text, TfMessage, TransformStamped, TwistStamped, schema,
};
use super::{orientation_of, topic_of_signal};
use crate::error::LogError;
use crate::signal::{Axis, QuatPart, Signal};
use crate::table::Table;

/// Topics that a log is written to; currents as efforts, A.
const JOINT_STATES: &str = "/joint_states";
const JOINT_COMMANDS: &str = "/joint_commands";
const JOINT_CURRENTS: &str = "/joint_currents";
const IMU: &str = "/imu/data";
const BATTERY: &str = "/battery_state";
const BASE_POSE: &str = "/base/pose";
const BASE_TWIST: &str = "/base/twist";
const DESCRIPTION: &str = "/robot_description";
const TF: &str = "/tf";
const ODOMETRY: &str = "/odom";
const DIAGNOSTICS: &str = "/diagnostics";
/// Diagnostics are for people: one message in so much time, ns.
const DIAGNOSTICS_EVERY_NS: u64 = 1_000_000_000;
/// The frame of what is measured from outside, and that of the IMU.
const WORLD: &str = "world";
const IMU_FRAME: &str = "imu";
/// Markers have one topic each, below this.
const MOCAP: &str = "/mocap/";

/// A coordinate frame, and where it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Name of the frame that it stands in; `world` is the outermost.
    pub outer: String,
    /// Its name.
    pub name: String,
    /// Its origin in the outer frame, m.
    pub position_m: [f64; 3],
    /// outer_from_frame, w, x, y, z.
    pub orientation_wxyz: [f64; 4],
}

/// What lets a viewer draw the robot: its description, and where its links are.
pub struct Scene<'a> {
    /// URDF; empty: none is written.
    pub description: &'a str,
    /// Name of the root link, in whose frame the odometry's velocities are.
    pub base: &'a str,
    /// The frames in a row, by its number.
    pub frames: &'a dyn Fn(usize) -> Vec<Frame>,
}

/// The rows as an MCAP file (profile `ros2`), stamped from `start_ns` (nanoseconds since 1970; 0 would read
/// as "not stamped"). Without `compression` it has no chunks: whatever begins of it can be read.
///
/// # Errors
/// [`LogError::Refused`] for a start that is not after 1970, or one so late that the stamps do not fit a
/// message.
pub fn write_mcap(
    table: &Table,
    start_ns: u64,
    compression: Option<Compression>,
    scene: Option<&Scene<'_>>,
) -> Result<Vec<u8>, LogError> {
    // a message counts seconds in 32 bits
    const LATEST_NS: u64 = i32::MAX as u64 * 1_000_000_000;
    let first_s = table.time_s().first().unwrap_or(&0.0);
    let since_ns = |time_s: &f64| ((time_s - first_s) * 1e9).round() as u64;
    let end_ns = start_ns.saturating_add(table.time_s().last().map_or(0, since_ns));
    if start_ns == 0 || end_ns > LATEST_NS {
        return Err(LogError::Refused(format!(
            "stamps from {start_ns} ns to {end_ns} ns since 1970 do not fit a message; they go from 1 to {LATEST_NS}"
        )));
    }
    let stamps = table.time_s().iter().map(|t| start_ns + since_ns(t));
    write_rows(table, stamps, compression, scene)
        .map_err(|error| LogError::Refused(error.to_string()))
}

fn write_rows(
    table: &Table,
    stamps: impl Iterator<Item = u64>,
    compression: Option<Compression>,
    scene: Option<&Scene<'_>>,
) -> Result<Vec<u8>, McapError> {
    let writer = WriteOptions::new()
        .profile("ros2")
        .library("caudata")
        .compression(compression)
        .compression_threads(0)
        .use_chunks(compression.is_some())
        .create(Cursor::new(Vec::new()))?;
    let mut file = File { writer, channels: BTreeMap::new() };
    let mut diagnostics_from_ns = 0;
    for (k, stamp_ns) in stamps.enumerate() {
        let Some(cells) = table.row(k) else { break };
        let signals = table.signals().iter().zip(cells);
        let row = Row(signals.filter_map(|(s, x)| Some((s, x?))).collect());
        let stamp = Stamp(i64::try_from(stamp_ns).unwrap_or(i64::MAX));
        let description = scene.map_or("", |scene| scene.description);
        if k == 0 && !description.is_empty() {
            let data = description.to_owned();
            let message = (DESCRIPTION.to_owned(), Text::TYPE, Text { data }.encode());
            file.put(message, stamp_ns, k)?;
        }
        for message in messages(&row, &stamp) {
            file.put(message, stamp_ns, k)?;
        }
        if stamp_ns >= diagnostics_from_ns
            && let Some(data) = row.diagnostics(&stamp)
        {
            let message = (DIAGNOSTICS.to_owned(), DiagnosticArray::TYPE, data);
            file.put(message, stamp_ns, k)?;
            diagnostics_from_ns = stamp_ns + DIAGNOSTICS_EVERY_NS;
        }
        for message in scene.iter().flat_map(|scene| drawn(scene, &row, &stamp, k)) {
            file.put(message, stamp_ns, k)?;
        }
    }
    file.writer.finish()?;
    Ok(file.writer.into_inner().into_inner())
}

/// A file that is written, and the topics that it has so far.
struct File {
    writer: mcap::Writer<Cursor<Vec<u8>>>,
    channels: BTreeMap<String, u16>,
}

impl File {
    fn put(
        &mut self,
        (topic, kind, data): Message,
        stamp_ns: u64,
        row: usize,
    ) -> Result<(), McapError> {
        let channel_id = match self.channels.get(&topic) {
            Some(channel) => *channel,
            None => {
                let definition = schema(kind).unwrap_or_default();
                let kind = self.writer.add_schema(kind, "ros2msg", definition.as_bytes())?;
                let id = self.writer.add_channel(kind, &topic, "cdr", &BTreeMap::new())?;
                self.channels.insert(topic, id);
                id
            }
        };
        let header = MessageHeader {
            channel_id,
            sequence: row as u32,
            log_time: stamp_ns,
            publish_time: stamp_ns,
        };
        self.writer.write_to_known_channel(&header, &data)
    }
}

/// When a row was, ns.
struct Stamp(i64);

impl Stamp {
    fn header(&self, frame: &str) -> Header {
        Header { stamp_ns: self.0, frame: frame.to_owned() }
    }
}

/// Where the robot's links are, and its odometry.
fn drawn(scene: &Scene<'_>, row: &Row<'_>, stamp: &Stamp, k: usize) -> Vec<Message> {
    let transforms = (scene.frames)(k).into_iter().map(|frame| {
        let [w, x, y, z] = frame.orientation_wxyz;
        TransformStamped {
            header: stamp.header(&frame.outer),
            child: frame.name,
            position_m: frame.position_m,
            orientation_xyzw: [x, y, z, w],
        }
    });
    let tf = TfMessage { transforms: transforms.collect() };
    let odometry = row.odometry(scene.base, stamp);
    let odometry = odometry.map(|m| (ODOMETRY.to_owned(), Odometry::TYPE, m.encode()));
    let tf = (TF.to_owned(), TfMessage::TYPE, tf.encode());
    std::iter::once(tf).chain(odometry).collect()
}

type Message = (String, &'static str, Vec<u8>);

/// The signal of a joint.
type OfJoint = fn(String) -> Signal;

/// What was sampled in a row.
struct Row<'a>(BTreeMap<&'a Signal, f64>);

impl Row<'_> {
    fn get(&self, signal: Signal) -> Option<f64> {
        self.0.get(&signal).copied()
    }

    /// `None` where a coordinate is missing.
    fn vector(&self, of: impl Fn(Axis) -> Signal) -> Option<[f64; 3]> {
        let [x, y, z] = Axis::ALL.map(|a| self.get(of(a)));
        Some([x?, y?, z?])
    }

    /// A message with a list for each of `kinds`, if there is a value of any.
    fn joints(&self, stamp: &Stamp, kinds: [Option<OfJoint>; 3]) -> Option<Vec<u8>> {
        let all = self.0.keys().filter_map(|s| s.joint());
        let sampled = |j: &&str| {
            let kinds = kinds.iter().flatten();
            kinds.into_iter().any(|of| self.get(of((*j).to_owned())).is_some())
        };
        // a set: the names in order, each once
        let names: BTreeSet<&str> = all.filter(sampled).collect();
        let list = |kind: Option<OfJoint>| -> Vec<f64> {
            let Some(of) = kind else { return Vec::new() };
            let values = names.iter().map(|n| self.get(of((*n).to_owned())));
            let values: Vec<f64> = values.map(|x| x.unwrap_or(f64::NAN)).collect();
            if values.iter().all(|x| x.is_nan()) { Vec::new() } else { values }
        };
        let [position, velocity, effort] = kinds.map(list);
        let message = JointState {
            header: stamp.header(""),
            name: names.iter().map(|n| (*n).to_owned()).collect(),
            position,
            velocity,
            effort,
        };
        (!names.is_empty()).then(|| message.encode())
    }

    fn imu(&self, stamp: &Stamp) -> Option<Vec<u8>> {
        let gyro = self.vector(Signal::Gyro);
        let acc = self.vector(Signal::Acceleration);
        let gravity = self.vector(Signal::Gravity);
        let message = Imu {
            header: stamp.header(IMU_FRAME),
            orientation_wxyz: gravity.map(orientation_of),
            gyro_radps: gyro.unwrap_or([f64::NAN; 3]),
            acc_mps2: acc.unwrap_or([f64::NAN; 3]),
        };
        (gyro.is_some() || acc.is_some() || gravity.is_some()).then(|| message.encode())
    }

    fn base_pose(&self, stamp: &Stamp) -> Option<Vec<u8>> {
        let position = self.vector(Signal::BasePosition);
        let quat = QuatPart::ALL.map(|p| self.get(Signal::BaseQuaternion(p)));
        let message = PoseStamped {
            header: stamp.header(WORLD),
            position_m: position.unwrap_or([f64::NAN; 3]),
            orientation_wxyz: quat.map(|q| q.unwrap_or(f64::NAN)),
        };
        (position.is_some() || quat.iter().all(Option::is_some)).then(|| message.encode())
    }

    /// What servos say of themselves, one status each; a log does not know what is too much.
    fn diagnostics(&self, stamp: &Stamp) -> Option<Vec<u8>> {
        let mut of_servos: BTreeMap<&str, Vec<(String, String)>> = BTreeMap::new();
        for (signal, value) in &self.0 {
            let (servo, key) = match signal {
                Signal::Temperature(servo) => (servo, "temperature °C"),
                Signal::Duty(servo) => (servo, "duty"),
                Signal::Enabled(servo) => (servo, "gives torque"),
                _ => continue,
            };
            let figures = of_servos.entry(servo).or_default();
            figures.push((key.to_owned(), value.to_string()));
        }
        let status = of_servos.into_iter().map(|(servo, values)| DiagnosticStatus {
            level: DiagnosticStatus::OK,
            name: servo.to_owned(),
            message: String::new(),
            hardware_id: servo.to_owned(),
            values,
        });
        let message = DiagnosticArray { header: stamp.header(""), status: status.collect() };
        (!message.status.is_empty()).then(|| message.encode())
    }

    /// `None` where the base's place, orientation or velocity is missing.
    fn odometry(&self, base: &str, stamp: &Stamp) -> Option<Odometry> {
        let [w, x, y, z] = QuatPart::ALL.map(|p| self.get(Signal::BaseQuaternion(p)));
        let [w, x, y, z] = [w?, x?, y?, z?];
        let world_mps = self.vector(Signal::BaseVelocity)?;
        Some(Odometry {
            header: stamp.header(WORLD),
            child: base.to_owned(),
            position_m: self.vector(Signal::BasePosition)?,
            orientation_xyzw: [x, y, z, w],
            linear_mps: turned_back([w, x, y, z], world_mps),
            // The gyroscope's frame is another one than the base's.
            angular_radps: [f64::NAN; 3],
            ..Odometry::default()
        })
    }
}

/// A vector of the outer frame in the frame that stands in it as `q` (unit, w, x, y, z).
fn turned_back([w, x, y, z]: [f64; 4], v: [f64; 3]) -> [f64; 3] {
    // v + 2·(w·t + u × t) with u = −(x, y, z) and t = u × v
    let cross = |a: [f64; 3], b: [f64; 3]| {
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    };
    let u = [-x, -y, -z];
    let t = cross(u, v);
    let ut = cross(u, t);
    std::array::from_fn(|i| v[i] + 2.0 * (w * t[i] + ut[i]))
}

/// The messages of one row.
fn messages(row: &Row<'_>, stamp: &Stamp) -> Vec<Message> {
    let mut out = Vec::new();
    let mut put = |topic: &str, kind, data: Option<Vec<u8>>| {
        out.extend(data.map(|data| (topic.to_owned(), kind, data)));
    };
    let [command, position]: [fn(String) -> Signal; 2] = [Signal::Command, Signal::Position];
    let [velocity, torque]: [fn(String) -> Signal; 2] = [Signal::Velocity, Signal::Torque];
    let commands = row.joints(stamp, [Some(command), None, None]);
    put(JOINT_COMMANDS, JointState::TYPE, commands);
    let states = row.joints(stamp, [Some(position), Some(velocity), Some(torque)]);
    put(JOINT_STATES, JointState::TYPE, states);
    let currents = row.joints(stamp, [None, None, Some(Signal::Current)]);
    put(JOINT_CURRENTS, JointState::TYPE, currents);
    put(IMU, Imu::TYPE, row.imu(stamp));
    let battery = row
        .get(Signal::Voltage)
        .map(|v| BatteryState { header: stamp.header(""), voltage_v: v as f32 });
    put(BATTERY, BatteryState::TYPE, battery.map(|m| m.encode()));
    put(BASE_POSE, PoseStamped::TYPE, row.base_pose(stamp));
    let twist = row.vector(Signal::BaseVelocity).map(|v| TwistStamped {
        header: stamp.header(WORLD),
        linear_mps: v,
        angular_radps: [f64::NAN; 3],
    });
    put(BASE_TWIST, TwistStamped::TYPE, twist.map(|m| m.encode()));
    let markers = row.0.keys().filter_map(|s| match s {
        Signal::Mocap(marker, _) => Some(marker),
        _ => None,
    });
    for marker in markers.collect::<BTreeSet<_>>() {
        let position = row.vector(|a| Signal::Mocap(marker.clone(), a));
        let pose = position.map(|position_m| PoseStamped {
            header: stamp.header(WORLD),
            position_m,
            orientation_wxyz: [1.0, 0.0, 0.0, 0.0],
        });
        let topic = format!("{MOCAP}{marker}");
        put(&topic, PoseStamped::TYPE, pose.map(|m| m.encode()));
    }
    for (signal, data) in row.0.iter().filter(|(signal, _)| is_alone(signal)) {
        let number = Number { data: *data };
        put(&topic_of_signal(signal), Number::TYPE, Some(number.encode()));
    }
    out
}

/// Whether no message of several signals has a place for it.
fn is_alone(signal: &Signal) -> bool {
    matches!(
        signal,
        Signal::Temperature(_)
            | Signal::Duty(_)
            | Signal::Enabled(_)
            | Signal::Foot(..)
            | Signal::Contact(_)
            | Signal::CommandVelocity(_)
            | Signal::CommandTorque(_)
            | Signal::SecondPosition(_)
            | Signal::Force(..)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_servo_says_of_itself_is_a_status_of_its_own() {
        let signals: Vec<Signal> =
            ["on.hip", "temp.hip", "pwm.knee", "pos.knee"].map(|s| s.parse().unwrap()).into();
        let row = Row(signals.iter().zip([1.0, 41.0, -0.25, 0.5]).collect());
        let told = row.diagnostics(&Stamp(7)).unwrap();
        let told = DiagnosticArray::decode(&told).unwrap();
        assert_eq!(told.header.stamp_ns, 7);
        let names: Vec<&str> = told.status.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["hip", "knee"]);
        let figure = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        let of_hip = [figure("temperature °C", "41"), figure("gives torque", "1")];
        assert_eq!(told.status[0].values, of_hip);
        assert_eq!(told.status[1].values, [figure("duty", "-0.25")]);
        // a row without any has no message
        let bare = Row(signals[3..].iter().zip([0.5]).collect());
        assert!(bare.diagnostics(&Stamp(7)).is_none());
    }

    #[test]
    fn a_velocity_is_turned_into_the_frame_of_who_has_it() {
        // a quarter turn to the left: what goes along the world's x goes to the right of the base
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let got = turned_back([half, 0.0, 0.0, half], [1.0, 0.0, 0.5]);
        for (got, want) in got.iter().zip([0.0, -1.0, 0.5]) {
            assert!((got - want).abs() < 1e-12, "{got} {want}");
        }
    }
}
