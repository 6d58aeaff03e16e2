//! Rows to MCAP.

use std::collections::BTreeMap;

use super::container::Writer;
use super::messages::{BatteryState, Header, Imu, JointState, PoseStamped, TwistStamped, schema};
use super::orientation_of;
use crate::error::LogError;
use crate::signal::{Axis, QuatPart, Signal};
use crate::table::Table;

/// Topics that a log is written to.
pub mod topics {
    /// Positions, speeds, torques.
    pub const JOINT_STATES: &str = "/joint_states";
    /// Commands, as positions.
    pub const JOINT_COMMANDS: &str = "/joint_commands";
    /// Motor currents, as efforts, A.
    pub const JOINT_CURRENTS: &str = "/joint_currents";
    /// Gyroscope, accelerometer, direction of gravity.
    pub const IMU: &str = "/imu/data";
    /// Supply.
    pub const BATTERY: &str = "/battery_state";
    /// Base in the world.
    pub const BASE_POSE: &str = "/base/pose";
    /// Its velocity, in the world.
    pub const BASE_TWIST: &str = "/base/twist";
    /// Markers, one topic each, below this.
    pub const MOCAP: &str = "/mocap/";
}

/// The rows as an MCAP file (profile `ros2`, not compressed), stamped from `start_ns` (nanoseconds since 1970; 0 would read as "not stamped"),
/// and the signals that the messages have no place for (temperatures, feet, contacts, switches).
///
/// # Errors
/// [`LogError::Refused`] for a start that is not after 1970, or one so late that the stamps do not fit a message.
pub fn write_mcap(table: &Table, start_ns: u64) -> Result<(Vec<u8>, Vec<Signal>), LogError> {
    // a message counts seconds in 32 bits
    const LATEST_NS: u64 = i32::MAX as u64 * 1_000_000_000;
    let last_s = table.time_s().last().unwrap_or(&0.0) - table.time_s().first().unwrap_or(&0.0);
    let end_ns = start_ns.saturating_add((last_s * 1e9) as u64);
    if start_ns == 0 || end_ns > LATEST_NS {
        return Err(LogError::Refused(format!(
            "stamps from {start_ns} ns to {end_ns} ns since 1970 do not fit a message; they go from 1 to {LATEST_NS}"
        )));
    }
    let mut writer = Writer::new("ros2");
    let mut schemas: BTreeMap<&'static str, u16> = BTreeMap::new();
    let mut channels: BTreeMap<String, u16> = BTreeMap::new();
    let left_out: Vec<Signal> = table
        .signals()
        .iter()
        .filter(|s| !carried(s))
        .cloned()
        .collect();
    for k in 0..table.len() {
        let Some(cells) = table.row(k) else { break };
        let row: BTreeMap<&Signal, f64> = table
            .signals()
            .iter()
            .zip(cells)
            .filter_map(|(s, x)| Some((s, x?)))
            .collect();
        let since_s = table.time_s()[k] - table.time_s()[0];
        let stamp_ns = start_ns + (since_s * 1e9).round() as u64;
        let header = Header {
            stamp_ns: i64::try_from(stamp_ns).unwrap_or(i64::MAX),
            frame: String::new(),
        };
        for (topic, kind, data) in messages(&row, &header) {
            let channel = match channels.get(&topic) {
                Some(channel) => *channel,
                None => {
                    let next = schemas.len() as u16 + 1;
                    let id = *schemas.entry(kind).or_insert(next);
                    if id == next {
                        writer.schema(id, kind, "ros2msg", &schema(kind).unwrap_or_default());
                    }
                    let channel = channels.len() as u16 + 1;
                    writer.channel(channel, id, &topic, "cdr");
                    channels.insert(topic, channel);
                    channel
                }
            };
            writer.message(channel, k as u32, stamp_ns, &data);
        }
    }
    Ok((writer.finish(), left_out))
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

/// The messages of one row.
fn messages(row: &BTreeMap<&Signal, f64>, header: &Header) -> Vec<Message> {
    let mut out: Vec<Message> = Vec::new();
    let get = |s: Signal| row.get(&s).copied();
    let vector = |of: &dyn Fn(Axis) -> Signal| -> Option<[f64; 3]> {
        let [x, y, z] = Axis::ALL.map(|a| get(of(a)));
        Some([x?, y?, z?])
    };
    // `BTreeMap` keeps the names in order and each once
    let joints = |keep: &dyn Fn(&Signal) -> bool| -> Vec<String> {
        let mut names: Vec<String> = row
            .keys()
            .filter(|s| keep(s))
            .filter_map(|s| s.joint().map(str::to_owned))
            .collect();
        names.sort_unstable();
        names.dedup();
        names
    };
    let column = |names: &[String], of: fn(String) -> Signal| -> Vec<f64> {
        let all: Vec<f64> = names
            .iter()
            .map(|n| get(of(n.clone())).unwrap_or(f64::NAN))
            .collect();
        if all.iter().all(|x| x.is_nan()) {
            Vec::new()
        } else {
            all
        }
    };
    let mut state = |topic: &str, names: Vec<String>, lists: [Vec<f64>; 3]| {
        if !names.is_empty() {
            let [position, velocity, effort] = lists;
            let m = JointState {
                header: header.clone(),
                name: names,
                position,
                velocity,
                effort,
            };
            out.push((topic.to_owned(), JointState::TYPE, m.encode()));
        }
    };
    let names = joints(&|s| matches!(s, Signal::Command(_)));
    let lists = [column(&names, Signal::Command), Vec::new(), Vec::new()];
    state(topics::JOINT_COMMANDS, names, lists);
    let names = joints(&|s| {
        matches!(
            s,
            Signal::Position(_) | Signal::Velocity(_) | Signal::Torque(_)
        )
    });
    let lists = [
        column(&names, Signal::Position),
        column(&names, Signal::Velocity),
        column(&names, Signal::Torque),
    ];
    state(topics::JOINT_STATES, names, lists);
    let names = joints(&|s| matches!(s, Signal::Current(_)));
    let lists = [Vec::new(), Vec::new(), column(&names, Signal::Current)];
    state(topics::JOINT_CURRENTS, names, lists);

    let (gyro, acc, grav) = (
        vector(&Signal::Gyro),
        vector(&Signal::Acceleration),
        vector(&Signal::Gravity),
    );
    if gyro.is_some() || acc.is_some() || grav.is_some() {
        let m = Imu {
            header: header.clone(),
            orientation_wxyz: grav.map(orientation_of),
            gyro_radps: gyro.unwrap_or([f64::NAN; 3]),
            acc_mps2: acc.unwrap_or([f64::NAN; 3]),
        };
        out.push((topics::IMU.to_owned(), Imu::TYPE, m.encode()));
    }
    if let Some(v) = get(Signal::Voltage) {
        let m = BatteryState {
            header: header.clone(),
            voltage_v: v as f32,
        };
        out.push((topics::BATTERY.to_owned(), BatteryState::TYPE, m.encode()));
    }
    let quat = QuatPart::ALL.map(|p| get(Signal::BaseQuaternion(p)));
    let base = vector(&Signal::BasePosition);
    if base.is_some() || quat.iter().all(Option::is_some) {
        let m = PoseStamped {
            header: header.clone(),
            position_m: base.unwrap_or([f64::NAN; 3]),
            orientation_wxyz: quat.map(|q| q.unwrap_or(f64::NAN)),
        };
        out.push((topics::BASE_POSE.to_owned(), PoseStamped::TYPE, m.encode()));
    }
    if let Some(linear_mps) = vector(&Signal::BaseVelocity) {
        let m = TwistStamped {
            header: header.clone(),
            linear_mps,
            angular_radps: [f64::NAN; 3],
        };
        out.push((
            topics::BASE_TWIST.to_owned(),
            TwistStamped::TYPE,
            m.encode(),
        ));
    }
    let mut markers: Vec<&String> = row
        .keys()
        .filter_map(|s| {
            if let Signal::Mocap(m, _) = s {
                Some(m)
            } else {
                None
            }
        })
        .collect();
    markers.dedup();
    for marker in markers {
        if let Some(position_m) = vector(&|a| Signal::Mocap(marker.clone(), a)) {
            let m = PoseStamped {
                header: header.clone(),
                position_m,
                orientation_wxyz: [1.0, 0.0, 0.0, 0.0],
            };
            out.push((
                format!("{}{marker}", topics::MOCAP),
                PoseStamped::TYPE,
                m.encode(),
            ));
        }
    }
    out
}
