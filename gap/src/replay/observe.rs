//! From simulated states to what the robot's sensors would have said, at the log's own stamps.

use caudata_model::RobotModel;
use caudata_sim::State;

use super::commands::{shown_angle, shown_current};
use super::data::{Data, Piece};
use crate::plant::Plant;
use crate::trial::{Kind, Trial, attitude_of};

/// Recorded states of one lane.
pub(super) struct Trace {
    start_s: f64,
    period_s: f64,
    rows: usize,
    width: usize,
    joints: usize,
    /// Whether body signals are recorded.
    body: bool,
    feet: usize,
    /// `[rows, width]`: positions, velocities, torques, and then body signals.
    values: Vec<f32>,
}

/// Places of body signals after those of the joints.
const GYRO: usize = 0;
const ACC: usize = 3;
const GRAV: usize = 6;
const POS: usize = 9;
const VEL: usize = 12;
const ATT: usize = 15;
const FOOT: usize = 18;

impl Trace {
    pub fn new(trial: &Trial, plant: &Plant, start_s: f64, period_s: f64, periods: usize) -> Self {
        let joints = plant.model.actuated().len();
        let feet = plant.model.feet().len();
        let body = trial
            .channels
            .iter()
            .any(|c| !c.kind.of_joint() && c.kind != Kind::Voltage);
        let width = 3 * joints + if body { FOOT + 3 * feet } else { 0 };
        Self {
            start_s,
            period_s,
            rows: periods + 1,
            width,
            joints,
            body,
            feet,
            values: Vec::with_capacity((periods + 1) * width),
        }
    }

    pub fn rows(&self) -> usize {
        self.rows
    }

    pub fn record(&mut self, state: &State, lane: usize, model: &RobotModel) {
        let hinges = state.joints;
        for &j in model.actuated() {
            self.values.push(state.joint_pos_rad[lane * hinges + j]);
        }
        for &j in model.actuated() {
            self.values.push(state.joint_vel_radps[lane * hinges + j]);
        }
        let a = lane * self.joints..(lane + 1) * self.joints;
        self.values.extend_from_slice(&state.motor_torque_nm[a]);
        if !self.body {
            return;
        }
        let three = 3 * lane..3 * lane + 3;
        self.values
            .extend_from_slice(&state.imu_gyro_radps[three.clone()]);
        self.values
            .extend_from_slice(&state.imu_acc_mps2[three.clone()]);
        self.values
            .extend_from_slice(&state.imu_gravity[three.clone()]);
        self.values
            .extend_from_slice(&state.base_pos_m[three.clone()]);
        self.values.extend_from_slice(&state.base_vel_mps[three]);
        let q = [0, 1, 2, 3].map(|i| f64::from(state.base_quat_wxyz[4 * lane + i]));
        self.values.extend(attitude_of(q).map(|x| x as f32));
        let feet = 3 * self.feet * lane..3 * self.feet * (lane + 1);
        self.values.extend_from_slice(&state.foot_pos_m[feet]);
    }

    fn last_row(&self) -> usize {
        (self.values.len() / self.width.max(1)).saturating_sub(1)
    }

    /// Column `c` at time `t_s`, on the line between recorded states.
    fn at(&self, c: usize, t_s: f64) -> f64 {
        let x = ((t_s - self.start_s) / self.period_s).max(0.0);
        let k = (x as usize).min(self.last_row());
        let next = (k + 1).min(self.last_row());
        let share = (x - k as f64).clamp(0.0, 1.0);
        let (a, b) = (
            self.values[k * self.width + c],
            self.values[next * self.width + c],
        );
        f64::from(a) + share * f64::from(b - a)
    }

    /// Column `c` behind a low-pass of `time_s`, as a column of its own.
    fn lagged(&self, c: usize, time_s: f64) -> Vec<f32> {
        let share = if time_s > 0.0 {
            -(-self.period_s / time_s).exp_m1()
        } else {
            1.0
        };
        let mut y = f64::from(self.values[c]);
        (0..=self.last_row())
            .map(|k| {
                y += share * (f64::from(self.values[k * self.width + c]) - y);
                y as f32
            })
            .collect()
    }

    fn at_in(&self, column: &[f32], t_s: f64) -> f64 {
        let x = ((t_s - self.start_s) / self.period_s).max(0.0);
        let k = (x as usize).min(column.len() - 1);
        let next = (k + 1).min(column.len() - 1);
        let share = (x - k as f64).clamp(0.0, 1.0);
        f64::from(column[k]) + share * f64::from(column[next] - column[k])
    }
}

/// What the sensors say at the stamps of stretch `segment`, in the order of the flat vector.
pub(super) fn predict(plant: &Plant, trace: &Trace, data: &Data, segment: usize) -> Vec<f32> {
    let s = &data.segments[segment];
    let trial = &data.trials[s.trial];
    let mut out = Vec::with_capacity(s.range.len());
    for piece in &s.pieces {
        let times = &data.time_s[piece.range.clone()];
        let sensing = &plant.sensing;
        let late_s = f64::from(sensing.measurement_delay_s);
        let origin_s = trial.span_s.0;
        // the log's own clock: what is stamped t was measured at …
        let seen = |t: f64| t - late_s - f64::from(sensing.clock_drift) * (t - origin_s);
        channel(plant, trace, piece, times, &seen, &mut out);
    }
    out
}

fn channel(
    plant: &Plant,
    trace: &Trace,
    piece: &Piece,
    times: &[f64],
    seen: &dyn Fn(f64) -> f64,
    out: &mut Vec<f32>,
) {
    let n = trace.joints;
    let i = piece.index;
    let sensing = &plant.sensing;
    let body = 3 * n;
    match piece.kind {
        Kind::Position => {
            let e = &sensing.encoders[i];
            out.extend(
                times
                    .iter()
                    .map(|&t| shown_angle(e, trace.at(i, seen(t))) as f32),
            );
        }
        Kind::Velocity => {
            let gain = f64::from(1.0 + sensing.encoders[i].gain);
            let lag_s = f64::from(sensing.velocity_lag_s[i]);
            if lag_s > 0.0 {
                let column = trace.lagged(n + i, lag_s);
                out.extend(
                    times
                        .iter()
                        .map(|&t| (gain * trace.at_in(&column, seen(t))) as f32),
                );
            } else {
                out.extend(
                    times
                        .iter()
                        .map(|&t| (gain * trace.at(n + i, seen(t))) as f32),
                );
            }
        }
        Kind::Torque => out.extend(times.iter().map(|&t| trace.at(2 * n + i, seen(t)) as f32)),
        Kind::Current => {
            let joint = &plant.lane.joints[i];
            let errors = &sensing.currents[i];
            let servo = plant.model.servo(i);
            let lag_s = f64::from(sensing.current_lag_s[i]);
            let column = (lag_s > 0.0).then(|| trace.lagged(2 * n + i, lag_s));
            out.extend(times.iter().map(|&t| {
                let given = match &column {
                    Some(column) => trace.at_in(column, seen(t)),
                    None => trace.at(2 * n + i, seen(t)),
                };
                // the current is that of a motor that does not saturate
                let left = 1.0 - f64::from(joint.torque_saturation_per_nm) * given.abs();
                let true_a = shown_current(
                    servo,
                    given / left.max(1e-3),
                    f64::from(joint.torque_constant_nm_per_a),
                    f64::from(joint.current_dead_band_a),
                );
                (f64::from(1.0 + errors.gain) * true_a + f64::from(errors.bias_a)) as f32
            }));
        }
        Kind::Voltage => {
            let column = voltage(plant, trace);
            out.extend(times.iter().map(|&t| trace.at_in(&column, seen(t)) as f32));
        }
        Kind::Gyro | Kind::Acceleration | Kind::Gravity => {
            imu(plant, trace, piece, times, seen, out)
        }
        Kind::BasePosition | Kind::BaseVelocity | Kind::BaseAttitude => {
            let late = f64::from(sensing.mocap_delay_s);
            let (sin, cos) = f64::from(sensing.mocap_yaw_rad).sin_cos();
            let offset = sensing.mocap_offset_m.map(f64::from);
            let base = match piece.kind {
                Kind::BasePosition => body + POS,
                Kind::BaseVelocity => body + VEL,
                _ => body + ATT,
            };
            out.extend(times.iter().map(|&t| {
                let t = seen(t) - late;
                let own = trace.at(base + i, t);
                let value = match (piece.kind, i) {
                    (Kind::BaseAttitude, 2) => own + f64::from(sensing.mocap_yaw_rad),
                    (Kind::BaseAttitude, _) => own,
                    (kind, axis) => {
                        let (x, y) = (trace.at(base, t), trace.at(base + 1, t));
                        let turned = match axis {
                            0 => cos * x - sin * y,
                            1 => sin * x + cos * y,
                            _ => own,
                        };
                        let shift = if kind == Kind::BasePosition {
                            offset[axis]
                        } else {
                            0.0
                        };
                        turned + shift
                    }
                };
                value as f32
            }));
        }
        Kind::Foot => out.extend(
            times
                .iter()
                .map(|&t| trace.at(body + FOOT + i, seen(t)) as f32),
        ),
    }
}

fn imu(
    plant: &Plant,
    trace: &Trace,
    piece: &Piece,
    times: &[f64],
    seen: &dyn Fn(f64) -> f64,
    out: &mut Vec<f32>,
) {
    let sensing = &plant.sensing;
    let base = 3 * trace.joints
        + match piece.kind {
            Kind::Gyro => GYRO,
            Kind::Acceleration => ACC,
            _ => GRAV,
        };
    let late = f64::from(sensing.imu_delay_s);
    let columns = [0, 1, 2].map(|axis| trace.lagged(base + axis, f64::from(sensing.imu_lag_s)));
    out.extend(times.iter().map(|&t| {
        let t = seen(t) - late;
        let v = [0, 1, 2].map(|axis| trace.at_in(&columns[axis], t) as f32);
        match piece.kind {
            Kind::Gyro => {
                sensing.mounting.gyro_radps(v)[piece.index] + sensing.bias.gyro_radps[piece.index]
            }
            Kind::Acceleration => {
                sensing.mounting.acc_mps2(v)[piece.index] + sensing.bias.acc_mps2[piece.index]
            }
            _ => sensing.mounting.turned(v)[piece.index],
        }
    }));
}

/// Bus voltage at every recorded state: V₀ − R·Σ|i| behind its lag.
fn voltage(plant: &Plant, trace: &Trace) -> Vec<f32> {
    let lane = &plant.lane;
    let open_v = f64::from(lane.supply_v);
    let ohm = f64::from(lane.supply_resistance_ohm);
    let lag_s = f64::from(lane.supply_lag_s);
    let share = if lag_s > 0.0 {
        -(-trace.period_s / lag_s).exp_m1()
    } else {
        1.0
    };
    let mut volt = open_v;
    (0..=trace.last_row())
        .map(|k| {
            let row = &trace.values[k * trace.width..(k + 1) * trace.width];
            let amps: f64 = (0..trace.joints)
                .map(|a| {
                    let torque = f64::from(row[2 * trace.joints + a]).abs();
                    torque / f64::from(lane.joints[a].torque_constant_nm_per_a)
                })
                .sum();
            volt += share * (open_v - ohm * amps - volt);
            volt as f32
        })
        .collect()
}
