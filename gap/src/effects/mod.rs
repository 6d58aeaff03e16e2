//! The catalogue: every physical effect that diagnosis can name, as a small plug-in.
//!
//! An [`Effect`] is a record: parameters with units, bounds and the smallest change that matters, sizes to try, where it can act, a hook that edits a
//! [`Plant`] (physics, sensors, clocks), look-alikes, and what must have been excited to see it. To add one: write its record in a file of its own
//! or of its family, and add a row to [`ALL`].

mod contact;
mod friction;
mod gear;
mod imu;
mod inertia;
mod place;
mod sensing;
mod servo;
mod structure;
mod supply;
mod timing;
mod water;

use caudata_model::RobotModel;
pub use timing::DROPPED_FRAMES;

use crate::excitation::Excitation;
use crate::plant::Plant;
use crate::trial::Kind;

pub use place::{Place, places};
pub(crate) use servo::less_voltage;

/// Where in the chain an effect acts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layer {
    /// What is read.
    Sensing,
    /// When it is sent and read.
    Timing,
    /// Position loop, motor, supply.
    Actuation,
    /// Friction, gear.
    Transmission,
    /// Play, springs, stops.
    Structure,
    /// Masses.
    Inertia,
    /// Ground.
    Contact,
    /// Water.
    Water,
}

impl Layer {
    /// Its name in reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Sensing => "sensing",
            Self::Timing => "timing",
            Self::Actuation => "actuation",
            Self::Transmission => "transmission",
            Self::Structure => "structure",
            Self::Inertia => "inertia",
            Self::Contact => "contact",
            Self::Water => "water",
        }
    }
}

/// What an effect can act on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Domain {
    /// The robot as a whole.
    Robot,
    /// Actuated joints: all alike, groups alike, or one.
    Joints,
    /// Links: one each.
    Links,
    /// All links alike (water).
    AllLinks,
    /// Play hinges: all alike, or one.
    Play,
    /// Feet: all alike, or one.
    Feet,
}

/// Measure of a parameter on a given robot, so that one grid serves small and large servos.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reference {
    /// 1.
    One,
    /// The servo's largest torque, N·m.
    Torque,
    /// The servo's speed without load, rad/s.
    Speed,
    /// Torque over speed, N·m·s/rad.
    Damping,
    /// Rotor inertia at the joint, kg·m².
    Armature,
    /// The position gain, N·m/rad.
    Gain,
}

/// One parameter of an effect.
#[derive(Debug, Clone, Copy)]
pub struct ParameterSpec {
    /// Name with unit, as in reports.
    pub name: &'static str,
    /// SI unit.
    pub unit: &'static str,
    /// Smallest value, in units of the reference.
    pub low: f64,
    /// Largest value, in units of the reference.
    pub high: f64,
    /// Value without the effect, in units of the reference. Not a number: what the robot file has.
    pub neutral: f64,
    /// Smallest change that matters, in units of the reference.
    pub scale: f64,
    /// What the above are measured in.
    pub reference: Reference,
}

/// One physical effect.
pub struct Effect {
    /// Id of GAP.md.
    pub id: &'static str,
    /// Where in the chain.
    pub layer: Layer,
    /// On what.
    pub domain: Domain,
    /// The first is its size, with those of the same unit (a centre of mass has three).
    pub parameters: &'static [ParameterSpec],
    /// Sizes to try, one value per parameter, in units of the references.
    pub grid: &'static [&'static [f64]],
    /// Whether its trace starts with a threshold (gap, stop, limit), so that a derivative at nothing says nothing.
    pub hinge: bool,
    /// Puts it into a plant. `values` in SI, one per parameter.
    pub apply: fn(&mut Plant, &Place, &[f64]),
    /// Signals in which it shows.
    pub shows_in: &'static [Kind],
    /// Effects that look like it.
    pub look_alikes: &'static [&'static str],
    /// Why the runs cannot show it, if so.
    pub unseen: fn(&Excitation, &Place) -> Option<&'static str>,
    /// A trial that shows it.
    pub trial: &'static str,
    /// How it differs from its look-alikes, in one line.
    pub signature: &'static str,
}

impl std::fmt::Debug for Effect {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.id)
    }
}

impl PartialEq for Effect {
    fn eq(&self, other: &Self) -> bool {
        self.id == other.id
    }
}

impl Effect {
    /// Value of parameter `index` that is `units` references at `place`.
    #[must_use]
    pub fn value(&self, model: &RobotModel, place: &Place, index: usize, units: f64) -> f64 {
        units * reference(model, place, self.parameters[index].reference)
    }

    /// Grid point `k` at `place`, SI. `[P]`
    #[must_use]
    pub fn sizes(&self, model: &RobotModel, place: &Place, k: usize) -> Vec<f64> {
        (self.grid[k].iter().enumerate())
            .map(|(i, &units)| self.value(model, place, i, units))
            .collect()
    }

    /// Values without the effect, SI. `[P]`
    #[must_use]
    pub fn neutral(&self, model: &RobotModel, place: &Place) -> Vec<f64> {
        (0..self.parameters.len())
            .map(|i| {
                let neutral = self.parameters[i].neutral;
                if neutral.is_nan() {
                    return model.backlash().half_width_rad;
                }
                self.value(model, place, i, neutral)
            })
            .collect()
    }

    /// Lowest and highest value of parameter `index`, SI.
    #[must_use]
    pub fn bounds(&self, model: &RobotModel, place: &Place, index: usize) -> (f64, f64) {
        let p = &self.parameters[index];
        (
            self.value(model, place, index, p.low),
            self.value(model, place, index, p.high),
        )
    }

    /// Whether parameter `index` wants to go further than is plausible: its value lies on a bound. Without the effect, and where there is none at all of what it
    /// counts, nothing does; nor where there is all of what it is a share of.
    #[must_use]
    pub fn at_bound(&self, model: &RobotModel, place: &Place, index: usize, value: f64) -> bool {
        let spec = &self.parameters[index];
        let a_share = spec.unit.is_empty() && (spec.low, spec.high) == (0.0, 1.0);
        let (low, high) = self.bounds(model, place, index);
        let near = 1e-6 * (high - low);
        let neutral = self.neutral(model, place)[index];
        let moved = (value - neutral).abs() >= near && value.abs() >= near;
        !a_share && moved && (value <= low + near || value >= high - near)
    }

    /// Smallest change of parameter `index` that matters, SI.
    #[must_use]
    pub fn scale(&self, model: &RobotModel, place: &Place, index: usize) -> f64 {
        self.value(model, place, index, self.parameters[index].scale)
    }
}

fn reference(model: &RobotModel, place: &Place, reference: Reference) -> f64 {
    let joints: Vec<usize> = match place.domain {
        Domain::Joints => place.items.clone(),
        _ => (0..model.actuated().len()).collect(),
    };
    let mean = |f: &dyn Fn(usize) -> f64| {
        joints.iter().map(|&a| f(a)).sum::<f64>() / joints.len().max(1) as f64
    };
    match reference {
        Reference::One => 1.0,
        Reference::Torque => mean(&|a| model.servo(a).tau_max_nm),
        Reference::Speed => mean(&|a| model.servo(a).qd_max_radps),
        Reference::Damping => mean(&|a| model.servo(a).tau_max_nm / model.servo(a).qd_max_radps),
        Reference::Armature => {
            mean(&|a| model.joints()[model.actuated()[a]].armature_kgm2.max(1e-4))
        }
        Reference::Gain => model.kp_nm_per_rad().max(1e-6),
    }
}

/// The catalogue.
pub static ALL: &[&Effect] = &[
    &sensing::ENCODER_OFFSET,
    &sensing::ENCODER_GAIN,
    &sensing::VELOCITY_LAG,
    &sensing::CURRENT_BIAS,
    &sensing::CURRENT_LAG,
    &imu::IMU_TILT,
    &imu::GYRO_BIAS,
    &imu::IMU_DELAY,
    &imu::MOCAP_FRAME,
    &timing::COMMAND_DELAY,
    &timing::MEASUREMENT_DELAY,
    &timing::BUS_SKEW,
    &timing::DROPPED_FRAMES,
    &timing::CLOCK_DRIFT,
    &timing::COMMAND_LOW_PASS,
    &timing::PROFILE_LIMIT,
    &timing::SERVO_LOOP_DELAY,
    &servo::KP_ERROR,
    &servo::KD_ERROR,
    &servo::INTEGRAL_ACTION,
    &servo::TORQUE_CONSTANT,
    &servo::WINDING_RESISTANCE,
    &servo::TORQUE_LIMIT,
    &servo::TORQUE_SATURATION,
    &servo::VOLTAGE_LIMIT,
    &servo::CONTROLLER_DEAD_BAND,
    &servo::BRAKING_ASYMMETRY,
    &servo::STALE_GAINS,
    &supply::SUPPLY_SAG,
    &supply::SUPPLY_LEVEL,
    &supply::THERMAL_DERATING,
    &friction::COULOMB_FRICTION,
    &friction::VISCOUS_FRICTION,
    &friction::STRIBECK_FRICTION,
    &friction::LOAD_DEPENDENT_FRICTION,
    &friction::LOAD_STICTION,
    &friction::DRIVE_ASYMMETRY,
    &friction::DIRECTION_ASYMMETRY,
    &friction::PRE_SLIDING,
    &friction::FRICTION_DRIFT,
    &gear::GEAR_BACKLASH,
    &gear::GEAR_COMPLIANCE,
    &gear::COGGING,
    &structure::GIRDLE_PLAY,
    &structure::PARALLEL_SPRING,
    &structure::HARD_STOP,
    &inertia::LINK_MASS,
    &inertia::LINK_COM,
    &inertia::LINK_INERTIA,
    &inertia::ARMATURE,
    &inertia::PAYLOAD,
    &inertia::FLOOR_SLOPE,
    &contact::CONTACT_FRICTION,
    &contact::BELLY_FRICTION,
    &water::LINEAR_DRAG,
    &water::QUADRATIC_DRAG,
    &water::ADDED_MASS,
    &water::BUOYANCY,
    &water::BUOYANCY_CENTRE,
    &water::HEAVE_DAMPING,
    &water::WATER_CURRENT,
    &water::WATER_LEVEL,
];

/// The effect with this id.
#[must_use]
pub fn find(id: &str) -> Option<&'static Effect> {
    ALL.iter().copied().find(|e| e.id == id)
}

/// A parameter: name, unit, neutral, low, high, smallest that matters, reference.
const fn parameter(
    name: &'static str,
    unit: &'static str,
    neutral: f64,
    (low, high): (f64, f64),
    scale: f64,
    reference: Reference,
) -> ParameterSpec {
    ParameterSpec {
        name,
        unit,
        low,
        high,
        neutral,
        scale,
        reference,
    }
}

/// Signals of the joints.
const JOINT_SIGNALS: &[Kind] = &[Kind::Position, Kind::Velocity, Kind::Current, Kind::Torque];

/// Signals of the whole body.
const BODY_SIGNALS: &[Kind] = &[
    Kind::Gyro,
    Kind::Acceleration,
    Kind::Gravity,
    Kind::BasePosition,
    Kind::BaseVelocity,
    Kind::BaseAttitude,
    Kind::Foot,
    Kind::Position,
    Kind::Torque,
];

/// For effects that any motion of the joints shows.
fn needs_motion(e: &Excitation, place: &Place) -> Option<&'static str> {
    (e.fastest_radps(place) < 0.2).then_some("the joint hardly moves in these runs")
}
