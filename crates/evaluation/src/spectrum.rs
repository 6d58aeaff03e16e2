//! Spectra of evenly sampled signals.

use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};
use std::sync::Arc;

/// A Fourier transform for signals of one length.
pub(crate) struct Spectrum {
    fft: Arc<dyn Fft<f64>>,
    rate_hz: f64,
}

impl Spectrum {
    /// For signals of `samples` values, `rate_hz` a second.
    pub fn new(samples: usize, rate_hz: f64) -> Self {
        Self {
            fft: FftPlanner::new().plan_fft_forward(samples),
            rate_hz,
        }
    }

    /// Frequency of bin `k`, Hz.
    pub fn frequency_hz(&self, k: usize) -> f64 {
        k as f64 * self.rate_hz / self.fft.len() as f64
    }

    /// Bins from 0 up to half the sampling rate.
    pub fn bins(&self) -> usize {
        self.fft.len() / 2 + 1
    }

    /// The transform of a signal with its mean taken off.
    pub fn of(&self, signal: impl Iterator<Item = f64>) -> Vec<Complex<f64>> {
        let mut values: Vec<Complex<f64>> = signal.map(|x| Complex::new(x, 0.0)).collect();
        let mean = values.iter().sum::<Complex<f64>>() / values.len().max(1) as f64;
        values.iter_mut().for_each(|x| *x -= mean);
        self.fft.process(&mut values);
        values
    }

    /// The frequency of the largest value of `power` (one per bin) between `low_hz` and half the sampling rate, refined by a parabola
    /// through the peak and its neighbours. `None` where nothing moves.
    pub fn peak_hz(&self, power: &[f64], low_hz: f64) -> Option<f64> {
        let first = (0..self.bins()).find(|&k| self.frequency_hz(k) >= low_hz)?;
        let last = self.bins().checked_sub(1)?;
        let peak = (first..last).max_by(|&a, &b| power[a].total_cmp(&power[b]))?;
        if power[peak] <= 0.0 {
            return None;
        }
        let side = |k: usize| power.get(k).copied().unwrap_or(0.0).sqrt();
        let (below, at, above) = (side(peak.saturating_sub(1)), side(peak), side(peak + 1));
        let bend = below - 2.0 * at + above;
        let shift = if bend < 0.0 {
            (0.5 * (below - above) / bend).clamp(-0.5, 0.5)
        } else {
            0.0
        };
        Some(self.frequency_hz(peak) + shift * self.frequency_hz(1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn finds_the_frequency_of_a_sine_between_two_bins() {
        // 10 s at 50 Hz: bins every 0.1 Hz; 1.37 Hz lies between two
        let s = Spectrum::new(500, 50.0);
        let spectrum = s.of((0..500).map(|i| 3.0 + (TAU * 1.37 * f64::from(i) / 50.0).sin()));
        let power: Vec<f64> = spectrum[..s.bins()].iter().map(|c| c.norm_sqr()).collect();
        let peak = s.peak_hz(&power, 0.3).unwrap();
        assert!((peak - 1.37).abs() < 0.03, "{peak}");
        assert!(power[0] < 1e-12, "the mean is taken off");
    }

    #[test]
    fn nothing_moves_no_peak() {
        let s = Spectrum::new(100, 50.0);
        assert_eq!(s.peak_hz(&vec![0.0; s.bins()], 0.3), None);
    }
}
