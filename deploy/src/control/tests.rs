//! The loop over a robot made of perfect servos, with a clock of its own.

use std::cell::Cell;
use std::ops::Range;

use crossbeam_channel::Receiver;
use sha2::{Digest, Sha256};

use super::plan::STILL_RADPS;
use super::*;
use crate::bus::{Imu, ImuReading, ServoBus, ServoReadings};
use crate::command_link::LinkView;
use crate::state::{PolicyRef, Sha256Digest};
use crate::testing::{model, policy_file, standing, stepping, swinging};
use crate::updates::Slot;
use crate::verify::{Verified, verify};
use crate::walk_command::{CommandTable, WalkCommand};

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

/// What an IMU does not tell any more.
#[derive(Clone, Copy, PartialEq)]
enum Blind {
    Rates,
    Accelerations,
}

/// Servos that are where they were sent, and what happens to them.
struct FakeRobot {
    pos_rad: PerJoint,
    vel_radps: PerJoint,
    sent: Vec<PerJoint>,
    torque_off: u32,
    /// From this command on velocities are not finite.
    broken_from: usize,
    /// Between these commands it lies on its back.
    lies: Range<usize>,
    /// From this command on the hardware says this about itself.
    ill: (usize, Health),
    /// From this command on the IMU gives no number for this.
    blind_from: (usize, Blind),
    /// Reads that time out after each command number given here: (commands sent, reads left).
    silent: (usize, u32),
}

impl FakeRobot {
    fn new() -> Self {
        Self {
            pos_rad: PerJoint::filled(16, 0.05),
            vel_radps: PerJoint::filled(16, 0.0),
            sent: Vec::new(),
            torque_off: 0,
            broken_from: usize::MAX,
            lies: 0..0,
            ill: (usize::MAX, Health::default()),
            blind_from: (usize::MAX, Blind::Rates),
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
            vel_radps: match broken {
                true => PerJoint::filled(16, f32::NAN),
                false => self.vel_radps,
            },
            current_a: PerJoint::filled(16, 0.0),
            supply_v: 12.0,
        })
    }

    fn write(&mut self, targets_rad: &PerJoint) -> Result<(), BusError> {
        self.vel_radps = PerJoint::from_fn(16, |i| (targets_rad[i] - self.pos_rad[i]) / 0.02);
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
        let fallen = self.lies.contains(&self.sent.len());
        let (from, what) = self.blind_from;
        let number = |of: Blind, value: f32| match self.sent.len() >= from && what == of {
            true => f32::NAN,
            false => value,
        };
        Ok(ImuReading {
            gyro_radps: [number(Blind::Rates, 0.0); 3],
            acc_mps2: [0.0, 0.0, number(Blind::Accelerations, 9.81)],
            gravity: Some([0.0, 0.0, if fallen { 1.0 } else { -1.0 }]),
        })
    }
}

impl Robot for FakeRobot {
    fn health(&self) -> Health {
        match self.sent.len() >= self.ill.0 {
            true => self.ill.1,
            false => Health::default(),
        }
    }
}

fn verified(version: u64, bytes: Vec<u8>) -> Verified {
    let policy = PolicyRef {
        stream: "s".to_owned(),
        version,
        sha256: Sha256Digest(Sha256::digest(&bytes).into()),
        reverts_to: None,
    };
    verify(bytes.into(), &policy, &model()).unwrap()
}

struct Run {
    result: Result<Ended, DeployError>,
    counts: Counts,
    events: Receiver<PolicyEvent>,
}

impl Run {
    /// What the loop told, oldest first.
    fn told(&self) -> Vec<PolicyEvent> {
        self.events.try_iter().collect()
    }
}

fn run_with(
    robot: &mut FakeRobot,
    policy: Verified,
    slot: Slot,
    walk_s: f64,
    stop: &StopFlag,
) -> Run {
    run_plan(plan(Some(walk_s), forward(0.9)), robot, policy, slot, stop)
}

/// A run at 50 Hz under `commands`, for `walk_s` seconds of walking.
fn plan(walk_s: Option<f64>, commands: CommandTable) -> RunPlan {
    RunPlan {
        period: PERIOD,
        walk_s,
        commands,
        step_max_rad: 0.3,
        read_deadline: READ_DEADLINE,
        limits: None,
        swap_wait: None,
        get_up: FALLEN_FOR,
        balances: false,
        legs: None,
    }
}

/// At that speed, m/s.
fn forward(vx_mps: f32) -> CommandTable {
    CommandTable::constant(WalkCommand([vx_mps, 0.0, 0.0]))
}

fn run_plan(
    plan: RunPlan,
    robot: &mut FakeRobot,
    policy: Verified,
    slot: Slot,
    stop: &StopFlag,
) -> Run {
    let clock = FakeClock::default();
    let (updates, events) = Updates::new(slot);
    let metrics = RobotMetrics::register(&caudata_telemetry::Metrics::new());
    let runner = PolicyRunner::new(policy, None).unwrap();
    let mut control = ControlLoop::start(robot, &clock, plan, runner, updates, metrics).unwrap();
    let result = control.run(stop);
    let (_, counts) = control.into_parts();
    Run { result, counts, events }
}

fn run(robot: &mut FakeRobot, walk_s: f64) -> Run {
    let policy = verified(1, swinging(1));
    run_with(robot, policy, Slot::default(), walk_s, &StopFlag::new())
}

#[test]
fn stands_up_walks_stands_and_lets_go() {
    let mut robot = FakeRobot::new();
    let run = run(&mut robot, 1.0);
    assert_eq!(run.result.unwrap(), Ended::Time);
    assert_eq!(robot.torque_off, 1);
    assert!((run.counts.walked_s - 1.0).abs() < 1e-6, "{}", run.counts.walked_s);
    let nominal: Vec<f32> = model().nominal_pos_rad().iter().map(|q| *q as f32).collect();
    assert_eq!(robot.sent.last().unwrap()[..], nominal);
    // Nowhere a jump: ramps move 0.01 rad per tick, and the gate allows 0.3.
    let steps = robot.sent.windows(2).map(|w| (w[1][9] - w[0][9]).abs());
    assert!(steps.fold(0.0, f32::max) < 0.1);
    // Command 0.9 m/s is beyond the training range, which ends at 0.5.
    assert!((run.counts.mean_command().vx_mps - 0.5).abs() < 1e-6);
    assert_eq!((run.counts.overruns, run.counts.late_readings, run.counts.held), (0, 0, 0));
}

#[test]
fn three_bad_actions_stop_the_robot_and_the_policy_for_good() {
    let mut robot = FakeRobot::new();
    robot.broken_from = 150;
    let run = run(&mut robot, 100.0);
    assert_eq!(run.result.as_ref().unwrap(), &Ended::BadActions);
    assert_eq!((run.counts.held, robot.torque_off), (3, 1));
    assert!(robot.sent.iter().flatten().all(|q| q.is_finite()));
    // The first two bad actions hold the target sent before them.
    assert_eq!(robot.sent[150], robot.sent[149]);
    assert_eq!(robot.sent[151], robot.sent[149]);
    let event = run.told().pop().unwrap();
    assert!(matches!(event, PolicyEvent::Bad { policy, fell: false, .. } if policy.version == 1));
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
    assert!(matches!(error, DeployError::Bus(BusError::Lost { .. })), "{error}");
    assert_eq!((robot.sent.len(), robot.torque_off), (120, 1));
}

#[test]
fn a_robot_on_its_back_is_stopped() {
    let mut robot = FakeRobot::new();
    robot.lies = 150..usize::MAX;
    let run = run(&mut robot, 100.0);
    assert_eq!(run.result.unwrap(), Ended::Fallen);
    // 25 ticks until it is believed, 50 of braking.
    assert!((220..=230).contains(&robot.sent.len()), "{}", robot.sent.len());
}

#[test]
fn one_that_may_get_up_is_given_time_to() {
    let run = |lies: Range<usize>, get_up: Duration| {
        let mut robot = FakeRobot::new();
        robot.lies = lies;
        let plan = RunPlan { get_up, ..plan(Some(10.0), forward(0.3)) };
        let policy = verified(1, stepping(1));
        let run = run_plan(plan, &mut robot, policy, Slot::default(), &StopFlag::new());
        (run.result.unwrap(), robot.sent.len())
    };
    let five_seconds = Duration::from_secs(5);
    // It lies for 4 s under its policy; it lies from the start, while it rises and 2 s longer: it is up again.
    assert_eq!(run(150..350, five_seconds).0, Ended::Time);
    assert_eq!(run(0..150, five_seconds).0, Ended::Time);
    // Only the policy gets it up: 250 ticks, and 50 of braking.
    let (ended, sent) = run(150..usize::MAX, five_seconds);
    assert_eq!(ended, Ended::Fallen);
    assert!((445..=455).contains(&sent), "{sent}");
    // Without that a lying robot is not even made to rise.
    assert_eq!(run(0..150, FALLEN_FOR).0, Ended::Fallen);
}

#[test]
fn one_that_falls_before_it_walks_never_walks() {
    // Lying from the start, fallen while it rises, fallen while it stands before its first step.
    for falls_from in [0, 40, 80] {
        let mut robot = FakeRobot::new();
        robot.lies = falls_from..usize::MAX;
        let run = run(&mut robot, 100.0);
        assert_eq!(run.result.unwrap(), Ended::Fallen, "{falls_from}");
        assert_eq!((run.counts.walked_s, robot.torque_off), (0.0, 1));
        // 25 ticks until it is believed, 50 of braking.
        let ticks = robot.sent.len() - falls_from;
        assert!((70..=80).contains(&ticks), "{falls_from}: {ticks}");
    }
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
    assert_eq!(run.result.as_ref().unwrap(), &Ended::Time);
    assert_eq!(run.counts.swaps, 1);
    let told = run.told();
    assert!(matches!(&told[0], PolicyEvent::Begun(policy) if policy.version == 1));
    assert!(matches!(&told[1], PolicyEvent::Replaced(old) if old.policy().version == 1));
    assert!(matches!(&told[2], PolicyEvent::Begun(policy) if policy.version == 2));
    // The new one stands: once walking, nothing leaves the nominal pose.
    assert_eq!(robot.sent[120], *robot.sent.last().unwrap());
}

#[test]
fn ten_good_seconds_make_a_good_policy() {
    let mut robot = FakeRobot::new();
    let short = run(&mut robot, 9.9);
    let good = |event: &PolicyEvent| matches!(event, PolicyEvent::Good { .. });
    let told = short.told();
    assert!(!told.iter().any(good));
    // It ended in order, so that it is not held against the policy.
    assert!(matches!(told.last(), Some(PolicyEvent::Ended(_))));
    let mut robot = FakeRobot::new();
    // a tick or two go by until the mean command is one to walk
    let long = run(&mut robot, 10.1);
    let told = long.told();
    let walked = told.iter().find_map(|event| match event {
        PolicyEvent::Good { walked_s, .. } => Some(*walked_s),
        _ => None,
    });
    assert_eq!(walked, Some(10.0));
}

#[test]
fn fault_32_standing_still_passes_no_trial() {
    let good_by = |legs: Option<LegOdometry>, vx_mps: f32, policy: Vec<u8>| {
        let mut robot = FakeRobot::new();
        let (policy, stop) = (verified(1, policy), StopFlag::new());
        let plan = RunPlan { legs, ..plan(Some(30.0), forward(vx_mps)) };
        let run = run_plan(plan, &mut robot, policy, Slot::default(), &stop);
        assert_eq!(run.result.as_ref().unwrap(), &Ended::Time);
        let good = |event: &PolicyEvent| matches!(event, PolicyEvent::Good { .. });
        run.told().iter().any(good)
    };
    let good = |vx_mps: f32, policy: Vec<u8>| good_by(None, vx_mps, policy);
    assert!(good(0.3, stepping(1)));
    assert!(!good(0.0, stepping(1)), "it was told to stand");
    assert!(!good(1e-6, stepping(1)), "that is no command to walk");
    assert!(!good(0.3, standing(1)), "it was told to move and did not");
    // All joints swing as one: each foot comes back to where it was.
    let legs = LegOdometry::new(model());
    assert!(legs.is_some());
    assert!(good_by(legs.clone(), 0.3, stepping(1)));
    assert!(!good_by(legs.clone(), 0.3, standing(1)));
    assert!(!good_by(legs, 0.3, swinging(1)), "it goes nowhere");
}

#[test]
fn fault_37_a_policy_that_pins_joints_at_their_limits_does_not_pass_its_trial() {
    // Every joint is wanted 2.5 rad from its nominal angle, which is beyond every limit; the filter takes
    // three ticks to get there.
    let pinned = || {
        let bytes = policy_file(1, |spec, _| {
            spec.layers[0].weight.fill(0.0);
            spec.layers[0].bias.fill(5.0);
        });
        verified(1, bytes)
    };
    let mut robot = FakeRobot::new();
    let run = run_with(&mut robot, pinned(), Slot::default(), 100.0, &StopFlag::new());
    assert_eq!(run.result.as_ref().unwrap(), &Ended::Saturated);
    // The filter takes a few ticks to bring all joints to their limits; fifty with a quarter of them there
    // are a second.
    let ticks = run.counts.walking_ticks;
    assert!((50..=60).contains(&ticks), "{ticks}");
    assert!(run.counts.saturated > 16 * 45, "{}", run.counts.saturated);
    assert_eq!(robot.torque_off, 1);
    let told = run.told();
    let bad = |e: &PolicyEvent| matches!(e, PolicyEvent::Bad { reason, fell: false, .. } if reason.contains("limits"));
    assert!(told.iter().any(bad), "{told:?}");
    // One that passed its trial before may be leaning on something.
    let proved = Verified { proved: true, ..pinned() };
    let mut robot = FakeRobot::new();
    let run = run_with(&mut robot, proved, Slot::default(), 11.0, &StopFlag::new());
    assert_eq!(run.result.as_ref().unwrap(), &Ended::Time);
}

/// A run of the policy that stands, with `change` made to the robot: why it ended, the number of targets
/// sent, and its counts.
fn stopped(change: impl FnOnce(&mut FakeRobot)) -> (Ended, usize, u32) {
    let mut robot = FakeRobot::new();
    change(&mut robot);
    let policy = verified(1, standing(1));
    let run = run_with(&mut robot, policy, Slot::default(), 100.0, &StopFlag::new());
    (run.result.unwrap(), robot.sent.len(), robot.torque_off)
}

#[test]
fn fault_39_41_42_43_hardware_faults_stand_or_brake_and_let_go() {
    let ill = |health| stopped(|robot| robot.ill = (150, health));
    let silent = |ticks| Health { silent_ticks: ticks, ..Health::default() };
    // Stand: already there, half a second of rest (25 ticks), torque off.
    let (why, sent, off) = ill(silent(3));
    assert_eq!((why, off), (Ended::Fault(Fault::ServoSilent), 1));
    assert!((175..=180).contains(&sent), "{sent}");
    // Damped: a second of braking (50 ticks), torque off.
    let (why, sent, off) = ill(silent(10));
    assert_eq!((why, off), (Ended::Fault(Fault::ServoSilent), 1));
    assert!((200..=202).contains(&sent), "{sent}");
    let alert = Health { alert: Some((9, 0x20)), ..Health::default() };
    assert_eq!(ill(alert).0, Ended::Fault(Fault::ServoAlert));
    let restarted = Health { restarted: Some(9), ..Health::default() };
    assert_eq!(ill(restarted).0, Ended::Fault(Fault::ServoRestarted));
    let fired = Health { watchdog_fired: Some(9), ..Health::default() };
    assert_eq!(ill(fired).0, Ended::Fault(Fault::WatchdogFired));
    // One or two ticks of silence are nothing: it walks until the time is over.
    let mut robot = FakeRobot::new();
    robot.ill = (150, silent(2));
    let policy = verified(1, standing(1));
    let run = run_with(&mut robot, policy, Slot::default(), 2.0, &StopFlag::new());
    assert_eq!(run.result.unwrap(), Ended::Time);
}

#[test]
fn fault_45_an_imu_without_numbers_counts_as_fallen() {
    // Accelerations that are no numbers: the policy does not see them, and its actions are good. Only that
    // nobody knows which way is up speaks against going on: 25 ticks until that is believed, 50 of braking.
    let (why, sent, off) = stopped(|robot| robot.blind_from = (150, Blind::Accelerations));
    assert_eq!((why, off), (Ended::Fallen, 1));
    assert!((220..=230).contains(&sent), "{sent}");
    // Rates that are no numbers: the policy sees them, and its actions are none. Three of these stop it
    // first, 50 ticks of braking.
    let (why, sent, off) = stopped(|robot| robot.blind_from = (150, Blind::Rates));
    assert_eq!((why, off), (Ended::BadActions, 1));
    assert!((200..=205).contains(&sent), "{sent}");
}

/// A link whose newest command came at `heard`, by the number of views so far; a kill from view `kill_from`
/// on.
struct FakeLink {
    views: u32,
    heard: fn(u32) -> Option<u32>,
    kill_from: u32,
    /// Views in which the dead-man's button is let go of.
    released: std::ops::Range<u32>,
}

impl Default for FakeLink {
    /// Heard at every view.
    fn default() -> Self {
        Self { views: 0, heard: Some, kill_from: u32::MAX, released: 0..0 }
    }
}

impl CommandLink for FakeLink {
    fn view(&mut self) -> LinkView {
        self.views += 1;
        let age = (self.heard)(self.views).map(|at| PERIOD * (self.views - at));
        LinkView {
            command: [0.2, 0.0, 0.0],
            age: age.unwrap_or(Duration::MAX),
            killed: self.views >= self.kill_from,
            released: self.released.contains(&self.views),
        }
    }
}

fn linked(link: FakeLink, walk_s: f64) -> (Result<Ended, DeployError>, Vec<PerJoint>, f64) {
    let mut robot = FakeRobot::new();
    let clock = FakeClock::default();
    let plan = plan(Some(walk_s), forward(0.9));
    let (updates, _events) = Updates::new(Slot::default());
    let metrics = RobotMetrics::register(&caudata_telemetry::Metrics::new());
    // Walks with every joint at the same offset from the nominal pose, whatever it sees.
    let bytes = policy_file(1, |spec, _| spec.layers[0].weight.fill(0.0));
    let runner = PolicyRunner::new(verified(1, bytes), None).unwrap();
    let mut control =
        ControlLoop::start(&mut robot, &clock, plan, runner, updates, metrics).unwrap();
    control.link = Some(Box::new(link));
    let result = control.run(&StopFlag::new());
    let vx = control.into_parts().1.mean_command().vx_mps;
    (result, robot.sent, vx)
}

#[test]
fn fault_47_a_silent_link_stops_then_stands_and_walks_on_when_it_is_back() {
    // Heard at every tick until 200, then nothing until 400, then again.
    let link = FakeLink {
        heard: |view| Some(if (200..400).contains(&view) { 200 } else { view }),
        ..FakeLink::default()
    };
    let (result, sent, vx) = linked(link, 10.0);
    assert_eq!(result.unwrap(), Ended::Time);
    let model = model();
    let nominal: Vec<f32> = model.nominal_pos_rad().iter().map(|q| *q as f32).collect();
    let stands = |tick: usize| sent[tick][..] == nominal;
    assert!(!stands(190) && !stands(240), "walks, then with speed 0");
    // 1 s (50 ticks) after the last command it goes back at 0.01 rad per tick and stands.
    assert!(stands(390), "stands");
    assert!(!stands(430), "walks on");
    // The mean is below the 0.2 m/s commanded, and not 0.
    assert!(vx > 0.1 && vx < 0.2, "{vx}");
}

#[test]
fn a_link_that_never_spoke_keeps_the_robot_standing() {
    let link = FakeLink { heard: |_| None, kill_from: 300, ..FakeLink::default() };
    let (result, sent, _) = linked(link, 100.0);
    assert_eq!(result.unwrap(), Ended::Killed);
    let model = model();
    let nominal: Vec<f32> = model.nominal_pos_rad().iter().map(|q| *q as f32).collect();
    assert!(sent[150..290].iter().all(|s| {
        let far = s.iter().zip(&nominal).map(|(a, b)| (a - b).abs());
        far.fold(0.0, f32::max) < 0.02
    }));
}

#[test]
fn fault_47_a_dead_mans_button_that_is_let_go_of_stands_the_robot_at_once() {
    let link = FakeLink { released: 200..400, ..FakeLink::default() };
    let (result, sent, _) = linked(link, 10.0);
    assert_eq!(result.unwrap(), Ended::Time);
    let model = model();
    let nominal: Vec<f32> = model.nominal_pos_rad().iter().map(|q| *q as f32).collect();
    let far = |tick: usize| {
        let far = sent[tick].iter().zip(&nominal).map(|(a, b)| (a - b).abs());
        far.fold(0.0, f32::max)
    };
    // From the very next target on the robot goes back, at 0.01 rad per tick; silence alone would take a
    // second (50 ticks).
    assert!(far(198) > 0.02, "walks: {}", far(198));
    for tick in 200..240 {
        let moved = far(tick) - far(tick - 1);
        let on_its_way = (moved + 0.01).abs() < 1e-5 || far(tick) < 1e-5;
        assert!(on_its_way, "tick {tick}: {} after {}", far(tick), far(tick - 1));
    }
    // It stays there although commands go on, and walks on when the button is held again.
    assert!((300..395).all(|tick| far(tick) < 1e-5));
    assert!(far(430) > 0.02, "{}", far(430));
}

#[test]
fn a_second_signal_lets_go_within_a_tick_wherever_the_robot_is() {
    /// Raises the flags as the robot gets its targets.
    struct Impatient {
        inner: FakeRobot,
        stop: StopFlag,
        insisted: StopFlag,
        /// Targets after which each is raised.
        at: [usize; 2],
    }
    impl ServoBus for Impatient {
        fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError> {
            self.inner.read(deadline)
        }
        fn write(&mut self, targets: &PerJoint) -> Result<(), BusError> {
            self.inner.write(targets)?;
            for (at, flag) in self.at.iter().zip([&self.stop, &self.insisted]) {
                if self.inner.sent.len() == *at {
                    flag.request("test");
                }
            }
            Ok(())
        }
        fn torque_off(&mut self) -> Result<(), BusError> {
            self.inner.torque_off()
        }
    }
    impl Imu for Impatient {
        fn reading(&mut self) -> Result<ImuReading, BusError> {
            self.inner.reading()
        }
    }
    impl Robot for Impatient {}
    // While it rises, walks, and is on its way back after the first signal (which takes more than ten ticks).
    for at in [[5, 6], [150, 151], [150, 160]] {
        let mut robot = Impatient {
            inner: FakeRobot::new(),
            stop: StopFlag::new(),
            insisted: StopFlag::new(),
            at,
        };
        let (stop, insisted) = (robot.stop.clone(), robot.insisted.clone());
        let clock = FakeClock::default();
        let plan = plan(None, forward(0.3));
        let (updates, _events) = Updates::new(Slot::default());
        let metrics = RobotMetrics::register(&caudata_telemetry::Metrics::new());
        let policy = verified(1, policy_file(1, |_, _| {}));
        let runner = PolicyRunner::new(policy, None).unwrap();
        let mut control =
            ControlLoop::start(&mut robot, &clock, plan, runner, updates, metrics).unwrap();
        control.insisted = insisted;
        assert_eq!(control.run(&stop).unwrap(), Ended::Interrupted);
        assert_eq!((robot.inner.sent.len(), robot.inner.torque_off), (at[1], 1));
    }
}

#[test]
fn a_kill_before_the_first_tick_takes_hold_of_nothing() {
    let link = FakeLink { kill_from: 0, ..FakeLink::default() };
    let (result, sent, _) = linked(link, 100.0);
    assert_eq!(result.unwrap(), Ended::Killed);
    // The first target switches the torque on: none may be sent.
    assert_eq!(sent.len(), 0);
}

#[test]
fn a_kill_brakes_at_the_next_tick() {
    // While it walks, and while it halts at the end of its time.
    for (walk_s, ended) in [(100.0, Ended::Killed), (1.5, Ended::Time)] {
        let link = FakeLink { kill_from: 200, ..FakeLink::default() };
        let (result, sent, _) = linked(link, walk_s);
        assert_eq!(result.unwrap(), ended);
        // Damped for 50 ticks from view 200 on, then off.
        assert!((249..=252).contains(&sent.len()), "{}", sent.len());
    }
}

#[test]
fn fault_32_a_fall_in_the_trial_is_the_policys_fault_and_one_after_it_is_not() {
    let fall = |falls_from: usize, proved: bool| {
        let mut robot = FakeRobot::new();
        robot.lies = falls_from..usize::MAX;
        let mut policy = verified(1, stepping(1));
        policy.proved = proved;
        let run = run_with(&mut robot, policy, Slot::default(), 100.0, &StopFlag::new());
        assert_eq!(run.result.as_ref().unwrap(), &Ended::Fallen);
        let fell = |event: &PolicyEvent| matches!(event, PolicyEvent::Bad { fell: true, .. });
        run.told().iter().any(fell)
    };
    assert!(fall(150, false), "in its trial");
    assert!(!fall(150, true), "it went through its trial in another run");
    // Walking begins after about 30 ticks; 500 more make it good.
    assert!(!fall(900, false), "after its trial");
}

/// A run under `commands` whose slot gets a standing policy after `after` targets; the number of targets sent
/// when the new one took over, and the counts.
fn swapped(
    commands: &str,
    after: usize,
    swap_wait: Option<Duration>,
    balances: bool,
) -> (Option<usize>, Counts) {
    /// Puts the policy there when the robot has been sent enough.
    struct Late {
        inner: FakeRobot,
        slot: Slot,
        late: Option<(usize, Verified)>,
        /// When the first target of the new policy went out: all of the nominal pose for a standing one.
        seen: Option<usize>,
    }
    impl ServoBus for Late {
        fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError> {
            let sent = self.inner.sent.len();
            if self.late.as_ref().is_some_and(|(at, _)| sent >= *at) {
                let (_, policy) = self.late.take().unwrap();
                self.slot.put(policy);
            }
            if self.late.is_none() && self.seen.is_none() && !self.slot.has_one() {
                self.seen = Some(sent);
            }
            let mut readings = self.inner.read(deadline)?;
            // The joints move as fast as they were sent.
            if let [.., before, last] = self.inner.sent.as_slice() {
                readings.vel_radps = PerJoint::from_fn(16, |i| (last[i] - before[i]) / 0.02);
            }
            Ok(readings)
        }
        fn write(&mut self, targets: &PerJoint) -> Result<(), BusError> {
            self.inner.write(targets)
        }
        fn torque_off(&mut self) -> Result<(), BusError> {
            self.inner.torque_off()
        }
    }
    impl Imu for Late {
        fn reading(&mut self) -> Result<ImuReading, BusError> {
            self.inner.reading()
        }
    }
    impl Robot for Late {}
    let slot = Slot::default();
    let mut robot = Late {
        inner: FakeRobot::new(),
        slot: slot.clone(),
        late: Some((after, verified(2, standing(2)))),
        seen: None,
    };
    let folder = tempfile::tempdir().unwrap();
    let table = folder.path().join("commands.csv");
    std::fs::write(&table, commands).unwrap();
    let clock = FakeClock::default();
    let commands = CommandTable::read(&table).unwrap();
    let plan = RunPlan { swap_wait, balances, ..plan(Some(8.0), commands) };
    let (updates, _events) = Updates::new(slot);
    let metrics = RobotMetrics::register(&caudata_telemetry::Metrics::new());
    // Its targets follow the gait clock and the command, so that the joints move while it walks.
    let runner = PolicyRunner::new(verified(1, policy_file(1, |_, _| {})), None).unwrap();
    let mut control =
        ControlLoop::start(&mut robot, &clock, plan, runner, updates, metrics).unwrap();
    control.run(&StopFlag::new()).unwrap();
    let counts = control.into_parts().1;
    (robot.seen, counts)
}

#[test]
fn fault_34_a_newer_policy_waits_for_the_robot_to_stand() {
    let walking = "t,vx,vy,yaw_rate\n0,0.3,0,0\n100,0.3,0,0\n";
    // Walking all the time: never.
    let (seen, counts) = swapped(walking, 200, None, false);
    assert_eq!((seen, counts.swaps, counts.stands_for_swap), (None, 0, 0));
    // With a limit of a second the robot is made to stand, gets it, and walks on.
    let (seen, counts) = swapped(walking, 200, Some(Duration::from_secs(1)), false);
    assert_eq!((counts.swaps, counts.stands_for_swap), (1, 1));
    assert!(counts.swap_speed_radps < STILL_RADPS, "{}", counts.swap_speed_radps);
    let seen = seen.unwrap();
    // A second of waiting (50 ticks), the way to the nominal pose at 0.01 rad per tick, a fifth of a second
    // of rest.
    assert!((255..400).contains(&seen), "{seen}");
    assert!((counts.walked_s - 8.0).abs() < 0.5, "{}", counts.walked_s);
    // Before walking it gets in at once.
    let (seen, counts) = swapped(walking, 5, None, false);
    assert!(seen.unwrap() < 10 && counts.swaps == 1, "{seen:?}");
    // What balances stands by its policy, commanded to: a second of waiting, at most two until it is let in.
    let (seen, counts) = swapped(walking, 200, Some(Duration::from_secs(1)), true);
    assert_eq!((counts.swaps, counts.stands_for_swap), (1, 1));
    assert!((255..=352).contains(&seen.unwrap()), "{seen:?}");
    assert!((counts.walked_s - 8.0).abs() < 0.1, "{}", counts.walked_s);
}
