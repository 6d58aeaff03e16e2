//! Spectra of evenly sampled signals.

use std::f64::consts::PI;
use std::sync::Arc;

use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};

/// A Fourier transform for signals of one length.
pub(crate) struct Spectrum {
    fft: Arc<dyn Fft<f64>>,
    rate_hz: f64,
}

impl Spectrum {
    /// For signals of `samples` values, `rate_hz` a second.
    pub fn new(samples: usize, rate_hz: f64) -> Self {
        Self { fft: FftPlanner::new().plan_fft_forward(samples), rate_hz }
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
        let values: Vec<f64> = signal.collect();
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        self.transform(values.iter().map(|x| x - mean))
    }

    fn transform(&self, signal: impl Iterator<Item = f64>) -> Vec<Complex<f64>> {
        let mut values: Vec<Complex<f64>> = signal.map(|x| Complex::new(x, 0.0)).collect();
        self.fft.process(&mut values);
        values
    }

    /// The frequency of the largest value of `power` (one per bin) between `low_hz` and half the sampling
    /// rate, refined by a parabola through the peak and its neighbours. `None` where nothing moves.
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
        let shift = if bend < 0.0 { (0.5 * (below - above) / bend).clamp(-0.5, 0.5) } else { 0.0 };
        Some(self.frequency_hz(peak) + shift * self.frequency_hz(1))
    }
}

/// Welch's estimate of the cross-spectrum of two signals: segments with a Hann window that overlap by half,
/// averaged as complex numbers.
///
/// P. D. Welch, "The use of fast Fourier transform for the estimation of power spectra", IEEE Trans. Audio
/// Electroacoust. 15 (1967). Averaging before taking any modulus lets what two noises have in common by
/// chance fall with the number of segments; the window keeps a strong slow line from leaking into fast bins.
pub(crate) struct Welch {
    spectrum: Spectrum,
    window: Vec<f64>,
    segment: usize,
}

impl Welch {
    /// Segments of `segment_s`, shorter where the signals (of `samples` values, `rate_hz` a second) are.
    pub fn new(samples: usize, rate_hz: f64, segment_s: f64) -> Self {
        let segment = ((segment_s * rate_hz).round() as usize).clamp(1, samples.max(1));
        let hann = |i: usize| (PI * i as f64 / segment as f64).sin().powi(2);
        Self {
            spectrum: Spectrum::new(segment, rate_hz),
            window: (0..segment).map(hann).collect(),
            segment,
        }
    }

    /// Frequency of bin `k`, Hz.
    pub fn frequency_hz(&self, k: usize) -> f64 {
        self.spectrum.frequency_hz(k)
    }

    /// Re of the mean over segments of conj(A)·B, one value per bin: the power that `b` does on `a` at that
    /// frequency, up to a common factor.
    pub fn in_phase(&self, a: &[f64], b: &[f64]) -> Vec<f64> {
        let mut sums = vec![0.0; self.spectrum.bins()];
        let hop = (self.segment / 2).max(1);
        let segments = a.windows(self.segment).zip(b.windows(self.segment));
        for (a, b) in segments.step_by(hop) {
            let (a, b) = (self.windowed(a), self.windowed(b));
            for (sum, (a, b)) in sums.iter_mut().zip(a.iter().zip(&b)) {
                *sum += (a.conj() * b).re;
            }
        }
        sums
    }

    /// The transform of a segment, its mean taken off before the window is put on.
    pub fn windowed(&self, segment: &[f64]) -> Vec<Complex<f64>> {
        let mean = segment.iter().sum::<f64>() / segment.len().max(1) as f64;
        let values = segment.iter().zip(&self.window);
        self.spectrum.transform(values.map(|(x, w)| (x - mean) * w))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn in_phase_power_by_hand() {
        // a = cos, b = cos(· − 60°) at 5 Hz: the mean product is cos(60°)/2 = 1/4, in quadrature it is 0.
        // With a Hann window the line is in three bins: 4.5, 5 and 5.5 Hz for 2 s.
        let wave = |shift: f64| -> Vec<f64> {
            let at = |i| (TAU * 5.0 * f64::from(i) / 50.0 - shift).cos();
            (0..500).map(at).collect()
        };
        let welch = Welch::new(500, 50.0, 2.0);
        let power = |shift: f64| welch.in_phase(&wave(0.0), &wave(shift));
        let (same, sixty, ninety) = (power(0.0), power(TAU / 6.0), power(TAU / 4.0));
        let all = |p: &[f64]| p.iter().sum::<f64>();
        assert!((all(&sixty) / all(&same) - 0.5).abs() < 1e-9);
        assert!((all(&ninety) / all(&same)).abs() < 1e-9);
        let line: f64 = (9..=11).map(|k| same[k]).sum();
        assert_eq!(welch.frequency_hz(10), 5.0);
        assert!((line / all(&same) - 1.0).abs() < 1e-9, "{same:?}");
    }

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
