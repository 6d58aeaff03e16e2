//! Every door through which bytes come in from outside, with bytes that somebody has spoilt: no panic, no
//! more memory than a limit, and nothing accepted that must not be.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout)]

#[path = "../../../deploy/src/testing.rs"]
#[allow(dead_code)]
mod policies;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use caudata_chaos_proxy::Dice;
use caudata_deploy::boundary::{Answer, RunFolder, STAGED_FORMAT, Staged, Teller, Told};
use caudata_deploy::command_link::{Kind, LinkKey, Message, Receiver};
use caudata_deploy::state::{PolicyRef, RobotState, Sha256Digest};
use caudata_deploy::store::PolicyStore;
use caudata_deploy::updates::PolicyEvent;
use caudata_dynamixel::crc::crc16;
use caudata_dynamixel::frame::{Framer, STATUS, encode, unstuff};
use caudata_fuzz::fuzz;
use caudata_model::RobotModel;
use caudata_model::import::{ImportOptions, import};
use caudata_policy::PolicyFile;
use caudata_policy_server::Record;
use caudata_proto::registry::{
    Freshness, LabelName, Manifest, SignedFreshness, StreamName, WatchEvent,
};
use caudata_proto::rollout::ROLLOUT_PROTOCOL;
use caudata_proto::wire::registry as wire;
use caudata_proto::{ActionHistory, DecodeLimits, Envelope, Moments, RolloutChunk, robot_link};
use caudata_runlog::Table;
use caudata_runlog::ros::messages::{
    DiagnosticArray, DiagnosticStatus, Header, Imu, JointState, JointTrajectory, NumberArray,
    Odometry, Twist,
};
use caudata_runlog::ros::{Compression, parse_mcap, write_mcap};
use caudata_signing::{ReleaseKey, Trust};
// of `policies`
use caudata_task as _;
use policies::standing;
use prost::Message as _;

fn manifest() -> Manifest {
    let file = PolicyFile::parse(Arc::from(standing(3))).unwrap();
    let stream = StreamName::new("release/flat").unwrap();
    let mut manifest = caudata_registry_client::manifest_of(stream, &file, 5).unwrap();
    manifest.evaluation_json = Some("{\"a\":1}".into());
    manifest
}

fn release() -> ReleaseKey {
    ReleaseKey::from_seed("release", &[7; 32])
}

fn fresh() -> ReleaseKey {
    ReleaseKey::from_seed("server", &[8; 32])
}

fn trust() -> String {
    format!("{}\n{}", release().trust_file(), fresh().trust_lines("fresh_key"))
}

#[test]
fn trust_file() {
    fuzz("trust_file", vec![trust().into_bytes()], 1 << 20, |bytes| {
        let Ok(text) = std::str::from_utf8(bytes) else {
            return "no text".into();
        };
        match Trust::parse(text) {
            Ok(_) => "taken".into(),
            Err(reason) => reason.chars().take(60).collect(),
        }
    });
}

#[test]
fn manifest_and_signature() {
    let trust = Trust::parse(&trust()).unwrap();
    let mut signed = manifest();
    release().sign(&mut signed);
    let mut back = manifest();
    back.reverts_to = Some(1);
    release().sign(&mut back);
    let genuine = [signed.clone(), back.clone()];
    let seeds = genuine.iter().map(|m| wire::Manifest::from(m.clone()).encode_to_vec()).collect();
    fuzz("manifest_and_signature", seeds, 1 << 20, |bytes| {
        let Ok(message) = wire::Manifest::decode(bytes) else {
            return "not protobuf".into();
        };
        match Manifest::try_from(message) {
            Err(error) => error.to_string(),
            Ok(found) => match trust.check(&found) {
                Err(_) => "not trusted".into(),
                Ok(()) => {
                    let mut bare = found.clone();
                    bare.signatures.clear();
                    let same = |m: &Manifest| Manifest { signatures: vec![], ..m.clone() } == bare;
                    assert!(genuine.iter().any(same), "trusts what nobody signed");
                    "trusted".into()
                }
            },
        }
    });
}

#[test]
fn freshness() {
    let trust = Trust::parse(&trust()).unwrap();
    let (stream, label) = (manifest().stream, LabelName::latest());
    let said = Freshness {
        nonce: [5; 32],
        stream: stream.clone(),
        label: label.clone(),
        version: 3,
        sha256: [1; 32],
    };
    let genuine = fresh().vouch(said.clone());
    let seeds = vec![wire::FreshnessResponse::from(genuine).encode_to_vec()];
    fuzz("freshness", seeds, 1 << 20, |bytes| {
        let Ok(message) = wire::FreshnessResponse::decode(bytes) else {
            return "not protobuf".into();
        };
        match SignedFreshness::try_from(message) {
            Err(error) => error.to_string(),
            Ok(found) => match trust.check_fresh(&found, &[5; 32], &stream, &label) {
                Err(why) => why.to_string(),
                Ok(()) => {
                    assert_eq!(found.said, said, "takes what nobody said");
                    "fresh".into()
                }
            },
        }
    });
}

#[test]
fn watch_event() {
    let event = |event| wire::WatchEvent { generation: 4, event: Some(event) }.encode_to_vec();
    let seeds = vec![
        event(wire::watch_event::Event::Published(manifest().into())),
        event(wire::watch_event::Event::Snapshot(wire::Snapshot {
            manifests: vec![manifest().into(); 2],
        })),
        event(wire::watch_event::Event::Progress(wire::Progress {})),
    ];
    fuzz("watch_event", seeds, 4 << 20, |bytes| match wire::WatchEvent::decode(bytes) {
        Err(_) => "not protobuf".into(),
        Ok(message) => match WatchEvent::try_from(message) {
            Err(error) => error.to_string(),
            Ok(_) => "taken".into(),
        },
    });
}

#[test]
fn policy_file() {
    let seeds = vec![standing(1), standing(2)];
    fuzz("policy_file", seeds, 64 << 20, |bytes| match PolicyFile::parse(Arc::from(bytes)) {
        Err(error) => error.to_string().chars().take(40).collect(),
        Ok(file) => {
            let layers = &file.spec().layers;
            let finite =
                layers.iter().flat_map(|l| l.weight.iter().chain(&l.bias)).all(|w| w.is_finite());
            assert!(finite, "a weight is not a number");
            "taken".into()
        }
    });
}

/// Two steps of one lane, observations of three values: a number and the last action.
fn rollout_chunk(action_history: Option<ActionHistory>) -> RolloutChunk {
    RolloutChunk {
        run_id: "run1".into(),
        actor_id: 0,
        incarnation: 1,
        sequence: 0,
        policy_version: 0,
        policy_sha256: [1; 32],
        contract_hash: [2; 32],
        steps: 4,
        lanes: 1,
        obs_dim: 3,
        act_dim: 1,
        observations: vec![
            0.1, 0.0, 0.2, 0.3, 0.5, 0.4, 0.5, -1.0, 0.6, 0.7, 0.0, 0.8, 0.9, 0.25, 1.0,
        ],
        actions: vec![0.5, -2.0, 0.75, 0.25],
        action_means: vec![0.0; 4],
        log_std: vec![-1.0],
        log_probs: vec![-1.0; 4],
        rewards: vec![0.5; 4],
        terminated: vec![false, false, true, false],
        truncated: vec![false; 4],
        final_observations: vec![],
        episodes: vec![],
        moments: Moments { count: 4, mean: vec![0.0; 3], m2: vec![0.0; 3] },
        action_history,
        trace: None,
    }
}

#[test]
fn rollout_frame() {
    let this = ROLLOUT_PROTOCOL as u8;
    let whole = |action_history| {
        caudata_proto::encode(&Envelope::Chunk(Box::new(rollout_chunk(action_history))))
    };
    let history = ActionHistory { first: 1, steps: 1, clip: 1.0 };
    // With past actions left out a frame is shorter: both ways are knocked at.
    assert!(whole(Some(history)).len() < whole(None).len());
    let seeds = vec![
        whole(None),
        whole(Some(history)),
        vec![8, this, 26, 6, 10, 4, b'r', b'u', b'n', b'1'],
        vec![8, this, 26, 0],
        vec![8, this + 1],
    ];
    fuzz("rollout_frame", seeds, 32 << 20, |bytes| {
        match caudata_proto::decode(bytes, &DecodeLimits::default()) {
            Err(error) => error.to_string().chars().take(40).collect(),
            Ok(_) => "taken".into(),
        }
    });
}

#[test]
fn robot_link_message() {
    let hello = robot_link::RobotMessage::Hello(Box::new(robot_link::Hello {
        robot_name: "polymander".into(),
        robot_hash: [3; 32],
        joint_names: (0..16).map(|i| format!("joint_{i}")).collect(),
        control_period_s: 0.02,
    }));
    let seeds = vec![robot_link::encode(&hello)];
    fuzz("robot_link_message", seeds, 1 << 20, |bytes| match robot_link::decode(bytes) {
        Err(error) => error.to_string().chars().take(40).collect(),
        Ok(_) => "taken".into(),
    });
}

#[test]
fn servo_frames() {
    let frame = |parameters: &[u8]| {
        let mut out = Vec::new();
        encode(1, STATUS, parameters, &mut out);
        out
    };
    let seeds = vec![frame(&[0, 1, 2, 3, 4]), frame(&[0xFF, 0xFF, 0xFD, 0x00]), frame(&[0; 200])];
    let mut dice = Dice::new(7);
    fuzz("servo_frames", seeds, 1 << 20, move |bytes| {
        let mut framer = Framer::new();
        let mut found = 0;
        // In pieces of any length, down to single bytes.
        let step = 1 + dice.below(40) as usize;
        for piece in bytes.chunks(step) {
            framer.push(piece);
            while let Some(frame) = framer.next_frame() {
                let (whole, crc) = frame.raw.split_at(frame.raw.len() - 2);
                assert_eq!(crc16(whole).to_le_bytes(), crc);
                let mut body = frame.body().to_vec();
                assert!(unstuff(&mut body) <= body.len());
                found += 1;
            }
        }
        format!(
            "{} frames",
            if found > 1 {
                "some"
            } else if found == 1 {
                "one"
            } else {
                "no"
            }
        )
    });
}

#[test]
fn command_datagram() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("key");
    std::fs::write(&file, [9; 32]).unwrap();
    let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&file, private).unwrap();
    let key = LinkKey::read(&file).unwrap();
    let message = |kind, sequence| Message { kind, nonce: 77, sequence, command: [0.1, 0.0, 0.2] };
    let genuine: Vec<Vec<u8>> = [
        message(Kind::Velocity, 1),
        message(Kind::Kill, 2),
        message(Kind::Ask, 3),
        message(Kind::Held, 4),
        message(Kind::Released, 5),
    ]
    .iter()
    .map(|m| m.encode(&key).to_vec())
    .collect();
    fuzz("command_datagram", genuine.clone(), 1 << 16, |bytes| {
        let mut receiver = Receiver::new(77);
        let answer = receiver.take(bytes, &key, Duration::from_secs(1));
        let view = receiver.view(Duration::from_secs(1));
        let heard = answer.is_some() || view.killed || view.age < Duration::MAX;
        assert!(!heard || genuine.iter().any(|g| g == bytes), "heeds what nobody sent");
        format!("heard {heard}")
    });
}

#[test]
fn robot_state_pair() {
    let folder = tempfile::tempdir().unwrap();
    let mut store = PolicyStore::open(folder.path()).unwrap();
    let policy = |version| PolicyRef {
        stream: "s".into(),
        version,
        sha256: Sha256Digest([version as u8; 32]),
        reverts_to: None,
    };
    let mut states = vec![RobotState::default()];
    let mut seeds = Vec::new();
    for version in 1..4 {
        store.update(|state| state.adopt(policy(version))).unwrap();
        states.push(store.state().clone());
        seeds.push(std::fs::read(folder.path().join("state.json")).unwrap());
    }
    let whole = seeds[0].clone();
    fuzz("robot_state_pair", seeds, 1 << 20, |bytes| {
        // One copy spoilt, the other an old one or spoilt as well.
        let spoilt_twice = bytes.len().is_multiple_of(2);
        std::fs::write(folder.path().join("state.json"), bytes).unwrap();
        let copy = if spoilt_twice { bytes } else { &whole };
        std::fs::write(folder.path().join("state.copy.json"), copy).unwrap();
        match PolicyStore::peek(folder.path()) {
            Err(error) => error.to_string().chars().take(80).collect(),
            Ok(found) => {
                let found = found.unwrap_or_default();
                assert!(states.contains(&found), "believes what was never written: {found:?}");
                assert!(spoilt_twice || found.generation >= 1, "forgets");
                "read".into()
            }
        }
    });
}

#[test]
fn server_record() {
    let record = Record { generation: 3, manifest: manifest() };
    fuzz(
        "server_record",
        vec![record.to_json().unwrap()],
        1 << 20,
        |bytes| match Record::from_json(bytes) {
            Err(error) => error.to_string().chars().take(40).collect(),
            Ok(_) => "taken".into(),
        },
    );
}

#[test]
fn wiring_file() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots/polymander.wiring.toml");
    let seeds = vec![std::fs::read(path).unwrap()];
    fuzz("wiring_file", seeds, 4 << 20, |bytes| {
        let Ok(text) = std::str::from_utf8(bytes) else {
            return "no text".into();
        };
        match caudata_hardware::Wiring::parse(text) {
            Ok(_) => "taken".into(),
            Err(reason) => reason.chars().take(40).collect(),
        }
    });
}

#[test]
fn log_table() {
    let seeds = vec![b"t,cmd.FL_knee,pos.FL_knee,volt\n0.0,0.1,0.1,12\n0.02,0.1,,12\n".to_vec()];
    fuzz("log_table", seeds, 4 << 20, |bytes| match Table::parse("log.csv", bytes) {
        Ok(_) => "taken".into(),
        Err(error) => error.to_string().chars().take(40).collect(),
    });
}

/// Files between the two processes of a robot: what is staged, and what the loop told.
#[test]
fn boundary_files() {
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state");
    let run = RunFolder::open(&folder.path().join("run")).unwrap();
    let policy = PolicyRef {
        stream: "s".to_owned(),
        version: 3,
        sha256: Sha256Digest([7; 32]),
        reverts_to: None,
    };
    let staged = Staged {
        format: STAGED_FORMAT.to_owned(),
        number: 4,
        run: 77,
        answer: Answer::Policy { policy: policy.clone(), proved: false },
    };
    staged.write(&run).unwrap();
    let mut teller = Teller::open(&state, &run).unwrap();
    teller.tell(&PolicyEvent::Begun(policy.clone())).unwrap();
    let bad = PolicyEvent::Bad { policy, reason: "falls".to_owned(), walked_s: 1.5, fell: true };
    teller.tell(&bad).unwrap();
    let told = |number: u32| state.join(format!("told/{number:020}.json"));
    let seeds =
        [run.file("staged.json"), told(1), told(2)].map(|path| std::fs::read(path).unwrap());
    fuzz("boundary_files", seeds.to_vec(), 1 << 20, |bytes| {
        std::fs::write(run.file("staged.json"), bytes).unwrap();
        std::fs::write(told(1), bytes).unwrap();
        let staged = Staged::read(&run);
        let mut events = Vec::new();
        Told::of(&state, &run).take(|event| events.push(event));
        let kinds: Vec<_> = events.iter().map(std::mem::discriminant).collect();
        for entry in std::fs::read_dir(state.join("told")).unwrap() {
            std::fs::remove_file(entry.unwrap().path()).unwrap();
        }
        format!("{} {kinds:?}", staged.is_some())
    });
}

#[test]
fn bag_container() {
    let log =
        Table::parse("log.csv", &b"t,cmd.a,pos.a,volt\n0,0.1,0.1,12\n0.02,0.1,,12\n"[..]).unwrap();
    let packed = [Compression::Zstd, Compression::Lz4].map(Some).into_iter().chain([None]);
    let seeds = packed.map(|packed| write_mcap(&log, 1, packed, None).unwrap());
    fuzz("bag_container", seeds.collect(), 160 << 20, |bytes| match parse_mcap("a.mcap", bytes) {
        Ok(_) => "taken".into(),
        Err(error) => error.to_string().chars().take(40).collect(),
    });
}

/// What ROS nodes send, and what a recording holds.
#[test]
fn ros_messages() {
    let header = Header { stamp_ns: 1_500_000_002, frame: "b".to_owned() };
    let seeds = vec![
        Twist { linear_mps: [0.25, 0.0, 0.0], angular_radps: [0.0, 0.0, -0.5] }.encode(),
        JointState {
            header: header.clone(),
            name: vec!["hip".to_owned(), "knee".to_owned()],
            position: vec![1.0, 2.0],
            velocity: vec![0.5],
            effort: vec![],
        }
        .encode(),
        DiagnosticArray {
            header,
            status: vec![DiagnosticStatus {
                level: 2,
                name: "hip".to_owned(),
                message: "hot".to_owned(),
                hardware_id: String::new(),
                values: vec![("T".to_owned(), "69".to_owned())],
            }],
        }
        .encode(),
    ];
    fuzz("ros_messages", seeds, 16 << 20, |bytes| {
        let said = [
            Twist::decode(bytes).err(),
            JointState::decode(bytes).err(),
            DiagnosticArray::decode(bytes).err(),
            Imu::decode(bytes).err(),
            JointTrajectory::decode(bytes).err(),
            NumberArray::decode(bytes).err(),
            Odometry::decode(bytes).err(),
        ];
        format!("{said:?}")
    });
}

fn shipped(name: &str) -> Vec<u8> {
    let robots = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../robots");
    std::fs::read(robots.join(name)).unwrap()
}

/// A robot file and its MJCF, with a zero byte between them.
#[test]
fn robot_file() {
    let pair = |name: &str| {
        let [toml, mjcf] = ["robot.toml", "xml"].map(|end| shipped(&format!("{name}.{end}")));
        [toml, mjcf].join(&0)
    };
    let seeds = vec![pair("quadruped"), pair("xl330_pendulum")];
    fuzz("robot_file", seeds, 32 << 20, |bytes| {
        let cut = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        let (toml, mjcf) = bytes.split_at(cut);
        match RobotModel::from_bytes("a.robot.toml", toml, mjcf.get(1..).unwrap_or_default()) {
            Err(error) => error.to_string().chars().take(60).collect(),
            Ok(robot) => {
                let moments = robot.links().iter().map(|l| l.mass_kg);
                assert!(moments.into_iter().all(f64::is_finite), "a mass is not a number");
                "taken".into()
            }
        }
    });
}

/// Models of other people.
#[test]
fn robot_import() {
    let urdf = br#"<robot name="r"><link name="a"><inertial><mass value="1"/><origin xyz="0 0 0.1" rpy="0 0 1"/>
        <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <link name="b"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision></link>
        <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
        <limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"#;
    let seeds = vec![shipped("quadruped.xml"), shipped("xl330_pendulum.xml"), urdf.to_vec()];
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.xml");
    fuzz("robot_import", seeds, 64 << 20, |bytes| {
        std::fs::write(&file, bytes).unwrap();
        match import(&file, &ImportOptions::default()) {
            Err(error) => error.to_string().chars().take(60).collect(),
            // `import` has loaded what it wrote
            Ok(made) => format!("{} notes", made.notes.len()),
        }
    });
}
