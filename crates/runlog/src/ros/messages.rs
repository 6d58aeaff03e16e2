//! The ROS 2 messages that a robot's log is made of, field by field as `common_interfaces` defines them.

use super::cdr::{Cdr, CdrError, Reader, Writer};

/// `decode` and `encode` of a message, and the name of its type.
macro_rules! whole {
    ($message:ident $(= $name:literal)?) => {
        impl $message {
            $(
                /// Type name in MCAP files.
                pub const TYPE: &'static str = $name;
            )?

            /// Reads the CDR form.
            pub fn decode(bytes: &[u8]) -> Result<Self, CdrError> {
                Reader::new(bytes)?.get()
            }

            /// Writes the CDR form.
            pub fn encode(&self) -> Vec<u8> {
                let mut w = Writer::default();
                self.write(&mut w);
                w.finish()
            }
        }
    };
}

/// A struct whose fields stand in the message one after another.
macro_rules! plain {
    ($(#[$about:meta])* $name:ident { $($(#[$field_about:meta])* $field:ident: $kind:ty,)* }) => {
        $(#[$about])*
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct $name {
            $($(#[$field_about])* pub $field: $kind,)*
        }

        impl Cdr for $name {
            fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
                Ok(Self { $($field: r.get()?,)* })
            }

            fn write(&self, w: &mut Writer) {
                $(w.put(&self.$field);)*
            }
        }
    };
}

/// `builtin_interfaces/Time` in nanoseconds, and the frame: `std_msgs/Header`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Header {
    /// Nanoseconds; 0: not stamped.
    pub stamp_ns: i64,
    /// Frame.
    pub frame: String,
}

impl Cdr for Header {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let (s, ns): (i32, u32) = r.get()?;
        Ok(Self { stamp_ns: i64::from(s) * 1_000_000_000 + i64::from(ns), frame: r.get()? })
    }

    fn write(&self, w: &mut Writer) {
        w.put(&(self.stamp_ns.div_euclid(1_000_000_000) as i32));
        w.put(&(self.stamp_ns.rem_euclid(1_000_000_000) as u32));
        w.put(&self.frame);
    }
}

plain! {
    /// `sensor_msgs/msg/JointState`. Lists are as long as `name`, or empty.
    JointState {
        /// Stamp.
        header: Header,
        /// Joints.
        name: Vec<String>,
        /// rad.
        position: Vec<f64>,
        /// rad/s.
        velocity: Vec<f64>,
        /// N·m.
        effort: Vec<f64>,
    }
}
whole!(JointState = "sensor_msgs/msg/JointState");

/// `sensor_msgs/msg/Imu`; covariances are not kept, but for "no orientation".
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Imu {
    /// Stamp.
    pub header: Header,
    /// world_from_imu, w, x, y, z; `None` where the sensor gives none (covariance −1).
    pub orientation_wxyz: Option<[f64; 4]>,
    /// rad/s.
    pub gyro_radps: [f64; 3],
    /// m/s².
    pub acc_mps2: [f64; 3],
}
whole!(Imu = "sensor_msgs/msg/Imu");

impl Cdr for Imu {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let header = r.get()?;
        let [x, y, z, w]: [f64; 4] = r.get()?;
        let covariance: [f64; 9] = r.get()?;
        let gyro_radps = r.get()?;
        r.get::<[f64; 9]>()?;
        let acc_mps2 = r.get()?;
        r.get::<[f64; 9]>()?;
        let unit = (x * x + y * y + z * z + w * w - 1.0).abs() < 0.1;
        Ok(Self {
            header,
            orientation_wxyz: (covariance[0] != -1.0 && unit).then_some([w, x, y, z]),
            gyro_radps,
            acc_mps2,
        })
    }

    fn write(&self, out: &mut Writer) {
        let [w, x, y, z] = self.orientation_wxyz.unwrap_or([1.0, 0.0, 0.0, 0.0]);
        let mut covariance = [0.0; 9];
        if self.orientation_wxyz.is_none() {
            covariance[0] = -1.0;
        }
        out.put(&self.header).put(&[x, y, z, w]).put(&covariance);
        out.put(&self.gyro_radps).put(&[0.0; 9]);
        out.put(&self.acc_mps2).put(&[0.0; 9]);
    }
}

/// `sensor_msgs/msg/BatteryState`: its voltage.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BatteryState {
    /// Stamp.
    pub header: Header,
    /// V.
    pub voltage_v: f32,
}
whole!(BatteryState = "sensor_msgs/msg/BatteryState");

impl Cdr for BatteryState {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        Ok(Self { header: r.get()?, voltage_v: r.get()? })
    }

    /// What is not known is NaN, as the message asks for.
    fn write(&self, w: &mut Writer) {
        w.put(&self.header).put(&self.voltage_v);
        for _ in 0..6 {
            w.put(&f32::NAN); // temperature, current, charge, capacity, design capacity, percentage
        }
        for status in [0u8, 0, 0, 1] {
            w.put(&status); // status, health, technology: unknown; present
        }
        let (cells, text) = (Vec::<f32>::new(), String::new());
        w.put(&cells).put(&cells).put(&text).put(&text);
    }
}

/// `geometry_msgs/msg/PoseStamped`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseStamped {
    /// Stamp.
    pub header: Header,
    /// m.
    pub position_m: [f64; 3],
    /// w, x, y, z.
    pub orientation_wxyz: [f64; 4],
}
whole!(PoseStamped = "geometry_msgs/msg/PoseStamped");

impl Cdr for PoseStamped {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let (header, position_m) = r.get()?;
        let [x, y, z, w] = r.get()?;
        Ok(Self { header, position_m, orientation_wxyz: [w, x, y, z] })
    }

    fn write(&self, out: &mut Writer) {
        let [w, x, y, z] = self.orientation_wxyz;
        out.put(&self.header).put(&self.position_m);
        out.put(&[x, y, z, w]);
    }
}

plain! {
    /// `geometry_msgs/msg/TwistStamped`.
    TwistStamped {
        /// Stamp.
        header: Header,
        /// m/s.
        linear_mps: [f64; 3],
        /// rad/s.
        angular_radps: [f64; 3],
    }
}
whole!(TwistStamped = "geometry_msgs/msg/TwistStamped");

plain! {
    /// `geometry_msgs/msg/TransformStamped`.
    TransformStamped {
        /// Stamp, and the outer frame.
        header: Header,
        /// The inner frame.
        child: String,
        /// Origin of the inner frame in the outer one, m.
        position_m: [f64; 3],
        /// outer_from_inner, x, y, z, w.
        orientation_xyzw: [f64; 4],
    }
}

plain! {
    /// `tf2_msgs/msg/TFMessage`: where frames are.
    TfMessage {
        /// One for each inner frame.
        transforms: Vec<TransformStamped>,
    }
}
whole!(TfMessage = "tf2_msgs/msg/TFMessage");

plain! {
    /// `nav_msgs/msg/Odometry`.
    Odometry {
        /// Stamp, and the frame of the pose.
        header: Header,
        /// The frame of the velocities.
        child: String,
        /// m.
        position_m: [f64; 3],
        /// x, y, z, w.
        orientation_xyzw: [f64; 4],
        /// Covariance of the pose.
        pose_covariance: Covariance,
        /// In the child's frame, m/s.
        linear_mps: [f64; 3],
        /// In the child's frame, rad/s.
        angular_radps: [f64; 3],
        /// Covariance of the velocities.
        twist_covariance: Covariance,
    }
}
whole!(Odometry = "nav_msgs/msg/Odometry");

/// Variances of x, y, z and the turns about these; what stands between them is 0, and not read. All 0: not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Covariance(pub [f64; 6]);

impl Cdr for Covariance {
    fn read(r: &mut Reader<'_>) -> Result<Self, CdrError> {
        let all = r.get::<[f64; 36]>()?;
        Ok(Self(std::array::from_fn(|i| all[7 * i])))
    }

    fn write(&self, w: &mut Writer) {
        let all: [f64; 36] = std::array::from_fn(|i| if i % 7 == 0 { self.0[i / 7] } else { 0.0 });
        w.put(&all);
    }
}

plain! {
    /// `std_msgs/msg/String`.
    Text {
        /// The text.
        data: String,
    }
}
whole!(Text = "std_msgs/msg/String");

plain! {
    /// `std_msgs/msg/Float64`.
    Number {
        /// The number.
        data: f64,
    }
}
whole!(Number = "std_msgs/msg/Float64");

plain! {
    /// `std_msgs/msg/Float64MultiArray`.
    NumberArray {
        /// Label, size and stride of each dimension.
        dimensions: Vec<((String, u32), u32)>,
        /// Where the data begin.
        offset: u32,
        /// The numbers.
        data: Vec<f64>,
    }
}
whole!(NumberArray = "std_msgs/msg/Float64MultiArray");

plain! {
    /// `trajectory_msgs/msg/JointTrajectoryPoint`. Lists are as long as the joints, or empty.
    TrajectoryPoint {
        /// rad.
        position: Vec<f64>,
        /// rad/s.
        velocity: Vec<f64>,
        /// rad/s².
        acceleration: Vec<f64>,
        /// N·m.
        effort: Vec<f64>,
        /// Time from the start: seconds, nanoseconds.
        after: (i32, u32),
    }
}

plain! {
    /// `trajectory_msgs/msg/JointTrajectory`.
    JointTrajectory {
        /// When it starts; 0: at once.
        header: Header,
        /// Joints.
        name: Vec<String>,
        /// In the order of time.
        points: Vec<TrajectoryPoint>,
    }
}
whole!(JointTrajectory = "trajectory_msgs/msg/JointTrajectory");

plain! {
    /// `geometry_msgs/msg/Twist`.
    Twist {
        /// m/s.
        linear_mps: [f64; 3],
        /// rad/s.
        angular_radps: [f64; 3],
    }
}
whole!(Twist);

plain! {
    /// `diagnostic_msgs/msg/DiagnosticStatus`.
    DiagnosticStatus {
        /// [`DiagnosticStatus::OK`] and following.
        level: u8,
        /// What it is about.
        name: String,
        /// How it is, in words.
        message: String,
        /// Which robot.
        hardware_id: String,
        /// Figures, name and value.
        values: Vec<(String, String)>,
    }
}

impl DiagnosticStatus {
    /// In order.
    pub const OK: u8 = 0;
    /// Not in order.
    pub const ERROR: u8 = 2;
}

plain! {
    /// `diagnostic_msgs/msg/DiagnosticArray`.
    DiagnosticArray {
        /// Stamp.
        header: Header,
        /// One for each part.
        status: Vec<DiagnosticStatus>,
    }
}
whole!(DiagnosticArray = "diagnostic_msgs/msg/DiagnosticArray");

const HEADER: &str = "
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
const QUATERNION: &str = "
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
";
const VECTOR: &str = "
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
";

/// The definition of a message type with everything that it holds (encoding `ros2msg`); `None` for types that
/// are not written here.
pub fn schema(type_name: &str) -> Option<String> {
    let (fields, held): (&str, &[&str]) = match type_name {
        JointState::TYPE => (
            "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
            &[HEADER],
        ),
        Imu::TYPE => (
            "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance",
            &[HEADER, QUATERNION, VECTOR],
        ),
        BatteryState::TYPE => (
            "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\nfloat32 current\nfloat32 charge\nfloat32 capacity\nfloat32 design_capacity\nfloat32 percentage\nuint8 power_supply_status\nuint8 power_supply_health\nuint8 power_supply_technology\nbool present\nfloat32[] cell_voltage\nfloat32[] cell_temperature\nstring location\nstring serial_number",
            &[HEADER],
        ),
        PoseStamped::TYPE => (
            "std_msgs/Header header\ngeometry_msgs/Pose pose\n================================================================================\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n================================================================================\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z",
            &[HEADER, QUATERNION],
        ),
        TwistStamped::TYPE => (
            "std_msgs/Header header\ngeometry_msgs/Twist twist\n================================================================================\nMSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
            &[HEADER, VECTOR],
        ),
        TfMessage::TYPE => (
            "geometry_msgs/TransformStamped[] transforms\n================================================================================\nMSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n================================================================================\nMSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
            &[HEADER, QUATERNION, VECTOR],
        ),
        Odometry::TYPE => (
            "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n================================================================================\nMSG: geometry_msgs/PoseWithCovariance\ngeometry_msgs/Pose pose\nfloat64[36] covariance\n================================================================================\nMSG: geometry_msgs/TwistWithCovariance\ngeometry_msgs/Twist twist\nfloat64[36] covariance\n================================================================================\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n================================================================================\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n================================================================================\nMSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
            &[HEADER, QUATERNION, VECTOR],
        ),
        DiagnosticArray::TYPE => (
            "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n================================================================================\nMSG: diagnostic_msgs/DiagnosticStatus\nbyte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n================================================================================\nMSG: diagnostic_msgs/KeyValue\nstring key\nstring value",
            &[HEADER],
        ),
        Text::TYPE => ("string data", &[]),
        Number::TYPE => ("float64 data", &[]),
        _ => return None,
    };
    Some(format!("{fields}{}", held.concat()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header() -> Header {
        Header { stamp_ns: 1_500_000_002, frame: "b".to_owned() }
    }

    /// 1.5 s and 2 ns, frame "b", one joint "hip" at 1 rad, no speeds, no efforts; laid out by hand.
    #[test]
    fn golden_bytes_of_a_joint_state() {
        let state = JointState {
            header: header(),
            name: vec!["hip".to_owned()],
            position: vec![1.0],
            velocity: vec![],
            effort: vec![],
        };
        #[rustfmt::skip]
        let want: &[u8] = &[
            0, 1, 0, 0,                         // little endian
            1, 0, 0, 0,  0x02, 0x65, 0xcd, 0x1d, // 1 s, 500 000 002 ns
            2, 0, 0, 0,  b'b', 0, 0, 0,          // "b" and two of padding
            1, 0, 0, 0,                          // one name
            4, 0, 0, 0,  b'h', b'i', b'p', 0,    // behind the header: 28 bytes
            1, 0, 0, 0,                          // one position: 32 bytes, so no padding
            0, 0, 0, 0, 0, 0, 0xf0, 0x3f,
            0, 0, 0, 0,  0, 0, 0, 0,             // none, none
        ];
        assert_eq!(state.encode(), want);
        assert_eq!(JointState::decode(want).unwrap(), state);
        for cut in 0..want.len() {
            assert!(JointState::decode(&want[..cut]).is_err(), "{cut} bytes are no message");
        }
    }

    #[test]
    fn every_message_reads_as_written() {
        let imu = Imu {
            header: header(),
            orientation_wxyz: Some([0.5, 0.5, -0.5, 0.5]),
            gyro_radps: [1.0, 2.0, 3.0],
            acc_mps2: [4.0, 5.0, 6.0],
        };
        assert_eq!(Imu::decode(&imu.encode()).unwrap(), imu);
        // frame "b" ends at 14, padded to 16; 37 numbers follow
        assert_eq!(imu.encode().len(), 4 + 16 + 37 * 8);
        let blind = Imu { orientation_wxyz: None, ..imu };
        assert_eq!(Imu::decode(&blind.encode()).unwrap(), blind);
        let battery = BatteryState { header: header(), voltage_v: 12.5 };
        assert_eq!(BatteryState::decode(&battery.encode()).unwrap(), battery);
        // 16, seven numbers of 4, four bytes, two empty lists, two empty texts (4 + 1, padded, 4 + 1)
        assert_eq!(battery.encode().len(), 4 + 16 + 28 + 4 + 8 + 8 + 5);
        let pose = PoseStamped {
            header: header(),
            position_m: [1.0, 2.0, 3.0],
            orientation_wxyz: [1.0, 0.0, 0.0, 0.0],
        };
        assert_eq!(PoseStamped::decode(&pose.encode()).unwrap(), pose);
        let twist = TwistStamped {
            header: header(),
            linear_mps: [1.0, 2.0, 3.0],
            angular_radps: [0.1, 0.2, 0.3],
        };
        assert_eq!(TwistStamped::decode(&twist.encode()).unwrap(), twist);
        // before the epoch, too
        let early = Header { stamp_ns: -1, frame: String::new() };
        let twist = TwistStamped { header: early.clone(), ..twist };
        assert_eq!(TwistStamped::decode(&twist.encode()).unwrap().header, early);
    }

    /// 1.5 s and 2 ns, frame "b", one status: error, "hip", "hot", no hardware, one figure; laid out by hand.
    #[test]
    fn golden_bytes_of_diagnostics() {
        let diagnostics = DiagnosticArray {
            header: header(),
            status: vec![DiagnosticStatus {
                level: DiagnosticStatus::ERROR,
                name: "hip".to_owned(),
                message: "hot".to_owned(),
                hardware_id: String::new(),
                values: vec![("T".to_owned(), "69".to_owned())],
            }],
        };
        #[rustfmt::skip]
        let want: &[u8] = &[
            0, 1, 0, 0,
            1, 0, 0, 0,  0x02, 0x65, 0xcd, 0x1d,
            2, 0, 0, 0,  b'b', 0, 0, 0,          // "b" and two of padding: 16 bytes
            1, 0, 0, 0,                          // one status: 20
            2, 0, 0, 0,                          // error, three of padding: 24
            4, 0, 0, 0,  b'h', b'i', b'p', 0,    // 32
            4, 0, 0, 0,  b'h', b'o', b't', 0,    // 40
            1, 0, 0, 0,  0, 0, 0, 0,             // "" and three of padding: 48
            1, 0, 0, 0,                          // one figure: 52
            2, 0, 0, 0,  b'T', 0, 0, 0,          // 60
            3, 0, 0, 0,  b'6', b'9', 0,
        ];
        assert_eq!(diagnostics.encode(), want);
        assert_eq!(DiagnosticArray::decode(want).unwrap(), diagnostics);
    }

    /// 0.25 m/s forward, −0.5 rad/s about z; laid out by hand.
    #[test]
    fn golden_bytes_of_a_twist() {
        let twist = Twist { linear_mps: [0.25, 0.0, 0.0], angular_radps: [0.0, 0.0, -0.5] };
        let mut want = vec![0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0xd0, 0x3f];
        want.extend([0; 32]);
        want.extend([0, 0, 0, 0, 0, 0, 0xe0, 0xbf]);
        assert_eq!(twist.encode(), want);
        assert_eq!(Twist::decode(&want).unwrap(), twist);
    }

    #[test]
    fn every_written_type_has_a_definition() {
        for t in [
            JointState::TYPE,
            Imu::TYPE,
            BatteryState::TYPE,
            PoseStamped::TYPE,
            TwistStamped::TYPE,
            TfMessage::TYPE,
            Odometry::TYPE,
            DiagnosticArray::TYPE,
        ] {
            assert!(schema(t).unwrap().contains("MSG: builtin_interfaces/Time"), "{t}");
        }
        for t in [Text::TYPE, Number::TYPE] {
            assert!(schema(t).is_some(), "{t}");
        }
        assert_eq!(schema("std_msgs/msg/Bool"), None);
    }
}
