//! Which joints columns are of whose names name none: by the order of what they are called, or by their numbers.

use std::collections::{BTreeMap, BTreeSet};

use caudata_model::RobotModel;

use super::sheet::Recording;
use super::words::{Words, joint_called};

/// What is no joint: a sensor, a supply, where a base or a hand is.
const NO_JOINT: &str = "x y z w roll pitch yaw euler quat imu base trunk torso hand tool tip ee foot force acc gyro mag \
                        marker battery bat cell unnamed index seq id count frame";

/// Joints by what columns call them.
pub(super) struct Order {
    /// What is left of a header without the words that say what it is of which joint.
    joints: BTreeMap<String, usize>,
    /// The number of the first joint where columns have numbers.
    first: usize,
}

impl Order {
    /// What the columns of a recording of `robot` mean. Those of angles that call as many joints otherwise as there are
    /// without a column are taken to have them in the robot's order (`Soll Schulter`, `Ist Schulter`, `Soll Ellbogen` of an arm of
    /// shoulder and elbow), by their numbers where each has its own. Else numbers count from 0, or from 1 where the last
    /// joint's is there and no 0.
    pub(super) fn of(recording: &Recording, robot: &RobotModel, clock: &str) -> Self {
        let mut free: Vec<usize> = (0..robot.actuated().len()).collect();
        let (mut labels, mut numbers) = (Vec::new(), Vec::new());
        for sheet in &recording.sheets {
            for column in sheet.header() {
                if column == clock || sheet.hint(column).is_some() {
                    continue;
                }
                let words = Words::of(column);
                if let Some(joint) = joint_called(robot, &words.whole) {
                    free.retain(|other| *other != joint);
                    continue;
                }
                let file = recording.file_of(sheet.as_ref());
                let angle = words.kind_in(file).is_some_and(|kind| ["cmd", "pos"].contains(&kind));
                if !angle || words.says(NO_JOINT) {
                    continue;
                }
                numbers.extend(words.number());
                labels.extend(words.label().filter(|label| !labels.contains(label)));
            }
        }
        // `leg0_q1` has the number of its joint in the leg: such stay in the order of their columns
        let number = |label: &String| Words::of(label).number();
        if labels.iter().filter_map(number).collect::<BTreeSet<_>>().len() == labels.len() {
            labels.sort_by_key(number);
        }
        let joints = match labels.len() == free.len() {
            true => labels.into_iter().zip(free).collect(),
            false => BTreeMap::new(),
        };
        let counts_from_1 = numbers.contains(&robot.actuated().len()) && !numbers.contains(&0);
        Self { joints, first: usize::from(counts_from_1) }
    }

    /// The joint of a column, if its name does not name one.
    pub(super) fn joint(&self, words: &Words, robot: &RobotModel) -> Option<usize> {
        if words.says(NO_JOINT) {
            return None;
        }
        let by_label = words.label().and_then(|label| self.joints.get(&label).copied());
        let by_number = || words.number()?.checked_sub(self.first);
        by_label.or_else(by_number).filter(|joint| *joint < robot.actuated().len())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use caudata_model::RobotModel;

    use super::super::draft::map;
    use super::super::map::{Map, apply};
    use super::super::{Format, open};

    fn model(name: &str) -> RobotModel {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots");
        RobotModel::load(format!("{folder}/{name}.robot.toml").as_ref()).unwrap()
    }

    /// Joints in another language or by number, a row of units, and joints that are named.
    #[test]
    fn columns_that_name_no_joint_have_them_in_order() {
        let dir = tempfile::tempdir().unwrap();
        let read = |robot: &str, text: &str| {
            let file = dir.path().join("run.csv");
            std::fs::write(&file, text).unwrap();
            let recordings = open(&file, Format::Csv, None).unwrap();
            let drafted = map(&recordings, &model(robot)).unwrap();
            let run = Map::parse("draft", &drafted.map)
                .map(|map| apply(&recordings[0], &map, &model(robot)).unwrap().rows.len());
            (drafted.read, drafted.unread, run.unwrap())
        };
        let names = model("quadruped").actuated_names().join(" ");
        let joints: Vec<&str> = names.split(' ').collect();
        // twelve, from 1 on, the tenth before the second
        let numbers: Vec<String> = (1..=12).map(|k| k.to_string()).collect();
        let mut shuffled = numbers.clone();
        shuffled.sort();
        let header: Vec<String> =
            shuffled.iter().map(|k| format!("q_ref{k},motor_{k}_angle")).collect();
        let row = vec!["0.1"; 25].join(",");
        let text = format!("t,{}\n{row}\n", header.join(","));
        let (read_of, unread, rows) = read("quadruped", &text);
        assert!(unread.is_empty() && rows == 1, "{unread:?}");
        assert_eq!(read_of[..2], [format!("cmd.{}", joints[0]), format!("pos.{}", joints[0])]);
        assert_eq!(read_of[2], format!("cmd.{}", joints[9]), "the tenth, called 10");
        // two that are left are those without a column
        let named: Vec<String> = joints[2..].iter().map(|j| format!("{j} Soll")).collect();
        let row = vec!["2.0"; 15].join(",");
        let units = vec!["deg"; 14].join(",");
        let text = format!(
            "Zeit,{},Ist Oberschenkel,Soll Oberschenkel,Soll Hüfte,Ist Hüfte\ns,{units}\n{row}\n",
            named.join(",")
        );
        let (read_of, unread, rows) = read("quadruped", &text);
        assert!(unread.is_empty() && rows == 1, "{unread:?}");
        let last = [(0, "pos"), (0, "cmd"), (1, "cmd"), (1, "pos")];
        assert_eq!(read_of[10..], last.map(|(j, kind)| format!("{kind}.{}", joints[j])));
        // an IMU's column with a 0 does not make the motors count from 0
        let motors: Vec<String> = (1..=12).map(|k| format!("motor_{k}_cmd")).collect();
        let text = format!("t,imu_q0,{}\n{}\n", motors.join(","), vec!["0.1"; 14].join(","));
        let (read_of, unread, _) = read("quadruped", &text);
        assert_eq!(
            (unread, &read_of[0]),
            (vec!["imu_q0".to_owned()], &format!("cmd.{}", joints[0]))
        );
        // numbers that come again stay in the order of their columns
        let legs: Vec<String> =
            (0..4).flat_map(|leg| (0..3).map(move |k| format!("leg{leg}_q{k}"))).collect();
        let text = format!("t,{}\n{}\n", legs.join(","), vec!["0.1"; 13].join(","));
        let all: Vec<String> = joints.iter().map(|joint| format!("pos.{joint}")).collect();
        assert_eq!(read("quadruped", &text).0, all);
        // where a hand is, is no joint, though two are left
        let row = vec!["2.0"; 13].join(",");
        let text = format!("t,{},hand_pos_x,hand_pos_y\n{row}\n", named.join(","));
        let (_, unread, _) = read("quadruped", &text);
        assert_eq!(unread, ["hand_pos_x", "hand_pos_y"]);
    }
}
