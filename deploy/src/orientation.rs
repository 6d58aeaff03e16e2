//! The direction of gravity in the IMU frame, from gyroscope and accelerometer.
//!
//! A complementary filter in the manner of Mahony, Hamel and Pflimlin ("Nonlinear complementary filters on
//! the special orthogonal group", 2008), reduced to the one direction that the policy sees. With ω the
//! angular velocity, g the estimate (unit vector, IMU frame) and a the specific force in units of standard
//! gravity: e = −a × g, ġ = g × (ω − b + k_p·e), ḃ = −k_i·e. Gravity is fixed in the world, so in the body it
//! turns against ω.
//!
//! Mahony's filter takes the direction of a. Here its size counts too: whatever shakes a robot that walks on, the
//! mean of a over a stride is vertical, and e is linear in it. The mean of directions is not: a foot that strikes
//! hard and pushes off softly would tilt the estimate.

/// How fast the accelerometer pulls the estimate, 1/s. Larger: gait accelerations leak in; smaller: gyro
/// offsets do.
const KP_PER_S: f32 = 1.0;
/// How fast the gyro offset is learnt, 1/s².
const KI_PER_S2: f32 = 0.1;
/// Largest gyro offset that is believed, rad/s (the sensor's data sheet gives 1 °/s typical).
const BIAS_MAX_RADPS: f32 = 0.1;
/// Standard gravity, m/s².
const G_MPS2: f32 = 9.806_65;
/// The first reading is taken as it is where its size is off gravity by less than this share.
const STILL_WITHIN: f32 = 0.5;
/// Largest |e|: a knock turns the estimate by no more than k_p·e for as long as it lasts. Walking bipeds feel 2 to
/// 3 g (95th percentile), and the mean is vertical only of whole readings.
const ERROR_MAX: f32 = 3.0;

/// Estimates the direction of gravity.
#[derive(Clone, Copy, Debug, Default)]
pub struct GravityFilter {
    gravity: Option<[f32; 3]>,
    /// The gyro offset learnt so far, rad/s. About the vertical it cannot be seen and stays 0.
    pub bias_radps: [f32; 3],
}

impl GravityFilter {
    /// A filter that takes its first believable accelerometer reading as it is.
    pub fn new() -> Self {
        Self::default()
    }

    /// Takes one pair of readings, `dt_s` after the last one, and gives the direction of gravity (unit
    /// vector, IMU frame; level: 0, 0, −1). The specific force at rest points up, so gravity is its opposite.
    /// A reading that is not a number pulls nothing.
    pub fn update(&mut self, gyro_radps: [f32; 3], acc_mps2: [f32; 3], dt_s: f32) -> [f32; 3] {
        let down = acc_mps2.map(|a| -a / G_MPS2);
        let Some(gravity) = self.gravity else {
            // A jolt or free fall shows no direction; level is the best guess until there is one.
            self.gravity = unit(down).filter(|_| (norm(down) - 1.0).abs() < STILL_WITHIN);
            return self.gravity.unwrap_or([0.0, 0.0, -1.0]);
        };
        let error = if norm(down).is_finite() { cross(down, gravity) } else { [0.0; 3] };
        let error = error.map(|e| e * (ERROR_MAX / norm(error)).min(1.0));
        for i in 0..3 {
            let bias = self.bias_radps[i] - KI_PER_S2 * error[i] * dt_s;
            self.bias_radps[i] = bias.clamp(-BIAS_MAX_RADPS, BIAS_MAX_RADPS);
        }
        let rate: [f32; 3] =
            std::array::from_fn(|i| gyro_radps[i] - self.bias_radps[i] + KP_PER_S * error[i]);
        let turned = rotate(gravity, rate.map(|w| -w * dt_s));
        let estimate = unit(turned).unwrap_or(gravity);
        self.gravity = Some(estimate);
        estimate
    }
}

fn norm(v: [f32; 3]) -> f32 {
    v.iter().map(|x| x * x).sum::<f32>().sqrt()
}

/// `None` for a vector too short to have a direction, or one that is not finite.
fn unit(v: [f32; 3]) -> Option<[f32; 3]> {
    let size = norm(v);
    (size > 1e-6 && size.is_finite()).then(|| v.map(|x| x / size))
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// `v` turned by the rotation vector `r` (Rodrigues).
fn rotate(v: [f32; 3], r: [f32; 3]) -> [f32; 3] {
    let angle = norm(r);
    let Some(axis) = unit(r) else {
        let small = cross(r, v);
        return std::array::from_fn(|i| v[i] + small[i]);
    };
    let (sin, cos) = angle.sin_cos();
    let along: f32 = (0..3).map(|i| axis[i] * v[i]).sum();
    let side = cross(axis, v);
    std::array::from_fn(|i| cos * v[i] + sin * side[i] + (1.0 - cos) * along * axis[i])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::FRAC_PI_2;

    const DT: f32 = 0.02;

    #[track_caller]
    fn close(a: [f32; 3], b: [f32; 3], tolerance: f32) {
        let apart = norm(std::array::from_fn(|i| a[i] - b[i]));
        assert!(apart < tolerance, "{a:?} is not {b:?}");
    }

    #[test]
    fn at_rest_gravity_is_against_the_specific_force() {
        let mut filter = GravityFilter::new();
        close(filter.update([0.0; 3], [0.0, 0.0, G_MPS2], DT), [0.0, 0.0, -1.0], 1e-6);
        // Nose down by 30°: the specific force, up in the world, has −sin 30° along the body's x.
        let acc = [-0.5 * G_MPS2, 0.0, 0.75_f32.sqrt() * G_MPS2];
        let mut tilted = GravityFilter::new();
        close(tilted.update([0.0; 3], acc, DT), [0.5, 0.0, -0.866_025], 1e-5);
    }

    #[test]
    fn free_fall_shows_no_direction_to_begin_with() {
        let mut filter = GravityFilter::new();
        let level = [0.0, 0.0, -1.0];
        assert_eq!(filter.update([0.0; 3], [0.2, 0.1, -0.1], DT), level);
        let tilted = filter.update([0.0; 3], [0.0, 0.6 * G_MPS2, 0.8 * G_MPS2], DT);
        close(tilted, [0.0, -0.6, -0.8], 1e-6);
    }

    #[test]
    fn upside_down_is_told_from_upright() {
        let mut filter = GravityFilter::new();
        assert!(filter.update([0.0; 3], [0.0, 0.0, -G_MPS2], DT)[2] > 0.99);
    }

    #[test]
    fn a_quarter_roll_is_followed_by_the_gyro_alone() {
        // Rolling to the right about x at π/2 per second for 1 s, without an accelerometer that could help
        // (free fall). Level gravity (0, 0, −1); after +90° about x the body's y axis points to the old z, so
        // gravity is (0, −1, 0).
        let mut filter = GravityFilter::new();
        filter.update([0.0; 3], [0.0, 0.0, G_MPS2], DT);
        let mut gravity = [0.0; 3];
        for _ in 0..50 {
            gravity = filter.update([FRAC_PI_2, 0.0, 0.0], [0.0; 3], DT);
        }
        close(gravity, [0.0, -1.0, 0.0], 1e-4);
    }

    #[test]
    fn a_wrong_start_is_pulled_right() {
        // A jolt during the first reading puts the estimate 0.2 rad off. While it is small the error obeys
        // ë + k_p·ė + k_i·e = 0 (1 and 0.1): after 60 s it is e^(−0.1127·60) = 0.1 % of it.
        let mut filter = GravityFilter::new();
        filter.update([0.0; 3], [-0.2 * G_MPS2, 0.0, G_MPS2], DT);
        let mut gravity = [0.0; 3];
        for _ in 0..3000 {
            gravity = filter.update([0.0; 3], [0.0, 0.0, G_MPS2], DT);
        }
        close(gravity, [0.0, 0.0, -1.0], 2e-3);
    }

    #[test]
    fn a_gyro_offset_is_learnt_and_does_not_tilt_the_estimate() {
        // 1 °/s about y at rest. Without the integral term the estimate would stay off by 0.01745/k_p = 0.017
        // rad.
        let mut filter = GravityFilter::new();
        let mut gravity = [0.0; 3];
        for _ in 0..3000 {
            gravity = filter.update([0.0, 0.017_45, 0.0], [0.0, 0.0, G_MPS2], DT);
        }
        close(gravity, [0.0, 0.0, -1.0], 1e-3);
        assert!((filter.bias_radps[1] - 0.017_45).abs() < 1e-3, "{:?}", filter.bias_radps);
        assert!(filter.bias_radps[2].abs() < 1e-6);
    }

    #[test]
    fn a_knock_moves_the_estimate_little() {
        // 0.3 g sideways: turned by 0.3·k_p·0.02 s = 0.006 rad; 9 g: by no more than 3·k_p·0.02 s.
        for (sideways_g, turned_rad) in [(0.3, 0.006), (9.0, 0.06)] {
            let mut filter = GravityFilter::new();
            filter.update([0.0; 3], [0.0, 0.0, G_MPS2], DT);
            let gravity = filter.update([0.0; 3], [0.0, sideways_g * G_MPS2, G_MPS2], DT);
            close(gravity, [0.0, -f32::sin(turned_rad), -f32::cos(turned_rad)], 3e-4);
        }
    }

    #[test]
    fn a_reading_that_is_no_number_leaves_no_trace() {
        let mut filter = GravityFilter::new();
        for acc_mps2 in [[0.0, 0.0, G_MPS2], [f32::NAN; 3], [f32::INFINITY, 0.0, 0.0]] {
            filter.update([0.0; 3], acc_mps2, DT);
        }
        filter.update([f32::NAN; 3], [0.0, 0.0, G_MPS2], DT);
        close(filter.update([0.0; 3], [0.0, 0.0, G_MPS2], DT), [0.0, 0.0, -1.0], 1e-6);
        assert_eq!(filter.bias_radps, [0.0; 3]);
    }

    #[test]
    fn strikes_and_soft_pushes_that_make_up_for_each_other_tilt_nothing() {
        // Every fifth tick 1.2 g forward on top of gravity, 0.3 g backward in the other four: their sum is 0.
        // Directions alone: (sin 50.2° − 4·sin 16.7°)/5 = −0.076, an estimate off by 4.4°.
        let mut filter = GravityFilter::new();
        let mut gravity = [0.0; 3];
        for tick in 0..3000 {
            let forward_g = if tick % 5 == 0 { 1.2 } else { -0.3 };
            gravity = filter.update([0.0; 3], [forward_g * G_MPS2, 0.0, G_MPS2], DT);
        }
        close(gravity, [0.0, 0.0, -1.0], 0.02);
    }
}
