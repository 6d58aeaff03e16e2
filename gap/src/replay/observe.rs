//! From simulated states to what the robot's sensors would have said, at the log's own stamps.

use std::cell::OnceCell;
use std::ops::Range;

use caudata_model::RobotModel;
use caudata_sim::State;
use caudata_sim::batch::Readout;

use super::commands::{shown_angle, shown_current};
use super::data::{Data, Piece};
use crate::plant::Plant;
use crate::trial::{Kind, Trial, YAW, attitude_of, nearest_turn};

/// What the channels of a log are made of beside joints.
pub(super) fn readout(trial: &Trial) -> Readout {
    let mut readout = Readout::JOINTS;
    for channel in &trial.channels {
        match channel.kind {
            Kind::Gyro | Kind::Acceleration | Kind::Gravity => readout.imu = true,
            Kind::BasePosition | Kind::BaseVelocity | Kind::BaseAttitude => readout.base = true,
            Kind::Foot => readout.feet = true,
            Kind::Position | Kind::Velocity | Kind::Current | Kind::Torque | Kind::Voltage => {}
        }
    }
    readout
}

/// Recorded states of one lane.
pub(super) struct Trace {
    start_s: f64,
    period_s: f64,
    /// How long before the time of the positions velocities are, s.
    ahead_s: f64,
    rows: usize,
    width: usize,
    joints: usize,
    /// Which body signals are recorded.
    readout: Readout,
    feet: usize,
    /// Command (rad) and torque (N·m) of each joint in the last step.
    last: Vec<(f32, f32)>,
    /// `[rows, width]`: positions, velocities, torques, and then body signals: IMU, base, feet, as far as
    /// they are read out.
    values: Vec<f32>,
}

/// Places of the IMU's signals, and how many numbers they are.
const GYRO: usize = 0;
const ACC: usize = 3;
const GRAV: usize = 6;
const IMU: usize = 9;
/// Places of the base's signals, and how many numbers they are.
const POS: usize = 0;
const VEL: usize = 3;
const QUAT: usize = 6;
const BASE: usize = 10;

impl Trace {
    pub fn new(
        readout: Readout,
        plant: &Plant,
        start_s: f64,
        period_s: f64,
        periods: usize,
        ahead_s: f64,
    ) -> Self {
        let joints = plant.model.actuated().len();
        let feet = if readout.feet {
            plant.model.feet().len()
        } else {
            0
        };
        let mut trace = Self {
            start_s,
            period_s,
            ahead_s,
            rows: periods + 1,
            width: 0,
            joints,
            readout,
            feet,
            last: vec![(f32::NAN, 0.0); joints],
            values: Vec::new(),
        };
        trace.width = trace.foot_column() + 3 * feet;
        trace.values.reserve_exact(trace.rows * trace.width);
        trace
    }

    pub fn rows(&self) -> usize {
        self.rows
    }

    /// First column of the IMU's signals.
    fn imu_column(&self) -> usize {
        3 * self.joints
    }

    /// First column of the base's signals.
    fn base_column(&self) -> usize {
        self.imu_column() + if self.readout.imu { IMU } else { 0 }
    }

    /// First column of the feet's positions.
    fn foot_column(&self) -> usize {
        self.base_column() + if self.readout.base { BASE } else { 0 }
    }

    /// Records `state`, to which the commands `targets_rad` led.
    pub fn record(&mut self, state: &State, lane: usize, model: &RobotModel, targets_rad: &[f32]) {
        let row = |k: usize| k * lane..k * (lane + 1);
        let values = &mut self.values;
        for joints in [&state.joint_pos_rad, &state.joint_vel_radps] {
            let own = &joints[row(state.joints)];
            values.extend(model.actuated().iter().map(|&j| own[j]));
        }
        // the torque is that of the positions before the step. While the command stays, it goes on as it went;
        // what the next command does to it, nobody has read yet
        let torques = &state.motor_torque_nm[row(self.joints)];
        for (last, now) in self.last.iter_mut().zip(targets_rad.iter().zip(torques)) {
            let goes_on = if last.0 == *now.0 {
                now.1 - last.1
            } else {
                0.0
            };
            values.push(now.1 + goes_on);
            *last = (*now.0, *now.1);
        }
        if self.readout.imu {
            values.extend_from_slice(&state.imu_gyro_radps[row(3)]);
            values.extend_from_slice(&state.imu_acc_mps2[row(3)]);
            values.extend_from_slice(&state.imu_gravity[row(3)]);
        }
        if self.readout.base {
            values.extend_from_slice(&state.base_pos_m[row(3)]);
            values.extend_from_slice(&state.base_vel_mps[row(3)]);
            values.extend_from_slice(&state.base_quat_wxyz[row(4)]);
        }
        values.extend_from_slice(&state.foot_pos_m[row(3 * state.feet)][..3 * self.feet]);
    }

    /// How much later than what it shows of `kind` a state is, s. The IMU takes the difference of two
    /// velocities.
    fn recorded_late_s(&self, kind: Kind) -> f64 {
        match kind {
            Kind::Velocity | Kind::Gyro | Kind::BaseVelocity => -self.ahead_s,
            Kind::Acceleration => -2.0 * self.ahead_s,
            _ => 0.0,
        }
    }

    /// The next torque goes on from nothing that was before.
    pub fn forget(&mut self) {
        self.last.fill((f32::NAN, 0.0));
    }

    fn last_row(&self) -> usize {
        (self.values.len() / self.width.max(1)).saturating_sub(1)
    }

    /// Between which recorded states `t_s` lies.
    fn place(&self, t_s: f64) -> Place {
        let x = ((t_s - self.start_s) / self.period_s).max(0.0);
        let row = (x as usize).min(self.last_row());
        Place {
            row: row as u32,
            next: (row + 1).min(self.last_row()) as u32,
            share: (x - row as f64).clamp(0.0, 1.0),
        }
    }

    /// `columns` at `places`, each on the line between recorded states: one after the other. Row by row: a
    /// trace is larger than caches are.
    fn at(&self, columns: Range<usize>, places: &[Place]) -> Vec<f64> {
        let row = |row: u32| {
            let from = row as usize * self.width;
            &self.values[from..from + self.width][columns.clone()]
        };
        let mut out = vec![0.0; columns.len() * places.len()];
        for (n, place) in places.iter().enumerate() {
            let both = row(place.row).iter().zip(row(place.next));
            for (c, (&a, &b)) in both.enumerate() {
                out[c * places.len() + n] = place.between(a, b);
            }
        }
        out
    }

    /// What [`attitude_of`] says of the base, each on the line between its values at recorded states.
    fn attitude(&self, place: &Place) -> [f64; 4] {
        let [a, b] = [place.row, place.next].map(|row| {
            let q = row as usize * self.width + self.base_column() + QUAT;
            let wxyz = [0, 1, 2, 3].map(|i| f64::from(self.values[q + i]));
            attitude_of(wxyz).map(|x| x as f32)
        });
        let mut b = b;
        b[YAW] = nearest_turn(f64::from(b[YAW]), f64::from(a[YAW])) as f32;
        [0, 1, 2, 3].map(|i| place.between(a[i], b[i]))
    }

    /// `N` columns from `c` on, each behind a low-pass of `time_s`, as columns of their own: what goes in is on the
    /// line between states, so that a short low-pass is as late as it says.
    fn lagged<const N: usize>(&self, c: usize, time_s: f64) -> Vec<[f32; N]> {
        let (stays, last, now) = weights(time_s, self.period_s);
        let x = |k: usize, i: usize| f64::from(self.values[k * self.width + c + i]);
        let mut y = std::array::from_fn::<f64, N, _>(|i| x(0, i));
        (0..=self.last_row())
            .map(|k| {
                std::array::from_fn(|i| {
                    y[i] = stays * y[i] + last * x(k.saturating_sub(1), i) + now * x(k, i);
                    y[i] as f32
                })
            })
            .collect()
    }
}

/// What a low-pass of `time_s` keeps of itself, of what went in `period_s` ago and of what goes in now, where that is
/// on the line between the two: y' = (x − y)/τ, exactly.
fn weights(time_s: f64, period_s: f64) -> (f64, f64, f64) {
    if time_s <= 0.0 {
        return (0.0, 0.0, 1.0);
    }
    let stays = (-period_s / time_s).exp();
    let mean = (1.0 - stays) * time_s / period_s;
    (stays, mean - stays, 1.0 - mean)
}

/// Where a stamp falls between two recorded states.
#[derive(Clone, Copy)]
struct Place {
    row: u32,
    next: u32,
    /// Share of the way from one to the other.
    share: f64,
}

impl Place {
    /// On the line from `a` in one to `b` in the other.
    #[inline]
    fn between(&self, a: f32, b: f32) -> f64 {
        f64::from(a) + self.share * f64::from(b - a)
    }

    /// The same in a column of its own.
    fn of(&self, column: &[f32]) -> f64 {
        self.between(column[self.row as usize], column[self.next as usize])
    }
}

/// What the sensors say at the stamps of stretch `segment`, in the order of the flat vector.
pub(super) fn predict(plant: &Plant, trace: &Trace, data: &Data, segment: usize) -> Vec<f32> {
    let s = &data.segments[segment];
    let trial = &data.trials[s.trial];
    let mut out = Vec::with_capacity(s.range.len());
    let mut seen = Seen {
        plant,
        trace,
        origin_s: trial.span_s.0,
        stamps: Vec::new(),
        together: Vec::new(),
    };
    for piece in &s.pieces {
        let from = out.len();
        channel(
            &mut seen,
            piece,
            &data.time_s[piece.range.clone()],
            &mut out,
        );
        if (piece.kind, piece.index) == (Kind::BaseAttitude, YAW) {
            // as many turns as the robot has made
            for (yaw, &measured) in out[from..].iter_mut().zip(&data.value[piece.range.clone()]) {
                *yaw = nearest_turn(f64::from(*yaw), measured) as f32;
            }
        }
    }
    out
}

/// What channels have in common in a stretch: most have the same stamps, and the parts of a vector or an
/// attitude go together.
struct Seen<'a> {
    plant: &'a Plant,
    trace: &'a Trace,
    /// When the run began, s.
    origin_s: f64,
    stamps: Vec<Stamps<'a>>,
    /// All components of a kind at some stamps (their number in `stamps`), SI: three of a vector and 0, four
    /// of an attitude.
    together: Vec<(Kind, usize, Vec<[f32; 4]>)>,
}

/// Stamps of a channel, and where they fall.
struct Stamps<'a> {
    /// s.
    times_s: &'a [f64],
    /// How much later than joints this was measured, s.
    late_s: f64,
    places: Vec<Place>,
    /// Signals of joints, the base and the feet at them, each once asked for, as [`Trace::at`] gives them.
    joints: OnceCell<Vec<f64>>,
    base: OnceCell<Vec<f64>>,
    feet: OnceCell<Vec<f64>>,
}

impl Stamps<'_> {
    /// Position (0), velocity (1) or torque (2) of a joint.
    fn joint(&self, trace: &Trace, signal: usize, joint: usize) -> &[f64] {
        let all = || trace.at(0..3 * trace.joints, &self.places);
        self.column(self.joints.get_or_init(all), signal * trace.joints + joint)
    }

    /// A component of the base's position or velocity, SI.
    fn base(&self, trace: &Trace, component: usize) -> &[f64] {
        let first = trace.base_column();
        let all = || trace.at(first..first + QUAT, &self.places);
        self.column(self.base.get_or_init(all), component)
    }

    /// A component of the feet's positions, m.
    fn foot(&self, trace: &Trace, component: usize) -> &[f64] {
        let first = trace.foot_column();
        let all = || trace.at(first..first + 3 * trace.feet, &self.places);
        self.column(self.feet.get_or_init(all), component)
    }

    fn column<'b>(&self, columns: &'b [f64], c: usize) -> &'b [f64] {
        let n = self.places.len();
        &columns[c * n..(c + 1) * n]
    }
}

impl<'a> Seen<'a> {
    /// The number in `stamps` of `times_s` of a sensor that is `late_s` late.
    fn stamps(&mut self, times_s: &'a [f64], late_s: f64) -> usize {
        let same = |s: &Stamps<'_>| s.late_s == late_s && s.times_s == times_s;
        if let Some(known) = self.stamps.iter().position(same) {
            return known;
        }
        let sensing = &self.plant.sensing;
        let measured_late_s = f64::from(sensing.measurement_delay_s);
        // the log's own clock: what is stamped t was measured at …
        let seen_s =
            |t: f64| t - measured_late_s - f64::from(sensing.clock_drift) * (t - self.origin_s);
        let place = |&t: &f64| self.trace.place(seen_s(t) - late_s);
        self.stamps.push(Stamps {
            times_s,
            late_s,
            places: times_s.iter().map(place).collect(),
            joints: OnceCell::new(),
            base: OnceCell::new(),
            feet: OnceCell::new(),
        });
        self.stamps.len() - 1
    }

    /// Component `index` of `kind` at stamps `number`; `all` gives them all.
    fn component(
        &mut self,
        kind: Kind,
        number: usize,
        index: usize,
        all: impl Fn(&Plant, &Trace, &[Place]) -> Vec<[f32; 4]>,
        out: &mut Vec<f32>,
    ) {
        let same = |t: &(Kind, usize, Vec<[f32; 4]>)| (t.0, t.1) == (kind, number);
        let known = self.together.iter().position(same).unwrap_or_else(|| {
            let places = &self.stamps[number].places;
            let values = all(self.plant, self.trace, places);
            self.together.push((kind, number, values));
            self.together.len() - 1
        });
        out.extend(self.together[known].2.iter().map(|v| v[index]));
    }
}

/// What the sensor of joint `a` says of the current that gives a torque, A.
fn current(plant: &Plant, a: usize, given_nm: f64) -> f32 {
    let (joint, errors) = (&plant.lane.joints[a], &plant.sensing.currents[a]);
    // the current is that of a motor that does not saturate
    let left = 1.0 - f64::from(joint.torque_saturation_per_nm) * given_nm.abs();
    let true_a = shown_current(
        given_nm / left.max(1e-3),
        f64::from(joint.torque_constant_nm_per_a),
        f64::from(joint.current_dead_band_a),
    );
    (f64::from(1.0 + errors.gain) * true_a + f64::from(errors.bias_a)) as f32
}

fn channel<'a>(seen: &mut Seen<'a>, piece: &Piece, times_s: &'a [f64], out: &mut Vec<f32>) {
    let (plant, trace) = (seen.plant, seen.trace);
    let n = trace.joints;
    let i = piece.index;
    let sensing = &plant.sensing;
    let late_s = match piece.kind {
        Kind::Gyro | Kind::Acceleration | Kind::Gravity => f64::from(sensing.imu_delay_s),
        Kind::BasePosition | Kind::BaseVelocity | Kind::BaseAttitude => {
            f64::from(sensing.mocap_delay_s)
        }
        // a servo's torque is its current, in other units
        Kind::Current | Kind::Torque => f64::from(sensing.current_delay_s[i]),
        _ => 0.0,
    };
    let number = seen.stamps(times_s, late_s + trace.recorded_late_s(piece.kind));
    let stamps = &seen.stamps[number];
    match piece.kind {
        Kind::Position => {
            let e = &sensing.encoders[i];
            let true_rad = stamps.joint(trace, 0, i);
            out.extend(true_rad.iter().map(|&q| shown_angle(e, q) as f32));
        }
        Kind::Velocity => {
            let gain = f64::from(1.0 + sensing.encoders[i].gain);
            let lag_s = f64::from(sensing.velocity_lag_s[i]);
            if lag_s > 0.0 {
                let column = trace.lagged::<1>(n + i, lag_s);
                let of = |place: &Place| (gain * place.of(column.as_flattened())) as f32;
                out.extend(stamps.places.iter().map(of));
            } else {
                let true_radps = stamps.joint(trace, 1, i);
                out.extend(true_radps.iter().map(|qd| (gain * qd) as f32));
            }
        }
        Kind::Current | Kind::Torque => {
            let current = |given_nm: f64| match piece.kind {
                Kind::Torque => given_nm as f32,
                _ => current(plant, i, given_nm),
            };
            let lag_s = f64::from(sensing.current_lag_s[i]);
            if lag_s > 0.0 {
                let column = trace.lagged::<1>(2 * n + i, lag_s);
                let of = |place: &Place| current(place.of(column.as_flattened()));
                out.extend(stamps.places.iter().map(of));
            } else {
                out.extend(stamps.joint(trace, 2, i).iter().map(|&nm| current(nm)));
            }
        }
        Kind::Voltage => {
            let column = voltage(plant, trace);
            out.extend(stamps.places.iter().map(|place| place.of(&column) as f32));
        }
        Kind::Gyro | Kind::Acceleration | Kind::Gravity => {
            let kind = piece.kind;
            seen.component(kind, number, i, |p, t, at| imu(p, t, kind, at), out);
        }
        Kind::BasePosition | Kind::BaseVelocity => {
            let (sin, cos) = f64::from(sensing.mocap_yaw_rad).sin_cos();
            let (first, offset_m) = if piece.kind == Kind::BasePosition {
                (POS, sensing.mocap_offset_m.map(f64::from))
            } else {
                (VEL, [0.0; 3])
            };
            let [x, y, own] = [0, 1, i].map(|axis| stamps.base(trace, first + axis));
            out.extend((0..own.len()).map(|k| {
                let turned = match i {
                    0 => cos * x[k] - sin * y[k],
                    1 => sin * x[k] + cos * y[k],
                    _ => own[k],
                };
                (turned + offset_m[i]) as f32
            }));
        }
        Kind::BaseAttitude => seen.component(piece.kind, number, i, attitudes, out),
        Kind::Foot => out.extend(stamps.foot(trace, i).iter().map(|&x| x as f32)),
    }
}

/// Direction of gravity in the base, and the base's yaw (rad) as motion capture has it, in the order of
/// [`Kind::BaseAttitude`].
fn attitudes(plant: &Plant, trace: &Trace, places: &[Place]) -> Vec<[f32; 4]> {
    let yaw_rad = f64::from(plant.sensing.mocap_yaw_rad);
    let of = |place: &Place| {
        let [x, y, yaw, z] = trace.attitude(place);
        [x, y, yaw + yaw_rad, z].map(|v| v as f32)
    };
    places.iter().map(of).collect()
}

/// The three axes of an IMU's signal, and 0.
fn imu(plant: &Plant, trace: &Trace, kind: Kind, places: &[Place]) -> Vec<[f32; 4]> {
    let sensing = &plant.sensing;
    let base = trace.imu_column()
        + match kind {
            Kind::Gyro => GYRO,
            Kind::Acceleration => ACC,
            _ => GRAV,
        };
    let columns = trace.lagged::<3>(base, f64::from(sensing.imu_lag_s));
    let of = |place: &Place| {
        let (a, b) = (columns[place.row as usize], columns[place.next as usize]);
        let v = [0, 1, 2].map(|axis| place.between(a[axis], b[axis]) as f32);
        let (seen, bias) = match kind {
            Kind::Gyro => (sensing.mounting.gyro_radps(v), sensing.bias.gyro_radps),
            Kind::Acceleration => (sensing.mounting.acc_mps2(v), sensing.bias.acc_mps2),
            _ => (sensing.mounting.turned(v), [0.0; 3]),
        };
        let read = |axis: usize| seen[axis] + bias[axis];
        [read(0), read(1), read(2), 0.0]
    };
    places.iter().map(of).collect()
}

/// Bus voltage at every recorded state: V₀ − R·Σ|i| behind its lag.
fn voltage(plant: &Plant, trace: &Trace) -> Vec<f32> {
    let lane = &plant.lane;
    let open_v = f64::from(lane.supply_v);
    let ohm = f64::from(lane.supply_resistance_ohm);
    if ohm == 0.0 {
        return vec![open_v as f32; trace.last_row() + 1];
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_comes_through_a_low_pass_as_late_as_it_says() {
        for time_s in [0.0, 0.0005, 0.002, 0.02] {
            let (stays, last, now) = weights(time_s, 0.002);
            let (mut y, mut x) = (0.0, 0.0);
            for _ in 0..400 {
                y = stays * y + last * x + now * (x + 0.002);
                x += 0.002;
            }
            assert!((x - y - time_s).abs() < 1e-9, "{time_s}: {}", x - y);
        }
    }
}
