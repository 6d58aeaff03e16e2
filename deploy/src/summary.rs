//! What a run came to: latencies, how far and how fast the robot went, and the summary at the end.

use std::time::Duration;

use serde::Serialize;

use crate::guard::Fault;
use crate::state::Sha256Digest;

/// Width of a latency bucket, µs.
const BUCKET_US: u64 = 5;
/// Buckets; longer latencies fall into the last one (40 ms).
const BUCKETS: usize = 8000;

/// Latencies in buckets of 5 µs: bounded memory however long the run.
#[derive(Clone, Debug)]
pub struct Latencies {
    counts: Vec<u64>,
    total: u64,
}

impl Default for Latencies {
    fn default() -> Self {
        Self { counts: vec![0; BUCKETS], total: 0 }
    }
}

impl Latencies {
    /// Counts one.
    pub fn add(&mut self, latency: Duration) {
        let bucket = latency.as_micros() / u128::from(BUCKET_US);
        let bucket = usize::try_from(bucket).unwrap_or(usize::MAX);
        self.counts[bucket.min(BUCKETS - 1)] += 1;
        self.total += 1;
    }

    /// The latency, µs, that the given share (0 to 1) of all stays at or below: the upper edge of its bucket.
    /// 0 where there are none.
    pub fn quantile_us(&self, share: f64) -> u64 {
        let wanted = (share * self.total as f64).ceil() as u64;
        let mut seen = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            seen += count;
            if seen >= wanted && seen > 0 {
                return (bucket as u64 + 1) * BUCKET_US;
            }
        }
        0
    }
}

/// Ticks over which a direction of travel is taken: more than one stride, so that the sway of the head
/// averages out.
const WINDOW_TICKS: u32 = 50;

/// How far and how fast the base went, from its true poses.
///
/// The displacement over each window of a second is turned by the mean heading (yaw of the base) in that
/// window.
#[derive(Clone, Debug, Default)]
pub struct Odometer {
    last_yaw_rad: Option<f64>,
    turned_rad: f64,
    window: Window,
    forward_m: f64,
    left_m: f64,
    start_m: Option<[f64; 2]>,
    last_m: [f64; 2],
    duration_s: f64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Window {
    start_m: [f64; 2],
    cos_sum: f64,
    sin_sum: f64,
    ticks: u32,
}

impl Odometer {
    /// Takes the pose `dt_s` after the last one.
    pub fn add(&mut self, pos_m: [f32; 3], quat_wxyz: [f32; 4], dt_s: f64) {
        let at = [f64::from(pos_m[0]), f64::from(pos_m[1])];
        let yaw = yaw_rad(quat_wxyz);
        match self.last_yaw_rad {
            None => {
                self.start_m = Some(at);
                self.window.start_m = at;
            }
            Some(last) => {
                let turn = yaw - last;
                // The short way round.
                self.turned_rad += turn.sin().atan2(turn.cos());
                self.duration_s += dt_s;
            }
        }
        self.last_yaw_rad = Some(yaw);
        self.last_m = at;
        self.window.cos_sum += yaw.cos();
        self.window.sin_sum += yaw.sin();
        self.window.ticks += 1;
        if self.window.ticks > WINDOW_TICKS {
            self.close_window();
        }
    }

    fn close_window(&mut self) {
        let Window { start_m, cos_sum, sin_sum, .. } = self.window;
        let size = cos_sum.hypot(sin_sum);
        if size > 0.0 {
            let (cos, sin) = (cos_sum / size, sin_sum / size);
            let (dx, dy) = (self.last_m[0] - start_m[0], self.last_m[1] - start_m[1]);
            self.forward_m += cos * dx + sin * dy;
            self.left_m += cos * dy - sin * dx;
        }
        self.window = Window { start_m: self.last_m, ..Window::default() };
    }

    /// Mean forward and sideways velocity (m/s) and yaw rate (rad/s), and the distance from start to end as
    /// the crow flies, m. `None` where there were no poses.
    pub fn result(mut self) -> Option<(Velocity, f64)> {
        let start = self.start_m?;
        if self.duration_s <= 0.0 {
            return None;
        }
        self.close_window();
        let velocity = Velocity {
            vx_mps: rounded(self.forward_m / self.duration_s),
            vy_mps: rounded(self.left_m / self.duration_s),
            yaw_rate_radps: rounded(self.turned_rad / self.duration_s),
        };
        let distance = (self.last_m[0] - start[0]).hypot(self.last_m[1] - start[1]);
        Some((velocity, rounded(distance)))
    }
}

/// Heading of the body's x axis.
fn yaw_rad([w, x, y, z]: [f32; 4]) -> f64 {
    let [w, x, y, z] = [w, x, y, z].map(f64::from);
    (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
}

/// To six decimals: micrometres are below what anybody knows, and single precision does not show.
pub fn rounded(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

/// A velocity in the heading frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Velocity {
    /// Forward, m/s.
    pub vx_mps: f64,
    /// To the left, m/s.
    pub vy_mps: f64,
    /// To the left, rad/s.
    pub yaw_rate_radps: f64,
}

/// Why a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Ended {
    /// The time asked for was over.
    Time,
    /// A signal.
    Signal,
    /// A second one: the servos were let go where they stood.
    Interrupted,
    /// The robot lay on its side or back.
    Fallen,
    /// The policy gave actions that are not finite.
    BadActions,
    /// The policy held joints at their limits in its trial.
    Saturated,
    /// The kill button.
    Killed,
    /// The hardware.
    #[serde(untagged)]
    Fault(Fault),
}

/// The last line of `caudata-robot run --json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RunSummary {
    /// The robot.
    pub robot: String,
    /// Stream of the policy that ran last.
    pub policy_stream: String,
    /// Its version.
    pub policy_version: u64,
    /// Its SHA-256.
    pub policy_sha256: Sha256Digest,
    /// Policies swapped in during the run.
    pub policy_swaps: u64,
    /// Times that the robot was made to stand for one.
    pub stands_for_swap: u64,
    /// Largest mean speed of the joints at which one was swapped in after rising, rad/s.
    pub swap_speed_radps: f64,
    /// Why the run ended.
    pub ended: Ended,
    /// Time that a policy was in charge, s of the robot's time.
    pub walked_s: f64,
    /// Control ticks in all, soft start and return included.
    pub ticks: u64,
    /// Periods skipped because a tick took too long.
    pub overruns: u64,
    /// Ticks without readings in time; the last target was kept.
    pub late_readings: u64,
    /// From waking to the command sent, median, µs.
    pub tick_p50_us: u64,
    /// The same, 99th percentile.
    pub tick_p99_us: u64,
    /// The same, 99.9th percentile.
    pub tick_p999_us: u64,
    /// One inference with its observation and action filter, 99th percentile, µs.
    pub inference_p99_us: u64,
    /// Memory in use at the end of the run, bytes.
    pub resident_bytes: u64,
    /// From when the tick was due to waking, 99th percentile, µs.
    pub wake_late_p99_us: u64,
    /// Actions that were not finite; the last target was held instead.
    pub held_actions: u64,
    /// Ticks in which the gate slowed a target down.
    pub rate_limited_ticks: u64,
    /// Joint-ticks that a policy wanted at a joint's limit.
    pub saturated_joint_ticks: u64,
    /// Rows in the log; 0 without one.
    pub log_rows: u64,
    /// Rows dropped because the disk was too slow.
    pub log_dropped: u64,
    /// Mean of the commands that the policy was given.
    pub commanded: Velocity,
    /// Mean velocity while walking; null where the link gives no true pose.
    pub achieved: Option<Velocity>,
    /// The same as the legs tell (leg odometry), which a foot that slides deceives; null on a robot with fewer than
    /// two feet, and in water.
    pub by_legs: Option<Velocity>,
    /// Distance between start and end of walking, m; null where the link gives no true pose.
    pub distance_m: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_bucket_edges() {
        let mut latencies = Latencies::default();
        assert_eq!(latencies.quantile_us(0.5), 0);
        // 98 of 12 µs (bucket 10 to 15), one of 203 µs (200 to 205), one of 1 s (beyond: the last bucket).
        for us in std::iter::repeat_n(12, 98).chain([203, 1_000_000]) {
            latencies.add(Duration::from_micros(us));
        }
        assert_eq!(latencies.quantile_us(0.5), 15);
        assert_eq!(latencies.quantile_us(0.99), 205);
        assert_eq!(latencies.quantile_us(1.0), 40_000);
    }

    fn about_z(yaw: f64) -> [f32; 4] {
        [(0.5 * yaw).cos() as f32, 0.0, 0.0, (0.5 * yaw).sin() as f32]
    }

    #[test]
    fn straight_on_under_another_heading() {
        // Facing world +y, 2 mm per tick of 20 ms along +y and 1 mm along −x (to the left): 0.1 m/s, 0.05
        // m/s.
        let mut odometer = Odometer::default();
        for k in 0..201 {
            let k = k as f32;
            odometer.add([-0.001 * k, 0.002 * k, 0.3], about_z(std::f64::consts::FRAC_PI_2), 0.02);
        }
        let (velocity, distance) = odometer.result().unwrap();
        assert!((velocity.vx_mps - 0.1).abs() < 1e-4, "{velocity:?}");
        assert!((velocity.vy_mps - 0.05).abs() < 1e-4, "{velocity:?}");
        assert!(velocity.yaw_rate_radps.abs() < 1e-9);
        // √(0.4² + 0.2²)
        assert!((distance - 0.447_21).abs() < 1e-4, "{distance}");
    }

    #[test]
    fn turning_on_a_circle_past_half_a_turn() {
        // 0.5 rad/s on a circle of 0.4 m: 0.2 m/s forward for 10 s, 5 rad in all.
        let mut odometer = Odometer::default();
        for k in 0..=500 {
            let yaw = 0.5 * 0.02 * f64::from(k);
            let pos = [0.4 * yaw.sin(), 0.4 - 0.4 * yaw.cos(), 0.0].map(|x| x as f32);
            odometer.add(pos, about_z(yaw), 0.02);
        }
        let (velocity, _) = odometer.result().unwrap();
        // The chord of a one-second window (0.51 rad) is shorter than its arc by 1 %.
        assert!((velocity.vx_mps - 0.2).abs() < 0.003, "{velocity:?}");
        assert!(velocity.vy_mps.abs() < 0.003);
        assert!((velocity.yaw_rate_radps - 0.5).abs() < 1e-4);
    }

    #[test]
    fn no_poses_no_velocity() {
        assert_eq!(Odometer::default().result(), None);
    }
}
