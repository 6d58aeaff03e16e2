//! One joint, one physics step: [`start`] before it, [`finish`] after it.

use std::f64::consts::TAU;

use super::loop_delay::Loop;
use super::passive::{self, StopAt};
use super::{DriveFeatures, ImplicitTorque, JointPassive, ServoDrive};
use super::{filter, friction, gear, servo, supply, thermal};
use crate::per_lane::per_lane;
use crate::real::Real;

/// Stands for a target that there was not yet.
const NO_TARGET_RAD: f64 = 1e9;

/// Weight of the newest load estimate: the mean of two steps, since a contact's impulse in one step is no
/// load to rub under.
const LOAD_SHARE: f64 = 0.5;

/// A physics step's length, and its inverse.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step<R> {
    /// dt, s.
    pub dt_s: R,
    /// 1/dt.
    pub per_dt: R,
    /// Whether what damps acts at the time of the positions, see [`EngineConfig::centred`].
    ///
    /// [`EngineConfig::centred`]: crate::EngineConfig::centred
    pub centred: bool,
}

impl<R: Real> Step<R> {
    /// A step of `dt_s`.
    pub fn new(dt_s: f64, centred: bool) -> Self {
        Self { dt_s: R::splat(dt_s), per_dt: R::splat(1.0 / dt_s), centred }
    }

    /// By how much a velocity is greater at the time of the positions, half a step on, with the last step's
    /// acceleration. Less where the loop's damping is so strong for the joint's inertia (1/`mobility`, kg·m²) that
    /// it takes away half of the velocity in a step, and nothing where it takes all: from there on looking ahead
    /// would swing (Adams and Bashforth's rule of two steps), which the step by itself does at twice that.
    #[inline(always)]
    fn ahead_radps(&self, p: &ServoDrive<R>, mobility: f64, qdd_radps2: R) -> R {
        if !self.centred {
            return R::zero();
        }
        let damping = p.kd_nms_per_rad + p.kd_min_nms_per_rad;
        let taken = damping * self.dt_s * R::splat(mobility);
        let share = (R::splat(2.0) - R::splat(2.0) * taken).clamp(R::zero(), R::one());
        R::splat(0.5) * self.dt_s * share * qdd_radps2
    }

    /// `drag` with a damper, at the step's end or in its middle.
    #[inline(always)]
    fn damped(
        &self,
        mut drag: ImplicitTorque<R>,
        damping_nms_per_rad: R,
        qd_radps: R,
    ) -> ImplicitTorque<R> {
        let mut at_end = damping_nms_per_rad;
        if self.centred {
            at_end = R::splat(0.5) * damping_nms_per_rad;
            drag.now_nm -= at_end * qd_radps;
        }
        drag.damping_nms_per_rad += at_end;
        drag
    }
}

per_lane! {
    /// What one servo and its gear remember from step to step.
    pub struct JointMemory<R> {
        /// Friction bristle, rad.
        pub bristle_rad: R,
        /// Command after the low-pass, rad.
        pub filtered_rad: R,
        /// Command after the profile, rad.
        pub profile_rad: R,
        /// Speed of the profile, rad/s.
        pub profile_radps: R,
        /// What the loop aimed at in the last step, rad; [`NO_TARGET_RAD`] before the first.
        pub target_rad: R,
        /// How far that was from what it aimed at before, rad.
        pub target_moved_rad: R,
        /// Speed that the loop damps, after its low-pass, rad/s.
        pub loop_radps: R,
        /// Integral part of the loop, N·m.
        pub integral_nm: R,
        /// Estimate of the torque passed on to the load, N·m.
        pub load_nm: R,
        /// Rotor ahead of the joint, rad.
        pub lead_rad: R,
        /// Rotor speed, rad/s.
        pub rotor_radps: R,
        /// Winding temperature above the surroundings, K.
        pub rise_k: R,
    }
}

impl<R: Real> JointMemory<R> {
    /// How far the encoder of servo `p` is ahead of its joint, and how much faster it is where that moves at
    /// `qd_radps`, rad and rad/s: something where it is on a rotor that is a body of its own.
    #[inline(always)]
    pub fn encoder_ahead(&self, p: &ServoDrive<R>, qd_radps: R) -> (R, R) {
        (p.motor_encoder * self.lead_rad, p.motor_encoder * (self.rotor_radps - qd_radps))
    }
}

impl JointMemory<f64> {
    /// A joint that has been moving at `qd_radps` with the command `command_rad` for long: nothing on its
    /// way, gear centred, cold.
    pub fn rest(command_rad: f64, qd_radps: f64) -> Self {
        Self {
            filtered_rad: command_rad,
            profile_rad: command_rad,
            target_rad: NO_TARGET_RAD,
            loop_radps: qd_radps,
            rotor_radps: qd_radps,
            ..Self::default()
        }
    }
}

/// What a joint gets in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Driven<R> {
    /// Everything on the joint: motor, gear, friction, spring, stops.
    pub torque: ImplicitTorque<R>,
    /// What the motor gives, N·m.
    pub motor_nm: R,
    /// The motor's speed at the start of the step, rad/s.
    pub motor_radps: R,
    /// Magnitude of its current, A.
    pub current_a: R,
    /// Friction and damping, wherever they act.
    drag: ImplicitTorque<R>,
    /// Rotor and teeth; `None` where no lane has them.
    gear: Option<gear::GearStep<R>>,
}

impl<R: Real> Driven<R> {
    /// What servo `p` takes from a bus of `bus_v` meanwhile, A.
    #[inline(always)]
    pub fn drawn_a(&self, p: &ServoDrive<R>, m: &JointMemory<R>, bus_v: R) -> R {
        supply::drawn_a(p, bus_v, m.rise_k, self.motor_nm, self.motor_radps, self.current_a)
    }
}

/// The torque on an actuated joint at position `q_rad`, velocity `qd_radps` for the step that now begins;
/// `command_rad` is what arrives at the servo, `on_its_way` what its loop asked for before.
#[inline(always)]
pub fn start<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    hinge: &JointPassive<R>,
    m: &mut JointMemory<R>,
    on_its_way: Loop<'_, R>,
    step: &Step<R>,
    bus_v: R,
    command_rad: R,
    q_rad: R,
    qd_radps: R,
    qdd_radps2: R,
    stop: StopAt<'_, R>,
) -> Driven<R> {
    let soft = R::splat(0.5).lt(p.gear_is_soft);
    let motor_radps = if f.gear { R::select(soft, m.rotor_radps, qd_radps) } else { qd_radps };
    let target_rad = follow(f, p, m, step, command_rad);
    let ahead_radps = step.ahead_radps(p, stop.law.mobility(), qdd_radps2);
    // a rotor behind play or springs has an acceleration of its own
    let motor_ahead_radps = R::select(soft, R::zero(), ahead_radps);
    let (mut seen_rad, mut seen_radps, mut seen_ahead_radps) = (q_rad, qd_radps, ahead_radps);
    if f.motor_encoder {
        let (lead_rad, lead_radps) = m.encoder_ahead(p, qd_radps);
        seen_rad += lead_rad;
        seen_radps += lead_radps;
        let behind_motor = R::zero().lt(p.motor_encoder);
        seen_ahead_radps = R::select(behind_motor, motor_ahead_radps, ahead_radps);
    }
    let motor_nm = motor(
        f,
        p,
        m,
        on_its_way,
        step,
        bus_v,
        target_rad,
        seen_rad,
        seen_radps + seen_ahead_radps,
        motor_radps + motor_ahead_radps,
    );

    let bound_nm = friction_bound(f, p, hinge, m, motor_radps);
    let drag = friction::bristle_torque(
        bound_nm,
        hinge.presliding_rad,
        motor_radps,
        m.bristle_rad,
        step.dt_s,
    );
    let mut drag = step.damped(drag, hinge.damping_nms_per_rad, motor_radps);
    if f.ripple {
        drag.now_nm += ripple_nm(p, q_rad);
    }

    let rigid = drag.plus(ImplicitTorque::constant(motor_nm));
    let (on_joint, gear) = if f.gear {
        let g = gear::step(p, m.lead_rad, motor_radps, qd_radps, motor_nm, &drag, step.dt_s);
        (ImplicitTorque::select(soft, g.torque, rigid), Some(g))
    } else {
        (rigid, None)
    };
    Driven {
        torque: on_joint.plus(passive::spring_and_stops(hinge, stop, q_rad, qd_radps)),
        motor_nm,
        motor_radps,
        current_a: servo::current_a(
            p,
            if f.saturation { servo::unsaturated_nm(p, motor_nm) } else { motor_nm },
        ),
        drag,
        gear,
    }
}

/// The torque of the gear's ripple at `q_rad`, N·m.
#[inline(always)]
fn ripple_nm<R: Real>(p: &ServoDrive<R>, q_rad: R) -> R {
    let turns = (p.ripple_per_turn * q_rad + p.ripple_phase_rad) * R::splat(1.0 / TAU);
    let within = turns - (turns + R::splat(0.5)).floor();
    let (sin, _) = (within * R::splat(TAU)).sin_cos();
    p.ripple_nm * sin
}

/// Takes into memory that the joint moved by `moved_rad` and went from velocity `qd_before_radps` to
/// `qd_after_radps`. Returns the motor's speed at the end of the step, rad/s.
#[inline(always)]
pub fn finish<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    hinge: &JointPassive<R>,
    m: &mut JointMemory<R>,
    step: &Step<R>,
    driven: &Driven<R>,
    moved_rad: R,
    qd_before_radps: R,
    qd_after_radps: R,
) -> R {
    let soft = R::splat(0.5).lt(p.gear_is_soft);
    let (mut motor_radps, mut motor_moved_rad) = (qd_after_radps, moved_rad);
    if let Some(g) = &driven.gear {
        let rotor = g.rotor_radps(qd_after_radps);
        motor_radps = R::select(soft, rotor, qd_after_radps);
        motor_moved_rad = R::select(soft, step.dt_s * rotor, moved_rad);
        m.rotor_radps = motor_radps;
        m.lead_rad = R::select(soft, m.lead_rad + motor_moved_rad - moved_rad, R::zero());
    }
    m.bristle_rad = friction::drag_bristle(m.bristle_rad, motor_moved_rad, hinge.presliding_rad);
    if f.load_friction {
        // What the motor gives, less friction and what speeds up the rotor, goes on to the load.
        let before = R::select(soft, driven.motor_radps, qd_before_radps);
        let passed = driven.motor_nm + driven.drag.after(motor_moved_rad, motor_radps)
            - p.rotor_kgm2 * (motor_radps - before) * step.per_dt;
        m.load_nm += R::splat(LOAD_SHARE) * (passed - m.load_nm);
    }
    if f.thermal {
        m.rise_k = thermal::warm_k(p, m.rise_k, driven.current_a);
    }
    motor_radps
}

/// The passive torque of a hinge without a servo, and its bristle's next deflection by
/// [`friction::drag_bristle`].
#[inline(always)]
pub fn hinge_torque<R: Real>(
    hinge: &JointPassive<R>,
    step: &Step<R>,
    bristle_rad: R,
    q_rad: R,
    qd_radps: R,
    stop: StopAt<'_, R>,
) -> ImplicitTorque<R> {
    let drag = friction::bristle_torque(
        hinge.friction_nm,
        hinge.presliding_rad,
        qd_radps,
        bristle_rad,
        step.dt_s,
    );
    step.damped(drag, hinge.damping_nms_per_rad, qd_radps)
        .plus(passive::spring_and_stops(hinge, stop, q_rad, qd_radps))
}

/// The command after low-pass and profile, rad.
#[inline(always)]
fn follow<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    m: &mut JointMemory<R>,
    step: &Step<R>,
    command_rad: R,
) -> R {
    let mut target_rad = command_rad;
    if f.low_pass {
        m.filtered_rad = filter::low_pass(m.filtered_rad, target_rad, p.low_pass_share);
        target_rad = m.filtered_rad;
    }
    if f.profile {
        (m.profile_rad, m.profile_radps) =
            filter::profile(p, m.profile_rad, m.profile_radps, target_rad, step.dt_s, step.per_dt);
        target_rad = m.profile_rad;
    }
    target_rad
}

/// How far the target moved in the last step and in this one, rad, as a loop sees it; nothing before the first. A loop
/// that takes its rate over more than a step sees a mean, and no steps.
#[inline(always)]
fn target_moved_rad<R: Real>(p: &ServoDrive<R>, m: &mut JointMemory<R>, target_rad: R) -> (R, R) {
    let known = m.target_rad.lt(R::splat(0.5 * NO_TARGET_RAD));
    let now_rad = R::select(known, target_rad - m.target_rad, R::zero());
    let before_rad = m.target_moved_rad;
    m.target_rad = target_rad;
    m.target_moved_rad = filter::low_pass(before_rad, now_rad, p.rate_low_pass_share);
    let is_mean = p.rate_low_pass_share.lt(R::one());
    (R::select(is_mean, R::zero(), before_rad), m.target_moved_rad)
}

/// Motor torque for a target and the angle that the loop sees, N·m.
#[inline(always)]
fn motor<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    m: &mut JointMemory<R>,
    on_its_way: Loop<'_, R>,
    step: &Step<R>,
    bus_v: R,
    target_rad: R,
    seen_rad: R,
    qd_radps: R,
    motor_radps: R,
) -> R {
    let mut error_rad = target_rad - seen_rad;
    if f.dead_band {
        error_rad = servo::dead_band(p, error_rad);
    }
    let mut kp = p.kp_nm_per_rad;
    if f.back_drive {
        kp = kp * servo::back_drive_factor(p.back_drive_kp_ratio, error_rad, qd_radps);
    }
    let mut damped_radps = qd_radps;
    if f.speed_low_pass {
        damped_radps = filter::low_pass(m.loop_radps, qd_radps, p.speed_low_pass_share);
    }
    // always, so that a lane that gets the lag begins with its own speed, whatever its neighbours have
    m.loop_radps = damped_radps;
    let mut wanted_nm = kp * error_rad - p.kd_nms_per_rad * damped_radps;
    if f.feed_forward {
        wanted_nm += p.feed_forward_nm;
    }
    if f.integral {
        wanted_nm += m.integral_nm;
    }
    if f.loop_delay {
        wanted_nm = on_its_way.pass(wanted_nm, p.loop_delay_steps);
    }
    wanted_nm -= p.kd_min_nms_per_rad * motor_radps;
    let mut per_rho = R::one();
    if f.winding {
        per_rho = thermal::per_rho(p, m.rise_k);
        wanted_nm = wanted_nm * per_rho;
    }
    let mut given_nm = limited_nm(f, p, bus_v, per_rho, wanted_nm, motor_radps);
    if f.command_damping {
        // A step of the target kicks for the time over which the loop takes its rate, cut by the limits. Of a step that
        // two physics steps share the second gives what both have beyond the first.
        let (before_rad, now_rad) = target_moved_rad(p, m, target_rad);
        let per_rad = p.command_damping_nms_per_rad * per_rho * step.per_dt / p.rate_share;
        let before_nm = wanted_nm + per_rad * before_rad;
        let both_nm = wanted_nm + per_rad * (before_rad + now_rad);
        let kick_nm = limited_nm(f, p, bus_v, per_rho, both_nm, motor_radps)
            - limited_nm(f, p, bus_v, per_rho, before_nm, motor_radps);
        given_nm += p.rate_share * kick_nm;
    }
    if f.integral {
        // Stands still while the motor cannot give more: no wind-up.
        let short = wanted_nm - given_nm;
        let winds_up = R::zero().lt(short * error_rad);
        let more = p.ki_nm_per_rad_s * error_rad * step.dt_s;
        m.integral_nm += R::select(winds_up, R::zero(), more);
    }
    if f.saturation {
        given_nm = servo::saturated_nm(p, given_nm);
    }
    given_nm
}

/// What a motor gives of a wanted torque, N·m. No closure of [`motor`]: one that is called in several places is a
/// function of its own, without the vector instructions that its caller was compiled for.
#[inline(always)]
fn limited_nm<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    bus_v: R,
    per_rho: R,
    wanted_nm: R,
    motor_radps: R,
) -> R {
    let given_nm = servo::clamp_nm(p, bus_v, per_rho, wanted_nm, motor_radps);
    if f.current_limit { servo::limit_current_nm(p, given_nm, motor_radps) } else { given_nm }
}

/// Bound of the dry friction, N·m.
#[inline(always)]
fn friction_bound<R: Real>(
    f: DriveFeatures,
    p: &ServoDrive<R>,
    hinge: &JointPassive<R>,
    m: &JointMemory<R>,
    speed_radps: R,
) -> R {
    let mut bound_nm = hinge.friction_nm;
    if f.stribeck {
        bound_nm += friction::stribeck_nm(p, speed_radps);
    }
    if f.load_friction {
        bound_nm += friction::load_friction_nm(p, m.load_nm, speed_radps);
    }
    if f.load_stribeck {
        bound_nm += friction::load_stribeck_nm(p, m.load_nm, speed_radps);
    }
    if f.asymmetry {
        bound_nm += friction::asymmetry_nm(p, m.bristle_rad, hinge.presliding_rad);
        bound_nm = bound_nm.max(R::zero());
    }
    bound_nm
}
