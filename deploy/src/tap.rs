//! What other programs on this computer may see of every tick, such as the door to ROS 2: one datagram each,
//! to whoever has opened `tap.sock` in the run folder. The loop hands a copy to a thread and never waits; a
//! reader that is slow misses ticks.

use std::io;
use std::os::unix::net::UnixDatagram;
use std::time::Duration;

use caudata_task::PerJoint;
use crossbeam_channel::{Sender, bounded};
use serde::{Deserialize, Serialize};

use crate::DeployError;
use crate::boundary::RunFolder;
use crate::guard::Fault;
use crate::motion::Stage;
use crate::notify;

/// Ticks that wait for the thread; a further one is left out.
const TICKS_WAITING_MAX: usize = 4;
/// Largest datagram, bytes.
const TICK_BYTES_MAX: usize = 8 << 10;

/// One tick.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tick {
    /// The robot's time, s.
    pub time_s: f64,
    /// Joint positions, rad, policy order.
    pub pos_rad: PerJoint,
    /// Joint velocities, rad/s.
    pub vel_radps: PerJoint,
    /// Servo currents, A.
    pub current_a: PerJoint,
    /// Position targets that were sent, rad.
    pub target_rad: PerJoint,
    /// Angular velocity, rad/s, IMU frame.
    pub gyro_radps: [f32; 3],
    /// Specific force, m/s², IMU frame.
    pub acc_mps2: [f32; 3],
    /// Direction of gravity, unit vector, IMU frame.
    pub gravity: [f32; 3],
    /// Velocity by the legs: forward, to the left, m/s, turning, rad/s; nothing where they tell nothing.
    pub going: Option<[f32; 3]>,
    /// Supply, V.
    pub supply_v: f32,
    /// What the robot is doing.
    pub stage: Stage,
    /// Why it stops, if the hardware is why.
    pub fault: Option<Fault>,
    /// Version of the policy.
    pub policy_version: u64,
    /// Periods skipped so far.
    pub overruns: u64,
    /// Ticks without readings so far.
    pub late_readings: u64,
    /// Hottest servo, °C.
    pub hottest_c: u8,
}

/// Starts the thread; it ends when the sender is dropped.
///
/// # Errors
/// [`DeployError::System`].
pub fn start(folder: &RunFolder) -> Result<Sender<Tick>, DeployError> {
    let socket = UnixDatagram::unbound().map_err(DeployError::system("a socket"))?;
    socket.set_nonblocking(true).map_err(DeployError::system("a socket"))?;
    let to = folder.file("tap.sock");
    let (sender, ticks) = bounded::<Tick>(TICKS_WAITING_MAX);
    let work = move || {
        for tick in ticks {
            if let Ok(bytes) = serde_json::to_vec(&tick) {
                // Mostly nobody is there.
                let _ = socket.send_to(&bytes, &to);
            }
        }
    };
    std::thread::Builder::new()
        .name("tap".into())
        .spawn(work)
        .map_err(DeployError::system("a thread"))?;
    Ok(sender)
}

/// The reader's end.
#[derive(Debug)]
pub struct Tap(UnixDatagram);

impl Tap {
    /// Opens the tap of `folder`; a reader that was there before gets nothing any more.
    ///
    /// # Errors
    /// [`DeployError::Folder`].
    pub fn open(folder: &RunFolder) -> Result<Self, DeployError> {
        let path = folder.file("tap.sock");
        let opened = notify::bind(&path).and_then(|socket| {
            socket.set_nonblocking(false)?;
            Ok(socket)
        });
        opened.map(Self).map_err(DeployError::folder(path))
    }

    /// The next tick; `None` where none came within `timeout`, or something that is no tick.
    pub fn next(&self, timeout: Duration) -> io::Result<Option<Tick>> {
        self.0.set_read_timeout(Some(timeout))?;
        let mut buffer = [0; TICK_BYTES_MAX];
        match self.0.recv(&mut buffer) {
            Ok(length) => Ok(serde_json::from_slice(&buffer[..length]).ok()),
            Err(error)
                if matches!(
                    error.kind(),
                    io::ErrorKind::WouldBlock
                        | io::ErrorKind::TimedOut
                        | io::ErrorKind::Interrupted
                ) =>
            {
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_sees_ticks_and_without_one_nothing_waits() {
        let folder = tempfile::tempdir().unwrap();
        let folder = RunFolder::open(&folder.path().join("run")).unwrap();
        let tick = Tick {
            time_s: 1.5,
            pos_rad: [0.25; 16].into(),
            vel_radps: [-0.5; 16].into(),
            current_a: [0.0; 16].into(),
            target_rad: [0.3; 16].into(),
            gyro_radps: [0.1, 0.2, 0.3],
            acc_mps2: [0.0, 0.0, 9.81],
            gravity: [0.0, 0.0, -1.0],
            going: Some([0.25, 0.0, -0.5]),
            supply_v: 12.0,
            stage: Stage::Walk,
            fault: Some(Fault::ServoAlert),
            policy_version: 7,
            overruns: 1,
            late_readings: 2,
            hottest_c: 41,
        };
        let sender = start(&folder).unwrap();
        for _ in 0..100 {
            // Whether it was taken or not: nobody waits.
            let _ = sender.try_send(tick);
        }
        let tap = Tap::open(&folder).unwrap();
        let seen = loop {
            let _ = sender.try_send(tick);
            if let Some(seen) = tap.next(Duration::from_millis(100)).unwrap() {
                break seen;
            }
        };
        assert_eq!(seen, tick);
    }
}
