//! `caudata sim robot`: a simulated robot as a process of its own, for `caudata-robot`.
//!
//! It runs in lock-step with its client: each command is answered with what the sensors read at the end of
//! that control period. Between commands its time stands still. Each client finds it anew in its starting
//! pose.

use std::f32::consts::PI;
use std::io::ErrorKind;
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

use caudata_config::ConfigArgs;
use caudata_env::WaterSensor;
use caudata_model::RobotModel;
use caudata_proto::framing::{FrameReader, write_frame};
use caudata_proto::robot_link::{
    BasePose, Command, Hello, MAX_MESSAGE_BYTES, RobotMessage, Sensors, decode, encode,
};
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::sensors::{self, ImuBias};
use caudata_sim::{Engine, InitialState, LaneParams, SimError};
use caudata_task::JointTable;
use caudata_telemetry::{ExitCode, Failure, FailureExt, StopFlag, announce};

use crate::commands::robot;
use crate::commands::sim_robot_pty::{self, PtyArgs};

/// How often a wait looks at the stop flag.
const STOP_SEEN_WITHIN: Duration = Duration::from_millis(50);
/// A client that says nothing for this long is gone.
const SILENCE_MAX: Duration = Duration::from_secs(60);
/// Time for one answer to leave.
const WRITE_MAX: Duration = Duration::from_secs(5);

#[derive(Debug, clap::Args)]
pub struct SimRobotArgs {
    /// How the robot is reached: `tcp`, or `pty` for emulated servos and IMU on pseudo-terminals
    #[arg(long, value_enum, default_value_t = LinkKind::Tcp)]
    bus: LinkKind,
    #[command(flatten)]
    pty: PtyArgs,
    /// Address to listen on; port 0 takes any free one. It is printed as one JSON line
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7402")]
    addr: SocketAddr,
    /// Seed of sensor noise, offsets and ground
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The IMU works out the direction of gravity itself (the true one) instead of leaving it to the client
    #[arg(long)]
    imu_gravity: bool,
    /// It lies on its back at the start
    #[arg(long)]
    on_its_back: bool,
    /// Physics and ground come from `[engine]` and `[terrain]`
    #[command(flatten)]
    config: ConfigArgs,
}

/// How the robot is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum LinkKind {
    /// Readings and commands in lock-step, over TCP.
    Tcp,
    /// The wire protocol of servos and IMU, on pseudo-terminals.
    Pty,
}

/// Serves one client after the other until asked to stop.
pub fn run(args: &SimRobotArgs, stop: &StopFlag) -> Result<(), Failure> {
    let (config, model) = robot::configured(&args.config)?;
    JointTable::from_model(&model).or_exit(ExitCode::BadInput)?;
    let mut start = InitialState::nominal(&model);
    if args.on_its_back {
        start.base_rpy_rad[0] = PI;
    }
    if args.bus == LinkKind::Pty {
        return sim_robot_pty::run(&args.pty, &config, model, &start, args.seed, stop);
    }
    let contact_force_n = config.task.reward.contact_force_n;
    let engine = caudata_sim::build(model, 1, &config.engine, &config.terrain, args.seed, 1)
        .or_exit(ExitCode::BadConfig)?;
    let water = WaterSensor::new(engine.model(), &config.task).or_exit(ExitCode::BadInput)?;
    let mut robot = SimulatedRobot::new(engine, start, args.seed, contact_force_n, water);
    robot.imu_gravity = args.imu_gravity;
    let listener = TcpListener::bind(args.addr)
        .or_exit_with(ExitCode::OsResource, || format!("cannot listen on {}", args.addr))
        .map_err(|failure| failure.hint("--addr takes another; with port 0 any that is free"))?;
    listener.set_nonblocking(true).or_exit(ExitCode::OsResource)?;
    announce("robot_link", listener.local_addr().or_exit(ExitCode::OsResource)?);
    while !stop.is_set() {
        match listener.accept() {
            Ok((stream, client)) => {
                tracing::info!(%client, "robot program connected");
                match serve(&mut robot, stream, stop) {
                    Ok(()) => tracing::info!(%client, time_s = robot.time_s(), "it hung up"),
                    Err(reason) => tracing::warn!(%client, reason, "hung up on it"),
                }
            }
            Err(e) if e.kind() == ErrorKind::WouldBlock => {
                stop.wait(STOP_SEEN_WITHIN);
            }
            // A client that was gone before it was accepted, or too many open files: the next one may go
            // well.
            Err(error) => {
                tracing::warn!(%error, "cannot accept");
                stop.wait(STOP_SEEN_WITHIN);
            }
        }
    }
    Ok(())
}

/// One client, from its hello until it hangs up.
fn serve(robot: &mut SimulatedRobot, mut stream: TcpStream, stop: &StopFlag) -> Result<(), String> {
    let refused = |e: std::io::Error| e.to_string();
    stream.set_nonblocking(false).map_err(refused)?;
    stream.set_nodelay(true).map_err(refused)?;
    stream.set_read_timeout(Some(STOP_SEEN_WITHIN)).map_err(refused)?;
    stream.set_write_timeout(Some(WRITE_MAX)).map_err(refused)?;
    let mut reader = FrameReader::new(MAX_MESSAGE_BYTES);
    let own = robot.hello();
    send(&mut stream, &RobotMessage::Hello(Box::new(own.clone())))?;
    match receive(&mut reader, &mut stream, stop)? {
        Some(RobotMessage::Hello(theirs)) if *theirs == own => {}
        Some(RobotMessage::Hello(_)) => return Err("it expects another robot".to_owned()),
        Some(_) => return Err("it did not say hello".to_owned()),
        None => return Ok(()),
    }
    robot.restart().map_err(|e| e.to_string())?;
    send(&mut stream, &robot.sensors())?;
    while let Some(message) = receive(&mut reader, &mut stream, stop)? {
        let RobotMessage::Command(command) = message else {
            return Err("it sent something else than a command".to_owned());
        };
        robot.step(&command)?;
        send(&mut stream, &robot.sensors())?;
    }
    Ok(())
}

fn send(stream: &mut TcpStream, message: &RobotMessage) -> Result<(), String> {
    write_frame(stream, &encode(message), MAX_MESSAGE_BYTES).map_err(|e| e.to_string())
}

/// The next message; `None` when the client has hung up or this process is asked to stop.
fn receive(
    reader: &mut FrameReader,
    stream: &mut TcpStream,
    stop: &StopFlag,
) -> Result<Option<RobotMessage>, String> {
    let end = Instant::now() + SILENCE_MAX;
    while !stop.is_set() {
        match reader.read(stream) {
            Ok(None) => return Ok(None),
            Ok(Some(payload)) => return decode(payload).map(Some).map_err(|e| e.to_string()),
            Err(e) if e.is_timeout() && Instant::now() < end => {}
            Err(e) => return Err(e.to_string()),
        }
    }
    Ok(None)
}

/// One lane of an engine behind the sensors of a robot.
struct SimulatedRobot {
    engine: Box<dyn Engine>,
    start: InitialState,
    /// With and without torque.
    params: [LaneParams; 2],
    seed: u64,
    imu_gravity: bool,
    contact_force_n: f32,
    water: WaterSensor,
    /// Clients so far: each has its own noise.
    episode: u64,
    stream: Stream,
    bias: ImuBias,
    tick: u64,
    torque: bool,
}

impl SimulatedRobot {
    fn new(
        engine: Box<dyn Engine>,
        start: InitialState,
        seed: u64,
        contact_force_n: f32,
        water: WaterSensor,
    ) -> Self {
        let with = engine.params(0).clone();
        let mut limp = with.clone();
        for per_servo in [&mut limp.torque_scale, &mut limp.kp_nm_per_rad, &mut limp.kd_nms_per_rad]
        {
            per_servo.fill(0.0);
        }
        let stream = Stream::new(Key::for_run(seed), Purpose::Sensor);
        Self {
            engine,
            start,
            params: [with, limp],
            seed,
            imu_gravity: false,
            contact_force_n,
            water,
            episode: 0,
            stream,
            bias: ImuBias::default(),
            tick: 0,
            torque: true,
        }
    }

    fn model(&self) -> &RobotModel {
        self.engine.model()
    }

    fn hello(&self) -> Hello {
        let names = self.model().actuated_names();
        Hello {
            robot_name: self.model().name().to_owned(),
            robot_hash: self.model().hash(),
            joint_names: names.into_iter().map(str::to_owned).collect(),
            control_period_s: self.engine.config().control_period_s(),
        }
    }

    fn time_s(&self) -> f64 {
        self.tick as f64 * self.engine.config().control_period_s()
    }

    /// At its start, torque on, fresh noise.
    fn restart(&mut self) -> Result<(), SimError> {
        let key = Key { episode: self.episode, ..Key::for_run(self.seed) };
        self.episode += 1;
        self.stream = Stream::new(key, Purpose::Sensor);
        self.bias = match &self.engine.model().sensors().imu {
            Some(imu) => ImuBias::draw(imu, &mut self.stream),
            None => ImuBias::default(),
        };
        self.tick = 0;
        self.torque = true;
        self.engine.set_params(0, &self.params[0])?;
        self.engine.reset(0, &self.start)
    }

    fn step(&mut self, command: &Command) -> Result<(), String> {
        let joints = self.model().actuated().len();
        if command.targets_rad.len() != joints {
            let found = command.targets_rad.len();
            return Err(format!("it sent {found} targets to {joints} joints"));
        }
        if command.tick != self.tick + 1 {
            return Err(format!("it sent tick {} after {}", command.tick, self.tick));
        }
        if command.torque_enabled != self.torque {
            let params = &self.params[usize::from(!command.torque_enabled)];
            self.engine.set_params(0, params).map_err(|e| e.to_string())?;
            self.torque = command.torque_enabled;
        }
        self.tick = command.tick;
        self.engine.step(&command.targets_rad, &[0.0; 6]).map_err(|e| e.to_string())?;
        if self.engine.state().diverged[0] {
            return Err("the simulation diverged".to_owned());
        }
        Ok(())
    }

    /// What the sensors read now.
    fn sensors(&mut self) -> RobotMessage {
        let period_s = self.engine.config().control_period_s();
        let (model, state) = (self.engine.model(), self.engine.state());
        let joint = |i: usize| model.actuated()[i];
        let each = |of: &dyn Fn(usize) -> f32| (0..model.actuated().len()).map(of).collect();
        let (bias, stepped) = (&self.bias, self.tick > 0);
        let (gyro_radps, acc_mps2) =
            sensors::imu(model, state, bias, stepped, period_s, &mut self.stream);
        RobotMessage::Sensors(Box::new(Sensors {
            tick: self.tick,
            time_s: self.tick as f64 * period_s,
            joint_pos_rad: each(&|i| {
                let seen_rad = state.encoder_pos_rad(0, joint(i), i);
                sensors::encoder_pos_rad(model.servo(i), seen_rad, 0.0)
            }),
            joint_vel_radps: each(&|i| {
                let seen_radps = state.encoder_vel_radps(0, joint(i), i);
                sensors::encoder_vel_radps(model.servo(i), seen_radps)
            }),
            current_a: each(&|i| sensors::current_a(model.servo(i), state.motor_torque_nm[i])),
            supply_v: self.engine.params(0).supply_v,
            gyro_radps,
            acc_mps2,
            imu_gravity: self.imu_gravity.then(|| three(&state.imu_gravity)),
            base_pose: Some(BasePose {
                pos_m: three(&state.base_pos_m),
                quat_wxyz: std::array::from_fn(|i| state.base_quat_wxyz[i]),
            }),
            foot_contacts: Some((0..state.feet).fold(0, |bits, foot| {
                let touches = state.foot_force_n[3 * foot + 2] > self.contact_force_n;
                bits | u32::from(touches) << foot
            })),
            in_water: Some(self.water.in_water(self.engine.as_ref(), 0)),
        }))
    }
}

fn three(values: &[f32]) -> [f32; 3] {
    std::array::from_fn(|i| values[i])
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_sim::{TerrainConfig, TerrainKind};
    use caudata_task::TaskConfig;
    use std::path::Path;
    use std::sync::Arc;

    fn robot() -> SimulatedRobot {
        robot_on(TerrainKind::Flat)
    }

    fn robot_on(ground: TerrainKind) -> SimulatedRobot {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/polymander.robot.toml");
        let model = Arc::new(RobotModel::load(&file).unwrap());
        let water = WaterSensor::new(&model, &TaskConfig::default()).unwrap();
        let terrain = TerrainConfig::of(ground);
        let engine = caudata_sim::build(model, 1, &Default::default(), &terrain, 1, 1).unwrap();
        let start = InitialState::nominal(engine.model());
        let mut robot = SimulatedRobot::new(engine, start, 1, 0.1, water);
        robot.restart().unwrap();
        robot
    }

    fn command(robot: &SimulatedRobot, torque_enabled: bool) -> Command {
        let nominal = robot.model().nominal_pos_rad();
        Command {
            tick: robot.tick + 1,
            targets_rad: nominal.iter().map(|&q| q as f32).collect(),
            torque_enabled,
        }
    }

    fn height_m(robot: &SimulatedRobot) -> f32 {
        robot.engine.state().base_pos_m[2]
    }

    #[test]
    fn it_stands_with_torque_and_sinks_without() {
        let mut robot = robot();
        for _ in 0..50 {
            robot.step(&command(&robot, true)).unwrap();
        }
        let standing = height_m(&robot);
        let RobotMessage::Sensors(read) = robot.sensors() else { panic!("sensors") };
        assert_eq!((read.tick, read.imu_gravity), (50, None));
        assert!((read.time_s - 1.0).abs() < 1e-12);
        // At rest the accelerometer shows gravity, upwards; its offset is drawn with 0.2 m/s² per axis.
        assert!((read.acc_mps2[2] - 9.81).abs() < 1.0, "{:?}", read.acc_mps2);
        assert_eq!(read.foot_contacts.map(|bits| bits.count_ones() >= 3), Some(true));
        for _ in 0..50 {
            robot.step(&command(&robot, false)).unwrap();
        }
        // The head comes down from 6 cm to 3 cm: it lies on the ground.
        let lying = height_m(&robot);
        assert!(lying < standing - 0.02, "{lying} from {standing}");
    }

    #[test]
    fn its_water_sensor_tells_deep_water_from_land() {
        for (ground, expected) in [(TerrainKind::DeepWater, true), (TerrainKind::Flat, false)] {
            let mut robot = robot_on(ground);
            let RobotMessage::Sensors(read) = robot.sensors() else { panic!("sensors") };
            assert_eq!(read.in_water, Some(expected), "{ground:?}");
        }
    }

    #[test]
    fn each_client_finds_it_anew_with_other_noise() {
        let mut robot = robot();
        let first = robot.sensors();
        robot.step(&command(&robot, false)).unwrap();
        robot.restart().unwrap();
        let second = robot.sensors();
        let (RobotMessage::Sensors(a), RobotMessage::Sensors(b)) = (first, second) else {
            panic!("sensors")
        };
        assert_eq!(
            (a.tick, &a.joint_pos_rad, &a.base_pose),
            (b.tick, &b.joint_pos_rad, &b.base_pose)
        );
        assert_ne!(a.gyro_radps, b.gyro_radps);
    }

    #[test]
    fn a_tick_that_was_left_out_is_refused() {
        let mut robot = robot();
        let mut late = command(&robot, true);
        late.tick += 1;
        assert_eq!(robot.step(&late).unwrap_err(), "it sent tick 2 after 0");
    }
}
