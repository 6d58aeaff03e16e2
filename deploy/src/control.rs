//! The control loop: sense, decide, check, send, fifty times a second.

mod legs;
mod plan;
mod swap;
mod trial;

use std::time::Duration;

use caudata_task::{COMMAND_DIM, PerJoint};
use caudata_telemetry::StopFlag;
use crossbeam_channel::Sender;

use crate::DeployError;
use crate::bus::{BusError, Health, Robot};
use crate::command_link::{CommandLink, LINK_STAND, LINK_STOP};
use crate::flight_log::{FlightLog, LogRow};
use crate::gate::OutputGate;
use crate::guard::{Fault, Guard, Verdict};
use crate::last_moments::LastMoments;
use crate::metrics::RobotMetrics;
use crate::motion::{Motion, Stage};
use crate::notify::{Notifier, Word};
use crate::orientation::GravityFilter;
use crate::pacing::{Clock, Pacer};
use crate::runner::{PolicyRunner, View};
use crate::summary::Ended;
use crate::tap::Tick;
use crate::updates::{PolicyEvent, Updates};

pub use legs::LegOdometry;
pub use plan::{Counts, RunPlan, Sensed};
use plan::{Trial, complete};

/// How long a tick waits for the readings of a simulated robot.
pub const READ_DEADLINE: Duration = Duration::from_millis(7);
/// Ticks in a row without readings after which the robot counts as lost (2 s).
pub const LATE_IN_A_ROW_MAX: u32 = 100;
/// Gravity's z in the IMU frame above which the robot lies on its side or back (tilt beyond 78°).
pub const FALLEN_GRAVITY_Z: f32 = -0.2;
/// How long of that stops a robot whose policy does not get up, and one whose IMU gives no numbers.
pub const FALLEN_FOR: Duration = Duration::from_millis(500);

/// The loop over one robot. It ends with the torque off whatever happens, as far as the bus lets it.
pub struct ControlLoop<'a, R: Robot, C: Clock> {
    robot: &'a mut R,
    clock: &'a C,
    plan: RunPlan,
    runner: PolicyRunner,
    updates: Updates,
    /// Gets every tick.
    pub log: Option<FlightLog>,
    last_moments: LastMoments,
    /// Takes the place of the plan's commands.
    pub link: Option<Box<dyn CommandLink>>,
    /// Gives signs of life to whoever watches this process.
    pub notifier: Notifier,
    /// Raised by a second signal: the servos are let go at once, wherever the robot is.
    pub insisted: StopFlag,
    /// Shows every tick to other programs on this computer.
    pub tap: Option<Sender<Tick>>,
    metrics: RobotMetrics,
    gravity: GravityFilter,
    gate: OutputGate,
    guard: Guard,
    motion: Motion,
    /// Sensed by [`ControlLoop::start`], used by the first tick.
    first: Option<Sensed>,
    last_time_s: f64,
    walk_start_s: Option<f64>,
    trial: Trial,
    /// Velocity by the legs at this tick, m/s, m/s, rad/s; `None`: nothing tells.
    going: Option<[f64; COMMAND_DIM]>,
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
        if joints.len() != first.servos.pos_rad.len() {
            let what = "a policy with other joints than this robot's".to_owned();
            return Err(DeployError::Internal { what });
        }
        metrics.policy_version.set(version_gauge(&runner));
        let last_moments = LastMoments::new(plan.period);
        Ok(Self {
            gate: OutputGate::new(&joints, plan.step_max_rad, first.servos.pos_rad),
            guard: Guard::new(plan.limits.clone()),
            motion: Motion::new(joints.nominal_rad, period_s, plan.balances),
            last_time_s: first.servos.time_s,
            first: Some(first),
            robot,
            clock,
            plan,
            runner,
            updates,
            log: None,
            last_moments,
            link: None,
            notifier: Notifier::default(),
            insisted: StopFlag::new(),
            tap: None,
            metrics,
            gravity,
            walk_start_s: None,
            trial: Trial::default(),
            going: None,
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

    /// The last 30 s, oldest first.
    pub fn last_moments(&self) -> &LastMoments {
        &self.last_moments
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
        self.updates.tell(PolicyEvent::Begun(self.runner.policy().clone()));
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
        self.counts.overruns = pacer.overruns;
        self.counts.held = self.gate.held();
        self.counts.rate_limited = self.gate.rate_limited();
        self.counts.saturated = self.gate.saturated();
        if matches!(
            (&result, self.ended),
            (Ok(()), None | Some(Ended::Time | Ended::Signal | Ended::Interrupted | Ended::Killed))
        ) {
            let policy = self.runner.policy().clone();
            self.updates.tell(PolicyEvent::Ended(policy));
        }
        self.say_how_the_trial_stands();
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
        let Some(sensed) = self.sense()? else { return Ok(()) };
        self.counts.ticks += 1;
        self.metrics.ticks.inc();
        let dt_s = sensed.servos.time_s - self.last_time_s;
        self.last_time_s = sensed.servos.time_s;
        let bias_radps = self.gravity.bias_radps;
        self.going = self.plan.going(&sensed, bias_radps, dt_s);
        self.watch_for_the_end(stop, &sensed);
        self.watch_hardware(&sensed);
        let wanted_command = self.wanted_command(&sensed);
        self.look_for_swap(&sensed, &wanted_command);
        let sent = self.gate.last_rad();
        let wanted = if self.motion.stage().is_policys() {
            self.walk(&sensed, dt_s, wanted_command)
        } else {
            self.wheels_stand(sent);
            Some(sent)
        };
        let targets = match wanted {
            Some(policy) => self.motion.targets(policy, sent, sensed.servos.pos_rad),
            None => sent,
        };
        let targets = self.gate.pass(targets);
        // A robot that is not held yet is not taken hold of in order to let it go: a kill or a stop that came
        // while the loop started leaves it alone.
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
        self.last_moments.push(row);
        if let Some(log) = &mut self.log {
            log.push(row);
        }
        self.show(&row);
        Ok(())
    }

    fn show(&self, row: &LogRow) {
        let Some(tap) = &self.tap else { return };
        let _ = tap.try_send(Tick {
            time_s: row.servos.time_s,
            pos_rad: row.servos.pos_rad,
            vel_radps: row.servos.vel_radps,
            current_a: row.servos.current_a,
            target_rad: row.command_rad,
            gyro_radps: row.imu.gyro_radps,
            acc_mps2: row.imu.acc_mps2,
            gravity: row.gravity,
            going: self.going.map(|going| going.map(|x| x as f32)),
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
            Err(BusError::Timeout { .. }) => {
                Err(BusError::Lost { reason: format!("no readings for {LATE_IN_A_ROW_MAX} ticks") }
                    .into())
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Time over, asked to stop, or fallen.
    fn watch_for_the_end(&mut self, stop: &StopFlag, sensed: &Sensed) {
        let walked_s = self.walk_start_s.map_or(0.0, |start| sensed.servos.time_s - start);
        // Half a period early is nearer than half a period late.
        let margin_s = 0.5 * self.plan.period.as_secs_f64();
        let over = self.plan.walk_s.is_some_and(|wanted| walked_s + margin_s >= wanted);
        if self.motion.stage() == Stage::Walk && self.walk_start_s.is_some() && over {
            self.ended.get_or_insert(Ended::Time);
            self.motion.halt();
        }
        if stop.is_set() {
            self.ended.get_or_insert(Ended::Signal);
            self.motion.halt();
        }
        self.watch_for_a_fall(sensed);
    }

    /// The command of this tick. A link that is silent stops the robot: speed 0 after 200 ms, standing after
    /// 1 s. A dead-man's button that is let go of stands it at once; a kill brakes at once, whatever the
    /// policy does.
    fn wanted_command(&mut self, sensed: &Sensed) -> [f32; COMMAND_DIM] {
        let asked = self.asked_command(sensed);
        let stands = self.motion.balances() && self.stand_ticks.is_some();
        if self.motion.stage() == Stage::Halt || stands { [0.0; COMMAND_DIM] } else { asked }
    }

    fn asked_command(&mut self, sensed: &Sensed) -> [f32; COMMAND_DIM] {
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
        if view.age <= LINK_STOP && !view.released { view.command } else { [0.0; COMMAND_DIM] }
    }

    fn wheels_stand(&mut self, sent_rad: PerJoint) {
        if self.runner.wheels_stand(&sent_rad) {
            self.motion.stand_in(self.runner.joints().nominal_rad);
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
        if damp { self.motion.damp() } else { self.motion.finish() }
    }

    /// What the hardware stopped the run for, and what it said about itself then.
    pub fn fault(&self) -> Option<(Fault, Health)> {
        self.fault
    }

    /// The policy's targets; `None`: hold what was sent last.
    fn walk(&mut self, sensed: &Sensed, dt_s: f64, wanted: [f32; COMMAND_DIM]) -> Option<PerJoint> {
        let start_s = match self.walk_start_s {
            Some(start) => {
                self.runner.advance(self.periods(dt_s));
                start
            }
            None => *self.walk_start_s.insert(sensed.servos.time_s),
        };
        let command = self.runner.trained_command(wanted);
        if self.motion.stage() == Stage::Walk {
            self.counts.walked_s = sensed.servos.time_s - start_s + self.plan.period.as_secs_f64();
            self.counts.walking(sensed, dt_s, &command, self.going);
        }
        let view = View {
            servos: &sensed.servos,
            gyro_radps: sensed.imu.gyro_radps,
            gravity: sensed.gravity,
            command,
            in_water: sensed.in_water,
        };
        let begun = self.clock.now();
        let acted = self.runner.act(&view);
        self.counts.inference_latency.add(self.clock.now().saturating_sub(begun));
        match acted {
            Some(targets) => {
                self.gate.good();
                self.judge_trial(sensed, &targets, &command);
                Some(targets)
            }
            None => {
                self.bad_action();
                None
            }
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

#[cfg(test)]
mod tests;
