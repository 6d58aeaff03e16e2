//! The whole way: ticks of a robot to a ROS node's subscriptions, and its velocity to the robot's command
//! link. The node is played by a plain zenoh session that knows nothing but keys and bytes.

use std::time::Duration;

use caudata_deploy::command_link::{CommandLink, LinkKey, UdpLink};
use caudata_deploy::motion::Stage;
use caudata_deploy::tap::Tick;
use caudata_model::RobotModel;
use caudata_ros2::door::{Appearance, Commands, Door, settings};
use caudata_runlog::ros::messages::{
    BatteryState, DiagnosticArray, Imu, JointState, Odometry, Text, TfMessage, Twist,
};
use zenoh::{Config, Wait};

const JOINTS: &str = "3/robot1/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e";
const IMU: &str = "3/robot1/imu/data/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b";
const DIAGNOSTICS: &str = "3/diagnostics/diagnostic_msgs::msg::dds_::DiagnosticArray_/RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e";
const VELOCITY: &str = "3/robot1/cmd_vel/geometry_msgs::msg::dds_::Twist_/RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a";

const FRAMES: &str = "3/robot1/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
const ODOMETRY: &str = "3/robot1/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0";
const BATTERY: &str = "3/robot1/battery_state/sensor_msgs::msg::dds_::BatteryState_/RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741";
const DESCRIPTION: &str = "3/robot1/robot_description/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

pub(crate) fn tick() -> Tick {
    Tick {
        time_s: 1.0,
        pos_rad: std::array::from_fn::<f32, 16, _>(|i| 0.01 * i as f32).into(),
        vel_radps: [0.5; 16].into(),
        current_a: [0.25; 16].into(),
        target_rad: [0.0; 16].into(),
        gyro_radps: [0.125, 0.0, -0.5],
        acc_mps2: [0.0, 0.0, 9.75],
        gravity: [0.0, 0.0, -1.0],
        going: Some([0.25, 0.0, -0.5]),
        supply_v: 12.0,
        stage: Stage::Walk,
        fault: None,
        policy_version: 7,
        overruns: 0,
        late_readings: 0,
        hottest_c: 40,
    }
}

/// A free port of this host.
pub(crate) fn endpoint() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/{}", listener.local_addr().unwrap())
}

pub(crate) fn node(mode: &str, listen: &str) -> zenoh::Session {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", format!("{mode:?}")),
        ("listen/endpoints", format!("[{listen:?}]")),
        ("scouting/multicast/enabled", "false".to_owned()),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

fn robot() -> RobotModel {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../../robots/polymander.robot.toml");
    RobotModel::load(file.as_ref()).unwrap()
}

/// The door of a robot called `robot1` in domain 3.
pub(crate) fn door_to(endpoint: &str) -> Door {
    let appearance = Appearance {
        domain: 3,
        node: "salamander".to_owned(),
        prefix: "/robot1".to_owned(),
        imu_frame: "imu".to_owned(),
        joints: (0..16).map(|i| format!("joint_{i}")).collect(),
        torque_nm_per_a: vec![2.0; 16],
        robot: robot().into(),
    };
    Door::open(settings(&[endpoint.to_owned()], &[]).unwrap(), appearance).unwrap()
}

/// Both ends of a command link.
pub(crate) fn command_link() -> (UdpLink, Commands) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("link.key");
    std::fs::write(&file, [7; 32]).unwrap();
    let private = std::os::unix::fs::PermissionsExt::from_mode(0o600);
    std::fs::set_permissions(&file, private).unwrap();
    let key = || LinkKey::read(&file).unwrap();
    let robot = UdpLink::listen("127.0.0.1:0".parse().unwrap(), key(), false).unwrap();
    let commands = Commands::to(robot.address(), key()).unwrap();
    (robot, commands)
}

#[test]
fn a_node_sees_the_robot_and_drives_it() {
    let endpoint = endpoint();
    let ros = node("peer", &endpoint);
    let heard = [JOINTS, IMU, DIAGNOSTICS, FRAMES, BATTERY, DESCRIPTION, ODOMETRY]
        .map(|key| ros.declare_subscriber(key).wait().unwrap());
    let mut door = door_to(&endpoint);

    // Until the subscriptions have found their way nothing arrives; a person would see the topic appear.
    let mut first = |index: usize| loop {
        door.publish(&tick()).unwrap();
        if let Ok(Some(sample)) = heard[index].recv_timeout(Duration::from_millis(100)) {
            break sample;
        }
    };
    let sample = first(0);
    let state = JointState::decode(&sample.payload().to_bytes()).unwrap();
    assert_eq!((state.name.len(), state.name[3].as_str()), (16, "joint_3"));
    assert!((state.position[3] - 0.03).abs() < 1e-6);
    // 0.25 A at 2 N·m/A.
    assert_eq!((state.velocity[15], state.effort[15]), (0.5, 0.5));
    assert!(state.header.stamp_ns > 1_600_000_000_000_000_000);
    // 33 bytes: number, time, and who.
    let attachment = sample.attachment().unwrap().to_bytes();
    assert_eq!((attachment.len(), attachment[16]), (33, 16));
    assert!(i64::from_le_bytes(attachment[..8].try_into().unwrap()) > 0);
    let time = i64::from_le_bytes(attachment[8..16].try_into().unwrap());
    assert_eq!(time, state.header.stamp_ns);

    let sensed = Imu::decode(&first(1).payload().to_bytes()).unwrap();
    assert_eq!((sensed.gyro_radps, sensed.acc_mps2), ([0.125, 0.0, -0.5], [0.0, 0.0, 9.75]));
    assert_eq!((sensed.orientation_wxyz, sensed.header.frame.as_str()), (None, "imu"));
    let said = DiagnosticArray::decode(&first(2).payload().to_bytes()).unwrap();
    assert_eq!((said.status[0].level, said.status[0].message.as_str()), (0, "Walk"));

    // One frame for each link, the first one's in `odom`, and the IMU; 0.01·i rad turn each link about its joint's axis.
    let frames = TfMessage::decode(&first(3).payload().to_bytes()).unwrap();
    let robot = robot();
    assert_eq!(frames.transforms.len(), robot.links().len() + 1);
    for (i, joint) in robot.actuated_names().into_iter().enumerate() {
        let joint = robot.joints().iter().find(|j| j.name == joint).unwrap();
        let link = &robot.links()[joint.child_link].name;
        let frame = frames.transforms.iter().find(|frame| frame.child == *link);
        let turned = frame.unwrap().orientation_xyzw[3];
        assert!((turned - (0.005 * i as f64).cos()).abs() < 1e-6, "{link}");
    }
    let odometry = Odometry::decode(&first(6).payload().to_bytes()).unwrap();
    let base = &robot.links()[0].name;
    assert_eq!((odometry.header.frame.as_str(), &odometry.child), ("odom", base));
    let in_odom = frames.transforms.iter().find(|frame| frame.child == *base);
    assert_eq!(in_odom.unwrap().header.frame, "odom");
    // ticks of one time: nothing passes. The robot turns by −0.5 rad/s, which a tilted root link sees as well.
    assert_eq!(odometry.position_m[..2], [0.0, 0.0]);
    let [x, y, z] = odometry.angular_radps;
    assert!((x * x + y * y + z * z).sqrt() > 0.5, "{odometry:?}");
    assert!(odometry.twist_covariance.0[0] > 0.0 && odometry.pose_covariance.0[2] > 1e3);
    let battery = BatteryState::decode(&first(4).payload().to_bytes()).unwrap();
    assert_eq!(battery.voltage_v, 12.0);
    let description = Text::decode(&first(5).payload().to_bytes()).unwrap();
    assert_eq!(description.data, robot.to_urdf());

    // The graph: a node, seven publishers, one subscriber, as `ros2 topic list` finds them.
    let tokens = ros.liveliness().get("@ros2_lv/3/**").wait().unwrap();
    let mut seen: Vec<String> = tokens
        .iter()
        .filter_map(|reply| Some(reply.result().ok()?.key_expr().to_string()))
        .collect();
    seen.sort();
    assert_eq!(seen.len(), 9, "{seen:#?}");
    assert!(seen.iter().any(|t| t.contains("/NN/%/%/salamander")));
    assert!(seen.iter().any(|t| t.contains("/MS/%/%/salamander/%robot1%cmd_vel/")));

    // Velocities: from the topic to the robot's end of the command link, authenticated.
    let (mut robot, mut commands) = command_link();
    assert_eq!(door.velocity(), None);
    let twist = Twist { linear_mps: [0.25, -0.125, 0.0], angular_radps: [0.0, 0.0, 0.5] };
    ros.put(VELOCITY, vec![1, 2, 3]).wait().unwrap();
    while robot.view().command != [0.25, -0.125, 0.5] {
        ros.put(VELOCITY, twist.encode()).wait().unwrap();
        commands.pass_on(door.velocity());
        std::thread::sleep(Duration::from_millis(5));
    }
    // ROS falls silent: nothing is passed on any more.
    while door.velocity().is_some() {
        std::thread::sleep(Duration::from_millis(20));
    }
}
