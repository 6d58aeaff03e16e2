//! Round trips and refusals of the robot link.

use proptest::prelude::*;

use super::*;

const JOINTS: usize = 12;

fn hello() -> Hello {
    Hello {
        robot_name: "polymander".into(),
        robot_hash: [5; 32],
        joint_names: (0..JOINTS).map(|i| format!("joint_{i}")).collect(),
        control_period_s: 0.02,
    }
}

fn command() -> Command {
    Command {
        tick: 9,
        targets_rad: (0..JOINTS).map(|i| i as f32 / 10.0).collect(),
        torque_enabled: true,
    }
}

fn sensors() -> Sensors {
    Sensors {
        tick: 9,
        time_s: 0.18,
        joint_pos_rad: vec![0.1; JOINTS],
        joint_vel_radps: vec![-0.2; JOINTS],
        current_a: vec![0.3; JOINTS],
        supply_v: 12.1,
        gyro_radps: [0.0, 0.1, -0.1],
        acc_mps2: [0.0, 0.2, 9.81],
        imu_gravity: Some([0.0, 0.0, -1.0]),
        base_pose: Some(BasePose { pos_m: [1.0, 2.0, 0.1], quat_wxyz: [1.0, 0.0, 0.0, 0.0] }),
        // FL and HR: bits 0 and 3, 1 + 8 = 9
        foot_contacts: Some(9),
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
    assert!(sensors().fit(JOINTS, 4) && !sensors().fit(JOINTS, 3) && !sensors().fit(15, 4));
    assert_eq!(feet_from_wire(256), Err(LinkError::Value { field: "foot_contacts" }));
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
        refused(|w| with_command(w).targets_rad.resize(33, 0.0), command()),
        LinkError::Joints { field: "targets_rad", found: 33 }
    );
    assert_eq!(
        refused(|w| with_command(w).targets_rad[3] = f32::NAN, command()),
        LinkError::Value { field: "targets_rad" }
    );
    assert_eq!(refused(|w| with_hello(w).protocol = 2, hello()), LinkError::Protocol { found: 2 });
    assert_eq!(
        refused(|w| with_hello(w).control_period_s = 0.0, hello()),
        LinkError::Value { field: "control_period_s" }
    );
    assert_eq!(
        refused(|w| with_hello(w).joint_names.clear(), hello()),
        LinkError::Joints { field: "joint_names", found: 0 }
    );
    assert_eq!(refused(|w| w.body = None, hello()), LinkError::Missing { field: "body" });
    let long = vec![0; MAX_MESSAGE_BYTES + 1];
    assert_eq!(decode(&long), Err(LinkError::TooLarge { bytes: MAX_MESSAGE_BYTES + 1 }));
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
