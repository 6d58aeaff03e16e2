//! The bus against emulated servos: groups, refusals, silence, noise, alerts, watchdog, reboot, wrong speed.

use std::time::Duration;

use caudata_dynamixel::emulator::{
    BOOT_US, EmulatedBus, EmulatedPort, EmulatedServo, Present, WireFaults,
};
use caudata_dynamixel::setup::{Want, compare, find_baud, move_to_baud};
use caudata_dynamixel::xm430::{self, TICK_ADDRESS, TICK_BYTES};
use caudata_dynamixel::{
    Answer, Bus, BusFault, ErrorNumber, GroupRead, GroupWrite, HardwareError, StatusError,
};

const DEADLINE: Duration = Duration::from_millis(7);
const SLOW: Duration = Duration::from_millis(200);

/// Servos 1 to `count` at 1 Mbit/s without return delay; servo k is at 1000 + k.
fn bus(count: u8) -> Bus<EmulatedPort> {
    let servos = (1..=count).map(|id| {
        let mut servo = EmulatedServo::new(id, xm430::MODEL_W210);
        servo.put(&xm430::BAUD_RATE, 3);
        servo.put(&xm430::RETURN_DELAY_TIME, 0);
        servo.sense(
            Present {
                position: 1000 + i32::from(id),
                velocity: -i32::from(id),
                current: 7,
                voltage: 121,
                temperature: 30,
            },
            0,
        );
        servo
    });
    Bus::new(EmulatedPort::new(EmulatedBus::new(servos.collect(), 1)), 1_000_000)
}

fn ids(count: u8) -> Vec<u8> {
    (1..=count).collect()
}

fn positions(group: &GroupRead) -> Vec<Option<i32>> {
    let position = |i| match group.answer(i) {
        Answer::Data(_) => xm430::PRESENT_POSITION.value_in(group.data(i), TICK_ADDRESS),
        _ => None,
    };
    (0..group.len()).map(position).collect()
}

#[test]
fn sixteen_servos_in_one_question_plain_and_fast() {
    for fast in [false, true] {
        let mut bus = bus(16);
        let mut group = GroupRead::new(&ids(16), TICK_ADDRESS, TICK_BYTES, fast);
        bus.read_group(&mut group, DEADLINE).unwrap();
        let expected: Vec<_> = (1..=16).map(|k| Some(1000 + k)).collect();
        assert_eq!(positions(&group), expected);
        // 30 bytes asked, 16 × 21 or 232 answered, 10 µs each.
        let wire_us = if fast { 300 + 2320 } else { 300 + 3360 };
        assert_eq!(bus.port_mut().now_us, wire_us);
        assert_eq!(bus.counts().silent, 0);
    }
}

#[test]
fn goals_of_a_group_arrive() {
    let mut bus = bus(16);
    let mut goals = GroupWrite::new(&ids(16), xm430::GOAL_POSITION.address, 4);
    for index in 0..16 {
        goals.set(index, 2000 + index as i32);
    }
    bus.write_group(&mut goals, DEADLINE).unwrap();
    let held: Vec<i32> = bus.port_mut().bus.servos.iter().map(EmulatedServo::goal).collect();
    assert_eq!(held, (2000..2016).collect::<Vec<_>>());
}

#[test]
fn a_goal_that_needs_stuffing_arrives() {
    // Counts −131,073 are FF FF FD FF: three bytes of a header.
    let mut bus = bus(1);
    bus.port_mut().bus.servos[0].put(&xm430::OPERATING_MODE, 5);
    bus.write(1, &xm430::GOAL_POSITION, -131_073, DEADLINE).unwrap();
    assert_eq!(bus.port_mut().bus.servos[0].goal(), -131_073);
    let (back, _) = bus.read(1, &xm430::GOAL_POSITION, DEADLINE).unwrap();
    assert_eq!(back, -131_073);
}

#[test]
fn one_silent_servo_is_named_and_the_deadline_holds() {
    let mut bus = bus(16);
    bus.port_mut().bus.servos[4].unplugged = true;
    let mut group = GroupRead::new(&ids(16), TICK_ADDRESS, TICK_BYTES, false);
    bus.read_group(&mut group, DEADLINE).unwrap();
    // In the emulated port's own time: nothing here waits by the machine's clock.
    assert!(bus.port_mut().now_us <= 7_000, "waited {} µs", bus.port_mut().now_us);
    let silent: Vec<usize> = (0..16).filter(|i| group.answer(*i) == Answer::Silent).collect();
    assert_eq!(silent, [4]);
    assert_eq!(bus.counts().silent, 1);
}

#[test]
fn fast_sync_read_with_a_silent_servo_falls_back_to_plain() {
    let mut bus = bus(4);
    bus.port_mut().bus.servos[1].unplugged = true;
    let mut fast = GroupRead::new(&ids(4), TICK_ADDRESS, TICK_BYTES, true);
    for _ in 0..3 {
        assert!(!bus.fast_is_hopeless());
        bus.read_group(&mut fast, DEADLINE).unwrap();
        assert_eq!(positions(&fast), [None; 4]);
    }
    assert!(bus.fast_is_hopeless());
    let mut plain = GroupRead::new(&ids(4), TICK_ADDRESS, TICK_BYTES, false);
    bus.read_group(&mut plain, DEADLINE).unwrap();
    assert_eq!(positions(&plain), [Some(1001), None, Some(1003), Some(1004)]);
}

#[test]
fn a_bad_wire_costs_answers_but_never_brings_wrong_ones() {
    for (seed, fast) in [(1, false), (2, true), (3, false)] {
        let mut bus = bus(16);
        bus.port_mut().bus.faults =
            WireFaults { lost_byte: 0.1, flipped_bit: 0.1, late: 0.02, late_us: 9_000, noise: 0.1 };
        let mut group = GroupRead::new(&ids(16), TICK_ADDRESS, TICK_BYTES, fast);
        let (mut came, mut asked) = (0, 0);
        for _ in 0..200 + seed {
            bus.read_group(&mut group, DEADLINE).unwrap();
            for (index, position) in positions(&group).into_iter().enumerate() {
                asked += 1;
                if let Some(position) = position {
                    came += 1;
                    assert_eq!(position, 1001 + index as i32);
                }
            }
            bus.port_mut().wait_us(20_000);
        }
        assert!(came > 0 && came < asked, "{came} of {asked}");
        assert!(bus.counts().crc_errors > 0);
    }
}

#[test]
fn a_bus_that_babbles_for_ever_does_not_hold_the_caller() {
    let mut bus = bus(1);
    bus.port_mut().babbles = true;
    let error = bus.ping(1, Duration::from_millis(2)).unwrap_err();
    assert!(matches!(error, BusFault::Silent { id: 1, .. }));
    bus.port_mut().babbles = false;
    assert_eq!(bus.ping(1, SLOW).unwrap().model, xm430::MODEL_W210);
}

#[test]
fn a_late_answer_is_not_taken_for_the_next_one() {
    let mut bus = bus(2);
    bus.port_mut().bus.faults = WireFaults { late: 1.0, late_us: 7_100, ..WireFaults::default() };
    assert!(bus.read(1, &xm430::PRESENT_POSITION, DEADLINE).is_err());
    bus.port_mut().bus.faults = WireFaults::default();
    // The answer to the first question (servo 1, 4 bytes) arrives while the bus is left quiet.
    let (goal, _) = bus.read(1, &xm430::GOAL_POSITION, SLOW).unwrap();
    assert_eq!(goal, 2048);
}

#[test]
fn refusals_and_alerts_reach_the_caller() {
    let mut bus = bus(2);
    bus.write(1, &xm430::TORQUE_ENABLE, 1, DEADLINE).unwrap();
    let refused = bus.write(1, &xm430::ID, 5, DEADLINE).unwrap_err();
    assert!(matches!(refused, BusFault::Refused { id: 1, error: ErrorNumber::ACCESS }));
    let far = bus.write(1, &xm430::GOAL_POSITION, 4096, DEADLINE).unwrap_err();
    assert!(matches!(far, BusFault::Refused { error: ErrorNumber::DATA_LIMIT, .. }));
    // Overload: torque off, alert in every answer, good data all the same.
    bus.port_mut().bus.servos[0].raise(HardwareError(HardwareError::OVERLOAD));
    let (_, error) = bus.read(1, &xm430::PRESENT_POSITION, DEADLINE).unwrap();
    assert!(error.alert());
    let mut group = GroupRead::new(&[1, 2], TICK_ADDRESS, TICK_BYTES, true);
    bus.read_group(&mut group, DEADLINE).unwrap();
    assert_eq!(
        [group.answer(0), group.answer(1)],
        [Answer::Data(StatusError(0x80)), Answer::Data(StatusError(0))]
    );
    assert!(!bus.port_mut().bus.servos[0].torque_on());
    assert!(bus.write(1, &xm430::TORQUE_ENABLE, 1, DEADLINE).is_err());
}

#[test]
fn the_watchdog_holds_the_pose_when_the_host_goes_silent_and_must_be_cleared() {
    let mut bus = bus(1);
    // 5 units of 20 ms.
    bus.write(1, &xm430::BUS_WATCHDOG, 5, DEADLINE).unwrap();
    bus.write(1, &xm430::TORQUE_ENABLE, 1, DEADLINE).unwrap();
    bus.write(1, &xm430::GOAL_POSITION, 3000, DEADLINE).unwrap();
    bus.port_mut().wait_us(99_000);
    assert!(!bus.port_mut().bus.servos[0].watchdog_fired());
    bus.port_mut().wait_us(2_000);
    assert!(bus.port_mut().bus.servos[0].watchdog_fired());
    assert_eq!(bus.port_mut().bus.servos[0].goal(), 1001, "where it was");
    let refused = bus.write(1, &xm430::GOAL_POSITION, 3000, DEADLINE).unwrap_err();
    assert!(matches!(refused, BusFault::Refused { error: ErrorNumber::DATA_RANGE, .. }));
    assert_eq!(bus.read(1, &xm430::BUS_WATCHDOG, DEADLINE).unwrap().0, 255);
    bus.write(1, &xm430::BUS_WATCHDOG, 0, DEADLINE).unwrap();
    bus.write(1, &xm430::GOAL_POSITION, 3000, DEADLINE).unwrap();
}

#[test]
fn a_reboot_forgets_torque_watchdog_and_gains() {
    let mut bus = bus(1);
    bus.write(1, &xm430::POSITION_P_GAIN, 900, DEADLINE).unwrap();
    bus.write(1, &xm430::BUS_WATCHDOG, 5, DEADLINE).unwrap();
    bus.write(1, &xm430::TORQUE_ENABLE, 1, DEADLINE).unwrap();
    bus.reboot(1, DEADLINE).unwrap();
    assert!(bus.ping(1, DEADLINE).is_err(), "it boots");
    bus.port_mut().wait_us(BOOT_US);
    let read = |bus: &mut Bus<_>, r| bus.read(1, r, DEADLINE).unwrap().0;
    assert_eq!(read(&mut bus, &xm430::TORQUE_ENABLE), 0);
    assert_eq!(read(&mut bus, &xm430::BUS_WATCHDOG), 0);
    assert_eq!(read(&mut bus, &xm430::POSITION_P_GAIN), 800);
    assert_eq!(read(&mut bus, &xm430::BAUD_RATE), 3, "kept without power");
}

#[test]
fn a_servo_at_factory_speed_is_found_and_moved() {
    let mut bus = bus(1);
    bus.port_mut().bus.servos[0].put(&xm430::BAUD_RATE, 1);
    bus.port_mut().bus.servos[0].put(&xm430::RETURN_DELAY_TIME, 250);
    assert_eq!(find_baud(&mut bus, 1).unwrap(), 57_600);
    move_to_baud(&mut bus, 1, 1_000_000).unwrap();
    let delay = Want { register: &xm430::RETURN_DELAY_TIME, value: 0 };
    let seen = compare(&mut bus, 1, &[delay], false).unwrap();
    assert_eq!((seen[0].found, seen[0].right), (250, false));
    let mended = compare(&mut bus, 1, &[delay], true).unwrap();
    assert!(mended[0].right);
    assert!(compare(&mut bus, 1, &[delay], false).unwrap().is_empty());
}

#[test]
fn an_id_that_nobody_has_is_silence_at_every_speed() {
    let mut bus = bus(1);
    assert!(matches!(find_baud(&mut bus, 9), Err(BusFault::Silent { id: 9, .. })));
    assert_eq!(bus.baud(), 1_000_000);
}
