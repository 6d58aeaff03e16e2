//! The hardware layer over emulated servos and an emulated IMU: what each fault on the bus looks like to the
//! control loop.

use caudata_dynamixel::HardwareError;
use caudata_dynamixel::emulator::{EmulatedBus, EmulatedPort, EmulatedServo, Present};
use caudata_hardware::emulated::EmulatedImu;

use std::path::Path;

use caudata_model::RobotModel;

use super::*;
use crate::hardware::inspect::Mark;
use crate::testing::model;

const DEADLINE: Duration = Duration::from_millis(7);

fn wiring() -> (Wiring, Vec<JointWiring>) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.wiring.toml");
    read_wiring(Path::new(path), &model(), &PortOverrides::default()).unwrap()
}

#[test]
fn wheels_are_refused() {
    let robots = concat!(env!("CARGO_MANIFEST_DIR"), "/../robots/polymander.");
    let read = |end| std::fs::read_to_string(format!("{robots}{end}")).unwrap();
    let rolls = read("xml").replace("-1.27409 1.27409", "-1e5 1e5");
    let (toml, model) = (read("robot.toml"), model());
    let rover = RobotModel::from_bytes(model.name(), toml.as_bytes(), rolls.as_bytes()).unwrap();
    let path = format!("{robots}wiring.toml");
    let refused = read_wiring(Path::new(&path), &rover, &PortOverrides::default());
    assert!(refused.unwrap_err().to_string().contains("joint.FL_hip: it is a wheel"));
}

/// Sixteen servos as from the factory but for id and speed, in the nominal pose at 12 V.
fn servos(joints: &[JointWiring]) -> Vec<EmulatedServo> {
    let nominal = model();
    let nominal = nominal.nominal_pos_rad();
    joints
        .iter()
        .zip(nominal)
        .map(|(joint, rad)| {
            let mut servo = EmulatedServo::new(joint.id, joint.model.number());
            servo.put(&xm430::BAUD_RATE, 3);
            let present = Present {
                position: joint.counts(*rad),
                velocity: 10,
                current: 100,
                voltage: 120,
                temperature: 30,
            };
            servo.sense(present, 0);
            servo
        })
        .collect()
}

fn level() -> EmulatedImu {
    let mut imu = EmulatedImu::default();
    imu.feel([0.0; 3], [0.0, 0.0, 9.81]);
    imu
}

pub(super) type Emulated = HardwareRobot<EmulatedPort, EmulatedImu>;

pub(super) fn robot() -> Emulated {
    let (wiring, joints) = wiring();
    let port = EmulatedPort::new(EmulatedBus::new(servos(&joints), 1));
    let mut bus = Bus::new(port, wiring.bus.baud);
    let inspection = inspect::servos(&mut bus, &wiring, &joints, &model(), true).unwrap();
    assert_eq!(inspection.wrong().next(), None);
    let imu = ImuChip::start(level(), &wiring.imu).unwrap();
    HardwareRobot::new(bus, imu, &wiring, joints).unwrap()
}

/// `count` ticks of 20 ms: read, IMU, write what was read.
fn ticks(robot: &mut Emulated, count: u32) -> Result<Health, BusError> {
    for _ in 0..count {
        match robot.read(DEADLINE) {
            Ok(readings) => {
                robot.reading()?;
                robot.write(&readings.pos_rad)?;
            }
            Err(BusError::Timeout { .. }) => {}
            Err(error) => return Err(error),
        }
        robot.bus_mut().port_mut().wait_us(15_000);
    }
    Ok(robot.health())
}

pub(super) fn emulated(robot: &mut Emulated, joint: usize) -> &mut EmulatedServo {
    &mut robot.bus_mut().port_mut().bus.servos[joint]
}

#[test]
fn readings_are_joint_angles_in_si_units() {
    let mut robot = robot();
    let readings = robot.read(DEADLINE).unwrap();
    let model = model();
    for (found, nominal) in readings.pos_rad.iter().zip(model.nominal_pos_rad()) {
        // Half a count is 0.044°.
        assert!((f64::from(*found) - nominal).abs() < 0.0008, "{found} {nominal}");
    }
    // 10 units of 0.229 rev/min; the right legs' servos are mounted the other way round.
    assert!((readings.vel_radps[0] - 0.2398).abs() < 1e-4);
    assert!((readings.vel_radps[10] + 0.2398).abs() < 1e-4);
    // 100 units of 2.69 mA.
    assert!(
        (readings.current_a[0] - 0.269).abs() < 1e-6
            && (readings.current_a[10] + 0.269).abs() < 1e-6
    );
}

#[test]
fn goals_come_before_torque_and_torque_before_the_watchdog() {
    let mut robot = robot();
    let readings = robot.read(DEADLINE).unwrap();
    let mut targets = readings.pos_rad;
    targets[9] += 0.01;
    robot.write(&targets).unwrap();
    let (_, joints) = wiring();
    for (index, joint) in joints.iter().enumerate() {
        let servo = emulated(&mut robot, index);
        assert!(servo.torque_on());
        assert_eq!(servo.goal(), joint.counts(f64::from(targets[index])));
        assert_eq!(servo.get(&xm430::BUS_WATCHDOG), 5);
    }
    robot.torque_off().unwrap();
    assert!((0..16).all(|i| !emulated(&mut robot, i).torque_on()));
}

#[test]
fn a_healthy_robot_stays_so_for_ten_seconds() {
    let mut robot = robot();
    let health = ticks(&mut robot, 500).unwrap();
    let calm = Health {
        hottest_c: 30,
        // The emulated IMU has no noise.
        imu_same_ticks: health.imu_same_ticks,
        ..Health::default()
    };
    assert_eq!(health, calm);
    assert_eq!(robot.bus_counts().silent, 0);
}

#[test]
fn fault_39_one_servo_silent_is_counted_and_its_readings_stand() {
    let mut robot = robot();
    ticks(&mut robot, 5).unwrap();
    emulated(&mut robot, 4).unplugged = true;
    for tick in 1..=10 {
        let before = robot.bus_mut().port_mut().now_us;
        let readings = robot.read(DEADLINE);
        let waited = robot.bus_mut().port_mut().now_us - before;
        assert!(waited <= 8_000, "tick {tick} waited {waited} µs");
        robot.bus_mut().port_mut().wait_us(15_000);
        // With Fast Sync Read one silent servo silences all: after three ticks plain Sync Read takes over.
        if tick > 3 {
            assert!((readings.unwrap().vel_radps[4] - 0.2398).abs() < 1e-4);
        }
        assert_eq!(robot.health().silent_ticks, tick);
    }
}

#[test]
fn fault_41_an_alert_names_joint_and_errors_at_once() {
    let mut robot = robot();
    ticks(&mut robot, 5).unwrap();
    emulated(&mut robot, 9).raise(HardwareError(HardwareError::OVERLOAD));
    let health = ticks(&mut robot, 1).unwrap();
    assert_eq!(health.alert, Some((9, HardwareError::OVERLOAD)));
}

#[test]
fn fault_42_a_servo_that_restarts_is_found_within_a_second() {
    let mut robot = robot();
    ticks(&mut robot, 5).unwrap();
    let now_us = robot.bus_mut().port_mut().now_us;
    emulated(&mut robot, 15).reboot(now_us);
    let mut found = None;
    for tick in 1..=50 {
        if ticks(&mut robot, 1).unwrap().restarted.is_some() {
            found = Some(tick);
            break;
        }
    }
    // 32 ticks of one round, after 300 ms (15 ticks) of booting, in which silence tells already.
    assert!(found.is_some_and(|tick| tick <= 50), "{found:?}");
    assert_eq!(robot.health().restarted, Some(15));
}

#[test]
fn fault_43_a_watchdog_that_fired_is_found_and_goals_are_refused() {
    let mut robot = robot();
    ticks(&mut robot, 5).unwrap();
    robot.bus_mut().port_mut().wait_us(150_000);
    let goal = emulated(&mut robot, 3).goal();
    robot.write(&PerJoint::filled(16, 0.3)).unwrap();
    assert_eq!(emulated(&mut robot, 3).goal(), goal);
    let health = ticks(&mut robot, 2).unwrap();
    assert!(health.watchdog_fired.is_some());
}

#[test]
fn a_bus_that_is_gone_is_lost_after_ten_ticks() {
    let mut robot = robot();
    ticks(&mut robot, 5).unwrap();
    (0..16).for_each(|i| emulated(&mut robot, i).unplugged = true);
    assert!(ticks(&mut robot, 9).is_ok());
    assert!(matches!(ticks(&mut robot, 1), Err(BusError::Lost { .. })));
}

#[test]
fn fault_45_a_stale_or_frozen_imu_is_counted() {
    let mut robot = robot();
    robot.reading().unwrap();
    for same in 1..=3 {
        robot.reading().unwrap();
        assert_eq!(robot.health().imu_same_ticks, same);
    }
    robot.imu = {
        let mut gone = level();
        let (wiring, _) = wiring();
        gone.unplugged = false;
        let mut chip = ImuChip::start(gone, &wiring.imu).unwrap();
        chip.bus_mut().unplugged = true;
        chip
    };
    for stale in 1..=3 {
        robot.reading().unwrap();
        assert_eq!(robot.health().imu_stale_ticks, stale);
    }
}

/// Inspection of servos that `change` made, without and with setting right.
fn inspected(change: impl Fn(&mut EmulatedServo)) -> [Vec<(String, Mark)>; 2] {
    [false, true].map(|fix| {
        let (wiring, joints) = wiring();
        let mut servos = servos(&joints);
        change(&mut servos[2]);
        let port = EmulatedPort::new(EmulatedBus::new(servos, 1));
        let mut bus = Bus::new(port, wiring.bus.baud);
        let found = inspect::servos(&mut bus, &wiring, &joints, &model(), fix).unwrap();
        let of_it = found.checks.into_iter().filter(|c| c.at == "spine_3");
        let odd = of_it.filter(|c| c.mark != Mark::Good).map(|c| (c.what, c.mark));
        odd.collect()
    })
}

fn has(checks: &[(String, Mark)], what: &str, mark: Mark) -> bool {
    checks.iter().any(|(w, m)| w == what && *m == mark)
}

#[test]
fn fault_52_wrong_speed_and_return_delay_are_set_right_or_refused() {
    let [seen, fixed] = inspected(|servo| servo.put(&xm430::BAUD_RATE, 1));
    assert!(has(&seen, "baud", Mark::Wrong), "{seen:?}");
    assert!(has(&fixed, "baud", Mark::Fixed), "{fixed:?}");
    // As from the factory: 500 µs.
    let [seen, fixed] = inspected(|_| {});
    assert!(has(&seen, "Return Delay Time", Mark::Wrong));
    assert!(has(&fixed, "Return Delay Time", Mark::Fixed));
    assert!(fixed.iter().all(|(_, mark)| *mark == Mark::Fixed));
}

#[test]
fn faults_51_and_53_a_joint_beyond_its_limits_and_a_low_battery_are_refused() {
    let far = inspected(|servo| servo.put(&xm430::PRESENT_POSITION, 4095));
    assert!(has(&far[1], "position", Mark::Wrong), "{far:?}");
    let low = inspected(|servo| servo.put(&xm430::PRESENT_INPUT_VOLTAGE, 104));
    assert!(has(&low[1], "supply", Mark::Wrong));
    let other = inspected(|servo| servo.put(&xm430::MODEL_NUMBER, 1020));
    assert!(has(&other[1], "model", Mark::Wrong));
    let hurt = inspected(|servo| servo.raise(HardwareError(HardwareError::OVERHEATING)));
    assert!(has(&hurt[1], "hardware errors", Mark::Wrong));
    let gone = inspected(|servo| servo.unplugged = true);
    assert!(has(&gone[1], "answers", Mark::Wrong));
}
