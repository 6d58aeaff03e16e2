//! The wave along the body: do spine and tail swing one after the other, from head to tail?

use caudata_task::PerJoint;
use rustfft::num_complex::Complex;
use serde::{Deserialize, Serialize};

use crate::Estimate;
use crate::spectrum::Welch;
use crate::trace::Frame;

/// Where the frequency of the wave is looked for, Hz.
const BAND_HZ: [f64; 2] = [0.3, 5.0];
/// Shortest stretch that is looked at, s: two waves of 1.25 Hz.
const SHORTEST_S: f64 = 1.6;
/// Swings below this show no wave, rad: a tenth of a degree, an encoder's step.
const STILL_RAD: f64 = 2e-3;

/// The wave in one stretch of an episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Wave {
    hz: f64,
    /// Half the way from one side to the other at that frequency, rad.
    amplitude_rad: PerJoint<f64>,
    /// conj(Q_j)·Q_{j+1} of neighbours; its argument is minus the lag.
    neighbours: PerJoint<Complex<f64>>,
}

impl Wave {
    /// The wave at the strongest common frequency; `None` where the frames are too few or nothing swings.
    /// `in_leg`: which joints move a leg; the others are the body's, from head to tail.
    pub fn of(frames: &[Frame], period_s: f64, in_leg: &[bool]) -> Option<Self> {
        let body: Vec<usize> = (0..in_leg.len()).filter(|&j| !in_leg[j]).collect();
        if (frames.len() as f64) * period_s < SHORTEST_S || body.len() < 2 {
            return None;
        }
        let length_s = frames.len() as f64 * period_s;
        let welch = Welch::new(frames.len(), 1.0 / period_s, length_s);
        let spectrum = |&joint: &usize| {
            let angle = |f: &Frame| f64::from(f.joint_pos_rad[joint]);
            welch.windowed(&frames.iter().map(angle).collect::<Vec<_>>())
        };
        let spectra: Vec<Vec<Complex<f64>>> = body.iter().map(spectrum).collect();
        let power = |k: usize| spectra.iter().map(|q| q[k].norm_sqr()).sum::<f64>();
        let inside = |&k: &usize| (BAND_HZ[0]..=BAND_HZ[1]).contains(&welch.frequency_hz(k));
        let peak =
            (1..frames.len() / 2).filter(inside).max_by(|&a, &b| power(a).total_cmp(&power(b)))?;
        // a Hann window spreads a line over three bins and passes half of its height; of those the power is
        // 3/2 of the middle one's
        let line = peak.saturating_sub(1).max(1)..=peak + 1;
        let scale = 4.0 / frames.len() as f64 / 1.5_f64.sqrt();
        let amplitude_rad = PerJoint::from_fn(body.len(), |joint| {
            let squares: f64 = line.clone().map(|k| spectra[joint][k].norm_sqr()).sum();
            scale * squares.sqrt()
        });
        if amplitude_rad.iter().all(|&a| a < STILL_RAD) {
            return None;
        }
        let neighbours = PerJoint::from_fn(body.len() - 1, |j| {
            let product = |k: usize| spectra[j][k].conj() * spectra[j + 1][k];
            line.clone().map(product).sum()
        });
        Some(Self { hz: welch.frequency_hz(peak), amplitude_rad, neighbours })
    }
}

/// The wave along the body over all episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WaveResult {
    /// Its frequency, Hz.
    pub hz: Estimate,
    /// Amplitude of each yaw joint at that frequency, head to tail, rad.
    pub amplitude_rad: PerJoint<f64>,
    /// How far each yaw joint lags behind the first, rad: differences of neighbours (each within ±π, from
    /// cross-spectra averaged over episodes) added up.
    pub lag_rad: PerJoint<f64>,
    /// Whether it grows at every joint: a wave that travels to the tail.
    pub travels_to_the_tail: bool,
}

impl WaveResult {
    /// Sums up the waves of some episodes; `None` where none has one.
    pub(crate) fn of(waves: &[Wave]) -> Option<Self> {
        let joints = waves.first()?.amplitude_rad.len();
        let n = waves.len() as f64;
        let mut lag_rad = PerJoint::filled(joints, 0.0);
        for j in 0..joints - 1 {
            // each episode counts alike, however far it swings
            let sum: Complex<f64> = waves
                .iter()
                .map(|w| w.neighbours[j] / w.neighbours[j].norm().max(f64::MIN_POSITIVE))
                .sum();
            lag_rad[j + 1] = lag_rad[j] - sum.arg();
        }
        Some(Self {
            hz: Estimate::of(&waves.iter().map(|w| w.hz).collect::<Vec<_>>()),
            amplitude_rad: PerJoint::from_fn(joints, |j| {
                waves.iter().map(|w| w.amplitude_rad[j]).sum::<f64>() / n
            }),
            travels_to_the_tail: lag_rad.windows(2).all(|w| w[1] > w[0]),
            lag_rad,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::tests::IN_LEG;
    use std::f64::consts::TAU;

    /// 8 s of a wave of 1.3 Hz, each joint `lag_rad` behind the one before it, 0.3 rad.
    fn frames(lag_rad: f64) -> Vec<Frame> {
        let frame = |i: i32| {
            let t = f64::from(i) * 0.02;
            let mut frame = Frame::still(16, 4);
            for j in 0..8 {
                let angle = 0.05 + 0.3 * (TAU * 1.3 * t - lag_rad * j as f64).sin();
                frame.joint_pos_rad[j] = angle as f32;
            }
            frame
        };
        (0..400).map(frame).collect()
    }

    #[test]
    fn a_wave_that_travels_to_the_tail() {
        // 0.5 rad per joint: 3.5 rad at the last one, more than half a turn
        let wave = Wave::of(&frames(0.5), 0.02, &IN_LEG).unwrap();
        let result = WaveResult::of(&[wave, wave]).unwrap();
        assert!((result.hz.mean - 1.3).abs() < 0.07, "{:?}", result.hz);
        for j in 0..8 {
            let lag = result.lag_rad[j];
            assert!((lag - 0.5 * j as f64).abs() < 0.01, "joint {j}: {lag}");
            let amplitude = result.amplitude_rad[j];
            assert!((amplitude - 0.3).abs() < 0.01, "joint {j}: {amplitude}");
        }
        assert!(result.travels_to_the_tail);
    }

    #[test]
    fn waves_to_the_head_and_standing_waves_do_not() {
        let travels = |lag| {
            let wave = Wave::of(&frames(lag), 0.02, &IN_LEG).unwrap();
            WaveResult::of(&[wave]).unwrap().travels_to_the_tail
        };
        assert!(!travels(-0.5));
        assert!(!travels(0.0));
    }

    #[test]
    fn nothing_that_swings_is_no_wave() {
        assert_eq!(Wave::of(&[Frame::still(16, 4); 400], 0.02, &IN_LEG), None);
        assert_eq!(Wave::of(&frames(0.5)[..60], 0.02, &IN_LEG), None);
        assert_eq!(WaveResult::of(&[]), None);
    }
}
