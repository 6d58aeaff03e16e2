//! MCAP to rows.

use std::collections::BTreeMap;

use super::cdr::CdrError;
use super::container::{ContainerError, Record, Records};
use super::gravity_of;
use super::messages::{BatteryState, Header, Imu, JointState, Number, PoseStamped, TwistStamped};
use super::signal_of_topic;
use crate::error::LogError;
use crate::signal::{Axis, QuatPart, Signal};
use crate::table::{MAX_COLUMNS, MAX_ROWS, Table, check_value};

/// Topics for viewers, which say nothing that others do not.
const PASSED_OVER: [&str; 5] = [
    "/robot_description",
    "/tf",
    "/tf_static",
    "/odom",
    "/rosout",
];

/// Samples of one stamp.
type Row = Vec<(Signal, f64)>;

/// The rows of an MCAP file; `file` names it in errors and notes.
///
/// Topics of other types are passed over, with a note unless they are known to say nothing. A file that ends in the middle gives what came before, with a note.
///
/// # Errors
/// [`LogError::Mcap`] for a file that is not MCAP or is damaged, or holds a message that is not what its type
/// says.
pub fn parse_mcap(file: &str, bytes: &[u8]) -> Result<Table, LogError> {
    let wrong = |message: String| LogError::Mcap {
        file: file.to_owned(),
        message: message.replace('\n', " "),
    };
    let records = Records::new(bytes).map_err(|e| wrong(e.to_string()))?;
    let mut rows: BTreeMap<i64, Row> = BTreeMap::new();
    let mut notes = Vec::new();
    let mut types: BTreeMap<u16, String> = BTreeMap::new();
    let mut channels: BTreeMap<u16, (String, String)> = BTreeMap::new();
    let mut used: BTreeMap<u16, bool> = BTreeMap::new();
    let mut messages = 0usize;
    for record in records {
        let (channel, log_time_ns, data) = match record {
            Ok(Record::Schema { id, name }) => {
                types.insert(id, name);
                continue;
            }
            Ok(Record::Channel { id, schema, topic }) => {
                let kind = types.get(&schema).cloned().unwrap_or_default();
                channels.insert(id, (topic, kind));
                continue;
            }
            Ok(Record::Message {
                channel,
                log_time_ns,
                data,
            }) => (channel, log_time_ns, data),
            Err(e @ ContainerError::Torn) if messages > 0 => {
                notes.push(format!(
                    "{file}: dropped what follows message {messages}: {e}"
                ));
                break;
            }
            Err(e) => return Err(wrong(e.to_string())),
        };
        messages += 1;
        let Some((topic, kind)) = channels.get(&channel) else {
            return Err(wrong(format!(
                "message {messages} is on channel {channel}, which was not announced"
            )));
        };
        let (header, row) = samples(kind, topic, &data)
            .map_err(|e| wrong(format!("message {messages} on {topic} ({kind}): {e}")))?;
        let read = used.entry(channel).or_insert(false);
        *read |= !row.is_empty();
        if row.is_empty() {
            continue;
        }
        let stamp_ns = if header.stamp_ns == 0 {
            i64::try_from(log_time_ns).unwrap_or(i64::MAX)
        } else {
            header.stamp_ns
        };
        rows.entry(stamp_ns).or_default().extend(row);
        if rows.len() > MAX_ROWS {
            return Err(wrong(format!("more than {MAX_ROWS} rows; split the log")));
        }
    }
    let unread = used.iter().filter(|(_, read)| !**read);
    notes.extend(
        unread
            .filter_map(|(id, _)| channels.get(id))
            .filter(|(topic, _)| !PASSED_OVER.contains(&topic.as_str()))
            .map(|(topic, kind)| format!("topic {topic} ({kind}) is not read")),
    );
    table(rows, notes).map_err(wrong)
}

/// What a message says. Values that are not finite were not sampled.
fn samples(kind: &str, topic: &str, data: &[u8]) -> Result<(Header, Row), CdrError> {
    let mut row = Row::new();
    let axes = |row: &mut Row, of: fn(Axis) -> Signal, v: [f64; 3]| {
        row.extend(Axis::ALL.iter().zip(v).map(|(a, x)| (of(*a), x)));
    };
    let header = match kind {
        JointState::TYPE | "sensor_msgs/JointState" => {
            let m = JointState::decode(data)?;
            let mut joints = |of: fn(String) -> Signal, values: &[f64]| {
                row.extend(m.name.iter().zip(values).map(|(n, x)| (of(n.clone()), *x)));
            };
            if topic.contains("command") || topic.contains("cmd") {
                joints(Signal::Command, &m.position);
            } else if topic.contains("current") {
                joints(Signal::Current, &m.effort);
            } else {
                joints(Signal::Position, &m.position);
                joints(Signal::Velocity, &m.velocity);
                joints(Signal::Torque, &m.effort);
            }
            m.header
        }
        Imu::TYPE | "sensor_msgs/Imu" => {
            let m = Imu::decode(data)?;
            axes(&mut row, Signal::Gyro, m.gyro_radps);
            axes(&mut row, Signal::Acceleration, m.acc_mps2);
            if let Some(q) = m.orientation_wxyz {
                axes(&mut row, Signal::Gravity, gravity_of(q));
            }
            m.header
        }
        BatteryState::TYPE | "sensor_msgs/BatteryState" => {
            let m = BatteryState::decode(data)?;
            row.push((Signal::Voltage, f64::from(m.voltage_v)));
            m.header
        }
        PoseStamped::TYPE | "geometry_msgs/PoseStamped" => {
            let m = PoseStamped::decode(data)?;
            match topic.rsplit_once("mocap/").map(|(_, marker)| marker) {
                Some(marker) => row.extend(
                    Axis::ALL
                        .iter()
                        .zip(m.position_m)
                        .map(|(a, x)| (Signal::Mocap(marker.to_owned(), *a), x)),
                ),
                None => {
                    axes(&mut row, Signal::BasePosition, m.position_m);
                    row.extend(
                        QuatPart::ALL
                            .iter()
                            .zip(m.orientation_wxyz)
                            .map(|(p, x)| (Signal::BaseQuaternion(*p), x)),
                    );
                }
            }
            m.header
        }
        TwistStamped::TYPE | "geometry_msgs/TwistStamped" => {
            let m = TwistStamped::decode(data)?;
            axes(&mut row, Signal::BaseVelocity, m.linear_mps);
            m.header
        }
        Number::TYPE | "std_msgs/Float64" => {
            let value = Number::decode(data)?.data;
            row.extend(signal_of_topic(topic).map(|signal| (signal, value)));
            Header::default()
        }
        _ => Header::default(),
    };
    row.retain(|(_, x)| x.is_finite());
    Ok((header, row))
}

fn table(rows: BTreeMap<i64, Row>, notes: Vec<String>) -> Result<Table, String> {
    let mut columns: BTreeMap<Signal, usize> = BTreeMap::new();
    for (signal, value) in rows.values().flatten() {
        signal.check().map_err(|e| e.to_string())?;
        check_value(signal, *value)?;
        if !columns.contains_key(signal) {
            columns.insert(signal.clone(), 0);
        }
        if columns.len() >= MAX_COLUMNS {
            return Err(format!("more than {MAX_COLUMNS} signals"));
        }
    }
    for (i, place) in columns.values_mut().enumerate() {
        *place = i;
    }
    let first_ns = rows.keys().next().copied().unwrap_or(0);
    let mut cells: Vec<Vec<Option<f64>>> = vec![vec![None; rows.len()]; columns.len()];
    let mut time_s = Vec::with_capacity(rows.len());
    for (k, (stamp_ns, row)) in rows.into_iter().enumerate() {
        time_s.push((i128::from(stamp_ns) - i128::from(first_ns)) as f64 * 1e-9);
        for (signal, value) in row {
            cells[columns[&signal]][k] = Some(value);
        }
    }
    Ok(Table::from_columns(
        columns.into_keys().collect(),
        time_s,
        cells,
        notes,
    ))
}
