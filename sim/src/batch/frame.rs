//! A frame of the robot in motion.

use super::vec3::{V3, add, add_cross, turn, uniform3, zero3};
use crate::simd::Lanes;

/// A node's frame in motion.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame<R> {
    /// World from node, columns.
    pub rot: [V3<R>; 3],
    /// Origin from the reference point, world, m.
    pub pos: V3<R>,
    /// Angular part of the joint's direction: the axis of a hinge, 0 of a slide.
    pub axis_ang: V3<R>,
    /// Linear part: origin × axis of a hinge, the axis of a slide.
    pub axis_lin: V3<R>,
    /// Angular velocity, rad/s.
    pub ang: V3<R>,
    /// Velocity of the material point at the reference point, m/s.
    pub lin: V3<R>,
    /// `ang` in the middle between this step's start and the last one's, see [`super::period`].
    pub ang_mid: V3<R>,
    /// `lin` likewise.
    pub lin_mid: V3<R>,
    /// Bias acceleration, angular, rad/s².
    pub bias_ang: V3<R>,
    /// Bias acceleration, linear (spatial), m/s².
    pub bias_lin: V3<R>,
}

impl<R: Lanes> Frame<R> {
    pub fn zero() -> Self {
        let o = zero3();
        Self {
            rot: [o; 3],
            pos: o,
            axis_ang: o,
            axis_lin: o,
            ang: o,
            lin: o,
            ang_mid: o,
            lin_mid: o,
            bias_ang: o,
            bias_lin: o,
        }
    }

    /// A constant place of the frame, from the reference point, world.
    #[inline(always)]
    pub fn point(&self, at: [R::Elem; 3]) -> V3<R> {
        add(self.pos, turn(&self.rot, uniform3(at)))
    }

    /// Velocity of the material point at `arm` (from the reference point), world.
    #[inline(always)]
    pub fn velocity(&self, arm: V3<R>) -> V3<R> {
        add_cross(self.lin, self.ang, arm)
    }
}
