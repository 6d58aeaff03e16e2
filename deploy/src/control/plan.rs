//! What a control loop is asked to do, what it senses and what it counts.

use std::time::Duration;

use caudata_hardware::wiring::Limits;
use caudata_proto::registry::TRIAL_S;
use caudata_task::{COMMAND_DIM, PerJoint};

use super::legs::{LegOdometry, Posture};
use crate::DeployError;
use crate::bus::{GroundTruth, Health, ImuReading, Robot, ServoReadings};
use crate::orientation::GravityFilter;
use crate::summary::{Latencies, Odometer, Velocity, rounded};
use crate::walk_command::CommandTable;

/// Mean speed of the joints below which the robot counts as standing still, rad/s. Servos report in steps of
/// 0.024 rad/s.
pub const STILL_RADPS: f32 = 0.1;
/// Ticks in a row of that, with the command at zero, before a newer policy is swapped in (0.2 s).
pub const STILL_TICKS: u32 = 10;

/// Ticks over which velocities of joints are averaged before they count as walking (0.2 s): what vibrates goes
/// nowhere.
const SWING_TICKS: f32 = 10.0;
/// Ticks over which commands and the robot's own velocity are averaged (1 s, longer than a stride): what alternates
/// goes nowhere.
const STRIDE_TICKS: f32 = 50.0;
/// Share of the command that a robot must go by in the mean. The shipped policies' legs tell 0.87 to 1.1 of it; those
/// of policies of 6 and 12 iterations, which swing in place, 0.02 at most.
const GOES_SHARE: f32 = 1.0 / 3.0;
/// Least command that counts as one to walk, norm of m/s and rad/s: three times the one at which the clocks of the
/// shipped policies stop.
const WALK_COMMAND: f32 = 0.03;

/// What a policy has shown so far.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Trial {
    /// Ticks of walking since it took over, or since its last bad action.
    pub(super) ticks: u32,
    /// Ticks of walking since it took over.
    pub(super) walked_ticks: u32,
    /// Ticks in which it was told to walk.
    pub(super) told_ticks: u32,
    /// Ticks in a row in which the joints stood still.
    idle_ticks: u32,
    /// Mean command, m/s and rad/s.
    command: [f32; COMMAND_DIM],
    /// Mean velocity by the legs, m/s and rad/s.
    going: Option<[f32; COMMAND_DIM]>,
    /// Mean velocities of the joints, rad/s.
    vel_radps: Option<PerJoint>,
}

impl Trial {
    /// Whether the policy has walked for [`TRIAL_S`] without a bad action.
    pub(super) fn is_over(&self, period: Duration) -> bool {
        f64::from(self.ticks) * period.as_secs_f64() >= TRIAL_S
    }

    /// Counts a tick. It is one of walking where the robot was told to move and does: where its legs tell how fast it
    /// goes (`going`, m/s and rad/s), its joints move and it goes where it was told to; else its joints move.
    pub(super) fn count(
        &mut self,
        command: &[f32; COMMAND_DIM],
        servos: &ServoReadings,
        going: Option<[f64; COMMAND_DIM]>,
    ) {
        follow(&mut self.command, command, STRIDE_TICKS);
        let swings = self.swings(servos);
        let moves = match going {
            Some(going) => {
                let mean = self.going.get_or_insert_default();
                follow(mean, &going.map(|v| v as f32), STRIDE_TICKS);
                swings && goes_as_told(mean, &self.command)
            }
            None => swings,
        };
        let told = dot(command, command).min(dot(&self.command, &self.command))
            >= WALK_COMMAND * WALK_COMMAND;
        self.told_ticks += u32::from(told);
        if told && moves {
            self.ticks += 1;
            self.walked_ticks += 1;
        }
    }

    /// Whether the joints moved of late, averaged so that a shiver does not count.
    fn swings(&mut self, servos: &ServoReadings) -> bool {
        let speed_radps = match mean_speed(&servos.vel_radps) {
            // no number: nothing is known of it
            speed if !speed.is_finite() => speed,
            _ => {
                let means = self.vel_radps.get_or_insert(servos.vel_radps.map(|_| 0.0));
                follow(means, &servos.vel_radps, SWING_TICKS);
                mean_speed(means)
            }
        };
        let still = speed_radps < STILL_RADPS;
        self.idle_ticks = if still { self.idle_ticks + 1 } else { 0 };
        self.idle_ticks < STILL_TICKS
    }
}

/// Moves running means over `ticks` on by one tick.
fn follow(means: &mut [f32], now: &[f32], ticks: f32) {
    for (mean, now) in means.iter_mut().zip(now) {
        *mean += (now - *mean) / ticks;
    }
}

/// Whether `going` has its share of the command along the command: of the way, where one is commanded, else of the turn.
fn goes_as_told(going: &[f32; COMMAND_DIM], command: &[f32; COMMAND_DIM]) -> bool {
    let [vx, vy, yaw] = *command;
    let asked = if vx.hypot(vy) >= WALK_COMMAND { [vx, vy, 0.0] } else { [0.0, 0.0, yaw] };
    dot(going, &asked) >= GOES_SHARE * dot(&asked, &asked)
}

fn dot(a: &[f32; COMMAND_DIM], b: &[f32; COMMAND_DIM]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// What a run is asked to do.
#[derive(Clone, Debug)]
pub struct RunPlan {
    /// Control period.
    pub period: Duration,
    /// How long a policy is in charge, s of the robot's time; `None`: until asked to stop.
    pub walk_s: Option<f64>,
    /// Where to go.
    pub commands: CommandTable,
    /// How far a target may move per tick, rad.
    pub step_max_rad: f32,
    /// How long a tick waits for readings.
    pub read_deadline: Duration,
    /// Limits of the hardware; `None` on a simulated robot.
    pub limits: Option<Limits>,
    /// How long a newer policy waits for the robot to stand before the robot is made to; `None`: for ever.
    pub swap_wait: Option<Duration>,
    /// How long a robot may lie under its policy before it is stopped. Beyond
    /// [`FALLEN_FOR`](super::FALLEN_FOR) it may lie while it rises, too: its policy gets it up.
    pub get_up: Duration,
    /// Whether it tips over without its policy
    /// ([`RobotModel::balances`](caudata_model::RobotModel::balances)).
    pub balances: bool,
    /// What tells how fast the robot goes; `None`: nothing does.
    pub legs: Option<LegOdometry>,
}

impl RunPlan {
    /// Velocity by the legs since the tick `dt_s` ago, with a gyroscope of that bias. Feet that swim tell nothing.
    pub(super) fn going(
        &mut self,
        sensed: &Sensed,
        bias_radps: [f32; 3],
        dt_s: f64,
    ) -> Option<[f64; COMMAND_DIM]> {
        let gyro_radps = sensed.imu.gyro_radps;
        let going = self.legs.as_mut()?.velocity(&Posture {
            pos_rad: &sensed.servos.pos_rad,
            gyro_radps: std::array::from_fn(|i| f64::from(gyro_radps[i] - bias_radps[i])),
            up: sensed.gravity.map(|g| -f64::from(g)),
            dt_s,
        });
        going.filter(|_| sensed.in_water != Some(true))
    }
}

/// Everything sensed at one tick.
#[derive(Clone, Copy, Debug)]
pub struct Sensed {
    /// Servos.
    pub servos: ServoReadings,
    /// IMU.
    pub imu: ImuReading,
    /// Direction of gravity, IMU frame.
    pub gravity: [f32; 3],
    /// What a simulation knows.
    pub truth: GroundTruth,
    /// What the hardware says about itself.
    pub health: Health,
    /// Whether it is in water.
    pub in_water: Option<bool>,
}

/// What the loop counted.
#[derive(Clone, Debug, Default)]
pub struct Counts {
    /// Ticks.
    pub ticks: u64,
    /// Ticks without readings.
    pub late_readings: u64,
    /// Policies swapped in.
    pub swaps: u64,
    /// Largest mean speed of the joints at which that happened, rad/s.
    pub swap_speed_radps: f32,
    /// Times that the robot was made to stand for a swap.
    pub stands_for_swap: u64,
    /// Periods skipped.
    pub overruns: u64,
    /// Actions held.
    pub held: u64,
    /// Ticks with a slowed target.
    pub rate_limited: u64,
    /// Joint-ticks that a policy wanted at a joint's limit.
    pub saturated: u64,
    /// Time that a policy was in charge, s of the robot's time.
    pub walked_s: f64,
    /// Sum of the commands over walking ticks, and their number.
    pub(crate) command_sum: [f64; COMMAND_DIM],
    pub(super) walking_ticks: u64,
    /// Sum of the velocities by the legs, and their number.
    legs_sum: [f64; COMMAND_DIM],
    legs_ticks: u64,
    /// From waking to sent.
    pub tick_latency: Latencies,
    /// From due to woken.
    pub wake_latency: Latencies,
    /// Observation, inference and action filter.
    pub inference_latency: Latencies,
    /// How far it went.
    pub odometer: Odometer,
}

impl Counts {
    /// Adds a tick of walking, `dt_s` after the last one.
    pub(super) fn walking(
        &mut self,
        sensed: &Sensed,
        dt_s: f64,
        command: &[f32; COMMAND_DIM],
        going: Option<[f64; COMMAND_DIM]>,
    ) {
        if let (Some(pos), Some(quat)) = (sensed.truth.base_pos_m, sensed.truth.base_quat_wxyz) {
            self.odometer.add(pos, quat, dt_s);
        }
        for (sum, &value) in self.command_sum.iter_mut().zip(command) {
            *sum += f64::from(value);
        }
        self.walking_ticks += 1;
        if let Some(going) = going {
            for (sum, value) in self.legs_sum.iter_mut().zip(going) {
                *sum += value;
            }
            self.legs_ticks += 1;
        }
    }

    /// Mean of the commands given.
    pub fn mean_command(&self) -> Velocity {
        mean(&self.command_sum, self.walking_ticks)
    }

    /// Mean velocity by the legs; `None` where nothing told.
    pub fn by_legs(&self) -> Option<Velocity> {
        (self.legs_ticks > 0).then(|| mean(&self.legs_sum, self.legs_ticks))
    }
}

fn mean(sum: &[f64; COMMAND_DIM], count: u64) -> Velocity {
    let [vx_mps, vy_mps, yaw_rate_radps] = sum.map(|sum| rounded(sum / count.max(1) as f64));
    Velocity { vx_mps, vy_mps, yaw_rate_radps }
}

/// Mean over the joints of their speeds, rad/s. What is not a number is no standing still.
pub(super) fn mean_speed(vel_radps: &PerJoint) -> f32 {
    let sum: f32 = vel_radps.iter().map(|v| v.abs()).sum();
    if sum.is_finite() { sum / vel_radps.len().max(1) as f32 } else { f32::INFINITY }
}

/// Adds the IMU and what follows from it to servo readings taken `dt_s` after the last ones.
pub(super) fn complete<R: Robot>(
    robot: &mut R,
    filter: &mut GravityFilter,
    servos: ServoReadings,
    dt_s: f32,
) -> Result<Sensed, DeployError> {
    let imu = robot.reading()?;
    let estimate = filter.update(imu.gyro_radps, imu.acc_mps2, dt_s);
    Ok(Sensed {
        servos,
        imu,
        gravity: imu.gravity.unwrap_or(estimate),
        truth: robot.ground_truth(),
        health: robot.health(),
        in_water: robot.in_water(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ticks of 500 (10 s) that count, where each joint moves by `vel_radps` of the tick under `command` of the tick,
    /// and the legs tell `going`, m/s.
    fn counted(
        command: impl Fn(u32) -> f32,
        vel_radps: impl Fn(u32) -> f32,
        going: Option<f64>,
    ) -> u32 {
        let mut trial = Trial::default();
        for tick in 0..500 {
            let servos = ServoReadings {
                time_s: 0.0,
                pos_rad: PerJoint::filled(2, 0.0),
                vel_radps: PerJoint::filled(2, vel_radps(tick)),
                current_a: PerJoint::filled(2, 0.0),
                supply_v: 12.0,
            };
            trial.count(&[command(tick), 0.0, 0.0], &servos, going.map(|vx| [vx, 0.3, 0.0]));
        }
        trial.ticks
    }

    /// 0.1 rad of swing at 1.4 Hz: 0.88 rad/s at most.
    fn swing(tick: u32) -> f32 {
        0.88 * (std::f32::consts::TAU * 1.4 * 0.02 * tick as f32).sin()
    }

    #[test]
    fn only_walking_counts_in_a_trial() {
        // the mean of what turns round every tick is 1/19 of it: 0.08 rad/s
        let shiver = |tick: u32| if tick.is_multiple_of(2) { 1.5 } else { -1.5 };
        let there_and_back = |tick: u32| {
            if (tick / 2).is_multiple_of(2) { 0.06 } else { -0.06 }
        };
        // the mean of a command of 0.1 m/s is above 0.03 after 18 ticks: 1 − 0.98¹⁸ = 0.305
        assert_eq!(counted(|_| 0.1, swing, None), 483);
        assert_eq!(counted(|_| 0.0, swing, None), 0);
        assert_eq!(counted(|_| 1e-6, swing, None), 0);
        assert_eq!(counted(there_and_back, swing, None), 0);
        // the ticks until it is seen that the joints stand still
        assert_eq!(counted(|_| 0.1, |_| 0.0, None), 0);
        assert!(counted(|_| 0.1, shiver, None) < 2 * STILL_TICKS, "1.5 rad/s, and goes nowhere");
    }

    #[test]
    fn where_legs_tell_it_must_go_where_it_is_told() {
        assert_eq!(counted(|_| 0.1, swing, Some(0.1)), 483);
        assert_eq!(counted(|_| 0.1, swing, Some(0.034)), 483);
        assert_eq!(counted(|_| 0.1, swing, Some(0.033)), 0);
        assert_eq!(counted(|_| 0.1, swing, Some(-0.1)), 0);
        assert_eq!(counted(|_| 0.0, swing, Some(0.1)), 0);
        // A gyroscope's bias of 1 °/s turns nobody who stands.
        assert_eq!(counted(|_| 0.1, |_| 0.0, Some(0.1)), 0);
        assert!(goes_as_told(&[0.0, 0.0, 0.2], &[0.0, 0.0, 0.5]));
        assert!(!goes_as_told(&[0.0, 0.0, 0.5], &[0.1, 0.0, 0.5]));
    }
}
