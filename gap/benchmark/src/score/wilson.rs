//! Rates with their intervals.

use serde::Serialize;

/// 95 % of a normal distribution lies within this many standard deviations.
const Z: f64 = 1.959_963_985;

/// So many of so many, with Wilson's 95 % interval (Wilson, J. American Statistical Association 22, 1927).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Rate {
    /// How many.
    pub hits: usize,
    /// How many there were in all.
    pub of: usize,
    /// hits/of; 0 of 0 is 0.
    pub rate: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

impl Rate {
    /// `hits` of `of`.
    pub fn new(hits: usize, of: usize) -> Self {
        if of == 0 {
            return Self { high: 1.0, ..Self::default() };
        }
        let (n, p) = (of as f64, hits as f64 / of as f64);
        let below = 1.0 + Z * Z / n;
        let centre = (p + Z * Z / (2.0 * n)) / below;
        let half = Z / below * (p * (1.0 - p) / n + Z * Z / (4.0 * n * n)).sqrt();
        Self { hits, of, rate: p, low: (centre - half).max(0.0), high: (centre + half).min(1.0) }
    }

    /// Counts how many of those for which `among` holds have `hit`.
    pub fn count<T>(all: &[T], among: impl Fn(&T) -> bool, hit: impl Fn(&T) -> bool) -> Self {
        let of: Vec<&T> = all.iter().filter(|x| among(x)).collect();
        Self::new(of.iter().filter(|x| hit(x)).count(), of.len())
    }
}

impl std::fmt::Display for Rate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.of == 0 {
            return f.write_str("-");
        }
        write!(
            f,
            "{:.0} % ({} of {}; {:.0}-{:.0} %)",
            100.0 * self.rate,
            self.hits,
            self.of,
            100.0 * self.low,
            100.0 * self.high
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_by_hand() {
        // 0 of 200: upper bound z²/(n + z²) = 3.8415/203.84 = 1.885 %
        let none = Rate::new(0, 200);
        assert!((none.high - 0.018_845).abs() < 1e-5 && none.low == 0.0);
        // 5 of 10: centre 0.5, half width 1.96·√(0.025 + 0.0096036)/1.38415 = 0.26340
        let half = Rate::new(5, 10);
        assert!((half.low - 0.236_59).abs() < 1e-4 && (half.high - 0.763_41).abs() < 1e-4);
        assert_eq!(Rate::new(0, 0).to_string(), "-");
    }
}
