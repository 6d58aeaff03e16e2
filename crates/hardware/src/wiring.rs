//! The wiring file: which servo is which joint, which way it turns, where its zero is, and how the IMU sits.
//!
//! It belongs to one robot on one bench, not to the robot model: two robots of one model differ in it.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use caudata_durable::read_text_at_most;
use caudata_dynamixel::units::{
    BUS_WATCHDOG_LSB_MS, CURRENT_LSB_A, RETURN_DELAY_LSB_US, counts_to_rad, rad_to_counts,
    register_of_baud,
};
use caudata_dynamixel::xm430::{MODEL_W210, MODEL_W350, MODEL_XL330_M077, MODEL_XL330_M288};
use serde::Deserialize;

/// `format` of a wiring file.
pub const WIRING_FORMAT: &str = "caudata.wiring.v1";

/// Why a wiring file is not taken.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "a message says what its fields are")]
pub enum WiringError {
    /// It cannot be read.
    #[error("wiring file {}: {source}", path.display())]
    Read { path: PathBuf, source: std::io::Error },
    /// It says something that cannot be.
    #[error("wiring file {}: {reason}", path.display())]
    Wrong { path: PathBuf, reason: String },
}

/// The whole file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wiring {
    /// [`WIRING_FORMAT`].
    pub format: String,
    /// Name of the robot model.
    pub robot: String,
    /// The servo bus.
    pub bus: BusWiring,
    /// What every servo holds.
    pub servo: ServoSettings,
    /// Limits beyond which the robot stops by itself.
    pub limits: Limits,
    /// The joints, by name.
    pub joint: BTreeMap<String, JointWiring>,
    /// The IMU.
    pub imu: ImuWiring,
    /// What tells water from land; absent: land.
    #[serde(default)]
    pub water: Option<WaterWiring>,
}

/// The servo bus.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BusWiring {
    /// Serial port.
    pub port: PathBuf,
    /// Bits per second.
    pub baud: u32,
    /// One common answer of all servos (firmware 42 and later; the manual's page on Fast Sync Read).
    pub fast_sync_read: bool,
    /// Pause of a servo before its answer, µs.
    pub return_delay_us: u64,
    /// A servo that hears nothing for this long stops by itself, ms.
    pub watchdog_ms: u64,
    /// How long a tick waits for readings, ms.
    pub read_deadline_ms: u64,
}

/// What every servo holds.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServoSettings {
    /// Operating Mode: 3 position, 5 position with a current limit.
    pub operating_mode: u8,
    /// Position P Gain.
    pub position_p_gain: u16,
    /// Position I Gain.
    pub position_i_gain: u16,
    /// Position D Gain.
    pub position_d_gain: u16,
    /// Current Limit, A.
    pub current_limit_a: f64,
    /// Temperature Limit, °C.
    pub temperature_limit_c: u8,
}

/// Limits beyond which the robot stops by itself.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Below this supply the robot does not start, and stands down, V.
    pub supply_min_v: f32,
    /// Above it too, V.
    pub supply_max_v: f32,
    /// A servo this hot stands the robot down, °C.
    pub temperature_max_c: u8,
    /// A joint that draws more than this for half a second stands the robot down, A.
    pub current_max_a: f32,
}

/// One joint.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointWiring {
    /// Id of its servo.
    pub id: u8,
    /// Model of its servo.
    #[serde(default = "default_model")]
    pub model: ServoModel,
    /// +1: the servo's positive direction is the joint's; −1: the opposite.
    pub direction: i8,
    /// Position of the servo (angle from the middle of its turn, rad) at which the joint is at zero.
    pub zero_rad: f64,
}

fn default_model() -> ServoModel {
    ServoModel::Xm430W210
}

/// Which servo.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub enum ServoModel {
    /// XM430-W210.
    #[serde(rename = "xm430_w210")]
    Xm430W210,
    /// XM430-W350.
    #[serde(rename = "xm430_w350")]
    Xm430W350,
    /// XL330-M288-T.
    #[serde(rename = "xl330_m288")]
    Xl330M288,
    /// XL330-M077-T.
    #[serde(rename = "xl330_m077")]
    Xl330M077,
}

impl ServoModel {
    /// Its model number.
    pub fn number(self) -> u16 {
        match self {
            Self::Xm430W210 => MODEL_W210,
            Self::Xm430W350 => MODEL_W350,
            Self::Xl330M288 => MODEL_XL330_M288,
            Self::Xl330M077 => MODEL_XL330_M077,
        }
    }
}

impl JointWiring {
    /// The joint's angle, rad, at a servo position.
    pub fn joint_rad(&self, counts: i32) -> f64 {
        f64::from(self.direction) * (counts_to_rad(counts) - self.zero_rad)
    }

    /// The servo position, counts, for a joint's angle.
    pub fn counts(&self, joint_rad: f64) -> i32 {
        rad_to_counts(f64::from(self.direction) * joint_rad + self.zero_rad)
    }
}

/// The IMU.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImuWiring {
    /// A Linux I²C bus (`/dev/i2c-1`), or `bridge:` and the serial port of a bridge.
    pub bus: String,
    /// Address of the LSM6DSOX.
    pub address: u8,
    /// Which of the chip's axes point forward, left and up.
    pub axes: [Axis; 3],
}

/// An axis of the chip, with its sign.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
pub enum Axis {
    /// Along x.
    #[serde(rename = "+x")]
    PlusX,
    /// Against x.
    #[serde(rename = "-x")]
    MinusX,
    /// Along y.
    #[serde(rename = "+y")]
    PlusY,
    /// Against y.
    #[serde(rename = "-y")]
    MinusY,
    /// Along z.
    #[serde(rename = "+z")]
    PlusZ,
    /// Against z.
    #[serde(rename = "-z")]
    MinusZ,
}

impl Axis {
    /// Which axis, and its sign.
    fn parts(self) -> (usize, f32) {
        match self {
            Self::PlusX => (0, 1.0),
            Self::MinusX => (0, -1.0),
            Self::PlusY => (1, 1.0),
            Self::MinusY => (1, -1.0),
            Self::PlusZ => (2, 1.0),
            Self::MinusZ => (2, -1.0),
        }
    }
}

impl ImuWiring {
    /// A vector of the chip in the robot's axes (forward, left, up).
    pub fn turned(&self, chip: [f32; 3]) -> [f32; 3] {
        self.axes.map(|axis| {
            let (index, sign) = axis.parts();
            sign * chip[index]
        })
    }

    /// A vector of the robot in the chip's axes.
    pub fn turned_back(&self, robot: [f32; 3]) -> [f32; 3] {
        let mut chip = [0.0; 3];
        for (axis, value) in self.axes.iter().zip(robot) {
            let (index, sign) = axis.parts();
            chip[index] = sign * value;
        }
        chip
    }

    /// Whether the axes are a right-handed set.
    fn right_handed(&self) -> bool {
        let rows = self.axes.map(Axis::parts);
        let at = |row: usize, column: usize| {
            if rows[row].0 == column { rows[row].1 } else { 0.0 }
        };
        let minor = |a: usize, b: usize| at(1, a) * at(2, b) - at(1, b) * at(2, a);
        at(0, 0) * minor(1, 2) - at(0, 1) * minor(0, 2) + at(0, 2) * minor(0, 1) == 1.0
    }
}

/// What tells that the robot swims: a file of the system that holds 0 or 1, such as the value of a GPIO line.
/// 1 stands for water that is too deep to walk in (`afloat_above_m` in the policy's contract).
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WaterWiring {
    /// The file.
    pub file: PathBuf,
}

/// Highest supply of a robot of this kind, V: twelve lithium cells.
const SUPPLY_MAX_V: f32 = 52.0;

/// Largest wiring file that is read, bytes.
const FILE_BYTES_MAX: u64 = 1 << 20;

impl Wiring {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`WiringError`] with what is wrong.
    pub fn read(path: &Path) -> Result<Self, WiringError> {
        let wrong = |reason| WiringError::Wrong { path: path.to_owned(), reason };
        let text =
            read_text_at_most(path, FILE_BYTES_MAX).map_err(|source| match source.kind() {
                ErrorKind::FileTooLarge | ErrorKind::InvalidData => wrong(source.to_string()),
                _ => WiringError::Read { path: path.to_owned(), source },
            })?;
        Self::parse(&text).map_err(wrong)
    }

    /// Parses and checks.
    ///
    /// # Errors
    /// What is wrong, in one line.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wiring: Self =
            toml::from_str(text).map_err(|e| e.to_string().trim().replace('\n', " "))?;
        wiring.check()?;
        Ok(wiring)
    }

    fn check(&self) -> Result<(), String> {
        let Self { bus, servo, limits, .. } = self;
        if self.format != WIRING_FORMAT {
            return Err(format!("format is `{}`, not `{WIRING_FORMAT}`", self.format));
        }
        if register_of_baud(bus.baud).is_none() {
            return Err(format!("bus.baud: servos have no speed of {}", bus.baud));
        }
        if bus.return_delay_us > 254 * RETURN_DELAY_LSB_US {
            return Err("bus.return_delay_us is at most 508".to_owned());
        }
        if !(BUS_WATCHDOG_LSB_MS..=127 * BUS_WATCHDOG_LSB_MS).contains(&bus.watchdog_ms) {
            return Err("bus.watchdog_ms must be 20 to 2540: without it a robot whose computer dies walks on".to_owned());
        }
        if !(1..=1000).contains(&bus.read_deadline_ms) {
            return Err("bus.read_deadline_ms must be 1 to 1000".to_owned());
        }
        if ![3, 5].contains(&servo.operating_mode) {
            return Err("servo.operating_mode must be 3 or 5".to_owned());
        }
        if !(servo.current_limit_a > 0.0 && servo.current_limit_a <= 1193.0 * CURRENT_LSB_A) {
            return Err("servo.current_limit_a must be above 0 and at most 3.2".to_owned());
        }
        let volts = limits.supply_min_v > 0.0 && limits.supply_min_v < limits.supply_max_v;
        if !(volts && limits.supply_max_v <= SUPPLY_MAX_V && limits.current_max_a > 0.0) {
            return Err(format!(
                "limits: 0 < supply_min_v < supply_max_v <= {SUPPLY_MAX_V}, and current_max_a > 0"
            ));
        }
        let mut ids = BTreeSet::new();
        for (name, joint) in &self.joint {
            if joint.id > caudata_dynamixel::frame::ID_MAX || !ids.insert(joint.id) {
                return Err(format!("joint.{name}: id {} is taken or above 252", joint.id));
            }
            if joint.direction.abs() != 1 {
                return Err(format!("joint.{name}: direction must be 1 or -1"));
            }
            if joint.zero_rad.is_nan() || joint.zero_rad.abs() > std::f64::consts::PI {
                return Err(format!("joint.{name}: zero_rad must be within half a turn"));
            }
        }
        if !self.imu.right_handed() {
            return Err("imu.axes must be three different axes and right-handed".to_owned());
        }
        Ok(())
    }

    /// The joints in the order of `names`.
    ///
    /// # Errors
    /// Which joint is missing or unknown.
    pub fn joints(&self, names: &[&str]) -> Result<Vec<JointWiring>, String> {
        if let Some(extra) = self.joint.keys().find(|k| !names.contains(&k.as_str())) {
            return Err(format!("joint.{extra}: the robot has no such joint"));
        }
        let of = |name: &&str| {
            self.joint.get(*name).cloned().ok_or_else(|| format!("joint.{name} is missing"))
        };
        names.iter().map(of).collect()
    }
}
