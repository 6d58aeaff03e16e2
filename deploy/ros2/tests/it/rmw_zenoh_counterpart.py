"""A node of ROS 2 over zenoh that shares no code with caudata: zenoh-ros2-sdk, with ROS's own message files.

    rmw_zenoh_counterpart.py ROUTER_PORT

Publishes /robot1/cmd_vel until it is stopped; once it has heard the other topics it says, as one line of
JSON, what it sees of the graph and the fields of the last message of each.
"""

import json
import sys
import threading
import time
from pathlib import Path

import numpy as np
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, discovery
from zenoh_ros2_sdk.message_registry import get_registry

TOPICS = {
    "joint_states": "sensor_msgs/msg/JointState",
    "imu/data": "sensor_msgs/msg/Imu",
    "tf": "tf2_msgs/msg/TFMessage",
    "odom": "nav_msgs/msg/Odometry",
    "battery_state": "sensor_msgs/msg/BatteryState",
    "robot_description": "std_msgs/msg/String",
    "diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
# No wheel has these files of ROS; they have a line, and four.
FILES = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "nav_msgs/msg/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
}
HELD = ("TransformStamped", "PoseWithCovariance", "TwistWithCovariance")
ROUTER = {"router_ip": "127.0.0.1", "router_port": int(sys.argv[1])}


def plain(value):
    """A message as JSON can say it."""
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if not name.startswith("__")]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(item) for item in value]
    value = value.item() if isinstance(value, np.generic) else value
    return None if value != value else value  # JSON knows no NaN


def graph():
    """Topic, node, type and hash of the type of every publisher and subscription; its own hashes it works out."""
    ends = []
    for name, _ in discovery.get_topic_names_and_types(timeout=5.0, **ROUTER):
        info = discovery.get_topic_info(name, timeout=5.0, verbose=True, **ROUTER)
        ends += [(name, end.node_name, end.topic_type, end.type_hash) for end in info.publishers + info.subscribers]
    return ends


def main():
    registry = get_registry(str(Path(sys.prefix) / "share"))
    heard, every = {}, threading.Event()

    def listen(topic):
        def on_message(message):
            heard[topic] = plain(message)
            if len(heard) == len(TOPICS):
                every.set()

        # Diagnostics have no namespace in ROS.
        name = "/" + topic if topic == "diagnostics" else "/robot1/" + topic
        if TOPICS[topic] in FILES:
            # Not before there is a session: this would open one to another router.
            for held in HELD:
                registry.load_message_type("geometry_msgs/msg/" + held)
        return ROS2Subscriber(name, TOPICS[topic], on_message, FILES.get(TOPICS[topic]), **ROUTER)

    subscriptions = [listen(topic) for topic in TOPICS]
    velocity = ROS2Publisher("/robot1/cmd_vel", "geometry_msgs/msg/Twist", **ROUTER)
    vector = velocity.session_mgr.store.types["geometry_msgs/msg/Vector3"]
    said = False
    while subscriptions:
        velocity.publish(linear=vector(0.25, -0.125, 0.0), angular=vector(0.0, 0.0, 0.5))
        if every.is_set() and not said:
            said = True
            print(json.dumps({"graph": graph(), "heard": heard}), flush=True)
        time.sleep(0.02)


main()
