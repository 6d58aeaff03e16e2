//! The control loop: sense, decide, check, send, fifty times a second.

use std::time::Duration;

use caudata_hardware::wiring::Limits;
use caudata_task::{ACT_DIM, COMMAND_DIM};
use caudata_telemetry::StopFlag;
use crossbeam_channel::Sender;

use crate::DeployError;
use crate::bus::{BusError, GroundTruth, Health, ImuReading, Robot, ServoReadings};
use crate::command_link::{CommandLink, LINK_STAND, LINK_STOP};
use crate::flight_log::{FlightLog, LogRow};
use crate::gate::{HELD_IN_A_ROW_MAX, Held, OutputGate, PINNED_TICKS_MAX};
use crate::guard::{Fault, Guard, Verdict};
use crate::metrics::RobotMetrics;
use crate::motion::{Motion, Stage};
use crate::notify::{Notifier, Word};
use crate::orientation::GravityFilter;
use crate::pacing::{Clock, Pacer};
use crate::recorder::Recorder;
use crate::report::{Ended, Latencies, Odometer, Velocity, rounded};
use crate::runner::{PolicyRunner, View};
use crate::tap::Tick;
use crate::updates::{PolicyEvent, Updates};
use crate::walk_command::CommandTable;

/// How long a tick waits for the readings of a simulated robot.
pub const READ_DEADLINE: Duration = Duration::from_millis(7);
/// Ticks in a row without readings after which the robot counts as lost (2 s).
pub const LATE_IN_A_ROW_MAX: u32 = 100;
/// Walking ticks after which a policy that never gave a bad action counts as good (10 s).
pub const TRIAL_TICKS: u32 = 500;
/// Gravity's z in the IMU frame above which the robot lies on its side or back (tilt beyond 78°).
pub const FALLEN_GRAVITY_Z: f32 = -0.2;
/// Ticks in a row of that before the robot is stopped (0.5 s).
pub const FALLEN_TICKS: u32 = 25;

/// Mean speed of the joints below which the robot counts as standing still, rad/s. Servos report in steps of 0.024 rad/s.
pub const STILL_RADPS: f32 = 0.1;
/// Ticks in a row of that, with the command at zero, before a newer policy is swapped in (0.2 s).
pub const STILL_TICKS: u32 = 10;
/// A robot that was made to stand for a swap and does not come to rest by then gets it all the same (2 s): its targets stand still.
pub const STAND_TICKS_MAX: u32 = 100;

/// What a run is asked to do.
#[derive(Clone, Debug)]
pub struct RunPlan {
    /// Control period.
    pub period: Duration,
    /// How long a policy is in charge, s of the robot's time; `None`: until asked to stop.
    pub walk_s: Option<f64>,
    /// Where to go.
    pub commands: CommandTable,
    /// How far a target may move per tick, rad.
    pub step_max_rad: f32,
    /// How long a tick waits for readings.
    pub read_deadline: Duration,
    /// Limits of the hardware; `None` on a simulated robot.
    pub limits: Option<Limits>,
    /// How long a newer policy waits for the robot to stand before the robot is made to; `None`: for ever.
    pub swap_wait: Option<Duration>,
}

/// Everything sensed at one tick.
#[derive(Clone, Copy, Debug)]
pub struct Sensed {
    /// Servos.
    pub servos: ServoReadings,
    /// IMU.
    pub imu: ImuReading,
    /// Direction of gravity, IMU frame.
    pub gravity: [f32; 3],
    /// What a simulation knows.
    pub truth: GroundTruth,
    /// What the hardware says about itself.
    pub health: Health,
    /// Whether it is in water.
    pub in_water: Option<bool>,
}

/// What the loop counted.
#[derive(Clone, Debug, Default)]
pub struct Counts {
    /// Ticks.
    pub ticks: u64,
    /// Ticks without readings.
    pub late_readings: u64,
    /// Policies swapped in.
    pub swaps: u64,
    /// Largest mean speed of the joints at which that happened, rad/s.
    pub swap_speed_radps: f32,
    /// Times that the robot was made to stand for a swap.
    pub stands_for_swap: u64,
    /// Periods skipped.
    pub overruns: u64,
    /// Actions held.
    pub held: u64,
    /// Ticks with a slowed target.
    pub rate_limited: u64,
    /// Joint-ticks that a policy wanted at a joint's limit.
    pub saturated: u64,
    /// Time that a policy was in charge, s of the robot's time.
    pub walked_s: f64,
    /// Sum of the commands over walking ticks, and their number.
    command_sum: [f64; COMMAND_DIM],
    walking_ticks: u64,
    /// From waking to sent.
    pub tick_latency: Latencies,
    /// From due to woken.
    pub wake_latency: Latencies,
    /// Observation, inference and action filter.
    pub inference_latency: Latencies,
    /// How far it went.
    pub odometer: Odometer,
}

impl Counts {
    /// Mean of the commands given.
    pub fn mean_command(&self) -> Velocity {
        let mean = |i: usize| rounded(self.command_sum[i] / self.walking_ticks.max(1) as f64);
        Velocity {
            vx_mps: mean(0),
            vy_mps: mean(1),
            yaw_rate_radps: mean(2),
        }
    }
}

/// The loop over one robot. It ends with the torque off whatever happens, as far as the bus lets it.
pub struct ControlLoop<'a, R: Robot, C: Clock> {
    robot: &'a mut R,
    clock: &'a C,
    plan: RunPlan,
    runner: PolicyRunner,
    updates: Updates,
    log: Option<FlightLog>,
    recorder: Recorder,
    link: Option<Box<dyn CommandLink>>,
    notifier: Notifier,
    /// Raised by a second signal.
    insisted: StopFlag,
    tap: Option<Sender<Tick>>,
    metrics: RobotMetrics,
    gravity: GravityFilter,
    gate: OutputGate,
    guard: Guard,
    motion: Motion,
    /// Sensed by [`ControlLoop::start`], used by the first tick.
    first: Option<Sensed>,
    last_time_s: f64,
    walk_start_s: Option<f64>,
    trial_ticks: u32,
    /// When this policy took over, s of the robot's time.
    begun_at_s: f64,
    still_ticks: u32,
    /// Ticks for which a newer policy has waited.
    swap_ticks: u32,
    /// Ticks for which the robot has stood, or gone there, to let it in; `None`: it does not.
    stand_ticks: Option<u32>,
    /// It stood for a swap, and is to walk on as soon as it stands where walking begins.
    walk_on: bool,
    fallen_ticks: u32,
    late_in_a_row: u32,
    ended: Option<Ended>,
    fault: Option<(Fault, Health)>,
    /// Whether a target was ever sent: before that the robot is as it was found, without torque.
    written: bool,
    counts: Counts,
}

impl<'a, R: Robot, C: Clock> ControlLoop<'a, R, C> {
    /// Takes the first readings; nothing moves yet.
    ///
    /// # Errors
    /// [`DeployError::Bus`].
    pub fn start(
        robot: &'a mut R,
        clock: &'a C,
        plan: RunPlan,
        runner: PolicyRunner,
        updates: Updates,
        metrics: RobotMetrics,
    ) -> Result<Self, DeployError> {
        let mut gravity = GravityFilter::new();
        let period_s = plan.period.as_secs_f32();
        let servos = robot.read(FIRST_READ_DEADLINE)?;
        let first = complete(robot, &mut gravity, servos, period_s)?;
        let joints = *runner.joints();
        let nominal_rad = joints.nominal_rad.to_array().ok_or(DeployError::Internal {
            what: "a policy with other joints than this robot's".to_owned(),
        })?;
        metrics.policy_version.set(version_gauge(&runner));
        let recorder = Recorder::new(plan.period);
        Ok(Self {
            gate: OutputGate::new(&joints, plan.step_max_rad, first.servos.pos_rad),
            guard: Guard::new(plan.limits.clone()),
            motion: Motion::new(nominal_rad, period_s),
            last_time_s: first.servos.time_s,
            first: Some(first),
            robot,
            clock,
            plan,
            runner,
            updates,
            log: None,
            recorder,
            link: None,
            notifier: Notifier::default(),
            insisted: StopFlag::new(),
            tap: None,
            metrics,
            gravity,
            walk_start_s: None,
            trial_ticks: 0,
            begun_at_s: 0.0,
            still_ticks: 0,
            swap_ticks: 0,
            stand_ticks: None,
            walk_on: false,
            fallen_ticks: 0,
            late_in_a_row: 0,
            ended: None,
            fault: None,
            written: false,
            counts: Counts::default(),
        })
    }

    /// What was sensed first, until [`ControlLoop::run`] begins.
    pub fn first(&self) -> Option<&Sensed> {
        self.first.as_ref()
    }

    /// Writes every tick to `log`.
    pub fn set_log(&mut self, log: FlightLog) {
        self.log = Some(log);
    }

    /// Takes commands from `link` instead of the plan's.
    pub fn set_link(&mut self, link: Box<dyn CommandLink>) {
        self.link = Some(link);
    }

    /// Shows every tick to other programs on this computer.
    pub fn set_tap(&mut self, tap: Sender<Tick>) {
        self.tap = Some(tap);
    }

    /// Gives signs of life to whoever watches this process.
    pub fn set_notifier(&mut self, notifier: Notifier) {
        self.notifier = notifier;
    }

    /// Lets the servos go at once, wherever the robot is, as soon as `insisted` is raised.
    pub fn set_insisted(&mut self, insisted: StopFlag) {
        self.insisted = insisted;
    }

    /// The last 30 s, oldest first.
    pub fn recorder(&self) -> &Recorder {
        &self.recorder
    }

    /// The policy that runs.
    pub fn runner(&self) -> &PolicyRunner {
        &self.runner
    }

    /// Gives the log and the counts back, after [`ControlLoop::run`].
    pub fn into_parts(self) -> (Option<FlightLog>, Counts) {
        (self.log, self.counts)
    }

    /// Stands up, walks, stands, lets go.
    ///
    /// # Errors
    /// [`DeployError::Bus`] where the robot is lost; the torque was switched off as far as that was possible.
    pub fn run(&mut self, stop: &StopFlag) -> Result<Ended, DeployError> {
        self.updates
            .tell(PolicyEvent::Begun(self.runner.policy().clone()));
        self.notifier.say(Word::Ready);
        let policy = self.runner.policy();
        tracing::info!(stream = policy.stream, version = policy.version, "rising");
        let mut pacer = Pacer::new(self.clock.now(), self.plan.period);
        let result = loop {
            let due = pacer.next(self.clock.now());
            self.metrics.overruns.inc_by(due.skipped);
            self.clock.sleep_until(due.at);
            let woke = self.clock.now();
            if self.insisted.is_set() {
                self.ended = Some(Ended::Interrupted);
                break Ok(());
            }
            match self.tick(stop) {
                Err(error) => break Err(error),
                Ok(()) if self.motion.stage() == Stage::Off => break Ok(()),
                Ok(()) => {}
            }
            self.note_latency(due.at, woke);
            self.notifier.say(Word::Alive);
            if self.motion.stage() == Stage::Damped {
                self.notifier.say(Word::Brakes);
            }
        };
        self.counts.overruns = pacer.overruns();
        self.counts.held = self.gate.held();
        self.counts.rate_limited = self.gate.rate_limited();
        self.counts.saturated = self.gate.saturated();
        if matches!(
            (&result, self.ended),
            (
                Ok(()),
                None | Some(Ended::Time | Ended::Signal | Ended::Interrupted | Ended::Killed)
            )
        ) {
            let policy = self.runner.policy().clone();
            self.updates.tell(PolicyEvent::Ended(policy));
        }
        let limp = match self.robot.torque_off() {
            // What stopped the run has named it: a servo that is gone says nothing, ever.
            Err(BusError::Holds { found }) if self.fault.is_some() && found.hold.is_empty() => {
                tracing::warn!(%found, "the torque is off as far as servos say");
                Ok(())
            }
            other => other,
        };
        self.notifier.say(Word::Brakes);
        // The supervisor must know this before the process ends: what dies after it is not started again.
        if !self.notifier.say_last(Word::Stopping) {
            tracing::warn!("the supervisor does not listen");
        }
        result?;
        limp?;
        Ok(self.ended.unwrap_or(Ended::Signal))
    }

    fn note_latency(&mut self, due: Duration, woke: Duration) {
        let took = self.clock.now().saturating_sub(woke);
        self.counts.tick_latency.add(took);
        self.counts.wake_latency.add(woke.saturating_sub(due));
        self.metrics.tick_seconds.observe(took.as_secs_f64());
    }

    fn tick(&mut self, stop: &StopFlag) -> Result<(), DeployError> {
        let Some(sensed) = self.sense()? else {
            return Ok(());
        };
        self.counts.ticks += 1;
        self.metrics.ticks.inc();
        let dt_s = sensed.servos.time_s - self.last_time_s;
        self.last_time_s = sensed.servos.time_s;
        self.watch_for_the_end(stop, &sensed);
        self.watch_hardware(&sensed);
        let wanted_command = self.wanted_command(&sensed);
        self.look_for_swap(&sensed, &wanted_command);
        let sent = self.gate.last_rad();
        let wanted = if self.motion.stage() == Stage::Walk {
            self.walk(&sensed, dt_s, wanted_command)
        } else {
            Some(sent)
        };
        let targets = match wanted {
            Some(policy) => self.motion.targets(policy, sent, sensed.servos.pos_rad),
            None => sent,
        };
        let targets = self.gate.pass(targets);
        // A robot that is not held yet is not taken hold of in order to let it go: a kill or a stop that came while the loop started leaves it alone.
        if self.ended.is_some() && !self.written {
            return Ok(());
        }
        self.written = true;
        self.robot.write(&targets)?;
        let row = LogRow {
            command_rad: targets,
            torque: true,
            servos: sensed.servos,
            imu: sensed.imu,
            gravity: sensed.gravity,
            truth: sensed.truth,
        };
        self.recorder.push(row);
        if let Some(log) = &mut self.log {
            log.push(row);
        }
        self.show(&row);
        Ok(())
    }

    fn show(&self, row: &LogRow) {
        let Some(tap) = &self.tap else {
            return;
        };
        let _ = tap.try_send(Tick {
            time_s: row.servos.time_s,
            pos_rad: row.servos.pos_rad,
            vel_radps: row.servos.vel_radps,
            current_a: row.servos.current_a,
            target_rad: row.command_rad,
            gyro_radps: row.imu.gyro_radps,
            acc_mps2: row.imu.acc_mps2,
            gravity: row.gravity,
            supply_v: row.servos.supply_v,
            stage: self.motion.stage(),
            fault: self.fault.map(|(fault, _)| fault),
            policy_version: self.runner.policy().version,
            overruns: self.metrics.overruns.get(),
            late_readings: self.counts.late_readings,
            hottest_c: self.robot.health().hottest_c,
        });
    }

    /// Everything sensed; `None` where it did not come in time.
    fn sense(&mut self) -> Result<Option<Sensed>, DeployError> {
        if let Some(first) = self.first.take() {
            return Ok(Some(first));
        }
        match self.robot.read(self.plan.read_deadline) {
            Ok(servos) => {
                self.late_in_a_row = 0;
                let dt_s = (servos.time_s - self.last_time_s) as f32;
                Ok(Some(complete(self.robot, &mut self.gravity, servos, dt_s)?))
            }
            Err(BusError::Timeout { .. }) if self.late_in_a_row < LATE_IN_A_ROW_MAX => {
                self.late_in_a_row += 1;
                self.counts.late_readings += 1;
                self.metrics.late_readings.inc();
                Ok(None)
            }
            Err(BusError::Timeout { .. }) => Err(BusError::Lost {
                reason: format!("no readings for {LATE_IN_A_ROW_MAX} ticks"),
            }
            .into()),
            Err(error) => Err(error.into()),
        }
    }

    /// Time over, asked to stop, or fallen.
    fn watch_for_the_end(&mut self, stop: &StopFlag, sensed: &Sensed) {
        let walked_s = self
            .walk_start_s
            .map_or(0.0, |start| sensed.servos.time_s - start);
        // Half a period early is nearer than half a period late.
        let margin_s = 0.5 * self.plan.period.as_secs_f64();
        let over = self
            .plan
            .walk_s
            .is_some_and(|wanted| walked_s + margin_s >= wanted);
        if self.motion.stage() == Stage::Walk && self.walk_start_s.is_some() && over {
            self.ended.get_or_insert(Ended::Time);
            self.motion.finish();
        }
        if stop.is_set() {
            self.ended.get_or_insert(Ended::Signal);
            self.motion.finish();
        }
        // An IMU that gives no number says nothing about being upright: it counts as lying.
        let finite = |v: &[f32; 3]| v.iter().all(|x| x.is_finite());
        let sane = finite(&sensed.imu.gyro_radps) && finite(&sensed.imu.acc_mps2);
        let lies = sensed.gravity[2] > FALLEN_GRAVITY_Z || !sane || !finite(&sensed.gravity);
        self.fallen_ticks = if lies { self.fallen_ticks + 1 } else { 0 };
        // Whatever it does: one that tips over while it stands must not walk on its back when the link returns.
        let stage = self.motion.stage();
        let braking = matches!(stage, Stage::Damped | Stage::Off);
        if self.fallen_ticks >= FALLEN_TICKS && !braking {
            tracing::error!(gravity = ?sensed.gravity, ?stage, "the robot fell: stopping");
            if stage == Stage::Walk {
                self.blame_a_fall(sensed);
            }
            self.ended = Some(Ended::Fallen);
            self.motion.damp();
        }
    }

    /// The command of this tick. A link that is silent stops the robot: speed 0 after 200 ms, standing after 1 s. A dead-man's button that
    /// is let go of stands it at once; a kill brakes at once, whatever the policy does.
    fn wanted_command(&mut self, sensed: &Sensed) -> [f32; COMMAND_DIM] {
        let Some(link) = &mut self.link else {
            let start_s = self.walk_start_s.unwrap_or(sensed.servos.time_s);
            return self.plan.commands.at(sensed.servos.time_s - start_s);
        };
        let view = link.view();
        if view.killed {
            self.ended.get_or_insert(Ended::Killed);
            self.motion.damp();
        } else if view.age > LINK_STAND || view.released {
            self.motion.stand();
        } else if view.age <= LINK_STOP
            && self.stand_ticks.is_none()
            && self.motion.resume(self.gate.last_rad())
        {
            self.runner.forget();
        }
        match view.age <= LINK_STOP && !view.released {
            true => view.command,
            false => [0.0; COMMAND_DIM],
        }
    }

    /// What the hardware says goes before what the policy wants.
    fn watch_hardware(&mut self, sensed: &Sensed) {
        let (fault, damp) = match self.guard.judge(&sensed.health, &sensed.servos) {
            Verdict::Fine => return,
            Verdict::Stand(fault) => (fault, false),
            Verdict::Damp(fault) => (fault, true),
        };
        if !matches!(self.ended, Some(Ended::Fault(known)) if known == fault) {
            tracing::error!(?fault, health = ?sensed.health, "the hardware is not in order: stopping");
        }
        self.ended.get_or_insert(Ended::Fault(fault));
        self.fault.get_or_insert((fault, sensed.health));
        match damp {
            true => self.motion.damp(),
            false => self.motion.finish(),
        }
    }

    /// What the hardware stopped the run for, and what it said about itself then.
    pub fn fault(&self) -> Option<(Fault, Health)> {
        self.fault
    }

    /// A policy that never went through its trial here and falls is not begun with again. One that did may have met a stone.
    fn blame_a_fall(&mut self, sensed: &Sensed) {
        if self.runner.is_proved() || self.trial_ticks >= TRIAL_TICKS {
            return;
        }
        self.updates.tell(PolicyEvent::Bad {
            policy: self.runner.policy().clone(),
            reason: "fell in its trial".to_owned(),
            walked_s: self.drove_s(sensed),
            fell: true,
        });
    }

    /// How long the present policy has been in charge, s.
    fn drove_s(&self, sensed: &Sensed) -> f64 {
        let from = self.walk_start_s.unwrap_or(sensed.servos.time_s);
        rounded((sensed.servos.time_s - from.max(self.begun_at_s)).max(0.0))
    }

    /// A newer policy gets in only at a safe moment: before walking has begun, or standing. While the robot walks it waits; where that
    /// takes too long, the robot is made to stand.
    fn look_for_swap(&mut self, sensed: &Sensed, wanted: &[f32; COMMAND_DIM]) {
        if self.walk_on && self.motion.resume(self.gate.last_rad()) {
            self.walk_on = false;
        }
        let speed = mean_speed(&sensed.servos);
        let stage = self.motion.stage();
        // Held still by the loop, or commanded to stand and standing.
        let held = matches!(stage, Stage::Settle | Stage::Stand);
        let asked = stage == Stage::Walk && *wanted == [0.0; COMMAND_DIM];
        let still = (held || asked) && speed < STILL_RADPS;
        self.still_ticks = if still { self.still_ticks + 1 } else { 0 };
        if !self.updates.waits() {
            self.swap_ticks = 0;
            if self.stand_ticks.take().is_some() {
                self.walk_on();
            }
            return;
        }
        self.swap_ticks = self.swap_ticks.saturating_add(1);
        self.metrics.armed.set(1);
        let at_rest = self.gate.last_rad() == self.runner.joints().nominal_rad;
        let stood_long = self
            .stand_ticks
            .is_some_and(|ticks| ticks >= STAND_TICKS_MAX);
        let safe = match stage {
            Stage::Rise => true,
            Stage::Settle => true,
            // Slow on its way to the nominal pose is not there.
            Stage::Stand => at_rest && (self.still_ticks >= STILL_TICKS || stood_long),
            Stage::Walk => self.still_ticks >= STILL_TICKS,
            // On its way to the end: the next run begins with it.
            Stage::Return | Stage::Rest | Stage::Damped | Stage::Off => false,
        };
        if safe {
            self.swap_policy(sensed, speed, wanted);
        } else {
            self.hurry(stage);
        }
    }

    /// Makes the robot stand where a newer policy has waited for too long.
    fn hurry(&mut self, stage: Stage) {
        if let Some(ticks) = &mut self.stand_ticks {
            *ticks += u32::from(self.gate.last_rad() == self.runner.joints().nominal_rad);
            return;
        }
        let waited = self.plan.period * self.swap_ticks;
        if stage == Stage::Walk && self.plan.swap_wait.is_some_and(|limit| waited >= limit) {
            let waited_s = waited.as_secs_f32();
            tracing::info!(
                waited_s,
                "a newer policy waits: the robot stands to let it in"
            );
            self.counts.stands_for_swap += 1;
            self.stand_ticks = Some(0);
            self.motion.stand();
        }
    }

    /// Takes over a newer policy, with empty history, blended in from what was sent last.
    fn swap_policy(&mut self, sensed: &Sensed, speed: f32, commanded: &[f32; COMMAND_DIM]) {
        let Some(verified) = self.updates.take() else {
            return;
        };
        match PolicyRunner::new(verified, Some(self.runner.clock())) {
            Ok(runner) => {
                let stage = self.motion.stage();
                let waited_s = self.plan.period.as_secs_f32() * self.swap_ticks as f32;
                let policy = runner.policy();
                tracing::info!(version = policy.version, sha256 = %policy.sha256, ?stage, waited_s, speed_radps = speed, ?commanded, "policy swapped in");
                let old = std::mem::replace(&mut self.runner, runner);
                self.updates.tell(PolicyEvent::Replaced(Box::new(old)));
                self.updates
                    .tell(PolicyEvent::Begun(self.runner.policy().clone()));
                self.metrics.policy_version.set(version_gauge(&self.runner));
                self.metrics.armed.set(0);
                self.counts.swaps += 1;
                // Rising, the robot moves by the loop's own ramp, not by a policy.
                if stage != Stage::Rise {
                    self.counts.swap_speed_radps = self.counts.swap_speed_radps.max(speed);
                }
                self.trial_ticks = 0;
                self.begun_at_s = sensed.servos.time_s;
                self.motion.blend_again(self.gate.last_rad());
            }
            Err(error) => tracing::error!(%error, "policy not swapped in"),
        }
        self.swap_ticks = 0;
        if self.stand_ticks.take().is_some() {
            self.walk_on();
        }
    }

    /// After standing for a swap. With a command link the link decides.
    fn walk_on(&mut self) {
        self.walk_on = self.link.is_none() && !self.motion.resume(self.gate.last_rad());
    }

    /// The policy's targets; `None`: hold what was sent last.
    fn walk(
        &mut self,
        sensed: &Sensed,
        dt_s: f64,
        wanted: [f32; COMMAND_DIM],
    ) -> Option<[f32; ACT_DIM]> {
        let start_s = match self.walk_start_s {
            Some(start) => {
                self.runner.advance(self.periods(dt_s));
                start
            }
            None => *self.walk_start_s.insert(sensed.servos.time_s),
        };
        self.counts.walked_s = sensed.servos.time_s - start_s + self.plan.period.as_secs_f64();
        if let (Some(pos), Some(quat)) = (sensed.truth.base_pos_m, sensed.truth.base_quat_wxyz) {
            self.counts.odometer.add(pos, quat, dt_s);
        }
        let command = self.runner.trained_command(wanted);
        for (sum, value) in self.counts.command_sum.iter_mut().zip(command) {
            *sum += f64::from(value);
        }
        self.counts.walking_ticks += 1;
        let view = View {
            servos: &sensed.servos,
            gyro_radps: sensed.imu.gyro_radps,
            gravity: sensed.gravity,
            command,
            in_water: sensed.in_water,
        };
        let begun = self.clock.now();
        let acted = self.runner.act(&view);
        self.counts
            .inference_latency
            .add(self.clock.now().saturating_sub(begun));
        match acted {
            Some(targets) => {
                self.gate.good();
                self.trial_ticks += 1;
                self.judge_trial(sensed, &targets);
                Some(targets)
            }
            None => {
                self.bad_action(sensed);
                None
            }
        }
    }

    /// A policy that wants many joints at their limits for a second does not pass its trial. One that passed before may be leaning on
    /// something.
    fn judge_trial(&mut self, sensed: &Sensed, targets: &[f32; ACT_DIM]) {
        let ticks = self.gate.watch_limits(targets);
        let fails = !self.runner.is_proved() && ticks >= PINNED_TICKS_MAX;
        let over = self.trial_ticks > TRIAL_TICKS;
        if over || (!fails && self.trial_ticks < TRIAL_TICKS) {
            return;
        }
        let policy = self.runner.policy().clone();
        let walked_s = self.drove_s(sensed);
        if !fails {
            self.updates.tell(PolicyEvent::Good { policy, walked_s });
            return;
        }
        let reason = format!("wanted joints at their limits for {ticks} ticks in a row");
        tracing::error!(%policy, reason, "the policy does not pass its trial: stopping");
        self.updates.tell(PolicyEvent::Bad {
            policy,
            reason,
            walked_s,
            fell: false,
        });
        self.ended.get_or_insert(Ended::Saturated);
        self.motion.finish();
    }

    fn bad_action(&mut self, sensed: &Sensed) {
        self.metrics.held_actions.inc();
        self.trial_ticks = 0;
        if self.gate.hold() == Held::Stop {
            let policy = self.runner.policy().clone();
            tracing::error!(%policy, "actions are not finite: stopping");
            let reason = format!("gave {HELD_IN_A_ROW_MAX} actions in a row that are not finite");
            self.updates.tell(PolicyEvent::Bad {
                policy,
                reason,
                walked_s: self.drove_s(sensed),
                fell: false,
            });
            self.ended = Some(Ended::BadActions);
            self.motion.damp();
        }
    }

    /// Whole periods in `dt_s`, at least one; a long gap does not send the gait clock round and round.
    fn periods(&self, dt_s: f64) -> u32 {
        let periods = (dt_s / self.plan.period.as_secs_f64()).round();
        periods.clamp(1.0, 50.0) as u32
    }
}

/// How long the first readings may take.
const FIRST_READ_DEADLINE: Duration = Duration::from_secs(5);

fn version_gauge(runner: &PolicyRunner) -> i64 {
    i64::try_from(runner.policy().version).unwrap_or(i64::MAX)
}

/// Mean over the joints of their speeds, rad/s. What is not a number is no standing still.
fn mean_speed(servos: &ServoReadings) -> f32 {
    let sum: f32 = servos.vel_radps.iter().map(|v| v.abs()).sum();
    match sum.is_finite() {
        true => sum / ACT_DIM as f32,
        false => f32::INFINITY,
    }
}

/// Adds the IMU and what follows from it to servo readings taken `dt_s` after the last ones.
fn complete<R: Robot>(
    robot: &mut R,
    filter: &mut GravityFilter,
    servos: ServoReadings,
    dt_s: f32,
) -> Result<Sensed, DeployError> {
    let imu = robot.reading()?;
    let estimate = filter.update(imu.gyro_radps, imu.acc_mps2, dt_s);
    Ok(Sensed {
        servos,
        imu,
        gravity: imu.gravity.unwrap_or(estimate),
        truth: robot.ground_truth(),
        health: robot.health(),
        in_water: robot.in_water(),
    })
}

#[cfg(test)]
mod tests;
