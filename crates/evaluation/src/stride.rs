//! How limbs and trunk go together in a stride, of robots with two girdles and a pair of legs at each.

use std::f64::consts::{PI, TAU};

use caudata_model::Kinematics;
use caudata_task::PerJoint;
use rustfft::num_complex::Complex;
use serde::{Deserialize, Serialize};

use crate::anatomy::Anatomy;
use crate::spectrum::Spectrum;
use crate::trace::Frame;

/// One episode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stride {
    /// By how much of a stride a fore foot comes down after the hind foot of its side, both sides together,
    /// 0 to 1. A lateral-sequence walk has 0.25 (single feet) to 0.5 (a trot).
    pub limb_phase: f64,
    /// From one side to the other: the angle between the girdles, rad.
    pub trunk_rad: f64,
    /// The same of the hind girdle's yaw against the way that the robot goes, rad.
    pub pelvis_rad: f64,
}

impl Stride {
    /// Measures some frames with this many frames to a stride, in which a foot is on the ground where
    /// `on_ground` says so. `None` for robots of another build, and where no foot moves.
    pub(crate) fn of(
        frames: &[Frame],
        stride: usize,
        spectrum: &Spectrum,
        anatomy: &Anatomy,
        on_ground: &dyn Fn(&Frame, usize) -> bool,
    ) -> Option<Self> {
        let pelvis = anatomy.pelvis.as_ref().filter(|_| !anatomy.sides.is_empty())?;
        let mut at = Kinematics::default();
        let bends = |f: &Frame| -> f64 {
            let joints = f.joint_pos_rad.iter().zip(&anatomy.in_trunk);
            joints.filter(|&(_, &is)| is).map(|(&q, _)| f64::from(q)).sum()
        };
        let yaws = unwrapped(frames.iter().map(|f| {
            let joints = f.joint_pos_rad.len();
            let pos = PerJoint::from_fn(joints, |j| f64::from(f.joint_pos_rad[j]));
            f64::from(f.heading_rad) + pelvis.yaw_off_heading_rad(&pos, &mut at)
        }));
        let trunk: Vec<f64> = frames.iter().map(bends).collect();
        Some(Self {
            limb_phase: limb_phase(frames, spectrum, &anatomy.sides, on_ground)?,
            trunk_rad: excursion(&trunk, stride),
            pelvis_rad: excursion(&yaws, stride),
        })
    }
}

impl Stride {
    /// The mean of some episodes; `None` of none.
    pub(crate) fn mean(all: impl Iterator<Item = Self>) -> Option<Self> {
        let all: Vec<Self> = all.collect();
        let n = all.len() as f64;
        let mean = |value: fn(&Self) -> f64| all.iter().map(value).sum::<f64>() / n;
        let turn: Complex<f64> = all.iter().map(|s| Complex::cis(TAU * s.limb_phase)).sum();
        (!all.is_empty()).then(|| Self {
            limb_phase: (turn.arg() / TAU).rem_euclid(1.0),
            trunk_rad: mean(|s| s.trunk_rad),
            pelvis_rad: mean(|s| s.pelvis_rad),
        })
    }
}

/// Mean over whole strides of the way from the least to the greatest value.
fn excursion(values: &[f64], stride: usize) -> f64 {
    let strides = values.chunks_exact(stride.clamp(1, values.len().max(1)));
    let n = strides.len().max(1) as f64;
    let span = |s: &[f64]| {
        s.iter().copied().fold(f64::MIN, f64::max) - s.iter().copied().fold(f64::MAX, f64::min)
    };
    strides.map(span).sum::<f64>() / n
}

/// Angles without jumps of a whole turn.
fn unwrapped(angles: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut last: Option<f64> = None;
    let next = |angle: f64| {
        let on = last.map_or(angle, |l| l + (angle - l + PI).rem_euclid(TAU) - PI);
        last = Some(on);
        on
    };
    angles.map(next).collect()
}

/// From the cross-spectrum of the contacts of hind and fore foot at the strongest frequency: a delay of a
/// share φ of a stride is a lag of 2πφ there.
fn limb_phase(
    frames: &[Frame],
    spectrum: &Spectrum,
    sides: &[[usize; 2]],
    on_ground: &dyn Fn(&Frame, usize) -> bool,
) -> Option<f64> {
    let contact = |&foot: &usize| {
        let down = |f: &Frame| f64::from(u8::from(on_ground(f, foot)));
        spectrum.of(frames.iter().map(down))
    };
    let pairs: Vec<[Vec<Complex<f64>>; 2]> =
        sides.iter().map(|side| [contact(&side[0]), contact(&side[1])]).collect();
    let power = |k: usize| -> f64 { pairs.iter().flatten().map(|foot| foot[k].norm_sqr()).sum() };
    let peak = (1..spectrum.bins()).max_by(|&a, &b| power(a).total_cmp(&power(b)))?;
    let cross: Complex<f64> = pairs.iter().map(|[hind, fore]| hind[peak].conj() * fore[peak]).sum();
    (cross.norm_sqr() > 0.0).then(|| (-cross.arg() / TAU).rem_euclid(1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::anatomy::tests::polymander;

    /// 12 s at 1 Hz. Each foot is down for 0.75 of the stride: hind left at 0, fore left 0.3 later, the right
    /// side half a stride after the left. The four trunk joints bend by 0.1·sin each, the body does not turn.
    fn walk() -> Vec<Frame> {
        let starts = [0.3, 0.8, 0.0, 0.5];
        let frame = |i: i32| {
            let t = f64::from(i) * 0.02;
            let mut frame = Frame::still(16, 4);
            for (foot, start) in starts.into_iter().enumerate() {
                frame.foot_force_n[foot] = match (t - start).rem_euclid(1.0) < 0.75 {
                    true => 10.0,
                    false => 0.0,
                };
            }
            for j in 1..5 {
                frame.joint_pos_rad[j] = (0.1 * (TAU * t).sin()) as f32;
            }
            frame
        };
        (0..600).map(frame).collect()
    }

    fn measured(frames: &[Frame]) -> Option<Stride> {
        let anatomy = Anatomy::of(&polymander());
        let spectrum = Spectrum::new(frames.len(), 50.0);
        Stride::of(frames, 50, &spectrum, &anatomy, &|f, foot| f.foot_force_n[foot] > 1.0)
    }

    #[test]
    fn a_lateral_sequence_walk_by_hand() {
        let stride = measured(&walk()).unwrap();
        assert!((stride.limb_phase - 0.3).abs() < 0.01, "{stride:?}");
        // four joints of ±0.1 rad: 0.8 rad from side to side
        assert!((stride.trunk_rad - 0.8).abs() < 0.01, "{stride:?}");
        // The girdles turn against each other by that; the heading is the line between them, so that the hind
        // one turns by about half of it.
        assert!((0.3..0.5).contains(&stride.pelvis_rad), "{stride:?}");
    }

    #[test]
    fn nothing_is_said_of_a_robot_that_stands() {
        assert_eq!(measured(&[Frame::still(16, 4); 600]), None);
    }

    #[test]
    fn a_turn_across_half_a_circle_is_no_jump() {
        let angles = unwrapped([3.1, -3.1, -3.0].into_iter());
        assert!((angles[1] - (TAU - 3.1)).abs() < 1e-12);
        assert!((excursion(&angles, 3) - (TAU - 6.1)).abs() < 1e-12);
    }
}
