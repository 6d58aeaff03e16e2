//! The curves of a run in bounded memory: when there are too many points, neighbours are averaged.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Points kept; a picture has fewer pixels.
const POINTS_MAX: usize = 2048;

/// What is known of one iteration, or the mean over several neighbours.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Point {
    /// Iterations that went into it.
    pub iterations: u64,
    /// Environment steps since the run began.
    pub steps: f64,
    /// Named values. One that is not known yet is absent.
    pub values: BTreeMap<String, f64>,
}

/// Points in order of time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct History {
    /// Iterations per point.
    stride: u64,
    points: Vec<Point>,
    /// The point that is being filled.
    open: Vec<Point>,
}

impl Default for History {
    fn default() -> Self {
        Self { stride: 1, points: Vec::new(), open: Vec::new() }
    }
}

impl History {
    /// Adds an iteration.
    pub fn push(&mut self, point: Point) {
        self.open.push(point);
        if (self.open.len() as u64) < self.stride {
            return;
        }
        self.points.push(mean(&self.open));
        self.open.clear();
        if self.points.len() > POINTS_MAX {
            self.points = self.points.chunks(2).map(mean).collect();
            self.stride *= 2;
        }
    }

    /// (steps, value) of every point that has `name`.
    pub fn series(&self, name: &str) -> Vec<(f64, f64)> {
        let pick = |point: &Point| point.values.get(name).map(|value| (point.steps, *value));
        self.points.iter().filter_map(pick).collect()
    }

    /// All names that begin with `prefix`, in order.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        let mut names: Vec<String> =
            self.points.iter().flat_map(|p| p.values.keys().cloned()).collect();
        names.retain(|name| name.starts_with(prefix));
        names.sort_unstable();
        names.dedup();
        names
    }
}

/// Each value's mean over the points that have it; the steps of the last.
fn mean(points: &[Point]) -> Point {
    let mut sums: BTreeMap<String, (f64, f64)> = BTreeMap::new();
    for point in points {
        for (name, value) in &point.values {
            let sum = sums.entry(name.clone()).or_default();
            sum.0 += value * point.iterations as f64;
            sum.1 += point.iterations as f64;
        }
    }
    Point {
        iterations: points.iter().map(|point| point.iterations).sum(),
        steps: points.last().map_or(0.0, |point| point.steps),
        values: sums.into_iter().map(|(name, (sum, weight))| (name, sum / weight)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(steps: f64, value: f64) -> Point {
        Point { iterations: 1, steps, values: BTreeMap::from([("a".to_owned(), value)]) }
    }

    #[test]
    fn a_long_run_keeps_its_shape_in_bounded_memory() {
        let mut history = History::default();
        for i in 0..10_000 {
            history.push(point(f64::from(i), f64::from(i)));
        }
        let series = history.series("a");
        assert!(series.len() <= POINTS_MAX && series.len() > POINTS_MAX / 2, "{}", series.len());
        // Points 0 to 7 make the first one after three halvings: mean 3.5, at the steps of its last.
        assert_eq!((history.points[0].iterations, series[0]), (8, (7.0, 3.5)));
        let back: History =
            serde_json::from_str(&serde_json::to_string(&history).unwrap()).unwrap();
        assert_eq!(back, history);
    }

    #[test]
    fn values_that_come_late_are_averaged_over_where_they_are() {
        let late = Point { values: BTreeMap::from([("b".to_owned(), 4.0)]), ..point(1.0, 0.0) };
        let merged = mean(&[point(0.0, 2.0), late]);
        assert_eq!((merged.values["a"], merged.values["b"]), (2.0, 4.0));
        let mut history = History::default();
        history.push(merged);
        assert_eq!(history.names("b"), ["b"]);
        assert!(history.series("c").is_empty());
    }
}
