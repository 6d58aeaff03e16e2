//! What a client may ask for.

use caudata_sim::TerrainKind;
use serde::Deserialize;

/// Greatest change of velocity that one push makes, m/s.
pub const PUSH_MPS_MAX: f32 = 3.0;

/// One order, as JSON: `{"do": "drive", "velocity": [0.3, 0, 0]}`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Order {
    /// To walk: vx, vy (m/s) and yaw rate (rad/s), heading frame. Beyond what the policy was trained for it is
    /// what it was trained for.
    Drive {
        /// The command.
        velocity: [f32; 3],
    },
    /// To be pushed: a force for 0.2 s that would change the velocity of the whole robot by so much, world, m/s.
    Push {
        /// At most 3 m/s.
        velocity_mps: [f32; 2],
    },
    /// Another ground; the robot starts again.
    Terrain {
        /// Any kind but `map`.
        kind: TerrainKind,
    },
    /// A factor on the torque of one actuated joint: 0 is limp, 1 is whole.
    Joint {
        /// In policy order.
        index: usize,
        /// 0 to 1.
        strength: f32,
    },
    /// To start again.
    Restart,
}

impl Order {
    /// Reads an order for a robot with any number of joints.
    ///
    /// # Errors
    /// A line that says what is wrong with it.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let order: Self = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
        let refused = match &order {
            Self::Drive { velocity } if velocity.iter().any(|v| !v.is_finite()) => {
                "velocity must be three finite numbers"
            }
            Self::Push { velocity_mps: [x, y] } if !(0.0..=PUSH_MPS_MAX).contains(&x.hypot(*y)) => {
                "velocity_mps must be at most 3 m/s"
            }
            Self::Joint { strength, .. } if !(0.0..=1.0).contains(strength) => {
                "strength must be 0 to 1"
            }
            Self::Terrain { kind: TerrainKind::Map } => "kind cannot be map",
            _ => return Ok(order),
        };
        Err(refused.to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_read_and_bad_ones_refused() {
        let drive = Order::parse(br#"{"do":"drive","velocity":[0.3,0,-0.1]}"#);
        let velocity = [0.3, 0.0, -0.1];
        assert_eq!(drive, Ok(Order::Drive { velocity }));
        assert_eq!(Order::parse(br#"{"do":"restart"}"#), Ok(Order::Restart));
        for bad in [
            "",
            "[]",
            r#"{"do":"explode"}"#,
            r#"{"do":"drive","velocity":[1,2]}"#,
            r#"{"do":"drive","velocity":[1e99,0,0]}"#,
            r#"{"do":"drive","velocity":[0,0,0],"more":1}"#,
            r#"{"do":"push","velocity_mps":[3,1]}"#,
            r#"{"do":"joint","index":0,"strength":-0.1}"#,
            r#"{"do":"joint","index":-1,"strength":1}"#,
            r#"{"do":"terrain","kind":"map"}"#,
            r#"{"do":"terrain","kind":"moon"}"#,
        ] {
            assert!(Order::parse(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
