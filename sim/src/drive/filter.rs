//! What a servo does to a command before it follows it (low-pass, and a profile that limits speed and
//! acceleration) and to the speed that it damps.

use super::ServoDrive;
use super::params::NO_LIMIT;
use crate::real::Real;

/// A first-order low-pass over one step, `share` of the way to its input: 1 − exp(−dt/τ) is `y' = (u − y)/τ` with
/// constant input, exactly.
#[inline(always)]
pub fn low_pass<R: Real>(filtered: R, input: R, share: R) -> R {
    // exactly the input at share 1: a lane without the lag must not notice a neighbour's
    let moved = filtered + share * (input - filtered);
    R::select(R::one().le(share), input, moved)
}

/// 1 − exp(−dt/τ): the part of the way that a first-order lag of `time_s` makes in `dt_s`; 1 for no lag.
pub fn lag_share(time_s: f64, dt_s: f64) -> f64 {
    if time_s > 0.0 { -(-dt_s / time_s).exp_m1() } else { 1.0 }
}

/// One step of the profile: position and speed of a point that follows `target_rad` within speed and
/// acceleration limits and arrives at rest (a trapezoidal profile, as servos' firmware makes it). Returns the
/// new position (rad) and speed (rad/s).
///
/// The speed is the highest from which the point can still stop at the target: with steps of dt and braking a
/// it covers a further v²/2a + v·dt/2.
#[inline(always)]
pub fn profile<R: Real>(
    p: &ServoDrive<R>,
    position_rad: R,
    speed_radps: R,
    target_rad: R,
    dt_s: R,
    per_dt: R,
) -> (R, R) {
    let way = target_rad - position_rad;
    let per_step = p.profile_acceleration_radps2 * dt_s;
    let half = R::splat(0.5) * per_step;
    // √(h² + 2·a·s) − h, as a quotient: the difference has no digits left where the limit is far away
    let twice = R::splat(2.0) * p.profile_acceleration_radps2 * way.abs();
    let stopping = twice / ((half * half + twice).sqrt() + half);
    let fastest = stopping.min(way.abs() * per_dt).min(p.profile_speed_radps);
    let wanted = fastest * way.signum0();
    let speed = wanted.clamp(speed_radps - per_step, speed_radps + per_step);
    // exactly the target without limits, likewise
    let most = R::splat(NO_LIMIT);
    let free = most.le(p.profile_speed_radps) & most.le(p.profile_acceleration_radps2);
    (R::select(free, target_rad, position_rad + dt_s * speed), speed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_through_the_low_pass() {
        // τ = 50 ms, 2 ms steps: after 50 ms 1 − 1/e, whatever the step
        let share = lag_share(0.05, 0.002);
        let mut y = 0.0;
        for _ in 0..25 {
            y = low_pass(y, 1.0, share);
        }
        assert!((y - 0.632_120_558_83_f64).abs() < 1e-9);
        assert_eq!(lag_share(0.0, 0.002), 1.0);
    }

    fn limits(speed: f64, acceleration: f64) -> ServoDrive<f64> {
        ServoDrive {
            profile_speed_radps: speed,
            profile_acceleration_radps2: acceleration,
            ..ServoDrive::default()
        }
    }

    /// Runs until the target of 1 rad is reached; returns the time, the highest speed, and the farthest
    /// position.
    fn ride(p: &ServoDrive<f64>, dt: f64) -> (f64, f64, f64) {
        let (mut x, mut v, mut fastest, mut farthest) = (0.0, 0.0, 0.0_f64, 0.0_f64);
        let mut steps = 0;
        while (x - 1.0_f64).abs() > 1e-4 && steps < 100_000 {
            (x, v) = profile(p, x, v, 1.0, dt, 1.0 / dt);
            fastest = fastest.max(v);
            farthest = farthest.max(x);
            steps += 1;
        }
        (f64::from(steps) * dt, fastest, farthest)
    }

    #[test]
    fn trapezoid_takes_as_long_as_it_should() {
        // 1 rad at 2 rad/s with 10 rad/s²: 0.2 s up, 0.2 s down, 0.6 rad cruising in 0.3 s: 0.7 s
        let (time, fastest, farthest) = ride(&limits(2.0, 10.0), 0.002);
        assert!((time - 0.7).abs() < 0.008, "took {time} s");
        assert!((fastest - 2.0).abs() < 1e-9);
        assert!(farthest < 1.0 + 1e-6, "overshot to {farthest}");
        // never reaches 20 rad/s: triangle of 2·√(1/10) = 0.632 s, peak 3.16 rad/s
        let (time, fastest, _) = ride(&limits(20.0, 10.0), 0.002);
        assert!((time - 0.632).abs() < 0.012, "took {time} s");
        assert!((fastest - 3.162).abs() < 0.03, "peaked at {fastest}");
    }

    #[test]
    fn arrives_in_single_precision_without_an_acceleration_limit() {
        let p = ServoDrive {
            profile_speed_radps: 2.0_f32,
            profile_acceleration_radps2: 1e9,
            ..ServoDrive::default()
        };
        // 0.3001 rad at 2 rad/s: 37.5 steps of 4 ms
        let (mut x, mut v) = (0.0, 0.0);
        for _ in 0..38 {
            (x, v) = profile(&p, x, v, 0.3001, 0.004, 250.0);
        }
        assert!((x - 0.3001).abs() < 1e-6, "stays {} away", x - 0.3001);
    }

    #[test]
    fn no_limit_is_no_profile() {
        let (x, v) = profile(&limits(1e6, 1e12), 0.0, 0.0, 0.7, 0.002, 500.0);
        assert!((x - 0.7_f64).abs() < 1e-6 && (v - 350.0_f64).abs() < 1e-3);
    }
}
