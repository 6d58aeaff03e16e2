//! The policy contract: all that a policy's numbers depend on. It is written into every policy file, its hash
//! rides in every rollout, and every reader compares it with its own.

use caudata_declare::named;
use caudata_model::{Pose, RobotModel};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::action::ActionConfig;
use crate::expression::Names;
use crate::layout::Part;
use crate::observation::Observer;
use crate::phase::PhaseConfig;
use crate::row::{MAX_FEET, MAX_JOINTS};
use crate::{JointTable, ObservationLayout, PerFoot, PerJoint, TaskConfig, TaskError};

/// What a policy was made for. Joint arrays are in policy order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyContract {
    /// Name of the robot.
    pub robot: String,
    /// SHA-256 of the robot's files, lower-case hexadecimal.
    pub robot_hash: String,
    /// Names of the actuated joints. `[A]`
    pub joint_names: Vec<String>,
    /// Nominal pose, rad. `[A]`
    pub nominal_pos_rad: Vec<f32>,
    /// Lower position limits, rad. `[A]`
    pub lower_limit_rad: Vec<f32>,
    /// Upper position limits, rad. `[A]`
    pub upper_limit_rad: Vec<f32>,
    /// Proportional gains at the joint, N·m/rad. `[A]`
    pub kp_nm_per_rad: Vec<f32>,
    /// Derivative gains at the joint, N·m·s/rad. `[A]`
    pub kd_nm_s_per_rad: Vec<f32>,
    /// Time between two actions, s.
    pub control_period_s: f64,
    /// What an action means.
    pub action: ActionConfig,
    /// Where each quantity lies in the observation.
    pub observation: ObservationLayout,
    /// Where the IMU sits and how its axes lie: what angular velocity and gravity of the observation are
    /// expressed in. `None` in policy files from before it was stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<ImuContract>,
    /// The gait clock.
    pub phase: PhaseContract,
    /// Commands that the policy was trained for.
    pub command: CommandContract,
    /// Height of the centre of mass above the highest ground under a foot or a girdle from which on the
    /// medium bit is 1 in water, m (`task.afloat_above_m`). Absent without that bit, and in files of before
    /// it was written down.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub afloat_above_m: Option<f32>,
}

/// The IMU's frame in that of the link that carries it; the root link's own frame on a robot without an IMU.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImuContract {
    /// Name of the link.
    pub link: String,
    /// Origin of the IMU's frame in the link's, m.
    pub pos_m: [f64; 3],
    /// Orientation: takes a vector from the IMU's frame to the link's; unit quaternion w, x, y, z.
    pub quat_wxyz: [f64; 4],
}

impl ImuContract {
    fn of(model: &RobotModel) -> Self {
        let (link, at) = match model.imu_site() {
            Some(site) => (site.link, site.link_from_site),
            None => (0, Pose::IDENTITY),
        };
        Self { link: model.links()[link].name.clone(), pos_m: at.pos_m, quat_wxyz: at.quat_wxyz }
    }
}

/// The gait clock of a contract.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhaseContract {
    /// Feet, in the order of the observation.
    pub feet: Vec<String>,
    /// Phase of each foot relative to the clock, rad.
    pub offsets_rad: Vec<f32>,
    /// Stride frequencies seen in training, Hz, [min, max].
    pub frequency_hz: [f32; 2],
    /// Height of the foot reference, m.
    pub swing_height_m: f32,
    /// Commands up to this norm stop the clock (see [`PhaseConfig`]).
    pub stand_command_norm: f32,
}

impl PhaseContract {
    /// The clock's configuration, to run a [`crate::phase::PhaseClock`] with.
    pub fn config(&self) -> PhaseConfig {
        PhaseConfig {
            frequency_hz: self.frequency_hz,
            swing_height_m: self.swing_height_m,
            stand_command_norm: self.stand_command_norm,
            ..PhaseConfig::default()
        }
    }

    /// Phase of each foot relative to the clock, rad; of the clock, 0, without feet.
    pub fn offsets(&self) -> PerFoot {
        match self.offsets_rad.as_slice() {
            [] => PerFoot::filled(1, 0.0),
            offsets => PerFoot::of(offsets),
        }
    }
}

/// Ranges of the commands of a contract, [min, max].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CommandContract {
    /// Forward velocity, m/s.
    pub vx_mps: [f32; 2],
    /// Velocity to the left, m/s.
    pub vy_mps: [f32; 2],
    /// Yaw rate, rad/s.
    pub yaw_rate_radps: [f32; 2],
}

named! {
    /// A field in which two contracts differ.
    #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum ContractDifference {
        /// Another robot.
        Robot = "robot",
        /// The same robot with other parameters (its files have another hash).
        RobotModel = "robot model",
        /// Other joints, or the same in another order.
        JointOrder = "joint order",
        /// Another nominal pose.
        NominalPose = "nominal pose",
        /// Other joint limits.
        JointLimits = "joint limits",
        /// Other gains.
        Gains = "gains",
        /// Another control rate.
        ControlPeriod = "control period",
        /// Another meaning of actions.
        Action = "action",
        /// Another observation.
        Observation = "observation layout",
        /// An IMU at another place, or with other axes.
        Imu = "place and axes of the IMU",
        /// Another gait clock.
        Phase = "gait phase",
        /// Other command ranges.
        CommandRange = "command range",
        /// Another depth from which on it swims.
        Afloat = "height from which on it swims",
    }
}

impl ContractDifference {
    /// Whether a policy would compute nonsense. Not so where only the training conditions differ: a robot
    /// file with other physical parameters (as diagnosis writes), or other command ranges.
    pub fn is_breaking(self) -> bool {
        !matches!(self, Self::RobotModel | Self::CommandRange | Self::Afloat)
    }
}

/// Whether a policy file and its robot can carry these names of joints.
///
/// # Errors
/// [`TaskError::Contract`] names the first that is not 1 to 32 printable ASCII characters without a comma.
pub fn check_joint_names<N: AsRef<str>>(names: &[N]) -> Result<(), TaskError> {
    let good = |n: &str| {
        (1..=32).contains(&n.len()) && n.bytes().all(|b| b.is_ascii_graphic() && b != b',')
    };
    match names.iter().map(AsRef::as_ref).find(|n| !good(n)) {
        None => Ok(()),
        Some(name) => Err(TaskError::Contract {
            what: "joint_names",
            reason: format!(
                "has `{name}`; a name is 1 to 32 printable ASCII characters without space or comma"
            ),
        }),
    }
}

impl PolicyContract {
    /// The contract of `task` on `model`.
    ///
    /// # Errors
    /// [`TaskError`] when the configuration is invalid or the robot is not one that the task can drive.
    pub fn new(model: &RobotModel, task: &TaskConfig) -> Result<Self, TaskError> {
        task.validate()?;
        let joints = JointTable::from_model(model)?;
        let feet: Vec<String> = model.feet().iter().map(|foot| foot.name.clone()).collect();
        let names: Vec<&str> = feet.iter().map(String::as_str).collect();
        let offsets_rad = task.phase.offsets_rad(&names)?;
        let joint_names = model.actuated_names();
        let joint_names: Vec<String> = joint_names.into_iter().map(str::to_owned).collect();
        let medium = task.observe_medium;
        let observation = task.observation.layout(&joint_names, &feet, medium)?;
        Ok(Self {
            robot: model.name().to_owned(),
            robot_hash: model.hash_hex(),
            joint_names,
            nominal_pos_rad: joints.nominal_rad.to_vec(),
            lower_limit_rad: joints.lower_rad.to_vec(),
            upper_limit_rad: joints.upper_rad.to_vec(),
            kp_nm_per_rad: model.gains().iter().map(|g| g.kp_nm_per_rad as f32).collect(),
            kd_nm_s_per_rad: model.gains().iter().map(|g| g.kd_nm_s_per_rad as f32).collect(),
            control_period_s: task.control_period_s,
            action: task.action,
            observation,
            imu: Some(ImuContract::of(model)),
            phase: PhaseContract {
                offsets_rad: offsets_rad[..feet.len()].to_vec(),
                feet,
                frequency_hz: task.phase.clock_hz(),
                swing_height_m: task.phase.swing_height_m,
                stand_command_norm: task.phase.stand_command_norm,
            },
            command: CommandContract {
                vx_mps: task.command.vx_mps,
                vy_mps: task.command.vy_mps,
                yaw_rate_radps: task.command.yaw_rate_radps,
            },
            afloat_above_m: task.observe_medium.then_some(task.afloat_above_m),
        })
    }

    /// Checks a contract that came from outside: lengths, finite numbers, ranges.
    ///
    /// # Errors
    /// [`TaskError::Contract`] names the first field that is wrong, [`TaskError::Config`] a value of its
    /// action or phase.
    pub fn validate(&self) -> Result<(), TaskError> {
        let refuse = |what, reason: String| Err(TaskError::Contract { what, reason });
        let (joints, feet) = (self.joint_names.len(), self.phase.feet.len());
        if !(1..=MAX_JOINTS).contains(&joints) {
            let reason = format!("has {joints} entries, expected 1 to {MAX_JOINTS}");
            return refuse("joint_names", reason);
        }
        check_joint_names(&self.joint_names)?;
        let values = self.nominal_pos_rad.len();
        if joints != values && self.lower_limit_rad.len() == values {
            let reason = format!("has {joints} entries, expected {values}");
            return refuse("joint_names", reason);
        }
        let phases = self.observation.slice(Part::Phase.name());
        let phases = phases.filter(|slice| slice.value.is_none()); // one's own may have any width
        let phases = phases.map_or(feet.max(1), |slice| slice.width() / 2);
        if feet > MAX_FEET || phases != feet.max(1) {
            let reason = format!("has {feet} entries, expected {phases}, at most {MAX_FEET}");
            return refuse("phase.feet", reason);
        }
        let arrays = [
            ("nominal_pos_rad", &self.nominal_pos_rad, joints),
            ("lower_limit_rad", &self.lower_limit_rad, joints),
            ("upper_limit_rad", &self.upper_limit_rad, joints),
            ("kp_nm_per_rad", &self.kp_nm_per_rad, joints),
            ("kd_nm_s_per_rad", &self.kd_nm_s_per_rad, joints),
            ("phase.offsets_rad", &self.phase.offsets_rad, feet),
        ];
        for (what, values, len) in arrays {
            if values.len() != len {
                let reason = format!("has {} entries, expected {len}", values.len());
                return refuse(what, reason);
            }
            if values.iter().any(|v| !v.is_finite()) {
                return refuse(what, "has a value that is not finite".to_owned());
            }
        }
        let mut limits = self.lower_limit_rad.iter().zip(&self.upper_limit_rad);
        if let Some(i) = limits.position(|(lower, upper)| lower > upper) {
            let reason = format!("is above the upper limit at joint {i}");
            return refuse("lower_limit_rad", reason);
        }
        let terms = self.observation.terms();
        let known = ObservationLayout::of(&terms, &self.joint_names, &self.phase.feet);
        let known = known.and_then(|known| known.with_past(self.observation.past()));
        if !known.is_ok_and(|known| known == self.observation) {
            let reason =
                "is not a layout that this version knows for these joints and feet".to_owned();
            return refuse("observation", reason);
        }
        let knows_water = !self.observation.range(Part::Medium).is_empty();
        let swims_from = |m: f32| knows_water && (0.0..=10.0).contains(&m);
        if !self.afloat_above_m.is_none_or(swims_from) {
            let reason = "must be 0 to 10 m, and absent without the medium bit".to_owned();
            return refuse("afloat_above_m", reason);
        }
        if !(1e-4..=1.0).contains(&self.control_period_s) {
            return refuse(
                "control_period_s",
                format!("is {}, expected 0.0001 to 1", self.control_period_s),
            );
        }
        self.action.validate()?;
        self.phase.config().validate()
    }

    /// The names that expressions may use.
    pub fn names(&self) -> Names<'_> {
        Names { joints: &self.joint_names, feet: &self.phase.feet }
    }

    /// Writes this contract's observations.
    ///
    /// # Errors
    /// [`TaskError`] where the contract is not a valid one.
    pub fn observer(&self) -> Result<Observer, TaskError> {
        let joints = self.joint_table().ok_or(TaskError::Contract {
            what: "nominal_pos_rad",
            reason: "has not one entry per joint".to_owned(),
        })?;
        Observer::new(&self.observation, &joints, self.names())
    }

    /// Length of an observation.
    pub fn obs_dim(&self) -> usize {
        self.observation.dim()
    }

    /// Length of an action.
    pub fn act_dim(&self) -> usize {
        self.joint_names.len()
    }

    /// Nominal pose and limits in the form that the action filter takes; `None` unless there is one of each
    /// per joint (a contract that passed [`Self::validate`] has them).
    pub fn joint_table(&self) -> Option<JointTable> {
        let row = |values: &[f32]| {
            let fits = values.len() == self.act_dim() && values.len() <= MAX_JOINTS;
            fits.then(|| PerJoint::of(values))
        };
        Some(JointTable {
            nominal_rad: row(&self.nominal_pos_rad)?,
            lower_rad: row(&self.lower_limit_rad)?,
            upper_rad: row(&self.upper_limit_rad)?,
        })
    }

    /// Everything in which `self` differs from `other`, most telling first.
    pub fn differences(&self, other: &Self) -> Vec<ContractDifference> {
        use ContractDifference as D;
        [
            (D::Robot, self.robot == other.robot),
            (D::JointOrder, self.joint_names == other.joint_names),
            (D::Observation, self.observation == other.observation),
            (D::Action, self.action == other.action),
            (D::ControlPeriod, self.control_period_s == other.control_period_s),
            (D::NominalPose, self.nominal_pos_rad == other.nominal_pos_rad),
            (
                D::JointLimits,
                self.lower_limit_rad == other.lower_limit_rad
                    && self.upper_limit_rad == other.upper_limit_rad,
            ),
            (
                D::Gains,
                self.kp_nm_per_rad == other.kp_nm_per_rad
                    && self.kd_nm_s_per_rad == other.kd_nm_s_per_rad,
            ),
            (D::Imu, {
                let stated = self.imu.as_ref().zip(other.imu.as_ref());
                stated.is_none_or(|(own, other)| own == other)
            }),
            (D::Phase, self.phase == other.phase),
            (D::RobotModel, self.robot_hash == other.robot_hash),
            (D::CommandRange, self.command == other.command),
            (D::Afloat, self.same_medium(other)),
        ]
        .into_iter()
        .filter_map(|(difference, same)| (!same).then_some(difference))
        .collect()
    }

    /// Whether the medium bits mean the same, as far as both say what they mean.
    fn same_medium(&self, other: &Self) -> bool {
        match (self.afloat_above_m, other.afloat_above_m) {
            (Some(own), Some(other)) => own == other,
            _ => true,
        }
    }

    /// The contract as canonical JSON: keys sorted, no white space, shortest numbers that read back exactly.
    pub fn canonical_json(&self) -> String {
        // Through text, so that a f32 is written as its own shortest decimal (0.15), which is also what a
        // reader of the policy file in any language gets back, and not as that f32 in double precision.
        let value = serde_json::to_string(self)
            .and_then(|text| serde_json::from_str::<serde_json::Value>(&text))
            .unwrap_or_default();
        let mut out = String::new();
        write_canonical(&value, &mut out);
        out
    }

    /// SHA-256 of the canonical JSON.
    pub fn hash(&self) -> [u8; 32] {
        Sha256::digest(self.canonical_json().as_bytes()).into()
    }

    /// [`Self::hash`] in lower-case hexadecimal.
    pub fn hash_hex(&self) -> String {
        hex::encode(self.hash())
    }
}

/// Writes `value` with sorted keys, whatever map type `serde_json` was built with.
fn write_canonical(value: &serde_json::Value, out: &mut String) {
    use serde_json::Value;
    match value {
        Value::Array(items) => {
            out.push('[');
            for (i, item) in items.iter().enumerate() {
                if i > 0 {
                    out.push(',');
                }
                write_canonical(item, out);
            }
            out.push(']');
        }
        Value::Object(map) => {
            let mut entries: Vec<_> = map.iter().collect();
            entries.sort_by_key(|(key, _)| *key);
            out.push('{');
            for (i, (key, item)) in entries.into_iter().enumerate() {
                if i > 0 {
                    out.push(',');
                }
                out.push_str(&Value::from(key.as_str()).to_string());
                out.push(':');
                write_canonical(item, out);
            }
            out.push('}');
        }
        leaf => out.push_str(&leaf.to_string()),
    }
}

#[cfg(test)]
mod tests;
