//! Evolution on a fixed set.

use caudata_random::{Key, Purpose, Stream};

use caudata_gap::replay::Variant;

use super::data::{CaseData, DataError, square};
use super::fit::{Fit, named};

/// Points a generation.
const POINTS: usize = 16;

/// Baseline 2: covariance matrix adaptation on delay, armature, viscous and Coulomb friction, and bias
/// (Hansen, "The CMA evolution strategy: a tutorial", 2016, with its default weights and rates). Names what
/// moved most, in steps that matter.
pub fn evolve(data: &CaseData, generations: usize) -> Result<(Fit, Vec<&'static str>), DataError> {
    // one parameter each
    const LIST: [&str; 5] =
        ["command_delay", "armature", "viscous_friction", "coulomb_friction", "encoder_offset"];
    let nothing: Variant = LIST.iter().flat_map(|id| data.each(id)).collect();
    let n = nothing.len();
    let scale = |k: usize| nothing[k].scale(data.model(), 0);
    let place = |y: &[f64]| -> Variant {
        let mut terms = nothing.clone();
        for (k, term) in terms.iter_mut().enumerate() {
            let (low, high) = term.bounds(data.model(), 0);
            term.values[0] = (term.values[0] + y[k] * scale(k)).clamp(low, high);
        }
        terms
    };
    let mut s = Stream::new(Key::for_run(1), Purpose::Action);
    let rates = Rates::of(n);
    let mut cloud = Cloud::of(n);
    let mut best = Fit { terms: nothing.clone(), cost: f64::INFINITY, values: 0, sd: Vec::new() };
    for _ in 0..generations {
        let draw = |s: &mut Stream| (0..n).map(|_| s.normal_f64()).collect::<Vec<f64>>();
        let draws: Vec<Vec<f64>> = (0..POINTS).map(|_| draw(&mut s)).collect();
        let steps = cloud.steps(&draws);
        let points: Vec<Variant> = steps.iter().map(|d| place(&cloud.point(d))).collect();
        let residuals = data.residuals(&data.fit, &points)?;
        let mut order: Vec<(f64, usize)> = residuals.iter().map(|r| square(r)).zip(0..).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0));
        if order[0].0 < best.cost {
            (best.cost, best.values) = (order[0].0, residuals[0].len());
            best.terms.clone_from(&points[order[0].1]);
        }
        let order: Vec<usize> = order.into_iter().map(|(_, k)| k).collect();
        cloud.learn(&rates, &steps, &draws, &order);
    }
    let names = named(data, &best.terms, scale, 1.0);
    Ok((best, names))
}

/// Weights and rates of learning.
struct Rates {
    weights: Vec<f64>,
    mass: f64,
    cc: f64,
    cs: f64,
    c1: f64,
    cmu: f64,
    ds: f64,
    /// Length of a draw on average.
    expected: f64,
}

impl Rates {
    fn of(n: usize) -> Self {
        let dim = n as f64;
        let parents = POINTS / 2;
        let raw: Vec<f64> =
            (0..parents).map(|i| (parents as f64 + 0.5).ln() - (i as f64 + 1.0).ln()).collect();
        let total: f64 = raw.iter().sum();
        let weights: Vec<f64> = raw.iter().map(|w| w / total).collect();
        let mass = 1.0 / weights.iter().map(|w| w * w).sum::<f64>();
        let cs = (mass + 2.0) / (dim + mass + 5.0);
        let c1 = 2.0 / ((dim + 1.3).powi(2) + mass);
        Self {
            weights,
            mass,
            cc: (4.0 + mass / dim) / (dim + 4.0 + 2.0 * mass / dim),
            cs,
            c1,
            cmu: (1.0 - c1).min(2.0 * (mass - 2.0 + 1.0 / mass) / ((dim + 2.0).powi(2) + mass)),
            ds: 1.0 + 2.0 * (((mass - 1.0) / (dim + 1.0)).sqrt() - 1.0).max(0.0) + cs,
            expected: dim.sqrt() * (1.0 - 1.0 / (4.0 * dim) + 1.0 / (21.0 * dim * dim)),
        }
    }
}

/// Where points are drawn.
struct Cloud {
    mean: Vec<f64>,
    sigma: f64,
    /// `[n, n]`
    cov: Vec<f64>,
    pc: Vec<f64>,
    ps: Vec<f64>,
}

impl Cloud {
    fn of(n: usize) -> Self {
        let mut cov = vec![0.0; n * n];
        (0..n).for_each(|i| cov[i * n + i] = 1.0);
        Self { mean: vec![0.0; n], sigma: 1.0, cov, pc: vec![0.0; n], ps: vec![0.0; n] }
    }

    fn steps(&self, draws: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let n = self.mean.len();
        let root = lower(&self.cov, n);
        let row = |z: &[f64], i: usize| (0..=i).map(|k| root[i * n + k] * z[k]).sum();
        let step = |z: &Vec<f64>| (0..n).map(|i| row(z, i)).collect();
        draws.iter().map(step).collect()
    }

    fn point(&self, step: &[f64]) -> Vec<f64> {
        let pairs = self.mean.iter().zip(step);
        pairs.map(|(m, d)| m + self.sigma * d).collect()
    }

    /// Moves towards the best of `steps`, which came of `draws`; `order`: their numbers, best first.
    fn learn(&mut self, r: &Rates, steps: &[Vec<f64>], draws: &[Vec<f64>], order: &[usize]) {
        let n = self.mean.len();
        let mixed = |from: &[Vec<f64>], i: usize| -> f64 {
            let best = r.weights.iter().zip(order);
            best.map(|(w, k)| w * from[*k][i]).sum()
        };
        for i in 0..n {
            let (step, draw) = (mixed(steps, i), mixed(draws, i));
            self.mean[i] += self.sigma * step;
            // with a triangular root the white step is the mixed draw itself
            self.ps[i] = (1.0 - r.cs) * self.ps[i] + (r.cs * (2.0 - r.cs) * r.mass).sqrt() * draw;
            self.pc[i] = (1.0 - r.cc) * self.pc[i] + (r.cc * (2.0 - r.cc) * r.mass).sqrt() * step;
        }
        for i in 0..n {
            for j in 0..n {
                let best = r.weights.iter().zip(order);
                let rank: f64 = best.map(|(w, k)| w * steps[*k][i] * steps[*k][j]).sum();
                self.cov[i * n + j] = (1.0 - r.c1 - r.cmu) * self.cov[i * n + j]
                    + r.c1 * self.pc[i] * self.pc[j]
                    + r.cmu * rank;
            }
        }
        self.sigma *= (r.cs / r.ds * (square(&self.ps).sqrt() / r.expected - 1.0)).exp();
    }
}

/// Lower triangular root of a covariance; what rounding makes negative counts as nothing.
fn lower(a: &[f64], n: usize) -> Vec<f64> {
    let mut l = vec![0.0; n * n];
    for j in 0..n {
        let mut d = a[j * n + j];
        for k in 0..j {
            d -= l[j * n + k] * l[j * n + k];
        }
        l[j * n + j] = d.max(1e-12).sqrt();
        for i in j + 1..n {
            let mut x = a[i * n + j];
            for k in 0..j {
                x -= l[i * n + k] * l[j * n + k];
            }
            l[i * n + j] = x / l[j * n + j];
        }
    }
    l
}
