//! `<compiler>`: units and conventions of the file.

use crate::pose;

/// `<compiler>` settings.
pub(super) struct Compiler {
    pub rad_per_unit: f64,
    pub autolimits: bool,
    /// Axis index and whether it turns with the frame, for each of the three Euler angles.
    euler: [(usize, bool); 3],
}

impl Default for Compiler {
    fn default() -> Self {
        Self {
            rad_per_unit: 1f64.to_radians(),
            autolimits: true,
            euler: [(0, true), (1, true), (2, true)],
        }
    }
}

impl Compiler {
    /// Takes a sequence of axes; `false`: it is none.
    pub fn set_euler(&mut self, sequence: &str) -> bool {
        let axes = euler_sequence(sequence);
        self.euler = axes.unwrap_or(self.euler);
        axes.is_some()
    }

    pub fn euler_to_quat(&self, angles: [f64; 3]) -> [f64; 4] {
        let mut q = [1.0, 0.0, 0.0, 0.0];
        for (&(axis, moving), angle) in self.euler.iter().zip(angles) {
            let mut unit = [0.0; 3];
            unit[axis] = 1.0;
            let turn = pose::quat_from_axis_angle(unit, angle * self.rad_per_unit);
            q = if moving { pose::quat_mul(q, turn) } else { pose::quat_mul(turn, q) };
        }
        q
    }
}

fn euler_sequence(text: &str) -> Option<[(usize, bool); 3]> {
    let mut out = [(0, true); 3];
    if text.chars().count() != 3 {
        return None;
    }
    for (slot, c) in out.iter_mut().zip(text.chars()) {
        let axis = "xyz".find(c.to_ascii_lowercase())?;
        *slot = (axis, c.is_ascii_lowercase());
    }
    Some(out)
}
