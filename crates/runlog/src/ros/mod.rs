//! Logs as MCAP files of the ROS 2 profile: what `ros2 bag record` writes and Foxglove, rerun and PlotJuggler
//! open.
//!
//! | messages | topic | signals |
//! |---|---|---|
//! | `sensor_msgs/JointState` | with `command` or `cmd` in its name | position → `cmd.<joint>` |
//! | | with `current` in its name | effort → `cur.<joint>` |
//! | | any other | `pos`, `vel`, effort → `tau` |
//! | `sensor_msgs/Imu` | any | `imu.gyro`, `imu.acc`; orientation → `imu.grav` |
//! | `sensor_msgs/BatteryState` | any | `volt` |
//! | `geometry_msgs/PoseStamped` | `…/mocap/<marker>` | `mocap.<marker>` |
//! | | any other | `base.pos`, `base.quat` |
//! | `geometry_msgs/TwistStamped` | any | `base.vel` |
//! | `std_msgs/Float64` | `/signal/…` | the one named, `/` for `.`: `/signal/temp/FL_hip` |
//!
//! Written, and passed over by the reader: `/robot_description` (URDF), `/tf`, `/odom` ([`Scene`]), `/diagnostics`
//! (what servos say of themselves, once a second).
//!
//! Time is the header's stamp (the recorder's, where a message has none), counted from the first message.
//! Messages with one stamp make one row.

pub mod bag;
pub mod cdr;
pub mod container;
pub mod messages;
mod read;
mod write;

pub use mcap::Compression;
pub use read::parse_mcap;
pub use write::{Frame, Scene, write_mcap};

use crate::signal::Signal;

/// Signals that no message has a place for have one topic each, below this.
const SIGNAL: &str = "/signal/";

/// The topic of a signal that no message has a place for.
fn topic_of_signal(signal: &Signal) -> String {
    format!("{SIGNAL}{}", signal.to_string().replace('.', "/"))
}

/// The signal of such a topic.
fn signal_of_topic(topic: &str) -> Option<Signal> {
    topic.strip_prefix(SIGNAL)?.replace('/', ".").parse().ok()
}

/// Direction of gravity in a frame that stands in the world as `q` (world_from_frame, w, x, y, z).
pub fn gravity_of([w, x, y, z]: [f64; 4]) -> [f64; 3] {
    // the third row of the rotation matrix, turned round: Rᵀ·(0, 0, −1)
    [-2.0 * (x * z - w * y), -2.0 * (y * z + w * x), -(1.0 - 2.0 * (x * x + y * y))]
}

/// An orientation without yaw in which gravity is `g` (a unit vector): what can be said of it in an `Imu`
/// message.
fn orientation_of(g: [f64; 3]) -> [f64; 4] {
    let pitch = g[0].clamp(-1.0, 1.0).asin();
    let roll = (-g[1]).atan2(-g[2]);
    let ((sp, cp), (sr, cr)) = ((0.5 * pitch).sin_cos(), (0.5 * roll).sin_cos());
    [cp * cr, cp * sr, sp * cr, -sp * sr]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gravity_and_orientation_are_each_others_inverse() {
        assert_eq!(gravity_of([1.0, 0.0, 0.0, 0.0]), [0.0, 0.0, -1.0]);
        // rolled a quarter turn to the right side down (about +x): the left side (+y) points up, gravity
        // along −y
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let g = gravity_of([half, half, 0.0, 0.0]);
        assert!((g[1] + 1.0).abs() < 1e-12 && g[0].abs() < 1e-12 && g[2].abs() < 1e-12, "{g:?}");
        for g in [[0.1, -0.2, -(1.0f64 - 0.05).sqrt()], [0.6, 0.8, 0.0], [0.0, 0.6, 0.8]] {
            let back = gravity_of(orientation_of(g));
            for k in 0..3 {
                assert!((back[k] - g[k]).abs() < 1e-12, "{g:?} {back:?}");
            }
        }
    }
}
