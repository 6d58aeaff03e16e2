//! What a careful lab's log makes of the truth: sampling instants, stamps, counts, noise, lost frames.

use caudata_model::RobotModel;
use caudata_random::Stream;
use caudata_runlog::Signal;

use super::sim::{Commands, Dense, SAMPLE_S, at};
use super::spec::Spec;

/// Time over which a servo averages its current reading, s.
const CURRENT_LAG_S: f64 = 0.001;
/// Step of the voltage reading, V.
const VOLT_LSB_V: f64 = 0.1;
/// Temperature of the room, °C.
const ROOM_C: f64 = 25.0;
/// Temperatures are read every so many rows.
const TEMPERATURE_EVERY: usize = 50;

/// Errors of one servo's readings beyond its encoder's (which is in the loop, and so in [`Spec`]).
#[derive(Clone, Copy, Debug)]
pub struct ServoReading {
    /// Low-pass of the speed estimate, s.
    pub velocity_lag_s: f64,
    /// Relative error of the current.
    pub current_gain: f64,
    /// Current read without current, A.
    pub current_bias_a: f64,
    /// White noise on the position before counting, rad.
    pub position_noise_rad: f64,
}

/// The whole chain.
#[derive(Clone, Debug)]
pub struct Sensing {
    /// Per servo, policy order.
    pub servos: Vec<ServoReading>,
    /// Age of what is read, s.
    pub measurement_delay_s: f64,
    /// How much slower the robot's clock goes (readings are older by this share of the time).
    pub clock_drift: f64,
    /// White noise on speeds, rad/s.
    pub velocity_noise_radps: f64,
    /// White noise on currents, A.
    pub current_noise_a: f64,
    /// By how much rows miss their instant, s (standard deviation).
    pub row_jitter_s: f64,
    /// Error of the stamps themselves, s (standard deviation).
    pub stamp_error_s: f64,
    /// Share of readings that never arrive.
    pub reading_loss: f64,
    /// Channels.
    pub log_current: bool,
    /// Whether the voltage is read.
    pub log_voltage: bool,
    /// Whether speeds are read.
    pub log_velocity: bool,
}

impl Sensing {
    /// A careful lab.
    pub fn careful(servos: usize) -> Self {
        Self {
            servos: vec![
                ServoReading {
                    velocity_lag_s: 0.0,
                    current_gain: 0.0,
                    current_bias_a: 0.0,
                    position_noise_rad: 0.0002,
                };
                servos
            ],
            measurement_delay_s: 0.0,
            clock_drift: 0.0,
            velocity_noise_radps: 0.01,
            current_noise_a: 0.004,
            row_jitter_s: 0.0002,
            stamp_error_s: 0.00005,
            reading_loss: 0.001,
            log_current: true,
            log_voltage: true,
            log_velocity: true,
        }
    }

    /// Columns of the log.
    pub fn signals(&self, model: &RobotModel) -> Vec<Signal> {
        let names = model.actuated_names();
        let each = |kind| Signal::each(&[kind], &names);
        let mut all = Signal::each(&[Signal::Command, Signal::Position], &names);
        if self.log_velocity {
            all.extend(each(Signal::Velocity));
        }
        if self.log_current {
            all.extend(each(Signal::Current));
        }
        if self.log_voltage {
            all.push(Signal::Voltage);
        }
        all.extend(each(Signal::Temperature));
        all
    }
}

/// When rows are taken: every 1/`rate_hz` with jitter, s.
pub fn row_times_s(
    duration_s: f64,
    rate_hz: f64,
    sensing: &Sensing,
    stream: &mut Stream,
) -> Vec<f64> {
    let rows = (duration_s * rate_hz).floor() as usize;
    let most = 0.3 / rate_hz;
    (0..=rows)
        .map(|k| {
            let jitter = (sensing.row_jitter_s * stream.normal_f64()).clamp(-most, most);
            (k as f64 / rate_hz + jitter).max(0.0)
        })
        .collect()
}

/// A row of a log.
pub type Row = (f64, Vec<Option<f64>>);

/// The rows of a log; columns as [`Sensing::signals`].
pub fn record(
    model: &RobotModel,
    spec: &Spec,
    sensing: &Sensing,
    commands: &Commands,
    dense: &Dense,
    stream: &mut Stream,
) -> Vec<Row> {
    let servos = spec.joints.len();
    let lagged = |channel: &[f64], lag_s: f64| low_pass(channel, lag_s);
    let vel: Vec<Vec<f64>> = (0..servos)
        .map(|a| lagged(&dense.vel_radps[a], sensing.servos[a].velocity_lag_s))
        .collect();
    let cur: Vec<Vec<f64>> =
        (0..servos).map(|a| lagged(&dense.current_a[a], CURRENT_LAG_S)).collect();
    let mut last_stamp = f64::NEG_INFINITY;
    let mut rows = Vec::with_capacity(commands.sent_s.len());
    for (k, &t) in commands.sent_s.iter().enumerate() {
        let stamp = (t + sensing.stamp_error_s * stream.normal_f64()).max(last_stamp + 1e-6);
        last_stamp = stamp;
        let seen = t * (1.0 - sensing.clock_drift) - sensing.measurement_delay_s;
        let lost = stream.uniform_f64(0.0, 1.0) < sensing.reading_loss;
        let mut row: Vec<Option<f64>> =
            commands.rows_rad[k].iter().map(|&u| Some(counted(u, 1e-6))).collect();
        let mut put = |x: f64| row.push((!lost).then_some(x));
        for a in 0..servos {
            let noise = sensing.servos[a].position_noise_rad * stream.normal_f64();
            let read = spec.joints[a].encode_rad(at(&dense.pos_rad[a], seen)) + noise;
            put(counted(read, model.servo(a).encoder_lsb_rad()));
        }
        if sensing.log_velocity {
            for a in 0..servos {
                let read = at(&vel[a], seen) + sensing.velocity_noise_radps * stream.normal_f64();
                put(counted(read, model.servo(a).velocity_lsb_radps));
            }
        }
        if sensing.log_current {
            for a in 0..servos {
                let s = &sensing.servos[a];
                let true_a = shown_current(model, a, at(&cur[a], seen));
                let read = (1.0 + s.current_gain) * true_a
                    + s.current_bias_a
                    + sensing.current_noise_a * stream.normal_f64();
                put(counted(read, model.servo(a).current_lsb_a));
            }
        }
        if sensing.log_voltage {
            put(counted(at(&dense.bus_v, seen), VOLT_LSB_V));
        }
        for a in 0..servos {
            let read = (ROOM_C + at(&dense.heat_k[a], seen)).round();
            row.push((k % TEMPERATURE_EVERY == 0).then_some(read));
        }
        rows.push((stamp, row));
    }
    rows
}

/// The current that the servo shows for what drives its motor: its dead band on top, A.
fn shown_current(model: &RobotModel, a: usize, i: f64) -> f64 {
    let band = model.servo(a).current_dead_band_a;
    // fades in: a servo at rest does not chatter between the two ends
    i + band * (i / 0.01).clamp(-1.0, 1.0)
}

/// In whole steps of `lsb`, if it has any.
pub(super) fn counted(x: f64, lsb: f64) -> f64 {
    match lsb > 0.0 {
        true => (x / lsb).round() * lsb,
        false => x,
    }
}

fn low_pass(channel: &[f64], lag_s: f64) -> Vec<f64> {
    if lag_s <= 0.0 {
        return channel.to_vec();
    }
    let share = 1.0 - (-SAMPLE_S / lag_s).exp();
    let mut y = channel.first().copied().unwrap_or(0.0);
    channel
        .iter()
        .map(|x| {
            y += share * (x - y);
            y
        })
        .collect()
}
