//! Recordings of ROS 2 (rosbag2), MCAP or SQLite: a file, or the folder of a bag.
//!
//! | message | columns, below the topic's name |
//! |---|---|
//! | `sensor_msgs/JointState` | `position/<joint>`, `velocity/<joint>`, `effort/<joint>` |
//! | `trajectory_msgs/JointTrajectory` | `position/<joint>`: what it asks for, every 10 ms |
//! | `std_msgs/Float64MultiArray` | `data[<number>]`; likewise joints without names |
//! | `sensor_msgs/Imu` | `angular_velocity/x`, `linear_acceleration/x`, `gravity/x` |
//! | `nav_msgs/Odometry`, `geometry_msgs/PoseStamped` | `position/x`, `orientation/w` |
//! | `sensor_msgs/BatteryState` | `voltage` |
//!
//! A topic has two clocks: `stamp` (the header's; the receipt where there is none) and `received`. Both count
//! from the first of the recording.

use std::collections::BTreeMap;
use std::path::Path;

use caudata_runlog::ros::bag::{Recorded, files, messages};
use caudata_runlog::ros::cdr::CdrError;
use caudata_runlog::ros::gravity_of;
use caudata_runlog::ros::messages::{
    BatteryState, Imu, JointState, JointTrajectory, NumberArray, Odometry, PoseStamped,
};

use super::run::{ImportError, file_stem};
use super::sheet::{Clock, Hint, Joint, MAX_VALUES, Numbers, Recording, Sheet};
use super::trajectory::{Asked, followed, most_values};

/// Words in the name of a topic of commands.
const COMMANDING: [&str; 6] = ["command", "cmd", "goal", "target", "desired", "reference"];
/// Header and receipt further from each other than this are of two clocks, ns.
const SAME_CLOCK_NS: i64 = 500_000_000;
const AXES: [&str; 3] = ["x", "y", "z"];

/// Values of a message, by column below its topic; and the header's stamp, ns, 0 where there is none.
type Row = (i64, Vec<(String, f64)>);

/// The recording at `path`.
///
/// # Errors
/// [`ImportError`] with file and reason.
pub fn open(path: &Path) -> Result<Recording, ImportError> {
    let mut bag = Bag::default();
    let mut notes = Vec::new();
    let files = files(path)?;
    for file in &files {
        notes.extend(messages(file, &READ, &mut |m| bag.take(m))?);
    }
    bag.recording(path, files.len(), notes)
}

/// Topics so far.
#[derive(Default)]
struct Bag {
    topics: BTreeMap<String, Topic>,
    /// Kind and number of messages of topics that are not read.
    others: BTreeMap<String, (String, usize)>,
    values: usize,
}

/// A topic that is read.
#[derive(Default)]
struct Topic {
    sheet: Numbers,
    stamp_ns: Vec<i64>,
    received_ns: Vec<i64>,
    /// Whether its messages have stamps of their own.
    stamped: bool,
    asked: Vec<Asked>,
}

/// The types that are read.
const READ: [&str; 7] = [
    JointState::TYPE,
    JointTrajectory::TYPE,
    NumberArray::TYPE,
    Imu::TYPE,
    Odometry::TYPE,
    PoseStamped::TYPE,
    BatteryState::TYPE,
];

impl Bag {
    fn take(&mut self, message: &Recorded<'_>) -> Result<(), String> {
        if !READ.contains(&message.kind) {
            match self.others.get_mut(message.topic) {
                Some((_, count)) => *count += 1,
                None => {
                    let first = (message.kind.to_owned(), 1);
                    self.others.insert(message.topic.to_owned(), first);
                }
            }
            return Ok(());
        }
        if !self.topics.contains_key(message.topic) {
            let sheet = Numbers::new(message.topic);
            let topic = Topic { sheet, ..Topic::default() };
            self.topics.insert(message.topic.to_owned(), topic);
        }
        let Some(topic) = self.topics.get_mut(message.topic) else { return Ok(()) };
        self.values += topic.take(message)?;
        match self.values > MAX_VALUES {
            true => Err(format!("more than {MAX_VALUES} values: split the recording")),
            false => Ok(()),
        }
    }

    /// What it has become; `files` is how many files were there.
    fn recording(
        mut self,
        path: &Path,
        files: usize,
        notes: Vec<String>,
    ) -> Result<Recording, ImportError> {
        let file = path.display().to_string();
        let wrong = |message| ImportError::Format { file: file.clone(), message };
        let unread = self.others.iter();
        let unread: Vec<String> =
            unread.map(|(topic, (kind, n))| format!("{topic} ({kind}, {n} messages)")).collect();
        for topic in self.topics.values_mut() {
            self.values += topic.follow(MAX_VALUES.saturating_sub(self.values)).map_err(wrong)?;
        }
        self.topics.retain(|_, topic| topic.sheet.rows() > 0);
        if self.topics.is_empty() {
            return Err(wrong(match (files, unread.is_empty()) {
                (0, _) => "has no .mcap and no .db3 file".to_owned(),
                (_, true) => "has no message".to_owned(),
                _ => format!("has no topic that is read; it has {}", unread.join(", ")),
            }));
        }
        let clock = self.clock();
        let first = |of: fn(&Topic) -> &Vec<i64>| {
            let all = self.topics.values().flat_map(of);
            all.copied().min().unwrap_or(0)
        };
        let [stamp_ns, received_ns] = [first(|t| &t.stamp_ns), first(|t| &t.received_ns)];
        let sheets = self.topics.into_values().map(|mut topic| {
            let seconds = |all: &[i64], from: i64| {
                all.iter().map(|t| t.saturating_sub(from) as f64 * 1e-9).collect()
            };
            topic.sheet.put_first("received", seconds(&topic.received_ns, received_ns));
            topic.sheet.put_first("stamp", seconds(&topic.stamp_ns, stamp_ns));
            Box::new(topic.sheet) as Box<dyn Sheet>
        });
        Ok(Recording {
            name: file_stem(path),
            sheets: sheets.collect(),
            clock: Some(clock),
            unread,
            notes,
            file,
        })
    }

    /// Headers count where they can: where all topics have them, or those without are of the same clock.
    fn clock(&self) -> Clock {
        let mut late_ns: Vec<i64> = Vec::new();
        for topic in self.topics.values().filter(|t| t.stamped) {
            let both = topic.received_ns.iter().zip(&topic.stamp_ns);
            late_ns.extend(both.map(|(received, stamp)| received.saturating_sub(*stamp)));
        }
        late_ns.sort_unstable();
        let bare = self.topics.iter().filter(|(_, t)| !t.stamped);
        let bare: Vec<&str> = bare.map(|(name, _)| name.as_str()).collect();
        let clock = |column: &str, remark| Clock { column: column.to_owned(), unit: "s", remark };
        let Some(late) = late_ns.get(late_ns.len() / 2).copied() else {
            return clock("received", "receipt: no message has a stamp of its own".to_owned());
        };
        let late_ms = late as f64 * 1e-6;
        match (bare.is_empty(), late.saturating_abs() < SAME_CLOCK_NS) {
            (true, _) => {
                clock("stamp", "the headers' stamps; `received` is when they arrived".to_owned())
            }
            (false, true) => clock(
                "stamp",
                format!(
                    "the headers' stamps; {} has none and counts by receipt, which is {late_ms:.1} ms later at the others",
                    bare.join(", ")
                ),
            ),
            (false, false) => clock(
                "received",
                format!(
                    "receipt: {} has no stamps, and those of the others are of another clock",
                    bare.join(", ")
                ),
            ),
        }
    }
}

impl Topic {
    /// A further message; how many values it adds.
    fn take(&mut self, message: &Recorded<'_>) -> Result<usize, String> {
        let text = |e: CdrError| e.to_string();
        if message.kind == JointTrajectory::TYPE {
            let trajectory = JointTrajectory::decode(&message.data).map_err(text)?;
            let stamp_ns = trajectory.header.stamp_ns;
            self.stamped |= stamp_ns != 0;
            let stamp_ns = if stamp_ns == 0 { message.received_ns } else { stamp_ns };
            let values = trajectory.points.iter().map(|p| p.position.len() + 1);
            let values = values.sum();
            let from_ns = [stamp_ns, message.received_ns];
            self.asked.push(Asked { from_ns, trajectory });
            return Ok(values);
        }
        let (stamp_ns, row) = row(message).map_err(text)?;
        self.stamped |= stamp_ns != 0;
        let stamp_ns = if stamp_ns == 0 { message.received_ns } else { stamp_ns };
        self.push([stamp_ns, message.received_ns], row, message.kind)
    }

    fn push(
        &mut self,
        [stamp_ns, received_ns]: [i64; 2],
        row: Vec<(String, f64)>,
        kind: &str,
    ) -> Result<usize, String> {
        let name = self.sheet.name().to_owned();
        let hint = |column: &str| hint(kind, &name, &column[name.len() + 1..], &row);
        let values = row.iter().map(|(column, x)| (format!("{name}/{column}"), *x));
        let added = self.sheet.push(values, &hint)?;
        self.stamp_ns.push(stamp_ns);
        self.received_ns.push(received_ns);
        Ok(added + 2)
    }

    /// What its trajectories ask for, as rows; `most` values at most.
    fn follow(&mut self, most: usize) -> Result<usize, String> {
        let mut asked = std::mem::take(&mut self.asked);
        asked.sort_by_key(|a| a.from_ns);
        let (mut values, mut last) = (0usize, BTreeMap::new());
        for k in 0..asked.len() {
            let until_ns = asked.get(k + 1).map_or(i64::MAX, |next| next.from_ns[0]);
            let Asked { from_ns, trajectory } = &asked[k];
            let until_ns = until_ns.saturating_sub(from_ns[0]);
            if values.saturating_add(most_values(trajectory, until_ns)) > most {
                return Err(format!("more than {MAX_VALUES} values: split the recording"));
            }
            for (after_ns, row) in followed(trajectory, until_ns, &mut last) {
                let at = from_ns.map(|from| from.saturating_add(after_ns));
                values += self.push(at, row, JointTrajectory::TYPE)?;
            }
        }
        Ok(values)
    }
}

/// What a message says.
fn row(message: &Recorded<'_>) -> Result<Row, CdrError> {
    let data = &message.data;
    let mut row = Vec::new();
    let mut put = |part: &str, names: &[String], values: &[f64]| {
        row.extend(values.iter().enumerate().map(|(k, x)| match names.get(k) {
            Some(name) => (format!("{part}/{name}"), *x),
            None => (format!("{part}[{k}]"), *x),
        }));
    };
    let axes = AXES.map(str::to_owned);
    let wxyz = ["w", "x", "y", "z"].map(str::to_owned);
    let header = match message.kind {
        JointState::TYPE => {
            let m = JointState::decode(data)?;
            put("position", &m.name, &m.position);
            put("velocity", &m.name, &m.velocity);
            put("effort", &m.name, &m.effort);
            m.header
        }
        Imu::TYPE => {
            let m = Imu::decode(data)?;
            put("angular_velocity", &axes, &m.gyro_radps);
            put("linear_acceleration", &axes, &m.acc_mps2);
            if let Some(q) = m.orientation_wxyz {
                put("gravity", &axes, &gravity_of(q));
            }
            m.header
        }
        Odometry::TYPE => {
            let m = Odometry::decode(data)?;
            let [x, y, z, w] = m.orientation_xyzw;
            put("position", &axes, &m.position_m);
            put("orientation", &wxyz, &[w, x, y, z]);
            m.header
        }
        PoseStamped::TYPE => {
            let m = PoseStamped::decode(data)?;
            put("position", &axes, &m.position_m);
            put("orientation", &wxyz, &m.orientation_wxyz);
            m.header
        }
        BatteryState::TYPE => {
            let m = BatteryState::decode(data)?;
            row.push(("voltage".to_owned(), f64::from(m.voltage_v)));
            m.header
        }
        _ => {
            put("data", &[], &NumberArray::decode(data)?.data);
            return Ok((0, row));
        }
    };
    Ok((header.stamp_ns, row))
}

/// What the form says of the column `column` of a topic, a message of which has the values `row`.
fn hint(kind: &str, topic: &str, column: &str, row: &[(String, f64)]) -> Hint {
    let number = column.strip_suffix(']').and_then(|c| c.rsplit_once('['));
    let number = number.and_then(|(part, k)| Some((part, k.parse::<usize>().ok()?)));
    let (part, of) = match number {
        Some((part, _)) => (part, ""),
        None => column.split_once('/').unwrap_or((column, "")),
    };
    let topic = topic.to_lowercase();
    let commands = COMMANDING.iter().any(|word| topic.contains(word));
    let whole = |signals: [&'static str; 3], unit: &'static str| Hint {
        kind: AXES.iter().position(|a| *a == of).map_or("", |k| signals[k]),
        joint: None,
        unit: Some(unit),
    };
    let among = || row.iter().filter(|(c, _)| c.starts_with(&format!("{part}["))).count();
    let joint = match number {
        Some((_, k)) => Some(Joint::Numbered(k, among())),
        None => Some(Joint::Named(of.to_owned())),
    };
    let (kind, unit) = match (kind, part) {
        (JointTrajectory::TYPE, _) => ("cmd", None),
        (NumberArray::TYPE, _) if commands => ("cmd", None),
        (JointState::TYPE, "position") if commands => ("cmd", None),
        (JointState::TYPE, "position") => ("pos", None),
        (JointState::TYPE, "velocity") if !commands => ("vel", None),
        (JointState::TYPE, "effort") if !commands => match topic.contains("current") {
            true => ("cur", None),
            false => ("tau", Some("Nm")),
        },
        (Imu::TYPE, "angular_velocity") => {
            return whole(["imu.gyro.x", "imu.gyro.y", "imu.gyro.z"], "rad/s");
        }
        (Imu::TYPE, "linear_acceleration") => {
            return whole(["imu.acc.x", "imu.acc.y", "imu.acc.z"], "m/s2");
        }
        (Imu::TYPE, "gravity") => return whole(["imu.grav.x", "imu.grav.y", "imu.grav.z"], "1"),
        (Odometry::TYPE | PoseStamped::TYPE, "position") => {
            return whole(["base.pos.x", "base.pos.y", "base.pos.z"], "m");
        }
        (Odometry::TYPE | PoseStamped::TYPE, "orientation") if of == "w" => {
            return Hint { kind: "base.quat.w", joint: None, unit: Some("1") };
        }
        (Odometry::TYPE | PoseStamped::TYPE, "orientation") => {
            return whole(["base.quat.x", "base.quat.y", "base.quat.z"], "1");
        }
        (BatteryState::TYPE, _) => {
            return Hint { kind: "volt", joint: None, unit: Some("V") };
        }
        _ => ("", None),
    };
    Hint { kind, joint, unit }
}
