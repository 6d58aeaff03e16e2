//! The robot itself: Dynamixel servos on a serial bus, and an IMU on I²C, behind the traits of
//! [`crate::bus`].
//!
//! A tick reads all servos in one question, then looks after one servo in turn (torque, alert, watchdog; or
//! supply and heat), so that each of sixteen is looked at within 0.64 s. Goals of all servos go out in one write.
//! Nothing here allocates in a tick.

pub mod inspect;
mod open;

use std::time::{Duration, Instant};

use caudata_dynamixel::setup::persistently;
use caudata_dynamixel::units::{
    BUS_WATCHDOG_LSB_MS, CURRENT_LSB_A, VELOCITY_LSB_RADPS, VOLTAGE_LSB_V,
};
use caudata_dynamixel::xm430::{self, Register};
use caudata_dynamixel::{Answer, Bus, BusCounts, BusFault, GroupRead, GroupWrite, Port, let_go};
use caudata_hardware::{I2c, ImuChip, ImuSample, JointWiring, Wiring};
use caudata_task::PerJoint;
use caudata_task::row::MAX_JOINTS;
pub use open::{PortOverrides, open_bus, open_bus_anyway, open_imu, read_wiring};

use crate::DeployError;
use crate::bus::{BusError, Health, Imu, ImuReading, Robot, ServoBus, ServoReadings};

/// Looking after one servo may take this part of a tick's time for reading: 2 of 7 ms.
const CARE_SHARE: f64 = 2.0 / 7.0;
/// Time for goals to leave.
const WRITE_DEADLINE: Duration = Duration::from_millis(5);
/// Ticks in a row without any servo after which the bus counts as gone.
pub const ALL_SILENT_MAX: u32 = 10;
/// Times that the order to switch the torque on is repeated: nobody answers it.
const TORQUE_ON_TIMES: u32 = 3;
/// Time for all servos to say that their torque is on.
const ARM_DEADLINE: Duration = Duration::from_millis(200);

/// Servos and IMU.
pub struct HardwareRobot<P, B> {
    bus: Bus<P>,
    imu: ImuChip<B>,
    joints: Vec<JointWiring>,
    ids: Vec<u8>,
    fast: Option<GroupRead>,
    plain: GroupRead,
    goals: GroupWrite,
    watchdog_units: i32,
    p_gain: i32,
    water: Option<std::fs::File>,
    armed: bool,
    start: Instant,
    /// Control period by which each goal moves the robot's time, s; `None`: the clock does.
    goal_period_s: Option<f64>,
    goals_sent: u64,
    newest: ServoReadings,
    silent: PerJoint<u32>,
    all_silent: u32,
    temperatures_c: PerJoint<u8>,
    turn: usize,
    health: Health,
    sample: Option<ImuSample>,
}

impl<P: Port, B: I2c> HardwareRobot<P, B> {
    /// Takes over a bus and an IMU that [`inspect`] found in order. Nothing moves yet.
    ///
    /// # Errors
    /// [`DeployError::Internal`] where there is no joint, or more than a policy has, [`DeployError::Bus`] where the first
    /// does not answer.
    pub fn new(
        mut bus: Bus<P>,
        imu: ImuChip<B>,
        wiring: &Wiring,
        joints: Vec<JointWiring>,
    ) -> Result<Self, DeployError> {
        let count = joints.len();
        if !(1..=MAX_JOINTS).contains(&count) {
            let what = format!("{count} joints are wired, a policy has 1 to {MAX_JOINTS}");
            return Err(DeployError::Internal { what });
        }
        let water = match &wiring.water {
            Some(water) => {
                let file = std::fs::File::open(&water.file);
                Some(file.map_err(DeployError::folder(&water.file))?)
            }
            None => None,
        };
        let ids: Vec<u8> = joints.iter().map(|j| j.id).collect();
        // Known from the first tick on; then each servo tells in turn.
        let register = &xm430::PRESENT_INPUT_VOLTAGE;
        let deadline = bus.setup_deadline;
        let volts = persistently(|| bus.read(ids[0], register, deadline));
        let (volts, _) = volts.map_err(BusError::from)?;
        let group = |fast| GroupRead::new(&ids, xm430::TICK_ADDRESS, xm430::TICK_BYTES, fast);
        Ok(Self {
            fast: wiring.bus.fast_sync_read.then(|| group(true)),
            plain: group(false),
            goals: goal_group(&ids),
            watchdog_units: (wiring.bus.watchdog_ms / BUS_WATCHDOG_LSB_MS) as i32,
            p_gain: i32::from(wiring.servo.position_p_gain),
            water,
            armed: false,
            start: Instant::now(),
            goal_period_s: None,
            goals_sent: 0,
            newest: ServoReadings {
                time_s: 0.0,
                pos_rad: PerJoint::filled(count, 0.0),
                vel_radps: PerJoint::filled(count, 0.0),
                current_a: PerJoint::filled(count, 0.0),
                supply_v: (VOLTAGE_LSB_V * f64::from(volts)) as f32,
            },
            silent: PerJoint::filled(count, 0),
            all_silent: 0,
            temperatures_c: PerJoint::filled(count, 0),
            turn: 0,
            health: Health::default(),
            sample: None,
            bus,
            imu,
            joints,
            ids,
        })
    }

    /// Counts time in goals, each of which moves it by `period_s`: for an emulated robot that does the same.
    pub fn in_step(mut self, period_s: f64) -> Self {
        self.goal_period_s = Some(period_s);
        self
    }

    /// What the bus counted.
    pub fn bus_counts(&self) -> BusCounts {
        self.bus.counts()
    }

    /// The bus, for tests to play tricks on.
    pub fn bus_mut(&mut self) -> &mut Bus<P> {
        &mut self.bus
    }

    /// Takes what the servos said; how many said nothing, and the first with an alert.
    fn take(&mut self, fast: bool) -> (usize, Option<usize>) {
        let group = match (&self.fast, fast) {
            (Some(group), true) => group,
            _ => &self.plain,
        };
        let (mut missing, mut alert) = (0, None);
        for joint in 0..self.ids.len() {
            let block = group.data(joint);
            let value = |r: &Register| r.value_in(block, xm430::TICK_ADDRESS).unwrap_or_default();
            let Answer::Data(error) = group.answer(joint) else {
                self.silent[joint] += 1;
                missing += 1;
                continue;
            };
            self.silent[joint] = 0;
            if error.alert() {
                alert = alert.or(Some(joint));
            }
            let wiring = &self.joints[joint];
            let sign = f64::from(wiring.direction);
            self.newest.pos_rad[joint] = wiring.joint_rad(value(&xm430::PRESENT_POSITION)) as f32;
            self.newest.vel_radps[joint] =
                (sign * VELOCITY_LSB_RADPS * f64::from(value(&xm430::PRESENT_VELOCITY))) as f32;
            self.newest.current_a[joint] =
                (sign * CURRENT_LSB_A * f64::from(value(&xm430::PRESENT_CURRENT))) as f32;
        }
        (missing, alert)
    }

    /// Looks after one servo: the one with an alert, else the next in turn.
    fn care(&mut self, alert: Option<usize>, deadline: Duration) -> Result<(), BusError> {
        let supply = self.turn % 2 == 1 && alert.is_none();
        let joint = alert.unwrap_or(self.turn / 2);
        self.turn = (self.turn + 1) % (2 * self.ids.len());
        if supply {
            let mut block = [0; xm430::SUPPLY_BYTES as usize];
            if self.look(joint, xm430::SUPPLY_ADDRESS, &mut block, deadline)? {
                let value = |r: &Register| r.value_in(&block, xm430::SUPPLY_ADDRESS);
                let volts = f64::from(value(&xm430::PRESENT_INPUT_VOLTAGE).unwrap_or_default());
                self.newest.supply_v = (VOLTAGE_LSB_V * volts) as f32;
                self.temperatures_c[joint] =
                    value(&xm430::PRESENT_TEMPERATURE).unwrap_or_default() as u8;
                let hottest = self.temperatures_c.iter().max();
                self.health.hottest_c = hottest.copied().unwrap_or_default();
            }
            return Ok(());
        }
        let mut block = [0; xm430::CARE_BYTES as usize];
        if !self.look(joint, xm430::CARE_ADDRESS, &mut block, deadline)? {
            return Ok(());
        }
        let value = |r: &Register| r.value_in(&block, xm430::CARE_ADDRESS).unwrap_or_default();
        let errors = value(&xm430::HARDWARE_ERROR_STATUS) as u8;
        if errors != 0 {
            self.health.alert.get_or_insert((joint, errors));
        }
        if self.armed {
            let watchdog = value(&xm430::BUS_WATCHDOG);
            if watchdog == 255 {
                self.health.watchdog_fired.get_or_insert(joint);
            } else if value(&xm430::TORQUE_ENABLE) != 1
                || watchdog != self.watchdog_units
                || value(&xm430::POSITION_P_GAIN) != self.p_gain
            {
                self.health.restarted.get_or_insert(joint);
            }
        }
        Ok(())
    }

    /// Reads a block of one servo; false where it is silent now, which the next tick's reading shows as well.
    fn look(
        &mut self,
        joint: usize,
        address: u16,
        block: &mut [u8],
        deadline: Duration,
    ) -> Result<bool, BusError> {
        match self.bus.read_block(self.ids[joint], address, block, deadline) {
            Ok(_) => Ok(true),
            Err(BusFault::Silent { .. } | BusFault::Refused { .. }) => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    /// Goals first, then torque, then the watchdog: a servo whose torque comes on with an old goal would
    /// jump.
    fn arm(&mut self) -> Result<(), BusError> {
        let write = |bus: &mut Bus<P>, ids: &[u8], register: &Register, value: i32| {
            let mut group = GroupWrite::new(ids, register.address, register.size);
            (0..ids.len()).for_each(|i| group.set(i, value));
            bus.write_group(&mut group, WRITE_DEADLINE)
        };
        let mut torque = GroupRead::new(
            &self.ids,
            xm430::TORQUE_ENABLE.address,
            xm430::TORQUE_ENABLE.size,
            false,
        );
        // Written to all at once and answered by nobody: what counts is what the servos then say.
        for _ in 0..TORQUE_ON_TIMES {
            write(&mut self.bus, &self.ids, &xm430::TORQUE_ENABLE, 1)?;
            self.bus.read_group(&mut torque, ARM_DEADLINE)?;
            let on =
                |i: &usize| matches!(torque.answer(*i), Answer::Data(_)) && torque.data(*i) == [1];
            if (0..self.ids.len()).all(|i| on(&i)) {
                write(&mut self.bus, &self.ids, &xm430::BUS_WATCHDOG, self.watchdog_units)?;
                self.armed = true;
                return Ok(());
            }
        }
        let off = (0..self.ids.len()).find(|i| torque.data(*i) != [1]).unwrap_or_default();
        Err(BusError::Lost {
            reason: format!("servo {} does not switch its torque on", self.ids[off]),
        })
    }
}

fn goal_group(ids: &[u8]) -> GroupWrite {
    GroupWrite::new(ids, xm430::GOAL_POSITION.address, xm430::GOAL_POSITION.size)
}

impl<P: Port, B: I2c> ServoBus for HardwareRobot<P, B> {
    fn read(&mut self, deadline: Duration) -> Result<ServoReadings, BusError> {
        let end = self.bus.now() + deadline;
        let fast = self.fast.is_some() && !self.bus.fast_is_hopeless();
        let group = match (&mut self.fast, fast) {
            (Some(group), true) => group,
            _ => &mut self.plain,
        };
        self.bus.read_group(group, deadline)?;
        let (missing, alert) = self.take(fast);
        self.health.silent_ticks = self.silent.iter().copied().max().unwrap_or_default();
        if missing == self.ids.len() {
            self.all_silent += 1;
            if self.all_silent >= ALL_SILENT_MAX {
                let reason = format!("no servo answered for {ALL_SILENT_MAX} ticks");
                return Err(BusError::Lost { reason });
            }
            return Err(BusError::Timeout { deadline });
        }
        self.all_silent = 0;
        // Waiting for a silent servo took the whole deadline.
        let left = end.saturating_duration_since(self.bus.now()).min(deadline.mul_f64(CARE_SHARE));
        if missing == 0 && !left.is_zero() {
            self.care(alert, left)?;
        }
        self.newest.time_s = match self.goal_period_s {
            Some(period_s) => period_s * self.goals_sent as f64,
            None => self.start.elapsed().as_secs_f64(),
        };
        Ok(self.newest)
    }

    fn write(&mut self, targets_rad: &PerJoint) -> Result<(), BusError> {
        for (index, (joint, target)) in self.joints.iter().zip(targets_rad).enumerate() {
            self.goals.set(index, joint.counts(f64::from(*target)));
        }
        self.bus.write_group(&mut self.goals, WRITE_DEADLINE)?;
        self.goals_sent += 1;
        if !self.armed {
            self.arm()?;
        }
        Ok(())
    }

    fn torque_off(&mut self) -> Result<(), BusError> {
        let patience = self.bus.setup_deadline;
        let found = let_go(&mut self.bus, &self.ids, patience);
        self.armed = false;
        let found = found?;
        if !found.hold.is_empty() || !found.silent.is_empty() {
            return Err(BusError::Holds { found });
        }
        // The torque is off; the watchdog has nothing to watch any more.
        let _ = self.bus.broadcast(&xm430::BUS_WATCHDOG, 0);
        Ok(())
    }
}

impl<P: Port, B: I2c> Imu for HardwareRobot<P, B> {
    fn reading(&mut self) -> Result<ImuReading, BusError> {
        match self.imu.sample() {
            Ok(sample) => {
                let same = self.sample == Some(sample);
                self.health.imu_same_ticks = if same { self.health.imu_same_ticks + 1 } else { 0 };
                self.health.imu_stale_ticks = 0;
                self.sample = Some(sample);
            }
            Err(_) => self.health.imu_stale_ticks += 1,
        }
        let sample = self
            .sample
            .ok_or_else(|| BusError::Lost { reason: "the IMU gives nothing".to_owned() })?;
        Ok(ImuReading { gyro_radps: sample.gyro_radps, acc_mps2: sample.acc_mps2, gravity: None })
    }
}

impl<P: Port, B: I2c> Robot for HardwareRobot<P, B> {
    fn health(&self) -> Health {
        self.health
    }

    fn in_water(&mut self) -> Option<bool> {
        use std::os::unix::fs::FileExt;
        let mut value = [0];
        let file = self.water.as_ref()?;
        // A line of the system: one byte, no disk behind it.
        matches!(file.read_at(&mut value, 0), Ok(1)).then(|| value[0] == b'1')
    }
}

#[cfg(test)]
mod latencies;
#[cfg(test)]
mod tests;
