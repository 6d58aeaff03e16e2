//! Random open-loop gaits.

use std::f64::consts::TAU;

use caudata_model::RobotModel;
use caudata_random::{Key, Purpose, Stream};

/// A trot: diagonal legs together, hips swing, knees lift in the swing, the spine bends along.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gait {
    /// Strides per second, Hz.
    pub rate_hz: f64,
    /// Swing of the hips, rad.
    pub hip_rad: f64,
    /// Lift of the knees, rad.
    pub knee_rad: f64,
    /// Bend of each spine joint, rad.
    pub spine_rad: f64,
    /// Phase of the spine against the legs, rad.
    pub spine_phase_rad: f64,
    /// Phase of the diagonal legs against each other, rad; π is a trot.
    pub leg_phase_rad: f64,
}

impl Gait {
    /// The gait that the project's tests and benchmarks have always used: 1.3 Hz.
    pub const TROT: Self = Self {
        rate_hz: 1.3,
        hip_rad: 0.35,
        knee_rad: 0.5,
        spine_rad: 0.1,
        spine_phase_rad: 0.0,
        leg_phase_rad: TAU / 2.0,
    };

    /// Gait number `index` of `seed`.
    pub fn random(seed: u64, index: u64) -> Self {
        let key = Key { episode: index, ..Key::for_run(seed) };
        let mut stream = Stream::new(key, Purpose::Command);
        let mut draw = |low, high| stream.uniform_f64(low, high);
        Self {
            rate_hz: draw(0.8, 1.5),
            hip_rad: draw(0.2, 0.45),
            knee_rad: draw(0.3, 0.6),
            spine_rad: draw(0.0, 0.15),
            spine_phase_rad: draw(-0.8, 0.8),
            leg_phase_rad: TAU / 2.0 + draw(-0.3, 0.3),
        }
    }

    /// Position commands, a row per control period of 20 ms.
    pub fn rows(&self, model: &RobotModel, periods: usize) -> Vec<Vec<f32>> {
        let row = |k: usize| {
            let mut row = vec![0.0; model.actuated().len()];
            self.targets(model, k as f64 * 0.02, &mut row);
            row
        };
        (0..periods).map(row).collect()
    }

    /// Position commands at `t_s`, policy order, rad.
    pub fn targets(&self, model: &RobotModel, t_s: f64, out: &mut [f32]) {
        let phase = TAU * self.rate_hz * t_s;
        let nominal = model.nominal_pos_rad();
        for (a, name) in model.actuated_names().iter().enumerate() {
            let leg = if name.starts_with("FL") || name.starts_with("HR") {
                phase
            } else {
                phase + self.leg_phase_rad
            };
            let offset = if name.ends_with("hip") {
                self.hip_rad * leg.cos()
            } else if name.ends_with("knee") {
                -self.knee_rad * (-leg.sin()).max(0.0)
            } else if name.starts_with("spine") {
                self.spine_rad * (phase + self.spine_phase_rad).cos()
            } else {
                0.0
            };
            out[a] = (nominal[a] + offset) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaits_repeat_and_differ() {
        assert_eq!(Gait::random(1, 4), Gait::random(1, 4));
        assert_ne!(Gait::random(1, 4), Gait::random(1, 5));
        assert_ne!(Gait::random(1, 4), Gait::random(2, 4));
    }
}
