//! What one true robot is like: every number that the truth simulator computes with, double precision, SI.
//!
//! [`Spec::nominal`] is the robot of the model file; hidden effects and nuisances change single numbers.

use caudata_model::RobotModel;

use super::tree::MassChange;

/// Loss of an impact, s/rad: 1.5·(1 − e)/v for a restitution of 0.5 at 0.3 rad/s.
pub const IMPACT_LOSS_S_PER_RAD: f64 = 2.5;

/// One servo with its joint. By default nothing of it is there.
#[derive(Clone, Debug, Default)]
pub struct JointSpec {
    // firmware
    /// Position gain, N·m/rad (as torque of the nominal motor).
    pub kp_nm_per_rad: f64,
    /// Growth of the gain with the error, 1/rad: kp·(1 + x·|e|).
    pub kp_growth_per_rad: f64,
    /// Derivative gain, N·m·s/rad.
    pub kd_nms_per_rad: f64,
    /// Low-pass on the speed that this gain acts on, s.
    pub damping_lag_s: f64,
    /// Integral gain, N·m/(rad·s).
    pub ki_nm_per_rad_s: f64,
    /// Errors within ± this count as none; beyond it the whole error counts, rad.
    pub dead_band_rad: f64,
    /// Computing time between reading and acting, s.
    pub loop_delay_s: f64,
    /// Command low-pass, s.
    pub low_pass_s: f64,
    /// Profile speed, rad/s; 0: none.
    pub profile_speed_radps: f64,
    /// Profile acceleration, rad/s²; 0: none.
    pub profile_acceleration_radps2: f64,
    /// Feed-forward that makes the motor's damping the file's, V·s/rad.
    pub feed_forward_vs_per_rad: f64,
    /// Volts that the firmware puts out per N·m it wants: R/kt of the nominal motor.
    pub volt_per_nm: f64,
    // motor
    /// Torque constant, N·m/A.
    pub kt_nm_per_a: f64,
    /// Back-EMF constant, V·s/rad.
    pub ke_vs_per_rad: f64,
    /// Winding resistance, cold, Ω.
    pub resistance_ohm: f64,
    /// Electrical time constant, s; 0: none.
    pub inductance_s: f64,
    /// Largest current with the motion or at rest, A.
    pub drive_current_a: f64,
    /// Largest current against the motion, A.
    pub brake_current_a: f64,
    /// Largest duty, 0 to 1.
    pub duty_limit: f64,
    /// Duty steps of the bridge, one way (PWM resolution).
    pub duty_steps: f64,
    /// Volts lost in the bridge against the current (dead time).
    pub bridge_drop_v: f64,
    /// Steady rise of the winding's temperature, K/A².
    pub thermal_rise_k_per_a2: f64,
    /// Its time constant, s.
    pub thermal_time_s: f64,
    /// Rotor inertia at the joint, kg·m².
    pub rotor_kgm2: f64,
    // friction and gear
    /// Coulomb, N·m.
    pub coulomb_nm: f64,
    /// Viscous, N·m·s/rad.
    pub viscous_nms_per_rad: f64,
    /// Stribeck: more at rest, N·m.
    pub stribeck_nm: f64,
    /// Its speed, rad/s.
    pub stribeck_speed_radps: f64,
    /// Bristle deflection at the Coulomb bound, rad.
    pub presliding_rad: f64,
    /// What the load is that friction grows with: the torque that the gear passes on (0), the motor's (1).
    pub load_of_motor: f64,
    /// Friction per load torque, motor drives.
    pub load_driving: f64,
    /// Friction per load torque, load drives.
    pub load_driven: f64,
    /// More in the positive direction, less in the negative, N·m.
    pub asymmetry_nm: f64,
    /// Ripple: amplitude, N·m.
    pub ripple_nm: f64,
    /// Ripple: periods per turn.
    pub ripple_per_turn: f64,
    /// Ripple: phase, rad.
    pub ripple_phase_rad: f64,
    /// Half of the gap between rotor and link, rad.
    pub half_gap_rad: f64,
    /// Stiffness between rotor and link, N·m/rad; 0: rigid unless there is a gap.
    pub gear_nm_per_rad: f64,
    /// Loss of teeth that meet, s/rad.
    pub impact_loss_s_per_rad: f64,
    /// Spring at the joint, N·m/rad.
    pub spring_nm_per_rad: f64,
    /// Where it is relaxed, rad.
    pub spring_rest_rad: f64,
    /// Hardening of that spring, N·m/rad³.
    pub spring_cubic_nm_per_rad3: f64,
    /// Stops, rad.
    pub stops_rad: (f64, f64),
    // beyond the catalogue
    /// Drag in proportion to speed squared, N·m·s²/rad².
    pub air_nms2_per_rad2: f64,
    /// Torque A·sin(2π·f·t): (A in N·m, f in Hz).
    pub shaker: (f64, f64),
    /// Extra friction where the joint is within (from, to), N·m.
    pub rub: (f64, f64, f64),
    /// Friction that grows while standing still, N·m, with its time constant, s.
    pub dwell: (f64, f64),
    /// Swinging appendage: inertia kg·m², natural frequency Hz, damping ratio.
    pub appendage: (f64, f64, f64),
    /// Hysteretic cable: torque N·m, way rad.
    pub cable: (f64, f64),
    /// Sticks for 80 ms with this much friction, N·m, every so many seconds.
    pub stutter: (f64, f64),
    /// Friction that decays over the run (running in): N·m at the start, time constant s.
    pub run_in: (f64, f64),
    /// Slow change of all dry friction: share, period s, phase rad.
    pub drift: (f64, f64, f64),
    // encoder, inside the loop
    /// Offset, rad.
    pub encoder_offset_rad: f64,
    /// Relative error of the angle.
    pub encoder_gain: f64,
    /// Once-per-turn error: amplitude rad, phase rad.
    pub eccentricity: (f64, f64),
    /// Error A·sin(8·q), rad: interpolation of the magnet's field.
    pub encoder_wave_rad: f64,
}

/// One true robot.
#[derive(Clone, Debug)]
pub struct Spec {
    /// Policy order.
    pub joints: Vec<JointSpec>,
    /// Per link.
    pub links: Vec<MassChange>,
    /// Gravity, m/s².
    pub gravity_mps2: [f64; 3],
    /// Open-circuit supply, V.
    pub supply_v: f64,
    /// Its resistance, Ω.
    pub supply_ohm: f64,
    /// Voltage at which the firmware's gains hold; it compensates for the voltage that it measures unless
    /// `gain_follows_supply`.
    pub reference_v: f64,
    /// Whether the firmware leaves the gains to the supply.
    pub gain_follows_supply: bool,
    /// From sending to arriving, s.
    pub command_delay_s: f64,
    /// More per place on the bus, s.
    pub skew_s: f64,
    /// Share of command frames lost, and mean burst.
    pub command_loss: (f64, f64),
    /// Half width of play hinges, rad, by model joint; `None`: the model's.
    pub play_rad: Vec<Option<f64>>,
}

impl JointSpec {
    /// The joint as the model has it: a DC motor whose torque-speed line is the envelope's taper.
    fn nominal(model: &RobotModel, a: usize) -> Self {
        let servo = model.servo(a);
        let joint = &model.joints()[model.actuated()[a]];
        let span = (servo.qd_max_radps - servo.qd_tau_max_radps).max(1e-6);
        let slope = (servo.tau_max_nm - servo.tau_qd_max_nm) / span;
        let stall = servo.tau_max_nm + slope * servo.qd_tau_max_radps;
        let kt = servo.torque_per_current_nm_per_a;
        let resistance = servo.reference_supply_v * kt / stall;
        let ke = slope * resistance / kt;
        Self {
            kp_nm_per_rad: model.kp_nm_per_rad(a),
            kd_nms_per_rad: model.kd_nm_s_per_rad(a),
            feed_forward_vs_per_rad: ke - servo.kd_min_nm_s_per_rad * resistance / kt,
            volt_per_nm: resistance / kt,
            kt_nm_per_a: kt,
            ke_vs_per_rad: ke,
            resistance_ohm: resistance,
            drive_current_a: servo.tau_max_nm / kt,
            brake_current_a: servo.tau_brake_max_nm / kt,
            duty_limit: 1.0,
            duty_steps: 885.0, // counts of the servo's PWM register at full duty
            thermal_time_s: 100.0,
            rotor_kgm2: joint.armature_kgm2,
            coulomb_nm: joint.friction_loss_nm,
            viscous_nms_per_rad: joint.damping_nm_s_per_rad,
            stribeck_nm: servo.stribeck_nm,
            stribeck_speed_radps: servo.stribeck_speed_radps,
            presliding_rad: 0.002,
            load_driving: servo.load_friction_driving,
            load_driven: servo.load_friction_driven,
            ripple_per_turn: 1.0,
            impact_loss_s_per_rad: IMPACT_LOSS_S_PER_RAD,
            spring_nm_per_rad: joint.stiffness_nm_per_rad,
            spring_rest_rad: joint.spring_ref_rad,
            stops_rad: joint.range_rad.unwrap_or((-1e6, 1e6)),
            shaker: (0.0, 1.0),
            dwell: (0.0, 1.0),
            appendage: (0.0, 1.0, 0.1),
            cable: (0.0, 0.1),
            stutter: (0.0, 1.0),
            run_in: (0.0, 1.0),
            drift: (0.0, 1.0, 0.0),
            ..Self::default()
        }
    }

    /// Whether rotor and link are two bodies.
    pub fn geared(&self) -> bool {
        self.half_gap_rad > 0.0 || self.gear_nm_per_rad > 0.0
    }

    /// What the encoder makes of a position before counting, rad.
    pub fn encode_rad(&self, q_rad: f64) -> f64 {
        let (size, phase) = self.eccentricity;
        (1.0 + self.encoder_gain) * q_rad
            + size * (q_rad + phase).sin()
            + self.encoder_wave_rad * (8.0 * q_rad).sin()
            + self.encoder_offset_rad
    }
}

impl Spec {
    /// The robot of the model file.
    pub fn nominal(model: &RobotModel) -> Self {
        Self {
            joints: (0..model.actuated().len()).map(|a| JointSpec::nominal(model, a)).collect(),
            links: vec![MassChange::default(); model.links().len()],
            gravity_mps2: model.gravity_mps2(),
            supply_v: model.supply_v(),
            supply_ohm: model.supply().resistance_ohm,
            reference_v: model.supply_v(),
            gain_follows_supply: false,
            command_delay_s: 0.0,
            skew_s: 0.0,
            command_loss: (0.0, 1.0),
            play_rad: vec![None; model.joints().len()],
        }
    }

    /// The joint's link (policy order): what it carries first.
    pub fn link_of(model: &RobotModel, a: usize) -> usize {
        model.joints()[model.actuated()[a]].child_link
    }
}
