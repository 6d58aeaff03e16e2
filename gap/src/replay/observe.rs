//! From simulated states to what the robot's sensors would have said, at the log's own stamps.

use std::cell::OnceCell;

use caudata_sim::batch::Readout;
use caudata_sim::drive::{ServoDrive, servo, supply};

use super::commands::{shown_angle, shown_current};
use super::data::{Data, Piece};
use super::trace::{ACC, GRAV, GYRO, POS, Place, QUAT, Trace, VEL};
use crate::plant::Plant;
use crate::trial::{Kind, Trial, YAW, nearest_turn};

/// What the channels of a log are made of beside joints.
pub(super) fn readout(trial: &Trial) -> Readout {
    let mut readout = Readout::JOINTS;
    for channel in &trial.channels {
        match channel.kind {
            Kind::Gyro | Kind::Acceleration | Kind::Gravity => readout.imu = true,
            Kind::BasePosition | Kind::BaseVelocity | Kind::BaseAttitude => readout.base = true,
            Kind::Foot => readout.feet = true,
            Kind::Position | Kind::SecondPosition | Kind::Velocity => {}
            Kind::Current | Kind::Torque | Kind::Voltage => {}
        }
    }
    readout
}

/// Whether a log has a joint's second encoder.
pub(super) fn has_second(trial: &Trial) -> bool {
    trial.channels.iter().any(|c| c.kind == Kind::SecondPosition)
}

/// What the sensors say at the stamps of stretch `segment`, in the order of the flat vector.
pub(super) fn predict(plant: &Plant, trace: &Trace, data: &Data, segment: usize) -> Vec<f32> {
    let s = &data.segments[segment];
    let trial = &data.trials[s.trial];
    let mut out = Vec::with_capacity(s.range.len());
    let mut seen =
        Seen { plant, trace, origin_s: trial.span_s.0, stamps: Vec::new(), together: Vec::new() };
    for piece in &s.pieces {
        let from = out.len();
        channel(&mut seen, piece, &data.time_s[piece.range.clone()], &mut out);
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
    /// Signals of joints (positions, velocities, torques, second positions), the base and the feet at them, each once asked for, as
    /// [`Trace::at`] gives them.
    joints: [OnceCell<Vec<f64>>; 4],
    base: OnceCell<Vec<f64>>,
    feet: OnceCell<Vec<f64>>,
}

impl Stamps<'_> {
    /// Position (0), velocity (1), torque (2) or second position (3) of a joint.
    fn joint(&self, trace: &Trace, signal: usize, joint: usize) -> &[f64] {
        let first = signal * trace.joints;
        let all = || trace.at(first..first + trace.joints, &self.places);
        self.column(self.joints[signal].get_or_init(all), joint)
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
            joints: Default::default(),
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
        Kind::SecondPosition => out.extend(stamps.joint(trace, 3, i).iter().map(|&q| q as f32)),
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

/// Bus voltage at every recorded state: V₀ − R·Σ d·i behind its lag ([`caudata_sim::drive::supply`]).
fn voltage(plant: &Plant, trace: &Trace) -> Vec<f32> {
    let lane = &plant.lane;
    let open_v = f64::from(lane.supply_v);
    let ohm = f64::from(lane.supply_resistance_ohm);
    if ohm == 0.0 {
        return vec![open_v as f32; trace.last_row() + 1];
    }
    let lag_s = f64::from(lane.supply_lag_s);
    let share = if lag_s > 0.0 { -(-trace.period_s / lag_s).exp_m1() } else { 1.0 };
    let servos = ServoDrive::all(&plant.model, lane, trace.period_s);
    let n = trace.joints;
    let mut volt = open_v;
    (0..=trace.last_row())
        .map(|k| {
            let row = &trace.values[k * trace.width..(k + 1) * trace.width];
            let drawn_a: f64 = (servos.iter().enumerate())
                .map(|(a, p)| {
                    let [qd_radps, given_nm] = [row[n + a], row[2 * n + a]].map(f64::from);
                    let current_a = servo::current_a(p, servo::unsaturated_nm(p, given_nm));
                    supply::drawn_a(p, volt, 0.0, given_nm, qd_radps, current_a)
                })
                .sum();
            volt += share * (open_v - ohm * drawn_a - volt);
            volt as f32
        })
        .collect()
}
