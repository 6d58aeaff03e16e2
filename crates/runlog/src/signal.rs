//! Signal names, as they stand in the header of `log.csv`.

use std::fmt;
use std::str::FromStr;

/// Longest name of a joint, leg or marker.
const MAX_NAME_BYTES: usize = 64;

/// A coordinate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Axis {
    /// Forward.
    X,
    /// Left.
    Y,
    /// Up.
    Z,
}

impl Axis {
    /// x, y, z.
    pub const ALL: [Self; 3] = [Self::X, Self::Y, Self::Z];

    fn letter(self) -> &'static str {
        ["x", "y", "z"][self as usize]
    }
}

/// A part of a quaternion.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum QuatPart {
    /// Real part.
    W,
    /// Imaginary part along x.
    X,
    /// Imaginary part along y.
    Y,
    /// Imaginary part along z.
    Z,
}

impl QuatPart {
    /// w, x, y, z.
    pub const ALL: [Self; 4] = [Self::W, Self::X, Self::Y, Self::Z];

    fn letter(self) -> &'static str {
        ["w", "x", "y", "z"][self as usize]
    }
}

/// What a column holds. The `Display` form is the column's name; `FromStr` reads it back.
///
/// Names of joints, legs and markers have 1 to 64 letters, digits, `_` or `-`.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Signal {
    /// `cmd.<joint>`: position command as sent, rad.
    Command(String),
    /// `cmd_vel.<joint>`: speed command as sent beside it, rad/s: the loop damps what the joint's speed differs by.
    CommandVelocity(String),
    /// `cmd_tau.<joint>`: torque command as sent beside it, N·m: the loop adds it to its own.
    CommandTorque(String),
    /// `pos.<joint>`: measured joint position, rad.
    Position(String),
    /// `pos2.<joint>`: the same by a second encoder on the other side of the gear, in radians of the joint.
    SecondPosition(String),
    /// `vel.<joint>`: joint velocity as the servo reports it, rad/s.
    Velocity(String),
    /// `cur.<joint>`: motor current, A.
    Current(String),
    /// `tau.<joint>`: joint torque, N·m.
    Torque(String),
    /// `temp.<joint>`: servo temperature, °C.
    Temperature(String),
    /// `pwm.<joint>`: what the servo puts on its motor, share of the supply, −1 to 1.
    Duty(String),
    /// `on.<joint>`: whether the servo gives torque (1) or is switched off and lets go (0); holds until the
    /// next sample.
    Enabled(String),
    /// `volt`: supply voltage, V.
    Voltage,
    /// `imu.gyro.<axis>`: angular velocity in the IMU frame, rad/s.
    Gyro(Axis),
    /// `imu.acc.<axis>`: specific force in the IMU frame, m/s².
    Acceleration(Axis),
    /// `imu.grav.<axis>`: direction of gravity in the IMU frame, unit vector.
    Gravity(Axis),
    /// `base.pos.<axis>`: position of the base in the world, m.
    BasePosition(Axis),
    /// `base.quat.<part>`: orientation world_from_base.
    BaseQuaternion(QuatPart),
    /// `base.vel.<axis>`: velocity of the base in the world, m/s.
    BaseVelocity(Axis),
    /// `mocap.<marker>.<axis>`: position of a marker in the world, m.
    Mocap(String, Axis),
    /// `foot.<leg>.<axis>`: position of a foot in the world, m.
    Foot(String, Axis),
    /// `contact.<leg>`: foot on the ground (1) or not (0).
    Contact(String),
    /// `force.<link>.<axis>`: force from outside on a link, world, N.
    Force(String, Axis),
}

impl Signal {
    /// One for each of these joints, kind by kind.
    pub fn each(kinds: &[fn(String) -> Self], joints: &[&str]) -> Vec<Self> {
        let one = |kind: &fn(String) -> Self, name: &&str| kind((*name).to_owned());
        kinds.iter().flat_map(|kind| joints.iter().map(move |name| one(kind, name))).collect()
    }

    /// One for each axis, kind by kind.
    pub fn axes(kinds: &[fn(Axis) -> Self]) -> Vec<Self> {
        kinds.iter().flat_map(|kind| Axis::ALL.map(kind)).collect()
    }

    /// The parts of the column's name, which dots join: kind, joint or leg or marker, coordinate; empty where
    /// there is none.
    fn parts(&self) -> [&str; 3] {
        match self {
            Self::Command(j) => ["cmd", j, ""],
            Self::CommandVelocity(j) => ["cmd_vel", j, ""],
            Self::CommandTorque(j) => ["cmd_tau", j, ""],
            Self::Position(j) => ["pos", j, ""],
            Self::SecondPosition(j) => ["pos2", j, ""],
            Self::Velocity(j) => ["vel", j, ""],
            Self::Current(j) => ["cur", j, ""],
            Self::Torque(j) => ["tau", j, ""],
            Self::Temperature(j) => ["temp", j, ""],
            Self::Duty(j) => ["pwm", j, ""],
            Self::Enabled(j) => ["on", j, ""],
            Self::Voltage => ["volt", "", ""],
            Self::Gyro(a) => ["imu.gyro", "", a.letter()],
            Self::Acceleration(a) => ["imu.acc", "", a.letter()],
            Self::Gravity(a) => ["imu.grav", "", a.letter()],
            Self::BasePosition(a) => ["base.pos", "", a.letter()],
            Self::BaseQuaternion(p) => ["base.quat", "", p.letter()],
            Self::BaseVelocity(a) => ["base.vel", "", a.letter()],
            Self::Mocap(m, a) => ["mocap", m, a.letter()],
            Self::Foot(l, a) => ["foot", l, a.letter()],
            Self::Contact(l) => ["contact", l, ""],
            Self::Force(l, a) => ["force", l, a.letter()],
        }
    }

    /// What is made of a joint's name, by the kind in front of it.
    fn of_joint(kind: &str) -> Option<fn(String) -> Self> {
        Some(match kind {
            "cmd" => Self::Command,
            "cmd_vel" => Self::CommandVelocity,
            "cmd_tau" => Self::CommandTorque,
            "pos" => Self::Position,
            "pos2" => Self::SecondPosition,
            "vel" => Self::Velocity,
            "cur" => Self::Current,
            "tau" => Self::Torque,
            "temp" => Self::Temperature,
            "pwm" => Self::Duty,
            "on" => Self::Enabled,
            _ => return None,
        })
    }

    /// The joint that the signal belongs to.
    pub fn joint(&self) -> Option<&str> {
        let [kind, name, _] = self.parts();
        Self::of_joint(kind).map(|_| name)
    }

    /// Whether the signal's names can be written and read back; a signal built by hand may hold a name with a
    /// dot, comma or blank.
    pub(crate) fn check(&self) -> Result<(), SignalError> {
        match self {
            Self::Mocap(n, _) | Self::Foot(n, _) | Self::Contact(n) | Self::Force(n, _) => {
                name(n).map(drop)
            }
            other => other.joint().map_or(Ok(()), |n| name(n).map(drop)),
        }
    }
}

impl fmt::Display for Signal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [kind, name, coordinate] = self.parts();
        f.write_str(kind)?;
        for part in [name, coordinate].iter().filter(|part| !part.is_empty()) {
            write!(f, ".{part}")?;
        }
        Ok(())
    }
}

/// Why a text is not a signal name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SignalError {
    /// None of the known forms.
    #[error(
        "`{0}` is not a signal (cmd|cmd_vel|cmd_tau|pos|pos2|vel|cur|tau|temp|pwm|on.<joint>, volt, imu.gyro|acc|grav.x|y|z, base.pos|vel.x|y|z, base.quat.w|x|y|z, mocap.<marker>.x|y|z, foot.<leg>.x|y|z, contact.<leg>, force.<link>.x|y|z)"
    )]
    Unknown(String),
    /// The part that names a joint, leg or marker.
    #[error("`{0}` is not a name of 1 to 64 letters, digits, _ or -")]
    Name(String),
}

fn name(text: &str) -> Result<String, SignalError> {
    let good = |b: u8| b.is_ascii_alphanumeric() || b == b'_' || b == b'-';
    if (1..=MAX_NAME_BYTES).contains(&text.len()) && text.bytes().all(good) {
        return Ok(text.to_owned());
    }
    Err(SignalError::Name(text.to_owned()))
}

impl FromStr for Signal {
    type Err = SignalError;

    fn from_str(text: &str) -> Result<Self, SignalError> {
        let unknown = || SignalError::Unknown(text.to_owned());
        let axis = |t: &str| Axis::ALL.into_iter().find(|a| a.letter() == t);
        let axis = |t: &str| axis(t).ok_or_else(unknown);
        let part = |t: &str| QuatPart::ALL.into_iter().find(|p| p.letter() == t);
        let parts: Vec<&str> = text.split('.').collect();
        match parts.as_slice() {
            ["volt"] => Ok(Self::Voltage),
            ["contact", l] => Ok(Self::Contact(name(l)?)),
            [kind, joint] => {
                name(joint).and_then(|j| Ok(Self::of_joint(kind).ok_or_else(unknown)?(j)))
            }
            ["imu", "gyro", a] => Ok(Self::Gyro(axis(a)?)),
            ["imu", "acc", a] => Ok(Self::Acceleration(axis(a)?)),
            ["imu", "grav", a] => Ok(Self::Gravity(axis(a)?)),
            ["base", "pos", a] => Ok(Self::BasePosition(axis(a)?)),
            ["base", "vel", a] => Ok(Self::BaseVelocity(axis(a)?)),
            ["base", "quat", p] => part(p).map(Self::BaseQuaternion).ok_or_else(unknown),
            ["mocap", m, a] => Ok(Self::Mocap(name(m)?, axis(a)?)),
            ["foot", l, a] => Ok(Self::Foot(name(l)?, axis(a)?)),
            ["force", l, a] => Ok(Self::Force(name(l)?, axis(a)?)),
            _ => Err(unknown()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_form_of_the_format_reads_and_writes_as_listed() {
        for text in [
            "cmd.FL_hip",
            "cmd_vel.FL_hip",
            "cmd_tau.FL_hip",
            "pos.FL_hip",
            "pos2.FL_hip",
            "vel.spine_1",
            "cur.tail_3",
            "tau.tail_3",
            "volt",
            "temp.HR_knee",
            "pwm.HR_knee",
            "on.HR_knee",
            "imu.gyro.x",
            "imu.acc.y",
            "imu.grav.z",
            "base.pos.x",
            "base.quat.w",
            "base.quat.z",
            "base.vel.y",
            "mocap.head-1.z",
            "foot.FL.x",
            "contact.HR",
            "force.gripper.z",
        ] {
            let signal: Signal = text.parse().unwrap();
            assert_eq!(signal.to_string(), text);
            assert!(signal.check().is_ok());
        }
        assert_eq!("pos.FL_hip".parse::<Signal>().unwrap().joint(), Some("FL_hip"));
        assert_eq!("volt".parse::<Signal>().unwrap().joint(), None);
    }

    #[test]
    fn near_misses_are_refused() {
        #[rustfmt::skip]
        let wrong = [
            "", "t", "T", "pos", "pos.", "pos.a.b", "pos.a b", "Pos.a", "volt.a", "imu.gyro", "imu.gyro.w", "imu.mag.x", "base.quat.q",
            "base.acc.x", "mocap.x", "mocap..x", "foot.FL", "foot.FL.w", "contact", "contact.FL.x", "pos.é", " pos.a",
        ];
        for text in wrong {
            assert!(text.parse::<Signal>().is_err(), "{text}");
        }
        assert!(format!("pos.{}", "a".repeat(64)).parse::<Signal>().is_ok());
        assert!(format!("pos.{}", "a".repeat(65)).parse::<Signal>().is_err());
        assert!(Signal::Position("a,b".to_owned()).check().is_err());
    }

    proptest! {
        #[test]
        fn whatever_parses_prints_the_same(text in "(cmd|pos|imu|base|foot|volt)(\\.[a-z_]{1,4}){0,3}") {
            if let Ok(signal) = text.parse::<Signal>() {
                prop_assert_eq!(signal.to_string(), text);
            }
        }
    }
}
