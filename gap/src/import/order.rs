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
