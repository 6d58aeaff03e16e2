//! The whole way of `door.rs` with a node on the other side that is not ours: `zenoh-ros2-sdk`, which speaks the
//! keys, tokens and attachments of `rmw_zenoh_cpp`, reads ROS's own message files, and shares no code with us.

use std::io::{BufRead, BufReader};
use std::process::{Child, Stdio};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use caudata_deploy::command_link::CommandLink;
use serde_json::{Value, json};

use crate::door::{command_link, door_to, endpoint, node, tick};
use crate::ros2::counterpart;

/// Only a counterpart that hears nothing takes as long.
const PATIENCE: Duration = Duration::from_secs(120);

struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "installs ROS 2: make test-faults"]
fn a_node_that_is_not_ours_lists_the_robot_reads_it_and_drives_it() {
    let endpoint = endpoint();
    let port = endpoint.rsplit(':').next().unwrap();
    let Some(mut command) = counterpart("rmw_zenoh_counterpart.py") else {
        return;
    };
    let _router = node("router", &endpoint);
    let mut door = door_to(&endpoint);
    let (mut robot, mut commands) = command_link();
    let child = command.arg(port).env("ROS_DOMAIN_ID", "3").stdout(Stdio::piped());
    let mut child = Ended(child.spawn().unwrap());
    let said = BufReader::new(child.0.stdout.take().unwrap());
    let (sender, lines) = mpsc::sync_channel(1);
    std::thread::spawn(move || {
        said.lines().map_while(Result::ok).try_for_each(|line| sender.send(line))
    });

    let began = Instant::now();
    let (mut saw, mut driven) = (None, false);
    while saw.is_none() || !driven {
        assert!(began.elapsed() < PATIENCE, "driven: {driven}, saw: {saw:?}");
        door.publish(&tick()).unwrap();
        commands.pass_on(door.velocity());
        driven |= robot.view().command == [0.25, -0.125, 0.5];
        saw = saw.or(lines.try_recv().ok());
        std::thread::sleep(Duration::from_millis(20));
    }
    let saw: Value = serde_json::from_str(&saw.unwrap()).unwrap();
    lists_the_robot(&saw["graph"]);
    reads_the_robot(&saw["heard"]);
}

/// Every topic of ours has its type, and the hash that the other side works out from ROS's message files.
fn lists_the_robot(graph: &Value) {
    let ends = graph.as_array().unwrap();
    for (topic, kind) in [
        ("/robot1/joint_states", "sensor_msgs/msg/JointState"),
        ("/robot1/imu/data", "sensor_msgs/msg/Imu"),
        ("/robot1/tf", "tf2_msgs/msg/TFMessage"),
        ("/robot1/odom", "nav_msgs/msg/Odometry"),
        ("/robot1/battery_state", "sensor_msgs/msg/BatteryState"),
        ("/robot1/robot_description", "std_msgs/msg/String"),
        ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
        ("/robot1/cmd_vel", "geometry_msgs/msg/Twist"),
    ] {
        let of_topic = |end: &&Value| end[0] == topic;
        let (ours, theirs): (Vec<&Value>, Vec<&Value>) =
            ends.iter().filter(of_topic).partition(|end| end[1] == "salamander");
        assert_eq!((ours.len(), theirs.len()), (1, 1), "{topic}: {graph:#}");
        assert_eq!(ours[0][2], kind);
        assert_eq!(ours[0][3], theirs[0][3], "{topic}: hash of the type");
    }
}

fn reads_the_robot(heard: &Value) {
    let state = &heard["joint_states"];
    assert_eq!(state["name"][3], "joint_3");
    let position = state["position"][3].as_f64().unwrap();
    assert!((position - 0.03).abs() < 1e-6, "{position}");
    assert_eq!((&state["velocity"][15], &state["effort"][15]), (&json!(0.5), &json!(0.5)));
    assert!(state["header"]["stamp"]["sec"].as_i64().unwrap() > 1_600_000_000);
    let imu = &heard["imu/data"];
    assert_eq!(imu["header"]["frame_id"], "imu");
    assert_eq!(imu["angular_velocity"], json!({ "x": 0.125, "y": 0.0, "z": -0.5 }));
    assert_eq!(imu["linear_acceleration"], json!({ "x": 0.0, "y": 0.0, "z": 9.75 }));
    let frame = &heard["tf"]["transforms"][0];
    let outer = frame["header"]["frame_id"].as_str().unwrap();
    let place = frame["transform"]["translation"]["x"].as_f64();
    assert!(!outer.is_empty() && place.is_some(), "{frame}");
    assert_eq!(heard["odom"]["header"]["frame_id"], "odom");
    let unknown = &heard["odom"]["pose"]["covariance"][14];
    assert_eq!(unknown, &json!(caudata_deploy::odometry::UNKNOWN));
    assert_eq!(heard["battery_state"]["voltage"], json!(12.0));
    let description = heard["robot_description"]["data"].as_str().unwrap();
    assert!(description.contains("<robot name="), "{description}");
    let status = &heard["diagnostics"]["status"][0];
    assert_eq!((&status["level"], &status["message"]), (&json!(0), &json!("Walk")));
}
