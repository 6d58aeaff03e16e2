//! What a joint does at one instant, as it was measured.

use crate::trial::{Channel, Steps};

/// Time over which a speed is taken, to each side, s.
const SPEED_WINDOW_S: f64 = 0.03;

/// Position, speed and error of a joint.
#[derive(Debug, Clone, Copy)]
pub struct Motion {
    /// Angle, rad.
    pub q_rad: f64,
    /// Speed, as positions show it, rad/s.
    pub qd_radps: f64,
    /// Command less angle, rad; 0 without a command.
    pub error_rad: f64,
}

impl Motion {
    /// At the stamp `t_s`.
    pub fn at(position: &Channel, command: Option<&Steps>, t_s: f64) -> Self {
        let q_rad = position.at(t_s);
        let ahead = position.at(t_s + SPEED_WINDOW_S);
        let behind = position.at(t_s - SPEED_WINDOW_S);
        let command = command.filter(|c| !c.value.is_empty());
        Self {
            q_rad,
            qd_radps: (ahead - behind) / (2.0 * SPEED_WINDOW_S),
            error_rad: command.map_or(0.0, |c| c.at(t_s) - q_rad),
        }
    }
}
