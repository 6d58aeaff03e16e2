//! Signals on an even grid, and how two of them go together. Not a number (NaN) stands for "not known".

use caudata_runlog::{Signal, Table};

/// Coarsest and finest grid, s.
const GRID_S: (f64, f64) = (0.005, 0.05);
/// Longest hole that is bridged, s.
const BRIDGE_S: f64 = 0.25;
/// Most grid points: two hours at 100 Hz. A longer log is judged by its beginning.
const MAX_POINTS: usize = 720_000;

/// From this correlation on, two signals go against each other.
pub const AGAINST: f64 = -0.5;

/// An even time grid over a log.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Time of the first point, s.
    pub start_s: f64,
    /// Step, s.
    pub step_s: f64,
    /// Points.
    pub len: usize,
}

impl Grid {
    /// The grid of a log: the median step of its [`busiest`] signal, not finer than 5 ms and not coarser than 50
    /// ms.
    pub fn of(table: &Table) -> Self {
        let time_s = table.time_s();
        let start_s = time_s.first().copied().unwrap_or(0.0);
        let span_s = time_s.last().copied().unwrap_or(0.0) - start_s;
        let step_s = median_step_s(&busiest(table)).clamp(GRID_S.0, GRID_S.1);
        let len = ((span_s / step_s).floor() as usize).saturating_add(1).min(MAX_POINTS);
        Self { start_s, step_s, len }
    }

    /// Points in `s` seconds, at least one.
    pub fn points(&self, s: f64) -> usize {
        ((s / self.step_s).round() as usize).max(1)
    }

    /// The signal at every grid point: between two samples on the line through them, NaN in holes longer than
    /// 0.25 s. `None` without such a column.
    pub fn linear(&self, table: &Table, signal: &Signal) -> Option<Vec<f64>> {
        let samples = samples(table, signal)?;
        let mut next = 0;
        let out = (0..self.len).map(|i| {
            let t = self.start_s + i as f64 * self.step_s;
            while next < samples.len() && samples[next].0 <= t {
                next += 1;
            }
            let before = next.checked_sub(1).map(|k| samples[k]);
            match (before, samples.get(next)) {
                (Some((t0, x0)), _) if t - t0 < 1e-9 => x0,
                (Some((t0, x0)), Some(&(t1, x1))) if t1 - t0 <= BRIDGE_S => {
                    x0 + (x1 - x0) * (t - t0) / (t1 - t0)
                }
                _ => f64::NAN,
            }
        });
        Some(out.collect())
    }

    /// The signal as it holds from sample to sample (a command, a switch); NaN before the first.
    pub fn held(&self, table: &Table, signal: &Signal) -> Option<Vec<f64>> {
        let samples = samples(table, signal)?;
        let mut next = 0;
        let out = (0..self.len).map(|i| {
            // a little later than the grid point: a command logged with the row belongs to it
            let t = self.start_s + i as f64 * self.step_s + 1e-9;
            while next < samples.len() && samples[next].0 <= t {
                next += 1;
            }
            next.checked_sub(1).map_or(f64::NAN, |k| samples[k].1)
        });
        Some(out.collect())
    }
}

fn samples(table: &Table, signal: &Signal) -> Option<Vec<(f64, f64)>> {
    let column = table.column(signal)?;
    let known = table.time_s().iter().zip(column);
    Some(known.filter_map(|(&t, x)| Some((t, (*x)?))).collect())
}

/// Times of the signal with the most values, s. Where signals have stamps of their own, as the topics of a ROS
/// bag have, rows come at no rate of any of them.
pub fn busiest(table: &Table) -> Vec<f64> {
    let values = |signal: &&Signal| table.column(signal).map_or(0, |c| c.iter().flatten().count());
    let most = table.signals().iter().max_by_key(values);
    let samples = most.and_then(|signal| samples(table, signal)).unwrap_or_default();
    samples.into_iter().map(|sample| sample.0).collect()
}

/// Median of the steps between rows, s; 0 for fewer than two rows.
pub fn median_step_s(time_s: &[f64]) -> f64 {
    median(time_s.windows(2).map(|w| w[1] - w[0]).collect()).unwrap_or(0.0)
}

/// Rows farther apart than this tell nothing of a servo, s.
const SLOWEST_S: f64 = 0.4;

/// What the stamps of rows are in that are so far apart: nobody samples a servo slower than once in
/// [`SLOWEST_S`], or, with a clock of a finer unit, faster than 2,500 times a second.
pub fn unit_of_steps(step: f64) -> &'static str {
    match step / SLOWEST_S {
        s if s <= 1.0 => "s",
        s if s <= 1e3 => "ms",
        s if s <= 1e6 => "us",
        _ => "ns",
    }
}

/// Median of what is finite.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|x| x.is_finite());
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Mean over a window of `width` points about each point; NaN where less than half of it is known.
pub fn smooth(x: &[f64], width: usize) -> Vec<f64> {
    let mut sums = Vec::with_capacity(x.len() + 1);
    let (mut sum, mut known) = (0.0, 0usize);
    sums.push((0.0, 0));
    for &v in x {
        if v.is_finite() {
            sum += v;
            known += 1;
        }
        sums.push((sum, known));
    }
    let (back, ahead) = (width / 2, width - width / 2);
    (0..x.len())
        .map(|i| {
            let (low, high) = (i.saturating_sub(back), (i + ahead).min(x.len()));
            let count = sums[high].1 - sums[low].1;
            if 2 * count >= high - low && count > 0 {
                (sums[high].0 - sums[low].0) / count as f64
            } else {
                f64::NAN
            }
        })
        .collect()
}

/// Slope over ± `half` points, per `step_s`; NaN at the ends.
pub fn slope(x: &[f64], half: usize, step_s: f64) -> Vec<f64> {
    let n = x.len();
    (0..n)
        .map(|i| {
            if i < half || i + half >= n {
                return f64::NAN;
            }
            (x[i + half] - x[i - half]) / (2.0 * half as f64 * step_s)
        })
        .collect()
}

/// How two signals go together over the points where both are known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Together {
    /// Correlation, −1 to 1; 0 where one of them does not move.
    pub r: f64,
    /// Least-squares slope of the second on the first.
    pub slope: f64,
    /// Standard deviation of the first.
    pub first_sd: f64,
    /// Standard deviation of the second.
    pub second_sd: f64,
    /// Points.
    pub points: usize,
}

/// The first signal `lag` points ago (negative: points ahead) against the second.
pub fn together(first: &[f64], second: &[f64], lag: isize) -> Together {
    let (mut n, mut sx, mut sy, mut sxx, mut syy, mut sxy) = (0usize, 0.0, 0.0, 0.0, 0.0, 0.0);
    for (i, &y) in second.iter().enumerate() {
        let Some(&x) = i.checked_add_signed(-lag).and_then(|k| first.get(k)) else { continue };
        if x.is_finite() && y.is_finite() {
            n += 1;
            sx += x;
            sy += y;
            sxx += x * x;
            syy += y * y;
            sxy += x * y;
        }
    }
    let count = (n as f64).max(1.0);
    let vx = (sxx / count - (sx / count).powi(2)).max(0.0);
    let vy = (syy / count - (sy / count).powi(2)).max(0.0);
    let cov = sxy / count - sx * sy / (count * count);
    let scale = (vx * vy).sqrt();
    Together {
        r: if scale > 1e-18 { cov / scale } else { 0.0 },
        slope: if vx > 1e-18 { cov / vx } else { 0.0 },
        first_sd: vx.sqrt(),
        second_sd: vy.sqrt(),
        points: n,
    }
}

/// The lag in points, from `lags`, at which `first` goes best with `second`, and how.
pub fn best_lag(
    first: &[f64],
    second: &[f64],
    lags: std::ops::RangeInclusive<isize>,
) -> (isize, Together) {
    let mut best = (0, together(first, second, 0));
    for lag in lags {
        let this = together(first, second, lag);
        if this.r > best.1.r {
            best = (lag, this);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> Table {
        Table::parse("log.csv", text.as_bytes()).unwrap()
    }

    #[test]
    fn a_grid_bridges_lost_samples_and_leaves_holes() {
        let t = table("t,pos.a,cmd.a\n0,0,1\n0.01,,\n0.02,2,3\n0.03,3,\n1.0,4,\n");
        let grid = Grid { start_s: 0.0, step_s: 0.01, len: 101 };
        let x = grid.linear(&t, &"pos.a".parse().unwrap()).unwrap();
        assert!((x[1] - 1.0).abs() < 1e-9 && x[3] == 3.0);
        assert!(x[50].is_nan(), "a hole of almost a second");
        let u = grid.held(&t, &"cmd.a".parse().unwrap()).unwrap();
        assert_eq!((u[1], u[2], u[100]), (1.0, 3.0, 3.0));
        assert!(grid.linear(&t, &"vel.a".parse().unwrap()).is_none());
    }

    #[test]
    fn a_delayed_and_scaled_copy_is_recognised() {
        let wave = |i: f64| (0.05 * i).sin() + (0.021 * i + 1.0).cos();
        let x: Vec<f64> = (0..1000).map(|i| wave(f64::from(i))).collect();
        let y: Vec<f64> = (0..1000).map(|i| 0.5 * wave(f64::from(i) - 7.0) + 3.0).collect();
        let (lag, t) = best_lag(&x, &y, -20..=20);
        assert_eq!(lag, 7);
        assert!((t.r - 1.0).abs() < 1e-9 && (t.slope - 0.5).abs() < 1e-9);
        assert!(together(&x, &y.iter().map(|v| -v).collect::<Vec<_>>(), 7).r < -0.999);
    }

    #[test]
    fn smoothing_and_slopes_of_a_line() {
        let x: Vec<f64> = (0..20).map(f64::from).collect();
        assert_eq!(smooth(&x, 5)[10], 10.0);
        assert_eq!(slope(&x, 2, 0.5)[10], 2.0); // one per point, two points a second
        assert!(slope(&x, 2, 0.5)[1].is_nan());
        assert_eq!(median(vec![3.0, f64::NAN, 1.0, 2.0]), Some(2.0));
    }
}
