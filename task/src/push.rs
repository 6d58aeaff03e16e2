//! Pushes: random horizontal forces on the torso.

use std::f32::consts::PI;

use caudata_declare::settings;
use caudata_random::Stream;
use serde::{Deserialize, Serialize};

use crate::TaskError;
use crate::error::{checks, within};

settings! {
    /// Table `[task.push]`: when and how hard the robot is pushed.
    #[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    pub struct PushConfig {
        /// Whether there are pushes. Default true.
        pub enabled: bool = true,
        /// Time from the end of a push to the next one, s, uniform in [min, max]. Default 3 to 8.
        /// Too short: the policy learns to brace all the time instead of walking.
        pub interval_s: [f32; 2] = [3.0, 8.0],
        /// How long a push lasts, s. Default 0.1 to 0.3.
        pub duration_s: [f32; 2] = [0.1, 0.3],
        /// Size of the force, N, in a uniformly drawn horizontal direction. Default 0 to 5: on 2.6 kg, 5 N
        /// for 0.2 s is a jolt of 0.4 m/s. Too large: nothing can be learnt from falling over.
        pub force_n: [f32; 2] = [0.0, 5.0],
        /// Environment steps of the whole run after which pushes have their full size; until then the size
        /// grows in proportion. Default 0: full size from the start.
        pub full_after_env_steps: u64 = 0,
    }
}

impl PushConfig {
    /// Checks every value.
    ///
    /// # Errors
    /// [`TaskError::Config`] names the first field that is out of range.
    pub fn validate(&self) -> Result<(), TaskError> {
        let time = "must be [min, max] within 0.001 to 1000000 s";
        checks! {
            self, "push.";
            interval_s: within(self.interval_s, 1e-3, 1e6), time;
            duration_s: within(self.duration_s, 1e-3, 1e6), time;
            force_n: within(self.force_n, 0.0, 1e4), "must be [min, max] within 0 to 10000 N";
        }
    }

    /// Factor on the force after `env_steps` steps of the whole run, 0 to 1.
    pub fn strength(&self, env_steps: u64) -> f32 {
        if env_steps >= self.full_after_env_steps {
            1.0
        } else {
            (env_steps as f64 / self.full_after_env_steps as f64) as f32
        }
    }
}

/// Where one environment is between pushes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PushSchedule {
    /// Control steps until the next push starts; 0 during a push.
    wait_steps: u32,
    /// Control steps that the present push still lasts.
    push_steps: u32,
    /// Force of the present push, N, world.
    force_n: [f32; 2],
}

impl PushSchedule {
    /// Draws the wait for the first push of an episode.
    pub fn draw(config: &PushConfig, control_period_s: f32, stream: &mut Stream) -> Self {
        Self {
            wait_steps: draw_steps(config.interval_s, control_period_s, stream),
            ..Self::default()
        }
    }

    /// Begins a push now, drawn or not: `force_n` (world x and y) for so many control steps.
    pub fn begin(&mut self, force_n: [f32; 2], steps: u32) {
        *self = Self { wait_steps: 0, push_steps: steps, force_n };
    }

    /// The force (N, world x and y) for the coming control step, scaled by `strength`; moves the schedule on.
    pub fn next_force(
        &mut self,
        config: &PushConfig,
        strength: f32,
        control_period_s: f32,
        stream: &mut Stream,
    ) -> [f32; 2] {
        if self.push_steps == 0 {
            if !config.enabled {
                return [0.0; 2];
            }
            if self.wait_steps > 0 {
                self.wait_steps -= 1;
                return [0.0; 2];
            }
            self.push_steps = draw_steps(config.duration_s, control_period_s, stream);
            let size = stream.uniform(config.force_n[0], config.force_n[1]);
            let (sin, cos) = stream.uniform(-PI, PI).sin_cos();
            self.force_n = [size * cos, size * sin];
        }
        self.push_steps -= 1;
        if self.push_steps == 0 && config.enabled {
            self.wait_steps = draw_steps(config.interval_s, control_period_s, stream);
        }
        self.force_n.map(|f| f * strength)
    }
}

/// A time drawn from `range_s`, in control steps, at least one.
fn draw_steps(range_s: [f32; 2], control_period_s: f32, stream: &mut Stream) -> u32 {
    let time_s = stream.uniform(range_s[0], range_s[1]);
    ((time_s / control_period_s).round() as u32).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use caudata_random::{Key, Purpose};

    fn forces(config: &PushConfig, strength: f32, steps: usize) -> Vec<[f32; 2]> {
        let mut stream = Stream::new(Key::for_run(5), Purpose::Push);
        let mut schedule = PushSchedule::draw(config, 0.02, &mut stream);
        (0..steps).map(|_| schedule.next_force(config, strength, 0.02, &mut stream)).collect()
    }

    #[test]
    fn waits_pushes_and_waits_again() {
        // 0.1 s wait = 5 steps, 0.06 s push = 3 steps: period 8, the first push at steps 5, 6, 7.
        let config = PushConfig {
            interval_s: [0.1, 0.1],
            duration_s: [0.06, 0.06],
            force_n: [2.0, 4.0],
            ..PushConfig::default()
        };
        let forces = forces(&config, 1.0, 80);
        for (step, force) in forces.iter().enumerate() {
            let size = force[0].hypot(force[1]);
            if step % 8 < 5 {
                assert_eq!(size, 0.0, "step {step}");
            } else {
                assert!((1.999..4.001).contains(&size), "step {step}: {size} N");
            }
        }
        assert_eq!(forces[5], forces[7]);
        assert_ne!(forces[5], forces[13]);
    }

    #[test]
    fn strength_grows_with_progress_and_scales_the_force() {
        let config = PushConfig { full_after_env_steps: 1000, ..PushConfig::default() };
        assert_eq!(config.strength(0), 0.0);
        assert_eq!(config.strength(250), 0.25);
        assert_eq!(config.strength(5000), 1.0);
        assert_eq!(PushConfig::default().strength(0), 1.0);
        let (full, half) = (forces(&config, 1.0, 600), forces(&config, 0.5, 600));
        assert!(full.iter().any(|f| f[0] != 0.0));
        for (full, half) in full.iter().zip(half) {
            assert_eq!([full[0] * 0.5, full[1] * 0.5], half);
        }
    }

    #[test]
    fn switched_off_means_no_force() {
        let config = PushConfig { enabled: false, ..PushConfig::default() };
        assert!(forces(&config, 1.0, 1000).iter().all(|f| *f == [0.0; 2]));
        // but for a push from outside
        let mut stream = Stream::new(Key::for_run(5), Purpose::Push);
        let mut schedule = PushSchedule::draw(&config, 0.02, &mut stream);
        schedule.begin([1.0, -2.0], 2);
        let felt: Vec<_> =
            (0..4).map(|_| schedule.next_force(&config, 1.0, 0.02, &mut stream)).collect();
        assert_eq!(felt, [[1.0, -2.0], [1.0, -2.0], [0.0; 2], [0.0; 2]]);
    }

    #[test]
    fn pushes_come_from_all_sides() {
        let config = PushConfig {
            interval_s: [0.02, 0.02],
            duration_s: [0.02, 0.02],
            ..PushConfig::default()
        };
        let forces = forces(&config, 1.0, 400);
        for (sx, sy) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            let count = forces.iter().filter(|f| f[0] * sx > 0.0 && f[1] * sy > 0.0).count();
            // 200 pushes, a quarter in each quadrant, standard deviation 6.
            assert!((count as i64 - 50).abs() < 28, "{count}");
        }
    }
}
