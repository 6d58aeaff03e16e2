//! Count, mean and sum of squared deviations of observations, for the learner's normaliser.

use caudata_proto::Moments;

/// Moments of `rows` (`[n, dim]`, row-major) by Welford's method in f64 (Welford 1962; Knuth, TAOCP 2,
/// 4.2.2).
///
/// The learner merges chunks exactly with Chan's formula, so that raw sums are not needed.
pub fn moments_of(rows: &[f32], dim: usize) -> Moments {
    let mut mean = vec![0.0; dim];
    let mut m2 = vec![0.0; dim];
    let mut count = 0u64;
    for row in rows.chunks_exact(dim) {
        count += 1;
        let share = 1.0 / count as f64;
        for ((&x, mean), m2) in row.iter().zip(&mut mean).zip(&mut m2) {
            let x = f64::from(x);
            let before = x - *mean;
            *mean += before * share;
            *m2 += before * (x - *mean);
        }
    }
    Moments { count, mean, m2 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_by_hand() {
        // Column 0: 1, 2, 6: mean 3, deviations −2, −1, 3, squares 4 + 1 + 9 = 14. Column 1 is constant.
        let moments = moments_of(&[1.0, 5.0, 2.0, 5.0, 6.0, 5.0], 2);
        assert_eq!(moments.count, 3);
        assert!((moments.mean[0] - 3.0).abs() < 1e-15 && (moments.m2[0] - 14.0).abs() < 1e-14);
        assert_eq!((moments.mean[1], moments.m2[1]), (5.0, 0.0));
    }

    #[test]
    fn a_large_offset_does_not_cost_the_variance() {
        // 10,000 + {0, 1}: the variance is ¼; Σx² − n·mean² in f32 would lose it.
        let rows: Vec<f32> = (0..1000).map(|i| 10_000.0 + (i % 2) as f32).collect();
        let moments = moments_of(&rows, 1);
        assert!((moments.m2[0] / 1000.0 - 0.25).abs() < 1e-9, "{moments:?}");
    }
}
