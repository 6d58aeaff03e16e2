//! What must be right before any torque goes on: every servo and what it holds, the supply, the pose, the
//! IMU.

use caudata_dynamixel::setup::{
    TRIES, Want, compare, find_baud, hardware_error, move_to_baud, persistently,
};
use caudata_dynamixel::units::{CURRENT_LSB_A, RETURN_DELAY_LSB_US, VOLTAGE_LSB_V};
use caudata_dynamixel::{Bus, BusFault, Port, xm430};
use caudata_hardware::{I2c, ImuChip, JointWiring, Wiring};
use caudata_model::RobotModel;
use serde::Serialize;

/// How far outside its limits a joint may stand and still start, rad: play and sag.
pub const LIMIT_MARGIN_RAD: f64 = 0.1;
/// A level robot's gravity may lean this much, cosine of 20°.
const LEVEL_COS: f32 = 0.94;
/// Specific force at rest, m/s², and how far it may be off.
const G_MPS2: f32 = 9.806_65;
const G_TOLERANCE_MPS2: f32 = 1.0;
/// A robot at rest turns slower than this, rad/s (the gyroscope's offset is 1 °/s typical).
const REST_RADPS: f32 = 0.2;
/// IMU samples that are averaged.
const IMU_SAMPLES: u16 = 20;

/// How a check went.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Mark {
    /// As it must be.
    Good,
    /// It was wrong, and was set right.
    Fixed,
    /// It is wrong.
    Wrong,
}

/// One check.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Check {
    /// Joint name, `imu` or `bus`.
    pub at: String,
    /// What was looked at.
    pub what: String,
    /// What was found, and what it must be where it differs.
    pub found: String,
    /// How it went.
    pub mark: Mark,
}

/// All checks of one inspection.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Inspection {
    /// In the order they were made.
    pub checks: Vec<Check>,
}

impl Inspection {
    fn add(&mut self, at: &str, what: &str, found: String, mark: Mark) {
        self.checks.push(Check { at: at.to_owned(), what: what.to_owned(), found, mark });
    }

    fn judge(&mut self, at: &str, what: &str, found: String, good: bool) {
        self.add(at, what, found, if good { Mark::Good } else { Mark::Wrong });
    }

    /// What is wrong.
    pub fn wrong(&self) -> impl Iterator<Item = &Check> {
        self.checks.iter().filter(|c| c.mark == Mark::Wrong)
    }
}

/// Inspects all servos; with `fix`, speeds and registers are set right. The torque is off afterwards.
///
/// # Errors
/// [`BusFault::Port`]: the port itself fails. A servo that does not answer is a finding.
pub fn servos<P: Port>(
    bus: &mut Bus<P>,
    wiring: &Wiring,
    joints: &[JointWiring],
    model: &RobotModel,
    fix: bool,
) -> Result<Inspection, BusFault> {
    let mut inspection = Inspection::default();
    let names = model.actuated_names();
    for (index, (joint, name)) in joints.iter().zip(names).enumerate() {
        let (low, high) = model.joint_limits_rad()[index];
        let limits = [low, high];
        match servo(bus, wiring, joint, limits, name, fix, &mut inspection) {
            Err(error @ BusFault::Port(_)) => return Err(error),
            Err(error) => inspection.add(name, "answers", error.to_string(), Mark::Wrong),
            Ok(()) => {}
        }
        if bus.baud() != wiring.bus.baud {
            bus.set_baud(wiring.bus.baud)?;
        }
    }
    Ok(inspection)
}

fn servo<P: Port>(
    bus: &mut Bus<P>,
    wiring: &Wiring,
    joint: &JointWiring,
    limits_rad: [f64; 2],
    name: &str,
    fix: bool,
    inspection: &mut Inspection,
) -> Result<(), BusFault> {
    let (id, baud, deadline) = (joint.id, wiring.bus.baud, bus.setup_deadline);
    let found = find_baud(bus, id)?;
    if found != baud {
        let text = format!("{found}, must be {baud}");
        if !fix {
            inspection.add(name, "baud", text, Mark::Wrong);
            return Ok(());
        }
        move_to_baud(bus, id, baud)?;
        inspection.add(name, "baud", text, Mark::Fixed);
    }
    let pong = persistently(|| bus.ping(id, deadline))?;
    let expected = joint.model.number();
    let what = format!("id {id}: model {}, firmware {}", pong.model, pong.firmware);
    inspection.judge(name, "model", what, pong.model == expected);
    let errors = hardware_error(bus, id)?;
    inspection.judge(name, "hardware errors", errors.to_string(), errors.is_none());
    // Settings kept without power are locked while the torque is on.
    persistently(|| bus.write(id, &xm430::TORQUE_ENABLE, 0, deadline))?;
    for finding in compare(bus, id, &wants(wiring, joint, limits_rad), fix)? {
        let text = format!("{}, must be {}", finding.found, finding.want.value);
        let mark = if finding.right { Mark::Fixed } else { Mark::Wrong };
        inspection.add(name, finding.want.register.name, text, mark);
    }
    let (volts, _) = persistently(|| bus.read(id, &xm430::PRESENT_INPUT_VOLTAGE, deadline))?;
    let volts = (VOLTAGE_LSB_V * f64::from(volts)) as f32;
    let limits = &wiring.limits;
    let good = (limits.supply_min_v..=limits.supply_max_v).contains(&volts);
    inspection.judge(name, "supply", format!("{volts:.1} V"), good);
    let (heat, _) = persistently(|| bus.read(id, &xm430::PRESENT_TEMPERATURE, deadline))?;
    let good = heat < i32::from(limits.temperature_max_c);
    inspection.judge(name, "temperature", format!("{heat} °C"), good);
    let (counts, _) = persistently(|| bus.read(id, &xm430::PRESENT_POSITION, deadline))?;
    let at_rad = joint.joint_rad(counts);
    let [low, high] = limits_rad;
    let good = at_rad > low - LIMIT_MARGIN_RAD && at_rad < high + LIMIT_MARGIN_RAD;
    let text = format!(
        "{:.1}° within {:.0}° to {:.0}°",
        at_rad.to_degrees(),
        low.to_degrees(),
        high.to_degrees()
    );
    inspection.judge(name, "position", text, good);
    Ok(())
}

/// What a servo must hold.
fn wants(wiring: &Wiring, joint: &JointWiring, limits_rad: [f64; 2]) -> Vec<Want> {
    let ends = limits_rad.map(|rad| joint.counts(rad).clamp(0, 4095));
    let servo = &wiring.servo;
    let want = |register, value| Want { register, value };
    vec![
        // It was told to: one that does not let go is not set right by telling it again.
        want(&xm430::TORQUE_ENABLE, 0),
        want(&xm430::RETURN_DELAY_TIME, (wiring.bus.return_delay_us / RETURN_DELAY_LSB_US) as i32),
        want(&xm430::DRIVE_MODE, 0),
        want(&xm430::OPERATING_MODE, i32::from(servo.operating_mode)),
        want(&xm430::HOMING_OFFSET, 0),
        want(&xm430::TEMPERATURE_LIMIT, i32::from(servo.temperature_limit_c)),
        want(&xm430::CURRENT_LIMIT, (servo.current_limit_a / CURRENT_LSB_A).round() as i32),
        want(&xm430::MAX_POSITION_LIMIT, ends[0].max(ends[1])),
        want(&xm430::MIN_POSITION_LIMIT, ends[0].min(ends[1])),
        want(&xm430::STATUS_RETURN_LEVEL, 2),
        want(&xm430::POSITION_D_GAIN, i32::from(servo.position_d_gain)),
        want(&xm430::POSITION_I_GAIN, i32::from(servo.position_i_gain)),
        want(&xm430::POSITION_P_GAIN, i32::from(servo.position_p_gain)),
        // A watchdog that fired refuses goals until it is cleared.
        want(&xm430::BUS_WATCHDOG, 0),
        want(&xm430::PROFILE_ACCELERATION, 0),
        want(&xm430::PROFILE_VELOCITY, 0),
    ]
}

/// Inspects the IMU of a robot that rests on its feet or belly: it feels gravity, upwards along z, and does
/// not turn.
pub fn imu<B: I2c>(chip: &mut ImuChip<B>) -> Inspection {
    let mut inspection = Inspection::default();
    let (mut acc, mut gyro) = ([0.0; 3], [0.0; 3]);
    for _ in 0..IMU_SAMPLES {
        // One question that nobody answered in time says nothing about a bus where nothing moves yet.
        let mut asked = 1;
        let sample = loop {
            match chip.sample() {
                Err(_) if asked < TRIES => asked += 1,
                other => break other,
            }
        };
        let sample = match sample {
            Ok(sample) => sample,
            Err(error) => {
                inspection.add("imu", "answers", error.to_string(), Mark::Wrong);
                return inspection;
            }
        };
        for axis in 0..3 {
            acc[axis] += sample.acc_mps2[axis] / f32::from(IMU_SAMPLES);
            gyro[axis] += sample.gyro_radps[axis] / f32::from(IMU_SAMPLES);
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let norm = |v: [f32; 3]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
    let size = norm(acc);
    let good = (size - G_MPS2).abs() < G_TOLERANCE_MPS2;
    inspection.judge("imu", "gravity", format!("{size:.2} m/s²"), good);
    let [x, y, z] = acc.map(|a| a / size.max(1e-6));
    let text = format!("up is {x:.2} forward, {y:.2} left, {z:.2} up");
    inspection.judge("imu", "axes", text, z > LEVEL_COS);
    let turning = norm(gyro);
    inspection.judge("imu", "at rest", format!("{turning:.3} rad/s"), turning < REST_RADPS);
    inspection
}
