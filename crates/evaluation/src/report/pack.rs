//! Tables of numbers, made small: 16-bit steps between the least and the greatest value of each column,
//! base64.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

/// Steps between the least and the greatest value of a column.
const STEPS: f64 = 65_535.0;

/// A table `[rows, columns]`; value = `low + step · u16`, little endian, row by row.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Packed {
    /// Rows.
    pub rows: usize,
    /// Least value of each column.
    pub low: Vec<f64>,
    /// Resolution of each column.
    pub step: Vec<f64>,
    /// The steps, base64.
    pub data: String,
}

impl Packed {
    /// Packs rows of one length. What is not finite counts as the column's least value: a page must not break
    /// on a broken robot.
    pub fn of(rows: &[Vec<f32>]) -> Self {
        let columns = rows.first().map_or(0, Vec::len);
        let column = |c: usize| {
            let values = rows.iter().filter_map(move |row| row.get(c).copied());
            values.filter(|v| v.is_finite()).map(f64::from)
        };
        let low: Vec<f64> = (0..columns)
            .map(|c| column(c).fold(f64::INFINITY, f64::min))
            .map(|low| if low.is_finite() { low } else { 0.0 })
            .collect();
        let step: Vec<f64> =
            (0..columns).map(|c| (column(c).fold(low[c], f64::max) - low[c]) / STEPS).collect();
        let mut bytes = Vec::with_capacity(2 * rows.len() * columns);
        for row in rows {
            for ((value, low), step) in row.iter().zip(&low).zip(&step) {
                let steps = match *step > 0.0 && value.is_finite() {
                    true => ((f64::from(*value) - low) / step).round(),
                    false => 0.0,
                };
                bytes.extend((steps.clamp(0.0, STEPS) as u16).to_le_bytes());
            }
        }
        Self { rows: rows.len(), low, step, data: STANDARD.encode(&bytes) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_by_hand() {
        // column 0 from −1 to 1: 0.5 is 3/4 of 65,535 = 49,151.25 → 49,151 = 0xBFFF; column 1 is constant
        let packed = Packed::of(&[vec![-1.0, 7.0], vec![0.5, 7.0], vec![1.0, f32::NAN]]);
        assert_eq!((packed.rows, packed.low), (3, vec![-1.0, 7.0]));
        assert_eq!(packed.step, [2.0 / 65_535.0, 0.0]);
        let bytes = [0, 0, 0, 0, 0xFF, 0xBF, 0, 0, 0xFF, 0xFF, 0, 0];
        assert_eq!(packed.data, STANDARD.encode(bytes));
        assert_eq!(Packed::of(&[]).rows, 0);
    }
}
