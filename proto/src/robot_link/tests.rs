//! Round trips and refusals of the robot link.

use proptest::prelude::*;

use super::*;

fn hello() -> Hello {
    Hello {
        robot_name: "polymander".into(),
        robot_hash: [5; 32],
        joint_names: std::array::from_fn(|i| format!("joint_{i}")),
        control_period_s: 0.02,
    }
}

fn command() -> Command {
    Command {
        tick: 9,
        targets_rad: std::array::from_fn(|i| i as f32 / 10.0),
        torque_enabled: true,
    }
}

fn sensors() -> Sensors {
    Sensors {
        tick: 9,
        time_s: 0.18,
        joint_pos_rad: [0.1; JOINTS],
        joint_vel_radps: [-0.2; JOINTS],
        current_a: [0.3; JOINTS],
        supply_v: 12.1,
        gyro_radps: [0.0, 0.1, -0.1],
        acc_mps2: [0.0, 0.2, 9.81],
        imu_gravity: Some([0.0, 0.0, -1.0]),
        base_pose: Some(BasePose {
            pos_m: [1.0, 2.0, 0.1],
            quat_wxyz: [1.0, 0.0, 0.0, 0.0],
        }),
        foot_contacts: Some([true, false, false, true]),
        in_water: Some(true),
    }
}

fn messages() -> Vec<RobotMessage> {
    let bare = Sensors {
        imu_gravity: None,
        base_pose: None,
        foot_contacts: None,
        in_water: None,
        ..sensors()
    };
    vec![
        RobotMessage::Hello(Box::new(hello())),
        RobotMessage::Command(command()),
        RobotMessage::Sensors(Box::new(sensors())),
        RobotMessage::Sensors(Box::new(bare)),
    ]
}

#[test]
fn every_message_survives_the_round_trip() {
    for message in messages() {
        let bytes = encode(&message);
        assert!(bytes.len() <= MAX_MESSAGE_BYTES);
        assert_eq!(decode(&bytes).unwrap(), message);
    }
}

#[test]
fn foot_contacts_are_bits_from_the_front_left() {
    // FL and HR: bits 0 and 3, 1 + 8 = 9.
    assert_eq!(sensors_to_wire(&sensors()).foot_contacts, Some(9));
    assert_eq!(
        feet_from_wire(16),
        Err(LinkError::Value {
            field: "foot_contacts"
        })
    );
}

#[test]
fn wrong_messages_are_refused_by_name() {
    let refused = |change: fn(&mut pb::RobotMessage), message: RobotMessage| {
        let mut wire = pb::RobotMessage::decode(encode(&message).as_slice()).unwrap();
        change(&mut wire);
        decode(&wire.encode_to_vec()).unwrap_err()
    };
    fn with_command(wire: &mut pb::RobotMessage) -> &mut pb::Command {
        match &mut wire.body {
            Some(pb::robot_message::Body::Command(command)) => command,
            _ => panic!("not a command"),
        }
    }
    fn with_hello(wire: &mut pb::RobotMessage) -> &mut pb::Hello {
        match &mut wire.body {
            Some(pb::robot_message::Body::Hello(hello)) => hello,
            _ => panic!("not a hello"),
        }
    }
    let command = || RobotMessage::Command(command());
    let hello = || RobotMessage::Hello(Box::new(hello()));
    assert_eq!(
        refused(|w| with_command(w).targets_rad.truncate(15), command()),
        LinkError::Length {
            field: "targets_rad",
            found: 15,
            expected: 16
        }
    );
    assert_eq!(
        refused(|w| with_command(w).targets_rad[3] = f32::NAN, command()),
        LinkError::Value {
            field: "targets_rad"
        }
    );
    assert_eq!(
        refused(|w| with_hello(w).protocol = 2, hello()),
        LinkError::Protocol { found: 2 }
    );
    assert_eq!(
        refused(|w| with_hello(w).control_period_s = 0.0, hello()),
        LinkError::Value {
            field: "control_period_s"
        }
    );
    assert_eq!(
        refused(|w| with_hello(w).joint_names.truncate(3), hello()),
        LinkError::Length {
            field: "joint_names",
            found: 3,
            expected: 16
        }
    );
    assert_eq!(
        refused(|w| w.body = None, hello()),
        LinkError::Missing { field: "body" }
    );
    let long = vec![0; MAX_MESSAGE_BYTES + 1];
    assert_eq!(
        decode(&long),
        Err(LinkError::TooLarge {
            bytes: MAX_MESSAGE_BYTES + 1
        })
    );
}

#[test]
fn cut_and_flipped_messages_do_no_harm() {
    for message in messages() {
        let good = encode(&message);
        for end in 0..good.len() {
            assert!(decode(&good[..end]).is_err(), "cut after {end} bytes");
        }
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            let _ = decode(&bad);
        }
    }
}

proptest! {
    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..256)) {
        let _ = decode(&bytes);
    }
}
