//! On its feet again: from any attitude, how soon does it stand, and does it stay up?

use serde::{Deserialize, Serialize};

use crate::Estimate;
use crate::trace::Trace;

/// Cosine of the tilt within which a robot is upright: 45°.
const UPRIGHT: f32 = std::f32::consts::FRAC_1_SQRT_2;
/// How long it may take, s.
const WITHIN_S: f64 = 3.0;

/// When the robot was upright for good, s; `None`: it was not at the end.
pub(crate) fn righted_s(trace: &Trace) -> Option<f64> {
    let tilted = |f: &crate::Frame| f.upright < UPRIGHT;
    let last = trace.frames.iter().rposition(tilted);
    let from = last.map_or(0, |frame| frame + 1);
    (from < trace.frames.len()).then_some(from as f64 * trace.period_s)
}

/// Episodes that began in any attitude. Upright: tilted by less than 45°.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RightingResult {
    /// Share of the episodes that were upright for good within 3 s.
    pub in_time: Estimate,
    /// Share of the episodes that were upright at their end.
    pub upright: Estimate,
    /// When those were for good, s.
    pub righted_s: Option<Estimate>,
}

impl RightingResult {
    /// Sums up when some episodes were upright for good.
    pub(crate) fn of(righted_s: &[Option<f64>]) -> Self {
        let times: Vec<f64> = righted_s.iter().copied().flatten().collect();
        let in_time = times.iter().filter(|&&t| t <= WITHIN_S).count();
        Self {
            in_time: Estimate::share(in_time, righted_s.len()),
            upright: Estimate::share(times.len(), righted_s.len()),
            righted_s: (!times.is_empty()).then(|| Estimate::of(&times)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Frame;

    /// Twenty seconds with the robot on its back in these stretches, s.
    fn trace(on_its_back: &[std::ops::Range<f64>]) -> Trace {
        let frame = |i: i32| Frame {
            upright: match on_its_back.iter().any(|s| s.contains(&(f64::from(i) * 0.02))) {
                true => -1.0,
                false => 0.99,
            },
            ..Frame::still(16, 4)
        };
        Trace { period_s: 0.02, frames: (0..1000).map(frame).collect(), ..Trace::default() }
    }

    #[test]
    fn who_falls_over_again_was_not_up_before() {
        assert_eq!(righted_s(&trace(&[])), Some(0.0));
        assert_eq!(righted_s(&trace(&[0.0..1.5])), Some(1.5));
        assert_eq!(righted_s(&trace(&[0.0..1.0, 7.0..8.0])), Some(8.0));
        assert_eq!(righted_s(&trace(&[0.0..30.0])), None);
        let result = RightingResult::of(&[Some(0.5), Some(2.5), Some(8.0), None]);
        assert_eq!((result.in_time.mean, result.upright.mean), (0.5, 0.75));
        assert!((result.righted_s.unwrap().mean - 11.0 / 3.0).abs() < 1e-12);
    }
}
