//! Axes: a range, where a value lies in it, and the marks.

use crate::text::{fixed, number};

/// An axis: its range, and whether it is logarithmic.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axis {
    low: f64,
    high: f64,
    log: bool,
}

impl Axis {
    fn linear(low: f64, high: f64) -> Self {
        let log = false;
        Self { low, high, log }
    }

    /// A linear axis over all finite `values`, with a margin; a flat one gets some height.
    pub fn over(values: impl IntoIterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        let span = high - low;
        let margin = if span > 0.0 { 0.06 * span } else { low.abs().max(1e-6) * 0.1 };
        Self::linear(low - margin, high + margin)
    }

    /// A linear axis over exactly this span (of time).
    pub fn exact(values: impl IntoIterator<Item = f64>) -> Self {
        let (low, high) = extent(values);
        let high = if high > low { high } else { low + 1.0 };
        Self::linear(low, high)
    }

    /// A logarithmic axis over the positive `values`.
    pub fn log_over(values: impl IntoIterator<Item = f64>) -> Self {
        let (low, high) = extent(values.into_iter().filter(|x| *x > 0.0));
        let (low, high) = if low > 0.0 { (low, high) } else { (0.1, 1.0) };
        Self { low: low / 1.25, high: high * 1.25, log: true }
    }

    /// The axis, made long enough that `x` is inside.
    pub fn with(mut self, x: f64) -> Self {
        self.low = self.low.min(x);
        self.high = self.high.max(x);
        self
    }

    /// 0 at the low end, 1 at the high end.
    pub fn place(&self, x: f64) -> f64 {
        if self.log {
            (x.max(1e-300) / self.low).ln() / (self.high / self.low).ln()
        } else {
            (x - self.low) / (self.high - self.low)
        }
    }

    /// About so many marks at round places, with their labels.
    pub fn ticks(&self, about: usize) -> Vec<(f64, String)> {
        if self.log {
            return self.log_ticks();
        }
        let raw = (self.high - self.low) / about.max(1) as f64;
        let unit = 10f64.powf(raw.log10().floor());
        let step =
            [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * unit).find(|s| *s >= raw).unwrap_or(raw);
        let decimals = -step.log10().floor();
        let label = |x: f64| {
            let most = self.low.abs().max(self.high.abs());
            if most < 1e6 && decimals <= 4.0 { fixed(x, decimals) } else { number(x) }
        };
        let first = (self.low / step).ceil() as i64;
        let last = (self.high / step).floor() as i64;
        (first..=last.min(first.saturating_add(20)))
            .map(|k| k as f64 * step)
            .map(|x| (x, label(x)))
            .collect()
    }

    fn log_ticks(&self) -> Vec<(f64, String)> {
        let within_two_decades = self.high / self.low < 120.0;
        let steps: &[f64] = if within_two_decades { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let (first, last) = (self.low.log10().floor(), self.high.log10());
        (0..40)
            .map(|k| first + f64::from(k))
            .take_while(|power| *power <= last)
            .flat_map(|power| steps.iter().map(move |m| m * 10f64.powf(power)))
            .filter(|x| (self.low..=self.high).contains(x))
            .map(|x| (x, number(x)))
            .collect()
    }
}

fn extent(values: impl IntoIterator<Item = f64>) -> (f64, f64) {
    let finite = values.into_iter().filter(|x| x.is_finite());
    let (low, high) =
        finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    if low <= high { (low, high) } else { (0.0, 1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: Axis, about: usize) -> Vec<String> {
        axis.ticks(about).into_iter().map(|tick| tick.1).collect()
    }

    #[test]
    fn marks_stand_at_round_places_and_differ() {
        assert_eq!(labels(Axis::exact([0.0, 10.0]), 5), ["0", "2", "4", "6", "8", "10"]);
        // three digits would say 100 five times
        assert_eq!(
            labels(Axis::exact([100.0, 101.0]), 5),
            ["100", "100.2", "100.4", "100.6", "100.8", "101"]
        );
        let log = Axis::log_over([0.1, 2.0]);
        assert_eq!(labels(log, 5), ["0.1", "0.2", "0.5", "1", "2"]);
        assert!(log.place(0.08).abs() < 1e-9);
    }

    #[test]
    fn flat_and_strange_values_have_a_range() {
        let flat = Axis::over([2.0, 2.0]);
        assert!((flat.place(2.0) - 0.5).abs() < 1e-9);
        assert_eq!(Axis::over([f64::NAN]), Axis::over([0.0, 1.0]));
        for strange in [Axis::over([-f64::MAX, f64::MAX]), Axis::over([1e300, 1e300])] {
            assert!(strange.ticks(5).len() < 25);
        }
    }
}
