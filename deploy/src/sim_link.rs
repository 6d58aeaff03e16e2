//! The simulated robot in another process, over TCP: servo bus and IMU in one.
//!
//! The two sides run in lock-step: the robot answers each command with the readings at the end of that
//! control period. Reads have deadlines; a reading that comes late is taken by a later tick, and the robot's
//! time stands still meanwhile.

use std::io::ErrorKind;
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use caudata_model::RobotModel;
use caudata_proto::framing::{FrameError, FrameReader, write_frame};
use caudata_proto::robot_link::{
    Command, Hello, MAX_MESSAGE_BYTES, RobotMessage, Sensors, decode, encode,
};
use caudata_task::{PerFoot, PerJoint};

use crate::bus::{BusError, GroundTruth, Imu, ImuReading, Robot, ServoBus, ServoReadings};

/// Time to connect, and for the robot to say hello and give its first readings.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(10);
/// Time for one command to leave.
pub const WRITE_TIMEOUT: Duration = Duration::from_secs(1);
/// How long the answer to letting go is waited for.
pub const LAST_ANSWER_TIMEOUT: Duration = Duration::from_secs(1);
/// How far the two sides' control periods may be apart, s.
const PERIOD_TOLERANCE_S: f64 = 1e-9;

/// A connection to a simulated robot.
#[derive(Debug)]
pub struct SimLink {
    address: String,
    stream: TcpStream,
    reader: FrameReader,
    tick: u64,
    joints: usize,
    feet: usize,
    /// The newest readings, and whether [`ServoBus::read`] gave them out.
    sensors: Option<(Box<Sensors>, bool)>,
}

impl SimLink {
    /// Connects to `address` (`host:port`) and compares hellos.
    ///
    /// # Errors
    /// [`BusError::Connect`] where nobody answers, [`BusError::Protocol`] where it is another robot.
    pub fn connect(
        address: &str,
        model: &RobotModel,
        control_period_s: f64,
    ) -> Result<Self, BusError> {
        let stream = connect(address)
            .map_err(|reason| BusError::Connect { address: address.to_owned(), reason })?;
        let mut link = Self {
            address: address.to_owned(),
            stream,
            reader: FrameReader::new(MAX_MESSAGE_BYTES),
            tick: 0,
            joints: model.actuated().len(),
            feet: model.feet().len(),
            sensors: None,
        };
        let own = hello_of(model, control_period_s);
        link.send(&RobotMessage::Hello(Box::new(own.clone())))?;
        let silent = |error| match error {
            BusError::Timeout { deadline } => BusError::Connect {
                address: address.to_owned(),
                reason: format!(
                    "it says nothing for {} ms: does it serve another program?",
                    deadline.as_millis()
                ),
            },
            other => other,
        };
        let RobotMessage::Hello(theirs) = link.receive(HELLO_TIMEOUT).map_err(silent)? else {
            return Err(link.protocol("it did not say hello"));
        };
        if let Some(reason) = compare(&own, &theirs) {
            return Err(link.protocol(reason));
        }
        let first = link.receive_sensors(HELLO_TIMEOUT).map_err(silent)?;
        link.sensors = Some((first, false));
        Ok(link)
    }

    fn send(&mut self, message: &RobotMessage) -> Result<(), BusError> {
        write_frame(&mut self.stream, &encode(message), MAX_MESSAGE_BYTES)
            .map_err(|e| BusError::Lost { reason: e.to_string() })
    }

    /// The next message, waiting at most `deadline` for all of it.
    fn receive(&mut self, deadline: Duration) -> Result<RobotMessage, BusError> {
        let lost = |reason: String| BusError::Lost { reason };
        let end = Instant::now() + deadline;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            // The system takes a time-out of zero for none at all.
            let left = left.max(Duration::from_micros(1));
            self.stream.set_read_timeout(Some(left)).map_err(|e| lost(e.to_string()))?;
            match self.reader.read(&mut self.stream) {
                Ok(Some(payload)) => {
                    let message = decode(payload).map_err(|e| e.to_string());
                    return message.map_err(|reason| self.protocol(reason));
                }
                Ok(None) => return Err(lost("it hung up".to_owned())),
                Err(FrameError::Io(e)) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) if e.is_timeout() && Instant::now() < end => {}
                Err(e) if e.is_timeout() => return Err(BusError::Timeout { deadline }),
                Err(e @ FrameError::TooLarge { .. }) => return Err(self.protocol(e.to_string())),
                Err(e) => return Err(lost(e.to_string())),
            }
        }
    }

    fn receive_sensors(&mut self, deadline: Duration) -> Result<Box<Sensors>, BusError> {
        match self.receive(deadline)? {
            RobotMessage::Sensors(sensors) if sensors.fit(self.joints, self.feet) => Ok(sensors),
            RobotMessage::Sensors(_) => {
                Err(self.protocol("readings of another number of joints or feet"))
            }
            _ => Err(self.protocol("expected readings")),
        }
    }

    fn command(&mut self, targets_rad: &[f32], torque: bool) -> Result<(), BusError> {
        self.tick += 1;
        self.send(&RobotMessage::Command(Command {
            tick: self.tick,
            targets_rad: targets_rad.to_vec(),
            torque_enabled: torque,
        }))
    }

    fn protocol(&self, reason: impl Into<String>) -> BusError {
        BusError::Protocol { address: self.address.clone(), reason: reason.into() }
    }

    fn newest(&self) -> Result<&Sensors, BusError> {
        let newest = self.sensors.as_ref().map(|(sensors, _)| sensors.as_ref());
        newest.ok_or(BusError::Lost { reason: "no readings yet".to_owned() })
    }
}

impl ServoBus for SimLink {
    fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError> {
        if self.sensors.as_ref().is_none_or(|(_, given)| *given) {
            let sensors = self.receive_sensors(deadline)?;
            if sensors.tick != self.tick {
                let reason = format!("it answers tick {}, asked was {}", sensors.tick, self.tick);
                return Err(self.protocol(reason));
            }
            self.sensors = Some((sensors, false));
        }
        if let Some((_, given)) = &mut self.sensors {
            *given = true;
        }
        let newest = self.newest()?;
        Ok(ServoReadings {
            time_s: newest.time_s,
            pos_rad: PerJoint::of(&newest.joint_pos_rad),
            vel_radps: PerJoint::of(&newest.joint_vel_radps),
            current_a: PerJoint::of(&newest.current_a),
            supply_v: newest.supply_v,
        })
    }

    fn write(&mut self, targets_rad: &PerJoint) -> Result<(), BusError> {
        self.command(targets_rad, true)
    }

    fn torque_off(&mut self) -> Result<(), BusError> {
        self.command(&PerJoint::filled(self.joints, 0.0), false)?;
        // Takes the answers that are still on their way: to hang up on them looks like a broken connection
        // over there.
        while self.newest()?.tick < self.tick {
            match self.receive_sensors(LAST_ANSWER_TIMEOUT) {
                Ok(sensors) => self.sensors = Some((sensors, false)),
                Err(BusError::Timeout { .. }) => break,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl Imu for SimLink {
    fn reading(&mut self) -> Result<ImuReading, BusError> {
        let newest = self.newest()?;
        Ok(ImuReading {
            gyro_radps: newest.gyro_radps,
            acc_mps2: newest.acc_mps2,
            gravity: newest.imu_gravity,
        })
    }
}

impl Robot for SimLink {
    fn ground_truth(&self) -> GroundTruth {
        let Ok(newest) = self.newest() else { return GroundTruth::default() };
        GroundTruth {
            base_pos_m: newest.base_pose.as_ref().map(|p| p.pos_m),
            base_quat_wxyz: newest.base_pose.as_ref().map(|p| p.quat_wxyz),
            foot_contacts: newest
                .foot_contacts
                .map(|bits| PerFoot::from_fn(self.feet, |foot| bits >> foot & 1 == 1)),
        }
    }

    fn in_water(&mut self) -> Option<bool> {
        self.newest().ok()?.in_water
    }
}

/// What this side says about the robot.
fn hello_of(model: &RobotModel, control_period_s: f64) -> Hello {
    let names = model.actuated_names();
    Hello {
        robot_name: model.name().to_owned(),
        robot_hash: model.hash(),
        joint_names: names.into_iter().map(str::to_owned).collect(),
        control_period_s,
    }
}

/// What differs between two hellos.
fn compare(own: &Hello, theirs: &Hello) -> Option<String> {
    if own.robot_name != theirs.robot_name {
        return Some(format!("it is a `{}`", theirs.robot_name));
    }
    if own.joint_names != theirs.joint_names {
        return Some("its joints have another order".to_owned());
    }
    if own.robot_hash != theirs.robot_hash {
        return Some("it was built from another robot file; give both the same --robot".to_owned());
    }
    if (own.control_period_s - theirs.control_period_s).abs() > PERIOD_TOLERANCE_S {
        let period = theirs.control_period_s;
        return Some(format!("its control period is {period} s"));
    }
    None
}

fn connect(address: &str) -> Result<TcpStream, String> {
    let resolved = address.to_socket_addrs().map_err(|e| e.to_string())?;
    let mut reason = "the name has no address".to_owned();
    for candidate in resolved {
        match TcpStream::connect_timeout(&candidate, HELLO_TIMEOUT) {
            Ok(stream) => {
                stream.set_nodelay(true).map_err(|e| e.to_string())?;
                let timeout = stream.set_write_timeout(Some(WRITE_TIMEOUT));
                return timeout.map(|()| stream).map_err(|e| e.to_string());
            }
            Err(e) => reason = e.to_string(),
        }
    }
    Err(reason)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{Read, Write};
    use std::net::TcpListener;

    #[test]
    fn a_program_of_another_protocol_is_told_from_a_robot_that_is_lost() {
        let answer = |bytes: &'static [u8]| {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            let address = listener.local_addr().unwrap().to_string();
            let server = std::thread::spawn(move || {
                let mut client = listener.accept().unwrap().0;
                client.read_exact(&mut [0; 4]).unwrap();
                client.write_all(bytes).unwrap();
            });
            let met = SimLink::connect(&address, &crate::testing::model(), 0.02).map(drop);
            server.join().unwrap();
            met.unwrap_err()
        };
        // read as a length, "HTTP" is more than any message has
        let error = answer(b"HTTP/1.1 400 Bad Request\r\n\r\n");
        assert!(matches!(error, BusError::Protocol { .. }), "{error}");
        assert!(error.to_string().contains("do not speak the same protocol"), "{error}");
        let error = answer(b"");
        assert!(matches!(error, BusError::Lost { .. }), "{error}");
    }
}
