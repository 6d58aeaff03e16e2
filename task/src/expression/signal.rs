//! What an expression may name: one row per signal.

use caudata_declare::named;

use super::Unit;

named! {
    /// How many values a signal has.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    pub enum Shape {
        /// One.
        Scalar = "a number",
        /// x, y, z.
        Three = "x, y, z",
        /// One per actuated joint, policy order.
        Joints = "per joint",
        /// One per foot, in the order of the robot file.
        Feet = "per foot",
    }
}

/// Who knows a signal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// The robot's own sensors and controller: observations may use it on the robot.
    Sensed,
    /// Only the simulation: rewards and terminations may use it, and observations that never leave it.
    Simulated,
}

/// A row of the table of signals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignalInfo {
    /// Name in expressions.
    pub name: &'static str,
    /// How many values it has.
    pub shape: Shape,
    /// Their unit.
    pub unit: Unit,
    /// Who knows it.
    pub known: Known,
    /// What it is.
    pub about: &'static str,
}

/// Makes the signals and their table.
macro_rules! signals {
    ($($(#[doc = $about:literal])+ $signal:ident = $name:literal, $shape:ident, $unit:expr, $known:ident;)+) => {
        /// A named quantity of the state after a control step.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Signal {
            $($(#[doc = $about])+ $signal,)+
        }

        /// Every signal, in the order of [`Signal`].
        pub const SIGNALS: &[SignalInfo] = &[$(SignalInfo {
            name: $name,
            shape: Shape::$shape,
            unit: $unit,
            known: Known::$known,
            about: concat!($($about),+),
        }),+];

        impl Signal {
            /// The signal with this name.
            pub fn named(name: &str) -> Option<Self> {
                match name {
                    $($name => Some(Self::$signal),)+
                    _ => None,
                }
            }
        }
    };
}

const METRE: Unit = Unit::of(1, 0, 0);
const SPEED: Unit = Unit::of(1, 0, -1);
const RATE: Unit = Unit::of(0, 0, -1);
const FORCE: Unit = Unit::of(1, 1, -2);

signals! {
    /// Joint velocities, rad/s.
    JointVel = "joint_vel", Joints, RATE, Sensed;
    /// Joint positions, rad.
    JointPos = "joint_pos", Joints, Unit::ONE, Sensed;
    /// Joint positions of the nominal pose, rad.
    Nominal = "nominal", Joints, Unit::ONE, Sensed;
    /// Lower limits of the joints, rad.
    Lower = "lower", Joints, Unit::ONE, Sensed;
    /// Upper limits of the joints, rad.
    Upper = "upper", Joints, Unit::ONE, Sensed;
    /// 1 for a joint of the tail, 0 otherwise.
    InTail = "in_tail", Joints, Unit::ONE, Simulated;
    /// Angular velocity, rad/s, body.
    Gyro = "gyro", Three, RATE, Sensed;
    /// Direction of gravity, unit vector, body; upright is 0, 0, −1.
    Gravity = "gravity", Three, Unit::ONE, Sensed;
    /// Phase of each foot, rad, −π to π.
    Phase = "phase", Feet, Unit::ONE, Sensed;
    /// Phase of the gait clock (of the first foot, where there are feet), rad, −π to π.
    Clock = "clock", Scalar, Unit::ONE, Sensed;
    /// Commanded forward velocity, m/s.
    CommandVx = "command_vx", Scalar, SPEED, Sensed;
    /// Commanded velocity to the left, m/s.
    CommandVy = "command_vy", Scalar, SPEED, Sensed;
    /// Commanded yaw rate, rad/s.
    CommandYaw = "command_yaw_rate", Scalar, RATE, Sensed;
    /// The newest action, clipped.
    Action = "action", Joints, Unit::ONE, Sensed;
    /// The action before it, clipped.
    PreviousAction = "previous_action", Joints, Unit::ONE, Sensed;
    /// Position targets before they are cut off at the limits, rad.
    Target = "target", Joints, Unit::ONE, Simulated;
    /// Joint velocities a control step ago, rad/s.
    PreviousJointVel = "previous_joint_vel", Joints, RATE, Simulated;
    /// Motor torques, mean over the step, N·m.
    Torque = "torque", Joints, Unit::of(2, 1, -2), Simulated;
    /// Mechanical power of each motor, mean over the step, signed, W.
    Power = "power", Joints, Unit::of(2, 1, -3), Simulated;
    /// Velocity of the whole body's centre of mass, m/s: forward, left, up.
    Velocity = "velocity", Three, SPEED, Simulated;
    /// Yaw rate of the whole body, rad/s.
    YawRate = "yaw_rate", Scalar, RATE, Simulated;
    /// Height of the centre of mass above the ground under the feet, m.
    Height = "height", Scalar, METRE, Simulated;
    /// Height of each foot's lowest point above the ground, m.
    FootHeight = "foot_height", Feet, METRE, Simulated;
    /// Horizontal speed of each foot, m/s.
    FootSpeed = "foot_speed", Feet, SPEED, Simulated;
    /// Vertical contact force on each foot, mean over the step, N.
    FootForce = "foot_force", Feet, FORCE, Simulated;
    /// 1 for a foot with more than `task.reward.contact_force_n` on it, 0 otherwise.
    Contact = "contact", Feet, Unit::ONE, Simulated;
    /// Contact force on trunk and legs but not the feet, N.
    TrunkForce = "trunk_force", Scalar, FORCE, Simulated;
    /// How far the heading is to the left of the course that is held, rad.
    OffCourse = "off_course", Scalar, Unit::ONE, Simulated;
    /// 1 while the command is to stand, 0 otherwise.
    Standing = "standing", Scalar, Unit::ONE, Simulated;
    /// 1 while the centre of mass is under water, 0 otherwise.
    Submerged = "submerged", Scalar, Unit::ONE, Simulated;
    /// 1 while it is that and the ground is out of reach, 0 otherwise.
    Afloat = "afloat", Scalar, Unit::ONE, Simulated;
    /// Force that pushes the trunk, N: forward, left, up.
    Push = "push", Three, FORCE, Simulated;
    /// Friction coefficient of the feet.
    Friction = "friction", Scalar, Unit::ONE, Simulated;
    /// Length of a control step, s.
    Step = "dt", Scalar, Unit::of(0, 0, 1), Simulated;
}

impl Signal {
    /// Its row.
    pub fn info(self) -> &'static SignalInfo {
        &SIGNALS[self as usize]
    }
}

/// The parts of a robot that an expression may name.
#[derive(Clone, Copy, Debug, Default)]
pub struct Names<'a> {
    /// Actuated joints, policy order.
    pub joints: &'a [String],
    /// Feet.
    pub feet: &'a [String],
}

/// What is wrong with an expression, without its place.
pub type Reason = String;
