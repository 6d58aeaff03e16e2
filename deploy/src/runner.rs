//! A policy at work: observation, inference, action filter and gait clock, by the same code as in training.

use caudata_policy::Inference;
use caudata_task::action::{ActionConfig, ActionFilter};
use caudata_task::observation::{ObservationInput, Observer};
use caudata_task::past::Recall;
use caudata_task::phase::{PhaseClock, PhaseConfig};
use caudata_task::{ACTION_HISTORY, COMMAND_DIM, JointTable, PerFoot, PerJoint};

use crate::DeployError;
use crate::bus::ServoReadings;
use crate::state::PolicyRef;
use crate::verify::Verified;

/// Commands that a policy was trained for, [min, max] of vx, vy (m/s) and yaw rate (rad/s).
pub type CommandRanges = [[f32; 2]; COMMAND_DIM];

/// Runs one policy.
#[derive(Debug)]
pub struct PolicyRunner {
    policy: PolicyRef,
    /// Whether it went through its trial here before.
    proved: bool,
    inference: Inference,
    observer: Observer,
    /// Whether there is no observation before the next one.
    fresh: bool,
    joints: JointTable,
    action_config: ActionConfig,
    phase_config: PhaseConfig,
    ranges: CommandRanges,
    period_s: f32,
    /// Phase of each foot relative to the clock, rad.
    offsets_rad: PerFoot,
    clock: PhaseClock,
    filter: ActionFilter,
    /// Clipped, newest first.
    actions: [PerJoint; ACTION_HISTORY],
    obs: Vec<f32>,
    recall: Recall,
    /// Earlier observations, as far as the policy sees them.
    memory: Vec<f32>,
}

/// What the policy sees of one moment.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// The servos.
    pub servos: &'a ServoReadings,
    /// Angular velocity, rad/s, IMU frame.
    pub gyro_radps: [f32; 3],
    /// Direction of gravity, unit vector, IMU frame.
    pub gravity: [f32; 3],
    /// Commanded vx, vy (m/s), yaw rate (rad/s).
    pub command: [f32; COMMAND_DIM],
    /// Whether the robot is in water; `None` where nothing tells, which counts as land.
    pub in_water: Option<bool>,
}

impl PolicyRunner {
    /// Takes over a policy that passed every check. `carry_on` is the clock of the policy before it, whose
    /// phase goes on.
    ///
    /// # Errors
    /// [`DeployError::Internal`] where the contract lacks joints, which verification excludes.
    pub fn new(verified: Verified, carry_on: Option<&PhaseClock>) -> Result<Self, DeployError> {
        let contract = &verified.file.metadata().contract;
        let joints = contract
            .joint_table()
            .ok_or(DeployError::Internal { what: "a verified policy lacks joints".to_owned() })?;
        let [low_hz, high_hz] = contract.phase.frequency_hz;
        let command = &contract.command;
        let recall = Recall::new(&contract.observation);
        let phase_rad = carry_on.map_or(0.0, PhaseClock::phase_rad);
        Ok(Self {
            observer: contract
                .observer()
                .map_err(|error| DeployError::Internal { what: error.to_string() })?,
            fresh: true,
            joints,
            action_config: contract.action,
            phase_config: contract.phase.config(),
            ranges: [command.vx_mps, command.vy_mps, command.yaw_rate_radps],
            period_s: contract.control_period_s as f32,
            offsets_rad: contract.phase.offsets(),
            clock: PhaseClock::new(phase_rad, 0.5 * (low_hz + high_hz)),
            filter: ActionFilter::new(joints.len()),
            actions: [PerJoint::filled(joints.len(), 0.0); ACTION_HISTORY],
            obs: vec![0.0; contract.obs_dim()],
            memory: vec![0.0; recall.memory_len()],
            recall,
            policy: verified.policy,
            proved: verified.proved,
            inference: verified.inference,
        })
    }

    /// Which policy this is.
    pub fn policy(&self) -> &PolicyRef {
        &self.policy
    }

    /// Whether it went through its trial on this robot before.
    pub fn is_proved(&self) -> bool {
        self.proved
    }

    /// Its gait clock.
    pub fn clock(&self) -> &PhaseClock {
        &self.clock
    }

    /// The joints as the policy knows them.
    pub fn joints(&self) -> &JointTable {
        &self.joints
    }

    /// `wanted` brought into the range that the policy was trained for; a command to stand stays one.
    pub fn trained_command(&self, wanted: [f32; COMMAND_DIM]) -> [f32; COMMAND_DIM] {
        if wanted == [0.0; COMMAND_DIM] {
            return wanted;
        }
        std::array::from_fn(|i| wanted[i].max(self.ranges[i][0]).min(self.ranges[i][1]))
    }

    /// Begins anew: no past actions and observations, filter at rest. The gait clock goes on.
    pub fn forget(&mut self) {
        let joints = self.joints.len();
        self.fresh = true;
        self.filter = ActionFilter::new(joints);
        self.actions = [PerJoint::filled(joints, 0.0); ACTION_HISTORY];
    }

    /// Where it has wheels, these stand where they were sent last: they are not led back to an angle. Whether
    /// it has any.
    pub fn wheels_stand(&mut self, sent_rad: &PerJoint) -> bool {
        let mut any = false;
        for joint in 0..self.joints.len() {
            if self.joints.rolls(joint) {
                self.joints.nominal_rad[joint] = sent_rad[joint];
                any = true;
            }
        }
        any
    }

    /// What the policy saw last.
    pub fn observation(&self) -> &[f32] {
        &self.obs
    }

    /// Moves the gait clock on by whole control periods.
    pub fn advance(&mut self, periods: u32) {
        for _ in 0..periods {
            self.clock.advance(self.period_s);
        }
    }

    /// Position targets, rad, within the joint limits. `None` where inference failed or gave a number that is
    /// not finite; history and filter are then as before.
    pub fn act(&mut self, view: &View) -> Option<PerJoint> {
        self.clock.set_command(&self.phase_config, &view.command);
        let observation = ObservationInput {
            joint_vel_radps: &view.servos.vel_radps,
            joint_pos_rad: &view.servos.pos_rad,
            gyro_radps: view.gyro_radps,
            gravity: view.gravity,
            phase_rad: self.clock.phases_rad(&self.offsets_rad),
            command: view.command,
            previous_actions: &self.actions,
            medium: view.in_water.map(|water| f32::from(u8::from(water))),
        };
        let mut action = PerJoint::filled(self.joints.len(), 0.0);
        let fresh = std::mem::take(&mut self.fresh);
        let (observer, seen) = (&mut self.observer, &mut self.obs);
        let present = self.recall.present_dim();
        let written = observer.write(&observation, None, fresh, &mut seen[..present]);
        let written = written.and_then(|()| self.recall.write(fresh, seen, &mut self.memory));
        if let Err(error) = written {
            tracing::error!(%error, "no observation");
            return None;
        }
        if let Err(error) = self.inference.run(&self.obs, 1, &mut action) {
            tracing::error!(%error, "inference failed");
            return None;
        }
        if !action.iter().all(|a| a.is_finite()) {
            return None;
        }
        self.action_config.remember(&action, &mut self.actions);
        let mut targets_rad = action;
        self.filter.apply(&self.action_config, &self.actions[0], &self.joints, &mut targets_rad);
        Some(targets_rad)
    }
}
