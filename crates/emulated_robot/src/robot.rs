//! One simulated robot behind control tables and IMU registers.

use caudata_dynamixel::emulator::{EmulatedBus, EmulatedServo, Present};
use caudata_dynamixel::units::{
    CURRENT_LSB_A, VELOCITY_LSB_RADPS, VOLTAGE_LSB_V, register_of_baud,
};
use caudata_dynamixel::xm430;
use caudata_env::WaterSensor;
use caudata_hardware::emulated::EmulatedBridge;
use caudata_hardware::{JointWiring, Wiring};
use caudata_random::{Key, Purpose, Stream};
use caudata_sim::sensors::{self, ImuBias};
use caudata_sim::{Engine, InitialState, LaneParams};
use serde::Serialize;

use crate::EmulationError;

/// What the servos' thermometers show, °C: heating is not simulated.
const TEMPERATURE_C: u8 = 32;
/// Time over which a direction of travel is taken, s: more than a stride, so that the sway of the head
/// averages out.
const WINDOW_S: f64 = 1.0;
/// Beginning and end of a walk that do not count: standing up and returning, s.
const LEAD_IN_S: f64 = 5.0;
const LEAD_OUT_S: f64 = 3.0;

/// How far it went with the torque on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Travel {
    /// How long the torque was on, s.
    pub torque_on_s: f64,
    /// Distance along its own heading, m.
    pub forward_m: f64,
    /// Mean speed along its own heading without the first 5 s and the last 3 s, m/s; null where it was on for
    /// less.
    pub forward_mps: Option<f64>,
    /// Lowest height of the base, m.
    pub height_min_m: f64,
}

/// Follows the base while the torque is on.
#[derive(Clone, Debug, Default)]
struct Trace {
    /// Beginning of the present window: time, s, and place, m; and the sum of headings in it.
    window: Option<(f64, [f64; 2], [f64; 2])>,
    forward_m: f64,
    /// (time, forward distance) at the end of every window.
    steps: Vec<(f64, f64)>,
    height_min_m: f64,
}

/// Windows of a trace that are remembered: 18 hours; a longer walk is judged by its last ones.
const STEPS_MAX: usize = 1 << 16;

impl Trace {
    fn add(&mut self, time_s: f64, pos_m: [f64; 3], yaw_rad: f64) {
        let at = [pos_m[0], pos_m[1]];
        let Some((begun_s, from_m, heading)) = &mut self.window else {
            self.window = Some((time_s, at, [yaw_rad.cos(), yaw_rad.sin()]));
            self.steps.push((time_s, 0.0));
            self.height_min_m = pos_m[2];
            return;
        };
        heading[0] += yaw_rad.cos();
        heading[1] += yaw_rad.sin();
        self.height_min_m = self.height_min_m.min(pos_m[2]);
        if time_s - *begun_s < WINDOW_S {
            return;
        }
        let size = heading[0].hypot(heading[1]).max(1e-9);
        let along = (0..2).map(|i| heading[i] / size * (at[i] - from_m[i]));
        self.forward_m += along.sum::<f64>();
        self.window = Some((time_s, at, [yaw_rad.cos(), yaw_rad.sin()]));
        if self.steps.len() == STEPS_MAX {
            self.steps.drain(..STEPS_MAX / 2);
        }
        self.steps.push((time_s, self.forward_m));
    }

    fn travel(&self) -> Option<Travel> {
        let (first, last) = (self.steps.first()?, self.steps.last()?);
        let at = |time: f64| self.steps.partition_point(|(t, _)| *t < time);
        let begin = self.steps.get(at(first.0 + LEAD_IN_S));
        let end = self.steps.get(at(last.0 - LEAD_OUT_S));
        let speed = match (begin, end) {
            (Some(a), Some(b)) if b.0 - a.0 >= 1.0 => Some((b.1 - a.1) / (b.0 - a.0)),
            _ => None,
        };
        Some(Travel {
            torque_on_s: last.0 - first.0,
            forward_m: self.forward_m,
            forward_mps: speed,
            height_min_m: self.height_min_m,
        })
    }
}

/// The robot.
pub struct EmulatedRobot {
    engine: Box<dyn Engine>,
    with_torque: LaneParams,
    joints: Vec<JointWiring>,
    wiring: Wiring,
    /// The servos.
    pub bus: EmulatedBus,
    /// The IMU.
    pub bridge: EmulatedBridge,
    stream: Stream,
    bias: ImuBias,
    /// Its sensor for water.
    pub water: Option<WaterSensor>,
    torque: Vec<bool>,
    steps: u64,
    trace: Trace,
}

impl EmulatedRobot {
    /// Servos at the bus's speed and otherwise as from the factory, around lane 0 of `engine`, which stands
    /// in the nominal pose.
    ///
    /// # Errors
    /// [`EmulationError::Wiring`] where the joints are not the robot's, [`EmulationError::Sim`].
    pub fn new(
        mut engine: Box<dyn Engine>,
        wiring: &Wiring,
        seed: u64,
    ) -> Result<Self, EmulationError> {
        let joints =
            wiring.joints(&engine.model().actuated_names()).map_err(EmulationError::Wiring)?;
        let baud = register_of_baud(wiring.bus.baud).unwrap_or(1);
        let servos = joints.iter().map(|joint| {
            let mut servo = EmulatedServo::new(joint.id, joint.model.number());
            servo.put(&xm430::BAUD_RATE, i32::from(baud));
            servo
        });
        let bus = EmulatedBus::new(servos.collect(), seed);
        let mut stream = Stream::new(Key::for_run(seed), Purpose::Sensor);
        let bias = match &engine.model().sensors().imu {
            Some(imu) => ImuBias::draw(imu, &mut stream),
            None => ImuBias::default(),
        };
        let start = InitialState::nominal(engine.model());
        engine.reset(0, &start)?;
        let mut robot = Self {
            with_torque: engine.params(0).clone(),
            torque: vec![true; joints.len()],
            wiring: wiring.clone(),
            bridge: EmulatedBridge::default(),
            steps: 0,
            trace: Trace::default(),
            water: None,
            engine,
            joints,
            bus,
            stream,
            bias,
        };
        robot.sense();
        Ok(robot)
    }

    /// Puts it somewhere else, as a hand would; servos keep their goals.
    ///
    /// # Errors
    /// [`EmulationError::Sim`] where `start` is not one of this robot.
    pub fn place(&mut self, start: &InitialState) -> Result<(), EmulationError> {
        self.engine.reset(0, start)?;
        self.sense();
        Ok(())
    }

    /// Time of its physics, s.
    pub fn time_s(&self) -> f64 {
        self.steps as f64 * self.step_s()
    }

    /// One step of it, s.
    pub fn step_s(&self) -> f64 {
        self.engine.config().control_period_s()
    }

    /// Position of the base, world, m.
    pub fn base_pos_m(&self) -> [f64; 3] {
        std::array::from_fn(|i| f64::from(self.engine.state().base_pos_m[i]))
    }

    /// Whether its sensor says that it swims; false without one.
    pub fn in_water(&self) -> bool {
        let sensor = self.water.as_ref();
        sensor.is_some_and(|sensor| sensor.in_water(self.engine.as_ref(), 0))
    }

    /// How far it went since the torque came on last; `None` where it never did.
    pub fn travel(&self) -> Option<Travel> {
        self.trace.travel()
    }

    /// Whether any servo has torque.
    pub fn torque_on(&self) -> bool {
        self.bus.servos.iter().any(EmulatedServo::torque_on)
    }

    /// Lets one step pass: servos pull towards their goals, sensors show what came of it.
    pub fn step(&mut self) -> Result<(), EmulationError> {
        let was_on = self.torque.iter().any(|on| *on);
        self.follow_torque()?;
        let servos = self.bus.servos.iter();
        let goals: Vec<f32> = servos
            .zip(&self.joints)
            .map(|(servo, joint)| joint.joint_rad(servo.goal()) as f32)
            .collect();
        self.engine.step(&goals, &[0.0; 6])?;
        self.steps += 1;
        if self.engine.state().diverged[0] {
            return Err(EmulationError::Diverged);
        }
        if self.torque_on() {
            if !was_on {
                self.trace = Trace::default();
            }
            let quat = &self.engine.state().base_quat_wxyz;
            let [w, x, y, z] = std::array::from_fn(|i| f64::from(quat[i]));
            let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
            let (time_s, pos_m) = (self.time_s(), self.base_pos_m());
            self.trace.add(time_s, pos_m, yaw);
        }
        self.sense();
        Ok(())
    }

    /// Servos without torque turn freely.
    fn follow_torque(&mut self) -> Result<(), EmulationError> {
        let torque: Vec<bool> = self.bus.servos.iter().map(EmulatedServo::torque_on).collect();
        if torque == self.torque {
            return Ok(());
        }
        let mut params = self.with_torque.clone();
        for (joint, on) in torque.iter().enumerate() {
            if !on {
                params.torque_scale[joint] = 0.0;
                params.kp_nm_per_rad[joint] = 0.0;
                params.kd_nms_per_rad[joint] = 0.0;
            }
        }
        self.engine.set_params(0, &params)?;
        self.torque = torque;
        Ok(())
    }

    /// Control tables and IMU registers show the present state.
    fn sense(&mut self) {
        let now_us = (self.time_s() * 1e6) as u64;
        let dt_s = self.step_s();
        let (model, state) = (self.engine.model(), self.engine.state());
        let supply_v = self.engine.params(0).supply_v;
        for (index, joint) in self.joints.iter().enumerate() {
            let at = model.actuated()[index];
            let sign = f64::from(joint.direction);
            let seen_rad = state.encoder_pos_rad(0, at, index);
            let seen_radps = state.encoder_vel_radps(0, at, index);
            let velocity = sign * f64::from(seen_radps) / VELOCITY_LSB_RADPS;
            let current = sensors::current_a(model.servo(index), state.motor_torque_nm[index]);
            let present = Present {
                position: joint.counts(f64::from(seen_rad)),
                velocity: velocity.round() as i32,
                current: (sign * f64::from(current) / CURRENT_LSB_A).round() as i16,
                voltage: (f64::from(supply_v) / VOLTAGE_LSB_V).round() as u16,
                temperature: TEMPERATURE_C,
            };
            if let Some(servo) = self.bus.servos.get_mut(index) {
                servo.sense(present, now_us);
            }
        }
        let (bias, stepped) = (&self.bias, self.steps > 0);
        let (gyro, acc) = sensors::imu(model, state, bias, stepped, dt_s, &mut self.stream);
        let back = |v| self.wiring.imu.turned_back(v);
        self.bridge.imu.feel(back(gyro), back(acc));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn speed_is_along_the_own_heading_without_beginning_and_end() {
        // 2 s of standing, 16 s at 0.25 m/s along world y facing y, 2 s of standing: 5 s and 3 s are left
        // out, 12 s of walking count.
        let mut trace = Trace::default();
        for step in 0..=5000_u32 {
            let time_s = 0.004 * f64::from(step);
            let y = 0.25 * (time_s - 2.0).clamp(0.0, 16.0);
            trace.add(time_s, [0.0, y, 0.1], std::f64::consts::FRAC_PI_2);
        }
        let travel = trace.travel().unwrap();
        // What the last window has begun does not count yet.
        assert!((travel.forward_m - 4.0).abs() < 1e-6, "{travel:?}");
        assert!((travel.forward_mps.unwrap() - 0.25).abs() < 1e-3, "{travel:?}");
    }
}
