//! Servos and IMU on two pseudo-terminals, in real time or in step with the goals that arrive.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::time::{Duration, Instant};

use caudata_dynamixel::emulator::Pty;

use crate::{EmulatedRobot, EmulationError};

/// How long one look at a terminal waits.
const LOOK: Duration = Duration::from_micros(300);
/// Steps that are made up for at once when the machine was busy; beyond that the robot's time stands still
/// instead.
const CATCH_UP_STEPS: u32 = 25;
/// Control period that one write of goals lets pass at [`Pace::Goals`], s.
const CONTROL_PERIOD_S: f64 = 0.02;

/// What moves the robot's time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// The clock.
    RealTime,
    /// Each write of goals lets one control period pass: a slow machine makes it slow, not wrong. Answers
    /// come at once, and watchdogs run by this time.
    Goals,
}

/// The terminals, and links to them under names that stay; beside them the file `water`, which holds 0 or 1
/// as the line of a water sensor does.
#[derive(Debug)]
pub struct Terminals {
    servos: Pty,
    imu: Pty,
    /// What stands for the line of the water sensor, and what it says.
    water: (File, bool),
}

impl Terminals {
    /// Opens both and makes `folder/servos` and `folder/imu` links to them; links that are there already are
    /// replaced. `folder/water` begins with 0.
    pub fn open(folder: &Path) -> std::io::Result<Self> {
        std::fs::create_dir_all(folder)?;
        let terminals = Self {
            servos: Pty::open()?,
            imu: Pty::open()?,
            water: (File::create(folder.join("water"))?, false),
        };
        terminals.water.0.write_all_at(b"0", 0)?;
        for (name, pty) in [("servos", &terminals.servos), ("imu", &terminals.imu)] {
            let link = folder.join(name);
            match std::fs::symlink_metadata(&link) {
                Ok(old) if old.is_symlink() => std::fs::remove_file(&link)?,
                _ => {}
            }
            std::os::unix::fs::symlink(pty.path(), &link)?;
        }
        Ok(terminals)
    }

    fn show_water(&mut self, is: bool) -> std::io::Result<()> {
        if is != self.water.1 {
            self.water.1 = is;
            self.water.0.write_all_at(if is { b"1" } else { b"0" }, 0)?;
        }
        Ok(())
    }
}

/// Serves until `stop` says so; `event` hears when the torque goes on (true) and off (false).
pub fn serve(
    robot: &mut EmulatedRobot,
    terminals: &mut Terminals,
    pace: Pace,
    stop: &dyn Fn() -> bool,
    event: &mut dyn FnMut(bool, &EmulatedRobot),
) -> Result<(), EmulationError> {
    let mut start = Instant::now();
    let (mut buffer, mut out) = ([0; 4096], Vec::new());
    let (mut goals, mut was_on) = (robot.bus.goal_writes, false);
    while !stop() {
        let count = terminals.servos.receive(&mut buffer, LOOK)?;
        let robot_us = (robot.time_s() * 1e6) as u64;
        let now_us = match pace {
            Pace::RealTime => start.elapsed().as_micros() as u64,
            Pace::Goals => robot_us,
        };
        robot.bus.host_baud = terminals.servos.baud()?;
        if pace == Pace::RealTime {
            robot.bus.hear(&buffer[..count], now_us);
        }
        // Byte by byte: on a busy machine goals and the next question may come together, and the question is
        // about what the goals did.
        for byte in buffer[..count].iter().filter(|_| pace == Pace::Goals) {
            robot.bus.hear(&[*byte], (robot.time_s() * 1e6) as u64);
            let new = robot.bus.goal_writes - goals;
            goals += new;
            let steps = new as u32 * (CONTROL_PERIOD_S / robot.step_s()).round() as u32;
            for _ in 0..steps {
                robot.step()?;
            }
        }
        out.clear();
        let until = match pace {
            Pace::RealTime => now_us,
            Pace::Goals => u64::MAX,
        };
        robot.bus.collect(until, &mut out);
        terminals.servos.send(&out)?;

        let count = terminals.imu.receive(&mut buffer, Duration::ZERO)?;
        out.clear();
        robot.bridge.hear(&buffer[..count], &mut out);
        terminals.imu.send(&out)?;

        let due = match pace {
            Pace::RealTime => {
                ((now_us.saturating_sub(robot_us)) as f64 * 1e-6 / robot.step_s()) as u32
            }
            Pace::Goals => 0,
        };
        for _ in 0..due.min(CATCH_UP_STEPS) {
            robot.step()?;
        }
        if due > CATCH_UP_STEPS {
            let lost = f64::from(due - CATCH_UP_STEPS) * robot.step_s();
            tracing::warn!(lost_s = lost, "the machine was busy: the robot's time stood still");
            start += Duration::from_secs_f64(lost);
        }
        terminals.show_water(robot.in_water())?;
        let on = robot.torque_on();
        if on != was_on {
            event(on, robot);
            was_on = on;
        }
    }
    Ok(())
}
