//! MCAP to rows.

use std::collections::BTreeMap;

use super::bag::of_mcap;
use super::cdr::CdrError;
use super::gravity_of;
use super::messages::{BatteryState, Header, Imu, JointState, Number, PoseStamped, TwistStamped};
use super::signal_of_topic;
use crate::error::LogError;
use crate::signal::{Axis, QuatPart, Signal};
use crate::table::{MAX_COLUMNS, MAX_ROWS, Table, check_value};

/// Topics for viewers, which say nothing that others do not.
const PASSED_OVER: [&str; 6] =
    ["/robot_description", "/tf", "/tf_static", "/odom", "/rosout", "/diagnostics"];

/// Samples of one stamp.
type Row = Vec<(Signal, f64)>;

/// The rows of an MCAP file; `file` names it in errors and notes.
///
/// Topics of other types are passed over, with a note unless they are known to say nothing. A file that ends in the middle gives what came before, with a note.
///
/// # Errors
/// [`LogError::Recording`] for a file that is not MCAP or is damaged, or holds a message that is not what its type
/// says.
pub fn parse_mcap(file: &str, bytes: &[u8]) -> Result<Table, LogError> {
    let wrong = |message: String| LogError::Recording {
        file: file.to_owned(),
        message: message.replace('\n', " "),
    };
    let mut rows: BTreeMap<i64, Row> = BTreeMap::new();
    let mut used: BTreeMap<String, (String, bool)> = BTreeMap::new();
    let torn = of_mcap(bytes, &mut |m| {
        let (header, row) = samples(m.kind, m.topic, &m.data).map_err(|e| e.to_string())?;
        match used.get_mut(m.topic) {
            Some((_, read)) => *read |= !row.is_empty(),
            None => {
                let read = (m.kind.to_owned(), !row.is_empty());
                used.insert(m.topic.to_owned(), read);
            }
        }
        if row.is_empty() {
            return Ok(());
        }
        let stamp_ns = match header.stamp_ns {
            0 => m.received_ns,
            stamp_ns => stamp_ns,
        };
        rows.entry(stamp_ns).or_default().extend(row);
        match rows.len() > MAX_ROWS {
            true => Err(format!("more than {MAX_ROWS} rows; split the log")),
            false => Ok(()),
        }
    })
    .map_err(wrong)?;
    let mut notes: Vec<String> = torn.iter().map(|t| format!("{file}: {t}")).collect();
    let unread = used.iter().filter(|(_, (_, read))| !read);
    notes.extend(
        unread
            .filter(|(topic, _)| !PASSED_OVER.contains(&topic.as_str()))
            .map(|(topic, (kind, _))| format!("topic {topic} ({kind}) is not read")),
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

fn table(rows: BTreeMap<i64, Row>, mut notes: Vec<String>) -> Result<Table, String> {
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
    let mut doubled = 0;
    for (k, (stamp_ns, row)) in rows.into_iter().enumerate() {
        time_s.push((i128::from(stamp_ns) - i128::from(first_ns)) as f64 * 1e-9);
        for (signal, value) in row {
            doubled += usize::from(cells[columns[&signal]][k].replace(value).is_some());
        }
    }
    if doubled > 0 {
        notes.push(format!("{doubled} value(s) that another of the same signal and stamp follows"));
    }
    Ok(Table::from_columns(columns.into_keys().collect(), time_s, cells, notes))
}
