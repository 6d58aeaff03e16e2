//! The drive-line of one actuated joint, written once over [`Real`]: from the command on the bus to the
//! torque at the joint.
//!
//! ```text
//!  command ── delay, loss ── low-pass ── profile ──▶ PD ── delay ── envelope ──▶ gear ──▶ joint
//!             command.rs     filter.rs   filter.rs   loop_delay.rs, servo.rs,    gear.rs  friction.rs, passive.rs
//!                                                    thermal.rs ▲ bus voltage, supply.rs
//! ```
//!
//! [`step::start`] gives one joint's torque for one physics step, [`step::finish`] takes what the joint then
//! did into its memory. Parameters and memory are structs with one number per lane ([`ServoDrive`],
//! [`JointPassive`], [`JointMemory`]), so lanes may differ in everything. A stage that no lane of an engine
//! needs is left out by [`DriveFeatures`], which is one branch that all lanes share.
//!
//! What is not smooth is handed to the engine as a spring and a damper to be taken implicitly
//! ([`ImplicitTorque`]), since stops, gear teeth and sticking friction are far stiffer than an explicit step
//! can follow. The position loop itself is explicit: rotor inertia keeps it stable (15 N·m/rad on 0.0022
//! kg·m²: ω·dt is 0.33 at 4 ms, the limit being 2).

pub mod command;
pub mod features;
pub mod filter;
pub mod friction;
pub mod gear;
pub(crate) mod lane;
pub mod loop_delay;
pub mod loss;
mod of_lane;
pub mod params;
pub mod passive;
pub mod servo;
pub mod step;
pub mod supply;
pub mod thermal;

pub use command::CommandHistory;
pub use features::DriveFeatures;
pub use loop_delay::WantedTorques;
pub use of_lane::loop_memory_steps;
pub use params::{JointPassive, ServoDrive};
pub use step::JointMemory;

use crate::real::Real;

/// A torque that follows its joint: `now − k·(q⁺ − q) − d·q̇⁺ − j·q̈`, where q⁺ and q̇⁺ are position and
/// velocity at the end of the step and q̈ is the acceleration over it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ImplicitTorque<R> {
    /// At the present position, without the damper's part, N·m.
    pub now_nm: R,
    /// k, N·m/rad.
    pub stiffness_nm_per_rad: R,
    /// d, N·m·s/rad.
    pub damping_nms_per_rad: R,
    /// j, kg·m².
    pub inertia_kgm2: R,
}

impl<R: Real> ImplicitTorque<R> {
    /// No torque.
    #[inline(always)]
    pub fn none() -> Self {
        Self::constant(R::zero())
    }

    /// The same torque whatever the joint does, N·m.
    #[inline(always)]
    pub fn constant(torque_nm: R) -> Self {
        Self {
            now_nm: torque_nm,
            stiffness_nm_per_rad: R::zero(),
            damping_nms_per_rad: R::zero(),
            inertia_kgm2: R::zero(),
        }
    }

    /// Both together.
    #[inline(always)]
    pub fn plus(self, other: Self) -> Self {
        Self {
            now_nm: self.now_nm + other.now_nm,
            stiffness_nm_per_rad: self.stiffness_nm_per_rad + other.stiffness_nm_per_rad,
            damping_nms_per_rad: self.damping_nms_per_rad + other.damping_nms_per_rad,
            inertia_kgm2: self.inertia_kgm2 + other.inertia_kgm2,
        }
    }

    /// `yes` where `mask` is true, `no` elsewhere.
    #[inline(always)]
    pub fn select(mask: R::Mask, yes: Self, no: Self) -> Self {
        Self {
            now_nm: R::select(mask, yes.now_nm, no.now_nm),
            stiffness_nm_per_rad: R::select(
                mask,
                yes.stiffness_nm_per_rad,
                no.stiffness_nm_per_rad,
            ),
            damping_nms_per_rad: R::select(mask, yes.damping_nms_per_rad, no.damping_nms_per_rad),
            inertia_kgm2: R::select(mask, yes.inertia_kgm2, no.inertia_kgm2),
        }
    }

    /// What it came to after the joint moved by `moved_rad` and reached `qd_radps`, without the inertia's
    /// part, N·m.
    #[inline(always)]
    pub fn after(&self, moved_rad: R, qd_radps: R) -> R {
        self.now_nm - self.stiffness_nm_per_rad * moved_rad - self.damping_nms_per_rad * qd_radps
    }
}

#[cfg(test)]
mod tests;
