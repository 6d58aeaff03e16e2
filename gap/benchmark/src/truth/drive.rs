//! One true servo: a sampled firmware loop, a DC motor, LuGre friction, a gear with teeth that bounce.
//!
//! Written for the benchmark alone. Friction: Canudas de Wit, Olsson, Åström, Lischinsky, "A new model for
//! control of systems with friction" (IEEE Trans. Automatic Control 40, 1995). Impacts: Hunt and Crossley (J.
//! Applied Mechanics 42, 1975).

use super::spec::{IMPACT_LOSS_S_PER_RAD, JointSpec};

/// Stiffness of gear teeth, N·m/rad.
const TEETH_NM_PER_RAD: f64 = 1500.0;
/// Stiffness of end stops, N·m/rad.
const STOP_NM_PER_RAD: f64 = 800.0;
/// Damping of the bristle near rest, as a time on its stiffness, s, and the speed at which it has faded,
/// rad/s.
const BRISTLE_DAMPING_S: f64 = 0.001;
const BRISTLE_FADE_RADPS: f64 = 0.1;
/// A joint with no more dry friction than this has none, N·m.
const FRICTIONLESS_NM: f64 = 1e-5;
/// Growth of a copper winding's resistance, 1/K.
const COPPER_PER_K: f64 = 0.0039;
/// Length of a stutter, s.
const STUTTER_S: f64 = 0.08;

/// Continuous state of a servo beyond its joint's position and speed.
pub const AUX: usize = 9;
/// Bristle, rad.
pub const BRISTLE: usize = 0;
/// Rotor position, rad.
pub const ROTOR: usize = 1;
/// Rotor speed, rad/s.
pub const ROTOR_SPEED: usize = 2;
/// Appendage position, rad.
pub const SWING: usize = 3;
/// Appendage speed, rad/s.
pub const SWING_SPEED: usize = 4;
/// Winding temperature above the surroundings, K.
pub const HEAT: usize = 5;
/// Current, A (only with inductance).
pub const CURRENT: usize = 6;
/// Stillness, 0 to 1.
pub const STILL: usize = 7;
/// Cable, −1 to 1.
pub const CABLE: usize = 8;

/// What the firmware remembers.
#[derive(Clone, Debug, Default)]
pub struct Firmware {
    filtered_rad: f64,
    profile_rad: f64,
    profile_radps: f64,
    integral_nm: f64,
    last_read_rad: f64,
    damped_radps: f64,
    /// Torques on their way (loop delay), oldest first.
    waiting_nm: Vec<f64>,
    saturated: bool,
}

impl Firmware {
    /// At rest at `q_rad` with `command_rad`.
    pub fn at_rest(command_rad: f64, read_rad: f64) -> Self {
        Self {
            filtered_rad: command_rad,
            profile_rad: command_rad,
            last_read_rad: read_rad,
            ..Self::default()
        }
    }

    /// One tick of `tick_s`: command as it has arrived, encoder as counted and before counting. Returns the
    /// volts at the bridge.
    pub fn tick(
        &mut self,
        p: &JointSpec,
        tick_s: f64,
        command_rad: f64,
        counted_rad: f64,
        read_rad: f64,
        bus_v: f64,
        compensation: f64,
    ) -> f64 {
        let mut target = command_rad;
        if p.low_pass_s > 0.0 {
            self.filtered_rad +=
                (1.0 - (-tick_s / p.low_pass_s).exp()) * (target - self.filtered_rad);
            target = self.filtered_rad;
        }
        if p.profile_speed_radps > 0.0 || p.profile_acceleration_radps2 > 0.0 {
            target = self.profile(p, tick_s, target);
        }
        let mut error = target - counted_rad;
        if error.abs() < p.dead_band_rad {
            error = 0.0;
        }
        let speed = (read_rad - self.last_read_rad) / tick_s;
        self.last_read_rad = read_rad;
        self.damped_radps = match p.damping_lag_s > 0.0 {
            true => speed + (-tick_s / p.damping_lag_s).exp() * (self.damped_radps - speed),
            // to the bit: teeth that bounce make another recording of a rounding
            false => speed,
        };
        let winds_up = self.saturated && error * self.integral_nm > 0.0;
        if p.ki_nm_per_rad_s > 0.0 && !winds_up {
            self.integral_nm += p.ki_nm_per_rad_s * error * tick_s;
        }
        let kp = p.kp_nm_per_rad * (1.0 + p.kp_growth_per_rad * error.abs());
        let mut wanted = kp * error - p.kd_nms_per_rad * self.damped_radps + self.integral_nm;
        let late = (p.loop_delay_s / tick_s).round() as usize;
        if late > 0 {
            self.waiting_nm.push(wanted);
            wanted = if self.waiting_nm.len() > late { self.waiting_nm.remove(0) } else { 0.0 };
        }
        let volts = p.volt_per_nm * wanted + p.feed_forward_vs_per_rad * speed;
        // Duty from the voltage that the firmware believes in, then the bridge's steps.
        let duty = (volts * compensation / bus_v).clamp(-p.duty_limit, p.duty_limit);
        self.saturated = duty.abs() >= p.duty_limit;
        (duty * p.duty_steps).round() / p.duty_steps * bus_v
    }

    fn profile(&mut self, p: &JointSpec, tick_s: f64, target: f64) -> f64 {
        let way = target - self.profile_rad;
        let mut speed = way.abs() / tick_s;
        if p.profile_speed_radps > 0.0 {
            speed = speed.min(p.profile_speed_radps);
        }
        if p.profile_acceleration_radps2 > 0.0 {
            let a = p.profile_acceleration_radps2;
            let half = 0.5 * a * tick_s;
            speed = speed.min((half * half + 2.0 * a * way.abs()).sqrt() - half);
            let wanted = speed * way.signum();
            self.profile_radps =
                wanted.clamp(self.profile_radps - a * tick_s, self.profile_radps + a * tick_s);
        } else {
            self.profile_radps = speed * way.signum();
        }
        self.profile_rad += self.profile_radps * tick_s;
        self.profile_rad
    }
}

/// Torque on a joint, and what the servo's own state does.
#[derive(Clone, Copy, Debug, Default)]
pub struct Flow {
    /// On the link, N·m.
    pub on_link_nm: f64,
    /// Motor current, A.
    pub current_a: f64,
    /// Derivative of the continuous state.
    pub rate: [f64; AUX],
}

/// Motor current at `volts` and motor speed `w`, A.
pub fn current_a(p: &JointSpec, volts: f64, w_radps: f64, heat_k: f64) -> f64 {
    let resistance = p.resistance_ohm * (1.0 + COPPER_PER_K * heat_k);
    let mut free = (volts - p.ke_vs_per_rad * w_radps) / resistance;
    if p.bridge_drop_v > 0.0 {
        let drop = p.bridge_drop_v / resistance;
        free -= free.clamp(-drop, drop);
    }
    let most = if free * w_radps < 0.0 { p.brake_current_a } else { p.drive_current_a };
    free.clamp(-most, most)
}

/// Bound of the dry friction at speed `v`, N·m.
pub fn friction_bound_nm(
    p: &JointSpec,
    v_radps: f64,
    load_nm: f64,
    q_rad: f64,
    still: f64,
    t_s: f64,
) -> f64 {
    let x = v_radps / p.stribeck_speed_radps;
    let mut bound = p.coulomb_nm + p.stribeck_nm * (-x * x).exp();
    if p.load_driving > 0.0 || p.load_driven > 0.0 {
        let mean = 0.5 * (p.load_driving + p.load_driven);
        let half = 0.5 * (p.load_driving - p.load_driven);
        let way = (v_radps * load_nm.signum() / 0.02).clamp(-1.0, 1.0);
        bound += load_nm.abs() * (mean + half * way);
    }
    bound += p.asymmetry_nm * (v_radps / 0.01).clamp(-1.0, 1.0);
    let (rub, from, to) = p.rub;
    if rub > 0.0 && q_rad > from && q_rad < to {
        bound += rub;
    }
    bound += p.dwell.0 * still;
    if p.stutter.0 > 0.0 && t_s.rem_euclid(p.stutter.1) < STUTTER_S {
        bound += p.stutter.0;
    }
    if p.run_in.0 > 0.0 {
        bound += p.run_in.0 * (-t_s.max(0.0) / p.run_in.1).exp();
    }
    let (share, period, phase) = p.drift;
    if share > 0.0 {
        bound *= 1.0 + share * (std::f64::consts::TAU * t_s / period + phase).sin();
    }
    bound.max(FRICTIONLESS_NM)
}

/// LuGre friction: torque against the motion (N·m) and the bristle's rate (rad/s) at speed `v` and deflection
/// `z`.
pub fn lugre(p: &JointSpec, bound_nm: f64, v_radps: f64, z_rad: f64, step_s: f64) -> (f64, f64) {
    let stiffness = p.coulomb_nm.max(1e-5) / p.presliding_rad;
    if bound_nm <= FRICTIONLESS_NM {
        return (p.viscous_nms_per_rad * v_radps, 0.0);
    }
    // Never faster than the integration can follow.
    let pull = (stiffness * v_radps.abs() / bound_nm).min(2.0 / step_s);
    let rate = v_radps - pull * z_rad;
    let fade = v_radps / BRISTLE_FADE_RADPS;
    let damping = stiffness * BRISTLE_DAMPING_S * (-fade * fade).exp();
    (stiffness * z_rad + damping * rate + p.viscous_nms_per_rad * v_radps, rate)
}

/// Force of something that is touched: `k·p·(1 + λ·ṗ)`, never pulling.
fn touch((k, loss_s_per_rad): (f64, f64), depth: f64, rate: f64) -> f64 {
    if depth <= 0.0 {
        return 0.0;
    }
    (k * depth * (1.0 + loss_s_per_rad * rate)).max(0.0)
}

/// Torque between rotor and link, positive on the link, N·m.
pub fn gear_nm(p: &JointSpec, lead_rad: f64, lead_radps: f64) -> f64 {
    let k = if p.gear_nm_per_rad > 0.0 { p.gear_nm_per_rad } else { TEETH_NM_PER_RAD };
    let h = p.half_gap_rad;
    if h == 0.0 {
        // Compliance without a gap: a spring with a little loss.
        return k * lead_rad + 0.2 * (k * p.rotor_kgm2).sqrt() * lead_radps;
    }
    let teeth = (k, p.impact_loss_s_per_rad);
    touch(teeth, lead_rad - h, lead_radps) - touch(teeth, -lead_rad - h, -lead_radps)
}

/// Everything on joint and servo at one instant. `load_nm`: estimate of the torque that the gear passes on.
pub fn flow(
    p: &JointSpec,
    q: f64,
    v: f64,
    x: &[f64],
    volts: f64,
    load_nm: f64,
    t_s: f64,
    step_s: f64,
) -> Flow {
    let mut out = Flow::default();
    let geared = p.geared();
    let w = if geared { x[ROTOR_SPEED] } else { v };
    let settled = current_a(p, volts, w, x[HEAT]);
    let current = if p.inductance_s > 0.0 {
        out.rate[CURRENT] = (settled - x[CURRENT]) / p.inductance_s;
        x[CURRENT]
    } else {
        settled
    };
    out.current_a = current;
    if p.thermal_rise_k_per_a2 > 0.0 {
        out.rate[HEAT] = (p.thermal_rise_k_per_a2 * current * current - x[HEAT]) / p.thermal_time_s;
    }
    let load_nm = load_nm + p.load_of_motor * (p.kt_nm_per_a * current - load_nm);
    let bound = friction_bound_nm(p, w, load_nm, q, x[STILL], t_s);
    let (friction, bristle_rate) = lugre(p, bound, w, x[BRISTLE], step_s);
    out.rate[BRISTLE] = bristle_rate;
    if p.dwell.0 > 0.0 {
        let still = (-(w / 0.05) * (w / 0.05)).exp();
        let time = if still > x[STILL] { p.dwell.1 } else { 0.02 };
        out.rate[STILL] = (still - x[STILL]) / time;
    }
    let rotor = if geared { x[ROTOR] } else { q };
    let ripple = if p.ripple_nm == 0.0 {
        0.0
    } else {
        // a second harmonic, as teeth and magnets have
        let a = p.ripple_per_turn * rotor + p.ripple_phase_rad;
        p.ripple_nm * (a.sin() + 0.2 * (2.0 * a).sin())
    };
    let motor_side = p.kt_nm_per_a * current - friction + ripple;
    if geared {
        let teeth = gear_nm(p, x[ROTOR] - q, x[ROTOR_SPEED] - v);
        out.rate[ROTOR] = x[ROTOR_SPEED];
        out.rate[ROTOR_SPEED] = (motor_side - teeth) / p.rotor_kgm2;
        out.on_link_nm = teeth;
    } else {
        out.on_link_nm = motor_side;
    }
    out.on_link_nm += link_side(p, q, v, x, t_s, &mut out.rate);
    out
}

/// What acts on the link beside the gear, N·m.
fn link_side(p: &JointSpec, q: f64, v: f64, x: &[f64], t_s: f64, rate: &mut [f64; AUX]) -> f64 {
    let off = p.spring_rest_rad - q;
    let mut torque = p.spring_nm_per_rad * off + p.spring_cubic_nm_per_rad3 * off * off * off;
    let (low, high) = p.stops_rad;
    let stop = (STOP_NM_PER_RAD, IMPACT_LOSS_S_PER_RAD);
    torque += touch(stop, low - q, -v) - touch(stop, q - high, v);
    torque -= p.air_nms2_per_rad2 * v * v.abs();
    if p.shaker.0 != 0.0 {
        torque += p.shaker.0 * (std::f64::consts::TAU * p.shaker.1 * t_s).sin();
    }
    let (inertia, hz, ratio) = p.appendage;
    if inertia > 0.0 {
        let w0 = std::f64::consts::TAU * hz;
        let pull = inertia * (w0 * w0 * (x[SWING] - q) + 2.0 * ratio * w0 * (x[SWING_SPEED] - v));
        rate[SWING] = x[SWING_SPEED];
        rate[SWING_SPEED] = -pull / inertia;
        torque += pull;
    }
    let (cable, way) = p.cable;
    if cable > 0.0 {
        rate[CABLE] = (v - v.abs() * x[CABLE]) / way;
        torque -= cable * x[CABLE];
    }
    torque
}
