//! What `rmw_zenoh_cpp` (0.2 and later: Jazzy, Kilted, Rolling) puts on zenoh: key expressions, attachments,
//! liveliness tokens.
//!
//! Sources: github.com/ros2/rmw_zenoh, `docs/design.md` (key expressions, tokens) and
//! `rmw_zenoh_cpp/src/detail/attachment_helpers.cpp`, `liveliness_utils.cpp`; type hashes by REP 2016
//! (github.com/ros-infrastructure/rep, `rep-2016.rst`). The tests work all of it out by hand once more.

/// A message type: its name in ROS, and the hash of its definition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MessageType {
    /// `package/msg/Name`.
    pub name: &'static str,
    /// `RIHS01_` and a SHA-256.
    pub hash: &'static str,
}

/// `sensor_msgs/msg/JointState`.
pub const JOINT_STATE: MessageType = MessageType {
    name: "sensor_msgs/msg/JointState",
    hash: "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
};
/// `sensor_msgs/msg/Imu`.
pub const IMU: MessageType = MessageType {
    name: "sensor_msgs/msg/Imu",
    hash: "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
};
/// `diagnostic_msgs/msg/DiagnosticArray`.
pub const DIAGNOSTIC_ARRAY: MessageType = MessageType {
    name: "diagnostic_msgs/msg/DiagnosticArray",
    hash: "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
};
/// `geometry_msgs/msg/Twist`.
pub const TWIST: MessageType = MessageType {
    name: "geometry_msgs/msg/Twist",
    hash: "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
};
/// `tf2_msgs/msg/TFMessage`.
pub const TF_MESSAGE: MessageType = MessageType {
    name: "tf2_msgs/msg/TFMessage",
    hash: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
};
/// `sensor_msgs/msg/BatteryState`.
pub const BATTERY_STATE: MessageType = MessageType {
    name: "sensor_msgs/msg/BatteryState",
    hash: "RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741",
};
/// `std_msgs/msg/String`.
pub const STRING: MessageType = MessageType {
    name: "std_msgs/msg/String",
    hash: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
};

/// `nav_msgs/msg/Odometry`.
pub const ODOMETRY: MessageType = MessageType {
    name: "nav_msgs/msg/Odometry",
    hash: "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
};

impl MessageType {
    /// As DDS writes it: `package::msg::dds_::Name_`.
    pub fn dds(&self) -> String {
        let mut parts = self.name.split('/');
        let mut next = || parts.next().unwrap_or_default();
        let (package, kind, name) = (next(), next(), next());
        format!("{package}::{kind}::dds_::{name}_")
    }
}

/// A topic in a domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Full name, `/` in front.
    pub name: String,
    /// What it carries.
    pub message: MessageType,
}

impl Topic {
    /// The key that its samples have.
    pub fn key(&self) -> String {
        let Self { domain, name, message } = self;
        let name = name.trim_matches('/');
        format!("{domain}/{name}/{}/{}", message.dds(), message.hash)
    }
}

/// A node of the ROS graph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Node {
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Id of its zenoh session, hexadecimal.
    pub session: String,
    /// Its name; it has no namespace and no enclave.
    pub name: String,
}

/// What a node does with a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// It publishes.
    Publisher,
    /// It listens.
    Subscriber,
}

/// Reliable, volatile, the last ten: every field at its default but the depth, and defaults are left out.
const QOS: &str = "::,10:,:,:,,";

impl Node {
    /// The token by which the node is seen.
    pub fn token(&self) -> String {
        let Self { domain, session, name } = self;
        format!("@ros2_lv/{domain}/{session}/0/0/NN/%/%/{name}")
    }

    /// The token by which its part in `topic` is seen. `entity` is another number for each.
    pub fn topic_token(&self, entity: u32, role: Role, topic: &Topic) -> String {
        let Self { domain, session, name } = self;
        let role = match role {
            Role::Publisher => "MP",
            Role::Subscriber => "MS",
        };
        let (mangled, dds) = (topic.name.replace('/', "%"), topic.message.dds());
        let hash = topic.message.hash;
        format!(
            "@ros2_lv/{domain}/{session}/0/{entity}/{role}/%/%/{name}/{mangled}/{dds}/{hash}/{QOS}"
        )
    }
}

/// Length of an attachment.
pub const ATTACHMENT_BYTES: usize = 8 + 8 + 1 + 16;

/// What comes with every sample; subscribers drop samples without it.
pub fn attachment(sequence: i64, unix_ns: i64, gid: [u8; 16]) -> [u8; ATTACHMENT_BYTES] {
    let mut out = [0; ATTACHMENT_BYTES];
    out[..8].copy_from_slice(&sequence.to_le_bytes());
    out[8..16].copy_from_slice(&unix_ns.to_le_bytes());
    // zenoh's serialisation of bytes: their number as a LEB128, one byte here, and the bytes.
    out[16] = 16;
    out[17..].copy_from_slice(&gid);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::{Value, json};
    use sha2::{Digest, Sha256};

    #[test]
    fn keys_of_the_published_examples() {
        // docs/design.md: the topic `chatter` of the demo nodes, alone and under the namespace /robot1.
        let string = MessageType {
            name: "std_msgs/msg/String",
            hash: "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
        };
        let key = |name: &str| {
            let name = name.to_owned();
            let topic = Topic { domain: 0, name, message: string };
            topic.key()
        };
        assert_eq!(
            key("/chatter"),
            "0/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
        assert_eq!(
            key("/robot1/chatter"),
            "0/robot1/chatter/std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
    }

    #[test]
    fn tokens_of_a_node_and_its_topics() {
        let node = Node {
            domain: 2,
            session: "aac3178e146ba6f1fc6e6a4085e77f21".to_owned(),
            name: "salamander".to_owned(),
        };
        assert_eq!(
            node.token(),
            "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/salamander"
        );
        let topic =
            Topic { domain: 2, name: "/robot1/joint_states".to_owned(), message: JOINT_STATE };
        assert_eq!(
            node.topic_token(11, Role::Publisher, &topic),
            "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/11/MP/%/%/salamander/%robot1%joint_states/\
             sensor_msgs::msg::dds_::JointState_/\
             RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e/::,10:,:,:,,"
        );
        let listens = node.topic_token(12, Role::Subscriber, &topic);
        assert!(listens.contains("/0/12/MS/"), "{listens}");
    }

    #[test]
    fn an_attachment_byte_by_byte() {
        let gid = [0xA0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];
        #[rustfmt::skip]
        let want = [
            42, 0, 0, 0, 0, 0, 0, 0,                       // sequence number 42
            0x87, 0xD6, 0x12, 0, 0, 0, 0, 0,               // 1 234 567 = 0x12D687 ns
            16,                                            // sixteen bytes follow
            0xA0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15,
        ];
        assert_eq!(attachment(42, 1_234_567, gid), want);
    }

    /// REP 2016: the SHA-256 of the definition as JSON, with everything it refers to, sorted by name.
    /// `fields` are (name, type id, capacity, nested type): 1 nested, 3 uint8, 6 int32, 7 uint32, 10 float32, 11
    /// float64, 15 boolean, 16 byte, 17 string; +48 an array, +144 a sequence.
    fn definition(name: &str) -> Value {
        let fields: &[(&str, u32, u32, &str)] = match name {
            "std_msgs/msg/String" => &[("data", 17, 0, "")],
            "builtin_interfaces/msg/Time" => &[("sec", 6, 0, ""), ("nanosec", 7, 0, "")],
            "std_msgs/msg/Header" => {
                &[("stamp", 1, 0, "builtin_interfaces/msg/Time"), ("frame_id", 17, 0, "")]
            }
            "geometry_msgs/msg/Vector3" => &[("x", 11, 0, ""), ("y", 11, 0, ""), ("z", 11, 0, "")],
            "geometry_msgs/msg/Point" => &[("x", 11, 0, ""), ("y", 11, 0, ""), ("z", 11, 0, "")],
            "geometry_msgs/msg/Pose" => &[
                ("position", 1, 0, "geometry_msgs/msg/Point"),
                ("orientation", 1, 0, "geometry_msgs/msg/Quaternion"),
            ],
            "geometry_msgs/msg/PoseWithCovariance" => {
                &[("pose", 1, 0, "geometry_msgs/msg/Pose"), ("covariance", 11 + 48, 36, "")]
            }
            "geometry_msgs/msg/TwistWithCovariance" => {
                &[("twist", 1, 0, "geometry_msgs/msg/Twist"), ("covariance", 11 + 48, 36, "")]
            }
            "nav_msgs/msg/Odometry" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("child_frame_id", 17, 0, ""),
                ("pose", 1, 0, "geometry_msgs/msg/PoseWithCovariance"),
                ("twist", 1, 0, "geometry_msgs/msg/TwistWithCovariance"),
            ],
            "geometry_msgs/msg/Quaternion" => {
                &[("x", 11, 0, ""), ("y", 11, 0, ""), ("z", 11, 0, ""), ("w", 11, 0, "")]
            }
            "geometry_msgs/msg/Transform" => &[
                ("translation", 1, 0, "geometry_msgs/msg/Vector3"),
                ("rotation", 1, 0, "geometry_msgs/msg/Quaternion"),
            ],
            "geometry_msgs/msg/TransformStamped" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("child_frame_id", 17, 0, ""),
                ("transform", 1, 0, "geometry_msgs/msg/Transform"),
            ],
            "tf2_msgs/msg/TFMessage" => {
                &[("transforms", 1 + 144, 0, "geometry_msgs/msg/TransformStamped")]
            }
            "sensor_msgs/msg/BatteryState" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("voltage", 10, 0, ""),
                ("temperature", 10, 0, ""),
                ("current", 10, 0, ""),
                ("charge", 10, 0, ""),
                ("capacity", 10, 0, ""),
                ("design_capacity", 10, 0, ""),
                ("percentage", 10, 0, ""),
                ("power_supply_status", 3, 0, ""),
                ("power_supply_health", 3, 0, ""),
                ("power_supply_technology", 3, 0, ""),
                ("present", 15, 0, ""),
                ("cell_voltage", 10 + 144, 0, ""),
                ("cell_temperature", 10 + 144, 0, ""),
                ("location", 17, 0, ""),
                ("serial_number", 17, 0, ""),
            ],
            "geometry_msgs/msg/Twist" => &[
                ("linear", 1, 0, "geometry_msgs/msg/Vector3"),
                ("angular", 1, 0, "geometry_msgs/msg/Vector3"),
            ],
            "sensor_msgs/msg/JointState" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("name", 17 + 144, 0, ""),
                ("position", 11 + 144, 0, ""),
                ("velocity", 11 + 144, 0, ""),
                ("effort", 11 + 144, 0, ""),
            ],
            "sensor_msgs/msg/Imu" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("orientation", 1, 0, "geometry_msgs/msg/Quaternion"),
                ("orientation_covariance", 11 + 48, 9, ""),
                ("angular_velocity", 1, 0, "geometry_msgs/msg/Vector3"),
                ("angular_velocity_covariance", 11 + 48, 9, ""),
                ("linear_acceleration", 1, 0, "geometry_msgs/msg/Vector3"),
                ("linear_acceleration_covariance", 11 + 48, 9, ""),
            ],
            "diagnostic_msgs/msg/KeyValue" => &[("key", 17, 0, ""), ("value", 17, 0, "")],
            "diagnostic_msgs/msg/DiagnosticStatus" => &[
                ("level", 16, 0, ""),
                ("name", 17, 0, ""),
                ("message", 17, 0, ""),
                ("hardware_id", 17, 0, ""),
                ("values", 1 + 144, 0, "diagnostic_msgs/msg/KeyValue"),
            ],
            "diagnostic_msgs/msg/DiagnosticArray" => &[
                ("header", 1, 0, "std_msgs/msg/Header"),
                ("status", 1 + 144, 0, "diagnostic_msgs/msg/DiagnosticStatus"),
            ],
            other => panic!("{other} has no definition here"),
        };
        let field = |(name, id, capacity, nested): &(&str, u32, u32, &str)| json!({ "name": name, "id": id, "capacity": capacity, "nested": nested });
        json!({ "name": name, "fields": fields.iter().map(field).collect::<Vec<_>>() })
    }

    fn text(definition: &Value) -> String {
        let fields = definition["fields"].as_array().unwrap().iter().map(|f| {
            format!(
                r#"{{"name": {}, "type": {{"type_id": {}, "capacity": {}, "string_capacity": 0, "nested_type_name": {}}}}}"#,
                f["name"], f["id"], f["capacity"], f["nested"]
            )
        });
        let fields: Vec<String> = fields.collect();
        format!(r#"{{"type_name": {}, "fields": [{}]}}"#, definition["name"], fields.join(", "))
    }

    fn referred(name: &str, into: &mut std::collections::BTreeSet<String>) {
        for field in definition(name)["fields"].as_array().unwrap() {
            let nested = field["nested"].as_str().unwrap();
            if !nested.is_empty() && into.insert(nested.to_owned()) {
                referred(nested, into);
            }
        }
    }

    fn hash(name: &str) -> String {
        let mut others = std::collections::BTreeSet::new();
        referred(name, &mut others);
        let others: Vec<String> = others.iter().map(|n| text(&definition(n))).collect();
        let whole = format!(
            r#"{{"type_description": {}, "referenced_type_descriptions": [{}]}}"#,
            text(&definition(name)),
            others.join(", ")
        );
        let digest = Sha256::digest(whole.as_bytes());
        let hex: String = digest.iter().map(|b| format!("{b:02x}")).collect();
        format!("RIHS01_{hex}")
    }

    #[test]
    fn type_hashes_are_those_of_the_definitions() {
        // The published one shows that this is the rule.
        assert_eq!(
            hash("std_msgs/msg/String"),
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        );
        for message in
            [JOINT_STATE, IMU, DIAGNOSTIC_ARRAY, TWIST, TF_MESSAGE, BATTERY_STATE, STRING, ODOMETRY]
        {
            assert_eq!(hash(message.name), message.hash, "{}", message.name);
        }
    }
}
