//! What is kept of one lane between steps.

use caudata_random::{Key, Purpose, Stream};
use caudata_sim::sensors::ImuBias;
use caudata_task::action::ActionFilter;
use caudata_task::command::{CommandState, along_course};
use caudata_task::phase::{PhaseClock, PhaseConfig};
use caudata_task::push::PushSchedule;
use caudata_task::reward::{PerTerm, RewardInput};
use caudata_task::termination::TerminationReason;
use caudata_task::{ACTION_HISTORY, BodyPlan, JointTable, PerFoot, PerJoint, TaskConfig};
use serde::{Deserialize, Serialize};

use crate::measure::{Sensors, Truth};
use crate::output::EpisodeStats;

/// One lane: its episode, controllers, disturbances and streams.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Lane {
    /// Number of the episode, from 0.
    pub episode: u64,
    /// Control steps done in it.
    pub step: u32,
    /// Time limit of this episode, control steps.
    pub step_limit: u32,
    pub command: CommandState,
    pub clock: PhaseClock,
    /// Phase of each foot relative to the clock, rad.
    offsets_rad: PerFoot,
    pub filter: ActionFilter,
    pub push: PushSchedule,
    /// Force of the push in the step that is done, N, world.
    pub push_n: [f32; 2],
    /// Friction coefficient of the feet in this episode.
    pub friction: f32,
    /// Past actions, clipped, newest first.
    pub actions: [PerJoint; ACTION_HISTORY],
    /// True joint velocities after the last step, rad/s.
    pub joint_vel_radps: PerJoint,
    /// Constant error of the joint positions in this episode, rad.
    pub joint_offset_rad: PerJoint,
    /// Constant error of the IMU in this episode.
    pub imu_bias: ImuBias,
    pub command_stream: Stream,
    pub push_stream: Stream,
    pub sensor_stream: Stream,
    pub action_stream: Stream,
    pub tally: Tally,
}

impl Lane {
    /// The state at the start of the episode of `key`, except for its start pose, for a robot with so many
    /// joints whose feet have these phases relative to the clock, rad. `reset_stream` gives the clock's start and, where `stagger`
    /// asks for it, a random length.
    pub fn start(
        task: &TaskConfig,
        sensors: Option<&Sensors>,
        (joints, offsets_rad): (usize, PerFoot),
        key: Key,
        stagger: bool,
        heading_rad: f32,
        reset_stream: &mut Stream,
    ) -> Self {
        let control_period_s = task.control_period_s as f32;
        let mut command_stream = Stream::new(key, Purpose::Command);
        let mut push_stream = Stream::new(key, Purpose::Push);
        let mut sensor_stream = Stream::new(key, Purpose::Sensor);
        let command =
            CommandState::draw(&task.command, control_period_s, heading_rad, &mut command_stream);
        let mut clock = PhaseClock::draw(&task.phase, reset_stream);
        clock.set_command(&task.phase, &command.value);
        let joint_offset_rad = task.noise.draw_joint_offsets(joints, &mut sensor_stream);
        let imu_bias = sensors.map(|s| s.draw_bias(&mut sensor_stream)).unwrap_or_default();
        let step_limit = if stagger {
            1 + reset_stream.below(u64::from(task.episode_steps)) as u32
        } else {
            task.episode_steps
        };
        Self {
            episode: key.episode,
            step: 0,
            step_limit,
            command,
            clock,
            offsets_rad,
            filter: ActionFilter::new(joints),
            push_n: [0.0; 2],
            friction: 0.0,
            push: PushSchedule::draw(&task.push, control_period_s, &mut push_stream),
            actions: [PerJoint::filled(joints, 0.0); ACTION_HISTORY],
            joint_vel_radps: PerJoint::filled(joints, 0.0),
            joint_offset_rad,
            imu_bias,
            command_stream,
            push_stream,
            sensor_stream,
            action_stream: Stream::new(key, Purpose::Action),
            tally: Tally::default(),
        }
    }

    /// Phase of each foot (of the clock without feet), rad, (−π, π].
    pub fn phases_rad(&self) -> PerFoot {
        self.clock.phases_rad(&self.offsets_rad)
    }

    /// Follows `command` for the rest of the episode, if there is one.
    pub fn hold(&mut self, phase: &PhaseConfig, command: Option<&[f32; 3]>) {
        if let Some(&value) = command {
            self.command = CommandState { value, steps_left: u32::MAX, course_rad: None };
            self.clock.set_command(phase, &value);
        }
    }

    /// What the ended episode reports, except for its reward terms; `feet` is how many the robot has.
    pub fn stats(
        &self,
        lane: usize,
        feet: usize,
        reason: Option<TerminationReason>,
    ) -> EpisodeStats {
        let tally = &self.tally;
        let steps = f64::from(self.step.max(1));
        let mean = |sum: f64| (sum / steps) as f32;
        EpisodeStats {
            lane: lane as u32,
            episode: self.episode,
            steps: self.step,
            return_sum: tally.return_sum as f32,
            terms: Vec::new(),
            terminated: reason.is_some(),
            reason,
            mean_speed_mps: mean(tally.speed_mps),
            mean_velocity_error_mps: mean(tally.velocity_error_mps),
            mean_power_w: mean(tally.power_w),
            trunk_contact_share: mean(f64::from(tally.trunk_contacts)),
            duty_factor: mean(f64::from(tally.foot_contacts) / feet.max(1) as f64),
            mean_slip_mps: (tally.slip_mps / f64::from(tally.foot_contacts.max(1))) as f32,
        }
    }
}

/// Sums over the steps of an episode.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(crate) struct Tally {
    pub return_sum: f64,
    pub terms: PerTerm<f64>,
    speed_mps: f64,
    velocity_error_mps: f64,
    power_w: f64,
    slip_mps: f64,
    trunk_contacts: u32,
    foot_contacts: u32,
}

impl Tally {
    /// Counts one step.
    pub fn add(
        &mut self,
        reward: f32,
        terms: &PerTerm,
        truth: &Truth,
        command: &CommandState,
        contact_force_n: f32,
    ) {
        self.return_sum += f64::from(reward);
        for (sum, term) in self.terms.iter_mut().zip(terms) {
            *sum += f64::from(*term);
        }
        let off_course_rad = command.off_course_rad(truth.heading_rad);
        let [vx, vy] = along_course(truth.com_vel_mps, off_course_rad);
        let speed_of = |x: f32, y: f32| f64::from((x * x + y * y).sqrt());
        self.speed_mps += speed_of(vx, vy);
        self.velocity_error_mps += speed_of(command.value[0] - vx, command.value[1] - vy);
        self.power_w += f64::from(truth.mech_power_w.iter().map(|p| p.abs()).sum::<f32>());
        self.trunk_contacts += u32::from(truth.trunk_force_n > contact_force_n);
        for (v, force) in truth.foot_vel_mps.iter().zip(&truth.foot_force_n) {
            if force[2] > contact_force_n {
                self.foot_contacts += 1;
                self.slip_mps += speed_of(v[0], v[1]);
            }
        }
    }
}

/// What the reward of the step just done looks at.
pub(crate) fn reward_input<'a>(
    task: &TaskConfig,
    joints: &'a JointTable,
    body: &'a BodyPlan,
    target_rad: &'a [f32],
    lane: &'a Lane,
    truth: &'a Truth,
) -> RewardInput<'a> {
    let (sin, cos) = truth.heading_rad.sin_cos();
    let [push_x, push_y] = lane.push_n;
    RewardInput {
        joints,
        dt_s: task.control_period_s as f32,
        swing_height_m: task.phase.swing_height_m,
        command: lane.command.value,
        standing: lane.clock.standing(),
        phase_rad: lane.phases_rad(),
        off_course_rad: lane.command.off_course_rad(truth.heading_rad),
        com_vel_mps: truth.com_vel_mps,
        com_height_m: truth.com_height_m,
        yaw_rate_radps: truth.yaw_rate_radps,
        gyro_radps: truth.gyro_radps,
        gravity: truth.gravity,
        joint_pos_rad: &truth.joint_pos_rad,
        joint_vel_radps: &truth.joint_vel_radps,
        previous_joint_vel_radps: &lane.joint_vel_radps,
        motor_torque_nm: &truth.motor_torque_nm,
        mech_power_w: &truth.mech_power_w,
        foot_height_m: &truth.foot_height_m,
        foot_vel_mps: &truth.foot_vel_mps,
        foot_force_n: &truth.foot_force_n,
        trunk_force_n: truth.trunk_force_n,
        push_n: [cos * push_x + sin * push_y, cos * push_y - sin * push_x, 0.0],
        friction: lane.friction,
        submerged: truth.submerged,
        afloat: truth.afloat,
        on_ground: truth.on_ground,
        in_leg: &body.in_leg,
        in_tail: &body.in_tail,
        swimming_rad: &body.swimming_rad,
        target_rad,
        action: &lane.actions[0],
        previous_action: &lane.actions[1],
    }
}
