//! Parameters from the robot file: servos, sensors, supply, play, contact, water. SI units; the file says
//! where each value is from.

use serde::{Deserialize, Serialize};

/// Gains of the position loop of one joint: torque = kp·(target − position) − kd·velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// N·m/rad.
    pub kp_nm_per_rad: f64,
    /// N·m·s/rad; the servo's own damping comes on top.
    pub kd_nm_s_per_rad: f64,
}

/// Where a servo's encoder sits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EncoderSide {
    /// Behind the gear, at the joint.
    Output,
    /// On the motor: it counts turns of the rotor, and does not see play.
    Motor,
}

/// One servo type: torque envelope, friction, and how it measures.
///
/// Envelope after ToddlerBot v2: the motor torque is limited to `tau_max_nm` up to the speed
/// `qd_tau_max_radps`, then linearly down to `tau_qd_max_nm` at `qd_max_radps`; torque against the motion is
/// limited to `tau_brake_max_nm`. The line is that at `reference_supply_v` and moves in parallel with the supply.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServoParams {
    /// Largest motor torque at low speed, N·m.
    pub tau_max_nm: f64,
    /// Speed up to which `tau_max_nm` is available, rad/s.
    pub qd_tau_max_radps: f64,
    /// Speed at which the taper ends, rad/s.
    pub qd_max_radps: f64,
    /// Torque left at `qd_max_radps`, N·m.
    pub tau_qd_max_nm: f64,
    /// Largest torque against the motion, N·m.
    pub tau_brake_max_nm: f64,
    /// Damping that the servo has beyond its Kd gain, N·m·s/rad.
    pub kd_min_nm_s_per_rad: f64,
    /// Factor on Kp while the load drives the joint against the servo's torque; 1: no change.
    pub back_drive_kp_ratio: f64,
    /// Coulomb friction at the joint, N·m.
    pub friction_loss_nm: f64,
    /// Viscous damping at the joint, N·m·s/rad.
    pub damping_nm_s_per_rad: f64,
    /// Rotor inertia seen at the joint, kg·m².
    pub armature_kgm2: f64,
    /// Supply at which the envelope was identified, V.
    pub reference_supply_v: f64,
    /// Position steps per turn of the output shaft.
    pub encoder_counts_per_turn: u32,
    /// Step of the reported velocity, rad/s.
    pub velocity_lsb_radps: f64,
    /// Step of the reported current, A.
    pub current_lsb_a: f64,
    /// Joint torque per ampere beyond the dead band, N·m/A.
    pub torque_per_current_nm_per_a: f64,
    /// Current that gives no torque yet, A.
    pub current_dead_band_a: f64,
    /// Full width of the play between motor and output shaft, rad.
    pub gear_backlash_rad: f64,
    /// Largest motor current, A; 0 (default): the torque limits alone count.
    #[serde(default)]
    pub current_limit_a: f64,
    /// Friction at rest beyond `friction_loss_nm`, N·m (Stribeck); default 0.
    #[serde(default)]
    pub stribeck_nm: f64,
    /// Speed at which it has fallen to 1/e, rad/s; default 0.1.
    #[serde(default = "default_stribeck_speed_radps")]
    pub stribeck_speed_radps: f64,
    /// Friction per load torque while the motor drives the load; default 0.
    #[serde(default)]
    pub load_friction_driving: f64,
    /// Friction per load torque while the load drives the motor; default 0.
    #[serde(default)]
    pub load_friction_driven: f64,
    /// Whether Kd acts on the rate of the error, as in a textbook's PID, so that a moving command is not braked and a
    /// step of it is a kick; default: it acts on the joint's speed alone.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub kd_acts_on_error: bool,
    /// Time over which it takes that rate, s; default 0.001, a period of the firmware of hobby servos.
    #[serde(default = "default_kd_rate_over_s", skip_serializing_if = "is_default_rate")]
    pub kd_rate_over_s: f64,
    /// Where its encoder sits. `None`: nobody says; simulated at the output, and a diagnosis tries both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoder: Option<EncoderSide>,
}

fn default_stribeck_speed_radps() -> f64 {
    0.1
}

/// Default of [`ServoParams::kd_rate_over_s`].
pub(crate) fn default_kd_rate_over_s() -> f64 {
    0.001
}

fn is_default_rate(over_s: &f64) -> bool {
    *over_s == default_kd_rate_over_s()
}

fn default_supply_lag_s() -> f64 {
    0.005
}

impl ServoParams {
    /// Position step of the encoder, rad.
    pub fn encoder_lsb_rad(&self) -> f64 {
        std::f64::consts::TAU / f64::from(self.encoder_counts_per_turn)
    }
}

/// How well the figures of a link were measured (robot file, `[measured.LINK]`): what stands there is the tolerance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, expecting = "a table with the tolerances `mass_kg` and `com_m`")]
pub struct Measured {
    /// Tolerance of its mass, ± kg; 0: as exactly as can be. `None`: nobody weighed it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mass_kg: Option<f64>,
    /// Tolerance of its centre of mass along each axis, ± m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub com_m: Option<f64>,
}

/// The inertial measurement unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImuParams {
    /// Site at which it sits; its axes are the site's.
    pub site: String,
    /// Gyroscope white noise, rad/s/√Hz.
    pub gyro_noise_radps_per_sqrt_hz: f64,
    /// Accelerometer white noise, m/s²/√Hz.
    pub acc_noise_mps2_per_sqrt_hz: f64,
    /// Standard deviation of the constant gyroscope offset from one power-up to the next, rad/s.
    pub gyro_bias_std_radps: f64,
    /// Standard deviation of the constant accelerometer offset, m/s².
    pub acc_bias_std_mps2: f64,
}

/// Sensors of the whole robot (those inside a servo are in [`ServoParams`]).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorParams {
    /// The IMU; `None` on a robot without one.
    pub imu: Option<ImuParams>,
}

/// Supply voltages.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SupplyParams {
    /// Voltage that simulations use unless told otherwise, V.
    pub default_v: f64,
    /// Bench supply, V.
    pub bench_v: f64,
    /// Full battery, V.
    pub battery_full_v: f64,
    /// Nominal battery, V.
    pub battery_nominal_v: f64,
    /// Resistance of battery and wiring, Ω; default 0: the voltage does not sag.
    #[serde(default)]
    pub resistance_ohm: f64,
    /// Time constant with which the voltage follows the load, s; default 0.005.
    #[serde(default = "default_supply_lag_s")]
    pub lag_s: f64,
}

/// Play at the girdle connections.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BacklashParams {
    /// `false`: the hinges are locked at zero.
    pub enabled: bool,
    /// Model indices of the backlash hinges, in model order.
    pub joints: Vec<usize>,
    /// The hinge moves freely within ± this angle, rad.
    pub half_width_rad: f64,
    /// Centring stiffness inside the play, N·m/rad.
    pub stiffness_nm_per_rad: f64,
    /// Viscous damping, N·m·s/rad.
    pub damping_nm_s_per_rad: f64,
    /// Coulomb friction, N·m.
    pub friction_loss_nm: f64,
}

/// Ground contact.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ContactParams {
    /// Sliding friction coefficient of the feet.
    pub foot_friction: f64,
    /// Sliding friction coefficient of everything else.
    pub body_friction: f64,
}

/// Water. Forces act per link in proportion to how much of it is below the surface.
///
/// Drag is that of the link's equivalent inertia box (edges b_i = √(6(I_j+I_k−I_i)/m), d their mean), times
/// the link's [`DragScale`].
#[derive(Clone, Debug, PartialEq)]
pub struct WaterParams {
    /// Density ρ, kg/m³.
    pub density_kg_per_m3: f64,
    /// Dynamic viscosity β, Pa·s.
    pub viscosity_pa_s: f64,
    /// k_b: buoyancy of a fully immersed link as a multiple of its weight.
    pub buoyancy_ratio: f64,
    /// k_d: damping of the vertical motion of a fully immersed link, N·s/m.
    pub heave_damping_ns_per_m: f64,
    /// One per link.
    pub drag: Vec<DragScale>,
    /// One per link.
    pub added: Vec<AddedShare>,
}

/// Water that a link has to speed up with itself, along (or about) its x, y and z axes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AddedShare {
    /// Added mass as a share of the mass of the displaced water (1: a cylinder moved across its axis; ½: a
    /// ball).
    pub mass: [f64; 3],
    /// Added inertia as a share of the displaced water's own.
    pub inertia: [f64; 3],
}

impl Default for DragScale {
    /// The box as it is.
    fn default() -> Self {
        let [linear_force, quadratic_force, linear_torque, quadratic_torque] = [[1.0; 3]; 4];
        Self { linear_force, quadratic_force, linear_torque, quadratic_torque }
    }
}

/// Factors on the box drag of a link, along (or about) the link's x, y and z axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DragScale {
    /// On the linear force 3π·d·β·v.
    pub linear_force: [f64; 3],
    /// On the quadratic force ½·ρ·b_j·b_k·|v|·v.
    pub quadratic_force: [f64; 3],
    /// On the linear torque π·d³·β·ω.
    pub linear_torque: [f64; 3],
    /// On the quadratic torque ρ·b_i·(b_j⁴+b_k⁴)/64·|ω|·ω.
    pub quadratic_torque: [f64; 3],
}
