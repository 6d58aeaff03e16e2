//! From the tap of a running robot to ROS topics, and from a topic of velocities to the robot's command link.

use std::net::{SocketAddr, UdpSocket};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use caudata_deploy::command_link::{Commander, DATAGRAM, LinkKey};
use caudata_deploy::odometry::{DeadReckoning, Reckoned};
use caudata_deploy::tap::Tick;
use caudata_model::{Pose, RobotModel};
use caudata_runlog::ros::messages::{
    BatteryState, Covariance, DiagnosticArray, DiagnosticStatus, Header, Imu, JointState, Odometry,
    Text, TfMessage, TransformStamped, Twist,
};
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::{Config, Session, Wait};

use crate::wire::{
    self, BATTERY_STATE, DIAGNOSTIC_ARRAY, IMU, JOINT_STATE, MessageType, Node, ODOMETRY, Role,
    STRING, TF_MESSAGE, TWIST, Topic,
};

/// A velocity older than this is no longer passed on; the robot then stops by itself.
const COMMAND_MAX_AGE: Duration = Duration::from_millis(500);
/// How often the present velocity is sent.
const SEND_EVERY: Duration = Duration::from_millis(50);
/// Diagnostics, battery and description once in so many ticks (1 s).
const SELDOM: u64 = 50;

/// The frame in which the legs say where the robot is.
const ODOM: &str = "odom";

/// Why the door does not open.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum DoorError {
    /// zenoh.
    #[error("zenoh: {0}")]
    Zenoh(String),
    /// The command link.
    #[error("command link to {address}: {source}")]
    Link { address: SocketAddr, source: std::io::Error },
}

fn zenoh_error(error: zenoh::Error) -> DoorError {
    DoorError::Zenoh(error.to_string())
}

/// How the robot appears in ROS.
#[derive(Clone, Debug)]
pub struct Appearance {
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Name of the node.
    pub node: String,
    /// In front of every topic: empty, or `/robot1`.
    pub prefix: String,
    /// Frame of the IMU.
    pub imu_frame: String,
    /// Joint names, policy order.
    pub joints: Vec<String>,
    /// A motor's torque per ampere by joint, N·m/A, for the effort of joint states.
    pub torque_nm_per_a: Vec<f64>,
    /// For its description and the places of its links.
    pub robot: Arc<RobotModel>,
}

/// The velocity that came last, and when.
type Newest = Option<([f32; 3], Instant)>;

/// An open session with everything declared. Dropped, the node is gone from the graph.
#[derive(Debug)]
pub struct Door {
    appearance: Appearance,
    session: Session,
    gid: [u8; 16],
    joints: Out,
    imu: Out,
    frames: Out,
    diagnostics: Out,
    battery: Out,
    description: Out,
    odometry: Out,
    reckoning: DeadReckoning,
    ticks: u64,
    velocity: Arc<Mutex<Newest>>,
    _tokens: Vec<LivelinessToken>,
    _subscriber: Subscriber<()>,
}

/// One topic out.
#[derive(Debug)]
struct Out {
    publisher: Publisher<'static>,
    sequence: i64,
}

impl Out {
    fn put(&mut self, gid: [u8; 16], unix_ns: i64, payload: Vec<u8>) -> Result<(), DoorError> {
        self.sequence += 1;
        let attachment = wire::attachment(self.sequence, unix_ns, gid).to_vec();
        let put = self.publisher.put(payload).attachment(attachment);
        put.wait().map_err(zenoh_error)
    }
}

/// Settings of a session as `rmw_zenoh_cpp` has them: a peer that finds others through the router.
///
/// # Errors
/// [`DoorError::Zenoh`] for an endpoint that is none.
pub fn settings(connect: &[String], listen: &[String]) -> Result<Config, DoorError> {
    let mut config = Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("connect/endpoints", format!("{connect:?}")),
        ("listen/endpoints", format!("{listen:?}")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "true".to_owned()),
    ] {
        config.insert_json5(key, &value).map_err(zenoh_error)?;
    }
    Ok(config)
}

impl Door {
    /// Opens the session and appears in the graph.
    ///
    /// # Errors
    /// [`DoorError::Zenoh`].
    pub fn open(config: Config, appearance: Appearance) -> Result<Self, DoorError> {
        let session = zenoh::open(config).wait().map_err(zenoh_error)?;
        let node = Node {
            domain: appearance.domain,
            session: session.zid().to_string(),
            name: appearance.node.clone(),
        };
        let topic = |name: &str, message: MessageType| Topic {
            domain: appearance.domain,
            name: format!("{}/{name}", appearance.prefix),
            message,
        };
        let topics = [
            (topic("joint_states", JOINT_STATE), Role::Publisher),
            (topic("imu/data", IMU), Role::Publisher),
            (
                Topic {
                    // Diagnostics of all robots meet in one topic.
                    name: "/diagnostics".to_owned(),
                    ..topic("", DIAGNOSTIC_ARRAY)
                },
                Role::Publisher,
            ),
            (topic("cmd_vel", TWIST), Role::Subscriber),
            (topic("tf", TF_MESSAGE), Role::Publisher),
            (topic("battery_state", BATTERY_STATE), Role::Publisher),
            (topic("robot_description", STRING), Role::Publisher),
            (topic("odom", ODOMETRY), Role::Publisher),
        ];
        let declare = |token: String| {
            let declared = session.liveliness().declare_token(token).wait();
            declared.map_err(zenoh_error)
        };
        let mut tokens = vec![declare(node.token())?];
        for (entity, (topic, role)) in (1..).zip(&topics) {
            tokens.push(declare(node.topic_token(entity, *role, topic))?);
        }
        let out = |topic: &Topic| {
            let declared = session.declare_publisher(topic.key()).wait();
            declared.map_err(zenoh_error).map(|publisher| Out { publisher, sequence: 0 })
        };
        let velocity = Arc::<Mutex<Newest>>::default();
        let newest = velocity.clone();
        let subscriber = session
            .declare_subscriber(topics[3].0.key())
            .callback(move |sample| {
                let Ok(twist) = Twist::decode(&sample.payload().to_bytes()) else {
                    tracing::warn!("a velocity that cannot be read is left out");
                    return;
                };
                *newest.lock().unwrap_or_else(PoisonError::into_inner) =
                    Some((command_of(&twist), Instant::now()));
            })
            .wait()
            .map_err(zenoh_error)?;
        Ok(Self {
            gid: session.zid().to_le_bytes(),
            joints: out(&topics[0].0)?,
            imu: out(&topics[1].0)?,
            diagnostics: out(&topics[2].0)?,
            frames: out(&topics[4].0)?,
            battery: out(&topics[5].0)?,
            description: out(&topics[6].0)?,
            odometry: out(&topics[7].0)?,
            reckoning: DeadReckoning::new(Arc::clone(&appearance.robot)),
            ticks: 0,
            velocity,
            _tokens: tokens,
            _subscriber: subscriber,
            session,
            appearance,
        })
    }

    /// Publishes one tick.
    ///
    /// # Errors
    /// [`DoorError::Zenoh`].
    pub fn publish(&mut self, tick: &Tick) -> Result<(), DoorError> {
        let unix_ns = unix_ns();
        let gid = self.gid;
        let look = &self.appearance;
        self.joints.put(gid, unix_ns, joint_state(tick, unix_ns, look).encode())?;
        self.imu.put(gid, unix_ns, imu(tick, unix_ns, look).encode())?;
        let reckoned = self.reckoning.add(tick);
        let frames = frames(tick, reckoned.as_ref(), unix_ns, look);
        self.frames.put(gid, unix_ns, frames.encode())?;
        if let Some(reckoned) = reckoned {
            let odometry = odometry(&reckoned, unix_ns, look).encode();
            self.odometry.put(gid, unix_ns, odometry)?;
        }
        if self.ticks.is_multiple_of(SELDOM) {
            let diagnostics = diagnostics(tick, unix_ns, look).encode();
            let battery = BatteryState { header: header(unix_ns, ""), voltage_v: tick.supply_v };
            let data = look.robot.to_urdf();
            self.diagnostics.put(gid, unix_ns, diagnostics)?;
            self.battery.put(gid, unix_ns, battery.encode())?;
            self.description.put(gid, unix_ns, Text { data }.encode())?;
        }
        self.ticks += 1;
        Ok(())
    }

    /// The newest velocity that ROS commands, vx, vy (m/s), yaw rate (rad/s); `None` where it is too old to
    /// count.
    pub fn velocity(&self) -> Option<[f32; 3]> {
        let newest = *self.velocity.lock().unwrap_or_else(PoisonError::into_inner);
        newest.filter(|(_, at)| at.elapsed() <= COMMAND_MAX_AGE).map(|(command, _)| command)
    }

    /// Id of its session.
    pub fn session_id(&self) -> String {
        self.session.zid().to_string()
    }
}

/// Passes velocities on to a robot's command link, as `caudata-robot drive` does.
pub struct Commands {
    socket: UdpSocket,
    key: LinkKey,
    commander: Commander,
    sent: Instant,
}

impl Commands {
    /// To the robot's `--link-addr`.
    ///
    /// # Errors
    /// [`DoorError::Link`].
    pub fn to(address: SocketAddr, key: LinkKey) -> Result<Self, DoorError> {
        let any: SocketAddr = match address {
            SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
            SocketAddr::V6(_) => ([0_u16; 8], 0).into(),
        };
        let opened = UdpSocket::bind(any).and_then(|socket| {
            socket.connect(address)?;
            socket.set_nonblocking(true)?;
            Ok(socket)
        });
        let socket = opened.map_err(|source| DoorError::Link { address, source })?;
        Ok(Self { socket, key, commander: Commander::begin(), sent: Instant::now() })
    }

    /// Sends what is due. Without a velocity nothing is sent, and the robot stops by itself.
    pub fn pass_on(&mut self, velocity: Option<[f32; 3]>) {
        let mut buffer = [0; DATAGRAM];
        while let Ok(DATAGRAM) = self.socket.recv(&mut buffer) {
            self.commander.hear(&buffer, &self.key);
        }
        let Some(velocity) = velocity else { return };
        if self.sent.elapsed() >= SEND_EVERY {
            self.sent = Instant::now();
            self.commander.command = velocity;
            let message = self.commander.next_message().encode(&self.key);
            // A robot that is not there yet refuses datagrams for a while.
            let _ = self.socket.send(&message);
        }
    }
}

fn command_of(twist: &Twist) -> [f32; 3] {
    [twist.linear_mps[0] as f32, twist.linear_mps[1] as f32, twist.angular_radps[2] as f32]
}

/// As ROS wants it: one name, position, velocity and effort per joint.
pub fn joint_state(tick: &Tick, unix_ns: i64, look: &Appearance) -> JointState {
    let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect();
    let effort = tick.current_a.iter().zip(&look.torque_nm_per_a);
    JointState {
        header: header(unix_ns, ""),
        name: look.joints.clone(),
        position: wide(&tick.pos_rad),
        velocity: wide(&tick.vel_radps),
        effort: effort.map(|(a, k)| f64::from(*a) * k).collect(),
    }
}

/// Rates and accelerations; the direction of gravity alone is no orientation, so that none is claimed.
pub fn imu(tick: &Tick, unix_ns: i64, look: &Appearance) -> Imu {
    Imu {
        header: header(unix_ns, &look.imu_frame),
        orientation_wxyz: None,
        gyro_radps: tick.gyro_radps.map(f64::from),
        acc_mps2: tick.acc_mps2.map(f64::from),
    }
}

/// Where the robot is by its legs, and how fast it goes.
pub fn odometry(reckoned: &Reckoned, unix_ns: i64, look: &Appearance) -> Odometry {
    let [w, x, y, z] = reckoned.pose.quat_wxyz;
    let root = look.robot.links().first();
    Odometry {
        header: header(unix_ns, ODOM),
        child: root.map_or_else(String::new, |link| link.name.clone()),
        position_m: reckoned.pose.pos_m,
        orientation_xyzw: [x, y, z, w],
        pose_covariance: Covariance(reckoned.pose_variance),
        linear_mps: reckoned.linear_mps,
        angular_radps: reckoned.angular_radps,
        twist_covariance: Covariance(reckoned.twist_variance),
    }
}

/// Where the links are, each in the one that carries it, and the IMU; the first one by the legs.
pub fn frames(
    tick: &Tick,
    reckoned: Option<&Reckoned>,
    unix_ns: i64,
    look: &Appearance,
) -> TfMessage {
    let robot = &look.robot;
    let measured: Vec<f64> = tick.pos_rad.iter().map(|x| f64::from(*x)).collect();
    let joints = robot.full_pos_rad(&measured);
    let places = joints.and_then(|joints| robot.kinematics(&Pose::IDENTITY, &joints));
    let places = places.unwrap_or_default().links;
    let links = robot.links();
    let frame = |outer: &str, name: &str, pose: Pose| {
        let [w, x, y, z] = pose.quat_wxyz;
        TransformStamped {
            header: header(unix_ns, outer),
            child: name.to_owned(),
            position_m: pose.pos_m,
            orientation_xyzw: [x, y, z, w],
        }
    };
    let of_links = links.iter().zip(&places).filter_map(|(link, place)| {
        let outer = link.parent?;
        Some(frame(&links[outer].name, &link.name, places[outer].inverse().compose(place)))
    });
    let imu = robot.imu_site();
    let imu = imu.map(|site| frame(&links[site.link].name, &look.imu_frame, site.link_from_site));
    let root = reckoned.zip(links.first());
    let root = root.map(|(reckoned, link)| frame(ODOM, &link.name, reckoned.pose));
    TfMessage { transforms: of_links.chain(imu).chain(root).collect() }
}

fn header(stamp_ns: i64, frame: &str) -> Header {
    Header { stamp_ns, frame: frame.to_owned() }
}

/// One status: in order, or what stops it, with the figures that people look at.
pub fn diagnostics(tick: &Tick, unix_ns: i64, look: &Appearance) -> DiagnosticArray {
    let (level, message) = match tick.fault {
        Some(fault) => (DiagnosticStatus::ERROR, format!("{fault:?}")),
        None => (DiagnosticStatus::OK, format!("{:?}", tick.stage)),
    };
    let value = |key: &str, value: String| (key.to_owned(), value);
    DiagnosticArray {
        header: header(unix_ns, ""),
        status: vec![DiagnosticStatus {
            level,
            name: format!("{}: control loop", look.node),
            message,
            hardware_id: look.node.clone(),
            values: vec![
                value("policy version", tick.policy_version.to_string()),
                value("supply V", format!("{:.1}", tick.supply_v)),
                value("hottest servo °C", tick.hottest_c.to_string()),
                value("periods skipped", tick.overruns.to_string()),
                value("ticks without readings", tick.late_readings.to_string()),
            ],
        }],
    }
}

fn unix_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    since.map_or(0, |d| i64::try_from(d.as_nanos()).unwrap_or(i64::MAX))
}
