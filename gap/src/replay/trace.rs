//! What is recorded of a lane, step by step, and what it was between steps.

use std::ops::Range;

use caudata_model::RobotModel;
use caudata_sim::Engine;
use caudata_sim::batch::{BatchEngine, Readout};

use crate::plant::Plant;
use crate::trial::{Kind, YAW, attitude_of, nearest_turn};

/// Recorded states of one lane.
pub(super) struct Trace {
    start_s: f64,
    pub(super) period_s: f64,
    rows: usize,
    pub(super) width: usize,
    pub(super) joints: usize,
    /// Which body signals are recorded.
    readout: Readout,
    /// Whether second encoders are.
    second: bool,
    pub(super) feet: usize,
    /// Command (rad) and torque (N·m) of each joint in the last step.
    last: Vec<(f32, f32)>,
    /// `[rows, width]`: positions, velocities, torques, second positions, and then body signals: IMU, base, feet, as far as
    /// they are read out.
    pub(super) values: Vec<f32>,
}

/// Places of the IMU's signals, and how many numbers they are.
pub(super) const GYRO: usize = 0;
pub(super) const ACC: usize = 3;
pub(super) const GRAV: usize = 6;
const IMU: usize = 9;
/// Places of the base's signals, and how many numbers they are.
pub(super) const POS: usize = 0;
pub(super) const VEL: usize = 3;
pub(super) const QUAT: usize = 6;
const BASE: usize = 10;

impl Trace {
    pub(super) fn new(
        readout: Readout,
        second: bool,
        plant: &Plant,
        start_s: f64,
        period_s: f64,
        periods: usize,
    ) -> Self {
        let joints = plant.model.actuated().len();
        let feet = if readout.feet { plant.model.feet().len() } else { 0 };
        let mut trace = Self {
            start_s,
            period_s,
            rows: periods + 1,
            width: 0,
            joints,
            readout,
            second,
            feet,
            last: vec![(f32::NAN, 0.0); joints],
            values: Vec::new(),
        };
        trace.width = trace.foot_column() + 3 * feet;
        trace.values.reserve_exact(trace.rows * trace.width);
        trace
    }

    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// First column of the IMU's signals.
    pub(super) fn imu_column(&self) -> usize {
        (3 + usize::from(self.second)) * self.joints
    }

    /// First column of the base's signals.
    pub(super) fn base_column(&self) -> usize {
        self.imu_column() + if self.readout.imu { IMU } else { 0 }
    }

    /// First column of the feet's positions.
    pub(super) fn foot_column(&self) -> usize {
        self.base_column() + if self.readout.base { BASE } else { 0 }
    }

    /// Records the engine's state, to which the commands `targets_rad` led.
    pub(super) fn record(
        &mut self,
        engine: &BatchEngine,
        lane: usize,
        model: &RobotModel,
        targets_rad: &[f32],
    ) {
        let state = engine.state();
        let row = |k: usize| k * lane..k * (lane + 1);
        let values = &mut self.values;
        let servos = || model.actuated().iter().enumerate();
        values.extend(servos().map(|(a, &j)| state.encoder_pos_rad(lane, j, a)));
        values.extend(servos().map(|(a, &j)| state.encoder_vel_radps(lane, j, a)));
        // the torque is that of the positions before the step. While the command stays, it goes on as it went;
        // what the next command does to it, nobody has read yet
        let torques = &state.motor_torque_nm[row(self.joints)];
        for (last, now) in self.last.iter_mut().zip(targets_rad.iter().zip(torques)) {
            let goes_on = if last.0 == *now.0 { now.1 - last.1 } else { 0.0 };
            values.push(now.1 + goes_on);
            *last = (*now.0, *now.1);
        }
        if self.second {
            let ahead = &state.encoder_ahead_rad[row(self.joints)];
            let leads = engine.rotor_leads_rad(lane);
            let joint_rad = &state.joint_pos_rad[row(state.joints)];
            values.extend(servos().map(|(a, &j)| joint_rad[j] + leads[a] - ahead[a]));
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

    /// How much later than what it shows of `kind` a state is, s: velocities are those of half a step before the
    /// positions, and the IMU takes the difference of two of them.
    pub(super) fn recorded_late_s(&self, kind: Kind) -> f64 {
        match kind {
            Kind::Velocity | Kind::Gyro | Kind::BaseVelocity => -0.5 * self.period_s,
            Kind::Acceleration => -self.period_s,
            _ => 0.0,
        }
    }

    /// The next torque goes on from nothing that was before.
    pub(super) fn forget(&mut self) {
        self.last.fill((f32::NAN, 0.0));
    }

    pub(super) fn last_row(&self) -> usize {
        (self.values.len() / self.width.max(1)).saturating_sub(1)
    }

    /// Between which recorded states `t_s` lies.
    pub(super) fn place(&self, t_s: f64) -> Place {
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
    pub(super) fn at(&self, columns: Range<usize>, places: &[Place]) -> Vec<f64> {
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
    pub(super) fn attitude(&self, place: &Place) -> [f64; 4] {
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
    pub(super) fn lagged<const N: usize>(&self, c: usize, time_s: f64) -> Vec<[f32; N]> {
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
pub(super) struct Place {
    pub(super) row: u32,
    pub(super) next: u32,
    /// Share of the way from one to the other.
    share: f64,
}

impl Place {
    /// On the line from `a` in one to `b` in the other.
    #[inline]
    pub(super) fn between(&self, a: f32, b: f32) -> f64 {
        f64::from(a) + self.share * f64::from(b - a)
    }

    /// The same in a column of its own.
    pub(super) fn of(&self, column: &[f32]) -> f64 {
        self.between(column[self.row as usize], column[self.next as usize])
    }
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
