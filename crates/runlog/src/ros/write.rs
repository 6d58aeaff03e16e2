//! Rows to MCAP.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;

use mcap::records::MessageHeader;
use mcap::{Compression, McapError, WriteOptions};

use super::messages::{BatteryState, Header, Imu, JointState, PoseStamped, TwistStamped, schema};
use super::orientation_of;
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
/// Markers have one topic each, below this.
const MOCAP: &str = "/mocap/";

/// The rows as an MCAP file (profile `ros2`), stamped from `start_ns` (nanoseconds since 1970; 0 would read
/// as "not stamped"), and the signals that the messages have no place for (temperatures, feet, contacts,
/// switches). Without `compression` it has no chunks: whatever begins of it can be read.
///
/// # Errors
/// [`LogError::Refused`] for a start that is not after 1970, or one so late that the stamps do not fit a
/// message.
pub fn write_mcap(
    table: &Table,
    start_ns: u64,
    compression: Option<Compression>,
) -> Result<(Vec<u8>, Vec<Signal>), LogError> {
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
    let left_out = table.signals().iter().filter(|s| !carried(s)).cloned();
    let stamps = table.time_s().iter().map(|t| start_ns + since_ns(t));
    let bytes = write_rows(table, stamps, compression)
        .map_err(|error| LogError::Refused(error.to_string()))?;
    Ok((bytes, left_out.collect()))
}

fn write_rows(
    table: &Table,
    stamps: impl Iterator<Item = u64>,
    compression: Option<Compression>,
) -> Result<Vec<u8>, McapError> {
    let mut writer = WriteOptions::new()
        .profile("ros2")
        .library("caudata")
        .compression(compression)
        .compression_threads(0)
        .use_chunks(compression.is_some())
        .create(Cursor::new(Vec::new()))?;
    let mut channels: BTreeMap<String, u16> = BTreeMap::new();
    for (k, stamp_ns) in stamps.enumerate() {
        let Some(cells) = table.row(k) else { break };
        let signals = table.signals().iter().zip(cells);
        let row = Row(signals.filter_map(|(s, x)| Some((s, x?))).collect());
        let header = Header {
            stamp_ns: i64::try_from(stamp_ns).unwrap_or(i64::MAX),
            frame: String::new(),
        };
        for (topic, kind, data) in messages(&row, &header) {
            let channel_id = match channels.get(&topic) {
                Some(channel) => *channel,
                None => {
                    let definition = schema(kind).unwrap_or_default();
                    let kind = writer.add_schema(kind, "ros2msg", definition.as_bytes())?;
                    let id = writer.add_channel(kind, &topic, "cdr", &BTreeMap::new())?;
                    channels.insert(topic, id);
                    id
                }
            };
            let header = MessageHeader {
                channel_id,
                sequence: k as u32,
                log_time: stamp_ns,
                publish_time: stamp_ns,
            };
            writer.write_to_known_channel(&header, &data)?;
        }
    }
    writer.finish()?;
    Ok(writer.into_inner().into_inner())
}

fn carried(signal: &Signal) -> bool {
    !matches!(
        signal,
        Signal::Temperature(_)
            | Signal::Duty(_)
            | Signal::Enabled(_)
            | Signal::Foot(..)
            | Signal::Contact(_)
    )
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
    fn joints(&self, header: &Header, kinds: [Option<OfJoint>; 3]) -> Option<Vec<u8>> {
        let all = self.0.keys().filter_map(|s| s.joint());
        let sampled = |j: &&str| {
            let kinds = kinds.iter().flatten();
            kinds
                .into_iter()
                .any(|of| self.get(of((*j).to_owned())).is_some())
        };
        // a set: the names in order, each once
        let names: BTreeSet<&str> = all.filter(sampled).collect();
        let list = |kind: Option<OfJoint>| -> Vec<f64> {
            let Some(of) = kind else { return Vec::new() };
            let values = names.iter().map(|n| self.get(of((*n).to_owned())));
            let values: Vec<f64> = values.map(|x| x.unwrap_or(f64::NAN)).collect();
            match values.iter().all(|x| x.is_nan()) {
                true => Vec::new(),
                false => values,
            }
        };
        let [position, velocity, effort] = kinds.map(list);
        let message = JointState {
            header: header.clone(),
            name: names.iter().map(|n| (*n).to_owned()).collect(),
            position,
            velocity,
            effort,
        };
        (!names.is_empty()).then(|| message.encode())
    }

    fn imu(&self, header: &Header) -> Option<Vec<u8>> {
        let gyro = self.vector(Signal::Gyro);
        let acc = self.vector(Signal::Acceleration);
        let gravity = self.vector(Signal::Gravity);
        let message = Imu {
            header: header.clone(),
            orientation_wxyz: gravity.map(orientation_of),
            gyro_radps: gyro.unwrap_or([f64::NAN; 3]),
            acc_mps2: acc.unwrap_or([f64::NAN; 3]),
        };
        (gyro.is_some() || acc.is_some() || gravity.is_some()).then(|| message.encode())
    }

    fn base_pose(&self, header: &Header) -> Option<Vec<u8>> {
        let position = self.vector(Signal::BasePosition);
        let quat = QuatPart::ALL.map(|p| self.get(Signal::BaseQuaternion(p)));
        let message = PoseStamped {
            header: header.clone(),
            position_m: position.unwrap_or([f64::NAN; 3]),
            orientation_wxyz: quat.map(|q| q.unwrap_or(f64::NAN)),
        };
        (position.is_some() || quat.iter().all(Option::is_some)).then(|| message.encode())
    }
}

/// The messages of one row.
fn messages(row: &Row<'_>, header: &Header) -> Vec<Message> {
    let [command, position]: [fn(String) -> Signal; 2] = [Signal::Command, Signal::Position];
    let [velocity, torque]: [fn(String) -> Signal; 2] = [Signal::Velocity, Signal::Torque];
    let current: fn(String) -> Signal = Signal::Current;
    let states = [Some(position), Some(velocity), Some(torque)];
    let battery = row.get(Signal::Voltage).map(|v| BatteryState {
        header: header.clone(),
        voltage_v: v as f32,
    });
    let twist = row.vector(Signal::BaseVelocity).map(|v| TwistStamped {
        header: header.clone(),
        linear_mps: v,
        angular_radps: [f64::NAN; 3],
    });
    let fixed = [
        (
            JOINT_COMMANDS,
            JointState::TYPE,
            row.joints(header, [Some(command), None, None]),
        ),
        (JOINT_STATES, JointState::TYPE, row.joints(header, states)),
        (
            JOINT_CURRENTS,
            JointState::TYPE,
            row.joints(header, [None, None, Some(current)]),
        ),
        (IMU, Imu::TYPE, row.imu(header)),
        (BATTERY, BatteryState::TYPE, battery.map(|m| m.encode())),
        (BASE_POSE, PoseStamped::TYPE, row.base_pose(header)),
        (BASE_TWIST, TwistStamped::TYPE, twist.map(|m| m.encode())),
    ];
    let fixed = fixed
        .into_iter()
        .filter_map(|(topic, kind, data)| Some((topic.to_owned(), kind, data?)));
    let markers: BTreeSet<&String> = row
        .0
        .keys()
        .filter_map(|s| match s {
            Signal::Mocap(marker, _) => Some(marker),
            _ => None,
        })
        .collect();
    let marker = |marker: &String| {
        let pose = PoseStamped {
            header: header.clone(),
            position_m: row.vector(|a| Signal::Mocap(marker.clone(), a))?,
            orientation_wxyz: [1.0, 0.0, 0.0, 0.0],
        };
        Some((format!("{MOCAP}{marker}"), PoseStamped::TYPE, pose.encode()))
    };
    fixed
        .chain(markers.into_iter().filter_map(marker))
        .collect()
}
