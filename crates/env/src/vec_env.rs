//! The vectorised environment.

use std::sync::Arc;
use std::time::{Duration, Instant};

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::{Engine, State};
use caudata_task::noise::Readings;
use caudata_task::observation::Observer;
use caudata_task::past::Recall;
use caudata_task::reward::own::{Programs, StateSignals};
use caudata_task::reward::{self, PerTerm};
use caudata_task::termination::{self, TerminationInput, TerminationReason};
use caudata_task::{
    BodyPlan, Critic, JointTable, Mirror, ObservationLayout, PerFoot, PerJoint, PolicyContract,
    TaskConfig,
};

use crate::EnvError;
use crate::checks::{check_actions, check_engine};
use crate::lane::{Lane, reward_input};
use crate::measure::{Reader, Sensors, Truth};
use crate::output::{OutputBuffers, StepOutput};
use crate::physics::PhysicsDraws;
use crate::start::StartShift;

/// Many environments of one task on one engine. `N` lanes, `D` observation values, `A` actions.
pub struct VecEnv {
    pub(crate) task: TaskConfig,
    pub(crate) contract: PolicyContract,
    pub(crate) engine: Box<dyn Engine>,
    pub(crate) lanes: Vec<Lane>,
    /// `[N, D]`
    pub(crate) observations: Vec<f32>,
    /// Earlier observations, as far as the policy sees them. `[N, M]`
    pub(crate) memories: Vec<f32>,
    /// What only the value function sees. `[N, E]`
    pub(crate) privileged: Vec<f32>,
    /// Environment steps of the whole run, for what grows with progress.
    pub(crate) progress: u64,
    pub(crate) seed: u64,
    pub(crate) actor: u64,
    /// Number of the first lane in the keys of the random streams.
    pub(crate) first_lane: u64,
    pub(crate) layout: ObservationLayout,
    pub(crate) observer: Observer,
    pub(crate) recall: Recall,
    pub(crate) critic: Critic,
    /// Whether the policy sees what only the simulation knows.
    pub(crate) sees_truth: bool,
    /// Reward terms of the task file.
    own_rewards: Programs,
    /// Conditions of the task file that end an episode.
    own_ends: Programs,
    pub(crate) joints: JointTable,
    mirror: Option<Mirror>,
    pub(crate) body: BodyPlan,
    pub(crate) reader: Reader,
    /// `None`: perfect sensors.
    pub(crate) sensors: Option<Sensors>,
    physics: PhysicsDraws,
    buffers: OutputBuffers,
    /// `[N, A]`, rad.
    targets_rad: Vec<f32>,
    /// Where the lane that is looked at would have its joints, whatever their limits. `[A]`
    pub(crate) target_rad: PerJoint,
    /// What its sensors read.
    pub(crate) readings: Readings,
    /// Its reward terms.
    terms: PerTerm,
    /// `[N, 6]`, force (N) and torque (N·m).
    wrenches: Vec<f32>,
    /// Lanes whose episode ended in this step.
    ended: Vec<usize>,
    /// The command that each lane follows for good; empty: commands are drawn. `[N]` or empty.
    pub(crate) held_commands: Vec<[f32; 3]>,
    /// Factor on the torque of each actuated joint, in every lane. `[A]`
    pub(crate) joint_strengths: Vec<f32>,
    /// Added to every drawn start.
    pub(crate) start_shift: StartShift,
    /// Time that the engine has taken for steps since it was made; no result depends on it.
    pub physics_time: Duration,
}

impl VecEnv {
    /// Environments of `task` on `engine`, every lane at the start of its first episode.
    ///
    /// `seed` is the run's, `actor` tells apart the actors of a run: they see different episodes.
    ///
    /// # Errors
    /// When the task is invalid, does not fit the robot, or the engine simulates another robot or rate.
    pub fn new(
        model: Arc<RobotModel>,
        task: TaskConfig,
        engine: Box<dyn Engine>,
        seed: u64,
        actor: u64,
    ) -> Result<Self, EnvError> {
        Self::from_lane(model, task, engine, seed, actor, 0)
    }

    /// As [`Self::new`], with lanes numbered from `first_lane`: several environments with the same `actor`
    /// and lanes that follow on one another draw what one environment with all the lanes would.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn from_lane(
        model: Arc<RobotModel>,
        task: TaskConfig,
        engine: Box<dyn Engine>,
        seed: u64,
        actor: u64,
        first_lane: u64,
    ) -> Result<Self, EnvError> {
        let contract = PolicyContract::new(&model, &task)?;
        let joints = JointTable::from_model(&model)?;
        check_engine(&model, &task, engine.as_ref())?;
        let lanes = engine.lanes();
        let layout = contract.observation.clone();
        let (observer, recall) = (contract.observer()?, Recall::new(&layout));
        let critic = Critic::new(&task.critic, contract.names())?;
        let own_rewards = task.reward.programs(contract.names())?;
        let own_ends = task.termination.programs(contract.names())?;
        let mut env = Self {
            contract,
            lanes: Vec::with_capacity(lanes),
            observations: vec![0.0; lanes * layout.dim()],
            memories: vec![0.0; lanes * recall.memory_len()],
            privileged: vec![0.0; lanes * critic.dim()],
            critic,
            progress: 0,
            seed,
            actor,
            first_lane,
            joints,
            mirror: Mirror::new(&model, &layout).ok(),
            body: BodyPlan::from_model(&model),
            reader: Reader::new(&model, &task)?,
            sensors: (task.noise.enabled && task.noise.sensor_models)
                .then(|| Sensors::new(&model, task.control_period_s)),
            physics: PhysicsDraws::new(&model),
            buffers: OutputBuffers::new(lanes),
            targets_rad: vec![0.0; lanes * joints.len()],
            target_rad: PerJoint::default(),
            readings: Readings::default(),
            terms: PerTerm::filled(task.reward.term_names().len(), 0.0),
            wrenches: vec![0.0; lanes * 6],
            ended: Vec::with_capacity(lanes),
            held_commands: Vec::new(),
            joint_strengths: vec![1.0; joints.len()],
            start_shift: StartShift::default(),
            physics_time: Duration::ZERO,
            sees_truth: observer.check_sensed(&layout).is_err(),
            observer,
            recall,
            own_rewards,
            own_ends,
            layout,
            task,
            engine,
        };
        for lane in 0..lanes {
            let started = env.start_episode(lane, 0, env.task.stagger_first_episode)?;
            env.lanes.push(started);
            env.observe_start(lane)?;
        }
        Ok(env)
    }

    /// The mirror of the robot and its observation, where they have one.
    pub fn mirror(&self) -> Option<&Mirror> {
        self.mirror.as_ref()
    }

    /// Number of lanes `N`.
    pub fn lanes(&self) -> usize {
        self.lanes.len()
    }

    /// Length `D` of an observation.
    pub fn obs_dim(&self) -> usize {
        self.layout.dim()
    }

    /// Length of an action.
    pub fn act_dim(&self) -> usize {
        self.joints.len()
    }

    /// What a policy for this environment must be made for.
    pub fn contract(&self) -> &PolicyContract {
        &self.contract
    }

    /// The task.
    pub fn task(&self) -> &TaskConfig {
        &self.task
    }

    /// The engine's state, the truth behind the observations.
    pub fn state(&self) -> &State {
        self.engine.state()
    }

    /// The engine.
    pub fn engine(&self) -> &dyn Engine {
        self.engine.as_ref()
    }

    /// The true state of one lane, in the task's order and frames.
    pub fn truth(&self, lane: usize) -> Truth {
        let mut truth = Truth::default();
        self.reader.read(self.engine.as_ref(), lane, &mut truth);
        truth
    }

    /// Present command of a lane: vx, vy (m/s), yaw rate (rad/s).
    pub fn command(&self, lane: usize) -> [f32; 3] {
        self.lanes[lane].command.value
    }

    /// Present phase of each foot of a lane (of its clock without feet), rad, (−π, π].
    pub fn phases_rad(&self, lane: usize) -> PerFoot {
        self.lanes[lane].phases_rad()
    }

    /// Stride frequency of a lane's gait clock in this episode, Hz.
    pub fn stride_frequency_hz(&self, lane: usize) -> f32 {
        self.lanes[lane].clock.frequency_hz()
    }

    /// Observations as the sensors report them, not normalised. `[N, D]`
    pub fn observations(&self) -> &[f32] {
        &self.observations
    }

    /// What only the value function sees, and how long that is (E).
    pub fn critic(&self) -> &Critic {
        &self.critic
    }

    /// What only the value function sees with [`Self::observations`]. `[N, E]`
    pub fn privileged(&self) -> &[f32] {
        &self.privileged
    }

    /// The stream for exploration noise of a lane's present episode.
    pub fn action_stream(&mut self, lane: usize) -> &mut Stream {
        &mut self.lanes[lane].action_stream
    }

    /// Tells how many environment steps the whole run has done; pushes and costs may grow with it.
    pub fn set_progress(&mut self, env_steps_total: u64) {
        self.progress = env_steps_total;
    }

    /// Starts a new episode in every lane, of staggered lengths where the task says so; does nothing where
    /// all lanes are at a start already.
    ///
    /// # Errors
    /// When the engine refuses.
    pub fn reset_all(&mut self) -> Result<(), EnvError> {
        if self.lanes.iter().all(|lane| lane.step == 0) {
            return Ok(());
        }
        for lane in 0..self.lanes.len() {
            self.next_episode(lane, self.task.stagger_first_episode)?;
        }
        Ok(())
    }

    /// One control step of all lanes. `actions` `[N, A]`; lanes whose episode ends start the next one.
    ///
    /// # Errors
    /// When `actions` has the wrong length or a value that is not finite (nothing has changed then), or the
    /// engine refuses (the environments are then of no use until a snapshot is restored).
    pub fn step(&mut self, actions: &[f32]) -> Result<&StepOutput, EnvError> {
        self.step_seen(actions, |_| ())
    }

    /// As [`Self::step`]; `seen` looks at the environments when the step is done and no lane has begun its
    /// next episode yet: [`Self::truth`] is then what the rewards were computed from.
    ///
    /// # Errors
    /// As [`Self::step`].
    pub fn step_seen(
        &mut self,
        actions: &[f32],
        seen: impl FnOnce(&Self),
    ) -> Result<&StepOutput, EnvError> {
        check_actions(actions, self.lanes.len(), self.act_dim())?;
        self.buffers.clear();
        self.prepare(actions);
        let began = Instant::now();
        self.engine.step(&self.targets_rad, &self.wrenches)?;
        self.physics_time += began.elapsed();
        self.ended.clear();
        let mut truth = Truth::default();
        for lane in 0..self.lanes.len() {
            self.reader.read(self.engine.as_ref(), lane, &mut truth);
            self.settle(lane, &truth)?;
        }
        seen(self);
        for i in 0..self.ended.len() {
            self.next_episode(self.ended[i], false)?;
        }
        Ok(&self.buffers.output)
    }

    /// What the last step gave.
    pub fn output(&self) -> &StepOutput {
        &self.buffers.output
    }

    /// Turns actions into position targets, and draws pushes.
    fn prepare(&mut self, actions: &[f32]) {
        let control_period_s = self.task.control_period_s as f32;
        let strength = self.task.push.strength(self.progress);
        let width = self.joints.len();
        for (i, lane) in self.lanes.iter_mut().enumerate() {
            let row = i * width..(i + 1) * width;
            let action = &actions[row.clone()];
            self.task.action.remember(action, &mut lane.actions);
            let (action, targets_rad) = (&lane.actions[0], &mut self.targets_rad[row]);
            let filter = &mut lane.filter;
            filter.apply(&self.task.action, action, &self.joints, targets_rad);
            let force = lane.push.next_force(
                &self.task.push,
                strength,
                control_period_s,
                &mut lane.push_stream,
            );
            lane.push_n = force;
            self.wrenches[i * 6..][..2].copy_from_slice(&force);
        }
    }

    /// After the engine's step: reward, end of episode, next command, observation of one lane.
    fn settle(&mut self, lane: usize, truth: &Truth) -> Result<(), EnvError> {
        let diverged = self.engine.state().diverged[lane] || !truth.is_finite();
        let now = &mut self.lanes[lane];
        let control_period_s = self.task.control_period_s as f32;
        now.step += 1;
        now.clock.advance(control_period_s);

        let terms = &mut self.terms;
        let (mut reward, mut own_end) = (0.0, false);
        if !diverged {
            let (task, joints, body) = (&self.task, &self.joints, &self.body);
            let target_rad = &mut self.target_rad;
            now.filter.unlimited_rad(&task.action, joints, target_rad);
            let input = reward_input(task, joints, body, target_rad, now, truth);
            let scales = self.task.reward.scales(self.progress);
            let config = &self.task.reward;
            let own = &mut self.own_rewards;
            reward = reward::evaluate(config, own, &input, control_period_s, scales, terms);
            if !self.own_ends.is_empty() {
                let signals = StateSignals::new(&input, config.contact_force_n);
                own_end = self.own_ends.first(&signals).is_some();
            }
            let (command, least_n) = (now.command, config.contact_force_n);
            now.tally.add(reward, terms, truth, &command, least_n);
        }
        self.buffers.output.rewards[lane] = reward;

        let input = TerminationInput {
            diverged,
            gravity: truth.gravity,
            com_height_m: truth.com_height_m,
            com_above_water_m: truth.com_above_water_m,
        };
        let reason = termination::check(&self.task.termination, &input)
            .or(own_end.then_some(TerminationReason::Condition));
        let ended = reason.is_some() || now.step >= now.step_limit;
        if !ended
            && now.command.tick(
                &self.task.command,
                control_period_s,
                truth.heading_rad,
                &mut now.command_stream,
            )
        {
            now.clock.set_command(&self.task.phase, &now.command.value);
        }
        if reason != Some(TerminationReason::Diverged) {
            self.observe(lane, truth, false)?;
        }
        self.lanes[lane].joint_vel_radps = truth.joint_vel_radps;
        if ended {
            let now = &self.lanes[lane];
            let (seen, more) = (self.layout.dim(), self.critic.dim());
            let last = (
                &self.observations[lane * seen..][..seen],
                &self.privileged[lane * more..][..more],
            );
            self.buffers.finish(
                now.stats(lane, truth.foot_height_m.len(), reason),
                &now.tally.terms,
                last,
            );
            self.ended.push(lane);
        }
        Ok(())
    }

    /// Starts the lane's next episode and observes its start.
    fn next_episode(&mut self, lane: usize, stagger: bool) -> Result<(), EnvError> {
        let episode = self.lanes[lane].episode + 1;
        self.lanes[lane] = self.start_episode(lane, episode, stagger)?;
        self.observe_start(lane)
    }

    /// Draws an episode, and puts the engine's lane at its start.
    pub(crate) fn start_episode(
        &mut self,
        lane: usize,
        episode: u64,
        stagger: bool,
    ) -> Result<Lane, EnvError> {
        let key = self.draw_robot(lane, episode)?;
        let mut reset_stream = Stream::new(key, Purpose::Reset);
        let start = caudata_task::reset::draw(
            &self.task.reset,
            &self.joints,
            &self.body.swimming_rad,
            &mut reset_stream,
        );
        let start = self.start_shift.apply(start);
        self.physics.apply_start(&start);
        self.engine.reset(lane, &self.physics.init)?;
        let mut started = Lane::start(
            &self.task,
            self.sensors.as_ref(),
            (self.joints.len(), self.contract.phase.offsets()),
            key,
            stagger,
            start.yaw_rad,
            &mut reset_stream,
        );
        started.joint_vel_radps = start.joint_vel_radps;
        started.friction = self.physics.params.foot_friction;
        started.tally.terms = PerTerm::filled(self.terms.len(), 0.0);
        started.hold(&self.task.phase, self.held_commands.get(lane));
        Ok(started)
    }

    /// Makes the robot of a lane the one of an episode, whose key is returned.
    pub(crate) fn draw_robot(&mut self, lane: usize, episode: u64) -> Result<Key, EnvError> {
        let key =
            Key { seed: self.seed, actor: self.actor, env: self.first_lane + lane as u64, episode };
        let mut physics_stream = Stream::new(key, Purpose::Randomisation);
        let randomisation = &self.task.randomisation;
        self.physics.draw.redraw(randomisation, &mut physics_stream);
        self.physics.apply_draw(&self.joint_strengths);
        self.engine.set_params(lane, &self.physics.params)?;
        Ok(key)
    }
}
