//! The loop over a robot made of perfect servos, with a clock of its own.

use std::cell::Cell;

use crossbeam_channel::Receiver;
use sha2::{Digest, Sha256};

use super::*;
use crate::bus::{Imu, ServoBus};
use crate::state::{PolicyRef, Sha256Digest};
use crate::testing::{model, policy_file, standing};
use crate::updates::Slot;
use crate::verify::{Verified, verify};
use crate::walk_command::WalkCommand;

const PERIOD: Duration = Duration::from_millis(20);

/// A clock that sleeping moves on.
#[derive(Default)]
struct FakeClock(Cell<Duration>);

impl Clock for FakeClock {
    fn now(&self) -> Duration {
        self.0.get()
    }

    fn sleep_until(&self, time: Duration) {
        self.0.set(self.0.get().max(time));
    }
}

/// Servos that are where they were sent, and what happens to them.
struct FakeRobot {
    pos_rad: [f32; ACT_DIM],
    sent: Vec<[f32; ACT_DIM]>,
    torque_off: u32,
    /// From this command on velocities are not finite.
    broken_from: usize,
    /// From this command on it lies on its back.
    falls_from: usize,
    /// Reads that time out after each command number given here: (commands sent, reads left).
    silent: (usize, u32),
}

impl FakeRobot {
    fn new() -> Self {
        Self {
            pos_rad: [0.05; ACT_DIM],
            sent: Vec::new(),
            torque_off: 0,
            broken_from: usize::MAX,
            falls_from: usize::MAX,
            silent: (usize::MAX, 0),
        }
    }
}

impl ServoBus for FakeRobot {
    fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError> {
        if self.sent.len() == self.silent.0 && self.silent.1 > 0 {
            self.silent.1 -= 1;
            return Err(BusError::Timeout { deadline });
        }
        let broken = self.sent.len() >= self.broken_from;
        Ok(ServoReadings {
            time_s: 0.02 * self.sent.len() as f64,
            pos_rad: self.pos_rad,
            vel_radps: [if broken { f32::NAN } else { 0.0 }; ACT_DIM],
            current_a: [0.0; ACT_DIM],
            supply_v: 12.0,
        })
    }

    fn write(&mut self, targets_rad: &[f32; ACT_DIM]) -> Result<(), BusError> {
        self.pos_rad = *targets_rad;
        self.sent.push(*targets_rad);
        Ok(())
    }

    fn torque_off(&mut self) -> Result<(), BusError> {
        self.torque_off += 1;
        Ok(())
    }
}

impl Imu for FakeRobot {
    fn reading(&mut self) -> Result<ImuReading, BusError> {
        let fallen = self.sent.len() >= self.falls_from;
        Ok(ImuReading {
            gyro_radps: [0.0; 3],
            acc_mps2: [0.0, 0.0, 9.81],
            gravity: Some([0.0, 0.0, if fallen { 1.0 } else { -1.0 }]),
        })
    }
}

impl Robot for FakeRobot {}

fn verified(version: u64, bytes: Vec<u8>) -> Verified {
    let policy = PolicyRef {
        stream: "s".to_owned(),
        version,
        sha256: Sha256Digest(Sha256::digest(&bytes).into()),
    };
    verify(bytes.into(), &policy, &model()).unwrap()
}

struct Run {
    result: Result<Ended, DeployError>,
    counts: Counts,
    events: Receiver<PolicyEvent>,
}

fn run_with(
    robot: &mut FakeRobot,
    policy: Verified,
    slot: Slot,
    walk_s: f64,
    stop: &StopFlag,
) -> Run {
    let clock = FakeClock::default();
    let plan = RunPlan {
        period: PERIOD,
        walk_s: Some(walk_s),
        commands: CommandTable::constant(WalkCommand([0.9, 0.0, 0.0])),
        step_max_rad: 0.3,
    };
    let (updates, events) = Updates::new(slot);
    let metrics = RobotMetrics::register(&caudata_telemetry::Metrics::new());
    let runner = PolicyRunner::new(policy, None).unwrap();
    let mut control = ControlLoop::start(robot, &clock, plan, runner, updates, metrics).unwrap();
    let result = control.run(stop);
    let (_, counts) = control.into_parts();
    Run {
        result,
        counts,
        events,
    }
}

fn run(robot: &mut FakeRobot, walk_s: f64) -> Run {
    let policy = verified(1, policy_file(1, |_, _| {}));
    run_with(robot, policy, Slot::default(), walk_s, &StopFlag::new())
}

#[test]
fn stands_up_walks_stands_and_lets_go() {
    let mut robot = FakeRobot::new();
    let run = run(&mut robot, 1.0);
    assert_eq!(run.result.unwrap(), Ended::Time);
    assert_eq!(robot.torque_off, 1);
    assert!(
        (run.counts.walked_s - 1.0).abs() < 1e-6,
        "{}",
        run.counts.walked_s
    );
    let nominal: Vec<f32> = model()
        .nominal_pos_rad()
        .iter()
        .map(|q| *q as f32)
        .collect();
    assert_eq!(robot.sent.last().unwrap().as_slice(), nominal);
    // Nowhere a jump: ramps move 0.01 rad per tick, and the gate allows 0.3.
    let steps = robot.sent.windows(2).map(|w| (w[1][9] - w[0][9]).abs());
    assert!(steps.fold(0.0, f32::max) < 0.1);
    // Command 0.9 m/s is beyond the training range, which ends at 0.5.
    assert!((run.counts.mean_command().vx_mps - 0.5).abs() < 1e-6);
    assert_eq!(
        (
            run.counts.overruns,
            run.counts.late_readings,
            run.counts.held
        ),
        (0, 0, 0)
    );
}

#[test]
fn three_bad_actions_stop_the_robot_and_the_policy_for_good() {
    let mut robot = FakeRobot::new();
    robot.broken_from = 150;
    let run = run(&mut robot, 100.0);
    assert_eq!(run.result.unwrap(), Ended::BadActions);
    assert_eq!((run.counts.held, robot.torque_off), (3, 1));
    assert!(robot.sent.iter().flatten().all(|q| q.is_finite()));
    // The first two bad actions hold the target sent before them.
    assert_eq!(robot.sent[150], robot.sent[149]);
    assert_eq!(robot.sent[151], robot.sent[149]);
    let event = run.events.try_recv().unwrap();
    assert!(matches!(event, PolicyEvent::Bad { policy, .. } if policy.version == 1));
}

#[test]
fn late_readings_hold_the_target_and_silence_ends_the_run_limp() {
    let mut robot = FakeRobot::new();
    robot.silent = (120, 7);
    let late = run(&mut robot, 1.0);
    assert_eq!(late.result.unwrap(), Ended::Time);
    assert_eq!(late.counts.late_readings, 7);

    let mut robot = FakeRobot::new();
    robot.silent = (120, u32::MAX);
    let lost = run(&mut robot, 1.0);
    let error = lost.result.unwrap_err();
    assert!(
        matches!(error, DeployError::Bus(BusError::Lost { .. })),
        "{error}"
    );
    assert_eq!((robot.sent.len(), robot.torque_off), (120, 1));
}

#[test]
fn a_robot_on_its_back_is_stopped() {
    let mut robot = FakeRobot::new();
    robot.falls_from = 150;
    let run = run(&mut robot, 100.0);
    assert_eq!(run.result.unwrap(), Ended::Fallen);
    // 25 ticks until it is believed, 50 of braking.
    assert!(
        (220..=230).contains(&robot.sent.len()),
        "{}",
        robot.sent.len()
    );
}

#[test]
fn asked_to_stop_it_never_walks() {
    let stop = StopFlag::new();
    stop.request("test");
    let mut robot = FakeRobot::new();
    let policy = verified(1, policy_file(1, |_, _| {}));
    let run = run_with(&mut robot, policy, Slot::default(), 9.0, &stop);
    assert_eq!(run.result.unwrap(), Ended::Signal);
    assert_eq!((run.counts.walked_s, robot.torque_off), (0.0, 1));
}

#[test]
fn a_newer_policy_is_swapped_in_and_blended() {
    let slot = Slot::default();
    slot.put(verified(2, standing(2)));
    let mut robot = FakeRobot::new();
    let policy = verified(1, policy_file(1, |_, _| {}));
    let run = run_with(&mut robot, policy, slot, 1.0, &StopFlag::new());
    assert_eq!((run.result.unwrap(), run.counts.swaps), (Ended::Time, 1));
    let event = run.events.try_recv().unwrap();
    assert!(matches!(event, PolicyEvent::Replaced(old) if old.policy().version == 1));
    // The new one stands: once walking, nothing leaves the nominal pose.
    assert_eq!(robot.sent[120], *robot.sent.last().unwrap());
}

#[test]
fn ten_good_seconds_make_a_good_policy() {
    let mut robot = FakeRobot::new();
    let short = run(&mut robot, 9.9);
    assert!(short.events.try_recv().is_err());
    let mut robot = FakeRobot::new();
    let long = run(&mut robot, 10.0);
    assert!(matches!(
        long.events.try_recv().unwrap(),
        PolicyEvent::Good(_)
    ));
}
