//! The serial port through a pseudo-terminal: the same bytes as through a cable, and the speed that the host
//! has set.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use caudata_dynamixel::emulator::{EmulatedBus, EmulatedServo, Pty};
use caudata_dynamixel::xm430;
use caudata_dynamixel::{Bus, SerialPort};

/// Long enough for a machine that is busy with other things.
const PATIENT: Duration = Duration::from_secs(20);

#[test]
fn a_servo_behind_a_pseudo_terminal_answers_at_its_own_speed_only() {
    let mut pty = Pty::open().unwrap();
    let path = pty.path().to_owned();
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = stop.clone();
    let servos = std::thread::spawn(move || {
        let mut servo = EmulatedServo::new(1, xm430::MODEL_W350);
        servo.put(&xm430::BAUD_RATE, 3);
        let mut bus = EmulatedBus::new(vec![servo], 1);
        let (start, mut buffer, mut out) = (Instant::now(), [0; 256], Vec::new());
        while !stopped.load(Ordering::Relaxed) {
            let count = pty.receive(&mut buffer, Duration::from_millis(1)).unwrap();
            let now_us = start.elapsed().as_micros() as u64;
            bus.host_baud = pty.baud().unwrap();
            bus.hear(&buffer[..count], now_us);
            out.clear();
            bus.collect(now_us, &mut out);
            pty.send(&out).unwrap();
        }
    });
    let port = SerialPort::open(&path, 57_600).unwrap();
    let mut bus = Bus::new(port, 57_600);
    assert!(bus.ping(1, Duration::from_millis(300)).is_err());
    bus.set_baud(1_000_000).unwrap();
    let pong = bus.ping(1, PATIENT).unwrap();
    assert_eq!(pong.model, xm430::MODEL_W350);
    // Terminal settings must not touch any byte: 0x0A, 0x0D, 0x11, 0x13, 0x03 and 0xFF all come back.
    for value in [0x0D0A_1311_i32, 0x7F03_FF00, -1] {
        bus.write(1, &xm430::PROFILE_VELOCITY, value, PATIENT).unwrap();
        assert_eq!(bus.read(1, &xm430::PROFILE_VELOCITY, PATIENT).unwrap().0, value);
    }
    stop.store(true, Ordering::Relaxed);
    servos.join().unwrap();
}

#[test]
fn a_port_is_one_programs_alone_and_left_as_it_is_by_others() {
    let pty = Pty::open().unwrap();
    let first = SerialPort::open(pty.path(), 1_000_000).unwrap();
    let error = SerialPort::open(pty.path(), 57_600).unwrap_err();
    assert_eq!(error.kind(), std::io::ErrorKind::ResourceBusy, "{error}");
    assert_eq!(pty.baud().unwrap(), 1_000_000, "the first one's speed stays");
    // Whoever must be obeyed comes in all the same, and is told.
    let (order, alone) = SerialPort::open_anyway(pty.path(), 1_000_000).unwrap();
    assert!(!alone);
    drop((first, order));
    assert!(SerialPort::open(pty.path(), 57_600).is_ok());
}
